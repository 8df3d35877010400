"""CPU time of an update of each learner, side by side.

The base policy has the default size and is untrained, transitions are random: neither changes the
cost. All learners run in turns, so that a change in the machine's speed reaches all of them.
"""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable
from typing import Any, get_args

import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.options import Critic
from symsteer.agents.replay import Transition
from symsteer.agents.sac import SacAgent
from symsteer.bench.tasks import task_class
from symsteer.policies import POLICIES

DECISIONS = 512
"""Random decisions in the replay."""

WARM_UP = 5
"""Updates before the first measurement."""


def measure(
    task: str, updates: int, repeats: int, report: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Time the updates of every learner with each kind of critic, and the decoder alone.

    Args:
        task: gives the layouts.
        updates: in one measurement.
        repeats: measurements of each learner.
        report: receives a line for each round.

    Returns:
        One row each: ``agent``, ``critic`` (None for the decoder), ``parameters``, ``batch_size``,
        and CPU milliseconds of one update: ``median``, ``min``, ``max``.
    """
    kind = task_class(task)
    policy = POLICIES.get("edp")
    base = policy(policy.Options(), kind.observation_layout, kind.action_layout)
    context = AgentContext(
        base.obs_layout,
        base.act_layout,
        base.horizon,
        base.execute,
        base.decode,
        base.normalized_observation,
    )
    rows: list[dict[str, Any]] = []
    work: list[Callable[[], Any]] = []
    for name in AGENTS.builtin:
        agent_class = AGENTS.get(name)
        if not issubclass(agent_class, SacAgent):
            continue
        for critic in get_args(Critic):
            agent = agent_class(context, agent_class.Options(critic=critic))
            agent.observe(_decisions(context))
            rows.append(
                {
                    "agent": name,
                    "critic": critic,
                    "parameters": agent.parameter_counts()["total"],
                    "batch_size": agent.options.batch_size,
                }
            )
            work.append(functools.partial(_update, agent))
    size = rows[0]["batch_size"]
    some = _decisions(context)
    rows.append({"agent": "decoder", "critic": None, "parameters": 0, "batch_size": size})
    work.append(lambda: base.decode(some.obs[:size], some.noise[:size]))
    for run in work:
        for _ in range(WARM_UP):
            run()
    times: list[list[float]] = [[] for _ in rows]
    for turn in range(repeats):
        for found, run in zip(times, work, strict=True):
            begin = time.process_time()
            for _ in range(updates):
                run()
            found.append(1e3 * (time.process_time() - begin) / updates)
        report(f"round {turn + 1} of {repeats}")
    for row, found in zip(rows, times, strict=True):
        row |= {"median": statistics.median(found), "min": min(found), "max": max(found)}
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Text table of :func:`measure`; ratios to `standard` with critics of the noise."""
    unit = next(r["median"] for r in rows if (r["agent"], r["critic"]) == ("standard", "noise"))
    lines = [
        f"CPU time of one update, batch {rows[0]['batch_size']}, one thread; median of "
        "the measurements (smallest to largest)",
        "",
        f"{'agent':18s} {'critic':9s} {'parameters':>10s} {'ms':>7s} {'':18s} ratio",
    ]
    for row in rows:
        spread = f"({row['min']:.1f} to {row['max']:.1f})"
        lines.append(
            f"{row['agent']:18s} {row['critic'] or '':9s} {row['parameters']:10,d} "
            f"{row['median']:7.1f} {spread:18s} {row['median'] / unit:5.2f}"
        )
    return "\n".join(lines)


def _decisions(context: AgentContext) -> Transition:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(DECISIONS, *shape, generator=generator)

    obs_dim, act_dim = context.obs_layout.dim, context.act_layout.dim
    return Transition(
        obs=0.1 * draw(obs_dim),
        noise=draw(context.horizon, act_dim),
        actions=draw(context.execute, act_dim).tanh(),
        reward=draw(),
        next_obs=0.1 * draw(obs_dim),
        terminal=torch.zeros(DECISIONS),
        truncated=torch.zeros(DECISIONS),
    )


def _update(agent: SacAgent) -> None:
    options = agent.options
    agent.update(agent.replay.sample(options.batch_size, options.gamma, options.n_step))
