"""What an evaluation measures beside success: Q against its bounds and fresh returns, symmetry.

The names are those of the run record; docs/metrics.md defines each. Formulas and code of the
single figures are in :mod:`symsteer.agents.diagnostics`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.agents.diagnostics import (
    bound_violation,
    critic_preference,
    equivariance_error,
    orbit_variance,
    policy_statistics,
    q_bias,
)
from symsteer.agents.sac import SacAgent, entropy_allowance
from symsteer.bench.steering.evaluation import Rollout
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Group

SYMMETRY_STATES = 64
"""States on which equivariance errors are measured."""


@dataclass(frozen=True)
class OnPolicy:
    """Stochastic episodes of the present agent, with the log-probabilities of what it played.

    Attributes:
        rollout: the episodes.
        log_prob: of the played noise, ``[T, N]``.
    """

    rollout: Rollout
    log_prob: torch.Tensor


def measure(
    agent: SacAgent,
    policy: ChunkPolicy,
    greedy: Rollout,
    on_policy: OnPolicy,
    feasible: tuple[float, float],
    generator: torch.Generator,
) -> dict[str, float]:
    """All diagnostics of one evaluation.

    Args:
        agent: a learner.
        policy: the frozen base.
        greedy: episodes of the deterministic actor.
        on_policy: episodes of the stochastic actor.
        feasible: lowest and highest possible return, in the environment's reward units.
        generator: for random noise that the critic compares with; on the agent's device.
    """
    config = agent.config
    low, high = feasible
    obs, noise = greedy.obs[greedy.running], greedy.noise[greedy.running]
    statistics = policy_statistics(agent, obs)
    alpha = statistics["alpha"] / config.reward_scale
    allowance = 0.0
    if config.soft_backup:
        allowance = entropy_allowance(config.gamma, alpha, statistics["entropy"])
    q = agent.q_values(obs, noise)
    bounds = bound_violation(q, low - allowance, high + allowance)
    smallest = q.amin(0)
    bias = _bias(agent, on_policy, alpha, feasible)
    few = torch.randperm(len(obs), generator=torch.Generator().manual_seed(0))[:SYMMETRY_STATES]
    few = few.to(obs.device)
    obs, noise = obs[few], noise[few]
    group = Group.parse(config.group)
    orbit = orbit_variance(agent, obs, noise, group)
    size = agent.q_values(obs, noise).double().square().mean().sqrt().item()
    return {
        "q_mean": smallest.mean().item(),
        "q_min": smallest.min().item(),
        "q_max": smallest.max().item(),
        "q_abs_max": bounds["max_abs_q"],
        "q_violation": bounds["violation_share"],
        "q_low": low,
        "q_high": high,
        "q_allowance": allowance,
        **bias,
        "q_preference": critic_preference(agent, obs, generator)["critic_preference"],
        "alpha": statistics["alpha"],
        "entropy": statistics["entropy"],
        "noise_norm": statistics["noise_norm"],
        "mode_norm": statistics["mode_norm"],
        "saturated": statistics["saturated_share"],
        "orbit_variance": orbit["orbit_variance"],
        "equivariance_actor": equivariance_error(agent, obs, group)["actor_equivariance_error"],
        "equivariance_critic": orbit["orbit_variance"] ** 0.5 / max(size, 1e-30),
        "equivariance_decode": decode_error(policy, obs, noise, group),
    }


def decode_error(
    policy: ChunkPolicy, obs: torch.Tensor, noise: torch.Tensor, group: Group
) -> float:
    """max over g of rms ||decode(gs, gw) - g decode(s, w)|| / rms ||decode(s, w)||.

    Args:
        obs, noise: ``[B, obs_dim]``, ``[B, Tp, Da]``.
    """
    actions = policy.decode(obs, noise).double()
    worst = 0.0
    for angle, reflect in group.elements:
        moved = policy.decode(
            policy.obs_layout.transform(obs, angle, reflect),
            policy.act_layout.transform(noise, angle, reflect),
        )
        gap = moved.double() - policy.act_layout.transform(actions, angle, reflect)
        worst = max(worst, (gap.square().mean() / actions.square().mean()).sqrt().item())
    return worst


def _bias(
    agent: SacAgent, on_policy: OnPolicy, alpha: float, feasible: tuple[float, float]
) -> dict[str, float]:
    run = on_policy.rollout
    # One column: the decisions of each episode up to its first success, episode after episode.
    rows = run.running.T
    truncated = torch.zeros_like(run.running)
    truncated[-1] = run.running[-1] & ~run.terminal[-1]

    def column(x: torch.Tensor) -> torch.Tensor:
        return x.transpose(0, 1)[rows]

    values = agent.q_values(column(run.obs), column(run.noise)).mean(0)
    result = q_bias(
        values[:, None],
        column(run.reward)[:, None],
        column(run.terminal)[:, None],
        column(truncated)[:, None],
        agent.config.gamma,
        feasible,
        column(on_policy.log_prob)[:, None],
        alpha,
    )
    # The return that the critics are trained towards: soft only with the soft backup.
    kind = "soft_bias" if agent.config.soft_backup else "bias"
    return {
        "q_bias": result[f"{kind}_mean"],
        "q_bias_std": result[f"{kind}_std"],
        "q_bias_hard": result["bias_mean"],
        "q_bias_low": result["bias_low"],
        "q_bias_high": result["bias_high"],
        "q_bias_covered": result["covered_share"],
        "return_mean": result["return_mean"],
    }
