"""``symsteer sweep``: run the runs that are not finished, or show them."""

from __future__ import annotations

import contextlib
import os
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from symsteer.agents import AGENTS
from symsteer.bench.sweep.display import Display
from symsteer.bench.sweep.plan import Plan, PlannedRun, title, write_sweep
from symsteer.bench.sweep.pool import SHARED_PATIENCE, LocalPool, Workers
from symsteer.bench.sweep.schedule import EndedRun, execute_plan, tasks_of, teams_of
from symsteer.bench.sweep.survey import Sighting, duration, look, time_left
from symsteer.bench.sweep.workforce import Workforce
from symsteer.errors import UserError
from symsteer.files import open_log
from symsteer.tables import aligned

COLUMNS = ("runs", "finished", "running", "unfinished", "missing")


def workers_of(workforce: Workforce, plan: Plan, cores: int | None = None) -> int | None:
    """How many runs are executed at the same time; None if the cluster decides.

    On one machine that is one per core, if the user says nothing, or only one on CUDA, because the
    runs would share a device.

    Args:
        workforce: what the user says.
        plan: of the runs.
        cores: of the machine; None: of this one.

    Raises:
        UserError: if a number is wrong.
    """
    if workforce.workers == "auto":
        raise UserError("--workers auto is for a sweep on this machine alone; name a number")
    if workforce.workers < 0:
        raise UserError(
            f"--workers is {workforce.workers}; it must be at least 1, or 0 for one per core"
        )
    if workforce.together is not None and workforce.together < 1:
        raise UserError(f"--together is {workforce.together}; it must be at least 1")
    if workforce.workers or workforce.ray is not None:
        return workforce.workers or None
    if any("cuda" in (config.sim, config.device) for config in plan.configs.values()):
        return 1
    return cores or _cores()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def choices(device: str, num_envs: Sequence[int]) -> dict[str, Sequence[Any]]:
    """The settings, by name, that are tried to find the fastest."""
    cuda, cores = device == "cuda", _cores()
    workers = [*dict.fromkeys((*(1,) * cuda, cores, max(1, cores // 2)))]
    together = (1, 5, 20, 80) if cuda else (1, 2, 5)
    return {"device": [device], "num_envs": num_envs, "workers": workers, "together": together}


def settled(
    plan: Plan,
    workforce: Workforce,
    measure: Callable[..., Any] | None,
    tell: Callable[[str], None],
) -> Workforce:
    """The fastest workforce for what is left of a plan; ``together`` stays if it is given.

    ``measure`` is :func:`symsteer.bench.throughput.measure`; None: tell only what would be tried.
    """
    workforce = replace(workforce, workers=0)
    workers_of(workforce, plan)
    left = [run for run, sighting in look_at(plan).items() if sighting.state != "finished"]
    learners = [run for run in left if AGENTS.get(run.agent).role == "learner"]
    cores, given = _cores(), workforce.together
    if len(learners) <= cores:
        return workforce
    config = plan.configs[learners[0]]
    tried = choices(config.device, [config.num_envs])
    # Larger teams would leave some cores without one.
    few = [n for n in tried["together"] if n <= len(learners) // cores]
    tried["together"] = [given] if given else few
    tell("--workers auto: tries {workers} at a time, {together} together".format(**tried))
    if measure is None:
        return workforce
    rates = measure(config, tried, LocalPool, tell)
    best, rate = next(iter(rates.items()))
    tell(f"the fastest: {best}, about {rate:.0f} runs an hour")
    return replace(workforce, workers=best.workers, together=given or best.together)


def run_plan(plan: Plan, workforce: Workforce) -> list[EndedRun]:
    """Execute every run of a plan that is not finished, and report on stdout.

    Returns:
        How each run has ended, in the order in which they ended; skipped ones first.

    Raises:
        UserError: if a number or an address of the workforce is wrong.
        OSError: if the folder of the runs cannot be created.
    """
    workers = workers_of(workforce, plan)
    seen = look_at(plan)
    todo = [run for run, sighting in seen.items() if sighting.state != "finished"]
    ends = [
        EndedRun(run, "skipped", sighting.success)
        for run, sighting in seen.items()
        if sighting.state == "finished"
    ]
    # Before anything is written: they may be too large.
    together = workforce.together or 1
    teams_of(plan, todo, together)
    log = plan.path.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    output = sys.stdout
    with contextlib.ExitStack() as stack:
        pool: Workers | None = None
        if todo and workforce.ray is not None:
            from symsteer.bench.sweep.cluster import RayCluster

            # Ray prints messages about its machines.
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open_log(log))))
            pool = RayCluster(workforce.ray, plan.out, workers)
        elif todo:
            pool = LocalPool(min(workers or 1, len(todo)), log)
            if plan.part:  # others work in the same folder
                pool.patience = SHARED_PATIENCE
        write_sweep(plan, workers or 0, {})
        if ends:
            words = f"{len(ends)} of {len(plan.configs)} runs are finished already"
            print(f"{'skipped':9s} {words}", file=output, flush=True)
        if pool is None:
            return ends
        stack.callback(pool.stop)
        display = stack.enter_context(Display(plan, seen, pool.capacity, output))
        failures = {}
        try:
            for end in execute_plan(plan, todo, pool, display, together):
                ends.append(end)
                display.ended(end)
                if end.status == "failed":
                    failures[end.run.run_id] = end.reason
                    write_sweep(plan, workers or 0, failures)
                if end.trace:
                    with open_log(log) as file:
                        file.write(f"{end.run.label}\n{end.trace}\n")
        except KeyboardInterrupt as error:
            error.add_note("the same command continues the sweep")
            raise
    return ends


def look_at(plan: Plan) -> dict[PlannedRun, Sighting]:
    """The state of each run of a plan."""
    return {run: look(plan.out / run.run_id) for run in plan.configs}


def preview(plan: Plan, workforce: Workforce) -> str:
    """A text that shows what a sweep would do. It runs and writes nothing, and does not connect.

    Raises:
        UserError: if a number or an address of the workforce is wrong.
    """
    workers = workers_of(workforce, plan)
    if workforce.ray is not None:
        from symsteer.bench.sweep.cluster import check_address

        check_address(workforce.ray)
    seen = look_at(plan)
    todo = [run for run in seen if seen[run].state != "finished"]
    bases = [task.label for task in tasks_of(plan, todo) if task.kind == "base policy"]
    lines = [title(plan.name, plan.description), "", _counts(seen), ""]
    lines.append(f"base policies to build: {len(bases) or 'none'}")
    lines += [f"{count:5} {label}" for label, count in Counter(bases).items()]
    lines.append(f"time: {_time(seen, len(todo), workers, bool(bases))}")
    return "\n".join(lines)


def _time(
    seen: dict[PlannedRun, Sighting], todo: int, workers: int | None, with_bases: bool
) -> str:
    if not todo:
        return "none, all runs are finished"
    if workers is None:
        return "depends on the size of the cluster; --workers N estimates it for N runs at a time"
    left = time_left(seen, workers)
    if left is None:
        return "unknown, no similar run is finished yet"
    workers_text = f"{workers} worker{'s' if workers > 1 else ''}"
    finished = len(seen) - todo
    known = "estimated from " + (
        f"{finished} finished run{'s' if finished > 1 else ''}" if finished else "running runs"
    )
    without = ", without the base policies" if with_bases else ""
    return f"about {duration(left)} with {workers_text}, {known}{without}"


def _counts(seen: dict[PlannedRun, Sighting]) -> str:
    """A table: the number of runs by state, for each value of the settings in which runs differ."""
    lines = []
    for key in dict.fromkeys(key for run in seen for key in run.keys):
        values = dict.fromkeys(run.keys[key] for run in seen if key in run.keys)
        for index, value in enumerate(values):
            of_value = [s for run, s in seen.items() if key in run.keys and run.keys[key] == value]
            lines.append(["" if index else key, str(value), *_tally(of_value)])
    lines.append(["all", "", *_tally(list(seen.values()))])
    return aligned(["", "", *COLUMNS], lines, left=2)


def _tally(sightings: list[Sighting]) -> list[str]:
    names = {"interrupted": "unfinished", "failed": "unfinished"}
    states = [names.get(sighting.state, sighting.state) for sighting in sightings]
    return [str(len(states)), *(str(states.count(name)) for name in COLUMNS[1:])]
