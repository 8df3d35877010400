"""``symsteer advise``: which agent to take in a world, from the records and from a probe in it."""

from __future__ import annotations

import dataclasses
import json as encoding
from pathlib import Path
from typing import TYPE_CHECKING

from symsteer.bench.cli import Trust
from symsteer.errors import UserError
from symsteer.registry import allow
from symsteer.tables import aligned
from symsteer.terminal import printable

if TYPE_CHECKING:
    from symsteer.leaderboard.rows import Table
    from symsteer.leaderboard.statistics import Interval
    from symsteer.leaderboard.which_agent import Advice, Lesson, Question, Score

ASK = (
    "To know more, play base, zero and golden-ticket in this world (symsteer run --agent NAME), "
    "and name their runs with --probe."
)


def advise(
    task: str | None = None,
    embodiment: str = "floating",
    variant: str = "none",
    broken_by: str | None = None,
    probe: tuple[Path, ...] = (),
    runs: tuple[Path, ...] = (),
    json: bool = False,
    trust: Trust = (),
) -> int:
    """Say which agent to take in a world, and how sure that is (docs/advise.md).

    The world is named by --task and --variant, or, if SymSteer does not have it, by how it is
    broken (--broken-by), by a probe in it, or by both.

    Args:
        task: Task; `symsteer list` names them.
        embodiment: floating or panda.
        variant: How the symmetry is broken, e.g. action_gain:0.5, or none.
        broken_by: The variant that is most like your world, without strength, or none: e.g.
            perception_bias if a camera is displaced.
        probe: Folders of finished runs in your world: of the agent base, whose decisions are asked
            whether sides are alike, and of zero and golden-ticket, if a constant noise shall tell.
        runs: Folders of runs or records to learn from. Default: the committed records.
        json: Print only JSON, with every number.
    """
    allow(task, variant, *trust)
    if not (task or broken_by or probe):
        raise UserError("name a world: with --task and --variant, --broken-by, or --probe RUNS")
    if task and broken_by:
        raise UserError("name the world either with --task and --variant, or with --broken-by")
    from symsteer.leaderboard.known_agents import STANDARD
    from symsteer.leaderboard.pairs import MEASURES
    from symsteer.leaderboard.paths import REPRODUCTIONS, STUDY, chosen_records
    from symsteer.leaderboard.row_numbers import summarize
    from symsteer.leaderboard.runs import load_runs
    from symsteer.leaderboard.sections.regret import fallback
    from symsteer.leaderboard.study import FOLDER, read_list, read_study
    from symsteer.leaderboard.which_agent import (
        Question,
        advise,
        drift_in,
        leave_tasks_out,
        lessons_of,
    )

    folders = chosen_records(runs, "advise", "--runs RUNS")
    # Mistakes first: to read the records takes seconds.
    if task:
        _known(task, embodiment, variant)
    question = Question(_kind(broken_by, variant if task else None))
    probed = _probed(probe) if probe else None
    # Of the committed records, submitted ones that nobody has made again give no advice.
    listed = None if runs else read_list(FOLDER / f"{STUDY}.toml")
    marks = None if runs else REPRODUCTIONS
    summaries = [summarize(load_runs([folder], marks, listed)) for folder in folders]
    lessons = [lesson for summary in summaries for lesson in lessons_of(summary)]
    if not lessons:
        raise UserError("no cell of these records has 5 base policies of equivariant and standard")
    otherwise = STANDARD if runs else fallback(summaries[0], read_study(STUDY).safe)
    here = _here(lessons, task, embodiment, variant)
    others = [lesson for lesson in lessons if lesson.task != task]
    gain, direction = (here.gain, here.direction) if here else (None, None)
    drift = drift_in(probed) if probed else None
    if probed:
        gain, direction = _found(probed)
    question = dataclasses.replace(question, gain=gain, direction=direction, measured=here)
    advices = [advise(others, question, measure, otherwise) for measure in MEASURES]
    scores = leave_tasks_out(lessons, otherwise)
    if json:
        data = {
            "worlds": len(lessons),
            "gain": gain,
            "direction": direction,
            "drift": drift,
            "advice": [_as_data(one) for one in advices],
            "left_out": [dataclasses.asdict(score) for score in scores],
        }
        print(encoding.dumps(data, indent=1, allow_nan=False, default=dataclasses.asdict))
        return 0
    tasks = len({lesson.task for lesson in lessons})
    blocks = [
        f"From {len(lessons)} worlds of {tasks} tasks, of {len(folders)} "
        f"{'study' if len(folders) == 1 else 'studies'}.",
        _facts(question, drift),
        *map(_text, advices),
        *([ASK] if probed is None and any(one.refused for one in advices) else []),
        _record(scores),
    ]
    print(printable("\n\n".join(blocks)))
    return 0


def _known(task: str, embodiment: str, variant: str) -> None:
    """Refuse a world that SymSteer does not have."""
    from symsteer.bench.audit.result import AuditSettings
    from symsteer.bench.audit.study import cells

    named = cells([task], [variant], AuditSettings(embodiment=embodiment))
    if len(named) != 1:
        raise UserError("name one task and one variant, not all")
    named[0].check()


def _kind(broken_by: str | None, variant: str | None) -> str:
    from symsteer.bench.variants import VARIANTS
    from symsteer.leaderboard.defects import dial_of
    from symsteer.names import check
    from symsteer.variant import UNBROKEN

    if broken_by is None:
        return dial_of(variant) if variant else ""
    check("kind of break", [broken_by], [UNBROKEN, *VARIANTS])
    return broken_by


def _probed(folders: tuple[Path, ...]) -> Table:
    """The one world of a probe."""
    from symsteer.leaderboard.row_numbers import summarize
    from symsteer.leaderboard.runs import load_runs

    tables = summarize(load_runs(folders)).tables
    if len(tables) != 1:
        raise UserError(
            f"the probe has runs of {len(tables)} worlds, with one budget and one setting each: "
            "name runs of one"
        )
    return tables[0]


def _found(table: Table) -> tuple[Interval | None, float | None]:
    """What a probe tells: the gain of the best constant noise, and whether sides are alike."""
    from symsteer.leaderboard.which_agent import direction_in, gain_in

    gain, direction = gain_in(table), direction_in(table)
    if gain is None and direction is None:
        raise UserError(
            "the probe needs runs of base, zero and golden-ticket on the same base policy; with "
            "the gripper, a run of base with this version is enough"
        )
    return gain, direction


def _here(lessons: list[Lesson], task: str | None, embodiment: str, variant: str) -> Lesson | None:
    """What the records say of the named world; of several studies, the first one."""
    from symsteer.leaderboard.defects import in_order

    place = task, embodiment, in_order(variant)
    for lesson in lessons:
        key = lesson.table.key
        if (key.task, key.embodiment, in_order(key.variant)) == place:
            return lesson
    return None


def _as_data(advice: Advice) -> dict[str, object]:
    answers = {
        rule: {
            "sign": answer.sign,
            "reason": answer.reason,
            "change": answer.change,
            "worlds": len(answer.lessons),
        }
        for rule, answer in advice.answers.items()
    }
    return {**vars(advice), "answers": answers}


# What the terminal shows.


def _facts(question: Question, drift: tuple[float, float] | None) -> str:
    facts = [["kind of break", question.kind or "not known"]]
    gain = _interval(question.gain) if question.gain else "not played"
    facts.append(["gain of the best constant noise", gain])
    alike = "not known" if question.direction is None else f"p = {question.direction:.3f}"
    facts.append(["opposite sides are alike", alike])
    if drift:
        along = " and ".join(f"{100 * d:+.2f}" for d in drift)
        facts.append(["drift of the tool", f"{along} cm a decision, along x and y"])
    return aligned([], facts, left=2)


def _text(advice: Advice) -> str:
    says = {1: "take equivariant", -1: "take standard", 0: "no answer"}
    rows = [[rule, says[one.sign], one.reason] for rule, one in advice.answers.items()]
    why = ", because the rules refuse" if advice.refused else ""
    lines = [f"{advice.measure}: take {advice.agent}{why}"]
    lines += [f"  {line}" for line in aligned([], rows, left=3).splitlines()]
    if advice.rise:
        lines.append(f"  success above the better of base and zero: {_interval(advice.rise)}")
    if advice.regret:
        lines.append(f"  below the best learner: {_interval(advice.regret)}")
    if advice.rise or advice.regret:
        lines.append(f"  (in brackets: 95 % of such worlds, estimated from {advice.worlds})")
    changes = [[f"    {rule}", one.change] for rule, one in advice.answers.items()]
    lines += ["  what would change these answers", *aligned([], changes, left=2).splitlines()]
    return "\n".join(lines)


def _interval(interval: Interval) -> str:
    return f"{interval.value:+.3f} [{interval.low:+.3f}, {interval.high:+.3f}]"


def _record(scores: list[Score]) -> str:
    from symsteer.leaderboard.sections.unknown_task import scores as rows_of

    if not scores:
        return "Test on tasks that are left out: not possible, the records have too few tasks."
    rows = rows_of(scores)
    header = [name.replace("`", "") for name in rows[0]]
    table = aligned(header, [list(row.values()) for row in rows], left=2)
    return f"Test: each world from the runs of the other tasks\n{table}"
