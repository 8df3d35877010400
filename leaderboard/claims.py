"""The claims of arXiv 2512.11345, each with a test, an effect, an interval and a verdict.

A verdict follows a fixed rule: the 95 % interval of the effect lies wholly on the side that the
claim predicts (supported), wholly on the other one (contradicted), or neither (undecided). A test
without enough data is undecided and says why; it is never left out.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from symsteer.leaderboard.defects import (
    MIN_CELLS,
    Audit,
    DefectMap,
    Panel,
    advantage,
    defect_of,
)
from symsteer.leaderboard.paper import (
    APPROXIMATE,
    EQUIVARIANT,
    STANDARD,
    WITHOUT_SYMMETRY,
)
from symsteer.leaderboard.statistics import (
    Interval,
    Sample,
    censored_median,
    newcombe,
    percentile,
    stratified_bootstrap,
    stratified_draws,
)
from symsteer.leaderboard.summary import MIN_SEEDS, Key, Pair, Summary, Table

NEARLY_SYMMETRIC = 0.05
"""Cells with an audited defect up to this are where the paper expects symmetry to help."""

STRONGLY_BROKEN = 0.25
"""Cells with an audited defect from this on are where the paper expects strictness to hurt."""

SLOPE_UNIT = 0.1
"""Slopes are given for this much more defect."""


@dataclass(frozen=True)
class Claim:
    """One test. `predicted` is the sign of the effect that the claim expects."""

    name: str
    test: str
    predicted: int
    effect: Interval | None = None
    cells: int = 0
    seeds: int = 0
    """Paired runs over all cells."""
    reason: str = ""
    """Why the test cannot decide, whatever its interval says."""
    beside: str = ""
    """Further numbers on the same question, without a test."""

    @property
    def verdict(self) -> str:
        if self.reason or self.effect is None or self.effect.sign == 0:
            return "undecided"
        return "supported" if self.effect.sign == self.predicted else "contradicted"


T = TypeVar("T")
Cells = list[tuple[Table, dict[Pair, T]]]
"""Tables with what each pair of runs contributes."""


def claims(summary: Summary, audit: Audit, found: DefectMap) -> list[Claim]:
    """All tests, in the order of the paper's claims."""
    symmetric = [t for t in summary.tables if _below(t, audit)]
    return [
        *(_sample_efficiency(symmetric, rival) for rival in WITHOUT_SYMMETRY),
        *(_divergence(summary.tables, rival) for rival in WITHOUT_SYMMETRY),
        *(_bias(summary.tables, rival) for rival in WITHOUT_SYMMETRY),
        _fewest_demonstrations(symmetric),
        _fewer_demonstrations(symmetric),
        *(_falls(found.panels[EQUIVARIANT, measure]) for measure in ("auc", "success")),
        _approximate_beyond(summary.tables, audit),
    ]


def _below(table: Table, audit: Audit) -> bool:
    defect = defect_of(table.key, audit)
    return defect is not None and defect.value <= NEARLY_SYMMETRIC


def _enough(cells: Cells[T], wanted: str) -> tuple[Cells[T], str]:
    """The cells with enough seeds; if there are none, all of them and why they cannot decide."""
    cells = [(table, samples) for table, samples in cells if samples]
    if not cells:
        return [], f"no runs of {wanted} to pair"
    enough = [(table, samples) for table, samples in cells if len(samples) >= MIN_SEEDS]
    if enough:
        return enough, ""
    most = max(len(samples) for _, samples in cells)
    return cells, f"at most {most} paired seeds in a cell, {MIN_SEEDS} are needed"


def _averaged(
    name: str, test: str, found: Cells[Sample], wanted: str
) -> tuple[Claim, Cells[Sample]]:
    """Mean over cells of paired differences, predicted to be positive, and the cells used."""
    cells, reason = _enough(found, wanted)
    if not cells:
        return Claim(name, test, 1, reason=reason), cells
    effect = stratified_bootstrap([list(samples.values()) for _, samples in cells])
    seeds = sum(len(samples) for _, samples in cells)
    return Claim(name, test, 1, effect, len(cells), seeds, reason), cells


def _paired(
    name: str, test: str, tables: Sequence[Table], first: str, second: str, measure: str, where: str
) -> tuple[Claim, Cells[Sample]]:
    """The same for the difference of two agents in a measure of the map."""
    found = [(table, advantage(table, first, second, measure)) for table in tables]
    return _averaged(name, test, found, f"`{first}` and `{second}`{where}")


def _sample_efficiency(tables: Sequence[Table], rival: str) -> Claim:
    claim, cells = _paired(
        "Sample efficiency: symmetric agents learn faster",
        f"area under the curve, `equivariant` minus `{rival}`, defect up to {NEARLY_SYMMETRIC:g}",
        tables,
        EQUIVARIANT,
        rival,
        "auc",
        f" where the audited defect is at most {NEARLY_SYMMETRIC:g}",
    )
    if not cells:
        return claim
    steps = [_threshold_steps([t for t, _ in cells], agent) for agent in (EQUIVARIANT, rival)]
    return replace(claim, beside=f"steps: {steps[0]} against {steps[1]} of the budget")


def _threshold_steps(tables: Sequence[Table], agent: str) -> str:
    """Median share of the budget until the threshold over all runs, and how many got there."""
    shares = [
        None if steps is None else round(100 * steps / table.key.env_steps)
        for table in tables
        if (row := table.row_of(agent))
        for steps in row.threshold_steps
    ]
    reached = sum(share is not None for share in shares)
    median = censored_median(shares)
    text = "> 100 %" if median is None else f"{median:.0f} %"
    return f"{text} ({reached}/{len(shares)})"


DIVERGENCE = "Value divergence: symmetry prevents it"


def _divergence(tables: Sequence[Table], rival: str) -> Claim:
    test = f"share of runs whose Q diverged, `{rival}` minus `equivariant`, all cells"

    def verdicts(table: Table, agent: str) -> dict[Pair, bool]:
        # A run that failed because its Q was not finite counts, so rows may have no finished run.
        rows = [row for row in table.rows if row.agent == agent]
        found = [{r.pair: r.diverged for r in row.runs if r.diverged is not None} for row in rows]
        return max(found, key=len, default={})

    found = [
        (table, _joined(verdicts(table, rival), verdicts(table, EQUIVARIANT))) for table in tables
    ]
    cells, reason = _enough(found, f"`{rival}` and `equivariant` with a critic")
    if not cells:
        return Claim(DIVERGENCE, test, 1, reason=reason)
    both = [pair for _, pairs in cells for pair in pairs.values()]
    counts, runs = [sum(pair[i] for pair in both) for i in (0, 1)], len(both)
    effect = newcombe((counts[0], runs), (counts[1], runs))
    beside = f"{counts[0]}/{runs} against {counts[1]}/{runs} diverged"
    return Claim(DIVERGENCE, test, 1, effect, len(cells), runs, reason, beside)


def _bias(tables: Sequence[Table], rival: str) -> Claim:
    """The milder form of divergence: how far Q is from the returns that it should predict."""
    name = "Value error: symmetry makes Q less wrong"
    test = f"absolute Q bias, `{rival}` minus `equivariant`, all cells"

    def biases(table: Table, agent: str) -> dict[Pair, float]:
        row = table.row_of(agent)
        found = {run.pair: run.in_window("q_bias") for run in row.finished} if row else {}
        return {pair: abs(float(np.mean(values))) for pair, values in found.items() if values}

    found: Cells[Sample] = []
    for table in tables:
        both = _joined(biases(table, rival), biases(table, EQUIVARIANT))
        found.append((table, {pair: Sample.constant(a - b) for pair, (a, b) in both.items()}))
    claim, cells = _averaged(name, test, found, f"`{rival}` and `equivariant` with a critic")
    return replace(claim, beside="in units of return") if cells else claim


def _joined(first: Mapping[Pair, T], second: Mapping[Pair, T]) -> dict[Pair, tuple[T, T]]:
    return {pair: (value, second[pair]) for pair, value in first.items() if pair in second}


FEW = "Few demonstrations: symmetry helps most there"


def _by_demonstrations(tables: Sequence[Table]) -> list[list[Table]]:
    """Tables that differ in the number of demonstrations alone, fewest first; families of two."""
    families: dict[tuple[object, ...], list[Table]] = defaultdict(list)
    for table in sorted(tables, key=lambda table: table.key):
        families[_family(table.key)].append(table)
    return [
        sorted(family, key=lambda table: table.key.demonstrations)
        for family in families.values()
        if len({table.key.demonstrations for table in family}) > 1
    ]


def _family(key: Key) -> tuple[object, ...]:
    return (key.task, key.embodiment, key.breaking, key.base, key.group, key.mode, key.env_steps)


def _one_number(tables: Sequence[Table]) -> str:
    numbers = sorted({table.key.demonstrations for table in tables})
    if not numbers:
        return f"no cell has an audited defect of at most {NEARLY_SYMMETRIC:g}"
    have = f"all have {numbers[0]}" if len(numbers) == 1 else f"there are {numbers}"
    return f"no cell was run with more than one number of demonstrations ({have})"


def _fewest_demonstrations(tables: Sequence[Table]) -> Claim:
    test = (
        "success, `equivariant` minus `standard`, at the smallest number of demonstrations, "
        f"defect up to {NEARLY_SYMMETRIC:g}"
    )
    families = _by_demonstrations(tables)
    if not families:
        return Claim(FEW, test, 1, reason=_one_number(tables))
    fewest = [family[0] for family in families]
    where = " at the smallest number of demonstrations"
    return _paired(FEW, test, fewest, EQUIVARIANT, STANDARD, "success", where)[0]


def _fewer_demonstrations(tables: Sequence[Table]) -> Claim:
    test = "the same, at the smallest minus at the largest number of demonstrations"
    families = _by_demonstrations(tables)
    if not families:
        return Claim(FEW, test, 1, reason=_one_number(tables))

    def samples(table: Table) -> list[Sample]:
        return list(advantage(table, EQUIVARIANT, STANDARD, "success").values())

    ends = [(samples(family[0]), samples(family[-1])) for family in families]
    ends = [(few, many) for few, many in ends if few and many]
    if not ends:
        return Claim(FEW, test, 1, reason="no runs of `equivariant` and `standard` at both ends")
    enough = [(few, many) for few, many in ends if min(len(few), len(many)) >= MIN_SEEDS]
    reason = "" if enough else f"fewer than {MIN_SEEDS} paired seeds at one of the ends"
    # The cells of one family share their episodes, so their draws belong together.
    cells = [side for end in enough or ends for side in end]
    signs = np.tile([1.0, -1.0], len(enough or ends))
    values = np.array([np.mean([sample.value for sample in cell]) for cell in cells])
    draws = stratified_draws(cells, np.random.default_rng(0))
    effect = percentile(
        2 * float(np.mean(signs * values)), 2 * np.mean(signs[:, None] * draws, axis=0)
    )
    runs = sum(len(few) for few, _ in enough or ends)
    return Claim(FEW, test, 1, effect, len(enough or ends), runs, reason)


LIMITS = "Limits under breaking: the advantage of strictness falls with the defect"


def _falls(panel: Panel) -> Claim:
    what = {"auc": "area under the curve", "success": "success"}[panel.measure]
    test = f"slope of the advantage in {what} (the map's line), per {SLOPE_UNIT:g} of defect"
    if panel.line is None:
        found = len({p.defect.value for p in panel.points if p.counts})
        reason = (
            f"{found} audited cells with {MIN_SEEDS} paired seeds and a defect of their own, "
            f"{MIN_CELLS} are needed"
        )
        return Claim(LIMITS, test, -1, reason=reason)
    slope = panel.line.slope
    scaled = Interval(*(SLOPE_UNIT * value for value in (slope.value, slope.low, slope.high)))
    counted = [point for point in panel.points if point.counts]
    seeds = sum(len(point.samples) for point in counted)
    return Claim(LIMITS, test, -1, scaled, len(counted), seeds)


def _approximate_beyond(tables: Sequence[Table], audit: Audit) -> Claim:
    broken = [
        table
        for table in tables
        if (defect := defect_of(table.key, audit)) and defect.value >= STRONGLY_BROKEN
    ]
    return _paired(
        "Limits under breaking: approximate equivariance holds up where strictness does not",
        f"success, `approximate` minus `equivariant`, defect from {STRONGLY_BROKEN:g} on",
        broken,
        APPROXIMATE,
        EQUIVARIANT,
        "success",
        f" where the audited defect is at least {STRONGLY_BROKEN:g}",
    )[0]
