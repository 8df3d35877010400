"""``symsteer advise``: which agent to take in a world, from its audit and from the records."""

from __future__ import annotations

import dataclasses
import json as encoding
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from symsteer.bench.cli import Trust
from symsteer.errors import UserError
from symsteer.registry import allow
from symsteer.tables import aligned
from symsteer.terminal import printable, to_paste

if TYPE_CHECKING:
    from symsteer.leaderboard.defects import Audit
    from symsteer.leaderboard.sections.unknown_task import LeaveOut
    from symsteer.leaderboard.statistics import Interval
    from symsteer.leaderboard.which_agent import Advice, AuditedWorld, Choice, Expected


def advise(
    task: str | None = None,
    embodiment: str = "floating",
    variant: str = "none",
    group: str = "C8",
    audit: Path | None = None,
    runs: tuple[Path, ...] = (),
    json: bool = False,
    trust: Trust = (),
) -> int:
    """Say which agent to take in a world, and how sure that is (docs/advise.md).

    The world is named by --task, if the committed audit has it, or by what `symsteer audit` wrote.

    Args:
        task: Task; `symsteer list` names them.
        embodiment: floating or panda.
        variant: How the symmetry is broken, e.g. action_gain:0.5, or none.
        group: Symmetry group, e.g. C8, D4 (with reflections).
        audit: What `symsteer audit --out` wrote: its folder, audit.json or summary.json.
        runs: Folders of runs or records. Runs of different folders are not compared. Default: the
            committed records.
        json: Print only JSON, with every number.
    """
    allow(task, variant, *trust)
    if (task is None) == (audit is None):
        raise UserError("name one world: with --task and --variant, or with --audit")
    from symsteer.leaderboard.defects import read_audit
    from symsteer.leaderboard.paths import REPRODUCTIONS, STUDY, chosen_records
    from symsteer.leaderboard.row_numbers import summarize
    from symsteer.leaderboard.runs import load_runs
    from symsteer.leaderboard.sections.unknown_task import leave_tasks_out
    from symsteer.leaderboard.study import FOLDER, read_list
    from symsteer.leaderboard.which_agent import advise

    folders = chosen_records(runs, "advise", "--runs RUNS")
    defects = read_audit()
    # Mistakes first: to read the records takes seconds.
    if task is not None:
        worlds = [(_committed(task, embodiment, variant, group, defects), "committed audit")]
    else:
        assert audit is not None
        worlds = [(world, f"measured, {audit}") for world in _audited(audit)]
    # Of the committed records, submitted ones that nobody has made again give no advice.
    listed = None if runs else read_list(FOLDER / f"{STUDY}.toml")
    marks = None if runs else REPRODUCTIONS
    summaries = [summarize(load_runs([folder], marks, listed)) for folder in folders]
    embodiments = dict.fromkeys(world.embodiment for world, _ in worlds)
    tests = [leave_tasks_out(summaries, defects, name) for name in embodiments]
    advices = [(advise(summaries, defects, world), source) for world, source in worlds]
    number = sum(len(summary.runs) for summary in summaries)
    if json:
        data = {
            "runs": number,
            "advice": [dataclasses.asdict(one) | {"audit": source} for one, source in advices],
            "left_out": [dataclasses.asdict(test) for test in tests],
        }
        print(encoding.dumps(data, indent=1, allow_nan=False))
        return 0
    studies = f"{len(folders)} studies" if len(folders) > 1 else "one study"
    blocks = [f"From {number} runs of {studies}."]
    blocks += [_text(advice, source) for advice, source in advices] + list(map(_test_text, tests))
    print(printable("\n\n".join(blocks)))
    return 0


def _committed(task: str, embodiment: str, variant: str, group: str, audit: Audit) -> AuditedWorld:
    """A world of the committed audit."""
    from symsteer.bench.audit.result import AuditSettings
    from symsteer.bench.audit.study import cells
    from symsteer.leaderboard.defects import in_order
    from symsteer.leaderboard.which_agent import AuditedWorld

    named = cells([task], [variant], AuditSettings(embodiment=embodiment, group=group))
    if len(named) != 1:
        raise UserError("name one task and one variant, not all")
    (settings,) = named
    settings.check()
    place = settings.task, settings.embodiment, in_order(settings.variant), settings.group
    if defect := audit.get(place):
        return AuditedWorld(*place, defect)
    where = ("--task", task, "--embodiment", embodiment, "--variant", variant, "--group", group)
    measure = to_paste("symsteer", "audit", *where, "--out", "found")
    raise UserError(
        f"the committed audit has no {variant} of {task}, {embodiment}, {group}; measure it with: "
        f"{measure}; then: symsteer advise --audit found"
    )


def _audited(path: Path) -> list[AuditedWorld]:
    """The worlds of an audit's file or folder."""
    from symsteer.bench.audit.report import read_result, summary, summary_json

    names = ("summary.json", "audit.json")
    if path.is_dir():
        held = [path / name for name in names if (path / name).is_file()]
        if not held:
            raise UserError(
                f"{path} holds no audit: name the folder, or the {' or '.join(names)}, that "
                "`symsteer audit --out` wrote"
            )
        path = held[0]
    if path.name == names[1]:
        return list(_worlds(summary_json([summary(read_result(path))]).encode(), path))
    try:
        return list(_worlds(path.read_bytes(), path))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}; name another audit") from error


def _worlds(data: bytes, path: Path) -> Iterator[AuditedWorld]:
    from symsteer.leaderboard.defects import parse_audit
    from symsteer.leaderboard.which_agent import AuditedWorld

    for place, defect in parse_audit(data, path).items():
        yield AuditedWorld(*place, defect)


# What the terminal shows.


def _text(advice: Advice, source: str) -> str:
    world, defect = advice.world, advice.world.defect
    facts = [
        ["defect of a decision", f"{_interval(defect.interval, '.3f')}, of the {defect.part}"],
        ["from", source],
        ["kind of break", " or else ".join(world.kinds)],
    ]
    lines = [f"{world.task}, {world.embodiment}, {world.variant}, {world.group}"]
    lines.append(aligned([], facts, left=2))
    if defect.resets_differ:
        lines.append("its initial states are broken, too, which is no part of a decision")
    if advice.expected:
        lines += [
            "",
            "Expected advantage over standard, with 95 % intervals (?: too little to decide):",
        ]
        header = ["agent", "measure", "from", "line of", "advantage", "cells", "policies", "tasks"]
        lines.append(aligned(header, [_expected(one) for one in advice.expected], left=4))
    lines += ["", *(_choice(choice) for choice in advice.choices)]
    return "\n".join(lines)


def _expected(one: Expected) -> list[str]:
    shown = "-" if one.value is None else f"{one.value:+.3f}"
    if one.interval:
        shown = _interval(one.interval, "+.3f")
    mark = " ?" if one.reasons else "  "
    numbers = (str(number) for number in (one.cells, one.policies, one.tasks))
    return [one.agent, one.measure, one.source, one.kind, shown + mark, *numbers]


def _interval(interval: Interval, digits: str) -> str:
    value, low, high = (format(v, digits) for v in (interval.value, interval.low, interval.high))
    return f"{value} [{low}, {high}]"


def _choice(choice: Choice) -> str:
    if not choice.agents:
        return f"{choice.measure}: undecided, because {choice.reason}"
    first, *others = choice.agents
    text = f"{choice.measure}: take {first}"
    if others:
        text += f"; also clearly above standard: {', '.join(others)}; which of them is not decided"
    return text


def _test_text(test: LeaveOut) -> str:
    """How expectations would have been without a task's own cells."""
    from symsteer.leaderboard.rows import MIN_SEEDS
    from symsteer.leaderboard.sections.unknown_task import best_agents, scores

    title = f"Test: each task from the runs of the other tasks ({test.embodiment})"
    if not test.agents:
        return (
            f"{title}: not possible; tasks with audited cells of at least {MIN_SEEDS} base "
            f"policies: {len(test.tasks)}."
        )
    rows = scores(test)
    shown = [[value.replace("`", "") for value in row.values()] for row in rows]
    table = aligned(list(rows[0]), shown, left=3)
    return f"{title}:\n{table}\n{best_agents(test)}".replace("`", "")
