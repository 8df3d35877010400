"""What tells runs apart: the key of their table, the recipe of their row, and their seeds."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from symsteer.leaderboard.records import (
    RunRecord,
    config_hash,
    flat,
    with_first_names,
    with_retired,
)
from symsteer.variant import UNBROKEN

SYMMETRIC_EMBODIMENT = "floating"
"""The embodiment without an arm: its states rotate with the world."""

ARM = "arm kinematics"

CELL = frozenset({"task", "embodiment", "variant", "evaluation_variant", "env_steps"})
"""Configuration keys that tell tables apart."""

MACHINE = frozenset({"device", "threads", "torch_threads", "workers", "progress", "out"})
"""Configuration keys, at any depth, that may differ between runs of one row, as seeds may."""

OPTIONS = "agent_options."
"""What the configuration keys of an agent's options begin with."""


@dataclass(frozen=True, order=True)
class Key:
    """What all runs of one table have in common."""

    task: str
    embodiment: str
    breaking: tuple[bool, str]
    """(is broken, variant): the unbroken control sorts first."""
    base: str
    group: str
    mode: str
    demonstrations: int
    env_steps: int
    settings: str = ""
    """Where learners share a grid of options (`grid_of`), their values: ``tau 0.05, utd 4.0``."""

    @property
    def variant(self) -> str:
        return self.breaking[1]

    @property
    def place(self) -> tuple[str, ...]:
        """What tables share that differ in variant, budget and number of demonstrations."""
        return self.task, self.embodiment, self.base, self.group, self.mode

    @property
    def broken_by(self) -> tuple[str, ...]:
        """What breaks the symmetry; empty for the unbroken control.

        An arm counts: unlike an arm-less gripper, its kinematics have no rotational symmetry.
        """
        arm = () if self.embodiment == SYMMETRIC_EMBODIMENT else (ARM,)
        return arm if self.variant == UNBROKEN else (*arm, self.variant)

    @classmethod
    def of(cls, record: RunRecord, grid: Sequence[str] = ()) -> Key:
        """The key of a run's table, where `grid` are the options of a grid."""
        settings, policy = record.settings, record.base_policy
        options = agent_options(record.config) if grid else {}
        return cls(
            settings.task,
            settings.embodiment,
            (settings.variant != UNBROKEN, settings.variant),
            policy.name,
            policy.group or "",
            settings.demonstrations.mode,
            settings.demonstrations.count,
            settings.env_steps,
            ", ".join(f"{name} {options[name]}" for name in grid if name in options),
        )


RowKey = tuple[Key, str, str]
"""Table, agent, recipe: what the runs of one row have in common."""


def row_key(record: RunRecord) -> RowKey:
    return Key.of(record), record.settings.agent, recipe_of(record.config)


def recipe_of(config: Mapping[str, Any]) -> str:
    """Hash of a configuration without its seeds and machine settings: what defines a row."""

    def strip(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {
                key: strip(item)
                for key, item in value.items()
                if key not in MACHINE and not _is_seed(key)
            }
        return [strip(item) for item in value] if isinstance(value, list) else value

    return config_hash(strip(with_first_names(with_retired(config))))


def seeds_of(config: Mapping[str, Any]) -> str:
    """Hash of all seeds of a configuration: what tells the runs of a row apart."""

    def keep(data: Mapping[str, Any]) -> dict[str, Any]:
        nested = {key: keep(item) for key, item in data.items() if isinstance(item, Mapping)}
        seeds = {key: item for key, item in data.items() if _is_seed(key)}
        return {key: item for key, item in nested.items() if item} | seeds

    return config_hash(keep(config))


def _is_seed(key: str) -> bool:
    return key == "seed" or key.endswith("_seed")


def setting_texts(config: Mapping[str, Any]) -> dict[str, str]:
    """All settings but those of the machine as texts, keys of nested tables joined by dots."""
    return {
        key: value if isinstance(value, str) else json.dumps(value)
        for key, value in flat(with_retired(config)).items()
        if not MACHINE.intersection(key.split("."))
    }


def agent_options(config: Mapping[str, Any]) -> dict[str, str]:
    """The options of the agent as texts."""
    texts = setting_texts(config)
    return {k.removeprefix(OPTIONS): text for k, text in texts.items() if k.startswith(OPTIONS)}


def row_settings(config: Mapping[str, Any]) -> dict[str, str]:
    """The settings that define a row as texts; those of the agent without a prefix."""
    return {
        key.removeprefix(OPTIONS): value
        for key, value in setting_texts(config).items()
        if not any(part in CELL or _is_seed(part) for part in key.split("."))
    }


def grid_of(records: Iterable[RunRecord]) -> tuple[str, ...]:
    """The options of a balanced grid, if two or more learners were all run in the same one.

    At least two options must vary. Balanced: every pair of values of two of them occurs in equally
    many of the grid's settings, as in full grids and in fractions of a resolution of III or more.
    """
    by_agent: dict[str, list[dict[str, str]]] = defaultdict(list)
    for record in records:
        if record.role != "reference":
            by_agent[record.settings.agent].append(agent_options(record.config))
    grids = set()
    for options in by_agent.values():
        names = sorted({name for texts in options for name in texts})
        varied = [name for name in names if len({texts.get(name) for texts in options}) > 1]
        settings = {tuple(texts.get(name, "unset") for name in varied) for texts in options}
        grids.add((tuple(varied), frozenset(settings)))
    if len(by_agent) < 2 or len(grids) != 1:
        return ()
    ((shared, grid),) = grids
    points = [dict(zip(shared, values, strict=True)) for values in grid]
    levels = {name: {point[name] for point in points} for name in shared}
    return shared if len(shared) > 1 and is_balanced(points, levels) else ()


def is_balanced(
    settings: Sequence[Mapping[str, str]], options: Mapping[str, Collection[str]]
) -> bool:
    """Whether every pair of values of two options occurs, and all equally often."""
    for first, second in combinations(options, 2):
        pairs = Counter((each.get(first), each.get(second)) for each in settings)
        if len(pairs) != len(options[first]) * len(options[second]):
            return False
        if len(set(pairs.values())) != 1:
            return False
    return bool(settings)
