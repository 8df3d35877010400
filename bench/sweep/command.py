"""``symsteer sweep``: run the runs that are not finished, or show them."""

from __future__ import annotations

import contextlib
import os
import sys

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sweep.display import Display
from symsteer.bench.sweep.plan import Plan, PlannedRun, sweep_path, title, write_sweep
from symsteer.bench.sweep.pool import LocalPool, Workers
from symsteer.bench.sweep.schedule import EndedRun, execute_plan, tasks_of, teams_of
from symsteer.bench.sweep.survey import Sighting, duration, look, time_left
from symsteer.errors import UserError
from symsteer.files import open_log
from symsteer.tables import aligned

COLUMNS = ("runs", "finished", "running", "unfinished", "missing")


def number_of_workers(asked: int, configs: list[RunConfig]) -> int:
    """How many runs to execute at the same time on this machine.

    Args:
        asked: the number that the user gave. 0 means one per core, or only one on CUDA, because
            the runs would share a device.
        configs: of the runs.

    Raises:
        UserError: if it is negative.
    """
    if asked < 0:
        raise UserError(f"--workers is {asked}; it must be at least 1, or 0 for one per core")
    if asked:
        return asked
    if any("cuda" in (config.sim, config.device) for config in configs):
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_plan(
    plan: Plan, workers: int = 0, ray: str | None = None, together: int = 1
) -> list[EndedRun]:
    """Execute every run of a plan that is not finished, and report on stdout.

    Args:
        plan: the runs.
        workers: number of runs at the same time; 0: one per core, or as many as fit on the cluster.
        ray: address of a Ray cluster to use instead of this machine.
        together: learners that share a process, if they differ in seeds and variants alone.

    Returns:
        How each run has ended, in the order in which they ended; skipped ones first.

    Raises:
        UserError: if ``workers``, ``ray`` or ``together`` is wrong.
        OSError: if the folder of the runs cannot be created.
    """
    if together < 1:
        raise UserError(f"--together is {together}; it must be at least 1")
    number = number_of_workers(workers, list(plan.configs.values()))
    seen = look_at(plan)
    todo = [run for run, sighting in seen.items() if sighting.state != "finished"]
    ends = [
        EndedRun(run, "skipped", sighting.success)
        for run, sighting in seen.items()
        if sighting.state == "finished"
    ]
    teams_of(plan, todo, together)  # before anything is written: they may be too large
    limit = workers if ray is not None else number
    log = sweep_path(plan.out, plan.name).with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    output = sys.stdout
    with contextlib.ExitStack() as stack:
        pool: Workers | None = None
        if todo and ray is not None:
            from symsteer.bench.sweep.cluster import RayCluster

            # Ray prints messages about its machines.
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open_log(log))))
            pool = RayCluster(ray, plan.out, limit or None)
        elif todo:
            pool = LocalPool(min(number, len(todo)), log)
        write_sweep(plan, limit, {})
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
                    write_sweep(plan, limit, failures)
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


def preview(plan: Plan, workers: int = 0, ray: str | None = None) -> str:
    """A text that shows what a sweep would do. It runs and writes nothing, and does not connect.

    Raises:
        UserError: if ``workers`` is negative, or ``ray`` is not an address.
    """
    number: int | None = number_of_workers(workers, list(plan.configs.values()))
    if ray is not None:
        from symsteer.bench.sweep.cluster import check_address

        check_address(ray)
        number = workers or None
    seen = look_at(plan)
    todo = [run for run in seen if seen[run].state != "finished"]
    bases = [task.label for task in tasks_of(plan, todo) if task.kind == "base policy"]
    lines = [title(plan.name, plan.description), "", _counts(seen), ""]
    lines.append(f"base policies to build: {len(bases) or 'none'}")
    lines += [f"  {label}" for label in bases]
    lines.append(f"time: {_time(seen, len(todo), number, bool(bases))}")
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
