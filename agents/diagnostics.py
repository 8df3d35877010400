"""Diagnostics of a learner: errors of its critics, and errors of its symmetry.

All values are in the environment's reward units, per decision. ``q`` arrays hold all critics,
``[critics, B]``, as :meth:`symsteer.agents.sac.SacAgent.q_values` returns them.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from symsteer.agents.episodes import Played
from symsteer.errors import UserError
from symsteer.policies.geometry import Group, equivariance_error

if TYPE_CHECKING:
    from symsteer.agents.sac import SacAgent

Scalars = dict[str, float]

SYMMETRY_STATES = 64
"""States on which equivariance errors are measured."""


def critic_diagnostics(agent: SacAgent, played: Played) -> Scalars:
    """All diagnostics of a learner at one evaluation, by the names that the record uses.

    docs/metrics.md defines them.
    """
    assert played.on_policy is not None
    options, greedy = agent.options, played.greedy
    low, high = played.feasible
    obs, noise = greedy.obs[greedy.running], greedy.noise[greedy.running]
    statistics = policy_statistics(agent, obs)
    alpha = statistics["alpha"] / options.reward_scale
    allowance = 0.0
    if options.soft_backup:
        allowance = entropy_allowance(options.gamma, alpha, statistics["entropy"])
    q = agent.q_values(obs, noise)
    bounds = bound_violation(q, low - allowance, high + allowance)
    smallest = q.amin(0)
    bias = _bias_on_policy(agent, played, alpha)
    few = torch.randperm(len(obs), generator=torch.Generator().manual_seed(0))[:SYMMETRY_STATES]
    few = few.to(obs.device)
    obs, noise = obs[few], noise[few]
    group = Group.parse(options.group)
    orbit = orbit_variance(agent, obs, noise, group)
    size = agent.q_values(obs, noise).double().square().mean().sqrt().item()
    context = agent.context
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
        "q_preference": critic_preference(agent, obs, played.generator)["critic_preference"],
        "alpha": statistics["alpha"],
        "entropy": statistics["entropy"],
        "noise_norm": statistics["noise_norm"],
        "mode_norm": statistics["mode_norm"],
        "saturated": statistics["saturated_share"],
        "orbit_variance": orbit["orbit_variance"],
        "equivariance_actor": actor_equivariance_error(agent, obs, group),
        "equivariance_critic": orbit["orbit_variance"] ** 0.5 / max(size, 1e-30),
        "equivariance_decode": equivariance_error(
            context.decode,
            (obs, noise),
            (context.obs_layout, context.act_layout),
            context.act_layout,
            group,
        ),
    }


def actor_equivariance_error(agent: SacAgent, obs: torch.Tensor, group: Group) -> float:
    """Error of the deterministic actor: max over g of rms ||mu(gs) - g mu(s)|| / rms ||mu(s)||.

    Args:
        obs: ``[B, obs_dim]``.
    """
    return equivariance_error(
        lambda x: agent.act(x, deterministic=True),
        (obs,),
        (agent.obs_layout,),
        agent.act_layout,
        group,
    )


def entropy_allowance(gamma: float, alpha: float, log_prob_size: float) -> float:
    """How far soft Q may exceed the hard bounds: ``alpha * gamma / (1 - gamma) * |log pi|``.

    The first factor is gamma because Q(s, w) does not contain the entropy bonus of w itself.

    Args:
        gamma: discount per decision.
        alpha: entropy weight.
        log_prob_size: typical magnitude of log pi, e.g. its largest mean over evaluations.
    """
    return abs(alpha) * gamma / (1 - gamma) * abs(log_prob_size)


def _bias_on_policy(agent: SacAgent, played: Played, alpha: float) -> Scalars:
    """Bias of Q on the stochastic episodes, each up to its first success."""
    run, log_prob = played.on_policy, played.log_prob
    assert run is not None
    assert log_prob is not None
    # All episodes in one column, each with its decisions up to the first success.
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
        agent.options.gamma,
        played.feasible,
        column(log_prob)[:, None],
        alpha,
    )
    # The critics estimate the soft return only with the soft backup.
    kind = "soft_bias" if agent.options.soft_backup else "bias"
    return {
        "q_bias": result[f"{kind}_mean"],
        "q_bias_std": result[f"{kind}_std"],
        "q_bias_hard": result["bias_mean"],
        "q_bias_low": result["bias_low"],
        "q_bias_high": result["bias_high"],
        "q_bias_covered": result["covered_share"],
        "return_mean": result["return_mean"],
    }


def bound_violation(q: torch.Tensor, low: float, high: float) -> Scalars:
    """Q-values outside the interval of returns that the task allows.

    - ``violation_share`` = mean over critics and states of [Q < low or Q > high or Q not finite];
    - ``max_abs_q`` = max |Q|; ``q_min``, ``q_mean``, ``q_max``;
    - ``finite`` = 1 if every value is finite, else 0.

    Args:
        q: any shape.
    """
    finite = torch.isfinite(q)
    outside = ~finite | (q < low) | (q > high)
    return {
        "violation_share": outside.double().mean().item(),
        "max_abs_q": q.abs().max().item(),
        "q_min": q.min().item(),
        "q_mean": q.mean().item(),
        "q_max": q.max().item(),
        "finite": float(finite.all()),
    }


def q_bias(
    q: torch.Tensor,
    reward: torch.Tensor,
    terminal: torch.Tensor,
    truncated: torch.Tensor,
    gamma: float,
    tail: tuple[float, float],
    log_prob: torch.Tensor | None = None,
    alpha: float = 0.0,
    tail_tolerance: float = 0.05,
) -> Scalars:
    """Bias of Q against fresh on-policy returns (REDQ's measure, arXiv 2101.05982).

    With d = terminal, the returns are

        hard:  G(t) = r(t) + gamma (1 - d(t)) G(t+1)
        soft:  G(t) = r(t) + gamma (1 - d(t)) (G(t+1) - alpha log pi(t+1)).

    The critics bootstrap through time-outs. If an episode was cut k decisions after state t, its
    return lacks ``gamma^k`` times an unknown tail. The tail is handled in two ways:

    - A state is *covered* if ``gamma^k <= tail_tolerance`` (in terminated episodes the weight is
      0). Its tail is set to the middle of ``tail``. ``bias_mean``, ``bias_std`` = mean and standard
      deviation of Q - G over covered states. ``bias_normalized``, ``bias_std_normalized`` = both
      divided by |mean G|. ``covered_share`` = share of covered states. Successful episodes are
      over-represented in them, so read this share together with the bias.
    - Over *all* states, ``bias_low`` = mean(Q - G with the highest tail) and ``bias_high`` = mean(Q
      - G with the lowest tail). The mean hard bias lies between them for every possible tail.

    If ``log_prob`` is given, ``soft_bias_mean`` and ``soft_bias_std`` are the first two with the
    soft return. If no state is covered, the values are NaN.

    Args:
        q: mean or any one critic's value of the played noise, ``[T, N]``.
        reward, terminal, truncated, log_prob: per decision, ``[T, N]``; ``terminal`` by success,
            ``truncated`` by time-out. After the end of an episode, a column continues with the
            next episode. The last row cuts all episodes that have not ended.
        gamma, alpha: discount and entropy weight.
        tail: smallest and largest value that a state can have, the feasible returns.
        tail_tolerance: largest weight of the unknown tail in a covered state.

    Raises:
        UserError: if the shapes differ.
    """
    shapes = {tuple(x.shape) for x in (q, reward, terminal, truncated)}
    if len(shapes) != 1 or q.ndim != 2:
        raise UserError(f"Q bias needs arrays of one shape [decisions, environments], not {shapes}")
    q, reward = q.double(), reward.double()
    ends = terminal.bool()
    cut = truncated.bool() & ~ends
    cut[-1] |= ~ends[-1]
    bonus = torch.zeros_like(q) if log_prob is None else -alpha * log_prob.double()

    hard, soft, weight = (torch.empty_like(q) for _ in range(3))
    next_hard, next_soft, next_weight = (torch.zeros_like(q[0]) for _ in range(3))
    next_bonus = torch.zeros_like(q[0])
    for t in reversed(range(len(q))):
        goes_on = (~ends[t] & ~cut[t]).double()
        hard[t] = reward[t] + gamma * goes_on * next_hard
        soft[t] = reward[t] + gamma * goes_on * (next_soft + next_bonus)
        # Weight of the unknown value after the cut in G(t).
        weight[t] = gamma * torch.where(cut[t], 1.0, goes_on * next_weight)
        next_hard, next_soft, next_weight, next_bonus = hard[t], soft[t], weight[t], bonus[t]

    low, high = tail
    covered = weight <= tail_tolerance
    middle = weight * (low + high) / 2

    def spread(gap: torch.Tensor) -> tuple[float, float]:
        if not covered.any():
            return math.nan, math.nan
        return gap[covered].mean().item(), gap[covered].std(unbiased=False).item()

    mean, std = spread(q - hard - middle)
    scale = abs((hard + middle)[covered].mean().item()) if covered.any() else math.nan
    scale = scale if scale > 0 else math.nan
    scalars = {
        "bias_mean": mean,
        "bias_std": std,
        "bias_normalized": mean / scale,
        "bias_std_normalized": std / scale,
        "covered_share": covered.double().mean().item(),
        "bias_low": (q - hard - weight * high).mean().item(),
        "bias_high": (q - hard - weight * low).mean().item(),
        "return_mean": hard.mean().item(),
    }
    if log_prob is not None:
        scalars["soft_bias_mean"], scalars["soft_bias_std"] = spread(q - soft - middle)
    return scalars


def critic_preference(agent: SacAgent, obs: torch.Tensor, generator: torch.Generator) -> Scalars:
    """By how much the critics prefer the actor to the base policy.

    ``critic_preference`` = mean over states and critics of Q(s, deterministic actor) - Q(s, w),
    w ~ N(0, I). Compare it with the true difference in return. If there is no true difference, the
    actor exploits errors of the critics.

    Args:
        obs: ``[B, obs_dim]``.
        generator: draws the random noise, on the agent's device.
    """
    own = agent.act(obs, deterministic=True)
    random = torch.randn(own.shape, generator=generator, device=own.device, dtype=own.dtype)
    gap = agent.q_values(obs, own) - agent.q_values(obs, random)
    return {"critic_preference": gap.mean().item()}


def policy_statistics(agent: SacAgent, obs: torch.Tensor) -> Scalars:
    """Temperature, entropy and noise norms of the stochastic policy.

    - ``alpha`` = exp(log alpha); ``entropy`` = mean of -log pi(w|s) over one draw per state;
    - ``noise_norm`` = mean ||w||; ``mode_norm`` = mean ||deterministic w||;
    - ``saturated_share`` = share of irrep blocks of drawn w with norm > 0.95 bound.
    """
    noise, log_prob = agent.sample(obs)
    mode = agent.act(obs, deterministic=True)
    return {
        "alpha": agent.alpha.item(),
        "entropy": -log_prob.mean().item(),
        "noise_norm": noise.flatten(1).norm(dim=1).mean().item(),
        "mode_norm": mode.flatten(1).norm(dim=1).mean().item(),
        "saturated_share": agent.distribution.saturated(noise.flatten(1)).double().mean().item(),
    }


@torch.no_grad()
def orbit_variance(
    agent: SacAgent, obs: torch.Tensor, noise: torch.Tensor, group: Group
) -> Scalars:
    """Variance of Q over group orbits: 0 for invariant critics.

    - ``orbit_variance`` = mean over states and critics of Var_g Q(gs, gw), g over the group;
    - ``orbit_share`` = ``orbit_variance`` / variance of Q over the batch with all its group images.

    Args:
        obs, noise: ``[B, obs_dim]``, ``[B, Tp, Da]``.
    """
    q = torch.stack(
        [
            agent.q_values(
                agent.obs_layout.transform(obs, angle, reflect),
                agent.act_layout.transform(noise, angle, reflect),
            )
            for angle, reflect in group.elements
        ]
    ).double()
    within = q.var(dim=0, unbiased=False).mean().item()
    total = q.transpose(0, 1).flatten(1).var(dim=1, unbiased=False).mean().item()
    return {"orbit_variance": within, "orbit_share": within / total if total > 0 else 0.0}
