"""Which agent to take in a world of which no record says anything: three rules.

*Kind*: what was better in other tasks whose world is broken in the same way.

*Probe*: play the base policy, its zero noise, and the best constant noise of a search
(`golden-ticket`). A constant noise treats one direction unlike the others, which a symmetric agent
cannot do. Where it gains much over the better of the other two, symmetry is in the way. How much is
much, a threshold, is learned from the records.

*Decisions*: where the base policy's own episodes are unlike on opposite sides, more than by chance
(`symsteer.policies.sides`), symmetry is in the way. This rule learns nothing from the records.

Where a rule is unsure it refuses. docs/advise.md has the rules' record.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean

import numpy as np
from scipy import stats

from symsteer.leaderboard.defects import dial_of, parts_of
from symsteer.leaderboard.keys import SYMMETRIC_EMBODIMENT
from symsteer.leaderboard.known_agents import BASE, CONSTANT, STANDARD, STRICT, ZERO
from symsteer.leaderboard.pairs import MEASURES, advantage
from symsteer.leaderboard.regret import Cell, regrets
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.statistics import Interval, stratified_bootstrap

LEAST_TASKS = 2
"""Other tasks that an answer needs."""

UNLIKE, ALIKE = 0.01, 0.1
"""p-values below the first: opposite sides are unlike; above the second: nothing says so."""


@dataclass(frozen=True)
class Lesson:
    """What the records say of a world.

    Attributes:
        table: its cell.
        gain: of the best constant noise; None if it was not played.
        advantage: of `STRICT` over `STANDARD`, by measure.
        rise: of the final success of each learner above the better of base policy and zero noise;
            none if these were not played.
        regret: of each learner, by measure.
        direction: p-value of the base policy's episodes being alike on all sides; None if unknown.
    """

    table: Table
    gain: Interval | None
    advantage: dict[str, Interval]
    rise: dict[str, float]
    regret: dict[str, dict[str, float]]
    direction: float | None = None

    @property
    def task(self) -> str:
        return self.table.key.task

    @property
    def kind(self) -> str:
        """How it is broken, without strengths."""
        return dial_of(self.table.key.variant)

    def sign(self, measure: str) -> int:
        """Of the advantage of `STRICT`; 0 if it is not decided."""
        return self.advantage[measure].sign if measure in self.advantage else 0


@dataclass(frozen=True)
class Question:
    """A world in which an agent is wanted.

    Attributes:
        kind: how it is broken, a variant without strength or `none`; empty if unknown.
        gain: of the best constant noise there; None if it was not played.
        direction: p-value of the base policy's episodes there being alike on all sides.
        measured: what the records say of this very world; None if they do not have it.
    """

    kind: str = ""
    gain: Interval | None = None
    direction: float | None = None
    measured: Lesson | None = None


@dataclass(frozen=True)
class Answer:
    """What a rule says.

    Attributes:
        sign: +1: `STRICT`; -1: `STANDARD`; 0: it refuses.
        reason: what it rests on, or why it refuses.
        change: what would change it.
        lessons: worlds like this one, by the rule.
    """

    sign: int
    reason: str
    change: str
    lessons: tuple[Lesson, ...] = ()


Rule = Callable[[Sequence[Lesson], Question, str], Answer]
"""From lessons of other tasks, a question and a measure."""


def lessons_of(summary: Summary) -> list[Lesson]:
    """Of the cells with the usual budget in which `STRICT` and `STANDARD` have enough policies.

    A world that changes in mid-run teaches nothing: its area is one of two worlds.
    """
    return [
        _lesson(table)
        for table in summary.usual_tables
        if {STRICT, STANDARD} <= table.decisive
        and all(spec.is_constant for spec in parts_of(table.key.variant) or ())
    ]


def _lesson(table: Table) -> Lesson:
    effects = {measure: advantage(table, STRICT, STANDARD, measure) for measure in MEASURES}
    learners = {name: row for name in sorted(table.decisive) if (row := table.row_of(name))}
    references = [row for name in (BASE, ZERO) if (row := table.row_of(name)) and row.success]
    best = max((row.success.value for row in references if row.success), default=None)
    rise = {
        name: row.success.value - best
        for name, row in learners.items()
        if row.success and best is not None
    }
    regret: dict[str, dict[str, float]] = {}
    for measure, attribute in zip(MEASURES, ("area", "success"), strict=True):
        values = {name: row.by_policy(attribute) for name, row in learners.items()}
        shared = sorted(set.intersection(*map(set, values.values())))
        regret[measure] = {}
        if len(shared) >= MIN_SEEDS:
            each = np.array([[values[name][policy] for policy in shared] for name in learners])
            found = regrets([Cell(each, shared)]).mean
            regret[measure] = dict(zip(learners, map(float, found), strict=True))
    return Lesson(
        table,
        gain_in(table),
        {m: stratified_bootstrap([list(pairs.values())]) for m, pairs in effects.items() if pairs},
        rise,
        regret,
        direction_in(table),
    )


def gain_in(table: Table) -> Interval | None:
    """What the best constant noise gains over the better of base policy and zero noise.

    In final success, with a 95 % interval over base policies and episodes; None if any of the three
    was not played on a common base policy.
    """
    rows = [row for name in (BASE, ZERO) if (row := table.row_of(name)) and row.success]
    if len(rows) < 2 or not table.row_of(CONSTANT):
        return None
    better = max(rows, key=lambda row: row.success.value if row.success else 0.0).agent
    pairs = advantage(table, CONSTANT, better, "success")
    return stratified_bootstrap([list(pairs.values())]) if pairs else None


def direction_in(table: Table) -> float | None:
    """p-value of the base policies' episodes being alike on all sides (Fisher's over runs).

    Runs share their initial states, so that of several runs it is not exact. None if it was not
    measured, or if policy or robot are not symmetric: sides then show that, and not the world.
    """
    key = table.key
    symmetric = key.embodiment == SYMMETRIC_EMBODIMENT and not key.base.startswith("plain")
    values = _of_base(table, "direction_p") if symmetric else []
    return float(stats.combine_pvalues(values).pvalue) if values else None


def drift_in(table: Table) -> tuple[float, float] | None:
    """Metres along x and y that the tool moves in each decision without being told to.

    The mean over runs of `BASE`; None if it was not measured.
    """
    along = [_of_base(table, name) for name in ("drift_x", "drift_y")]
    return (fmean(along[0]), fmean(along[1])) if all(along) else None


def _of_base(table: Table, name: str) -> list[float]:
    """A diagnostic of the finished runs of `BASE`, at their end."""
    row = table.row_of(BASE)
    return [v for run in row.finished if (v := run.last(name)) is not None] if row else []


def by_kind(lessons: Sequence[Lesson], question: Question, measure: str) -> Answer:
    """What was better in the worlds of other tasks that are broken in the same way.

    It refuses if there are too few of them, if none is decided, or if the decided ones disagree.
    """
    if not question.kind:
        return Answer(0, "the kind of break is not known", "to know how the world is broken")
    like = tuple(lesson for lesson in lessons if lesson.kind == question.kind)
    tasks = {lesson.task for lesson in like}
    more = "more such worlds in which one agent is clearly better"
    if len(tasks) < LEAST_TASKS:
        few = f"other tasks with such a world: {len(tasks)}, {LEAST_TASKS} are needed"
        return Answer(0, few, more)
    signs = [sign for lesson in like if (sign := lesson.sign(measure))]
    if not signs:
        return Answer(0, f"no difference is clear in {len(like)} such worlds", more, like)
    if len(set(signs)) > 1:
        either = f"of {len(like)} such worlds, some are won by either"
        return Answer(0, either, "nothing, as long as the records have these worlds", like)
    reason = f"{len(signs)} of {len(like)} such worlds are decided, and agree"
    other = STANDARD if signs[0] > 0 else STRICT
    return Answer(signs[0], reason, f"one such world in which {other} is clearly better", like)


def by_probe(lessons: Sequence[Lesson], question: Question, measure: str) -> Answer:
    """Whether the best constant noise gains more than the records' threshold.

    It refuses if the interval of the gain holds the threshold.
    """
    known = [lesson for lesson in lessons if lesson.gain]
    limit = threshold(known, measure)
    more = "records of more probed worlds"
    if len({lesson.task for lesson in known}) < LEAST_TASKS:
        return Answer(0, f"fewer than {LEAST_TASKS} other tasks were probed", more)
    if limit is None:
        return Answer(0, "in the probed worlds that are decided, one agent always wins", more)
    if question.gain is None:
        return Answer(0, "the world was not probed", f"a gain clearly above or below {limit:+.3f}")
    low, high = question.gain.low, question.gain.high
    if low < limit <= high:
        unclear = f"the gain may lie on either side of {limit:+.3f}"
        return Answer(0, unclear, "a narrower interval: more base policies, or more episodes")
    above = low >= limit
    like = tuple(one for one in known if one.gain and (one.gain.value >= limit) == above)
    word, side = ("at least", "below") if above else ("less than", "above")
    reason, change = f"a constant noise gains {word} {limit:+.3f}", f"a gain clearly {side} it"
    return Answer(-1 if above else 1, reason, change, like)


def by_decisions(lessons: Sequence[Lesson], question: Question, measure: str) -> Answer:
    """Whether the base policy's episodes are unlike on opposite sides.

    It refuses if the p-value lies between the two limits.
    """
    p = question.direction
    unlike, alike = f"unlike sides (p below {UNLIKE})", f"sides that look alike (p above {ALIKE})"
    if p is None:
        change = f"a run of base, not of an arm: {unlike}, or {alike}"
        return Answer(0, "no decisions are known", change)
    if UNLIKE <= p <= ALIKE:
        unclear = f"whether opposite sides are alike is unclear (p = {p:.3f})"
        return Answer(0, unclear, f"more episodes: {unlike}, or {alike}")
    known = tuple(one for one in lessons if one.direction is not None)
    if p < UNLIKE:
        like = tuple(one for one in known if (one.direction or 0.0) < UNLIKE)
        return Answer(-1, f"opposite sides are unlike (p = {p:.3f})", alike, like)
    like = tuple(one for one in known if (one.direction or 0.0) > ALIKE)
    return Answer(1, f"opposite sides look alike (p = {p:.3f})", unlike, like)


RULES: dict[str, Rule] = {"kind": by_kind, "probe": by_probe, "decisions": by_decisions}


def threshold(lessons: Sequence[Lesson], measure: str) -> float | None:
    """The gain that best tells where `STANDARD` wins: fewest wrong signs of the decided worlds.

    Halfway between two worlds; of several equally good thresholds the middle one. None if the
    decided worlds have one sign, or one gain.
    """
    decided = sorted(
        (lesson.gain.value, sign)
        for lesson in lessons
        if lesson.gain and (sign := lesson.sign(measure))
    )
    if len({sign for _, sign in decided}) < 2:
        return None
    gains = [gain for gain, _ in decided]
    candidates = [(a + b) / 2 for a, b in pairwise(gains) if a < b]
    errors = [sum((gain >= limit) == (sign > 0) for gain, sign in decided) for limit in candidates]
    best = [limit for limit, e in zip(candidates, errors, strict=True) if e == min(errors)]
    return best[len(best) // 2] if best else None


# What they say together.


@dataclass(frozen=True)
class Advice:
    """What to take in a world, for one measure.

    Attributes:
        answers: of each rule.
        agent: to take.
        refused: whether no rule has an answer, or two disagree, so that the agent is the fallback.
        rise: expected of its final success above the better of base policy and zero noise, with the
            interval of 95 % of such worlds; None if fewer than three such worlds tell.
        regret: expected, likewise.
        worlds: how many worlds are like this one.
    """

    measure: str
    answers: dict[str, Answer]
    agent: str
    refused: bool
    rise: Interval | None
    regret: Interval | None
    worlds: int


def advise(
    lessons: Sequence[Lesson],
    question: Question,
    measure: str,
    fallback: str = STANDARD,
    rules: Iterable[str] = RULES,
) -> Advice:
    """What to take.

    Args:
        lessons: of other tasks.
        question: the world.
        measure: one of `MEASURES`.
        fallback: the agent that is safe where the rules refuse.
        rules: those that count.
    """
    answers = {name: RULES[name](lessons, question, measure) for name in rules}
    if question.measured:
        measured = _measured(question.measured, measure)
        # What was measured in this very world counts before all rules.
        answers = {"records": measured} | ({} if measured.sign else answers)
    signs = {answer.sign for answer in answers.values()} - {0}
    refused = len(signs) != 1
    agent = fallback if refused else STRICT if signs.pop() > 0 else STANDARD
    said = [answer.lessons for answer in answers.values() if refused or answer.sign]
    like = list({id(one): one for group in said for one in group}.values()) or list(lessons)
    rises = [one.rise[agent] for one in like if agent in one.rise]
    lost = [one.regret[measure][agent] for one in like if agent in one.regret[measure]]
    return Advice(measure, answers, agent, refused, _predicted(rises), _predicted(lost), len(like))


def _measured(lesson: Lesson, measure: str) -> Answer:
    effect = lesson.advantage.get(measure)
    change = "more runs in this world"
    if effect is None:
        return Answer(0, "no paired runs", change)
    bounds = f"[{effect.low:+.3f}, {effect.high:+.3f}]"
    text = f"{STRICT} minus {STANDARD} is {effect.value:+.3f} {bounds}"
    reason = text if effect.sign else f"undecided: {text}"
    return Answer(effect.sign, reason, change, (lesson,))


def _predicted(values: Sequence[float]) -> Interval | None:
    """Mean, and the interval in which a further world lies with 95 % (normal)."""
    if len(values) < 3:
        return None
    spread = float(np.std(values, ddof=1)) * (1 + 1 / len(values)) ** 0.5
    half = float(stats.t.ppf(0.975, len(values) - 1)) * spread
    return Interval(fmean(values), fmean(values) - half, fmean(values) + half)


# How it would have been for a task without records.


@dataclass(frozen=True)
class Score:
    """How rules would have answered for tasks that they know nothing of.

    Attributes:
        rule: its name, or those of all.
        worlds: that are decided.
        answered, right: of these.
        regret: mean over all worlds, decided or not, of the agent that was advised.
        fixed: the same of an agent that is taken everywhere.
    """

    rule: str
    measure: str
    worlds: int
    answered: int
    right: int
    regret: float
    fixed: dict[str, float]


def leave_tasks_out(lessons: Sequence[Lesson], fallback: str = STANDARD) -> list[Score]:
    """Each world is asked about with the lessons of the other tasks alone, if these are enough."""
    found: list[Score] = []
    if len({lesson.task for lesson in lessons}) <= LEAST_TASKS:
        return found
    told = {"kind": True, "probe": any(lesson.gain for lesson in lessons)}
    told["decisions"] = any(lesson.direction is not None for lesson in lessons)
    asked = [name for name in RULES if told[name]]
    choices = [(name,) for name in asked] + ([tuple(asked)] if len(asked) > 1 else [])
    for measure in MEASURES:
        for rules in choices:
            answered = right = worlds = 0
            regret: dict[str, list[float]] = defaultdict(list)
            advised: list[float] = []
            for lesson in lessons:
                others = [other for other in lessons if other.task != lesson.task]
                question = Question(lesson.kind, lesson.gain, lesson.direction)
                advice = advise(others, question, measure, fallback, rules)
                known = lesson.regret[measure]
                if {STRICT, STANDARD, fallback} <= known.keys():
                    for agent in (STRICT, STANDARD, fallback):
                        regret[agent].append(known[agent])
                    advised.append(known[advice.agent])
                if sign := lesson.sign(measure):
                    worlds += 1
                    answered += not advice.refused
                    right += not advice.refused and advice.agent == (
                        STRICT if sign > 0 else STANDARD
                    )
            if worlds and advised:
                fixed = {agent: fmean(values) for agent, values in regret.items()}
                name = " and ".join(rules)
                found.append(Score(name, measure, worlds, answered, right, fmean(advised), fixed))
    return found
