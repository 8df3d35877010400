"""Execute a plan: first build what runs share, each once; then execute several runs at a time.

The workers are processes of this machine (``pool``) or of a cluster (``cluster``).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

from symsteer.agents import AGENTS
from symsteer.agents.team import can_join
from symsteer.bench.runs.base_policy import demonstration_path, find_base
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.evaluator import check_room
from symsteer.bench.sweep.plan import Plan, PlannedRun
from symsteer.bench.sweep.work import Result, build_base, build_demonstrations, play

TRIES = 2
"""A task that failed is tried once more; a run then continues from its checkpoint."""

LOST_TRIES = 10
"""Tries of a task whose machine was lost, which is not the task's fault."""

REFRESH_SECONDS = 0.5


class Workers(Protocol):
    """Executes tasks."""

    capacity: int | None
    """Number of tasks at the same time; None if it decides itself."""
    patience: float
    """Seconds to wait for a run that another process seems to hold."""

    def submit(self, function: Callable[..., Result], *args: Any) -> Future:
        """Start a task."""

    def result(self, future: Future) -> Result:
        """The result of a task that has ended, also if its process died."""

    def stop(self) -> None:
        """End all processes at once."""


@dataclass
class Outcome:
    """How a run ended."""

    run: PlannedRun
    status: Literal["finished", "skipped", "failed", "elsewhere"]
    """``skipped``: it was finished before. ``elsewhere``: another process works on it."""
    reason: str = ""
    trace: str = ""


class Watcher:
    """Is called at the events of a sweep; a method may do nothing."""

    def started(self, task: Task) -> None:
        """A task began."""

    def retried(self, task: Task, result: Result) -> None:
        """A task failed and will be tried again."""

    def refresh(self, running: list[Task]) -> None:
        """Half a second has passed, or a task has ended."""


@dataclass(eq=False)
class Task:
    """Something to do: collect demonstrations, train a base policy, or execute runs."""

    kind: Literal["demonstrations", "base policy", "run"]
    label: str
    function: Callable[..., Result]
    args: tuple
    team: tuple[PlannedRun, ...] = ()
    """The runs that it executes; several are trained together."""
    needed_by: list[PlannedRun] = field(default_factory=list)
    """The runs that cannot be executed if this task, which executes none, fails."""
    then: list[Task] = field(default_factory=list)
    """Tasks that need the result of this one."""
    waits: int = 0
    """Number of tasks whose results it still needs."""
    tries: int = 0
    losses: int = 0


def tasks_of(
    plan: Plan, todo: list[PlannedRun], patience: float = 0.0, together: int = 1
) -> list[Task]:
    """The tasks of a sweep: shared data that do not exist yet, each once, then the runs.

    Args:
        plan: of the sweep.
        todo: the runs to execute.
        patience: seconds to wait for a run that another process seems to hold.
        together: number of runs that one task may execute, if they can be trained together.
    """
    demonstrations: dict[tuple, Task | None] = {}
    bases: dict[tuple, Task | None] = {}
    needs: dict[PlannedRun, Task | None] = {}
    for run in todo:
        config = plan.configs[run]
        wanted = config.demonstrations
        demos_key = (config.task, config.embodiment, wanted)
        # A policy of several tasks is trained once for the runs on all of them.
        trained = (config.policy_tasks, *demos_key[1:])
        base_key = (*trained, config.policy_name, config.policy, config.policy_seed)
        words = f"{config.task} {config.embodiment}, {wanted.count} {wanted.mode}"
        args = (config, plan.out)
        if base_key not in bases and find_base(*args):
            bases[base_key] = None
        if base_key not in bases:
            if demos_key not in demonstrations:
                demos = Task("demonstrations", words, build_demonstrations, args)
                demonstrations[demos_key] = None if demonstration_path(*args).is_file() else demos
            words = f"{config.policy_name} for {words} demonstrations"
            bases[base_key] = Task("base policy", words, build_base, args)
            _join(demonstrations[demos_key], bases[base_key])
        needs[run] = bases[base_key]
        for shared in (demonstrations.get(demos_key), bases[base_key]):
            if shared:
                shared.needed_by.append(run)
    runs = []
    for team in teams_of(plan, todo, together):
        runs.append(_run_task(plan, team, patience))
        for base in {id(needs[run]): needs[run] for run in team}.values():
            _join(base, runs[-1])
    return [task for task in (*demonstrations.values(), *bases.values(), *runs) if task]


def _run_task(plan: Plan, team: tuple[PlannedRun, ...], patience: float) -> Task:
    configs = tuple(plan.configs[run] for run in team)
    args = (configs, plan.out, patience, plan.tracking)
    return Task("run", team[0].label, play, args, team)


def teams_of(plan: Plan, todo: list[PlannedRun], together: int) -> list[tuple[PlannedRun, ...]]:
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
        cures = "lower num_envs, or use `symsteer run` with --workers", "lower --together"
        check_room([plan.configs[run] for run in team], cure=cures[len(team) > 1])
    return [tuple(team) for team in teams]


def execute_plan(
    plan: Plan, todo: list[PlannedRun], workers: Workers, watcher: Watcher, together: int = 1
) -> Iterator[Outcome]:
    """Execute runs of a plan, and yield the outcome of each when it ends.

    A run that fails does not stop the others. First come tasks that others wait for, then the runs
    in the order of the suite, then tasks that failed before; these are executed one by one.
    """
    order = itertools.count()
    ready: list[tuple[int, int, Task]] = []

    def offer(task: Task) -> None:
        rank = 2 if task.tries else 1 if task.kind == "run" else 0
        heapq.heappush(ready, (rank, next(order), task))

    for task in tasks_of(plan, todo, workers.patience, together):
        if not task.waits:
            offer(task)

    def go_on(task: Task) -> None:
        """Offer the tasks that waited for this one alone."""
        for follower in task.then:
            follower.waits -= 1
            if not follower.waits and (follower.team or follower.needed_by):
                offer(follower)

    def leave_out(runs: list[PlannedRun], task: Task) -> None:
        """Take runs out of the tasks that wait for this one; teams go on without them."""
        for follower in task.then:
            follower.needed_by = [run for run in follower.needed_by if run not in runs]
            if follower.team:
                follower.team = tuple(run for run in follower.team if run not in runs)
                configs = tuple(plan.configs[run] for run in follower.team)
                follower.args = (configs, *follower.args[1:])
            else:
                leave_out(runs, follower)
                go_on(follower)

    running: dict[Future, Task] = {}
    while ready or running:
        while ready and (workers.capacity is None or len(running) < workers.capacity):
            _, _, task = heapq.heappop(ready)
            running[workers.submit(task.function, *task.args)] = task
            watcher.started(task)
        done, _ = wait(running, timeout=REFRESH_SECONDS, return_when=FIRST_COMPLETED)
        for future in done:
            task = running.pop(future)
            whole = workers.result(future)
            parts = [(task, whole)]
            if len(task.team) > 1:
                each = whole.parts or (whole,) * len(task.team)
                alone = [_run_task(plan, (run,), workers.patience) for run in task.team]
                parts = list(zip(alone, each, strict=True))
            for part, result in parts:
                if result.status == "done":
                    go_on(part)
                    for run in part.team:
                        yield Outcome(run, "finished")
                elif _again(part, result):
                    watcher.retried(part, result)
                    offer(part)
                else:
                    lost = [*part.team, *part.needed_by]
                    leave_out(lost, part)
                    go_on(part)
                    for run in lost:
                        yield _failure(run, part, result)
        watcher.refresh(list(running.values()))


def _again(task: Task, result: Result) -> bool:
    """Whether to try a failed task again; counts the attempt."""
    if result.status == "lost":
        task.losses += 1
        return task.losses < LOST_TRIES
    task.tries += 1
    return result.status == "failed" and task.tries < TRIES


def _failure(run: PlannedRun, task: Task, result: Result) -> Outcome:
    if result.status == "busy":
        return Outcome(run, "elsewhere", result.reason)
    if task.team:
        return Outcome(run, "failed", result.reason, result.trace)
    return Outcome(run, "failed", f"its {task.kind} failed: {result.reason}", result.trace)


def _join(first: Task | None, then: Task | None) -> None:
    if first and then:
        first.then.append(then)
        then.waits += 1
