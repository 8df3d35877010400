"""Work off a plan: what cells share is built once, then the cells run, side by side.

Where the work is done is not known here: on this machine (``pool``) or on a cluster (``cluster``).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

from symsteer.bench.runs.base_policy import demonstration_path, find_base
from symsteer.bench.sweep.plan import Cell, Plan
from symsteer.bench.sweep.work import Result, build_base, build_demonstrations, play

TRIES = 2
"""A failed task is tried once more; a run then continues from its checkpoint."""

LOST_TRIES = 10
"""A task whose machine went away is tried this often: that is no fault of its own."""

REFRESH_SECONDS = 0.5


class Workers(Protocol):
    """Where tasks are done."""

    capacity: int | None
    """How many tasks are done side by side; None if it decides itself."""
    patience: float
    """Seconds to wait for a run that another process seems to hold."""

    def submit(self, function: Callable[..., Result], *args: Any) -> Future:
        """Begin a task."""

    def result(self, future: Future) -> Result:
        """How a task ended that is done, whatever became of its process."""

    def stop(self) -> None:
        """End all processes, whatever they are doing."""


@dataclass
class Outcome:
    """What became of a cell."""

    cell: Cell
    status: Literal["finished", "skipped", "failed", "elsewhere"]
    """``skipped``: it was finished before. ``elsewhere``: another process is working on it."""
    reason: str = ""
    trace: str = ""


class Watcher(Protocol):
    """Who wants to know how a sweep gets on."""

    def started(self, task: Task) -> None:
        """A task was handed to a worker."""

    def retried(self, task: Task, result: Result) -> None:
        """A task failed and will be tried again."""

    def refresh(self, running: list[Task]) -> None:
        """Some time has passed."""


@dataclass(eq=False)
class Task:
    """A piece of work: demonstrations, a base policy, or a cell."""

    kind: Literal["demonstrations", "base policy", "cell"]
    label: str
    function: Callable[..., Result]
    args: tuple
    cell: Cell | None = None
    then: list[Task] = field(default_factory=list)
    """Tasks that need this one."""
    waits: bool = False
    """Whether it needs another one."""
    tries: int = 0
    losses: int = 0

    @property
    def cells(self) -> list[Cell]:
        """The cells that come to nothing without this task."""
        own = [self.cell] if self.cell else []
        return own + [cell for task in self.then for cell in task.cells]


def tasks_of(plan: Plan, todo: list[Cell], patience: float = 0.0) -> list[Task]:
    """The cells, and before them what they share and is not there yet, each once.

    Args:
        plan: which holds the cells.
        todo: the cells that are to run.
        patience: seconds to wait for a run that another process seems to hold.
    """
    demonstrations: dict[tuple, Task | None] = {}
    bases: dict[tuple, Task | None] = {}
    cells = []
    for cell in todo:
        config = plan.configs[cell]
        wanted = config.demonstrations
        demos_key = (config.task, config.embodiment, wanted)
        base_key = (*demos_key, config.policy, config.policy_seed)
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
        cells.append(Task("cell", cell.label, play, (*args, patience), cell))
        _join(bases[base_key], cells[-1])
    return [task for task in (*demonstrations.values(), *bases.values(), *cells) if task]


def work_off(plan: Plan, todo: list[Cell], workers: Workers, watcher: Watcher) -> Iterator[Outcome]:
    """Run cells of a plan; one that fails does not stop the others. Yields each as it ends.

    Tasks that others wait for come first, then the cells in the order of the suite, and last what
    failed before.
    """
    order = itertools.count()
    ready: list[tuple[int, int, Task]] = []

    def offer(task: Task) -> None:
        rank = 2 if task.tries else 1 if task.kind == "cell" else 0
        heapq.heappush(ready, (rank, next(order), task))

    for task in tasks_of(plan, todo, workers.patience):
        if not task.waits:
            offer(task)
    running: dict[Future, Task] = {}
    while ready or running:
        while ready and (workers.capacity is None or len(running) < workers.capacity):
            _, _, task = heapq.heappop(ready)
            running[workers.submit(task.function, *task.args)] = task
            watcher.started(task)
        done, _ = wait(running, timeout=REFRESH_SECONDS, return_when=FIRST_COMPLETED)
        for future in done:
            task = running.pop(future)
            result = workers.result(future)
            if result.status == "done":
                for follower in task.then:
                    offer(follower)
                if task.cell:
                    yield Outcome(task.cell, "finished")
            elif _again(task, result):
                watcher.retried(task, result)
                offer(task)
            else:
                for cell in task.cells:
                    yield _failure(cell, task, result)
        watcher.refresh(list(running.values()))


def _again(task: Task, result: Result) -> bool:
    """Whether a task that did not succeed is tried again; counts the attempt."""
    if result.status == "lost":
        task.losses += 1
        return task.losses < LOST_TRIES
    task.tries += 1
    return result.status == "failed" and task.tries < TRIES


def _failure(cell: Cell, task: Task, result: Result) -> Outcome:
    if result.status == "busy":
        return Outcome(cell, "elsewhere", result.reason)
    if task.cell:
        return Outcome(cell, "failed", result.reason, result.trace)
    return Outcome(cell, "failed", f"its {task.kind} failed: {result.reason}", result.trace)


def _join(first: Task | None, then: Task | None) -> None:
    if first and then:
        first.then.append(then)
        then.waits = True
