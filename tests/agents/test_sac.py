"""The learner: targets by hand, temperature, determinism, saving, and real learning."""

import copy
import dataclasses
import io

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import Budget
from symsteer.agents.networks import count
from symsteer.agents.sac import SacAgent
from symsteer.agents.standard import StandardAgent
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout

LEARNERS = ["standard", "standard-matched", "augmented", "equivariant", "residual-pathway"]
CRITICS = ["noise", "aliased", "sampler"]


def tensors(part):
    """Parameters of a network, or the matrices of the target critics."""
    if isinstance(part, torch.nn.Module):
        return [p.detach() for p in part.parameters()]
    return [tensor.detach() for layer in part for tensor in layer]


@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize("name", LEARNERS)
def test_update_moves_every_parameter_and_stays_finite(problem, name, critic):
    agent = problem.agent(name, critic_kind=critic)
    trained = {**agent.networks, "target": agent.target}
    before = {key: [p.clone() for p in tensors(part)] for key, part in trained.items()}
    for seed in range(3):
        scalars = agent.update(problem.batch(seed=seed))
        assert all(torch.isfinite(value) for value in scalars.values()), scalars
    for key, old in before.items():
        moved = [not torch.equal(a, b) for a, b in zip(old, tensors(trained[key]), strict=True)]
        assert all(moved), (key, moved)
    assert agent.updates == 3


@pytest.mark.parametrize("critic", CRITICS)
@pytest.mark.parametrize("soft", [False, True])
@pytest.mark.parametrize("terminal", [0.0, 1.0])
def test_critic_target_is_the_hand_computed_one(problem, terminal, soft, critic):
    agent = problem.agent(
        "standard", dtype=torch.float64, soft_backup=soft, initial_alpha=0.3, critic_kind=critic
    )
    batch = problem.batch(dtype=torch.float64, terminal=terminal)
    for seed in range(3):  # so that target and online critics differ
        agent.update(problem.batch(seed=10 + seed, dtype=torch.float64))
    with torch.no_grad():
        mean, log_scale = agent.moments(batch.next_obs)
        generator = copy.deepcopy(agent.generator)
        eps = torch.randn(mean.shape, generator=generator, dtype=torch.float64)
        noise, log_prob = agent.distribution.sample(mean, log_scale, eps)
        stored, judged = batch.noise, noise
        if critic != "noise":
            chunk = noise.unflatten(1, (problem.horizon, -1))
            judged = agent.context.decode(batch.next_obs, chunk)[:, :2].flatten(1)
            stored = batch.actions
        target_q = agent.critic.apply_weights(agent.target, torch.cat([batch.next_obs, judged], 1))
        value = torch.minimum(target_q[0], target_q[1])[..., 0]
        if soft:
            value = value - agent.alpha * log_prob
        wanted = batch.reward if terminal else batch.reward + 0.95 * value
        q = agent.critic(torch.cat([batch.obs, stored.flatten(1)], 1))[..., 0]
        expected = (q[0] - wanted).square().mean() + (q[1] - wanted).square().mean()
    scalars = agent.update(batch)
    assert scalars["losses/critic"].item() == pytest.approx(expected.item(), rel=1e-12)
    assert scalars["train/target_mean"].item() == pytest.approx(wanted.mean().item(), rel=1e-12)


@pytest.mark.parametrize(("reduce", "row"), [("min", 0), ("mean", 2)])
def test_several_critics_become_one_value(problem, reduce, row):
    q = torch.arange(10.0).view(5, 2)
    agent = problem.agent("standard", critics=5, reduce=reduce)
    assert torch.equal(agent.reduced(q.flip(0)), q[row])


def test_success_ends_and_time_outs_bootstrap_or_end(problem):
    def target(terminal, truncated=0.0, **options):
        batch = problem.batch(terminal=terminal)
        batch["truncated"] = torch.full_like(batch.reward, truncated)
        return problem.agent("standard", **options).update(batch)["train/target_mean"].item()

    rewards = pytest.approx(problem.batch().reward.mean().item(), abs=1e-6)
    assert target(1.0) == target(0.0, 1.0, timeouts_terminal=True) == rewards
    assert target(0.0) == target(0.0, 1.0) != rewards


def test_target_critics_follow_by_tau(problem):
    agent = problem.agent("equivariant", tau=0.25)
    old = [t.clone() for t in tensors(agent.target)]
    agent.update(problem.batch())
    for before, target, online in zip(
        old, tensors(agent.target), tensors(agent.critic.weights()), strict=True
    ):
        assert torch.allclose(target, 0.75 * before + 0.25 * online, atol=1e-6)


@pytest.mark.parametrize("critic", CRITICS)
def test_actor_step_leaves_the_critics_alone_and_climbs_q(problem, critic):
    agent = problem.agent("standard", initial_alpha=1e-6, critic_kind=critic)
    obs = problem.batch(256).obs

    def value():
        return agent.q_values(obs, agent.act(obs, deterministic=True)).amin(0).mean().item()

    agent.optimizers["critic"].lr = 0.0
    frozen = [p.clone() for p in agent.critic.parameters()]
    before = value()
    for seed in range(60):
        agent.update(problem.batch(seed=seed))
    assert all(torch.equal(a, b) for a, b in zip(frozen, agent.critic.parameters(), strict=True))
    assert value() > before + 1e-3


@pytest.mark.parametrize("critic", CRITICS)
def test_actor_loss_is_the_hand_computed_one(problem, critic):
    agent = problem.agent("equivariant", dtype=torch.float64, initial_alpha=0.3, critic_kind=critic)
    for seed in range(3):  # so that target and online critics differ
        agent.update(problem.batch(seed=10 + seed, dtype=torch.float64))
    for name in ("critic", "noise_critic"):
        if name in agent.optimizers:
            agent.optimizers[name].lr = 0.0
    batch = problem.batch(dtype=torch.float64)
    generator = copy.deepcopy(agent.generator)
    with torch.no_grad():
        mean, log_scale = agent.moments(batch.obs)
        torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        if critic == "aliased":  # the pair of noise and actions to distil from
            torch.randint(4, (len(mean),), generator=generator)
        eps = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        noise, log_prob = agent.distribution.sample(mean, log_scale, eps)
        q = agent.noise_q_values(batch.obs, noise.unflatten(1, (problem.horizon, -1)))
        expected = (agent.alpha * log_prob - torch.minimum(q[0], q[1])).mean()
    scalars = agent.update(batch)
    assert scalars["losses/actor"].item() == pytest.approx(expected.item(), rel=1e-12)
    assert scalars["train/entropy"].item() == pytest.approx(-log_prob.mean().item(), rel=1e-12)


@pytest.mark.parametrize("wanted", [100.0, -100.0])
def test_alpha_moves_towards_the_target_entropy(problem, wanted):
    """The target is per number of the noise."""
    agent = problem.agent("equivariant", target_entropy=wanted)
    assert agent.target_entropy == wanted * problem.horizon * problem.act_layout.dim
    before = agent.alpha
    entropy = agent.update(problem.batch())["train/entropy"].item()
    assert ((agent.alpha > before) == (entropy < agent.target_entropy)).all()


def test_reward_scale_leaves_reported_values_in_reward_units(problem):
    batch = problem.batch(terminal=1.0)
    plain = problem.agent("standard").update(batch)
    scaled = problem.agent("standard", reward_scale=10.0).update(batch)
    assert scaled["train/target_mean"].item() == pytest.approx(
        plain["train/target_mean"].item(), rel=1e-5
    )


def parameters(agent):
    parts = (*agent.networks.values(), agent.target)
    return [*(t for part in parts for t in tensors(part)), agent.alpha]


def same(a, b):
    return all(torch.equal(x, y) for x, y in zip(parameters(a), parameters(b), strict=True))


@pytest.mark.parametrize("name", LEARNERS)
def test_same_seed_same_agent(problem, name):
    def run(seed):
        torch.randn(seed + 3)  # the global generator must not matter
        agent, replay = problem.agent(name, seed=seed), problem.replay()
        for _ in range(5):
            agent.update(replay.sample(32))
        return agent, agent.act(problem.batch().obs)

    (first, noise), (second, again), (other, _) = run(0), run(0), run(1)
    assert same(first, second)
    assert torch.equal(noise, again)
    assert not same(first, other)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        *((name, {}) for name in AGENTS.builtin if issubclass(AGENTS.get(name), SacAgent)),
        *(("equivariant", {"critic_kind": critic}) for critic in ("noise", "sampler")),
        ("standard", {"distill_steps": 0.5, "noise_bank": 0, "distill": "actor"}),
    ],
    ids=str,
)
def test_a_saved_agent_continues_bit_equal(problem, name, options):
    """With a part of an update and a distillation step owed."""
    options = {"noise_bank": 4, **options, "warmup": 16, "utd": 0.245, "batch_size": 16}

    def play(agent, steps):
        scalars = {}
        for step in steps:
            transition = problem.transition(16, seed=step)
            transition.noise = agent.act(transition.obs)
            agent.observe(transition)
            for batch in agent.batches():
                scalars = agent.update(batch)
        return scalars, agent.act(problem.batch().obs)

    agent = problem.agent(name, **options)
    play(agent, range(3))
    assert agent.updates == 7  # half a step of distillation is owed, if they are half steps
    assert agent.owed > 0
    file = io.BytesIO()
    torch.save({"agent": agent.state_dict(), "replay": agent.replay.state_dict()}, file)
    scalars, noise = play(agent, range(3, 6))

    file.seek(0)
    saved = torch.load(file, weights_only=True)
    again = problem.agent(name, seed=77, **options)
    again.act(problem.batch().obs)  # expanded weights must not survive the loading
    again.load_state_dict(saved["agent"])
    again.replay.load_state_dict(saved["replay"])
    scalars_again, noise_again = play(again, range(3, 6))
    assert same(agent, again)
    assert torch.equal(noise, noise_again)
    assert scalars == scalars_again
    assert again.updates == agent.updates == 19
    for field, kept in agent.replay.storage.items():
        assert torch.equal(kept, again.replay.storage[field])


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"name": "standard"}, "agent"),
        ({"width": 64}, "width"),
        ({"group": "C4"}, "group"),
        ({"critic_kind": "noise"}, "critic"),
        ({"noise_bound": 2.0}, "noise_bound"),
        ({"problem": {"horizon": 4}}, "horizon"),
        ({"problem": {"obs_layout": Layout([Field("xy", 1)])}}, "obs_layout"),
    ],
)
def test_a_checkpoint_of_another_agent_is_refused(problem, change, word):
    state = problem.agent("equivariant").state_dict()
    change = dict(change)
    other = dataclasses.replace(problem, **change.pop("problem", {}))
    agent = other.agent(change.pop("name", "equivariant"), **change)
    with pytest.raises(UserError, match=word):
        agent.load_state_dict(state)


def test_ensemble_is_its_members_one_by_one(problem):
    agent = problem.agent("equivariant", dtype=torch.float64)
    x = torch.randn(5, agent.action_inputs.dim, dtype=torch.float64)
    for member, value in zip(agent.critic.members, agent.critic(x), strict=True):
        lift, hidden, pool = member
        out = lift(x)
        out = torch.nn.functional.layer_norm(out, out.shape[-2:]).relu()
        out = hidden(out)
        out = torch.nn.functional.layer_norm(out, out.shape[-2:]).relu()
        assert torch.allclose(pool(out), value, atol=1e-12)


@pytest.mark.parametrize("group", ["C8", "C4", "D4"])
@pytest.mark.parametrize("width", [128, 256])
def test_matched_agent_has_the_equivariant_ones_size(problem, group, width):
    equivariant = problem.agent("equivariant", group=group, width=width).parameter_counts()
    matched = problem.agent("standard-matched", group=group, width=width).parameter_counts()
    plain = problem.agent("standard", group=group, width=width).parameter_counts()
    for key in ("actor", "critic", "total"):
        assert matched[key] == pytest.approx(equivariant[key], rel=0.02)
    networks = problem.agent("equivariant", group=group, width=width).networks
    assert equivariant["actor"] == count(networks["actor"])
    assert equivariant["critic"] == count(networks["critic"]) + count(networks["noise_critic"])
    assert equivariant["total"] == equivariant["actor"] + equivariant["critic"]
    assert plain["total"] > 2 * equivariant["total"]
    assert matched["width"] < plain["width"] == width


def test_untrained_policies_start_near_zero_with_the_given_scale(problem):
    for name in LEARNERS:
        mean, log_scale = problem.agent(name).moments(problem.batch().obs)
        assert mean.abs().max() < 0.1
        assert torch.allclose(log_scale.exp(), torch.tensor(0.5), atol=0.05)


def test_the_hooks_of_an_agent_are_used(problem):
    """Each one changes what it should in one update."""

    class Own(StandardAgent):
        name = "own"

        def critic_target(self, batch, following):
            return torch.full_like(batch.reward, 3.0)

        def penalty(self, name, batch):
            if name == "actor":
                return 1e3 * sum(p.square().sum() for p in self.actor.parameters())
            return None

        def after_update(self, batch):
            return {"train/seen": torch.tensor(float(len(batch.reward)))}

    agent = Own(problem.context(), StandardAgent.Options(**problem.options))
    size = sum(p.square().sum() for p in agent.actor.parameters()).item()
    scalars = agent.update(problem.batch())
    assert scalars["train/target_mean"].item() == 3.0
    assert scalars["train/seen"].item() == 32
    assert sum(p.square().sum() for p in agent.actor.parameters()).item() < size


@pytest.mark.parametrize("num_envs", [1, 3, 48])
def test_updates_are_paid_for_behind_the_warm_up_for_any_number_of_environments(problem, num_envs):
    agent = problem.agent("standard", warmup=48, utd=0.25)
    updates = 0
    for step in range(144 // num_envs):
        agent.observe(problem.transition(num_envs, seed=step))
        updates += len(list(agent.batches()))
    assert updates == (144 - 48) // 4


def test_the_warm_up_plays_the_base_policy(problem):
    agent = problem.agent("standard", warmup=1)
    noise = agent.act(problem.batch(2000).obs)
    assert noise.shape == (2000, problem.horizon, problem.act_layout.dim)
    assert noise.mean().abs() < 0.02
    assert noise.std().item() == pytest.approx(1, abs=0.02)
    agent.observe(problem.transition(1))
    assert agent.act(problem.batch(2000).obs).abs().max() <= 1.5


def test_a_budget_within_the_warm_up_is_refused(problem):
    options = problem.agent("standard", warmup=40).options
    with pytest.raises(UserError, match="nothing would be learned"):
        SacAgent.check(options, Budget(160, 4, 4, 50))
    SacAgent.check(options, Budget(161, 4, 4, 50))
