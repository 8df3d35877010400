"""The plan of a sweep: its runs, and the file with their list that ``symsteer status`` reads."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from symsteer.bench.runs.base_policy import base_key
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import run_id, write_json
from symsteer.bench.runs.run import check
from symsteer.bench.sweep.suite import Suite
from symsteer.errors import UserError
from symsteer.leaderboard.records import flat

BASIC = ("task", "embodiment", "variant", "agent", "seed")
"""Keys of a configuration that all tables and lines show."""

PART = re.compile(r"-[1-9][0-9]*-of-[1-9][0-9]*$")
"""What the name of a share's file has behind that of its suite."""

FOLLOWERS = ("policy_seed", "demonstrations.seed")
"""Keys that say nothing new where they are the run's seed."""

OWNERS = {"agent": "agent", "policy": "policy.name"}
"""The key with the name of the agent or policy that has the options ``agent.X`` or ``policy.X``."""


@dataclass(frozen=True)
class PlannedRun:
    """The settings that identify a run in lines and tables, and its budget."""

    run_id: str
    task: str
    embodiment: str
    variant: str
    agent: str
    seed: int
    env_steps: int
    extra: dict[str, Any] = field(default_factory=dict, hash=False)
    """Other settings in which the runs of a suite differ: ``{"demonstrations.count": 5}``."""

    @classmethod
    def of(cls, config: Mapping[str, Any], name: str, extra: Iterable[str] = ()) -> PlannedRun:
        """The run of a configuration given as nested plain data."""
        settings = _settings(config)
        values = {key: config[key] for key in (*BASIC, "env_steps")}
        return cls(name, **values, extra={k: settings[k] for k in extra if k in settings})

    @property
    def keys(self) -> dict[str, Any]:
        """The settings that identify the run, in the order in which they are shown."""
        return {key: getattr(self, key) for key in BASIC} | self.extra

    @property
    def label(self) -> str:
        """One line that names the run."""
        extra = "".join(f" {key.rpartition('.')[2]} {value}" for key, value in self.extra.items())
        return f"{self.task} {self.embodiment} {self.variant} {self.agent}{extra} seed {self.seed}"


@dataclass(frozen=True)
class Plan:
    """The runs of a suite, in its order, and the folder that they are written to."""

    name: str
    description: str
    out: Path
    configs: dict[PlannedRun, RunConfig]
    track: bool = False
    """Whether Weights & Biases shows the runs."""
    part: str = ""
    """``-3-of-16`` if these are not all runs of the suite, but the third of 16 shares."""

    @property
    def path(self) -> Path:
        """The file with the list of the runs."""
        return sweep_path(self.out, self.name + self.part)

    @property
    def runs(self) -> list[PlannedRun]:
        """The runs, in the order of the suite."""
        return list(self.configs)


@dataclass(frozen=True)
class SweepFile:
    """What is kept of a sweep in ``RUNS/sweeps/SUITE.json``, or of a share in another file."""

    suite: str
    description: str
    workers: int
    """Number of runs at the same time; 0 if the cluster decides."""
    updated: str
    runs: tuple[PlannedRun, ...]
    failures: dict[str, str] = field(default_factory=dict)
    """Why runs failed in the last sweep, by run id. The record of a run whose process was killed
    cannot hold it."""
    jobs: dict[str, str] = field(default_factory=dict)
    """The Slurm jobs that runs were handed to, by run id."""


def make_plan(suite: Suite, out: Path, elsewhere: bool = False) -> Plan:
    """Check every run of a suite before anything is built.

    Args:
        suite: what to run.
        out: folder of the runs.
        elsewhere: whether other machines run it: they need the full path of the folder, and the
            devices are not checked here.

    Raises:
        UserError: if a run cannot be started, e.g. because its task does not exist.
    """
    settings = []
    for config in suite.runs:
        try:
            check(replace(config, sim="cpu", device="cpu") if elsewhere else config)
        except UserError as error:
            raise UserError(f"{suite.name}: {error}") from error
        settings.append(_settings(config.to_json()))
    extra = _differing(settings)
    runs = {
        PlannedRun.of(config.to_json(), run_id(config, {}), extra): config for config in suite.runs
    }
    return Plan(suite.name, suite.description, out.resolve() if elsewhere else out, runs)


def shares(plan: Plan, count: int) -> list[Plan]:
    """Split a plan for machines that do not know of each other.

    Each run is in one share. The split depends on the runs and their order alone, not on which are
    finished. Runs with the same base policy stay together, unless there are more shares than base
    policies: machines that share no folder do not train the same policy twice.
    """
    groups: dict[tuple, list[PlannedRun]] = {}
    for run, config in plan.configs.items():
        groups.setdefault(base_key(config), []).append(run)
    runs = [run for group in groups.values() for run in group]
    ends = [0, *itertools.accumulate(map(len, groups.values()))]
    cuts = [len(runs) * number / count for number in range(count + 1)]
    if count <= len(groups):
        cuts = [min(ends, key=lambda end: abs(end - cut)) for cut in cuts]
    return [
        replace(
            plan,
            configs={run: plan.configs[run] for run in runs[round(begin) : round(end)]},
            part=f"-{number}-of-{count}",
        )
        for number, (begin, end) in enumerate(itertools.pairwise(cuts), 1)
    ]


def share_of(plan: Plan, shard: str) -> Plan:
    """The share of a plan that ``--shard`` names: ``3/16`` is the third of 16.

    Raises:
        UserError: if it names none.
    """
    numbers = re.fullmatch("([1-9][0-9]{0,4})/([1-9][0-9]{0,4})", shard)
    number, count = map(int, numbers.groups()) if numbers else (1, 0)
    if number > count:
        raise UserError(f"--shard {shard} is no share; 3/16 is the third of 16")
    return shares(plan, count)[number - 1]


def _settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration as one flat table, with the options of the agent as ``agent.X``."""
    options = flat(config.get("agent_options", {}), "agent.")
    return flat({key: config[key] for key in config if key != "agent_options"}) | options


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys, other than those of BASIC, whose values differ.

    The options of an agent are compared among runs of this agent only: other agents have other
    options and other defaults. The same holds for policies.
    """
    values: dict[str, dict[Any, set[str]]] = {}
    for one in settings:
        for key, value in one.items():
            owner_key = OWNERS.get(key.partition(".")[0])
            owner = one[owner_key] if owner_key and owner_key != key else None
            values.setdefault(key, {}).setdefault(owner, set()).add(repr(value))
    told = {*BASIC, *(k for k in FOLLOWERS if all(one[k] == one["seed"] for one in settings))}
    return [
        key
        for key, by_owner in values.items()
        if key not in told and any(len(texts) > 1 for texts in by_owner.values())
    ]


def sweep_path(out: Path, suite: str) -> Path:
    """The file of a sweep."""
    return out / "sweeps" / f"{suite}.json"


def write_sweep(
    plan: Plan, workers: int, failures: Mapping[str, str], jobs: Mapping[str, str] | None = None
) -> None:
    """Write the file of a sweep atomically.

    Raises:
        UserError: if it cannot be written.
    """
    file = SweepFile(
        suite=plan.name,
        description=plan.description,
        workers=workers,
        updated=datetime.now(UTC).isoformat(timespec="seconds"),
        runs=tuple(plan.configs),
        failures=dict(failures),
        jobs=dict(jobs or {}),
    )
    write_json(plan.path, asdict(file))


def read_sweep(path: Path) -> SweepFile:
    """Read the file of a sweep.

    Raises:
        UserError: if it is none.
    """
    try:
        return TypeAdapter(SweepFile).validate_python(json.loads(path.read_text("utf-8-sig")))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not the list of a sweep; run the sweep again to replace it"
        ) from error


def title(name: str, description: str) -> str:
    """Name and description of a suite."""
    return f"{name}: {description}" if description else name
