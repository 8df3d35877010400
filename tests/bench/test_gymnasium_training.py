"""Other people's training code runs on the environments as it stands."""

import math
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.vector.wrappers.sb3 import ManiSkillSB3VectorEnv
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.monitor import Monitor
from torch import nn
from torch.nn import functional

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


# ------------------------------------------------------------------ in CleanRL's style


def make_env(env_id, options):
    """CleanRL's ``make_env``, with options."""

    def thunk():
        env = gym.make(env_id, **options)
        env = gym.wrappers.RecordEpisodeStatistics(env)
        env.action_space.seed(1)
        return env

    return thunk


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


class Critic(nn.Module):
    def __init__(self, envs):
        super().__init__()
        inputs = np.array(envs.single_observation_space.shape).prod()
        inputs += np.prod(envs.single_action_space.shape)
        self.net = nn.Sequential(nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, x, a):
        return self.net(torch.cat([x, a], 1)).view(-1)


class Actor(nn.Module):
    def __init__(self, envs):
        super().__init__()
        self.trunk = nn.Linear(np.array(envs.single_observation_space.shape).prod(), 64)
        self.mean = nn.Linear(64, np.prod(envs.single_action_space.shape))
        self.log_std = nn.Linear(64, np.prod(envs.single_action_space.shape))
        space = envs.single_action_space
        self.register_buffer("scale", torch.tensor((space.high - space.low) / 2.0))
        self.register_buffer("bias", torch.tensor((space.high + space.low) / 2.0))

    def get_action(self, x):
        x = torch.relu(self.trunk(x))
        std = (-5 + 3.5 * (torch.tanh(self.log_std(x)) + 1)).exp()
        normal = torch.distributions.Normal(self.mean(x), std)
        raw = normal.rsample()
        squashed = torch.tanh(raw)
        log_prob = normal.log_prob(raw) - torch.log(self.scale * (1 - squashed.pow(2)) + 1e-6)
        return squashed * self.scale + self.bias, log_prob.sum(1)


def weights(*modules):
    return torch.cat([p.detach().flatten().clone() for m in modules for p in m.parameters()])


@pytest.mark.slow
def test_a_single_file_sac_trains():
    torch.manual_seed(0)
    envs = SyncVectorEnv([make_env(SINGLE, OPTIONS)], autoreset_mode=AutoresetMode.SAME_STEP)
    assert isinstance(envs.single_action_space, gym.spaces.Box)
    actor, critic, target = Actor(envs), Critic(envs), Critic(envs)
    target.load_state_dict(critic.state_dict())
    before = weights(actor, critic)
    actor_optimizer = torch.optim.Adam(actor.parameters(), lr=3e-4)
    critic_optimizer = torch.optim.Adam(critic.parameters(), lr=1e-3)
    envs.single_observation_space.dtype = np.float32
    replay = ReplayBuffer(
        10_000,
        envs.single_observation_space,
        envs.single_action_space,
        "cpu",
        handle_timeout_termination=False,
    )
    lengths, losses = [], []
    obs, _ = envs.reset(seed=1)
    for step in range(500):
        if step < 100:
            actions = np.array([envs.single_action_space.sample() for _ in range(envs.num_envs)])
        else:
            actions = actor.get_action(torch.Tensor(obs))[0].detach().numpy()
        next_obs, rewards, terminations, truncations, infos = envs.step(actions)
        real_next_obs = next_obs.copy()
        ended = terminations | truncations
        if ended.any():
            lengths += infos["final_info"]["episode"]["l"][ended].tolist()
            for index in np.flatnonzero(ended):
                real_next_obs[index] = infos["final_obs"][index]
            assert (real_next_obs != next_obs).any()
        replay.add(obs, real_next_obs, actions, rewards, terminations, infos)
        obs = next_obs
        if step < 100:
            continue
        data = replay.sample(64)
        with torch.no_grad():
            action, log_prob = actor.get_action(data.next_observations)
            value = target(data.next_observations, action) - 0.2 * log_prob
            goal = data.rewards.flatten() + (1 - data.dones.flatten()) * 0.99 * value
        critic_loss = functional.mse_loss(critic(data.observations, data.actions), goal)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()
        action, log_prob = actor.get_action(data.observations)
        actor_loss = (0.2 * log_prob - critic(data.observations, action)).mean()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()
        for new, old in zip(critic.parameters(), target.parameters(), strict=True):
            old.data.lerp_(new.data, 0.005)
        losses.append([critic_loss.item(), actor_loss.item()])
    envs.close()
    assert len(losses) == 400
    assert np.isfinite(losses).all()
    assert sum(lengths) > 500 - LIMIT
    assert max(lengths) == LIMIT
    assert (weights(actor, critic) != before).float().mean() > 0.9


@pytest.mark.slow
def test_a_single_file_ppo_trains_on_processes():
    """PPO's loop over environments in processes, which reset on the step after an end."""
    torch.manual_seed(0)
    n, steps = 2, 128
    envs = AsyncVectorEnv([make_env(f"symsteer.bench.tasks:{SINGLE}", OPTIONS) for _ in range(n)])
    try:
        actor, value = Actor(envs), nn.Linear(envs.single_observation_space.shape[0], 1)
        before = weights(actor, value)
        optimizer = torch.optim.Adam([*actor.parameters(), *value.parameters()], lr=3e-4)
        episodes, losses = [], []
        obs, _ = envs.reset(seed=1)
        done = np.zeros(n, dtype=bool)
        for _ in range(4):
            batch = []
            for _ in range(steps):
                x = torch.Tensor(obs)
                mean = torch.tanh(actor.mean(torch.relu(actor.trunk(x))))
                normal = torch.distributions.Normal(mean, 0.3)
                action = normal.sample()
                following, reward, terminated, truncated, infos = envs.step(action.numpy())
                # A step that only resets is no experience.
                kept = torch.as_tensor(~done)
                batch.append((x, action, normal.log_prob(action).sum(1).detach(), reward, kept))
                if "episode" in infos:
                    episodes += infos["episode"]["l"][infos["_episode"]].tolist()
                obs, done = following, terminated | truncated
            x, action, old, reward, kept = (
                torch.cat([torch.as_tensor(row[i]) for row in batch]) for i in range(5)
            )
            assert 0 < int((~kept).sum()) <= len(episodes)
            advantage = (reward.float() - value(x).view(-1).detach())[kept]
            for _ in range(50):
                mean = torch.tanh(actor.mean(torch.relu(actor.trunk(x[kept]))))
                new = torch.distributions.Normal(mean, 0.3).log_prob(action[kept]).sum(1)
                ratio = (new - old[kept]).exp()
                clipped = ratio.clamp(0.8, 1.2)
                policy_loss = -torch.min(ratio * advantage, clipped * advantage).mean()
                value_loss = functional.mse_loss(value(x[kept]).view(-1), reward.float()[kept])
                optimizer.zero_grad()
                (policy_loss + value_loss).backward()
                optimizer.step()
                losses.append([policy_loss.item(), value_loss.item()])
    finally:
        envs.close()
    assert len(losses) == 200
    assert np.isfinite(losses).all()
    assert max(episodes) == LIMIT
    changed = weights(actor, value) != before
    assert changed.float().mean() > 0.5
