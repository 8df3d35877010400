"""Several runs in one process; learners of one kind are trained as a team.

The runs go on in turns, until each of them waits for an update. Those that have made the fewest
updates are served first, so that runs with different checkpoints come together again.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from symsteer.agents.replay import Batch
from symsteer.agents.team import Team, can_join
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import is_finished, run_id
from symsteer.bench.runs.run import opened
from symsteer.bench.runs.tracking import Tracking
from symsteer.bench.runs.trainer import Trainer, Updates, next_batch


@dataclass(eq=False)
class _Member:
    """A run that waits for an update of its agent."""

    index: int
    stack: contextlib.ExitStack
    trainer: Trainer
    updates: Updates
    batch: Batch | None = None

    @property
    def agent(self) -> Any:
        return self.trainer.agent


def execute_together(
    configs: Sequence[RunConfig], out: Path, tracking: Tracking | None = None
) -> list[Exception | None]:
    """Execute several runs to their ends; those that are finished are left alone.

    Args:
        configs: what to run. A team needs equal settings except for seeds, variants and tasks
            with equal layouts.
        out: folder of the runs.
        tracking: a service that shows the runs.

    Returns:
        For each run None, or the error that ended it. An error of one run does not stop the others.
    """
    errors: list[Exception | None] = [None] * len(configs)
    with contextlib.ExitStack() as everything:
        waiting: list[_Member] = []
        for index, config in enumerate(configs):
            if is_finished(out / run_id(config, {})):
                continue
            stack = everything.enter_context(contextlib.ExitStack())
            try:
                trainer = stack.enter_context(
                    opened(config, out, progress=False, tracking=tracking, together=len(configs))
                )
            except Exception as error:
                errors[index] = error
                continue
            member = _Member(index, stack, trainer, trainer.updates_due())
            _advance(member, None, waiting, errors)
        team: Team | None = None
        while waiting:
            chosen = _next(waiting)
            agents = [member.agent for member in chosen]
            if team is None or team.members != agents:
                if team is not None:
                    team.dissolve()
                team = Team(agents) if len(agents) > 1 else None
            waiting = [member for member in waiting if member not in chosen]
            begin = time.perf_counter()
            batches = [member.batch for member in chosen if member.batch is not None]
            try:
                found = team.update(batches) if team else [agents[0].update(batches[0])]
            except Exception as error:
                for member in chosen:
                    _fail(member, error, errors)
                continue
            seconds = (time.perf_counter() - begin) / len(chosen)
            for member, scalars in zip(chosen, found, strict=True):
                member.trainer.add_update(seconds)
                _advance(member, scalars, waiting, errors)
    return errors


def _advance(
    member: _Member,
    scalars: Mapping[str, torch.Tensor] | None,
    waiting: list[_Member],
    errors: list[Exception | None],
) -> None:
    """Let a run go on until it waits again, or ends."""
    try:
        member.batch = next_batch(member.updates, scalars)
    except Exception as error:
        _fail(member, error, errors)
        return
    if member.batch is None:
        member.stack.close()
    else:
        waiting.append(member)


def _fail(member: _Member, error: Exception, errors: list[Exception | None]) -> None:
    """End a run with an error; its record says so."""
    errors[member.index] = error
    with contextlib.suppress(type(error)):
        member.stack.__exit__(type(error), error, error.__traceback__)


def _next(waiting: Sequence[_Member]) -> list[_Member]:
    """The runs to serve next: a team, or one run."""
    alone = [member for member in waiting if not can_join(type(member.agent))]
    if alone:
        return alone[:1]
    fewest = min(member.agent.updates for member in waiting)
    behind = [member for member in waiting if member.agent.updates == fewest]
    first = behind[0].agent
    team = [
        member
        for member in behind
        if type(member.agent) is type(first)
        and member.agent.options == first.options
        and member.agent.description() == first.description()
    ]
    return sorted(team, key=lambda member: member.index)
