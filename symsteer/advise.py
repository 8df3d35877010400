"""``symsteer advise``: which agent to take in a world, from its audit and from the records."""

from __future__ import annotations

import dataclasses
import json as encoding
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symsteer.bench.cli import Trust
from symsteer.errors import UserError
from symsteer.registry import allow
from symsteer.terminal import printable

if TYPE_CHECKING:
    from symsteer.bench.audit.result import AuditSettings
    from symsteer.leaderboard.advice import Advice, Choice, Expected, LeaveOut, World
    from symsteer.leaderboard.defects import Audit


def advise(
    task: str | None = None,
    embodiment: str = "floating",
    variant: str = "none",
    group: str = "C8",
    audit: Path | None = None,
    records: tuple[Path, ...] = (),
    states: int = 32,
    runs: Path = Path("runs"),
    json: Path | None = None,
    trust: Trust = (),
) -> int:
    """Say which agent to take in a world, and how sure that is (docs/advise.md).

    The world is named by --task, or by a file of `symsteer audit`. What the committed audit does
    not have is measured first.

    Args:
        task: Task; `symsteer list` names them.
        embodiment: floating or panda.
        variant: How the symmetry is broken, e.g. action_gain:0.5, or none.
        group: Group of the base policy.
        audit: What `symsteer audit --out` wrote, the folder or its audit.json or summary.json.
        records: Folders of runs or records, each a study of its own; default: the committed
            records.
        states: States of the expert and of the base policy, each, of an audit that is measured.
        runs: Folder of the runs; base policies of an audit that is measured are kept in RUNS/base.
        json: Write everything into this file, too.
    """
    allow(task, variant, *trust)
    if (task is None) == (audit is None):
        raise UserError("name one world: with --task and --variant, or with --audit")
    from symsteer.leaderboard.advice import advise, leave_tasks_out
    from symsteer.leaderboard.defects import read_audit
    from symsteer.leaderboard.paths import REPRODUCTIONS, STUDY, chosen_records
    from symsteer.leaderboard.study import FOLDER, read_list
    from symsteer.leaderboard.summary import load_runs, summarize

    folders = chosen_records(records, "advise", "--records RUNS")
    # Mistakes first: to read the records takes seconds, to measure a world minutes.
    settings = None
    if audit is not None:
        worlds = [(world, f"measured, {audit}") for world in _audited(audit)]
    else:
        settings = _named(task or "", embodiment, variant, group, states)
    # Of the committed records, submitted ones that nobody has made again give no advice.
    listed = None if records else read_list(FOLDER / f"{STUDY}.toml")
    marks = None if records else REPRODUCTIONS
    summaries = [summarize(load_runs([folder], marks, listed)) for folder in folders]
    defects = read_audit()
    if settings is not None:
        worlds = [_world(settings, runs, defects)]
    embodiments = list(dict.fromkeys(world.embodiment for world, _ in worlds))
    tests = [leave_tasks_out(summaries, defects, name) for name in embodiments]
    advices = [advise(summaries, defects, world) for world, _ in worlds]
    number = sum(len(summary.runs) for summary in summaries)
    blocks = [_text(found, source) for found, (_, source) in zip(advices, worlds, strict=True)]
    blocks += [_test_text(test) for test in tests]
    studies = f"{len(folders)} studies" if len(folders) > 1 else "one study"
    print(printable("\n\n".join([f"From {number} runs of {studies}.", *blocks])))
    if json is not None:
        from symsteer.files import write_atomically

        data = {
            "runs": number,
            "advice": [
                {**dataclasses.asdict(found), "audit": source}
                for found, (_, source) in zip(advices, worlds, strict=True)
            ],
            "left_out": [dataclasses.asdict(test) for test in tests],
        }
        write_atomically(json, (encoding.dumps(data, indent=1, allow_nan=False) + "\n").encode())
        print(printable(f"\nwrote {json}"))
    return 0


def _named(task: str, embodiment: str, variant: str, group: str, states: int) -> AuditSettings:
    """The settings of an audit of a world that is named."""
    from symsteer.bench.audit.result import AuditSettings
    from symsteer.bench.audit.study import cells

    template = AuditSettings(embodiment=embodiment, group=group, count=states)
    named = cells([task], [variant], template)
    if len(named) != 1:
        raise UserError("name one task and one variant, not all")
    (settings,) = named
    settings.check()
    return settings


def _world(settings: AuditSettings, runs: Path, audit: Audit) -> tuple[World, str]:
    """A world with its committed or measured defect, and where that is from."""
    from symsteer.leaderboard.advice import World
    from symsteer.leaderboard.defects import in_order

    place = settings.task, settings.embodiment, in_order(settings.variant), settings.group
    if defect := audit.get(place):
        return World(*place, defect), "committed audit"
    return _measure(settings, runs), f"measured now, {settings.count} states"


def _measure(settings: AuditSettings, runs: Path) -> World:
    from symsteer.bench.audit.report import summary, summary_json
    from symsteer.bench.audit.study import run_audits

    (result,) = run_audits([settings], runs)
    return next(_worlds(summary_json([summary(result)]).encode(), runs))


def _audited(path: Path) -> list[World]:
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


def _worlds(data: bytes, path: Path) -> Iterator[World]:
    from symsteer.leaderboard.advice import World
    from symsteer.leaderboard.defects import parse_audit

    for place, defect in parse_audit(data, path).items():
        yield World(*place, defect)


# What the terminal shows.


def _text(advice: Advice, source: str) -> str:
    world, defect = advice.world, advice.world.defect
    lines = [
        f"{world.task}, {world.embodiment}, {world.variant}, {world.group}",
        f"defect of a decision  {_interval(defect.interval, '.3f')}, of the {defect.part}",
        f"from                  {source}",
        f"kind of break         {' or else '.join(world.kinds)}",
    ]
    if defect.resets_differ:
        lines.append("its initial states are broken, too, which is no part of a decision")
    if advice.expected:
        lines += ["", "Expected advantage over standard, 95 % interval; ? decides nothing:"]
        head = ("agent", "measure", "advantage", "from", "line of")
        lines.append(_row(*head, "cells", "policies", "tasks"))
        lines += [_expected(one) for one in advice.expected]
    lines += ["", *(_choice(choice) for choice in advice.choices)]
    return "\n".join(lines)


def _expected(one: Expected) -> str:
    shown = "-" if one.value is None else f"{one.value:+.3f}"
    if one.interval:
        shown = _interval(one.interval, "+.3f")
    mark = " ?" if one.reasons else "  "
    numbers = (str(one.cells), str(one.policies), str(one.tasks))
    return _row(one.agent, one.measure, shown + mark, one.source, one.kind, *numbers)


def _row(*cells: str) -> str:
    return "{:18s} {:8s} {:>27s}  {:11s} {:16s} {:>5s} {:>8s} {:>5s}".format(*cells)


def _interval(found: Any, digits: str) -> str:
    value, low, high = (format(v, digits) for v in (found.value, found.low, found.high))
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
    from symsteer.leaderboard.summary import MIN_SEEDS

    title = f"Tested by leaving out one task after the other ({test.embodiment})"
    if not test.agents:
        return (
            f"{title}: not possible; tasks with audited cells of at least {MIN_SEEDS} base "
            f"policies: {len(test.tasks)}."
        )
    lines = [f"{title}, of {len(test.tasks)}:"]
    lines.append(_tested("agent", "measure", "sign right", "of clear ones", "inside", "error"))
    for row in test.agents:
        lines.append(
            _tested(
                row.agent,
                row.measure,
                _share(row.right, row.cells),
                _share(row.clear_right, row.clear),
                _share(row.inside, row.with_interval),
                f"{row.error:.3f}",
            )
        )
    for best in test.best:
        lines.append(
            f"best agent by {best.measure}: right in {_share(best.right, best.cells)} cells; the "
            f"one that is best on average elsewhere: {_share(best.usual, best.cells)}"
        )
    return "\n".join(lines)


def _tested(*cells: str) -> str:
    return "{:18s} {:8s} {:>16s} {:>16s} {:>16s} {:>8s}".format(*cells)


def _share(part: int, whole: int) -> str:
    return f"{part}/{whole} ({part / whole:.0%})" if whole else "-"
