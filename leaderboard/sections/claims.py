"""Declared claims (`symsteer.leaderboard.study`), each with an effect, p-values and a verdict."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean

import numpy as np

from symsteer.leaderboard.advantage_by_defect import Point, fit
from symsteer.leaderboard.defects import Audit, defect_of, parts_of
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import ROW_ORDER
from symsteer.leaderboard.pairs import MEASURES, advantage
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.runs import Pair
from symsteer.leaderboard.sections import Findings, Section, View
from symsteer.leaderboard.statistics import (
    CONFIDENCE,
    BootstrapEstimate,
    Effect,
    Interval,
    Sample,
    ShareDifference,
    cell_estimates,
    combined,
    holm,
    p_difference,
    p_equivalence,
    units_of,
)
from symsteer.leaderboard.study import Cells, Claim, Study
from symsteer.leaderboard.text import NOTHING, SPACE, code, interval, number, stacked, table_text
from symsteer.names import unknown
from symsteer.variant import specs_at, variant_text

SLOPE_UNIT = 0.1
"""Slopes are given for this much more defect."""

EXPLAINED = f"""\
Effects are differences of two agents, paired by base policy and seed (success and its area by
episode, too), mean over cells with {MIN_SEEDS} pairs; slopes are per {SLOPE_UNIT:g} of defect,
within base policies. *Supported* and *contradicted* need p < 0.05 for "no effect", *equivalent*
needs it for "an effect of at least the smallest one of interest"; otherwise a claim is *undecided*.
Below a difference: the means of both agents (of an interaction, in the first cells).
Both p-values are corrected for the number of tests of a family (Holm), the intervals are not.
*Rests on* names each task without whose cells the interval holds 0, *but not in* each in which the
effect is at least the smallest one of interest, and its interval does not hold 0."""

MEASURE_WORDS = {
    "auc": "area under the curve",
    "success": "success",
    "diverged": "share of diverged runs",
    "magnitude": "largest \\|Q\\| over the largest feasible",
    "bias": "\\|Q bias\\| (reward)",
}

Used = list[tuple[Table, dict[Pair, Sample]]]
"""Cells with what each pair of runs contributes."""


@dataclass(frozen=True)
class ClaimOutcome:
    """A claim and what the records say about it."""

    claim: Claim
    effect: Effect | None = None
    cells: int = 0
    pairs: int = 0
    """Paired runs over all cells."""
    policies: int = 0
    """Base policies that they steer."""
    reason: str = ""
    """Why it is not tested."""
    behind: str = ""
    """The numbers behind a difference: both agents' means or, of shares, counts."""
    p: float = 1.0
    """Of no effect, corrected for the number of tested claims of the family (Holm)."""
    p_equal: float = 1.0
    """Of an effect at least as large as the smallest of interest, corrected in the same way."""
    by_task: Mapping[str, Interval] = field(default_factory=dict)
    """The effect in the cells of each task, if there are several."""
    behind_by_task: Mapping[str, str] = field(default_factory=dict)
    """The numbers behind these differences."""
    rests_on: tuple[str, ...] = ()
    """The tasks without whose cells the interval does not exclude 0 on the same side."""
    without_chosen: Interval | None = None
    """The effect without the tasks on which the designs were chosen (`Study.chosen_on`)."""

    @property
    def needs(self) -> tuple[str, ...]:
        """The tasks without which a decided claim would not be decided."""
        return self.rests_on if self.verdict in ("supported", "contradicted") else ()

    @property
    def apart(self) -> tuple[str, ...]:
        """The tasks in which the effect clearly matters, though over all of them it does not."""
        return tuple(
            task
            for task, effect in self.by_task.items()
            if self.verdict == "equivalent"
            and effect.sign
            and abs(effect.value) >= self.claim.smallest
        )

    @property
    def verdict(self) -> str:
        """`equivalent`, `supported`, `contradicted`, `undecided` or `not tested`."""
        level = 1 - CONFIDENCE
        if self.reason or self.effect is None:
            return "not tested"
        if self.p_equal < level:
            return "equivalent"
        if self.p >= level:
            return "undecided"
        sign = 1 if self.effect.value > 0 else -1
        return "supported" if sign == self.claim.predicted else "contradicted"


def claims(study: Study, summary: Summary, audit: Audit) -> list[ClaimOutcome]:
    """All claims of a study, in its order.

    Raises:
        UserError: for an agent, task, embodiment or variant that neither the records nor the audit
            nor SymSteer has.
    """
    _check_names(study, summary, audit)
    outcomes = [_outcome(claim, summary, audit, study.chosen_on) for claim in study.claims]
    families: dict[str, list[int]] = defaultdict(list)
    for index, outcome in enumerate(outcomes):
        if not outcome.reason:
            families[outcome.claim.family].append(index)
    for members in families.values():
        effects = [(outcomes[i].effect, outcomes[i].claim.smallest) for i in members]
        different = holm([p_difference(effect) for effect, _ in effects if effect])
        equal = holm([p_equivalence(effect, margin) for effect, margin in effects if effect])
        for index, p, p_equal in zip(members, different, equal, strict=True):
            outcomes[index] = replace(outcomes[index], p=p, p_equal=p_equal)
    return outcomes


def _check_names(study: Study, summary: Summary, audit: Audit) -> None:
    keys = [table.key for table in summary.tables]
    places = [*((k.task, k.embodiment, k.variant) for k in keys), *(p[:3] for p in audit)]
    variants = {name for place in places for name in (place[2], *_parts(place[2]))}
    valid = {
        "agent": [*ROW_ORDER, *(a for a in summary.agents if a not in ROW_ORDER)],
        "task": sorted({place[0] for place in places}),
        "embodiment": sorted({place[1] for place in places}),
        "variant": sorted(variants),
    }
    if study.safe and study.safe.agent not in valid["agent"]:
        raise unknown("agent", study.safe.agent, valid["agent"], f"{study.source}, safe")
    for name in study.kind.standard if study.kind else ():
        if name not in variants:
            raise unknown("variant", name, valid["variant"], f"{study.source}, kind")
    for claim in study.claims:
        named: list[tuple[str, tuple[str, ...]]] = [("agent", claim.agents)]
        for cells in (claim.cells, claim.minus or Cells()):
            named += [(k, getattr(cells, k) or ()) for k in ("task", "embodiment", "variant")]
        for kind, names in named:
            for name in names:
                # What has a schedule is known by what it is at the end of a run.
                if not {name, _at_the_end(name)} & set(valid[kind]):
                    raise unknown(kind, name, valid[kind], f"{study.source}, {claim.name!r}")


def _at_the_end(name: str) -> str:
    """A variant with a schedule as it is at the end: ``wind:1`` of ``wind:1@0.5``; others stay."""
    parts = parts_of(name)
    return variant_text(specs_at(parts, 1.0)) if parts else name


def _parts(variant: str) -> list[str]:
    """The variants that a text joins, without their strengths."""
    return [part.partition(":")[0] for part in variant.split("+")]


def _outcome(
    claim: Claim, summary: Summary, audit: Audit, chosen_on: tuple[str, ...]
) -> ClaimOutcome:
    sides: list[Used] = []
    for cells in (claim.cells, claim.minus):
        if cells is None:
            continue
        tables, reason = selected(cells, summary.tables, audit)
        used = [(table, pairs) for table in tables if (pairs := paired(table, claim))]
        if reason := reason or ("" if used else _without_pairs(tables, claim, cells)):
            return ClaimOutcome(claim, reason=reason)
        sides.append(used)
    reason = ""
    if any(max(len(pairs) for _, pairs in side) < MIN_SEEDS for side in sides):
        reason = f"fewer than {MIN_SEEDS} pairs of runs in every cell"
    else:
        sides = [[(t, pairs) for t, pairs in side if len(pairs) >= MIN_SEEDS] for side in sides]
    everything = [cell for side in sides for cell in side]
    effect: Effect | None
    behind = ""
    by_task: dict[str, Interval] = {}
    behind_by_task: dict[str, str] = {}
    rests_on: list[str] = []
    without_chosen: Interval | None = None
    if claim.effect == "slope":
        points = [
            Point(table, defect, pairs)
            for table, pairs in everything
            if (defect := defect_of(table.key, audit))
        ]
        fitted = fit(points)
        if fitted is None:
            return ClaimOutcome(claim, reason="no base policy was steered at two defects")
        everything = [(p.table, dict(p.pairs)) for p in points if p.setting in fitted.settings]
        effect, reason = combined([fitted.slope], [SLOPE_UNIT]), reason or fitted.reason
    else:
        drawn = _mean(sides)
        effect = drawn
        if claim.measure == "diverged":
            effect, behind = _shares(everything, claim, drawn)
            reason = reason if effect else "nobody diverged"
        else:
            behind = _means(sides[0], claim)
            by_task, without = _tasks(sides)
            behind_by_task = {
                task: _means([cell for cell in sides[0] if cell[0].key.task == task], claim)
                for task in by_task
            }
            chosen = " and ".join(chosen_on)
            others = [[cell for cell in s if cell[0].key.task not in chosen_on] for s in sides]
            if chosen and others != sides and all(others):
                without_chosen = without[chosen] = _mean(others).interval()
            sign = drawn.interval().sign
            rests_on = [task for task, left in without.items() if sign and left.sign != sign]
    pairs_used = {pair for _, pairs in everything for pair in pairs}
    return ClaimOutcome(
        claim,
        effect,
        cells=len(everything),
        pairs=sum(len(pairs) for _, pairs in everything),
        policies=len({policy for policy, _ in pairs_used}),
        reason=reason,
        behind=behind,
        by_task=by_task,
        behind_by_task=behind_by_task,
        rests_on=tuple(rests_on),
        without_chosen=without_chosen,
    )


def _mean(sides: Sequence[Used]) -> BootstrapEstimate:
    """Mean over the cells of the first side, less that of the second one if there is one."""
    weights = [sign / len(side) for sign, side in zip((1, -1), sides, strict=False) for _ in side]
    cells = [list(pairs.values()) for side in sides for _, pairs in side]
    return combined(cell_estimates(cells), weights)


def _tasks(sides: Sequence[Used]) -> tuple[dict[str, Interval], dict[str, Interval]]:
    """The effect in each of several tasks, and without each of them, where all sides have cells."""
    tasks = sorted({table.key.task for side in sides for table, _ in side})
    alone, without = {}, {}
    for task in tasks if len(tasks) > 1 else ():
        there = [[cell for cell in side if cell[0].key.task == task] for side in sides]
        elsewhere = [[cell for cell in side if cell[0].key.task != task] for side in sides]
        if all(there):
            alone[task] = _mean(there).interval()
        if all(elsewhere):
            without[task] = _mean(elsewhere).interval()
    return alone, without


def selected(cells: Cells, tables: Sequence[Table], audit: Audit) -> tuple[list[Table], str]:
    """The tables that a claim is about, and if there are none, why."""
    tables = [table for table in tables if _selects(cells, table.key, audit)]
    if not tables:
        return [], f"there are no {where(cells)}"
    if cells.demonstrations not in ("fewest", "most"):
        return tables, ""
    families: dict[Key, list[Table]] = defaultdict(list)
    for table in sorted(tables, key=lambda table: table.key.demonstrations):
        families[replace(table.key, demonstrations=0)].append(table)
    several = [family for family in families.values() if len(family) > 1]
    end = 0 if cells.demonstrations == "fewest" else -1
    reason = "" if several else "no cell was run with more than one number of demonstrations"
    return [family[end] for family in several], reason


def _selects(cells: Cells, key: Key, audit: Audit) -> bool:
    if cells.defect is not None:
        defect = defect_of(key, audit)
        if defect is None or not cells.defect[0] <= defect.value <= cells.defect[1]:
            return False
    return (
        (cells.broken is None or cells.broken == bool(key.broken_by))
        and (cells.task is None or key.task in cells.task)
        and (cells.embodiment is None or key.embodiment in cells.embodiment)
        and (cells.env_steps is None or key.env_steps in cells.env_steps)
        and (not isinstance(few := cells.demonstrations, tuple) or key.demonstrations in few)
        and (
            cells.variant is None
            or not {key.variant, *_parts(key.variant)}.isdisjoint(cells.variant)
        )
    )


def where(cells: Cells) -> str:
    """Which cells, in words."""
    if cells == Cells():
        return "all cells"
    words = {None: "", True: "broken ", False: "unbroken "}[cells.broken] + "cells"
    have = []
    if cells.defect is not None:
        have.append(f"a defect of {cells.defect[0]:g} to {cells.defect[1]:g}")
    for names in (cells.task, cells.embodiment, cells.variant):
        if names is not None:
            have.append(" or ".join(map(code, names)))
    if isinstance(cells.demonstrations, tuple):
        have.append(f"{_listed(cells.demonstrations)} demonstrations")
    elif cells.demonstrations is not None:
        have.append(f"the {cells.demonstrations} demonstrations")
    if cells.env_steps is not None:
        have.append(f"{_listed(cells.env_steps)} steps")
    return words + (f" with {', '.join(have)}" if have else "")


def _listed(numbers: Sequence[int]) -> str:
    return " or ".join(f"{number:,}" for number in numbers)


def _without_pairs(tables: Sequence[Table], claim: Claim, cells: Cells) -> str:
    """Why no runs of the two agents can be compared."""
    place = "" if cells == Cells() else f" in {where(cells)}"
    for agent in claim.agents:
        if not any(row.agent == agent and row.runs for table in tables for row in table.trusted):
            return f"no runs of {code(agent)}" + place
    if claim.measure == "bias":
        return "not measured over all decisions"
    return f"no runs of both agents with the same seed on the same base policy{place}"


def paired(table: Table, claim: Claim) -> dict[Pair, Sample]:
    """The difference of the two agents' measure, by pair of runs."""
    if claim.measure in MEASURES:
        return advantage(table, *claim.agents, claim.measure)
    values = [_values(table, agent, claim.measure) for agent in claim.agents]
    return {
        pair: Sample.constant(value - values[1][pair], pair[0])
        for pair, value in values[0].items()
        if pair in values[1]
    }


def _values(table: Table, agent: str, measure: str) -> dict[Pair, float]:
    """A number for each run of an agent that has it; of several recipes, of the usual one, or of
    that with most runs."""
    candidates = []
    for row in table.trusted:
        measured = {run.pair: run.measured(measure) for run in row.runs if row.agent == agent}
        values = {pair: value for pair, value in measured.items() if value is not None}
        candidates.append((bool(values), row.usual, len(values), values))
    return max(candidates, key=lambda each: each[:3], default=(False, False, 0, {}))[-1]


def _means(cells: Used, claim: Claim) -> str:
    """Both agents' measure, mean over cells of the runs that are paired."""
    means = []
    for agent in claim.agents:
        each = [
            fmean(values[pair] for pair in pairs)
            for table, pairs in cells
            if (values := _values(table, agent, claim.measure)).keys() >= pairs.keys()
        ]
        means.append(number(fmean(each), 2) if len(each) == len(cells) else NOTHING)
    return " against ".join(means)


def _shares(cells: Used, claim: Claim, drawn: BootstrapEstimate) -> tuple[Effect | None, str]:
    """A difference of shares, and the numbers behind it; no effect where nobody diverged.

    Where all units agree the draws have no width. Newcombe's interval takes their place, with the
    units as trials: runs on one policy, in one world or in several, are no independent trials.
    """
    sides = [[_values(table, agent, claim.measure) for table, _ in cells] for agent in claim.agents]
    counts = [
        sum(values[pair] for values, (_, pairs) in zip(side, cells, strict=True) for pair in pairs)
        for side in sides
    ]
    number = sum(len(pairs) for _, pairs in cells)
    text = " against ".join(f"{count:.0f}/{number}" for count in counts) + " diverged"
    if not any(counts):
        return None, text
    if np.ptp(drawn.units) > 1e-9:
        return drawn, text
    named = [units_of(list(pairs.values()), index) for index, (_, pairs) in enumerate(cells)]
    units = len({name for units in named for name in units})
    first, second = ((units * count / number, units) for count in counts)
    return ShareDifference(first, second), text


def render(outcomes: list[ClaimOutcome], view: View) -> list[str]:
    """The study's claims and their verdicts."""
    study = view.findings.study
    origin = f"They are declared in {code(study.source)} (sha256 {code(study.sha256[:12])}"
    if study.declared:
        origin += f", commit {code(study.declared)})."
    else:
        origin += "). The study names no commit that declared them before its runs."
    rows: list[dict[str, str]] = []
    untested: dict[str, list[str]] = {}
    for outcome in outcomes:
        claim = outcome.claim
        if outcome.effect is None:
            untested.setdefault(outcome.reason, []).append(title(claim))
            continue
        p_values = f"{p_text(outcome.p)}<br>{p_text(outcome.p_equal)}"
        rows.append(
            {
                "Claim (family)": f"{title(claim)} ({claim.family})",
                "Verdict": verdict_text(outcome),
                "Effect": test_text(claim),
                "Size, 95 % interval": size_text(outcome),
                "Smallest of interest": f"{claim.smallest:g}",
                "p: none; at least that": NOTHING if outcome.reason else p_values,
                "Cells, pairs, policies": f"{outcome.cells}, {outcome.pairs}, {outcome.policies}",
            }
        )
    if study.chosen_on:
        known = " and ".join(map(code, study.chosen_on))
        origin += f" *In new tasks*: without {known}, on which designs of agents were chosen."
    parts = [EXPLAINED, origin]
    if rows:
        parts.append(table_text(rows, left=3))
    if several := [outcome for outcome in outcomes if outcome.by_task]:
        by_task = [
            {"Claim": title(outcome.claim)}
            | {
                code(task): f"{interval(each, sign=True)}<br>{outcome.behind_by_task[task]}"
                for task, each in outcome.by_task.items()
            }
            for outcome in several
        ]
        parts += ["The same effects in each task:", table_text(by_task, sparse=True)]
    if untested:
        lines = [f"- {reason}: {'; '.join(names)}" for reason, names in untested.items()]
        parts.append("Not tested:\n\n" + "\n".join(lines))
    return parts


def title(claim: Claim) -> str:
    """Its name, and that it predicts no effect where it does: the name may sound otherwise."""
    return f"{claim.name} (predicted: no effect)" if claim.predicted == 0 else claim.name


def size_text(outcome: ClaimOutcome) -> str:
    """The effect, without the tasks of the designs, and the numbers behind it."""
    text = stacked(outcome.effect.interval() if outcome.effect else None, sign=True, digits=3)
    if left := outcome.without_chosen:
        text += f"<br>in new tasks: {interval(left, sign=True, digits=3)}"
    return text + (f"<br>{outcome.behind}" if outcome.behind else "")


def verdict_text(outcome: ClaimOutcome) -> str:
    text = f"**{outcome.verdict}**"
    if outcome.reason:
        return f"{text}: {outcome.reason}"
    if outcome.needs:
        text += f", rests on {', '.join(map(code, outcome.needs))}"
    if outcome.apart:
        text += f" on average, but not in {' or '.join(map(code, outcome.apart))}"
    if outcome.policies >= MIN_SEEDS or outcome.verdict == "undecided":
        return text
    policies = "one base policy" if outcome.policies == 1 else f"{outcome.policies} base policies"
    return f"{text}, for {policies} alone"


def test_text(claim: Claim) -> str:
    first, second = map(code, claim.agents)
    text = f"{MEASURE_WORDS[claim.measure]}, {first} minus {second}, {where(claim.cells)}"
    if claim.minus is not None:
        text += f" minus the same in {where(claim.minus)}"
    return f"slope of {text}" if claim.effect == "slope" else text


def p_text(value: float) -> str:
    return "< 0.001".replace(" ", SPACE) if value < 0.001 else number(value, 3)


def of_study(findings: Findings) -> list[ClaimOutcome]:
    """What became of the study's claims."""
    return claims(findings.study, findings.summary, findings.audit)


SECTION = Section("Claims, effects and p-values", of_study, render)
