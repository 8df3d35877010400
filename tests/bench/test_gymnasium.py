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
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env as check_sb3_env

from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import TASKS, make, task_class
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError
from tests.bench.shared import assert_same
from tests.bench.state_tasks import STATE_TASKS

BATCHED = "SymSteer/PickCube-v1"
SINGLE = "SymSteer/PickCube-single-v1"
PAGE = Path(__file__).parents[2] / "docs" / "gymnasium.md"
BROKEN = {"variant": "action_gain", "strength": 0.5}

# What gymnasium's checker says about every ManiSkill environment: it is wrapped, and its
# observations are not bounded.
HARMLESS = ("different from the unwrapped version", "value is -infinity", "value is infinity")


def single_id(task):
    return f"SymSteer/{task.replace('-v', '-single-v')}"


def checked(env, **flags):
    """Run gymnasium's checker; returns what it warns of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, **flags)
    texts = [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    return [text for text in texts if not any(part in text for part in HARMLESS)]


# ------------------------------------------------------------------ one environment


@pytest.mark.parametrize(
    "options",
    [{}, {"embodiment": "panda", "reward_mode": "dense", "obs_mode": "state_dict", **BROKEN}],
)
def test_gymnasiums_checker_passes(options):
    env = gym.make(SINGLE, **options)
    assert checked(env) == []
    env.close()


def test_gymnasiums_checker_passes_through_cpu_gym_wrapper():
    # gymnasium cannot make an environment anew from its spec once CPUGymWrapper is around it,
    # which is how the checker tests other render modes and closing twice.
    env = CPUGymWrapper(gym.make(BATCHED, num_envs=1, **BROKEN))
    assert checked(env, skip_render_check=True, skip_close_check=True) == []
    env.close()
    env.close()


def test_render_modes_are_those_of_this_machine():
    env = gym.make(BATCHED)
    assert ("rgb_array" in env.metadata["render_modes"]) == rendering_works()
    assert env.metadata["render_fps"] == 20


@pytest.mark.parametrize("task", STATE_TASKS)
def test_every_task_has_an_id_for_numpy(task):
    """``CPUGymWrapper`` around the batched id is the same environment."""
    env = gym.make(single_id(task), **BROKEN)
    batched = CPUGymWrapper(gym.make(f"SymSteer/{task}", num_envs=1, **BROKEN))
    env.action_space.seed(0)
    action, traces = env.action_space.sample(), []
    for one in (env, batched):
        assert one.spec.max_episode_steps == task_class(task).max_episode_steps
        obs, info = one.reset(seed=5)
        steps = [(obs, 0.0, False, False, info), *(one.step(action) for _ in range(2))]
        for array, reward, terminated, truncated, info in steps:
            assert type(array) is np.ndarray
            assert array.dtype == np.float32
            assert array in one.observation_space
            assert [type(x) for x in (reward, terminated, truncated)] == [float, bool, bool]
            assert isinstance(info, dict)
            assert not any(torch.is_tensor(value) for value in info.values())
        traces.append([step[0] for step in steps])
        one.close()
    np.testing.assert_array_equal(*traces)


def rollout(env, seed, steps=60):
    """Observations, rewards and ends of an episode with the space's own random actions."""
    env.action_space.seed(seed)
    trace = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        trace.append(np.concatenate([obs, [reward, terminated, truncated]]))
        if terminated or truncated:
            break
    return trace


@pytest.mark.parametrize("embodiment", ["floating", "panda"])
def test_one_environment_alone_is_the_one_of_a_batch(embodiment):
    """``gpu_sim_enabled`` is false to wrappers here, and the simulation must not notice."""
    env = gym.make(SINGLE, embodiment=embodiment, reward_mode="dense", **BROKEN)
    options = {"embodiment": embodiment, "reward_mode": "dense", **BROKEN}
    batch = gym.make(BATCHED, num_envs=3, **options)
    trace = rollout(env, 7)
    assert len(trace) == 51
    assert trace[-1][-1], "the time limit ends it"
    for again, before in zip(rollout(env, 7), trace, strict=True):
        np.testing.assert_array_equal(again, before)
    assert not env.unwrapped.gpu_sim_enabled
    assert batch.unwrapped.gpu_sim_enabled

    env.action_space.seed(7)
    obs, _ = batch.reset(seed=[1, 7, 2])
    np.testing.assert_array_equal(obs[1].numpy(), trace[0])
    for expected in trace[1:]:
        action = np.stack([np.zeros(7), env.action_space.sample(), np.ones(7)])
        obs, reward, *_ = batch.step(torch.as_tensor(action, dtype=torch.float32))
        # The arm's inverse kinematics rounds differently in a batch, depending on the CPU.
        np.testing.assert_allclose(obs[1].numpy(), expected[:-3], atol=5e-5)
        np.testing.assert_allclose(reward[1].item(), expected[-3], atol=5e-5)


def test_states_of_one_environment_can_be_set():
    env = gym.make(SINGLE)
    env.reset(seed=0)
    action = np.array([1, 0.3, -0.5, 0, 0, 0.5, 1], dtype=np.float32)
    env.step(action)
    state = env.unwrapped.get_state_dict()
    first = env.step(action)[0]
    assert np.abs(env.step(-action)[0] - first).max() > 1e-2
    env.unwrapped.set_state_dict(state)
    np.testing.assert_allclose(env.step(action)[0], first, atol=2e-5)


def test_info_is_not_shared_between_steps():
    env = gym.make(BATCHED)
    _, info = env.reset(seed=0)
    env.step(torch.zeros(1, 7))
    assert info["elapsed_steps"].tolist() == [0]


def test_a_seed_seeds_gymnasiums_generator_too():
    env = gym.make(SINGLE)
    env.reset(seed=3)
    first = env.np_random.random(4)
    env.reset(seed=3)
    assert env.unwrapped.np_random_seed == 3
    np.testing.assert_array_equal(env.np_random.random(4), first)


# ------------------------------------------------------------------ registration


def run(code):
    """What a fresh interpreter prints."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    return result.stdout.split("\n")[-2]


def test_ids_name_their_module():
    """``module:id`` needs no import: all that a script has which takes an id only."""
    code = (
        "import gymnasium as gym; "
        "env = gym.make('symsteer.bench.tasks:SymSteer/PushCube-v1', num_envs=2); "
        "print(env.unwrapped.num_envs, "
        "gym.make('symsteer.bench.tasks:SymSteer/PushCube-single-v1').reset(seed=0)[0].shape)"
    )
    assert run(code) == f"2 ({task_class('PushCube-v1').observation_layout.dim},)"


def test_importing_the_registries_is_cheap_and_registers_the_ids():
    heavy = ("torch", "mani_skill")
    code = (
        "import sys; from symsteer.bench.tasks import TASKS; from symsteer.bench.variants import "
        f"VARIANTS; seen = [m for m in {heavy} if m in sys.modules]; "
        "[r.summary(name) for r in (TASKS, VARIANTS) for name in r]; import gymnasium as gym; "
        "print(seen, 'torch' in sys.modules, 'SymSteer/PickCube-v1' in gym.registry)"
    )
    assert run(code) == "[] False True"


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
        env = gym.make(BATCHED, control_mode=mode)
        env.reset(seed=0, options={"reconfigure": True})
    finally:
        logger.removeHandler(caplog.handler)
    assert "Mimic" not in caplog.text


def test_a_spec_makes_the_same_environment_again():
    """Also as JSON, which has no tensors."""
    env = gym.make(BATCHED, num_envs=2, max_episode_steps=4, variant="wind", strength=[0.25, 1])
    for spec in (env.spec, EnvSpec.from_json(env.spec.to_json())):
        again = gym.make(spec)
        assert again.unwrapped.variants[0].strength.tolist() == [0.25, 1]
        assert again.spec.max_episode_steps == find_max_episode_steps_value(again) == 4
    env = gym.make(BATCHED, num_envs=2, variant="wind", strength=torch.tensor([0.25, 1]))
    assert EnvSpec.from_json(env.spec.to_json()).kwargs["strength"] == [0.25, 1]
    single = gym.make(SINGLE, max_episode_steps=4, variant="wind", strength=np.float32(0.25))
    assert EnvSpec.from_json(single.spec.to_json()).kwargs["strength"] == 0.25
    single = gym.make(single.spec)
    assert single.unwrapped.variants[0].strength == 0.25
    assert [len(rollout(single, seed=0)) for _ in range(2)] == [5, 5]


@pytest.mark.parametrize("options", [{}, {"workers": 2}])
def test_environments_cannot_be_copied(options):
    env = gym.make(BATCHED, num_envs=2, **options)
    for copied in (copy.deepcopy, pickle.dumps):
        for one in (env, env.unwrapped):
            with pytest.raises(UserError, match="cannot be copied or pickled; make another"):
                copied(one)
    with pytest.raises(AttributeError, match="'EpisodeLimit' object has no attribute 'nothing'"):
        _ = env.nothing
    env.close()


@pytest.mark.parametrize("limit", [4, 60])
def test_a_limit_of_the_users_holds_for_each_environment(limit):
    env = gym.make(BATCHED, num_envs=2, max_episode_steps=limit)
    env.reset(seed=0)
    zeros = torch.zeros(2, 7)
    for _ in range(3):
        *_, truncated, _ = env.step(zeros)
    assert not truncated.any()
    env.reset(options={"env_idx": torch.tensor([1])})
    seen = [env.step(zeros)[3].tolist() for _ in range(limit)]
    assert [step.index(True) if True in step else None for step in zip(*seen, strict=True)] == [
        limit - 4,
        limit - 1,
    ]
    assert len(rollout(gym.make(SINGLE, max_episode_steps=limit), 0, steps=99)) == limit + 1


def test_without_a_limit_nothing_is_truncated():
    env = gym.make(BATCHED, max_episode_steps=-1)
    env.reset(seed=0)
    assert not any(env.step(torch.zeros(1, 7))[3].any() for _ in range(60))


def test_an_id_of_ones_own_fixes_a_variant():
    gym.register(
        "Lab/WeakPick-v1",
        entry_point="symsteer.bench.tasks:make_single",
        max_episode_steps=5,
        kwargs={"task": "PickCube-v1", "variant": "action_gain:0.5"},
    )
    try:
        env = gym.make("Lab/WeakPick-v1")
        assert env.unwrapped.variants[0].strength == 0.5
        assert len(rollout(env, seed=0)) == 6
    finally:
        gym.registry.pop("Lab/WeakPick-v1")


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
        ({"render_mode": "rgb"}, ["'rgb'", "'rgb_array'"]),
        ({"robot_uids": "panda"}, ["robot_uids='panda'", "embodiment", "floating, panda"]),
        ({"control_mode": "pd_joint_delta_pos", **BROKEN}, ["pd_ee_delta_pose", "leave"]),
    ],
)
def test_a_mistaken_option_is_one_sentence(options, parts):
    with pytest.raises(UserError) as error:
        gym.make(BATCHED, **options)
    text = str(error.value)
    assert "\n" not in text
    assert all(part in text for part in parts), text


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA here")
@pytest.mark.parametrize("options", [{"sim": "cuda"}, {"sim_backend": "physx_cuda"}])
def test_cuda_where_there_is_none(options):
    with pytest.raises(UserError, match=r"needs an NVIDIA GPU.*sim='cpu'"):
        gym.make(BATCHED, num_envs=2, **options)


def test_a_single_environment_is_single():
    with pytest.raises(UserError, match="leave num_envs out"):
        gym.make(SINGLE, num_envs=2)


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


def test_actions_are_arrays(two):
    with pytest.raises(UserError, match=r"tensor or array of shape \(2, 7\), not a list"):
        two.step([[0.0] * 7] * 2)


@pytest.mark.parametrize("options", [{}, BROKEN])
def test_actions_may_be_whole_numbers(options):
    env = gym.make(BATCHED, **options)
    seen = []
    for action in (torch.ones(1, 7), torch.ones(1, 7, dtype=torch.int64), np.ones((1, 7), int)):
        env.reset(seed=0)
        seen.append(env.step(action)[0])
    assert torch.equal(seen[0], seen[1])
    assert torch.equal(seen[0], seen[2])


# ------------------------------------------------------------------ N environments


def test_vector_spaces_and_tensors():
    env = gym.make(BATCHED, num_envs=4, variant="action_gain", strength=[0, 0.2, 0.5, 1])
    dim = task_class("PickCube-v1").observation_layout.dim
    assert env.observation_space.shape == (4, dim)
    assert env.unwrapped.single_observation_space.shape == (dim,)
    assert env.action_space.shape == (4, 7)
    env.reset(seed=[0, 1, 2, 3])
    obs, *ends, info = env.step(env.action_space.sample())
    assert obs.shape == (4, dim)
    assert [x.dtype for x in ends] == [torch.float32, torch.bool, torch.bool]
    assert all(x.shape == (4,) for x in (*ends, info["success"]))
    assert env.unwrapped.variants[0].strength.tolist() == pytest.approx([0, 0.2, 0.5, 1])


@pytest.mark.parametrize("ignore_terminations", [False, True])
def test_maniskills_vector_wrapper_records_episodes(ignore_terminations):
    n = 6
    inner = gym.make("SymSteer/PushCube-v1", num_envs=n)
    env = ManiSkillVectorEnv(inner, ignore_terminations=ignore_terminations, record_metrics=True)
    env.reset(seed=list(range(n)))
    expert = Expert(inner.unwrapped)
    returns, lengths = torch.zeros(n), torch.zeros(n)
    solved = torch.zeros(n, dtype=torch.bool)
    episodes = torch.zeros(n)
    for step in range(100):
        action = expert.act()
        action[0] = 0  # one environment never moves: its episodes end at the limit
        obs, reward, terminated, truncated, info = env.step(action)
        returns += reward
        lengths += 1
        done = terminated | truncated
        ended = info["final_info"] if done.any() else info
        solved |= ended["success"]
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
    assert episodes[0] == 2
    assert (episodes[1:] == 2 if ignore_terminations else episodes[1:] > 3).all()


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
    described = json.loads((tmp_path / "t.json").read_text())
    assert described["env_info"]["env_id"] == BATCHED
    assert described["env_info"]["max_episode_steps"] == 3


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


def single_broken():
    return CPUGymWrapper(gym.make(BATCHED, num_envs=1, **BROKEN), record_metrics=True)


def test_environments_in_processes_are_those_of_a_batch():
    seeds = [3, 9]
    envs = gym.vector.AsyncVectorEnv([single_broken] * 2)
    ours = gym.make(BATCHED, num_envs=2, **BROKEN)
    try:
        obs, _ = envs.reset(seed=seeds)
        expected, _ = ours.reset(seed=seeds)
        assert obs.dtype == np.float32
        np.testing.assert_array_equal(obs, expected.numpy())
        envs.action_space.seed(0)
        for _ in range(5):
            action = envs.action_space.sample()
            obs, reward, _, _, info = envs.step(action)
            expected, expected_reward, *_ = ours.step(torch.as_tensor(action))
            np.testing.assert_allclose(obs, expected.numpy(), atol=1e-5)
            np.testing.assert_allclose(reward, expected_reward.numpy())
        assert info["episode"]["episode_len"].tolist() == [5, 5]
    finally:
        envs.close()


def test_environments_spread_over_workers_are_those_of_one_process():
    envs = [
        ManiSkillVectorEnv(
            gym.make(BATCHED, num_envs=3, max_episode_steps=4, workers=workers, **BROKEN),
            record_metrics=True,
        )
        for workers in (1, 2)
    ]
    try:
        assert envs[0].single_observation_space == envs[1].single_observation_space
        assert_same(*(env.reset(seed=[3, 4, 5]) for env in envs))
        envs[0].action_space.seed(0)
        for step in range(9):
            action = envs[0].action_space.sample()
            results = [env.step(action) for env in envs]
            assert_same(*results)
            assert ("final_info" in results[0][-1]) == (step in (3, 7))
    finally:
        for env in envs:
            env.close()


def test_stable_baselines3s_checker_passes():
    check_sb3_env(gym.make("SymSteer/PushCube-single-dense-v1", **BROKEN), warn=True)


def test_maniskills_wrapper_for_stable_baselines3():
    env = ManiSkillSB3VectorEnv(gym.make("SymSteer/PushCube-dense-v1", num_envs=3, **BROKEN))
    env.seed(0)
    first = env.reset()
    assert first.shape == (3, env.observation_space.shape[0])
    ends = 0
    for _ in range(50 + 1):
        obs, rewards, dones, infos = env.step(np.stack([env.action_space.sample()] * 3))
        ends += dones.sum()
    assert (rewards.shape, obs.shape, len(infos)) == ((3,), first.shape, 3)
    assert ends >= 3


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
    before = set(gym.registry)
    try:
        exec(
            compile(blocks()[number], f"gymnasium.md, block {number}", "exec"),
            {"__name__": "__main__"},
        )
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
