"""What a sweep has to do: its cells, and the list of them that ``symsteer status`` reads."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from symsteer.bench.runs.config import RunConfig, flat
from symsteer.bench.runs.folder import run_id, write_json
from symsteer.bench.runs.run import check
from symsteer.bench.sweep.suite import Suite
from symsteer.errors import UserError

BASIC = ("task", "embodiment", "variant", "agent", "seed")
"""The keys of a configuration that every table and line shows."""


@dataclass(frozen=True)
class Cell:
    """What one needs to know of a run to show it and to guess how long it takes."""

    run_id: str
    task: str
    embodiment: str
    variant: str
    agent: str
    seed: int
    env_steps: int
    extra: dict[str, Any] = field(default_factory=dict, hash=False)
    """What else tells the cells of a suite apart: ``{"demonstrations.count": 5}``."""

    @classmethod
    def of(cls, config: Mapping[str, Any], name: str, extra: Iterable[str] = ()) -> Cell:
        """The cell of a configuration as nested plain data."""
        settings = flat(config)
        values = {key: config[key] for key in (*BASIC, "env_steps")}
        return cls(name, **values, extra={key: settings[key] for key in extra})

    @property
    def keys(self) -> dict[str, Any]:
        """What tells the cell apart, in the order in which it is shown."""
        return {key: getattr(self, key) for key in BASIC} | self.extra

    @property
    def label(self) -> str:
        """The cell in words."""
        extra = "".join(f" {key.rpartition('.')[2]} {value}" for key, value in self.extra.items())
        return f"{self.task} {self.embodiment} {self.variant} {self.agent}{extra} seed {self.seed}"


def short_labels(cells: Sequence[Cell], everything: bool) -> dict[Cell, str]:
    """The cells in as few words as tell them apart, agent first.

    Args:
        cells: of one sweep.
        everything: name task and variant even where all cells share them.
    """
    shared = {key for key in BASIC if len({cell.keys[key] for cell in cells}) == 1}
    shared -= {"agent", "seed"} | ({"task", "variant"} if everything else set())
    labels = {}
    for cell in cells:
        order = ("agent", "task", "embodiment", "variant")
        words = [str(cell.keys[key]) for key in order if key not in shared]
        words += [f"{key.rpartition('.')[2]}={value}" for key, value in cell.extra.items()]
        labels[cell] = f"{' '.join(words)} s{cell.seed}"
    return labels


@dataclass(frozen=True)
class Plan:
    """The cells of a suite, in its order, and the folder of their runs."""

    name: str
    description: str
    out: Path
    configs: dict[Cell, RunConfig]

    @property
    def title(self) -> str:
        """Name and description."""
        return _title(self.name, self.description)

    @property
    def cells(self) -> list[Cell]:
        """The cells, in the order of the suite."""
        return list(self.configs)


@dataclass(frozen=True)
class Manifest:
    """The resolved list of a sweep, ``OUT/sweeps/<suite>.json``."""

    suite: str
    description: str
    workers: int
    """Runs side by side; 0 if the cluster decides."""
    updated: str
    runs: tuple[Cell, ...]
    failures: dict[str, str] = field(default_factory=dict)
    """Why runs failed in the last sweep, by run id. A run whose process was killed cannot say so
    in its own record."""

    @property
    def title(self) -> str:
        """Name and description."""
        return _title(self.suite, self.description)


def make_plan(suite: Suite, out: Path, elsewhere: bool = False) -> Plan:
    """Resolve a suite, and refuse what cannot run before anything is built.

    Args:
        suite: what to run.
        out: folder of the runs.
        elsewhere: whether other machines run it, whose devices this one does not know.

    Raises:
        UserError: if a cell names what does not exist.
    """
    settings = []
    for config in suite.runs:
        try:
            check(replace(config, sim="cpu", device="cpu") if elsewhere else config)
        except UserError as error:
            raise UserError(f"{suite.name}: {error}") from error
        settings.append(flat(config.to_json()))
    extra = [
        key
        for key, value in settings[0].items()
        if key not in BASIC and any(one[key] != value for one in settings)
    ]
    cells = {Cell.of(config.to_json(), run_id(config, {}), extra): config for config in suite.runs}
    return Plan(suite.name, suite.description, out, cells)


def manifest_path(out: Path, suite: str) -> Path:
    """Where the list of a sweep lies."""
    return out / "sweeps" / f"{suite}.json"


def write_manifest(plan: Plan, workers: int, failures: Mapping[str, str]) -> None:
    """Write the list of a sweep atomically.

    Raises:
        UserError: if it cannot be written.
    """
    manifest = Manifest(
        plan.name,
        plan.description,
        workers,
        datetime.now(UTC).isoformat(timespec="seconds"),
        tuple(plan.cells),
        dict(failures),
    )
    write_json(manifest_path(plan.out, plan.name), asdict(manifest))


def read_manifest(path: Path) -> Manifest:
    """Read the list of a sweep.

    Raises:
        UserError: if the file is no such list.
    """
    try:
        return TypeAdapter(Manifest).validate_python(json.loads(path.read_text()))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not the list of a sweep; run the sweep again to write it anew"
        ) from error


def _title(name: str, description: str) -> str:
    return f"{name}: {description}" if description else name
