"""The page's first screen: what symmetry gains by kind of break, and where learners are ahead."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from symsteer.leaderboard.defects import MEASURES, Audit, advantage, defect_of, dial_of, parts_of
from symsteer.leaderboard.paper import STANDARD, USING_SYMMETRY
from symsteer.leaderboard.statistics import Interval, cell_estimates, combined, crossed_bootstrap
from symsteer.leaderboard.summary import (
    MIN_SEEDS,
    SYMMETRIC_EMBODIMENT,
    Key,
    Summary,
    Table,
    success_pairs,
)
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


@dataclass(frozen=True)
class Tally:
    """In how many cells an agent's final success is clearly above and clearly below another's.

    Attributes:
        cells: those with the pairs of runs that a verdict needs.
    """

    above: int
    below: int
    cells: int


def against_references(summary: Summary) -> dict[str, Tally]:
    """Each learner against a cell's best reference; agents without such a cell are left out."""
    found = {}
    for agent in summary.agents:
        rows = [t.row_of(agent) for t in summary.tables if t.best_reference]
        enough = [row for row in rows if row and row.pairs_with_best >= MIN_SEEDS]
        found[agent] = _tally(row.against_best for row in enough)
    return {agent: tally for agent, tally in found.items() if tally.cells}


def against_standard(summary: Summary) -> dict[str, Tally]:
    """Each other learner against `STANDARD`; agents without a cell in common are left out."""
    found = {}
    for agent in summary.agents:
        rows = [(t.row_of(agent), t.row_of(STANDARD)) for t in summary.tables]
        if agent != STANDARD and summary.roles[agent] != "reference":
            pairs = [success_pairs(row, other) for row, other in rows if row and other]
            enough = [list(own.values()) for own in pairs if len(own) >= MIN_SEEDS]
            found[agent] = _tally(map(crossed_bootstrap, enough))
    return {agent: tally for agent, tally in found.items() if tally.cells}


def _tally(found: Iterable[Interval | None]) -> Tally:
    signs = [effect.sign for effect in found if effect]
    return Tally(signs.count(1), signs.count(-1), len(signs))


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
