"""What symmetry gains over the standard agent, by kind of break: the page's first screen."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from symsteer.leaderboard.defects import (
    MEASURES,
    Audit,
    advantage,
    defect_of,
    dial_of,
    parts_of,
)
from symsteer.leaderboard.paper import STANDARD, USING_SYMMETRY
from symsteer.leaderboard.statistics import Interval, cell_estimates, combined
from symsteer.leaderboard.summary import MIN_SEEDS, SYMMETRIC_EMBODIMENT, Key, Summary, Table
from symsteer.leaderboard.text import code, count
from symsteer.variant import UNBROKEN


@dataclass(frozen=True)
class Gain:
    """Advantage of an agent over `STANDARD`, mean over the cells of one kind.

    Attributes:
        kind: what these cells have in common, as markdown.
        measure: one of `MEASURES`.
        cells: their number; those with fewer pairs than a verdict needs are left out, unless
            all have fewer.
        pairs: paired runs in all of them.
        enough: whether the cells have the pairs that a verdict needs.
        defects: smallest and largest audited defect of the kind's cells; None if one has none.
    """

    kind: str
    agent: str
    measure: str
    effect: Interval
    cells: int
    pairs: int
    enough: bool
    defects: tuple[float, float] | None


def gains(summary: Summary, audit: Audit) -> list[Gain]:
    """By kind (unbroken worlds first), agent and measure; what has no paired runs is left out."""
    found = []
    for kind, tables in kinds(summary).items():
        audited = [defect.value for t in tables if (defect := defect_of(t.key, audit))]
        defects = (min(audited), max(audited)) if len(audited) == len(tables) else None
        for agent in USING_SYMMETRY:
            for measure in MEASURES:
                cells = [pairs for t in tables if (pairs := advantage(t, agent, STANDARD, measure))]
                enough = [pairs for pairs in cells if len(pairs) >= MIN_SEEDS]
                if used := enough or cells:
                    drawn = combined(cell_estimates([list(pairs.values()) for pairs in used]))
                    sizes = len(used), sum(map(len, used)), bool(enough)
                    found.append(Gain(kind, agent, measure, drawn.interval(), *sizes, defects))
    return found


def kinds(summary: Summary) -> dict[str, list[Table]]:
    """Tables by the kind of break: unbroken, each dial, each dial with an arm.

    Cells with another budget than most, with fewer demonstrations than the most of their place, or
    whose break begins in mid-run are kinds of their own.
    """
    found: dict[str, list[Table]] = defaultdict(list)

    def others(key: Key) -> tuple[bool, bool]:
        return key.env_steps != summary.usual_budget, summary.has_few_demonstrations(key)

    for table in sorted(summary.tables, key=lambda table: (others(table.key), _order(table.key))):
        longer, fewer = others(table.key)
        words = [_break(table.key)]
        words += [f"{count(table.key.env_steps)} steps"] if longer else []
        words += ["few demonstrations"] if fewer else []
        found[", ".join(words)].append(table)
    return dict(found)


def _order(key: Key) -> tuple[bool, bool, str]:
    """Without an arm first, unbroken first."""
    return key.embodiment != SYMMETRIC_EMBODIMENT, key.variant != UNBROKEN, key.variant


def _break(key: Key) -> str:
    """What breaks the symmetry, without strengths."""
    arm = [] if key.embodiment == SYMMETRIC_EMBODIMENT else ["arm"]
    if key.variant == UNBROKEN:
        return "".join(arm) or "unbroken"
    constant = all(spec.is_constant for spec in parts_of(key.variant) or ())
    return ", ".join([*arm, code(dial_of(key.variant)), *([] if constant else ["changing"])])
