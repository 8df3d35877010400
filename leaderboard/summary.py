"""From records to the rows of the tables: grouping, pairing, and every number of a row."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from symsteer.errors import UserError
from symsteer.leaderboard.paper import BASE, ROW_ORDER
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import (
    ROLES,
    Divergence,
    Evaluation,
    Provenance,
    Reproduction,
    Role,
    RunRecord,
    check_reproduction,
    config_hash,
    file_hash,
    flat,
    read_record,
    read_reproductions,
    with_retired,
)
from symsteer.leaderboard.records.curves import area_under_curve
from symsteer.leaderboard.records.reproductions import Verdict
from symsteer.leaderboard.statistics import (
    Block,
    Interval,
    Sample,
    area_weights,
    censored_median,
    crossed_bootstrap,
    deepest_dip,
    paired_differences,
    steps_to_threshold,
    success_interval,
)
from symsteer.leaderboard.study import all_listed

SYMMETRIC_EMBODIMENT = "floating"
"""The embodiment without an arm: its states rotate with the world."""

ARM = "arm kinematics"

MIN_SEEDS = 5
"""Finished runs, or pairs of runs, that a rank and a verdict need."""

FINAL_WINDOW = 5
"""The final window is the last fifth of the budget."""

THRESHOLD = 0.8
"""Steps are counted until this share of the best learner's final success."""

SAME_POINT = 0.01
"""Evaluations of two runs at most this share of the budget apart belong together: a run is
evaluated after the decision that crosses the planned step, and decisions differ in length."""

MOST_SETTINGS = 3
"""Settings that the label of a row shows."""

CELL = frozenset({"task", "embodiment", "variant", "evaluation_variant", "env_steps"})
"""Configuration keys that tell tables apart."""

MACHINE = frozenset({"device", "threads", "torch_threads", "workers", "progress", "out"})
"""Configuration keys, at any depth, that may differ between runs of one row, as seeds may."""

OPTIONS = "agent_options."
"""What the configuration keys of an agent's options begin with."""


Group = tuple[str, str, bool]
"""Agent, recipe and mark: what the runs of one row have in common."""

Pair = tuple[str, int]
"""Content hash of the base policy and run seed."""


def row_place(agent: str, role: Role) -> tuple[int, int, str]:
    """Sorting key of agents: by role, then those of `ROW_ORDER`, then by name."""
    index = ROW_ORDER.index(agent) if agent in ROW_ORDER else len(ROW_ORDER)
    return ROLES.index(role), index, agent


@dataclass(frozen=True)
class Run:
    """One record and where it was read."""

    path: Path
    record: RunRecord
    reproduction: Reproduction | None = None
    """What the same run said when it was made again."""
    trusted: bool = True
    """Whether it counts: all do but submitted ones that no maintainer has reproduced."""

    @property
    def seed(self) -> int:
        return self.record.settings.seed

    @property
    def policy(self) -> str:
        """Content hash of the base policy that it steers."""
        return self.record.base_policy.content_hash

    @property
    def pair(self) -> Pair:
        """What a run of another agent must share to be paired with this one."""
        return self.policy, self.seed

    @property
    def agent(self) -> str:
        return self.record.settings.agent

    @property
    def finished(self) -> bool:
        return self.record.status == "finished"

    @property
    def provenances(self) -> list[Provenance]:
        """Where the run began and where it was continued."""
        return [self.record.provenance, *self.record.continued]

    @cached_property
    def curve(self) -> dict[int, Evaluation]:
        """Evaluations by env_steps; of two at the same step the later one counts."""
        return {evaluation.env_steps: evaluation for evaluation in self.record.evaluations}

    @property
    def is_reference(self) -> bool:
        return self.record.role == "reference"

    @cached_property
    def final_success(self) -> dict[int, float]:
        """success_once of the final evaluation by episode seed (empty before the end)."""
        return episode_success(self.record.final) if self.record.final else {}

    @cached_property
    def window(self) -> dict[tuple[int, int], float]:
        """success_once in the final window by (env_steps, episode seed); empty before the end.

        These are all evaluations in the last fifth of the budget; of a reference it is the one
        final evaluation, at any step.
        """
        final = self.record.final
        if final is None:
            return {}
        start = (FINAL_WINDOW - 1) * self.record.settings.env_steps
        inside = [
            evaluation
            for step, evaluation in self.curve.items()
            if evaluation is final or (not self.is_reference and FINAL_WINDOW * step >= start)
        ]
        return {
            (evaluation.env_steps, seed): success
            for evaluation in inside
            for seed, success in episode_success(evaluation).items()
        }

    @property
    def success(self) -> float:
        """Share of successful episodes in the final window; the run must be finished."""
        return float(np.mean(list(self.window.values())))

    @property
    def area(self) -> float:
        """Area under the success curve over the budget; the run must be finished."""
        return area_under_curve(*_points(self), self.record.settings.env_steps)

    @property
    def feasible(self) -> tuple[float, float] | None:
        """Feasible Q bounds, entropy allowance included."""
        bound = self.record.feasible_q
        if bound is None:
            return None
        allowance = max([0.0, *self.diagnostics("q_allowance")])
        return bound.low - allowance, bound.high + allowance

    @property
    def diverged(self) -> bool | None:
        """Whether Q diverged; None without a critic and while an unfinished run may still do so."""
        verdict = self.record.diverged
        return verdict if self.finished or verdict else None

    @cached_property
    def rise(self) -> dict[int, float]:
        """Success in the last fifth of the budget minus that in the fifth before it.

        By episode seed, for those that both have; empty before the end.
        """
        if not self.finished:
            return {}
        return paired_differences(self._in_fifth(FINAL_WINDOW), self._in_fifth(FINAL_WINDOW - 1))

    def _in_fifth(self, number: int) -> dict[int, float]:
        """Mean success by episode seed over the evaluations in a fifth of the budget, 1 to 5."""
        values: dict[int, list[float]] = defaultdict(list)
        for step, evaluation in self.curve.items():
            inside = 1 + FINAL_WINDOW * step // self.record.settings.env_steps
            if min(inside, FINAL_WINDOW) == number:
                for seed, success in episode_success(evaluation).items():
                    values[seed].append(success)
        return {seed: float(np.mean(successes)) for seed, successes in values.items()}

    def in_window(self, name: str) -> list[float]:
        """Finite values of a diagnostic in the evaluations of the final window."""
        start = (FINAL_WINDOW - 1) * self.record.settings.env_steps
        evaluations = [e for step, e in self.curve.items() if FINAL_WINDOW * step >= start]
        values = [evaluation.diagnostics.get(name) for evaluation in evaluations]
        return [value for value in values if value is not None]

    def diagnostics(self, name: str) -> list[float]:
        """All finite values of a diagnostic, in the order of the evaluations."""
        values = (e.diagnostics.get(name) for e in self.record.evaluations)
        return [value for value in values if value is not None]

    def last(self, *names: str) -> float | None:
        """The final evaluation's value of the first of `names` that was measured."""
        final = self.record.final
        values = [final.diagnostics.get(name) for name in names] if final else []
        return next((value for value in values if value is not None), None)


def episode_success(evaluation: Evaluation) -> dict[int, float]:
    """success_once by episode seed."""
    columns = evaluation.episodes
    return dict(zip(columns.seed, map(float, columns.success_once), strict=True))


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
        return arm if self.variant == "none" else (*arm, self.variant)

    @classmethod
    def of(cls, record: RunRecord, grid: Sequence[str] = ()) -> Key:
        """The key of a run's table, where `grid` are the options of a grid."""
        settings, policy = record.settings, record.base_policy
        options = agent_options(record.config) if grid else {}
        return cls(
            settings.task,
            settings.embodiment,
            (settings.variant != "none", settings.variant),
            policy.name,
            policy.group or "",
            settings.demonstrations.mode,
            settings.demonstrations.count,
            settings.env_steps,
            ", ".join(f"{name} {options[name]}" for name in grid if name in options),
        )


@dataclass
class Row:
    """An agent (one recipe of it) in one table."""

    agent: str
    role: Role
    recipe: str
    runs: list[Run]
    missing: int = 0
    marked: bool = False
    """Whether its runs are submitted ones that no maintainer has reproduced."""
    label: str = ""
    usual: bool = False
    """Whether most runs of the agent, in all tables, have the settings of this row."""
    success: Interval | None = None
    last: Interval | None = None
    difference: Interval | None = None
    against_best: Interval | None = None
    pairs_with_best: int = 0
    rise: Interval | None = None
    area: float | None = None
    threshold_steps: list[int | None] = field(default_factory=list)
    dip: float | None = None
    rank: int | None = None

    @property
    def finished(self) -> list[Run]:
        return [run for run in self.runs if run.finished]

    @property
    def is_reference(self) -> bool:
        """Whether it is compared with and never ranked."""
        return self.role == "reference"

    @property
    def episodes(self) -> list[int]:
        """Episodes in the final window of each finished run."""
        return [len(run.window) for run in self.finished]

    @property
    def search_steps(self) -> float | None:
        """Mean environment steps that a reference spent on search; None if it spent none."""
        if not self.is_reference or not self.finished:
            return None
        return float(np.mean([run.record.budget.env_steps for run in self.finished])) or None

    @property
    def median_threshold_steps(self) -> float | None:
        return censored_median(self.threshold_steps) if self.threshold_steps else None

    @property
    def divergences(self) -> list[Divergence]:
        """How far Q left what is feasible, for every run with a critic, finished or not."""
        return [found for run in self.runs if (found := run.record.divergence)]

    @property
    def diverged(self) -> list[bool]:
        """Whether Q diverged, for the same runs."""
        return [found.diverged for found in self.divergences]

    @property
    def reproductions(self) -> Counter[Verdict]:
        """Of its runs that were made again: how many for each verdict."""
        return Counter(run.reproduction.verdict for run in self.runs if run.reproduction)

    def over_runs(self, *names: str) -> float | None:
        """Mean over finished runs of a diagnostic's final value."""
        values = [value for run in self.finished if (value := run.last(*names)) is not None]
        return float(np.mean(values)) if values else None

    def largest(self, name: str) -> float | None:
        """Largest value of a part of `Divergence` over the runs that have it."""
        values = [getattr(found, name) for found in self.divergences]
        return max((value for value in values if value is not None), default=None)


@dataclass
class Table:
    """All rows of one task, embodiment, variant and base policy; marked ones come last."""

    key: Key
    rows: list[Row]
    threshold: float | None = None
    best_reference: Row | None = None

    @property
    def trusted(self) -> list[Row]:
        """The rows that are not marked: all that is concluded is about them."""
        return [row for row in self.rows if not row.marked]

    @property
    def learners(self) -> list[Row]:
        """Trusted rows with finished runs of agents that are no references."""
        return [row for row in self.trusted if row.finished and not row.is_reference]

    def row_of(self, agent: str) -> Row | None:
        """The agent's trusted row with its usual settings, else that with the most finished runs.

        None if the agent finished none.
        """
        rows = [row for row in self.trusted if row.agent == agent and row.finished]
        return max(rows, key=lambda row: (row.usual, len(row.finished)), default=None)

    @property
    def runs(self) -> list[Run]:
        return [run for row in self.rows for run in row.runs]

    @property
    def counted(self) -> list[Run]:
        """The runs of trusted rows, or all where there are none."""
        return [run for row in self.trusted for run in row.runs] or self.runs

    @property
    def feasible(self) -> tuple[float, float] | None:
        """The widest feasible Q bounds of the runs, entropy allowance included."""
        bounds = [found for run in self.counted if (found := run.feasible)]
        return (min(low for low, _ in bounds), max(h for _, h in bounds)) if bounds else None

    @property
    def is_ranked(self) -> bool:
        return any(row.rank is not None for row in self.rows)


@dataclass
class Summary:
    """Everything that the page shows."""

    tables: list[Table]
    set_aside: list[Run]
    """Older or unfinished records of a configuration, seed and base policy with a better one."""

    @property
    def runs(self) -> list[Run]:
        return [run for table in self.tables for run in table.runs]

    @cached_property
    def usual_budget(self) -> int:
        """The budget of most tables."""
        budgets = Counter(table.key.env_steps for table in self._trusted_tables)
        return max(budgets, key=lambda steps: (budgets[steps], steps), default=0)

    @property
    def _trusted_tables(self) -> list[Table]:
        return [table for table in self.tables if any(row.runs for row in table.trusted)]

    @cached_property
    def _demonstrations(self) -> dict[tuple[str, ...], int]:
        """The largest number of demonstrations of each place."""
        # Of each place the largest comes last, and counts.
        return dict(sorted((t.key.place, t.key.demonstrations) for t in self._trusted_tables))

    def has_few_demonstrations(self, key: Key) -> bool:
        """Whether other tables of the same place have more."""
        return key.demonstrations < self._demonstrations.get(key.place, 0)

    @cached_property
    def usual_tables(self) -> list[Table]:
        """Those with the budget of most, and the most demonstrations of their place."""
        return [
            table
            for table in self.tables
            if table.key.env_steps == self.usual_budget
            and not self.has_few_demonstrations(table.key)
        ]

    @property
    def has_reproductions(self) -> bool:
        """Whether any of the runs was made again."""
        return any(run.reproduction for run in self.runs)

    @property
    def has_marks(self) -> bool:
        """Whether any row is marked."""
        return any(row.marked for table in self.tables for row in table.rows)

    @property
    def roles(self) -> dict[str, Role]:
        """Role by agent, in the order of the rows."""
        roles = {row.agent: row.role for table in self.tables for row in table.rows}
        return dict(sorted(roles.items(), key=lambda item: row_place(*item)))

    @property
    def agents(self) -> list[str]:
        return list(self.roles)


def load_runs(
    paths: Iterable[Path], reproductions: Path | None = None, listed: Collection[str] | None = None
) -> list[Run]:
    """Read the records that `paths` name: files, run folders, folders of either.

    `record_files` says which files those are. Raises UserError for a path that names none, for a
    file that is not a valid record, and for a reproduction that does not say what its records say.

    Args:
        paths: of the records.
        reproductions: folder of their reproductions (`read_reproductions`).
        listed: hashes of the records and reproductions that are the study's own (`Study.listed`).
            Others are submitted. A submitted run is trusted if one of its row was reproduced by a
            listed reproduction. None: nothing is known, and all are trusted.
    """
    known = read_reproductions(reproductions) if reproductions else {}
    vouched = all_listed() if listed is None and known else listed or ()
    runs = []
    for file in record_files(paths):
        record, digest = read_record(file), file_hash(file)
        runs.append(Run(file, record, known.get(digest), listed is None or digest in listed))
        if reproductions and digest in known:
            path = reproductions / f"{digest}.json"
            counts = file_hash(path) in vouched, listed is None
            check_reproduction(known[digest], path, file, *counts)
    confirmed = {
        row_key(run.record)
        for run in runs
        if not run.trusted and run.reproduction and run.reproduction.verdict != "different"
    }
    runs = [replace(r, trusted=r.trusted or row_key(r.record) in confirmed) for r in runs]
    used = {run.reproduction.record.sha256 for run in runs if run.reproduction}
    present = {run.record.run_id for run in runs}
    for digest in sorted(known.keys() - used):
        if (name := known[digest].record.run_id) in present:
            raise UserError(
                f"{reproductions}/{digest}.json is about a record of {name} that has changed since "
                "then: make it again with `symsteer reproduce`, or remove the file"
            )
    return runs


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

    return config_hash(strip(with_retired(config)))


def seeds_of(config: Mapping[str, Any]) -> str:
    """Hash of all seeds of a configuration: what tells the runs of a row apart."""

    def keep(data: Mapping[str, Any]) -> dict[str, Any]:
        nested = {key: keep(item) for key, item in data.items() if isinstance(item, Mapping)}
        own = {key: item for key, item in data.items() if _is_seed(key)}
        return {key: item for key, item in nested.items() if item} | own

    return config_hash(keep(config))


def _is_seed(key: str) -> bool:
    return key == "seed" or key.endswith("_seed")


def summarize(runs: Sequence[Run]) -> Summary:
    """Group runs into tables and compute every row; independent of the order of `runs`."""
    tables, set_aside = grouped(runs)
    for table in tables:
        _complete(table)
    return Summary(tables, set_aside)


def grouped(
    runs: Sequence[Run], grid: Sequence[str] | None = None
) -> tuple[list[Table], list[Run]]:
    """Tables whose rows have runs and names but no numbers yet, and the runs that are set aside.

    Args:
        runs: the runs.
        grid: the options of a grid; None finds them in the runs.
    """
    chosen, set_aside = _one_per_cell(runs)
    trusted = [run for run in chosen if run.trusted] or chosen
    grid = grid_of(trusted) if grid is None else grid
    tables: dict[Key, dict[Group, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in chosen:
        _, agent, recipe = row_key(run.record)
        tables[Key.of(run.record, grid)][agent, recipe, not run.trusted].append(run)
    # An agent has one role: that of its newest trusted run.
    by_age = sorted(chosen, key=lambda run: (run.trusted, run.record.started, run.record.run_id))
    roles = {run.agent: run.record.role for run in by_age}
    usual = _usual_settings(trusted)
    return [_table(key, rows, roles, usual) for key, rows in sorted(tables.items())], set_aside


def grid_of(runs: Iterable[Run]) -> tuple[str, ...]:
    """The options of a balanced grid, if two or more learners were all run in the same one.

    At least two options must vary. Balanced: every pair of values of two of them occurs in equally
    many of the grid's settings, as in full grids and in fractions of a resolution of III or more.
    """
    options: dict[str, list[dict[str, str]]] = defaultdict(list)
    for run in runs:
        if not run.is_reference:
            options[run.agent].append(agent_options(run.record.config))
    grids = set()
    for own in options.values():
        names = sorted({name for texts in own for name in texts})
        varied = [name for name in names if len({texts.get(name) for texts in own}) > 1]
        settings = {tuple(texts.get(name, "unset") for name in varied) for texts in own}
        grids.add((tuple(varied), frozenset(settings)))
    if len(options) < 2 or len(grids) != 1:
        return ()
    ((shared, found),) = grids
    points = [dict(zip(shared, values, strict=True)) for values in found]
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


def _usual_settings(runs: Iterable[Run]) -> dict[str, dict[str, str]]:
    """The settings with which most runs of an agent were made, over all tables; if there is one."""
    counts: dict[str, Counter[tuple[tuple[str, str], ...]]] = defaultdict(Counter)
    for run in runs:
        counts[run.agent][tuple(sorted(_settings(run.record.config).items()))] += 1
    usual = {}
    for agent, counter in counts.items():
        (first, number), *others = counter.most_common(2)
        if not others or others[0][1] < number:
            usual[agent] = dict(first)
    return usual


def _one_per_cell(runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """Keep the newest finished record of each configuration, seed and base policy.

    The others are set aside. A base policy that is trained again with its seed on another kind of
    processor differs, and runs are compared only on the same one: so both count.
    """
    cells: dict[tuple[Any, ...], list[Run]] = defaultdict(list)
    for run in runs:
        seeds = seeds_of(run.record.config)
        cells[*row_key(run.record), seeds, run.policy, not run.trusted].append(run)
    chosen, set_aside = [], []
    for cell in sorted(cells):
        candidates = sorted(
            cells[cell],
            key=lambda run: (run.finished, run.record.started, run.record.run_id, str(run.path)),
        )
        best = candidates[-1]
        chosen.append(best)
        # The same record found twice (a run folder and its committed copy) is no second attempt.
        set_aside += [run for run in candidates[:-1] if run.record != best.record]
    return chosen, set_aside


def _table(
    key: Key,
    groups: Mapping[Group, list[Run]],
    roles: Mapping[str, Role],
    usual: Mapping[str, Mapping[str, str]],
) -> Table:
    seeds = {run.seed for (*_, marked), runs in groups.items() for run in runs if not marked}
    rows = []
    for (agent, recipe, marked), runs in groups.items():
        have = {run.seed for run in runs}
        runs = sorted(runs, key=lambda run: run.seed)
        rows.append(Row(agent, roles[agent], recipe, runs, len(seeds - have), marked))
    for agent in roles.keys() - {agent for agent, *_ in groups}:
        rows.append(Row(agent, roles[agent], "", [], len(seeds)))
    for agent, marked in {(row.agent, row.marked) for row in rows}:
        twins = [row for row in rows if (row.agent, row.marked) == (agent, marked)]
        _label(twins, usual.get(agent))
    rows.sort(key=lambda r: (r.marked, row_place(r.agent, r.role), not r.usual, r.label))
    return Table(key, rows)


def _complete(table: Table) -> None:
    rows = table.trusted
    for row in table.rows:
        _fill(row)
    table.threshold = _threshold(rows)
    base = table.row_of(BASE)
    for row in table.rows:
        if base and row.agent != BASE:
            _against_base(row, base)
        if table.threshold is not None and not row.is_reference:
            points = map(_points, row.finished)
            row.threshold_steps = [steps_to_threshold(*own, table.threshold) for own in points]
    references = [row for row in rows if row.is_reference and row.success]
    table.best_reference = max(
        references, key=lambda row: row.success.value if row.success else 0.0, default=None
    )
    if table.best_reference:
        for row in table.learners:
            pairs = success_pairs(row, table.best_reference)
            row.pairs_with_best = len(pairs)
            row.against_best = crossed_bootstrap(list(pairs.values())) if pairs else None
    _rank(rows)


def _label(twins: Sequence[Row], common: Mapping[str, str] | None) -> None:
    """Name the rows of one agent; of several, by the settings in which they differ from the usual.

    Usual are those with which most runs of the agent were made in all tables, or if no row has
    them, of each setting the value that most rows have.

    Args:
        twins: the rows.
        common: settings of most runs.
    """
    settings = [_settings(row.runs[0].record.config) if row.runs else {} for row in twins]
    keys = sorted({key for config in settings for key in config})
    usual: dict[str, str | None] = {}
    for key in keys:
        (first, number), *others = Counter(c.get(key, "unset") for c in settings).most_common(2)
        usual[key] = None if others and others[0][1] == number else first
    if common in settings:
        usual = {key: common.get(key, "unset") for key in keys}
    for row, own in zip(twins, settings, strict=True):
        row.usual = own == common
        values = {key: own.get(key, "unset") for key in usual}
        texts = [f"{key} {value}" for key, value in values.items() if value != usual[key]]
        if len(texts) > MOST_SETTINGS:
            texts = [f"{len(texts)} other settings", row.recipe[:6]]
        texts += ["not reproduced"] * row.marked
        row.label = row.agent + (f" ({', '.join(texts)})" if texts else "")


def _settings(config: Mapping[str, Any]) -> dict[str, str]:
    """The settings that define a row as texts; those of the agent without a prefix."""
    return {
        key.removeprefix(OPTIONS): value
        for key, value in setting_texts(config).items()
        if not any(part in CELL or _is_seed(part) for part in key.split("."))
    }


def agent_options(config: Mapping[str, Any]) -> dict[str, str]:
    """The options of the agent as texts."""
    texts = setting_texts(config)
    return {k.removeprefix(OPTIONS): text for k, text in texts.items() if k.startswith(OPTIONS)}


def setting_texts(config: Mapping[str, Any]) -> dict[str, str]:
    """All settings but those of the machine as texts, keys of nested tables joined by dots."""
    return {
        key: value if isinstance(value, str) else json.dumps(value)
        for key, value in flat(with_retired(config)).items()
        if not MACHINE.intersection(key.split("."))
    }


def _points(run: Run) -> tuple[list[int], list[float]]:
    return list(run.curve), [evaluation.success_once for evaluation in run.curve.values()]


def _fill(row: Row) -> None:
    """Compute the numbers of a row that need no other row."""
    if not row.finished:
        return
    row.success = success_interval([success_sample(run) for run in row.finished])
    finals = [Sample.pooled(run.final_success.items(), run.policy) for run in row.finished]
    row.last = success_interval(finals)
    rising = [run for run in row.finished if run.rise and not row.is_reference]
    rises = [Sample.pooled(run.rise.items(), run.policy) for run in rising]
    row.rise = crossed_bootstrap(rises) if rises else None
    if row.search_steps is None:
        row.area = float(np.mean([run.area for run in row.finished]))


def success_sample(run: Run) -> Sample:
    """Success in the final window of a finished run."""
    return _pooled(run.window, run)


def _pooled(window: Mapping[tuple[int, int], float], run: Run) -> Sample:
    """Values by (env_steps, episode seed) as one block."""
    return Sample.pooled(((seed, value) for (_, seed), value in window.items()), run.policy)


def _threshold(rows: Sequence[Row]) -> float | None:
    finals = [row.success.value for row in rows if row.success and row.role == "learner"]
    return THRESHOLD * max(finals) if finals else None


def _against_base(row: Row, base: Row) -> None:
    row.difference = compare(row, base)
    if row.is_reference:
        return
    dips = []
    for run in row.finished:
        reference = reference_success(run, base.finished)
        found = (paired_differences(episode_success(e), reference) for e in run.curve.values())
        if below := [float(np.mean(list(values.values()))) for values in found if values]:
            dips.append(deepest_dip(below))
    row.dip = min(dips, default=None)


def reference_success(run: Run, references: Sequence[Run]) -> dict[int, float]:
    """Success of a reference on the base policy that `run` steers, by episode seed.

    Taken from the reference's run with the same policy (content hash) and the same run seed, else
    from the mean of all its runs with that policy; empty if there is none.
    """
    same = [reference for reference in references if reference.policy == run.policy]
    same = [reference for reference in same if reference.seed == run.seed] or same
    values: dict[int, list[float]] = defaultdict(list)
    for reference in same:
        for seed, success in reference.final_success.items():
            values[seed].append(success)
    return {seed: float(np.mean(successes)) for seed, successes in values.items()}


def success_pairs(first: Row, second: Row) -> dict[Pair, Sample]:
    """Differences of final-window success, first minus second, by pair of runs.

    Two learners are paired by run seed on the same base policy, then by evaluation (`aligned`) and
    episode seed; with a reference, which is evaluated once, the episode seed alone pairs
    (`reference_success`).
    """
    if first.is_reference and not second.is_reference:
        reverse = success_pairs(second, first)
        return {pair: sample.negated() for pair, sample in reverse.items()}
    pairs = {}
    for run in first.finished:
        if second.is_reference:
            reference = reference_success(run, second.finished)
            other = {key: reference[key[1]] for key in run.window if key[1] in reference}
        else:
            partner = _partner(run, second)
            points = aligned(run, partner) if partner else {}
            other = {
                (step, seed): partner.window[points[step], seed]
                for step, seed in run.window
                if partner and (points.get(step), seed) in partner.window
            }
        if differences := paired_differences(run.window, other):
            pairs[run.pair] = _pooled(differences, run)
    return pairs


def area_pairs(first: Row, second: Row, budget: int) -> dict[Pair, Sample]:
    """Differences of the area under the curve, first minus second, by pair of runs.

    Over the evaluations that both runs have (`aligned`), on the episodes that both have there.
    """
    twins = [(run, twin) for run in first.finished if (twin := _partner(run, second))]
    found = {run.pair: area_difference(run, twin, budget) for run, twin in twins}
    return {pair: sample for pair, sample in found.items() if sample}


def area_difference(run: Run, partner: Run, budget: int) -> Sample | None:
    """Difference of the area under the curve, first minus second; None without a common episode."""
    blocks: dict[int, Block] = {}
    for step, twin in aligned(run, partner).items():
        mine, theirs = run.curve[step], partner.curve[twin]
        if found := paired_differences(episode_success(mine), episode_success(theirs)):
            blocks[step] = Sample.pooled(found.items()).blocks[0]
    if not blocks:
        return None
    return Sample(tuple(blocks.values()), area_weights(list(blocks), budget), run.policy)


def aligned(run: Run, other: Run) -> dict[int, int]:
    """env_steps of `run`'s evaluations -> of those of `other` that belong to them.

    That is the nearest one, if it is at most `SAME_POINT` of the budget away.
    """
    reach = SAME_POINT * run.record.settings.env_steps
    found = {}
    for step in run.curve:
        twin = min(other.curve, key=lambda there: (abs(there - step), there), default=None)
        if twin is not None and abs(twin - step) <= reach:
            found[step] = twin
    return found


def _partner(run: Run, row: Row) -> Run | None:
    """The row's run with the same seed on the same base policy: on another one, success differs."""
    return next((other for other in row.finished if other.pair == run.pair), None)


def compare(first: Row, second: Row) -> Interval | None:
    """Paired difference of final-window success; None without common episodes."""
    pairs = success_pairs(first, second)
    return crossed_bootstrap(list(pairs.values())) if pairs else None


def _rank(rows: Sequence[Row]) -> None:
    """Rank learners: 1 + the number of learners that are clearly better.

    Two rows are compared if they have `MIN_SEEDS` pairs of runs, with the same seed on the same
    base policy; a row that can be compared with no other one gets no rank.
    """
    for first, second in combinations([row for row in rows if row.role == "learner"], 2):
        pairs = success_pairs(first, second)
        if len(pairs) < MIN_SEEDS:
            continue
        found = crossed_bootstrap(list(pairs.values()))
        first.rank, second.rank = first.rank or 1, second.rank or 1
        if found.sign:
            worse = second if found.sign > 0 else first
            worse.rank = (worse.rank or 1) + 1
