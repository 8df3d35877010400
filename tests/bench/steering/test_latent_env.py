"""The latent-noise environment compared with single steps of the task."""

import pytest
import torch

from symsteer.bench.steering.evaluation import long_episodes, long_limit, rollout, steerability
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.tasks import make, task_class
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy, PolicyOptions
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions

TASK = "PickCube-v1"


def untrained_policy(execute: int = 4) -> ChunkPolicy:
    torch.manual_seed(0)
    task = task_class(TASK)
    options = EquivariantOptions(channels=8, width=16, depth=1, execute=execute, sampling_steps=2)
    return EquivariantDiffusionPolicy(options, task.observation_layout, task.action_layout)


class NoiseIsAction(ChunkPolicy):
    """A decoder that plays its noise, so that a test decides every action."""

    def __init__(self, execute: int):
        task = task_class(TASK)
        options = PolicyOptions(horizon=execute, execute=execute)
        super().__init__(options, task.observation_layout, task.action_layout)

    @classmethod
    def fit(cls, *_):
        raise NotImplementedError

    def decode(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        return noise


@pytest.fixture(scope="module")
def env():
    env = make(TASK, num_envs=4)
    yield env
    env.close()


def test_step_is_the_decoded_chunk_played_by_hand(env):
    policy = untrained_policy()
    latent = LatentNoiseEnv(env, policy)
    seeds = [3, 4, 5, 6]
    noise = torch.randn(3, 4, policy.horizon, policy.act_layout.dim)
    obs = latent.reset(seeds)
    seen = [obs]
    for w in noise:
        result = latent.step(w)
        assert torch.equal(result.reward, torch.full((4,), -float(policy.execute)))
        assert not result.terminal.any()
        seen.append(result.obs_after)
    obs, _ = env.reset(seed=seeds)
    for i, w in enumerate(noise):
        assert torch.equal(obs, seen[i])
        actions = policy.decode(obs, w)
        for t in range(policy.execute):
            obs, *_ = env.step(actions[:, t])
    assert torch.equal(obs, seen[-1])
    assert latent.control_steps == 3 * policy.execute * 4


def test_an_episode_that_ends_within_a_chunk_ends_with_its_own_observation(env):
    """Between decisions nobody looks, but where an episode ends."""
    latent = LatentNoiseEnv(env, NoiseIsAction(execute=8))
    noise = 0.1 * torch.randn(4, 8, 7, generator=torch.Generator().manual_seed(1))
    noise[:, :2, :3], noise[:, :, 6] = 1.0, 1.0
    steps, states = [], []
    for play in (lambda: steps.extend(env.step(noise[:, t]) for t in range(8)), None):
        latent.reset([0, 1, 2, 3])
        env.elapsed_steps[3] = latent._elapsed[3] = env.max_episode_steps - 1
        state = env.get_state_dict()
        # Cubes that lie in their goals: success, once the hand stands still.
        state["actors"]["goal_site"][:2, :3] = state["actors"]["cube"][:2, :3]
        env.set_state_dict(state)
        states.append(env.get_state())
        result = play() if play else latent.step(noise)
    assert torch.equal(*states)
    success = torch.stack([info["success"] for *_, info in steps])
    first = [int(column.int().argmax()) if column.any() else 7 for column in success.T[:3]]
    assert result.terminal.tolist() == [True, True, False, False]
    assert result.truncated.tolist() == [False, False, False, True]
    assert 0 < first[0] < 7
    for row, t in enumerate([*first, 0]):
        assert torch.equal(result.next_obs[row], steps[t][0][row])
    assert result.reward.tolist() == [-float(t) for t in first[:2]] + [-8.0, -1.0]
    assert set(steps[0][4]) > {"is_grasped", "success"}


def expert_chunk(env, expert: Expert) -> torch.Tensor:
    """One expert action as a chunk of one, with environment 0 held still."""
    action = expert.act()
    action[0] = 0.0
    return action[:, None]


def test_success_ends_an_episode_and_its_cost(env):
    latent = LatentNoiseEnv(env, NoiseIsAction(execute=1))
    latent.reset([0, 1, 2, 3])
    expert = Expert(env)
    total = torch.zeros(4)
    for _ in range(env.max_episode_steps):
        before = env.elapsed_steps.clone()
        result = latent.step(expert_chunk(env, expert))
        total += result.reward
        won = result.terminal.nonzero().flatten()
        assert torch.equal(result.reward == 0, result.terminal)
        if len(won):
            assert not result.truncated[won].any()
            assert result.episodes["success_once"].all()
            # A return of -(length - 1): every step costs 1, except the one that succeeds.
            length = before[won] + 1
            assert torch.equal(result.episodes["episode_len"].float(), length.float())
            assert torch.equal(result.episodes["return"], -(length.float() - 1))
            # The next observation is the end of the old episode, not the start of the new one.
            assert (result.next_obs[won] != result.obs_after[won]).any(dim=1).all()
            break
    else:
        pytest.fail("the expert never succeeded")


def test_time_out_truncates_without_terminal(env):
    latent = LatentNoiseEnv(env, NoiseIsAction(execute=8))
    latent.reset([0, 1, 2, 3])
    still = torch.zeros(4, 8, latent.policy.act_layout.dim)
    decisions = -(-env.max_episode_steps // 8)
    for _ in range(decisions - 1):
        assert not latent.step(still).truncated.any()
    result = latent.step(still)
    assert result.truncated.all()
    assert not result.terminal.any()
    # The last chunk is cut by the time limit: only what was executed costs.
    last = env.max_episode_steps - 8 * (decisions - 1)
    assert result.reward.tolist() == [-float(last)] * 4
    assert result.episodes["return"].tolist() == [-float(env.max_episode_steps)] * 4
    assert env.elapsed_steps.tolist() == [0] * 4


def test_a_longer_limit_does_not_end_an_episode_at_the_limit_of_the_task(env):
    latent = LatentNoiseEnv(
        env, NoiseIsAction(execute=8), True, max_episode_steps=env.max_episode_steps + 20
    )
    obs = latent.reset([0, 1, 2, 3])
    still = torch.zeros(4, 8, latent.policy.act_layout.dim)
    for _ in range(-(-env.max_episode_steps // 8)):
        result = latent.step(still)
        # Also the decision across the task's limit is complete.
        assert result.reward.tolist() == [-8.0] * 4
        assert not result.truncated.any()
    assert (result.obs_after - obs).abs().max() < 0.1
    # The observation does not hold the time, so that values beyond the limit are defined.
    assert not any(
        "time" in field.name or "step" in field.name for field in env.observation_layout.fields
    )


def test_rollout_does_not_depend_on_the_number_of_environments(env):
    # A network's products differ in the last bit with the size of the batch; this decoder has none.
    policy = NoiseIsAction(execute=4)
    seeds = held_out_seeds(6)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(6, policy.horizon, policy.act_layout.dim, generator=generator)
    wide = make(TASK, num_envs=6)
    runs = [
        rollout(
            LatentNoiseEnv(e, policy, ignore_terminations=True), lambda o, rows: noise[rows], seeds
        )
        for e in (env, wide)
    ]
    wide.close()
    # Of the last batch of four, two count.
    assert env.scene.px._paused.tolist() == [False, False, True, True]
    assert runs[0].episodes["seed"].tolist() == seeds
    assert torch.equal(runs[0].obs, runs[1].obs)
    for name, value in runs[0].episodes.items():
        assert torch.equal(value, runs[1].episodes[name]), name


def test_rollout_measures_success_once_and_at_the_end(env):
    """An expert that lets go after success: often success once, rarely success at the end."""
    latent = LatentNoiseEnv(env, NoiseIsAction(execute=1), ignore_terminations=True)
    expert: list[Expert] = []

    def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        if not expert:
            expert.append(Expert(env))
        if env.elapsed_steps[0] < 30:
            return expert_chunk(env, expert[0])
        away = torch.zeros(4, 1, 7)
        away[..., env.action_layout.slice("z")] = 1.0
        return away

    result = rollout(latent, act, [0, 1, 2, 3])
    episodes = result.episodes
    assert episodes["success_once"].tolist() == [False, True, True, True]
    assert not episodes["success_at_end"].any()
    assert episodes["episode_len"].tolist() == [env.max_episode_steps] * 4
    assert episodes["return"][0] == -env.max_episode_steps
    # Exactly one decision of each solved episode is terminal, and nothing after it is "running".
    assert result.terminal.sum(0).tolist() == [0, 1, 1, 1]
    assert torch.equal(-result.running.sum(0) + result.terminal.sum(0), episodes["return"].long())


def test_long_episodes_that_are_done_stand_still(env, monkeypatch):
    """Those that begin at random end earlier; the others are the same as if these went on."""

    def play():
        latent = LatentNoiseEnv(env, NoiseIsAction(execute=4), ignore_terminations=True)
        latent.max_episode_steps = long_limit(env.max_episode_steps, 4, gamma=0.1)
        noise = torch.Generator().manual_seed(0)

        def sample(obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return torch.randn(4, 4, 7, generator=noise), torch.zeros(4)

        def draw(count: int, generator: torch.Generator) -> torch.Tensor:
            return torch.randn(count, 4, 7, generator=generator)

        generator = torch.Generator().manual_seed(1)
        return long_episodes(latent, sample, draw, [0, 1, 2, 3], 0.1, generator)

    paused = []
    pause = LatentNoiseEnv.pause

    def recorded(self, rows):
        paused.append(rows)
        pause(self, rows)

    monkeypatch.setattr(LatentNoiseEnv, "pause", recorded)
    still = play()
    assert torch.stack(paused).any(0).tolist() == [False, True, False, True]
    monkeypatch.setattr(LatentNoiseEnv, "pause", lambda self, rows: None)
    moving = play()
    assert torch.equal(still.obs[:, [0, 2]], moving.obs[:, [0, 2]])
    assert not torch.equal(still.obs, moving.obs)
    for name in ("reward", "terminal", "last", "on_policy", "off_policy"):
        assert torch.equal(getattr(still, name), getattr(moving, name)), name
    # Nothing after the last decision of a column counts.
    for column in (1, 3):
        end = int(still.last[:, column].nonzero())
        assert torch.equal(still.obs[: end + 1, column], moving.obs[: end + 1, column])


def test_evaluation_refuses_an_environment_that_ends_at_success(env):
    with pytest.raises(UserError, match="ignore_terminations"):
        rollout(LatentNoiseEnv(env, untrained_policy()), lambda o, r: o, [0])


def test_steerability_of_an_untrained_policy_warns(env):
    policy = untrained_policy()
    latent = LatentNoiseEnv(env, policy, ignore_terminations=True)
    report = steerability(latent, policy, seed=0, states=2, draws=4)
    assert report["episodes"] == 8
    assert report["solvable"] < 0.9
    assert "initial states" in report["warning"]
