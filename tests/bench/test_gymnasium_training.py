"""Other people's training code runs on the environments as it stands."""

import math
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import SyncVectorEnv
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.vector.wrappers.sb3 import ManiSkillSB3VectorEnv
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor

import symsteer.bench.tasks  # noqa: F401  (registers the ids)

SINGLE = "SymSteer/PushCube-single-dense-v1"
OPTIONS = {"variant": "action_gain:0.5"}
LIMIT = 50


class Losses(BaseCallback):
    """Keeps every loss that Stable-Baselines3 logs."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        logged = self.model.logger.name_to_value
        self.seen.append({k: v for k, v in logged.items() if k.endswith("loss")})
        return True


def test_stable_baselines3s_checker_passes():
    check_env(gym.make(SINGLE, **OPTIONS), warn=True)


def test_maniskills_wrapper_for_stable_baselines3():
    env = ManiSkillSB3VectorEnv(gym.make("SymSteer/PushCube-dense-v1", num_envs=3, **OPTIONS))
    env.seed(0)
    first = env.reset()
    assert first.shape == (3, env.observation_space.shape[0])
    ends = 0
    for _ in range(LIMIT + 1):
        obs, rewards, dones, infos = env.step(np.stack([env.action_space.sample()] * 3))
        ends += dones.sum()
    assert (rewards.shape, obs.shape, len(infos)) == ((3,), first.shape, 3)
    assert ends >= 3


@pytest.mark.slow
def test_stable_baselines3_trains(tmp_path):
    env = CPUGymWrapper(gym.make("SymSteer/PushCube-dense-v1", num_envs=1, **OPTIONS))
    model = SAC("MlpPolicy", Monitor(env), learning_starts=100, batch_size=64, seed=0, device="cpu")
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    losses = Losses()
    model.learn(500, callback=losses, log_interval=10**9)
    assert model._n_updates == 400
    final = losses.seen[-1]
    assert {"train/actor_loss", "train/critic_loss", "train/ent_coef_loss"} <= set(final)
    assert all(math.isfinite(value) for step in losses.seen for value in step.values())
    trained = [n for n, p in model.policy.named_parameters() if not torch.equal(p, before[n])]
    assert len(trained) == len(before)

    episodes = model.ep_info_buffer
    assert sum(episode["l"] for episode in episodes) > 500 - LIMIT
    assert max(episode["l"] for episode in episodes) == LIMIT
    # Time-outs are bootstrapped through, successes are not.
    buffer, stored = model.replay_buffer, slice(0, model.replay_buffer.pos)
    timeouts = buffer.timeouts[stored].sum()
    successes = buffer.dones[stored].sum() - timeouts
    assert timeouts == sum(episode["l"] == LIMIT for episode in episodes)
    assert timeouts + successes == len(episodes)
    assert np.isfinite(buffer.rewards[stored]).all()
    assert buffer.rewards[stored].std() > 0

    model.save(tmp_path / "sac")
    loaded = SAC.load(tmp_path / "sac", device="cpu")
    obs, _ = env.reset(seed=1)
    action, _ = loaded.predict(obs, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(obs, deterministic=True)[0])
    assert action in env.action_space


def test_cleanrls_ppo_wraps_the_documented_id():
    """Its wrappers and vector environment, with the three changes that docs/gymnasium.md gives."""
    page = Path(__file__).parents[2] / "docs" / "gymnasium.md"
    (env_id,) = set(re.findall(r"--env-id (symsteer\S+)", page.read_text()))

    def thunk():
        env = gym.wrappers.FlattenObservation(gym.make(env_id))
        env = gym.wrappers.ClipAction(gym.wrappers.RecordEpisodeStatistics(env))
        env = gym.wrappers.NormalizeObservation(env)
        clip = (lambda obs: np.clip(obs, -10, 10), env.observation_space)
        env = gym.wrappers.NormalizeReward(gym.wrappers.TransformObservation(env, *clip))
        return gym.wrappers.TransformReward(env, lambda reward: np.clip(reward, -10, 10))

    envs = SyncVectorEnv(autoreset_mode="SameStep", env_fns=[thunk, thunk])
    envs.reset(seed=1)
    rewards = []
    for _ in range(LIMIT):
        _, reward, *_, infos = envs.step(envs.action_space.sample())
        rewards.append(reward)
    assert np.std(rewards) > 0, "the reward is dense"
    ended = np.flatnonzero(infos["_final_info"])
    assert [infos["final_info"]["episode"]["l"][i] for i in ended] == [LIMIT, LIMIT]
    envs.close()
