"""What is tuned: agents, cells, numbers of trials and search spaces, as a TOML file.

``[grid]`` and ``[run]`` describe the cells as in a suite, one run per trial each. ``[confirm]`` is
the grid of fresh cells on which the chosen settings are compared with the first ones. Every option
of the agents in ``singles`` is also tried by itself. ``[space]`` has the options of all agents that
have them, ``[space.AGENT]`` those of one agent. An option has a list of choices, or
``{ low = 1e-4, high = 1e-2, log = true }``; an empty list takes it from an agent. ``[start]`` has
options of every first trial; the others begin with the agent's defaults. Every ``[[further]]`` is
a setting that all agents try after their trials; what it leaves out is that of the first trial.
"""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Annotated, Any

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainSerializer,
    PrivateAttr,
    model_validator,
)

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.sweep.grid import Grids, SuiteFile, Table
from symsteer.bench.sweep.suite import runs_of
from symsteer.bench.tuning import FOLDER
from symsteer.errors import UserError
from symsteer.files import read_model
from symsteer.names import check

LATER = ("description", "trials", "further", "exchange", "batch", "singles")
"""What may change after the first trial."""

WrittenGrids = Annotated[
    Grids, PlainSerializer(lambda grids: grids[0] if len(grids) == 1 else grids)
]
"""Grids as in a suite, which are written as in the file."""

Count = Annotated[int, Field(strict=True, ge=1, le=10**6)]

Space = Mapping[str, BaseDistribution]
"""What an option may be, by option."""


class TuningPlan(BaseModel):
    """A tuning plan. The fields are the keys of its file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    description: str = ""
    """What is tuned, and where."""
    agents: Annotated[tuple[str, ...], Field(min_length=1)]
    singles: tuple[str, ...] = ()
    """Agents of which every option is also tried by itself."""
    trials: Count = 20
    """Of each agent, drawn by the search."""
    exchange: Annotated[int, Field(strict=True, ge=0, le=10**6)] = 0
    """Further trials of each agent, which begin with the settings of the others."""
    batch: Count = 4
    """Trials of an agent in one round; later rounds learn from earlier ones."""
    probe: Count = 2
    """Cells after which a trial may be given up."""
    seed: Annotated[int, Field(strict=True, ge=0, lt=2**32)] = 0
    """Of the search."""
    grid: WrittenGrids
    run: Table = {}
    confirm: WrittenGrids
    start: Table = {}
    further: tuple[Table, ...] = ()
    space: Annotated[Table, Field(min_length=1)]
    _name: str = PrivateAttr("")
    _spaces: dict[str, Space] = PrivateAttr(default_factory=dict)

    @property
    def name(self) -> str:
        """Of the file, without its ending."""
        return self._name

    @property
    def spaces(self) -> Mapping[str, Space]:
        """The search space of each agent."""
        return self._spaces

    @property
    def digest(self) -> str:
        """Hash of all that decides what a trial is."""
        kept = self.model_dump(exclude_unset=True, exclude=set(LATER))
        return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()

    @property
    def listed(self) -> int:
        """Trials of each agent before the exchange: those drawn, and the further settings."""
        return self.trials + len(self.further)

    @property
    def total(self) -> int:
        """Trials of each agent."""
        return self.listed + self.exchange

    def first(self, agent: str) -> dict[str, Any]:
        """Options of the agent's first trial."""
        defaults = AGENTS.get(agent).Options()
        return {name: self.start.get(name, getattr(defaults, name)) for name in self.spaces[agent]}

    def later(self, agent: str) -> list[dict[str, Any]]:
        """Options of the further settings, which the agent tries after its trials."""
        first = self.first(agent)
        return [{name: more.get(name, first[name]) for name in first} for more in self.further]

    def cells(self, agent: str, options: Mapping[str, Any], grid: str = "grid") -> list[RunConfig]:
        """One run per cell with these options, in the order of the file.

        Args:
            agent: its name.
            options: of the agent.
            grid: ``grid`` for the cells of trials, ``confirm`` for the fresh ones.
        """
        run = copy.deepcopy(self.run)
        shared = run.get("agent", {})
        general = {key: value for key, value in shared.items() if key not in self.agents}
        run["agent"] = {**general, "name": agent, agent: {**shared.get(agent, {}), **options}}
        suite = SuiteFile.model_validate({"grid": getattr(self, grid), "run": run})
        return list(runs_of(suite, grid))

    @model_validator(mode="after")
    def _fits_its_agents(self) -> TuningPlan:
        known = {agent: _option_names(agent) for agent in self.agents}
        every = dict.fromkeys(name for names in known.values() for name in names)
        check("option or agent", self.space, [*every, *self.agents], "space")
        check("agent", self.singles, self.agents, "singles")
        for agent in self.agents:
            for key, table in (("space", self.space), ("run.agent", self.run.get("agent", {}))):
                if not isinstance(table, dict) or not isinstance(table.get(agent, {}), dict):
                    raise UserError(f"{key}.{agent} must be a table of options")
            self._spaces[agent] = self._space_of(agent, known[agent])
        tuned = sorted({name for space in self.spaces.values() for name in space})
        for key, table in (("start", self.start), *(("further", more) for more in self.further)):
            check("tuned option", table, tuned, key)
        for agent, space in self.spaces.items():
            first = self.first(agent)
            for name, value in first.items():
                if not _contains(space[name], value):
                    raise UserError(
                        f"space.{name} does not contain {value!r}, with which the first trial of "
                        f"{agent} begins; widen it, or give start.{name}"
                    )
            for name, value in (item for more in self.later(agent) for item in more.items()):
                if not _contains(space[name], value):
                    raise UserError(
                        f"space.{name} does not contain {value!r} of a further setting; widen it, "
                        f"or change further.{name}"
                    )
            self.cells(agent, first, "confirm")
            if self.probe > (count := len(self.cells(agent, first))):
                raise UserError(f"probe is {self.probe}, but there are only {count} cells")
        return self

    def _space_of(self, agent: str, known: list[str]) -> Space:
        """The options of an agent that are tuned: the shared ones that it has, and its own."""
        special = self.space.get(agent, {})
        check(f"option of {agent}", special, known, "space")
        shared = {key: self.space[key] for key in self.space if key in known}
        space = {
            name: _distribution(name, values)
            for name, values in (shared | special).items()
            if values != [] or name not in special
        }
        for name, values in space.items():
            for end in (*_ends(values), self.start.get(name)):
                if end is not None:
                    build_config({"agent": agent, "agent_options": {name: end}}, "space")
        return space


def read_plan(name_or_path: str) -> TuningPlan:
    """Read a tuning plan by name or from a TOML file.

    Raises:
        UserError: if there is no such plan, it is not complete, a search space does not fit its
            agent, or it leaves out a value of the first trial.
    """
    plan, path = read_model(name_or_path, "tuning plan", FOLDER, TuningPlan)
    plan._name = path.stem
    return plan


def _option_names(agent: str) -> list[str]:
    return [field.name for field in dataclasses.fields(AGENTS.get(agent).Options)]


def _distribution(name: str, values: Any) -> BaseDistribution:
    """A list of choices, or numbers within a range: whole ones if both ends are."""
    try:
        if isinstance(values, list):
            return CategoricalDistribution(values)
        whole = {type(values["low"]), type(values["high"])} == {int}
        return (IntDistribution if whole else FloatDistribution)(**values)
    except (LookupError, TypeError, ValueError) as error:
        raise UserError(
            f"space.{name} must be a list of choices, or {{ low = 1e-4, high = 1e-2, log = true }} "
            f"with low below high (and above 0 with log), not {values!r}"
        ) from error


def _ends(values: Any) -> tuple[Any, ...]:
    return getattr(values, "choices", ()) or (values.low, values.high)


def _contains(values: Any, value: Any) -> bool:
    if isinstance(values, CategoricalDistribution):
        return value in values.choices
    return isinstance(value, int | float) and values.low <= value <= values.high
