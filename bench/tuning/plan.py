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
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasPath, BaseModel, ConfigDict, Field, ValidationError

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.sweep.grid import suite_data
from symsteer.bench.sweep.suite import suite_of
from symsteer.bench.tuning import FOLDER
from symsteer.errors import UserError, first_problem
from symsteer.files import read_toml
from symsteer.names import check

LATER = ("description", "trials", "further", "exchange", "batch", "singles")
"""What may change after the first trial."""

Table = dict[str, Any]
Grid = Annotated[Table | list[Table], Field(min_length=1)]
Number = Annotated[int, Field(ge=1, le=10**6)]


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)

    description: str = ""
    agents: Annotated[list[str], Field(min_length=1)]
    singles: list[str] = []
    trials: Number = 20
    exchange: Annotated[int, Field(ge=0, le=10**6)] = 0
    batch: Number = 4
    probe: Number = 2
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    grid: Grid
    run: Table = {}
    options: dict[str, Any] = Field({}, validation_alias=AliasPath("run", "agent"))
    confirm: Grid
    start: Table = {}
    further: list[Table] = []
    space: Annotated[Table, Field(min_length=1)]


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``, whole ones if both are; ``log``: even in the logarithm."""

    low: float
    high: float
    log: bool = False


@dataclass(frozen=True)
class Choices:
    """A list of values."""

    values: tuple[Any, ...]


Space = Mapping[str, Range | Choices]
"""By option."""


@dataclass(frozen=True)
class TuningPlan:
    """A tuning plan.

    Attributes:
        name: of the file, without its ending.
        source: file name; messages begin with it.
        description: what is tuned, and where.
        trials: of each agent, drawn by the search.
        exchange: further trials of each agent, which begin with the settings of the others.
        batch: trials of an agent in one round; later rounds learn from earlier ones.
        probe: cells after which a trial may be given up.
        seed: of the search.
        spaces: search space of each agent.
        singles: agents of which every option is also tried by itself.
        data: the tables of the file.
    """

    name: str
    source: str
    description: str
    trials: int
    exchange: int
    batch: int
    probe: int
    seed: int
    spaces: Mapping[str, Space]
    singles: tuple[str, ...]
    data: Mapping[str, Any]

    @property
    def agents(self) -> list[str]:
        """In the order of the file."""
        return list(self.spaces)

    @property
    def digest(self) -> str:
        """Hash of all that decides what a trial is."""
        kept = {key: value for key, value in self.data.items() if key not in LATER}
        return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()

    @property
    def listed(self) -> int:
        """Trials of each agent before the exchange: those drawn, and the further settings."""
        return self.trials + len(self.data.get("further", ()))

    def start(self, agent: str) -> dict[str, Any]:
        """Options of the agent's first trial."""
        return {name: _first(self.data, agent, name) for name in self.spaces[agent]}

    def further(self, agent: str) -> list[dict[str, Any]]:
        """Options of the settings that the agent tries after its trials."""
        start = self.start(agent)
        return [
            {name: options.get(name, first) for name, first in start.items()}
            for options in self.data.get("further", ())
        ]

    def cells(self, agent: str, options: Mapping[str, Any], grid: str = "grid") -> list[RunConfig]:
        """One run per cell with these options, in the order of the file.

        Args:
            agent: its name.
            options: of the agent.
            grid: ``grid`` for the cells of trials, ``confirm`` for the fresh ones.
        """
        run = copy.deepcopy(self.data.get("run", {}))
        table = {"grid": self.data[grid], "run": run}
        shared = run.get("agent", {})
        own = {key: value for key, value in shared.items() if key not in self.spaces}
        run["agent"] = {**own, "name": agent, agent: {**shared.get(agent, {}), **options}}
        return list(suite_of(suite_data(table, Path(self.source))).runs)


def read_plan(name_or_path: str) -> TuningPlan:
    """Read a tuning plan by name or from a TOML file.

    Raises:
        UserError: if there is no such plan, it is not complete, a search space does not fit its
            agent, or it leaves out a value of the first trial.
    """
    data, path = read_toml(name_or_path, "tuning plan", FOLDER)
    source = path.name
    check("key", data, sorted(_File.model_fields.keys() - {"options"}), source)
    try:
        file = _File.model_validate(data)
    except ValidationError as error:
        raise UserError(f"{source}: {first_problem(error)}; correct it there") from error
    agents = file.agents
    try:
        names = dict.fromkeys(name for agent in agents for name in _option_names(agent))
    except UserError as error:
        raise UserError(f"{source}: agents: {error}") from error
    check("option or agent", data["space"], [*names, *agents], f"{source}, space")
    for where, table in (("space", file.space), ("run.agent", file.options)):
        for agent in agents:
            if not isinstance(table.get(agent, {}), dict):
                raise UserError(f"{source}: {where}.{agent} must be a table of options")
    plan = TuningPlan(
        name=path.stem,
        source=source,
        description=file.description,
        spaces={agent: _space(agent, data, agents, source) for agent in agents},
        singles=tuple(file.singles),
        data=data,
        **{key: getattr(file, key) for key in ("trials", "exchange", "batch", "probe", "seed")},
    )
    shared = {name for space in plan.spaces.values() for name in space}
    tables = [("start", data.get("start", {})), *(("further", f) for f in data.get("further", ()))]
    for key, table in tables:
        check("tuned option", table, sorted(shared), f"{source}, {key}")
    check("agent", plan.singles, plan.agents, f"{source}, singles")
    for agent in plan.agents:
        plan.cells(agent, plan.start(agent), "confirm")
        for name, value in (item for options in plan.further(agent) for item in options.items()):
            if not _contains(plan.spaces[agent][name], value):
                raise UserError(
                    f"{source}: space.{name} does not contain {value!r} of a further setting; "
                    f"widen it, or change further.{name}"
                )
        if plan.probe > (count := len(plan.cells(agent, plan.start(agent)))):
            raise UserError(f"{source}: probe is {plan.probe}, but there are only {count} cells")
    return plan


def _first(data: Mapping[str, Any], agent: str, name: str) -> Any:
    default = getattr(AGENTS.get(agent).Options(), name)
    return data.get("start", {}).get(name, default)


def _space(agent: str, data: Mapping[str, Any], agents: Sequence[str], source: str) -> Space:
    tables = data["space"]
    fields = _option_names(agent)
    own = tables.get(agent, {})
    check(f"option of {agent}", own, fields, f"{source}, space")
    shared = {key: value for key, value in tables.items() if key not in agents and key in fields}
    space: dict[str, Range | Choices] = {}
    for name, value in {**shared, **own}.items():
        if value == [] and name in own:
            continue
        space[name] = found = _values(name, value, source)
        ends = found.values if isinstance(found, Choices) else (found.low, found.high)
        for end in (*ends, first := _first(data, agent, name)):
            build_config({"agent": agent, "agent_options": {name: end}}, f"{source}: space")
        if not _contains(found, first):
            raise UserError(
                f"{source}: space.{name} does not contain {first!r}, with which the first trial of "
                f"{agent} begins; widen it, or give start.{name}"
            )
    return space


def _option_names(agent: str) -> list[str]:
    return [field.name for field in dataclasses.fields(AGENTS.get(agent).Options)]


def _values(name: str, value: Any, source: str) -> Range | Choices:
    if isinstance(value, list) and value:
        return Choices(tuple(value))
    try:
        found = Range(**value)
        least = 0 if found.log else -math.inf
        numbers = all(type(end) in (int, float) for end in (found.low, found.high))
        if numbers and least < found.low < found.high < math.inf:
            return found
    except TypeError:
        pass
    raise UserError(
        f"{source}: space.{name} must be a list of choices, or {{ low = 1e-4, high = 1e-2, "
        f"log = true }} with low below high (and above 0 with log), not {value!r}"
    )


def _contains(values: Range | Choices, value: Any) -> bool:
    if isinstance(values, Choices):
        return value in values.values
    return isinstance(value, int | float) and values.low <= value <= values.high
