"""A comparison as text for a terminal, and as data for JSON.

Records and file names may hold any text. In the terminal it is shown on one line and without
control characters (`shown`); JSON escapes it.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from symsteer.leaderboard.cell_names import told_apart
from symsteer.leaderboard.compare.changes import (
    DECISIVE,
    Change,
    Changes,
    Measure,
    PairedCell,
)
from symsteer.leaderboard.compare.sides import Leftover, Side, code_of
from symsteer.leaderboard.rows import MIN_SEEDS
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.text import MARKS, SPACE, compact, interval, number
from symsteer.tables import aligned
from symsteer.terminal import printable

WIDTH = 100
"""Characters of a line."""
NAME_WIDTH = 60
MOST_REASONS = 3
MOST_CODES = 3

LABELS: dict[Measure, str] = {"success": "success", "auc": "AUC", "q_bias": "|Q bias|"}
FEW = "*"


def to_text(a: Side, b: Side, changes: Changes) -> str:
    """What a terminal shows; sentences are folded to lines of at most `WIDTH` characters."""
    identical = changes.verdict == "identical"
    minutes = " (A), ".join(number(seconds / 60, 1) for seconds in changes.seconds)
    return "\n\n".join(
        [
            _lines([_side("A", a), _side("B", b)]),
            _lines([*_agreement(changes), *_notes(changes), *_alone(changes)]),
            f"minutes a run: {minutes} (B)" if identical else _table(changes),
            _lines([f"verdict: {verdict_text(changes)}"]),
        ]
    )


def verdict_text(changes: Changes) -> str:
    """The verdict in one or two sentences."""
    counted = {LABELS[name]: difference for name, difference in changes.decisive.items()}
    margin = f", by more than the margin of {changes.margin:g}" if changes.margin else ""
    if changes.verdict == "identical":
        return "identical"
    if changes.verdict == "none":
        most = max(len(cell.pairs) for cell in changes.cells)
        return (
            f"none. A verdict needs {MIN_SEEDS} pairs in a cell, for example five seeds; the most "
            f"here is {most}."
        )
    if changes.verdict == "worse":
        bad = {name: change for name, change in counted.items() if change.high < -changes.margin}
        return f"B is clearly worse{margin}: {_listed(bad)}."
    if changes.verdict == "better":
        text = f"B is clearly better: {_listed({n: i for n, i in counted.items() if i.low > 0})}."
    else:
        text = f"B is not clearly worse{margin}."
    losses = [f"{number(-change.low, 3)} in {n}" for n, change in counted.items() if change.low < 0]
    return text + f" It may lose up to {' and '.join(losses)}." * bool(losses)


def to_data(a: Side, b: Side, changes: Changes) -> dict[str, Any]:
    """The same, and every pair, as plain data."""
    return {
        "a": _side_data(a, changes.alone[0]),
        "b": _side_data(b, changes.alone[1]),
        "verdict": changes.verdict,
        "margin": changes.margin,
        "pairs": len(changes.pairs),
        "same_episodes": sum(pair.same_episodes for pair in changes.pairs),
        "same_diagnostics": sum(pair.same_diagnostics for pair in changes.pairs),
        "only_a_has": list(changes.one_sided[0]),
        "only_b_has": list(changes.one_sided[1]),
        "changed_options": list(changes.changed),
        "overall": _measures_data(changes.overall, changes.seconds),
        "cells": [
            {
                "task": cell.key.task,
                "embodiment": cell.key.embodiment,
                "variant": cell.key.variant,
                "base_policy": f"{cell.key.base} {cell.key.group}".strip(),
                "demonstrations": {"mode": cell.key.mode, "count": cell.key.demonstrations},
                "env_steps": cell.key.env_steps,
                "agent": cell.label or None,
                "measures": _measures_data(cell.measures, cell.seconds),
                "pairs": [
                    {
                        "a": str(pair.a.path),
                        "b": str(pair.b.path),
                        "base_policy": pair.a.policy,
                        "seed": pair.a.seed,
                        "same_episodes": pair.same_episodes,
                        "same_diagnostics": pair.same_diagnostics,
                    }
                    for pair in cell.pairs
                ],
            }
            for cell in changes.cells
        ],
    }


def cell_names(cells: Sequence[PairedCell]) -> list[str]:
    """Task, embodiment and variant of each cell, and what else tells it from the other cells."""
    names = []
    for key, label in ((cell.key, cell.label) for cell in cells):
        apart = told_apart(key, [cell.key for cell in cells])
        words = [f"{text} {name}" for name, text in apart.items()]
        words = [key.task, key.embodiment, key.variant, label, *words, key.settings]
        names.append(" ".join(filter(None, words)).replace(SPACE, " "))
    return names


def shown(text: str, limit: int = 80) -> str:
    """Text from a record, a file name or the command line on one line, without control
    characters."""
    clean = " ".join(printable(text).split())
    return clean if len(clean) <= limit else f"{clean[: limit - 1]}…"


def _lines(texts: Sequence[str]) -> str:
    """Paragraphs, folded; those that begin with spaces keep them on further lines."""
    return "\n".join(
        textwrap.fill(
            text,
            WIDTH,
            subsequent_indent=" " * (len(text) - len(text.lstrip()) + 3),
            break_on_hyphens=False,
        )
        for text in texts
    )


def _side(letter: str, side: Side) -> str:
    """How a name was read, and what it holds."""
    name, runs = shown(side.name, 300), side.runs
    read = {"folder": f"the folder {name}", "file": f"the record {name}"}.get(
        side.kind, f"the {side.kind} {name} in {shown(str(side.place), 300)}"
    )
    agents = ", ".join(sorted({shown(run.agent, 40) for run in runs}))
    of = "" if side.kind == "agent" else f" of {shown(agents, 200)}"
    count = _some(len(runs) + len(side.leftovers), "run")
    count = f"{len(runs)} of {count}" if side.leftovers else count
    codes = sorted(
        {
            (code_of(run)[:8] or "unknown") + " with changes" * bool(run.record.provenance.dirty)
            for run in runs
        }
    )
    more = len(codes) - MOST_CODES
    code = ", ".join(codes[:MOST_CODES]) + f" and {more} more" * (more > 0)
    return f"{letter}: {read}: {count}{of}; code {code}"


def _agreement(changes: Changes) -> list[str]:
    pairs = changes.pairs
    same = sum(pair.same_episodes for pair in pairs)
    deep = sum(pair.same_episodes and pair.same_diagnostics for pair in pairs)
    policies = len({pair.a.policy for pair in pairs})
    total = f"{_some(len(pairs), 'pair')} in {_some(len(changes.cells), 'cell')}, on "
    total += f"{policies} base {'policy' if policies == 1 else 'policies'}."
    if same < len(pairs):
        return [f"{total} Identical bit for bit: {same} of {len(pairs)}."]
    diagnostics = "and in all diagnostics" if deep == same else "but not in all diagnostics"
    return [
        f"IDENTICAL: all pairs agree bit for bit in every episode of every evaluation, "
        f"{diagnostics}.",
        total,
    ]


def _notes(changes: Changes) -> list[str]:
    notes = [
        f"Settings that only {letter} has, which do not count: {shown(', '.join(keys), 200)}."
        for letter, keys in zip("AB", changes.one_sided, strict=True)
        if keys
    ]
    if changed := changes.changed:
        notes.append(f"Options that differ (A -> B): {shown(', '.join(changed), 300)}.")
    return notes


def _alone(changes: Changes) -> list[str]:
    """How many runs have no partner, and the most frequent reasons with an example each."""
    alone_a, alone_b = changes.alone
    if not alone_a and not alone_b:
        return ["Every run has a partner."]
    lines = [f"Without a partner: {_some(len(alone_a), 'run')} of A, {len(alone_b)} of B."]
    for letter, alone in zip("AB", changes.alone, strict=True):
        by_reason: dict[str, list[Leftover]] = defaultdict(list)
        for leftover in alone:
            by_reason[leftover.reason].append(leftover)
        groups = sorted(by_reason.items(), key=lambda item: -len(item[1]))
        for reason, runs in groups[:MOST_REASONS]:
            example = shown(runs[0].run.record.run_id)
            lines.append(f"  {len(runs)} of {letter}: {shown(reason)}, such as {example}")
        if others := sum(len(runs) for _, runs in groups[MOST_REASONS:]):
            lines.append(f"  {others} of {letter}: other reasons (--json has all)")
    return lines


def _table(changes: Changes) -> str:
    """By measure a row for the mean over cells, and one for each cell that is not identical."""
    names = [shown(name, NAME_WIDTH) for name in cell_names(changes.cells)]
    listed = [
        (name, cell.measures, cell.seconds, len(cell.pairs))
        for name, cell in zip(names, changes.cells, strict=True)
        if not cell.is_identical
    ]
    if len(changes.cells) > 1:
        every = len(changes.pairs)
        listed.insert(0, ("mean over cells", changes.overall, changes.seconds, every))
    rows = []
    for measure, label in LABELS.items():
        for name, measures, _, _ in listed:
            if change := measures.get(measure):
                few = "" if change.counts else FEW
                a, b = (_value(measure, value) for value in (change.a, change.b))
                rows.append(
                    [label, name, f"{change.pairs}{few}", a, b, _difference(measure, change)]
                )
                label = ""
    label = "minutes a run"
    for name, _, seconds, pairs in listed:
        rows.append([label, name, str(pairs), *(number(s / 60, 1) for s in seconds), ""])
        label = ""
    header = ("", "", "pairs", "A", "B", "B - A, 95 % interval")
    lines = [aligned(header, rows, left=2)]
    if any(row[2].endswith(FEW) for row in rows):
        lines.append(f"{FEW} fewer than {MIN_SEEDS} pairs: not in the mean if any cell has enough")
    if same := sum(cell.is_identical for cell in changes.cells):
        lines.append(f"not listed: {_some(same, 'identical cell')}")
    return "\n".join(lines)


def _value(measure: Measure, value: float) -> str:
    return number(value) if measure in DECISIVE else compact(value)


def _difference(measure: Measure, change: Change) -> str:
    """The difference with its interval; what decides has a mark where it excludes 0."""
    difference = change.difference
    if measure in DECISIVE:
        return _interval(difference) + (MARKS[difference.sign] if change.counts else "")
    value, low, high = (compact(v) for v in (difference.value, difference.low, difference.high))
    # Of one run, or of runs that agree, there is no spread to take an interval from.
    return f"{'+' * (difference.value > 0)}{value}" + f" [{low}, {high}]" * (low != high)


def _interval(difference: Interval) -> str:
    return interval(difference, sign=True, digits=3).replace(SPACE, " ")


def _listed(differences: Mapping[str, Interval]) -> str:
    return " and ".join(f"{name} {_interval(one)}" for name, one in differences.items())


def _some(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


def _side_data(side: Side, alone: Sequence[Leftover]) -> dict[str, Any]:
    return {
        "name": side.name,
        "read_as": side.kind,
        "place": str(side.place),
        "runs": len(side.runs),
        "agents": sorted({run.agent for run in side.runs}),
        "code": sorted({code_of(run) for run in side.runs} - {""}),
        "without_partner": [
            {"run_id": one.run.record.run_id, "path": str(one.run.path), "why": one.reason}
            for one in alone
        ],
    }


def _measures_data(
    measures: Mapping[Measure, Change], seconds: tuple[float, float]
) -> dict[str, dict[str, Any]]:
    data: dict[str, dict[str, Any]] = {
        name: {
            "a": change.a,
            "b": change.b,
            "difference": change.difference.value,
            "low": change.difference.low,
            "high": change.difference.high,
            "pairs": change.pairs,
            "enough_pairs": change.counts,
        }
        for name, change in measures.items()
    }
    return {**data, "wall_clock": {"a": seconds[0], "b": seconds[1]}}
