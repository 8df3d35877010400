"""Several runs in one process; learners of one kind are trained as a team.

The runs go on in turns, until each of them waits for an update. Those that have made the fewest
updates are served first, so that runs with different checkpoints come together again.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from symsteer.agents.replay import Batch
from symsteer.agents.sac import can_join
from symsteer.agents.team import Team
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.folder import is_finished, run_id
from symsteer.bench.runs.run import opened
from symsteer.bench.runs.trainer import next_batch


class _Member(contextlib.ExitStack):
    """A run of this process, which closes when the run ends.

    Attributes:
        error: what ended the run.
        batch: of the update that the run waits for; None after its end.
    """

    error: Exception | None = None
    batch: Batch | None = None

    def begin(self, config: RunConfig, how: Execution, together: int) -> None:
        """Open the run, unless it is finished, and let it go on."""
        try:
            if is_finished(how.runs / run_id(config, {})):
                return
            self.trainer = self.enter_context(opened(config, how, together))
        except Exception as error:
            self.error = error
            return
        self.updates = self.trainer.updates_due()
        self.advance(None)

    @property
    def agent(self) -> Any:
        return self.trainer.agent

    def advance(self, scalars: Mapping[str, torch.Tensor] | None) -> None:
        """Let the run go on until it waits again, or ends."""
        try:
            self.batch = next_batch(self.updates, scalars)
        except Exception as error:
            self.fail(error)
        if self.batch is None:
            self.close()

    def fail(self, error: Exception) -> None:
        """End the run with an error; its record says so."""
        self.error, self.batch = error, None
        with contextlib.suppress(type(error)):
            self.__exit__(type(error), error, error.__traceback__)


def execute_together(configs: Sequence[RunConfig], how: Execution) -> list[Exception | None]:
    """Execute several runs to their ends; those that are finished are left alone.

    Args:
        configs: what to run. A team needs equal settings except for seeds, variants and tasks
            with equal layouts.
        how: they are executed.

    Returns:
        For each run None, or the error that ended it. An error of one run does not stop the others.
    """
    with contextlib.ExitStack() as everything:
        members = [everything.enter_context(_Member()) for _ in configs]
        for member, config in zip(members, configs, strict=True):
            member.begin(config, how, len(configs))
        team: Team | None = None
        while waiting := [member for member in members if member.batch is not None]:
            chosen = _next(waiting)
            agents = [member.agent for member in chosen]
            if team is None or team.members != agents:
                if team is not None:
                    team.dissolve()
                team = Team(agents) if len(agents) > 1 else None
            begin = time.perf_counter()
            batches = [member.batch for member in chosen if member.batch is not None]
            try:
                updates = team.update(batches) if team else [agents[0].update(batches[0])]
            except Exception as error:
                for member in chosen:
                    member.fail(error)
                continue
            seconds = (time.perf_counter() - begin) / len(chosen)
            for member, scalars in zip(chosen, updates, strict=True):
                member.trainer.add_update(seconds)
                member.advance(scalars)
    return [member.error for member in members]


def _next(waiting: Sequence[_Member]) -> list[_Member]:
    """The runs to serve next: a team, or one run."""
    alone = [member for member in waiting if not can_join(type(member.agent))]
    if alone:
        return alone[:1]
    fewest = min(member.agent.updates for member in waiting)
    behind = [member for member in waiting if member.agent.updates == fewest]
    first = behind[0].agent
    return [
        member
        for member in behind
        if type(member.agent) is type(first)
        and member.agent.options == first.options
        and member.agent.description() == first.description()
    ]
