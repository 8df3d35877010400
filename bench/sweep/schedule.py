"""Execute a plan: first build what runs share, each once; then execute several runs at a time.

The workers are processes of this machine (``pool``) or of a cluster (``cluster``).
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from typing import Literal

from symsteer.agents import AGENTS
from symsteer.agents.sac import can_join
from symsteer.bench.runs.base_policy import base_key, demonstration_path, find_base
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.evaluator import check_room
from symsteer.bench.sweep.plan import Plan, PlannedRun
from symsteer.bench.sweep.pool import Workers
from symsteer.bench.sweep.work import Kind, Result

TRIES = 2
"""A task that failed is tried once more; a run then continues from its checkpoint."""

LOST_TRIES = 10
"""Tries of a task whose machine was lost, which is not the task's fault."""

REFRESH_SECONDS = 0.5


@dataclass
class EndedRun:
    """How a run ended."""

    run: PlannedRun
    status: Literal["finished", "skipped", "failed", "elsewhere"]
    """``skipped``: it was finished before. ``elsewhere``: another process works on it."""
    reason: str = ""
    trace: str = ""


@dataclass(eq=False)
class Task:
    """Something to do: collect demonstrations, train a base policy, or execute runs."""

    kind: Kind
    label: str
    runs: list[PlannedRun]
    """The runs that it executes, trained together if they are several; of a task that executes
    none, those that need its result."""
    needs: list[Task] = field(default_factory=list)
    """Tasks that must end before."""
    tries: int = 0
    losses: int = 0


class Watcher:
    """Is called while a plan is executed; a method may do nothing."""

    def refresh(self, running: list[Task]) -> None:
        """Tasks have begun or ended, or half a second has passed."""

    def retried(self, task: Task, result: Result) -> None:
        """A task failed and will be tried again."""


def tasks_of(plan: Plan, todo: list[PlannedRun], together: int = 1) -> list[Task]:
    """The tasks of a sweep: shared data that do not exist yet, each once, then the runs.

    Args:
        plan: of the sweep.
        todo: the runs to execute.
        together: number of runs that one task may execute, if they can be trained together.
    """
    demonstrations: dict[tuple, Task] = {}
    bases: dict[tuple, Task | None] = {}
    """None for those that exist."""
    base_of: dict[PlannedRun, Task] = {}
    for run in todo:
        config = plan.configs[run]
        wanted = config.demonstrations
        key = base_key(config)
        if key not in bases:
            words = f"{config.task} {config.embodiment}, {wanted.count} {wanted.mode}"
            base = Task("base policy", f"{config.policy_name} for {words} demonstrations", [])
            bases[key] = None if find_base(config, plan.out) else base
            if bases[key] and not demonstration_path(config, plan.out).is_file():
                place = (config.task, config.embodiment, wanted)
                demos = demonstrations.setdefault(place, Task("demonstrations", words, []))
                base.needs.append(demos)
        if needed := bases[key]:
            base_of[run] = needed
            for shared in (needed, *needed.needs):
                shared.runs.append(run)
    teams = []
    for team in teams_of(plan, todo, together):
        needs = dict.fromkeys(base_of[run] for run in team if run in base_of)
        teams.append(Task("run", team[0].label, team, list(needs)))
    return [*demonstrations.values(), *filter(None, bases.values()), *teams]


def teams_of(plan: Plan, todo: list[PlannedRun], together: int) -> list[list[PlannedRun]]:
    """Runs that differ in seeds and variants alone, up to ``together``; refuses too large teams."""
    teams: list[list[PlannedRun]] = []
    open_teams: dict[RunConfig, list[PlannedRun]] = {}
    for run in todo:
        config = plan.configs[run]
        demonstrations = replace(config.demonstrations, seed=0)
        key = replace(config, seed=0, policy_seed=0, variant="none", demonstrations=demonstrations)
        team = open_teams.get(key)
        if team is None or len(team) == together:
            team = open_teams[key] = []
            teams.append(team)
        team.append(run)
        if not can_join(AGENTS.get(config.agent)):
            del open_teams[key]
    for team in teams:
        cures = "lower num_envs, or use `symsteer run` with --sim-workers", "lower --together"
        check_room([plan.configs[run] for run in team], cure=cures[len(team) > 1])
    return teams


def execute_plan(
    plan: Plan, todo: list[PlannedRun], workers: Workers, watcher: Watcher, together: int = 1
) -> Iterator[EndedRun]:
    """Execute runs of a plan, and yield how each has ended.

    A run that fails does not stop the others. First come tasks that others wait for, then the runs
    in the order of the suite, then tasks that failed before; these are executed one by one.
    """
    queue = tasks_of(plan, todo, together)
    how = Execution(plan.out, track=plan.track, quiet=True, group=plan.name)
    running: dict[Future, Task] = {}
    ended: set[Task] = set()
    lost: set[PlannedRun] = set()

    def settle(task: Task, result: Result) -> Iterator[EndedRun]:
        if result.status != "done" and _again(task, result):
            watcher.retried(task, result)
            queue.append(task)
            return
        ended.add(task)
        if result.status != "done":
            lost.update(task.runs)
            yield from (_failure(run, task, result) for run in task.runs)
        elif task.kind == "run":
            yield from (EndedRun(run, "finished") for run in task.runs)

    while queue or running:
        for task in list(queue):
            if workers.capacity is not None and len(running) >= workers.capacity:
                break
            if ended.issuperset(task.needs):
                queue.remove(task)
                task.runs = [run for run in task.runs if run not in lost]
                if task.runs:
                    configs = [plan.configs[run] for run in task.runs]
                    several = None if task.kind == "run" else 1
                    running[workers.submit(task.kind, configs[:several], how)] = task
                else:
                    ended.add(task)
        watcher.refresh(list(running.values()))
        done, _ = wait(running, timeout=REFRESH_SECONDS, return_when=FIRST_COMPLETED)
        for future in done:
            task, results = running.pop(future), workers.result(future)
            if task.kind != "run" or len(task.runs) == 1:
                yield from settle(task, results[0])
                continue
            # A process that died has one result for all of its runs.
            each = results if len(results) == len(task.runs) else results * len(task.runs)
            for run, result in zip(task.runs, each, strict=True):
                yield from settle(Task("run", run.label, [run]), result)
    watcher.refresh([])


def _again(task: Task, result: Result) -> bool:
    """Whether to try a failed task again; counts the attempt."""
    if result.status == "lost":
        task.losses += 1
        return task.losses < LOST_TRIES
    task.tries += 1
    return result.status == "failed" and task.tries < TRIES


def _failure(run: PlannedRun, task: Task, result: Result) -> EndedRun:
    if result.status == "busy":
        return EndedRun(run, "elsewhere", result.reason)
    reason = result.reason if task.kind == "run" else f"its {task.kind} failed: {result.reason}"
    return EndedRun(run, "failed", reason, result.trace)
