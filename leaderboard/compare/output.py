"""A comparison as text for a terminal, and as data for JSON.

Records and file names may hold any text. In the terminal it is shown on one line and without
control characters (`shown`); JSON escapes it.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

from symsteer.leaderboard.compare.changes import DECISIVE, CellChanges, Change, Changes, Measure
from symsteer.leaderboard.compare.pairing import Cell
from symsteer.leaderboard.compare.sides import Leftover, Side, code_of
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.summary import MIN_SEEDS, Run
from symsteer.leaderboard.text import MARKS, NOTHING, SPACE, compact, interval, number
from symsteer.terminal import printable

WIDTH = 100
"""Characters of a line."""
NAME_WIDTH = 36
MOST_REASONS = 3
MOST_CODES = 3

LABELS: dict[Measure, str] = {"success": "success", "auc": "AUC", "q_bias": "|Q bias|"}
FEW = "*"


def to_text(a: Side, b: Side, changes: Changes) -> str:
    """What a terminal shows, in lines of at most `WIDTH` characters."""
    blocks = [
        _lines([_side("A", a), _side("B", b)]),
        _lines([*_agreement(changes), *_notes(changes), *_alone(changes)]),
    ]
    if changes.verdict == "identical":
        of_a, of_b = (number(seconds / 60, 1) for seconds in changes.seconds)
        blocks.append(f"minutes a run: {of_a} (A), {of_b} (B)")
    else:
        blocks.append(_overall(changes))
        if len(changes.cells) > 1:
            blocks += [_cells(changes), _information(changes)]
    blocks.append(_lines([f"verdict: {verdict_text(changes)}"]))
    return "\n\n".join(blocks)


def verdict_text(changes: Changes) -> str:
    """The verdict in one or two sentences."""
    counted = {
        LABELS[name]: change.difference
        for name in DECISIVE
        if (change := changes.overall.get(name)) and change.counts
    }
    margin = f", by more than the margin of {changes.margin:g}" if changes.margin else ""
    if changes.verdict == "identical":
        return "identical"
    if changes.verdict == "none":
        most = max(len(cell.pairs) for cell in changes.pairing.cells)
        return (
            f"none. A verdict needs {MIN_SEEDS} pairs in a cell, for example five seeds; the most "
            f"here is {most}."
        )
    if changes.verdict == "worse":
        bad = {name: found for name, found in counted.items() if found.high < -changes.margin}
        return f"B is clearly worse{margin}: {_listed(bad)}."
    if changes.verdict == "better":
        text = f"B is clearly better: {_listed({n: i for n, i in counted.items() if i.low > 0})}."
    else:
        text = f"B is not clearly worse{margin}."
    losses = [f"{number(-found.low, 3)} in {n}" for n, found in counted.items() if found.low < 0]
    return text + f" It may lose up to {' and '.join(losses)}." * bool(losses)


def _listed(found: dict[str, Interval]) -> str:
    return " and ".join(f"{name} {_interval(difference)}" for name, difference in found.items())


def to_data(a: Side, b: Side, changes: Changes) -> dict[str, Any]:
    """The same, and every pair, as plain data."""
    pairing = changes.pairing
    return {
        "a": _side_data(a, pairing.alone[0]),
        "b": _side_data(b, pairing.alone[1]),
        "verdict": changes.verdict,
        "margin": changes.margin,
        "pairs": len(pairing.pairs),
        "same_episodes": sum(pair.same_episodes for pair in pairing.pairs),
        "same_diagnostics": sum(pair.same_diagnostics for pair in pairing.pairs),
        "only_a_has": list(pairing.one_sided[0]),
        "only_b_has": list(pairing.one_sided[1]),
        "changed_options": list(pairing.changed),
        "overall": _measures_data(changes.overall, changes.seconds),
        "cells": [_cell_data(found) for found in changes.cells],
    }


def cell_names(cells: Sequence[Cell]) -> list[tuple[str, str]]:
    """Task and embodiment of each cell, and what else tells it from the other cells."""
    keys = [cell.key for cell in cells]
    names = []
    for cell in cells:
        key = cell.key
        parts = [key.variant, cell.label]
        if len({(other.base, other.group) for other in keys}) > 1:
            parts.append(f"{key.base} {key.group}".strip())
        if len({(other.mode, other.demonstrations) for other in keys}) > 1:
            parts.append(f"{key.demonstrations} {key.mode} demonstrations")
        if len({other.env_steps for other in keys}) > 1:
            parts.append(f"{key.env_steps:,} steps")
        parts.append(key.settings)
        names.append((f"{key.task} {key.embodiment}", " ".join(part for part in parts if part)))
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
    place, name = shown(str(side.place), 300), shown(side.name, 300)
    read = {
        "folder": f"the folder {name}",
        "file": f"the record {name}",
        "agent": f"the agent {name} in {place}",
        "commit": f"the commit {name} in {place}",
    }[side.kind]
    runs = side.runs
    agents = ", ".join(sorted({shown(run.agent, 40) for run in runs}))
    of = "" if side.kind == "agent" else f" of {shown(agents, 200)}"
    count = _some(len(runs) + len(side.leftovers), "run")
    if side.leftovers:
        count = f"{len(runs)} of {count}"
    codes = sorted({_code(run) for run in runs})
    text = ", ".join(codes[:MOST_CODES])
    if len(codes) > MOST_CODES:
        text += f" and {len(codes) - MOST_CODES} more"
    return f"{letter}: {read}: {count}{of}; code {text}"


def _code(run: Run) -> str:
    dirty = " with changes" if run.record.provenance.dirty else ""
    return (code_of(run)[:8] or "unknown") + dirty


def _agreement(changes: Changes) -> list[str]:
    pairs = changes.pairing.pairs
    same = sum(pair.same_episodes for pair in pairs)
    deep = sum(pair.same_episodes and pair.same_diagnostics for pair in pairs)
    policies = len({pair.a.policy for pair in pairs})
    total = f"{_some(len(pairs), 'pair')} in {_some(len(changes.cells), 'cell')}, on "
    total += f"{_some(policies, 'base policy', 'base policies')}."
    if same == len(pairs):
        diagnostics = "in all diagnostics" if deep == same else "not in all diagnostics"
        beside = "and" if deep == same else "but"
        return [
            "IDENTICAL: all pairs agree bit for bit in every episode of every evaluation, "
            f"{beside} {diagnostics}.",
            total,
        ]
    return [f"{total} Identical bit for bit: {same} of {len(pairs)}."]


def _notes(changes: Changes) -> list[str]:
    pairing = changes.pairing
    notes = []
    for letter, keys in zip("AB", pairing.one_sided, strict=True):
        if keys:
            names = shown(", ".join(keys), 200)
            notes.append(f"Settings that only {letter} has, which do not count: {names}.")
    if pairing.changed:
        notes.append(f"Options that differ (A -> B): {shown(', '.join(pairing.changed), 300)}.")
    return notes


def _alone(changes: Changes) -> list[str]:
    """How many runs have no partner, and the most frequent reasons with an example each."""
    alone_a, alone_b = changes.pairing.alone
    if not alone_a and not alone_b:
        return ["Every run has a partner."]
    lines = [f"Without a partner: {_some(len(alone_a), 'run')} of A, {len(alone_b)} of B."]
    for letter, alone in zip("AB", changes.pairing.alone, strict=True):
        by_reason: dict[str, list[Leftover]] = defaultdict(list)
        for found in alone:
            by_reason[found.reason].append(found)
        groups = sorted(by_reason.items(), key=lambda item: -len(item[1]))
        for reason, runs in groups[:MOST_REASONS]:
            example = shown(runs[0].run.record.run_id)
            lines.append(f"  {len(runs)} of {letter}: {shown(reason)}, such as {example}")
        if others := sum(len(runs) for _, runs in groups[MOST_REASONS:]):
            lines.append(f"  {others} of {letter}: other reasons (--json has all)")
    return lines


def _overall(changes: Changes) -> str:
    """A's and B's means and the differences over all cells."""
    if len(changes.cells) == 1:
        (name,) = cell_names([changes.cells[0].cell])
        title = shown(" ".join(name), NAME_WIDTH)
    else:
        title = "mean over cells"
    rows = [[title, "pairs", "A", "B", "B - A, 95 % interval"]]
    for measure, change in changes.overall.items():
        a, b = (_value(measure, value) for value in (change.a, change.b))
        differs = _difference(measure, change, digits=3)
        rows.append([f"  {LABELS[measure]}", str(change.pairs), a, b, differs])
    minutes = (number(seconds / 60, 1) for seconds in changes.seconds)
    rows.append(["  minutes a run", str(len(changes.pairing.pairs)), *minutes, ""])
    return _aligned(rows, "<>>><")


def _cells(changes: Changes) -> str:
    """The measures that decide, in each cell."""
    measures = [measure for measure in DECISIVE if measure in changes.overall]
    rows = [["B - A in each cell", "pairs", *(LABELS[measure] for measure in measures)]]
    for name, found in _by_place(changes):
        if found is None:
            rows.append([name, "", *("" for _ in measures)])
            continue
        few = FEW if len(found.cell.pairs) < MIN_SEEDS else ""
        texts = [
            _difference(measure, found.measures[measure]) if measure in found.measures else NOTHING
            for measure in measures
        ]
        rows.append([name, f"{len(found.cell.pairs)}{few}", *texts])
    table = _aligned(rows, "<><<"[: len(rows[0])])
    if any(row[1].endswith(FEW) for row in rows):
        table += f"\n{FEW} fewer than {MIN_SEEDS} pairs: not in the mean if any cell has enough"
    same = sum(found.cell.is_identical for found in changes.cells)
    return table + f"\nnot listed: {_some(same, 'identical cell')}" * (same > 0)


def _information(changes: Changes) -> str:
    """What does not decide, in each cell."""
    biased = "q_bias" in changes.overall
    rows = [["not part of the verdict", "minutes A", "B"]]
    rows[0] += [f"{LABELS['q_bias']} A -> B", "B - A"] * biased
    for name, found in _by_place(changes):
        minutes = [number(s / 60, 1) for s in found.seconds] if found else ["", ""]
        rows.append([name, *minutes, *(_bias(found) * biased)])
    return _aligned(rows, "<>><<"[: len(rows[0])])


def _by_place(changes: Changes) -> Iterator[tuple[str, CellChanges | None]]:
    """The cells that are not identical, with their names; before those of a task and embodiment,
    its name alone."""
    names = cell_names([found.cell for found in changes.cells])
    before = ""
    for (place, name), found in zip(names, changes.cells, strict=True):
        if found.cell.is_identical:
            continue
        if place != before:
            yield shown(place), None
        before = place
        yield f"  {shown(name, 200)}", found


def _bias(found: CellChanges | None) -> tuple[str, str]:
    change = found.measures.get("q_bias") if found else None
    if change is None:
        return NOTHING * (found is not None), ""
    a, b = (_value("q_bias", value) for value in (change.a, change.b))
    return f"{a} -> {b}", _difference("q_bias", change)


def _aligned(rows: Sequence[Sequence[str]], sides: str) -> str:
    """Columns two spaces apart; a long first column is folded, its last line with the numbers."""
    folded = []
    for row in rows:
        indent = row[0][: len(row[0]) - len(row[0].lstrip())]
        how: dict[str, Any] = {"initial_indent": indent, "subsequent_indent": f"{indent}  "}
        folded.append(textwrap.wrap(row[0].strip(), NAME_WIDTH, break_on_hyphens=False, **how))
    widths = [max(len(line) for lines in folded for line in lines)]
    widths += [max(len(row[column]) for row in rows) for column in range(1, len(sides))]
    lines = []
    for names, row in zip(folded, rows, strict=True):
        lines += names[:-1]
        cells = zip([names[-1], *row[1:]], sides, widths, strict=True)
        lines.append("  ".join(f"{text:{side}{width}}" for text, side, width in cells).rstrip())
    return "\n".join(lines)


def _value(measure: Measure, value: float) -> str:
    return number(value) if measure in DECISIVE else compact(value)


def _difference(measure: Measure, change: Change, digits: int = 2) -> str:
    """The difference with its interval; what decides has a mark where it excludes 0."""
    found = change.difference
    if measure in DECISIVE:
        return _interval(found, digits) + (MARKS[found.sign] if change.counts else "")
    value, low, high = (compact(v) for v in (found.value, found.low, found.high))
    # Of one run, or of runs that agree, there is no spread to take an interval from.
    return f"{'+' * (found.value > 0)}{value}" + f" [{low}, {high}]" * (low != high)


def _interval(found: Interval, digits: int = 3) -> str:
    return interval(found, sign=True, digits=digits).replace(SPACE, " ")


def _some(count: int, noun: str, plural: str = "") -> str:
    return f"{count} {noun if count == 1 else plural or noun + 's'}"


def _side_data(side: Side, alone: Sequence[Leftover]) -> dict[str, Any]:
    return {
        "name": side.name,
        "read_as": side.kind,
        "place": str(side.place),
        "runs": len(side.runs),
        "agents": sorted({run.agent for run in side.runs}),
        "code": sorted({code_of(run) for run in side.runs} - {""}),
        "without_partner": [
            {"run_id": found.run.record.run_id, "path": str(found.run.path), "why": found.reason}
            for found in alone
        ],
    }


def _cell_data(found: CellChanges) -> dict[str, Any]:
    key = found.cell.key
    return {
        "task": key.task,
        "embodiment": key.embodiment,
        "variant": key.variant,
        "base_policy": f"{key.base} {key.group}".strip(),
        "demonstrations": {"mode": key.mode, "count": key.demonstrations},
        "env_steps": key.env_steps,
        "agent": found.cell.label or None,
        "measures": _measures_data(found.measures, found.seconds),
        "pairs": [
            {
                "a": str(pair.a.path),
                "b": str(pair.b.path),
                "base_policy": pair.a.policy,
                "seed": pair.a.seed,
                "same_episodes": pair.same_episodes,
                "same_diagnostics": pair.same_diagnostics,
            }
            for pair in found.cell.pairs
        ],
    }


def _measures_data(
    measures: dict[Measure, Change], seconds: tuple[float, float]
) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {
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
    return {**found, "wall_clock": {"a": seconds[0], "b": seconds[1]}}
