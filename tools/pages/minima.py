"""Writes the tables of docs/minima.md.

python -m tools.pages.minima            # from leaderboard/results/minima
python -m tools.pages.minima FOLDER     # from the barriers.json and transfer.json of a folder
"""

from __future__ import annotations

import json
import statistics
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy import stats

from symsteer.errors import UserError
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.text import difference, number
from symsteer.tables import markdown
from tools.minima.barriers import barrier
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "minima.md"
RESULTS = CHECKOUT / "leaderboard" / "results" / "minima"

Row = Mapping[str, Any]

SPREAD = "mean [lowest, highest]"

WAYS = {"as trained": "trained", "permuted": "permuted", "aligned": "aligned"}
WAYS["balanced and aligned"] = "balanced"


def barriers(rows: Sequence[Row]) -> str:
    """The height of the barrier, as a share of the mean loss at its ends."""

    def height(row: Row, way: str) -> float:
        losses = row["losses"][way]
        return 2 * barrier(losses) / (losses[0] + losses[-1])

    return _of_ways(rows, WAYS, height)


def distances(rows: Sequence[Row]) -> str:
    """The distance of the ends, as a share of the norm of the parameters."""
    return _of_ways(rows, WAYS, lambda row, way: row["distance"][way])


def middles(rows: Sequence[Row]) -> str:
    """Success of the policy at one end of the line, and in its middle."""
    return _of_ways(rows, {"one end": "own", **WAYS}, lambda row, way: row["success"][way])


def _of_ways(
    rows: Sequence[Row], ways: Mapping[str, str], value: Callable[[Row, str], float]
) -> str:
    """Mean [lowest, highest] by policy and by what differs, a column for each way."""
    lines = [
        [f"`{policy}`", apart, *(spread([value(r, way) for r in found]) for way in ways.values())]
        for (policy, apart), found in _grouped(rows, "policy", "apart").items()
    ]
    return markdown(["policy", "differ in", *ways], lines, left=2)


def transfers(rows: Sequence[Row]) -> str:
    """Success on another policy beside what else is known of it: mean [lowest, highest]."""
    shown = {
        "no actor": "alone",
        "its own actor": "own_actor",
        "the other's actor": "moved",
        "with its noise aligned": "aligned",
    }
    lines = [
        [f"`{agent}`", *(spread([r[key] for r in found]) for key in shown.values())]
        for (agent,), found in _grouped(rows, "agent").items()
    ]
    return markdown(["actor", *shown], lines)


def gains(rows: Sequence[Row]) -> str:
    """Differences of success, with 95 % intervals over the pairs."""
    shown = {
        "the other's actor minus no actor": ("moved", "alone"),
        "minus the policy's own actor": ("moved", "own_actor"),
        "what aligning the noise adds": ("aligned", "moved"),
    }
    lines = []
    for (agent,), found in _grouped(rows, "agent").items():
        cells = []
        for more, less in shown.values():
            pairs = [  # both directions of a pair share their policies and actors
                statistics.mean(row[more] - row[less] for row in pair)
                for pair in zip(found[::2], found[1::2], strict=True)
            ]
            cells.append(interval(pairs))
        lines.append([f"`{agent}`", *cells])
    return markdown(["actor", *shown], lines)


def agreements(rows: Sequence[Row]) -> str:
    """Correlation of the actions of both policies over the noise: mean [lowest, highest]."""
    # It is one of policies: the rows of each agent repeat it.
    once = [row for row in rows if row["agent"] == rows[0]["agent"]]
    shown = {"the same noise": "agreement", "aligned noise": "agreement_aligned"}
    return markdown(list(shown), [[spread([r[key] for r in once]) for key in shown.values()]], 0)


def _grouped(rows: Sequence[Row], *keys: str) -> dict[tuple[str, ...], list[Row]]:
    groups: dict[tuple[str, ...], list[Row]] = defaultdict(list)
    for row in rows:
        groups[tuple(row[key] for key in keys)].append(row)
    return groups


def spread(values: Sequence[float]) -> str:
    """Mean [lowest, highest]."""
    mean, low, high = (number(x) for x in (statistics.mean(values), min(values), max(values)))
    return f"{mean} [{low}, {high}]"


def interval(values: Sequence[float], confidence: float = 0.95) -> str:
    """Mean [interval] by Student's t, marked where it is on one side of 0."""
    mean = statistics.mean(values)
    half = stats.t.ppf((1 + confidence) / 2, len(values) - 1) * stats.sem(values)
    return difference(Interval(mean, mean - half, mean + half))


def render(folder: Path) -> str:
    """All tables, in markdown.

    Raises:
        UserError: a file cannot be read.
    """
    parts = {
        "barriers.json": {
            f"The barrier: {SPREAD}": barriers,
            f"The distance: {SPREAD}": distances,
            f"The middle of the line, played: {SPREAD}": middles,
        },
        "transfer.json": {
            f"Success with the actor of another policy: {SPREAD}": transfers,
            "Differences, with 95 % intervals": gains,
            f"Correlation of the actions of two policies with the same noise: {SPREAD}": agreements,
        },
    }
    text = []
    for file, tables in parts.items():
        try:
            rows = json.loads((folder / file).read_text("utf-8-sig"))["rows"]
            text += [f"### {title}\n\n{table(rows)}" for title, table in tables.items()]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{folder / file} cannot be read ({error}); write it again with "
                f"`python -m tools.minima.{file.removesuffix('.json')}`"
            ) from None
    return "\n\n".join(text)


def main(arguments: Sequence[str]) -> int:
    """Write docs/minima.md; returns the exit code."""
    source = Path(arguments[0]) if arguments else RESULTS
    return write_tables(PAGE, lambda: render(source))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
