"""From runs to tables: which runs count, which rows they form, and how the rows are called."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from symsteer.leaderboard.keys import Key, grid_of, row_key, row_settings, seeds_of
from symsteer.leaderboard.known_agents import row_place
from symsteer.leaderboard.records import Role
from symsteer.leaderboard.rows import AgentRow, Table
from symsteer.leaderboard.runs import Run

MOST_SETTINGS = 3
"""Settings that the label of a row shows."""

RowGroup = tuple[str, str, bool]
"""Agent, recipe and mark: what the runs of one row have in common."""


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
    if grid is None:
        grid = grid_of(run.record for run in trusted)
    tables: dict[Key, dict[RowGroup, list[Run]]] = defaultdict(lambda: defaultdict(list))
    for run in chosen:
        _, agent, recipe = row_key(run.record)
        tables[Key.of(run.record, grid)][agent, recipe, not run.trusted].append(run)
    # An agent has one role: that of its newest trusted run.
    by_age = sorted(chosen, key=lambda run: (run.trusted, run.record.started, run.record.run_id))
    roles = {run.agent: run.record.role for run in by_age}
    usual = _usual_settings(trusted)
    return [_table(key, rows, roles, usual) for key, rows in sorted(tables.items())], set_aside


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


def _usual_settings(runs: Iterable[Run]) -> dict[str, dict[str, str]]:
    """The settings with which most runs of an agent were made, over all tables; if there is one."""
    counts: dict[str, Counter[tuple[tuple[str, str], ...]]] = defaultdict(Counter)
    for run in runs:
        counts[run.agent][tuple(sorted(row_settings(run.record.config).items()))] += 1
    modes = {agent: _mode(counter) for agent, counter in counts.items()}
    return {agent: dict(settings) for agent, settings in modes.items() if settings is not None}


def _mode(counter: Counter[Any]) -> Any:
    """What is most frequent; None if two are equally so."""
    (first, number), *others = counter.most_common(2)
    return None if others and others[0][1] == number else first


def _table(
    key: Key,
    groups: Mapping[RowGroup, list[Run]],
    roles: Mapping[str, Role],
    usual: Mapping[str, Mapping[str, str]],
) -> Table:
    seeds = {run.seed for (*_, marked), runs in groups.items() for run in runs if not marked}
    rows = []
    for (agent, recipe, marked), runs in groups.items():
        missing = len(seeds - {run.seed for run in runs})
        runs = sorted(runs, key=lambda run: run.seed)
        rows.append(AgentRow(agent, roles[agent], recipe, runs, missing, marked))
    for agent in roles.keys() - {agent for agent, *_ in groups}:
        rows.append(AgentRow(agent, roles[agent], "", [], len(seeds)))
    for agent, marked in {(row.agent, row.marked) for row in rows}:
        twins = [row for row in rows if (row.agent, row.marked) == (agent, marked)]
        _label(twins, usual.get(agent))
    rows.sort(key=lambda r: (r.marked, row_place(r.agent, r.role), not r.usual, r.label))
    return Table(key, rows)


def _label(twins: Sequence[AgentRow], common: Mapping[str, str] | None) -> None:
    """Name the rows of one agent; of several, by the settings in which they differ from the usual.

    Usual are those with which most runs of the agent were made in all tables, or if no row has
    them, of each setting the value that most rows have.

    Args:
        twins: the rows.
        common: settings of most runs.
    """
    settings = [row_settings(row.runs[0].record.config) if row.runs else {} for row in twins]
    names = sorted({name for each in settings for name in each})
    if common is not None and common in settings:
        usual = {name: common.get(name, "unset") for name in names}
    else:
        usual = {n: _mode(Counter(each.get(n, "unset") for each in settings)) for n in names}
    for row, texts_of in zip(twins, settings, strict=True):
        row.usual = texts_of == common
        values = {name: texts_of.get(name, "unset") for name in names}
        texts = [f"{name} {value}" for name, value in values.items() if value != usual[name]]
        if len(texts) > MOST_SETTINGS:
            texts = [f"{len(texts)} other settings", row.recipe[:6]]
        texts += ["not reproduced"] * row.marked
        row.label = row.agent + (f" ({', '.join(texts)})" if texts else "")
