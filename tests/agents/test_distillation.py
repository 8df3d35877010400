"""Noise critics learn what the action critics say of the actions that noise is decoded to."""

import copy

import pytest
import torch

from symsteer.agents import AGENTS

SOURCES = ["gaussian", "squashed", "actor", "mixture"]


def filled(problem, name="standard", **options):
    agent = problem.agent(name, lr=3e-3, gamma=0.0, **options)
    # The critics stay as they are; large enough for differences between actions.
    agent.optimizers["critic"].lr = 0.0
    agent.observe(problem.transition(256))  # reward scale 1: values in units of rewards
    return agent


def gap(agent, obs, noise):
    """Spread of Q(s, decode(s, w)) - Q_W(s, w), over that of Q(s, decode(s, w))."""
    wanted = agent.q_values(obs, noise)
    apart = agent.noise_q_values(obs, noise) - wanted
    return (apart.square().mean() / wanted.var()).sqrt().item()


def where_it_distils(agent):
    """Observations and noise of each kind that the option names."""
    kept, source = agent.replay.storage, agent.options.distill
    points = {}
    if source != "actor":
        obs = kept["obs"][:256]
        noise = agent.bank_noise(256, agent.generator)
        if agent.options.noise_bank:
            noise = kept["bank_noise"][:256, 0]
        points["random"] = (obs, noise)
    if source in ("actor", "mixture"):
        obs = kept["next_obs"][:256]
        points["actor"] = (obs, agent.sample(obs)[0])
    return points


@pytest.mark.parametrize(("source", "bank"), [*((source, 4) for source in SOURCES), ("mixture", 0)])
def test_noise_critics_approach_the_action_critics(problem, source, bank):
    agent = filled(problem, distill=source, noise_bank=bank)
    before = {key: gap(agent, *point) for key, point in where_it_distils(agent).items()}
    for _ in range(300):
        assert "losses/distillation" in agent.update(agent.replay.sample(64))
    after = {key: gap(agent, *point) for key, point in where_it_distils(agent).items()}
    for key, value in after.items():
        assert value < min(0.6, 0.5 * before[key]), (before, after)


def test_without_distillation_they_stay_apart(problem):
    agent = filled(problem, distill_steps=1e-9)
    before = gap(agent, *where_it_distils(agent)["random"])
    for _ in range(300):
        assert "losses/distillation" not in agent.update(agent.replay.sample(64))
    assert gap(agent, *where_it_distils(agent)["random"]) == before > 1


@pytest.mark.parametrize("source", SOURCES)
def test_the_loss_is_the_hand_computed_one(problem, source):
    """Head by head, at the noise that the option names and nowhere else."""
    agent = filled(problem, distill=source, dtype=torch.float64)
    batch = agent.replay.sample(32)
    generator = copy.deepcopy(agent.generator)
    with torch.no_grad():
        mean, log_scale = agent.moments(batch.next_obs)
        eps = torch.randn(mean.shape, generator=generator, dtype=mean.dtype)
        drawn = agent.chunk(agent.distribution.sample(mean, log_scale, eps)[0])
        points = [(batch.next_obs, drawn)]
        if source != "actor":
            rows = torch.arange(32)
            picked = torch.randint(4, (32,), generator=generator)
            points.append((batch.obs, batch.bank_noise[rows, picked]))
        if source in ("gaussian", "squashed"):
            del points[0]
        obs, noise = (torch.cat(parts) for parts in zip(*points, strict=True))
        gap = agent.noise_q_values(obs, noise) - agent.q_values(obs, noise)
        expected = gap.square().mean(1).sum()
    scalars = agent.update(batch)
    assert scalars["losses/distillation"].item() == pytest.approx(expected.item(), rel=1e-12)


@pytest.mark.parametrize(("steps", "made"), [(2.0, [2, 4, 6, 8]), (0.5, [0, 1, 1, 2])])
def test_distillation_steps_per_update(problem, steps, made):
    agent, counted = filled(problem, distill_steps=steps), []
    for _ in range(4):
        agent.update(agent.replay.sample(32))
        counted.append(int(agent.optimizers["noise_critic"].steps))
    assert counted == made


def test_the_bank_is_decoded_when_a_decision_is_stored(problem):
    decoded = []

    def decode(obs, noise):
        decoded.append(len(obs))
        return noise.tanh() + obs[:, None, :1]

    context = problem.context(decode=decode)
    kind = AGENTS.get("standard")
    agent = kind(context, kind.Options(**{**problem.options, "noise_bank": 4, "noise_bound": 0.7}))
    step = problem.transition(8)
    agent.observe(step)
    assert decoded == [32]
    kept = {name: rows[:8] for name, rows in agent.replay.storage.items()}
    for k in range(4):
        noise = kept["bank_noise"][:, k]
        expected = noise.tanh() + step.obs[:, None, :1]
        torch.testing.assert_close(kept["bank_actions"][:, k], expected[:, : context.execute])
    for block in problem.act_layout.blocks:
        assert kept["bank_noise"][..., block].norm(dim=-1).max() <= 0.7 * (1 + 1e-6)
    assert len(kept["bank_noise"].flatten(0, 1).unique(dim=0)) == 32
    # In an update, only the actor's noise at the next states is decoded.
    decoded.clear()
    agent.update(agent.replay.sample(32))
    assert decoded == [32]
