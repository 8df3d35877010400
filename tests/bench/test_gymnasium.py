"""Environments for others: gymnasium's API, ManiSkill's wrappers, NumPy."""

import copy
import json
import pickle
import re
import subprocess
import sys
import warnings
from pathlib import Path

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env
from mani_skill import logger
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.wrappers import CachedResetWrapper
from mani_skill.utils.wrappers.action_repeat import ActionRepeatWrapper
from mani_skill.utils.wrappers.frame_stack import FrameStack
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from mani_skill.vector.wrappers.sb3 import ManiSkillSB3VectorEnv
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import TASKS, make, task_class
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError

BATCHED = "SymSteer/PickCube-v1"
SINGLE = "SymSteer/PickCube-single-v1"
PAGE = Path(__file__).parents[2] / "docs" / "gymnasium.md"
BROKEN = {"variant": "action_gain", "strength": 0.5}

# What gymnasium's checker says about every ManiSkill environment: it is wrapped, and its
# observations are not bounded.
HARMLESS = ("different from the unwrapped version", "value is -infinity", "value is infinity")


# ------------------------------------------------------------------ one environment


@pytest.mark.parametrize(
    ("make_env", "flags"),
    [
        (
            lambda: gym.make(
                SINGLE, embodiment="panda", reward_mode="dense", obs_mode="state_dict", **BROKEN
            ),
            {},
        ),
        # gymnasium cannot make an environment anew from its spec once CPUGymWrapper is around it,
        # which is how the checker tests other render modes and closing twice.
        (
            lambda: CPUGymWrapper(gym.make(BATCHED, num_envs=1, **BROKEN)),
            {"skip_render_check": True, "skip_close_check": True},
        ),
    ],
)
def test_gymnasiums_checker_passes(make_env, flags):
    env = make_env()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, **flags)
    texts = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    assert [text for text in texts if not any(part in text for part in HARMLESS)] == []
    env.close()
    env.close()


def rollout(env, seed, steps=60):
    """Observations, rewards and ends of an episode with the space's own random actions."""
    env.action_space.seed(seed)
    trace = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        assert [type(x) for x in (reward, terminated, truncated)] == [float, bool, bool]
        trace.append(np.concatenate([obs, [reward, terminated, truncated]]))
        if terminated or truncated:
            break
    return trace


@pytest.mark.parametrize("embodiment", ["floating", "panda"])
def test_one_environment_alone_is_the_one_of_a_batch(embodiment):
    """``gpu_sim_enabled`` is false to wrappers here, and the simulation must not notice."""
    options = {"embodiment": embodiment, "reward_mode": "dense", **BROKEN}
    env, batch = gym.make(SINGLE, **options), gym.make(BATCHED, num_envs=3, **options)
    trace = rollout(env, 7)
    assert len(trace) == 51
    assert trace[-1][-1], "the time limit ends it"
    first = trace[0]
    assert (type(first), first.dtype, first in env.observation_space) == (np.ndarray, "f4", True)
    for again, before in zip(rollout(env, 7), trace, strict=True):
        np.testing.assert_array_equal(again, before)
    assert not env.unwrapped.gpu_sim_enabled
    assert batch.unwrapped.gpu_sim_enabled

    env.action_space.seed(7)
    obs, _ = batch.reset(seed=[1, 7, 2])
    np.testing.assert_array_equal(obs[1].numpy(), first)
    for expected in trace[1:12]:
        action = np.stack([np.zeros(7), env.action_space.sample(), np.ones(7)])
        obs, reward, *_ = batch.step(torch.as_tensor(action, dtype=torch.float32))
        # The arm's inverse kinematics rounds differently in a batch, depending on the CPU.
        np.testing.assert_allclose(obs[1].numpy(), expected[:-3], atol=5e-5)
        np.testing.assert_allclose(reward[1].item(), expected[-3], atol=5e-5)


def test_what_belongs_to_one_environment_or_one_step():
    env = gym.make(BATCHED)
    assert ("rgb_array" in env.metadata["render_modes"]) == rendering_works()
    assert env.metadata["render_fps"] == 20
    _, info = env.reset(seed=3)
    first = env.np_random.random(4)
    env.step(torch.zeros(1, 7))
    assert info["elapsed_steps"].tolist() == [0]
    env.reset(seed=3)
    np.testing.assert_array_equal(env.np_random.random(4), first)


# ------------------------------------------------------------------ registration


def test_importing_the_registries_is_cheap_and_registers_the_ids():
    heavy = ("torch", "mani_skill")
    code = (
        "import sys; from symsteer.bench.tasks import TASKS; from symsteer.bench.variants import "
        f"VARIANTS; seen = [m for m in {heavy} if m in sys.modules]; "
        "[r.summary(name) for r in (TASKS, VARIANTS) for name in r]; import gymnasium as gym; "
        "print(seen, 'torch' in sys.modules, 'SymSteer/PickCube-v1' in gym.registry)"
    )
    command = [sys.executable, "-W", "ignore", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.stdout.split("\n")[-2] == "[] False True", result.stderr


def test_rewards_are_dense_where_the_id_says_so():
    ids = [i for i in gym.registry if i.startswith("SymSteer/")]
    assert len(ids) == 4 * len(TASKS.names())
    for task in TASKS:
        for kind in ("", "-single", "-dense", "-single-dense"):
            spec = gym.spec(f"SymSteer/{task.replace('-v', f'{kind}-v')}")
            mode = spec.kwargs.get("reward_mode", "sparse")
            assert mode == ("normalized_dense" if kind.endswith("dense") else "sparse")
            assert mode in task_class(task).SUPPORTED_REWARD_MODES
            assert spec.max_episode_steps == task_class(task).max_episode_steps
    dense = gym.make("SymSteer/PickCube-single-dense-v1")
    dense.reset(seed=0)
    assert 0 < dense.step(dense.action_space.sample())[1] < 1
    assert gym.make(dense.spec, reward_mode="sparse").unwrapped.reward_mode == "sparse"


@pytest.mark.parametrize("mode", ["pd_ee_delta_pose", "pd_joint_delta_pos", "pd_joint_pos"])
def test_no_control_mode_leaves_out_which_finger_follows(mode, caplog):
    """ManiSkill warns where it has to assume it, at every reconfiguration."""
    logger.addHandler(caplog.handler)
    try:
        gym.make(BATCHED, control_mode=mode)
    finally:
        logger.removeHandler(caplog.handler)
    assert "Mimic" not in caplog.text


def test_a_spec_makes_the_same_environment_again():
    """Also as JSON, which has no tensors."""
    options = {"num_envs": 2, "max_episode_steps": 4, "variant": "wind"}
    env = gym.make(BATCHED, **options, strength=torch.tensor([0.25, 1]))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.variants[0].strength.tolist() == [0.25, 1]
    assert again.spec.max_episode_steps == find_max_episode_steps_value(again) == 4
    single = gym.make(SINGLE, max_episode_steps=4, variant="wind", strength=np.float32(0.25))
    single = gym.make(EnvSpec.from_json(single.spec.to_json()))
    assert single.unwrapped.variants[0].strength == 0.25
    assert [len(rollout(single, seed=0)) for _ in range(2)] == [5, 5]


@pytest.mark.parametrize("workers", [1, 2])
def test_copies_are_refused_and_limits_hold_in_one_process_and_in_two(workers):
    env = gym.make(BATCHED, num_envs=2, max_episode_steps=2, workers=workers)
    for copied in (copy.deepcopy, pickle.dumps):
        for one in (env, env.unwrapped):
            with pytest.raises(UserError, match="cannot be copied or pickled; make another"):
                copied(one)
    with pytest.raises(AttributeError, match="'EpisodeLimit' object has no attribute 'nothing'"):
        _ = env.nothing
    env.reset(seed=0)
    assert [env.step(torch.zeros(2, 7))[3].tolist() for _ in range(2)] == [[False] * 2, [True] * 2]
    env.close()


@pytest.mark.parametrize("limit", [60, -1])
def test_a_limit_of_the_users_holds_for_each_environment(limit):
    env = gym.make(BATCHED, num_envs=2, max_episode_steps=limit)
    env.reset(seed=0)
    for _ in range(3):
        env.step(torch.zeros(2, 7))
    env.reset(options={"env_idx": torch.tensor([1])})
    ends = torch.stack([env.step(torch.zeros(2, 7))[3] for _ in range(60)])
    never = torch.zeros(60, dtype=torch.bool)
    first, second = never.clone(), never.clone()
    first[56:], second[59:] = True, True
    assert torch.equal(ends, torch.stack([first, second] if limit == 60 else [never] * 2, dim=1))


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"embodiment": "pand"}, ["'pand'", "'panda'", "floating"]),
        ({"variant": "action_gian:1"}, ["'action_gian'", "'action_gain'"]),
        ({"variant": "action_gain"}, ["needs a strength", "[0, 1]"]),
        ({"variant": ["action_gain:1"]}, ["is a text", "'action_gain:0.5'"]),
        ({"variant": "action_gain", "strength": 1.5}, ["[0, 1]", "1.5"]),
        ({"variant": "action_gain", "strength": "high"}, ["[0, 1]", "high"]),
        ({"strength": 0.5}, ["without a variant", "0.5"]),
        ({"num_envs": 3, "variant": "action_gain", "strength": [0, 1]}, ["2 strengths", "3 env"]),
        ({"num_envs": 0}, ["num_envs is 0"]),
        ({"num_envs": "4"}, ["num_envs", "whole number", "'4'"]),
        ({"n_envs": 4}, ["option 'n_envs'", "'num_envs'"]),
        ({"varaint": "action_gain:1"}, ["option 'varaint'", "'variant'"]),
        ({"sim": "gpu"}, ['"gpu"', '"cpu" or "cuda"']),
        ({"sim_backend": "bullet"}, ["'bullet'", "physx_cpu"]),
        ({"sim": "cpu", "sim_backend": "gpu"}, ["sim='cpu'", "sim_backend='gpu'"]),
        ({"obs_mode": "stat"}, ["'stat'", "'state'"]),
        ({"reward_mode": "denes"}, ["'denes'", "'dense'", "sparse"]),
        ({"render_mode": "rgb"}, ["'rgb'", "rgb_array"]),
        ({"robot_uids": "panda"}, ["robot_uids='panda'", "embodiment", "floating, panda"]),
        ({"control_mode": "pd_joint_delta_pos", **BROKEN}, ["pd_ee_delta_pose", "leave"]),
        ({"id": SINGLE, "num_envs": 2}, ["leave num_envs out"]),
        pytest.param(
            {"num_envs": 2, "sim_backend": "physx_cuda"},
            ["needs an NVIDIA GPU", "sim='cpu'"],
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here"),
        ),
    ],
)
def test_a_mistaken_option_is_one_sentence(options, parts):
    with pytest.raises(UserError) as error:
        gym.make(**{"id": BATCHED, **options})
    text = str(error.value)
    assert "\n" not in text
    assert all(part in text for part in parts), text


# ------------------------------------------------------------------ N environments


@pytest.fixture(scope="module")
def two():
    env = gym.make(BATCHED, num_envs=2, variant=None, embodiment=None, strength=None)
    env.reset(seed=0)
    assert env.unwrapped.variants == ()  # None means not given
    yield env
    env.close()


@pytest.mark.parametrize("rows", [[2], [-1], [0, 0], [True, False]])
def test_rows_of_a_partial_reset_must_be_there(two, rows):
    with pytest.raises(UserError, match=r"env_idx lists environments by number.*from 0 to 1"):
        two.reset(options={"env_idx": rows})
    two.step(torch.zeros(2, 7))


def test_actions_are_arrays_also_of_whole_numbers(two):
    with pytest.raises(UserError, match=r"tensor or array of shape \(2, 7\), not a list"):
        two.step([[0.0] * 7] * 2)
    seen = []
    for action in (torch.ones(2, 7), torch.ones(2, 7, dtype=torch.int64), np.ones((2, 7), int)):
        two.reset(seed=0)
        seen.append(two.step(action)[0])
    assert torch.equal(seen[0], seen[1])
    assert torch.equal(seen[0], seen[2])


def test_vector_spaces_and_tensors(two):
    dim = task_class("PickCube-v1").observation_layout.dim
    assert two.observation_space.shape == (2, dim)
    assert two.unwrapped.single_observation_space.shape == (dim,)
    assert two.action_space.shape == (2, 7)
    obs, *ends, info = two.step(two.action_space.sample())
    assert obs.shape == (2, dim)
    assert [x.dtype for x in ends] == [torch.float32, torch.bool, torch.bool]
    assert all(x.shape == (2,) for x in (*ends, info["success"]))


@pytest.mark.parametrize("ignore_terminations", [False, True])
def test_maniskills_vector_wrapper_records_episodes(ignore_terminations):
    n = 6
    inner = gym.make("SymSteer/PushCube-v1", num_envs=n)
    env = ManiSkillVectorEnv(inner, ignore_terminations=ignore_terminations, record_metrics=True)
    env.reset(seed=list(range(n)))
    expert = Expert(inner.unwrapped)
    returns, lengths, episodes = torch.zeros(3, n)
    solved = torch.zeros(n, dtype=torch.bool)
    for step in range(60):
        action = expert.act()
        action[0] = 0  # one environment never moves: its episodes end at the limit
        obs, reward, terminated, truncated, info = env.step(action)
        done = terminated | truncated
        ended = info["final_info"] if done.any() else info
        returns, lengths, solved = returns + reward, lengths + 1, solved | ended["success"]
        for name, own in (("return", returns), ("episode_len", lengths), ("success_once", solved)):
            assert torch.equal(ended["episode"][name].to(own.dtype), own)
        if ignore_terminations:
            assert not terminated.any()
            assert torch.equal(truncated, torch.full((n,), step % 50 == 49))
        else:
            assert torch.equal(terminated, ended["success"])
        if done.any():
            # Ended rows restart; the others go on.
            assert torch.equal(info["_final_info"], done)
            assert torch.equal((info["final_observation"] != obs).any(dim=1), done)
            returns[done], lengths[done], solved[done] = 0, 0, False
            episodes += done
    assert episodes[0] == 1
    assert (episodes[1:] == 1 if ignore_terminations else episodes[1:] > 1).all()


@pytest.mark.parametrize("numpy", [False, True])
def test_maniskills_recorder_writes_trajectories(tmp_path, numpy):
    n = 1 if numpy else 2
    env = gym.make(BATCHED, num_envs=n, max_episode_steps=3)
    env = CPUGymWrapper(env) if numpy else env
    env = RecordEpisode(env, str(tmp_path), save_video=False, trajectory_name="t")
    if not numpy:
        env = ManiSkillVectorEnv(env, record_metrics=True)
    env.reset(seed=0)
    for _ in range(6):
        *_, truncated, _ = env.step(env.action_space.sample())
        if numpy and truncated:
            env.reset()
    env.close()
    with h5py.File(tmp_path / "t.h5") as file:
        assert len(file) >= 2 * n
        assert file["traj_0"]["actions"].shape == (3, 7)
        assert file["traj_0"]["obs"].shape[0] == 4
    described = json.loads((tmp_path / "t.json").read_text())["env_info"]
    assert (described["env_id"], described["max_episode_steps"]) == (BATCHED, 3)


def test_maniskills_other_wrappers():
    n, dim = 3, task_class("PickCube-v1").observation_layout.dim
    stacked = FrameStack(gym.make(BATCHED, num_envs=n), num_stack=2)
    stacked.reset(seed=0)
    assert stacked.step(torch.zeros(n, 7))[0].shape == (n, 2, dim)
    repeated = ActionRepeatWrapper(gym.make(BATCHED, num_envs=n), repeat=3)
    repeated.reset(seed=0)
    assert repeated.step(torch.zeros(n, 7))[4]["elapsed_steps"].tolist() == [3] * n
    cached = CachedResetWrapper(gym.make(BATCHED, num_envs=n), config={"num_resets": n, "seed": 0})
    assert cached.reset()[0].shape == (n, dim)
    assert cached.step(torch.zeros(n, 7))[0].shape == (n, dim)


def test_stable_baselines3_takes_both():
    check_sb3_env(gym.make("SymSteer/PushCube-single-dense-v1", **BROKEN), warn=True)
    env = ManiSkillSB3VectorEnv(
        gym.make("SymSteer/PushCube-dense-v1", num_envs=3, max_episode_steps=5, **BROKEN)
    )
    env.seed(0)
    first, ends = env.reset(), 0
    for _ in range(6):
        obs, rewards, dones, infos = env.step(np.stack([env.action_space.sample()] * 3))
        ends += dones.sum()
    assert (rewards.shape, obs.shape, len(infos)) == ((3,), first.shape, 3)
    assert ends == 3
    PPO("MlpPolicy", env, n_steps=6, batch_size=18, n_epochs=1, seed=0).learn(18)


def test_cleanrls_ppo_wraps_the_documented_id():
    """Its wrappers and vector environment, with the three changes that docs/gymnasium.md gives."""
    (env_id,) = set(re.findall(r"--env-id (symsteer\S+)", PAGE.read_text()))

    def thunk():
        env = gym.wrappers.FlattenObservation(gym.make(env_id))
        env = gym.wrappers.ClipAction(gym.wrappers.RecordEpisodeStatistics(env))
        env = gym.wrappers.NormalizeObservation(env)
        clip = (lambda obs: np.clip(obs, -10, 10), env.observation_space)
        env = gym.wrappers.NormalizeReward(gym.wrappers.TransformObservation(env, *clip))
        return gym.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))

    envs = gym.vector.SyncVectorEnv(autoreset_mode="SameStep", env_fns=[thunk, thunk])
    envs.reset(seed=1)
    rewards = []
    for _ in range(50):
        _, reward, *_, infos = envs.step(envs.action_space.sample())
        rewards.append(reward)
    assert np.std(rewards) > 0, "the reward is dense"
    ended = np.flatnonzero(infos["_final_info"])
    assert [infos["final_info"]["episode"]["l"][i] for i in ended] == [50, 50]
    envs.close()


def blocks():
    """Python blocks of the page, by their number."""
    return re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(i, marks=[pytest.mark.slow] if "learn(" in block else [])
        for i, block in enumerate(blocks())
    ],
)
def test_the_page_runs(number, monkeypatch):
    learn = SAC.learn
    monkeypatch.setattr(SAC, "learn", lambda self, total_timesteps: learn(self, 150))
    before, names = set(gym.registry), {"__name__": "__main__"}
    try:
        exec(compile(blocks()[number], f"gymnasium.md, block {number}", "exec"), names)
        if new := set(gym.registry) - before:
            assert names["env"].spec.id in new
            assert names["env"].unwrapped.variants[0].strength == 0.5
    finally:
        for name in set(gym.registry) - before:
            gym.registry.pop(name)


def test_make_vec_takes_single_environments_only():
    envs = gym.make_vec(SINGLE, num_envs=2, **BROKEN)
    obs, _ = envs.reset(seed=[3, 9])
    expected, _ = make("PickCube-v1", num_envs=2, variant="action_gain:0.5").reset(seed=[3, 9])
    np.testing.assert_array_equal(obs, expected.numpy())
    with pytest.raises(gym.error.Error, match="EpisodeLimit"):
        gym.make_vec(BATCHED, num_envs=2)
