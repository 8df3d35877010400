"""Writes the tables of docs/audit.md, docs/variants.md and the tasks' pages from the summary.

python -m tools.pages.audit                     # from the committed summary
python -m tools.pages.audit OUT/summary.json    # replaces the committed summary first

Of a cell that several summaries have, the last one counts. The committed summary is
leaderboard/results/audit/summary.json.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from symsteer.bench.audit.report import (
    EXACT,
    SIGNIFICANT,
    percent,
    summary_json,
    to_markdown,
    two_digits,
)
from symsteer.bench.audit.result import VERSION, old_version
from symsteer.bench.variants.levels import LEVELS, points_of, strength
from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.tables import markdown
from symsteer.terminal import complain
from symsteer.variant import UNBROKEN
from tools.pages.marks import CHECKOUT, check_checkout, with_tables

PAGE = CHECKOUT / "docs" / "audit.md"
VARIANTS_PAGE = CHECKOUT / "docs" / "variants.md"
SUMMARY = CHECKOUT / "leaderboard" / "results" / "audit" / "summary.json"
TASK_PAGES = CHECKOUT / "docs" / "tasks"
MARK = "<!-- audit:{} -->\n"
"""Line of a task's page after which everything is generated."""
CELL = ("task", "embodiment", "group", "variant")
"""What names a row of a summary."""
GRADES = ((0.01, "near exact"), (0.05, "close"), (0.15, "rough"))
"""Limits of the defect of a decision."""


def render(rows: Sequence[dict[str, Any]]) -> str:
    """Overview and a table for each task and embodiment, in markdown."""
    places = list(dict.fromkeys((r["task"], r["embodiment"], r["group"]) for r in rows))
    parts = [_overview(rows)]
    for place in places:
        own = [r for r in rows if (r["task"], r["embodiment"], r["group"]) == place]
        task, embodiment, group = place
        states = f"{own[0]['states']} states, the object moves in {own[0]['moving']}"
        reach = max(r["unreachable"] for r in own)
        if reach > 0:
            states += f"; up to {100 * reach:.1f} % of the turned states are out of reach"
        parts.append(f"### {task}, {embodiment}, {group}\n\n{states}.\n\n{to_markdown(own)}")
    return "\n".join(parts)


def _overview(rows: Sequence[dict[str, Any]]) -> str:
    """Range of each component over the tasks, one row for each embodiment and variant."""
    head = ["variant", "tasks", "decision", "tool", "object", "cost", "observed", "resets"]
    lines = ["| " + " | ".join(head) + " |", "|---|" + "--:|" * (len(head) - 1)]
    for place in dict.fromkeys((r["embodiment"], r["group"], r["variant"]) for r in rows):
        own = [r for r in rows if (r["embodiment"], r["group"], r["variant"]) == place]
        embodiment, group, variant = place
        name = "unbroken" if variant == "none" else f"`{variant}`"
        if (embodiment, group) != ("floating", "C8"):
            name = f"{embodiment}, {group}, {name}"
        cells = [name, str(len(own))]
        cells += [percent_range([r[c] for r in own], 0) for c in ("decision", "tool", "object")]
        cells += [percent_range([r[c] for r in own], EXACT) for c in ("cost", "observation")]
        differ = sum(r["resets_p"] < SIGNIFICANT for r in own)
        cells += [f"{differ} of {len(own)} differ" if differ else "alike"]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def levels(rows: Sequence[Mapping[str, Any]]) -> str:
    """The strengths of all levels, in markdown: a row for each task, a column for each variant."""
    audited = points_of(rows)

    def cell(name: str, place: tuple[str, str]) -> str:
        strengths = []
        for level in LEVELS:
            try:
                strengths.append(f"{strength(name, level, *place, audited):g}")
            except UserError:
                strengths.append("-")
        return " / ".join(strengths) if {*strengths} != {"-"} else "-"

    names = sorted({name for place in audited for name in audited[place]})
    cells = {name: [cell(name, place) for place in audited] for name in names}
    shown = [name for name in names if {*cells[name]} != {"-"}]
    lines = [
        [", ".join(place), *(cells[name][i] for name in shown)] for i, place in enumerate(audited)
    ]
    return markdown(["task", *(f"`{name}`" for name in shown)], lines) + "\n"


def percent_range(intervals: Sequence[list[float] | None], exact: float) -> str:
    """Smallest to largest value in per cent; just 0 if all are below ``exact``."""
    values = [i[0] for i in intervals if i is not None]
    if not values:
        return "at rest"
    if max(values) < exact:
        return "0"
    low, high = two_digits(100 * min(values)), two_digits(100 * max(values))
    return f"{low} %" if low == high else f"{low} to {high} %"


def generate(page: str, rows: Sequence[dict[str, Any]]) -> str:
    """Replace the tables of docs/audit.md.

    Raises:
        UserError: the page lacks the marks around the tables.
    """
    return with_tables(page, render(rows), "docs/audit.md")


def grade(row: dict[str, Any]) -> str:
    """How well the symmetry of a row holds, in words."""
    return next((word for limit, word in GRADES if row["decision"][0] < limit), "broken")


def generate_task(page: str, task: str, rows: Sequence[dict[str, Any]]) -> str:
    """Replace what follows the mark of a task's page by the audit of its unbroken embodiments.

    Raises:
        UserError: the page lacks the mark.
    """
    before, mark, _ = page.partition(MARK.format(task))
    if not mark:
        raise UserError(
            f"the page of {task} lacks the mark {MARK.format(task).strip()}; restore the page"
        )
    lines = [
        "",
        "The [audit](../audit.md) of the unbroken task: defect of a decision of "
        "4 steps in states that expert and policy visit (group C8):",
        "",
        "| embodiment | decision | part | tool | object | resets | symmetry |",
        "|---|--:|---|--:|--:|--:|---|",
    ]
    for row in rows:
        if (row["task"], row["variant"], row["group"]) == (task, "none", "C8"):
            whole, tool, thing = (percent(row[name]) for name in ("decision", "tool", "object"))
            resets = "differ" if row["resets_p"] < SIGNIFICANT else "alike"
            cells = [row["embodiment"], whole, row["part"], tool, thing, resets, grade(row)]
            lines.append(f"| {' | '.join(cells)} |")
    return before + mark + "\n".join(lines) + "\n"


def task_page(task: str) -> Path:
    """Path of a task's page, for instance ``docs/tasks/pick-cube.md`` for ``PickCube-v1``."""
    name = re.sub(r"(?<!^)(?=[A-Z])", "-", task.removesuffix("-v1")).lower()
    return TASK_PAGES / f"{name}.md"


def read_summary(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a ``summary.json``.

    Raises:
        UserError: the file cannot be read, or is of another version.
    """
    try:
        rows = json.loads(path.read_text("utf-8-sig"))
        versions = {row.get("version", 1) for row in rows}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"cannot read the summary {path}: {error}; name the summary.json of an audit"
        ) from error
    for version in versions - {VERSION}:
        raise UserError(f"{path}: {old_version(version)}")
    return rows


def in_order(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each cell once: places as they come first, the unbroken variant, the others by strength."""
    cells = {tuple(row[name] for name in CELL): row for row in rows}
    places = list(dict.fromkeys((task, embodiment, group) for task, embodiment, group, _ in cells))

    def order(cell: tuple[str, str, str, str]) -> tuple[int, bool, str, float]:
        name, _, strength = cell[3].partition(":")
        # Joined and moving variants have more than one number.
        first = re.split(r"[^\d.]|\.\.", strength)[0]
        return places.index(cell[:3]), name != UNBROKEN, name, float(first or 0)

    return [cells[cell] for cell in sorted(cells, key=order)]


def main(arguments: Sequence[str]) -> int:
    """Write the tables of the pages; returns the exit code."""
    try:
        check_checkout(PAGE)
        paths = arguments or [str(SUMMARY)]
        rows = in_order(row for path in paths for row in read_summary(Path(path)))
        pages = {PAGE: generate(PAGE.read_text(), rows)}
        pages[VARIANTS_PAGE] = with_tables(
            VARIANTS_PAGE.read_text(), levels(rows), "docs/variants.md"
        )
        for task in dict.fromkeys(row["task"] for row in rows):
            pages[task_page(task)] = generate_task(task_page(task).read_text(), task, rows)
        if arguments:
            pages[SUMMARY] = summary_json(rows)
        write_together({path: text.encode() for path, text in pages.items()})
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(f"wrote the tables of {len(rows)} audits to {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
