"""Steering agents: SAC in the latent noise of a frozen policy, and the references it must beat.

An agent is a class with a ``name`` in any module of this package: a new one needs one new file and
nothing else (docs/submit.md).
"""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol, TypeAlias, cast

import torch

from symsteer.agents.references import BaseAgent
from symsteer.agents.replay import Batch, ReplayBuffer
from symsteer.agents.sac import Normalize, SacAgent, SacConfig
from symsteer.errors import UserError
from symsteer.policies.geometry import Layout

__all__ = [
    "AGENTS",
    "Batch",
    "ReplayBuffer",
    "SacAgent",
    "SacConfig",
    "SteeringAgent",
    "make_agent",
    "registry",
]

AgentClass: TypeAlias = type[SacAgent] | type[BaseAgent]

AGENTS: Mapping[str, AgentClass]
"""What :func:`registry` returns; looked up on first use, so that a damaged file in this package is
reported by the command that needs the agents."""

COMPARED = ("standard", "standard-matched", "equivariant", "approximate")
"""The agents of the paper's question, listed first and in this order."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")
"""Names that can be part of a run's folder and record."""


class SteeringAgent(Protocol):
    """What the collecting loop needs of an agent."""

    name: str
    learns: bool

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]`` for observations ``[B, obs_dim]``."""
        ...

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One gradient step; scalars as tensors (none if the agent does not learn)."""
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...

    def parameter_counts(self) -> dict[str, int]:
        """Keys actor, critic, total, actor_width, critic_width."""
        ...


@functools.cache
def registry() -> Mapping[str, AgentClass]:
    """All agents by name: `COMPARED`, other learners by name, then the references.

    An agent is a class that a module of this package defines and that has a ``name``, its own or
    an inherited one; classes whose own name starts with an underscore are none.

    Raises:
        UserError: if a module cannot be imported, two agents have one name, or an agent's name
            cannot be part of a run's folder, or it inherits from no agent.
    """
    found: dict[str, AgentClass] = {}
    for agent in _classes():
        where = f"{agent.__module__.replace('.', '/')}.py: {agent.__name__}"
        if not NAME.fullmatch(agent.name):
            raise UserError(
                f"{where} has the name {agent.name!r}; use at most 60 letters, digits, dots, "
                "dashes and underscores, as the name becomes part of file names"
            )
        if not issubclass(agent, SacAgent | BaseAgent):
            raise UserError(
                f"{where} has a name but is no agent; inherit from agents.sac.SacAgent (or, if it "
                "does not learn, from agents.references.BaseAgent), or start the class's name with "
                "an underscore"
            )
        if agent.name in found:
            other = found[agent.name]
            raise UserError(
                f"{where} and {other.__module__.replace('.', '/')}.py: {other.__name__} are both "
                f"called {agent.name!r}; give each agent a name of its own"
            )
        found[agent.name] = agent

    def place(name: str) -> tuple[int, str]:
        if name in COMPARED:
            return COMPARED.index(name), ""
        # References keep the order of their file, from the simplest on.
        return (len(COMPARED), name) if found[name].learns else (len(COMPARED) + 1, "")

    return {name: found[name] for name in sorted(found, key=place)}


def _classes() -> Iterator[AgentClass]:
    for module in pkgutil.iter_modules(__path__, f"{__name__}."):
        try:
            members = vars(importlib.import_module(module.name))
        # Whatever an agent's file may raise while it is read.
        except Exception as error:
            raise UserError(
                f"{module.name.replace('.', '/')}.py cannot be imported "
                f"({type(error).__name__}: {error}{_line(error)}); mend or remove it"
            ) from error
        for member in list(members.values()):
            if (
                inspect.isclass(member)
                and member.__module__ == module.name
                and not member.__name__.startswith("_")
                and isinstance(getattr(member, "name", None), str)
            ):
                yield cast(AgentClass, member)


def _line(error: Exception) -> str:
    """Where the innermost file of this package failed."""
    lines = []
    trace = error.__traceback__
    while trace:
        path = Path(trace.tb_frame.f_code.co_filename)
        if str(path.parent) in __path__ and path != Path(__file__):
            lines.append(f", line {trace.tb_lineno}")
        trace = trace.tb_next
    return lines[-1] if lines else ""


def __getattr__(name: str) -> Any:
    if name == "AGENTS":
        return registry()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def make_agent(
    name: str,
    obs_layout: Layout,
    act_layout: Layout,
    horizon: int,
    config: SacConfig | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    normalize_obs: Normalize | None = None,
    dtype: torch.dtype = torch.float32,
) -> SacAgent | BaseAgent:
    """Build an agent by name; arguments as in :class:`symsteer.agents.sac.SacAgent`.

    Raises:
        UserError: if there is no agent of that name.
    """
    agents = registry()
    if name not in agents:
        raise UserError(f"there is no agent {name!r}; choose one of {', '.join(agents)}")
    return agents[name](
        obs_layout, act_layout, horizon, config or SacConfig(), device, seed, normalize_obs, dtype
    )
