"""Diagnostics of a learner: errors of its critics, and errors of its symmetry.

All values are in the environment's reward units, per decision; docs/metrics.md defines each of
them. ``q`` arrays hold all critics, ``[critics, B]``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import scipy.stats
import torch

from symsteer.agents.episodes import LongEpisodes, Played
from symsteer.policies.geometry import Group, equivariance_error

if TYPE_CHECKING:
    from symsteer.agents.sac import SacAgent

Scalars = dict[str, float]
Measures = dict[str, float | None]
"""None: not measured."""

SYMMETRY_STATES = 64
"""States on which equivariance errors are measured."""

MIN_PAIRS = 8
"""Decisions that a correlation of Q with the return needs."""

SAME = 1e-6
"""Values that differ by less, relative to their size, differ by rounding only."""


def critic_diagnostics(agent: SacAgent, played: Played) -> Measures:
    """All diagnostics of a learner at one evaluation, by the names that the record uses."""
    assert played.long is not None
    options, greedy = agent.options, played.greedy
    low, high = played.feasible
    obs, noise = greedy.obs[greedy.running], greedy.noise[greedy.running]
    statistics = policy_statistics(agent, obs)
    alpha, allowance = statistics["alpha"] / options.reward_scale, 0.0
    if options.soft_backup:
        # Soft Q may exceed the hard bounds by the discounted entropy bonus of later decisions.
        allowance = abs(alpha) * options.gamma / (1 - options.gamma) * abs(statistics["entropy"])
    q = agent.q_values(obs, noise)
    smallest = q.amin(0)
    # The critics estimate the soft return only with the soft backup.
    errors = value_errors(agent, played.long, alpha * options.soft_backup)
    few = torch.randperm(len(obs), generator=torch.Generator().manual_seed(0))[:SYMMETRY_STATES]
    few = few.to(obs.device)
    obs, noise = obs[few], noise[few]
    group, layouts = Group.parse(options.group), (agent.obs_layout, agent.act_layout)
    variance = orbit_variance(agent, obs, noise, group)
    q_here, gap = agent.q_values(obs, noise), None
    if options.critic_kind == "aliased":
        gap = (agent.noise_q_values(obs, noise) - q_here).abs().mean().item()
    # What the critics gain by the actor; if the returns do not, it exploits errors of theirs.
    steered, random = agent.act(obs, True), agent.gaussian_noise(len(obs), played.generator)
    preference = (agent.q_values(obs, steered) - agent.q_values(obs, random)).mean().item()
    return {
        "q_mean": smallest.mean().item(),
        "q_min": smallest.min().item(),
        "q_max": smallest.max().item(),
        **bound_violation(q, low - allowance, high + allowance),
        "q_low": low,
        "q_high": high,
        "q_allowance": allowance,
        **errors,
        "alias_gap": gap,
        "q_preference": preference,
        **statistics,
        "orbit_variance": variance,
        "equivariance_actor": actor_equivariance_error(agent, obs, group),
        "equivariance_critic": (
            variance**0.5 / max(q_here.double().square().mean().sqrt().item(), 1e-30)
        ),
        "equivariance_decode": equivariance_error(
            agent.decode, (obs, noise), layouts, agent.act_layout, group
        ),
    }


def actor_equivariance_error(agent: SacAgent, obs: torch.Tensor, group: Group) -> float:
    """Error of the actor's mean: max over g of rms ||mu(gs) - g mu(s)|| / rms ||mu(s)||.

    Args:
        obs: ``[B, obs_dim]``.
    """
    return equivariance_error(agent.mode, (obs,), (agent.obs_layout,), agent.act_layout, group)


def orbit_variance(agent: SacAgent, obs: torch.Tensor, noise: torch.Tensor, group: Group) -> float:
    """Mean over states and critics of Var_g Q(gs, gw), g over the group: 0 for invariant critics.

    Args:
        obs, noise: ``[B, obs_dim]``, ``[B, rows, Da]``.
    """
    q = [
        agent.q_values(agent.obs_layout.transform(obs, *g), agent.act_layout.transform(noise, *g))
        for g in group.elements
    ]
    return torch.stack(q).double().var(dim=0, unbiased=False).mean().item()


def policy_statistics(agent: SacAgent, obs: torch.Tensor) -> Scalars:
    """Temperature, entropy and noise norms of the stochastic policy, over one draw per state.

    ``mode_norm`` is that of the deterministic noise; ``saturated`` is the share of irrep blocks of
    drawn noise with a norm above 0.95 of the bound.
    """
    action, log_prob = agent.sample(obs)
    mode, noise = (x[:, -agent.drawn_rows :].flatten(1) for x in (agent.mode(obs), action))
    return {
        "alpha": agent.alpha.item(),
        "entropy": -log_prob.mean().item(),
        "noise_norm": noise.norm(dim=1).mean().item(),
        "mode_norm": mode.norm(dim=1).mean().item(),
        "saturated": agent.distribution.saturated(noise).double().mean().item(),
    }


def bound_violation(q: torch.Tensor, low: float, high: float) -> Scalars:
    """Q-values outside the interval of returns that the task allows.

    - ``q_abs_max`` = max |Q|;
    - ``q_magnitude`` = max |Q| / max(|low|, |high|): above 1 is soft divergence (van Hasselt et
      al., arXiv 1812.02648);
    - ``q_overshoot`` = max over Q of (Q - high, low - Q, 0) / (high - low);
    - ``q_violation`` = mean over critics and states of [Q < low or Q > high or Q not finite].

    Args:
        q: any shape.
        low, high: the interval, low < high.
    """
    outside = ~torch.isfinite(q) | (q < low) | (q > high)
    largest = q.abs().max().item()
    overshoot = torch.maximum(q - high, low - q).clamp(min=0).max().item()
    return {
        "q_abs_max": largest,
        "q_magnitude": largest / max(abs(low), abs(high)),
        "q_overshoot": overshoot / (high - low),
        "q_violation": outside.double().mean().item(),
    }


@torch.no_grad()
def value_errors(agent: SacAgent, played: LongEpisodes, alpha: float = 0.0) -> Measures:
    """Errors of Q over all decisions that count, successful or not: on-policy and off-policy.

    Q compares with :func:`discounted_returns`, the return that the critics are trained towards.
    :func:`agreement` gives the measures, with names that begin with ``q_``, off-policy ``q_off_``.

    ``td_error`` = root mean square over the on-policy decisions of

        r + gamma (1 - d) (R Q(s', w') - alpha log pi(w'|s')) - mean_j Q_j(s, w),

    w' being the noise of the next decision, and R the reduction of the targets.

    Args:
        agent: has ``q_values``, and of the options ``gamma`` and ``reduce``.
        alpha: entropy weight in reward units; 0 with a hard backup.
    """
    gamma = agent.options.gamma
    ends = played.terminal | played.last if played.timeouts_end else played.terminal
    bonus = -alpha * played.log_prob.double()
    returns = discounted_returns(played.reward, ends, played.last, gamma, bonus)
    # What follows the last decision of a column is not known.
    counts = played.on_policy & (ends | ~played.last)
    follows = torch.zeros_like(ends)
    follows[1:] = (counts & ~ends)[:-1]
    needed = played.on_policy | played.off_policy | follows
    values = agent.q_values(played.obs[needed], played.noise[needed]).double()
    mean, reduced = (torch.zeros_like(returns) for _ in range(2))
    mean[needed] = values.mean(0)
    reduced[needed] = values.mean(0) if agent.options.reduce == "mean" else values.amin(0)
    after = (reduced + bonus).roll(-1, 0).where(~ends, 0)
    gap = (played.reward + gamma * after - mean)[counts]
    result: Measures = {"td_error": gap.square().mean().sqrt().item() if len(gap) else None}
    for kind, chosen in (("", played.on_policy), ("off_", played.off_policy)):
        measured = agreement(mean[chosen], returns[chosen])
        result |= {f"q_{kind}{name}": value for name, value in measured.items()}
        mean_return, spread = _mean_and_std(returns[chosen])
        result |= {f"return_{kind}mean": mean_return, f"return_{kind}std": spread}
    return result


def discounted_returns(
    reward: torch.Tensor,
    ends: torch.Tensor,
    last: torch.Tensor,
    gamma: float,
    bonus: torch.Tensor,
) -> torch.Tensor:
    """G(t) = r(t) + gamma (1 - ends(t)) (G(t+1) + bonus(t+1)), ``[T, N]`` in double precision.

    After ``last``, rewards and bonuses are taken to go on as in this decision: an episode that has
    failed for so long is taken to fail for ever. The weight of this future in the returns that
    count is at most 5 % (with a discount of at most 0.99).

    Args:
        reward, bonus: per decision, ``[T, N]``; the bonus is that of entropy, with a soft backup.
        ends: nothing follows this decision, ``[T, N]`` bool.
        last: the column's last decision, where it does not succeed, ``[T, N]`` bool.
        gamma: discount per decision.
    """
    returns = torch.empty_like(reward, dtype=torch.float64)
    after = torch.zeros_like(returns[0])
    for t in reversed(range(len(returns))):
        after = torch.where(last[t], (reward[t] + bonus[t]) / (1 - gamma), after)
        returns[t] = reward[t] + gamma * torch.where(ends[t], 0.0, after)
        after = returns[t] + bonus[t]
    return returns


def agreement(q: torch.Tensor, returns: torch.Tensor) -> Measures:
    """How well Q-values agree with returns.

    - ``bias``, ``bias_std`` = mean and standard deviation of Q - G;
    - ``correlation``, ``rank_correlation`` = Pearson's and Spearman's of Q and G; None where one
      of them has no variance, and for fewer than ``MIN_PAIRS`` values;
    - ``overestimated`` = share with Q > G;
    - ``decisions`` = number of values. Without values, all others are None.

    Args:
        q, returns: ``[B]``, double precision.
    """
    gap = q - returns
    bias, spread = _mean_and_std(gap)
    over = torch.where(gap.isnan(), gap, (gap > 0).double())
    measured = len(q) >= MIN_PAIRS and not any(
        bool(x.std() <= SAME * x.abs().max()) for x in (q, returns)
    )
    pair = q.numpy(force=True), returns.numpy(force=True)
    return {
        "bias": bias,
        "bias_std": spread,
        "correlation": float(scipy.stats.pearsonr(*pair).statistic) if measured else None,
        "rank_correlation": float(scipy.stats.spearmanr(*pair).statistic) if measured else None,
        "overestimated": _mean_and_std(over)[0],
        "decisions": float(len(q)),
    }


def _mean_and_std(x: torch.Tensor) -> tuple[float, float] | tuple[None, None]:
    """Mean and population standard deviation of numbers, if there are any."""
    return (x.mean().item(), x.std(unbiased=False).item()) if len(x) else (None, None)
