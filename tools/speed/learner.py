"""Time of an update of each learner, side by side with what bounds it.

The base policy has the default size and is untrained, transitions are random: neither changes the
cost.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.options import SacOptions
from symsteer.agents.replay import Batch, Transition
from symsteer.agents.sac import SacAgent, can_join
from symsteer.agents.team import Team
from symsteer.bench.throughput import new_policy
from tools.speed.timing import OtherProgram, clock_of, in_turns, products_of, time_on

DECISIONS = 512
"""Random decisions in the replay."""

TEAMS = {"cpu": (5,), "cuda": (5, 20, 80)}
"""Members of the teams on each device."""


@dataclass
class Contender:
    """What is timed.

    Attributes:
        device: of its tensors.
        what: the update, the same as a CUDA graph, or its matrix products alone.
        critic: of a learner.
        members: learners that are updated at once.
        batch_size: transitions in an update of one learner; 0 without batches.
        run: what is timed.
        updates: that ``run`` stands for.
    """

    device: str
    agent: str
    what: str
    critic: str
    members: int
    parameters: int
    batch_size: int
    run: Callable[[], Any]
    updates: float = 1


def measure(
    task: str,
    updates: int,
    repeats: int,
    report: Callable[[str], None],
    agents: Sequence[str] = tuple(AGENTS.builtin),
    devices: Sequence[str] = ("cpu",),
    sbx: Path | None = None,
) -> list[dict[str, Any]]:
    """Time the updates of learners.

    Args:
        task: gives the layouts.
        updates: in one measurement.
        repeats: measurements of each contender.
        report: receives a line for each round.
        agents: names; those that are no learners are left out.
        devices: ``cpu``, ``cuda``.
        sbx: a Python that has SBX (JAX); None: without it.

    Returns:
        One row each: the fields of :class:`Contender` but ``run``, and milliseconds of one update
        of one member: ``median``, ``min``, ``max``. They are of CPU time, with a GPU of wall-clock
        time.
    """
    contenders = [
        contender for device in devices for contender in _contenders(task, agents, device)
    ]
    if sbx:
        size = _standard_options().batch_size
        contenders.append(Contender("cpu", "sbx", "update", "noise", 1, 0, size, _sbx(task, sbx)))
    runs = [contender.run for contender in contenders]
    times = [
        [spent / contender.updates for spent in found]
        for contender, found in zip(
            contenders, in_turns(runs, updates, repeats, report, clock_of(devices)), strict=True
        )
    ]
    return [
        {
            **{key: value for key, value in vars(contender).items() if key != "run"},
            **{"median": statistics.median(found), "min": min(found), "max": max(found)},
        }
        for contender, found in zip(contenders, times, strict=True)
    ]


def table(rows: list[dict[str, Any]]) -> str:
    """Text table of :func:`measure`; ratios to `standard` with critics of the noise.

    They are to the one on the first device.
    """
    devices = {row["device"] for row in rows}
    unit = next(
        row["median"]
        for row in rows
        if (row["agent"], row["what"], row["critic"]) == ("standard", "update", "noise")
    )
    lines = [
        f"{time_on([*devices])} of one update of one learner, one thread; "
        "median of the measurements (smallest to largest)",
        "",
        f"{'device':6s} {'agent':18s} {'what':18s} {'critic':9s} {'parameters':>10s} {'batch':>6s} "
        f"{'ms':>7s} {'':18s} ratio",
    ]
    for row in rows:
        spread = f"({row['min']:.1f} to {row['max']:.1f})"
        parameters = f"{row['parameters']:,d}" if row["parameters"] else ""
        team = f", team of {row['members']}" if row["members"] > 1 else ""
        what = row["what"] + team
        lines.append(
            f"{row['device']:6s} {row['agent']:18s} {what:18s} {row['critic']:9s} "
            f"{parameters:>10s} {row['batch_size'] or '':>6} {row['median']:7.2f} {spread:18s} "
            f"{row['median'] / unit:5.2f}"
        )
    return "\n".join(lines)


def _contenders(task: str, agents: Sequence[str], device: str) -> list[Contender]:
    found = []
    for name in agents:
        agent_class = AGENTS.get(name)
        if not issubclass(agent_class, SacAgent):
            continue
        for critic in agent_class.Options.known_critics:
            alone = _learner(task, name, critic, 0, device)
            sizes = (alone.parameter_counts()["total"], alone.options.batch_size)
            update = functools.partial(_update, alone)
            found.append(Contender(device, name, "update", critic, 1, *sizes, update))
            if name == "standard":
                products = products_of(update)
                found.append(Contender(device, name, "products alone", critic, 1, *sizes, products))
            if alone.in_graphs:
                graph = functools.partial(_update, alone, Batch())
                found.append(Contender(device, name, "graph", critic, 1, *sizes, graph))
            for count in TEAMS[device] if can_join(agent_class) else ():
                seeds = range(1, 1 + count)
                team = Team([_learner(task, name, critic, seed, device) for seed in seeds])
                run = functools.partial(_update_team, team)
                found.append(Contender(device, name, "update", critic, count, *sizes, run, count))
                if alone.in_graphs:
                    run = functools.partial(_update_team, team, [Batch()] * count)
                    found.append(
                        Contender(device, name, "graph", critic, count, *sizes, run, count)
                    )
    context = AgentContext.of(new_policy(task).to(device), device)
    if importlib.util.find_spec("stable_baselines3"):
        size = _standard_options().batch_size
        train = _sb3(context)
        found.append(Contender(device, "stable-baselines3", "update", "noise", 1, 0, size, train))
    return found


def _learner(task: str, name: str, critic: str, seed: int, device: str) -> SacAgent:
    agent_class = AGENTS.get(name)
    options = agent_class.Options(critic_kind=critic, warmup=1)
    agent = agent_class(AgentContext.of(new_policy(task).to(device), device, seed), options)
    assert isinstance(agent, SacAgent)
    agent.observe(_decisions(agent.context, agent.rows, DECISIONS))
    return agent


def _standard_options() -> SacOptions:
    return AGENTS.get("standard").Options()


def _decisions(context: AgentContext, rows: int, count: int) -> Transition:
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(count, *shape, generator=generator).to(context.device)

    obs_dim, act_dim = context.obs_layout.dim, context.act_layout.dim
    return Transition(
        obs=0.1 * draw(obs_dim),
        noise=draw(rows, act_dim),
        actions=draw(context.execute, act_dim).tanh(),
        reward=draw(),
        next_obs=0.1 * draw(obs_dim),
        terminal=torch.zeros(count, device=context.device),
        truncated=torch.zeros(count, device=context.device),
    )


def _update(agent: SacAgent, batch: Batch | None = None) -> None:
    agent.update(agent.new_batch() if batch is None else batch)


def _update_team(team: Team, batches: Sequence[Batch] | None = None) -> None:
    team.update(batches or [agent.new_batch() for agent in team.members])


def _sbx(task: str, python: Path) -> OtherProgram:
    """SBX's SAC with networks and batches of the same sizes, on the noise."""
    options, context = _standard_options(), AgentContext.of(new_policy(task))
    sizes = {
        "obs": context.obs_layout.dim,
        "noise": context.noise_layout.dim,
        "batch": options.batch_size,
        "width": options.width,
        "depth": options.depth,
        "critics": options.critics,
        "decisions": DECISIONS,
    }
    program = Path(__file__).with_name("sbx_update.py")
    return OtherProgram([str(python), str(program), json.dumps(sizes)])


def _sb3(context: AgentContext) -> Callable[[], None]:
    """Stable-Baselines3's SAC with networks and batches of the same sizes, on the noise."""
    import gymnasium
    import numpy as np
    from stable_baselines3 import SAC
    from stable_baselines3.common.logger import Logger

    options = _standard_options()
    obs, noise = context.obs_layout.dim, context.noise_layout.dim

    class Spaces(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (obs,), np.float32)
        action_space = gymnasium.spaces.Box(-1, 1, (noise,), np.float32)

        def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict]:
            return np.zeros(obs, np.float32), {}

    model = SAC(
        "MlpPolicy",
        Spaces(),
        batch_size=options.batch_size,
        policy_kwargs={
            "net_arch": [options.width] * options.depth,
            "n_critics": options.critics,
        },
        device=context.device,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    assert model.replay_buffer is not None
    draw = np.random.default_rng(0)
    for _ in range(DECISIONS):
        row = [draw.standard_normal((1, n)).astype(np.float32) for n in (obs, obs, noise)]
        zero = np.zeros(1, np.float32)
        model.replay_buffer.add(row[0], row[1], row[2].clip(-1, 1), zero, zero, [{}])
    return functools.partial(model.train, gradient_steps=1, batch_size=options.batch_size)
