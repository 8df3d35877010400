"""The loop of one run: the same for every agent.

A checkpoint is written when all environments begin new episodes in fresh scenes. It contains
everything that the rest of the run depends on. So a run that was killed and continued has the same
record as one that was not, except for times (on the CPU; CUDA's sums are not repeatable). At the
same times the world changes, if a variant begins or grows in the course of the run.

Observers (:mod:`symsteer.bench.runs.observers`) write the results.
"""

from __future__ import annotations

import math
import time
from collections.abc import Generator, Mapping, Sequence
from typing import Any, TypeAlias

import torch

from symsteer.agents.agent import Budget
from symsteer.agents.replay import Batch
from symsteer.bench.runs.checkpoint import Counters, fitting, save_checkpoint
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.evaluator import Evaluator, Steered, new_agent
from symsteer.bench.runs.folder import CHECKPOINT
from symsteer.bench.runs.stored import RunFolder
from symsteer.bench.steering.latent_env import Clock, LatentNoiseEnv
from symsteer.bench.tasks import task_class
from symsteer.bench.variants import evaluation_variants
from symsteer.errors import UserError
from symsteer.leaderboard.records import Episodes, Evaluation
from symsteer.policies.contract import ChunkPolicy
from symsteer.variant import VariantSpec, specs_at

Updates: TypeAlias = Generator[Batch, Mapping[str, torch.Tensor] | None, None]
"""A run that hands out every batch that is due, and is sent the scalars of the update."""


def budget_of(config: RunConfig) -> Budget:
    """What the agent of a run may use."""
    limit = task_class(config.task).max_episode_steps
    return Budget(config.env_steps, config.num_envs, config.policy.execute, limit)


class Observer:
    """Is called at the events of a run; a method may do nothing."""

    def began(self, run: Trainer, checkpoint: Mapping[str, Any] | None) -> None:
        """The run was built; this process has not simulated anything yet."""

    def entered(self, run: Trainer, phase: str) -> None:
        """A phase begins: ``preparing``, ``evaluation``."""

    def stepped(self, run: Trainer, scalars: Sequence[Mapping[str, torch.Tensor]]) -> None:
        """All training environments took one decision."""

    def paused(self, run: Trainer) -> None:
        """All environments are about to begin new episodes in fresh scenes."""

    def evaluated(self, run: Trainer, evaluation: Evaluation) -> None:
        """Held-out episodes were played."""

    def saving(self, run: Trainer) -> Mapping[str, Any]:
        """A checkpoint is about to be written; returns what to add to it."""
        return {}

    def finished(self, run: Trainer) -> None:
        """The run has finished."""

    def failed(self, run: Trainer, error: BaseException) -> None:
        """The run did not finish; its last checkpoint is kept."""


class Trainer(Steered):
    """State of a run; :meth:`play` executes the rest of it.

    Args:
        run: what to execute.
        policy: the frozen policy.
        checkpoint: a state to continue from.
        observers: called in this order.
        how: how it is executed.
        together: number of runs in this process.

    Attributes:
        share: of the budget that was used when the environments began in fresh scenes; variants
            have the strength that belongs to it.

    Raises:
        UserError: if the checkpoint was made with another base policy or agent.
    """

    def __init__(
        self,
        run: RunFolder,
        policy: ChunkPolicy,
        checkpoint: Mapping[str, Any] | None,
        observers: Sequence[Observer],
        how: Execution,
        together: int = 1,
    ):
        super().__init__(run.config, policy, new_agent(run.config, policy))
        self.folder, self.resolved = run.folder, run.resolved
        self.observers, self.how, self.together = observers, how, together
        self.env_steps = self.decisions = self.updates = 0
        self.train_until: int | None = None
        self.next_evaluation = 0
        self.fresh_starts = 0
        self.share = 0.0
        self.final = False
        self.clock = Clock()
        self.waited = 0.0  # seconds in which other runs of this process went on
        earlier = self._restore(checkpoint) if checkpoint else 0.0
        self.start = time.perf_counter() - earlier
        for observer in observers:
            observer.began(self, checkpoint)
        try:
            variants = evaluation_variants(self.config.variants, self.share)
            self.evaluator = Evaluator(self, variants, how.sim_workers)
        except BaseException as error:
            self.stop(error)
            raise

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds spent so far, by part, and in all."""
        return {**vars(self.clock), "total": time.perf_counter() - self.start - self.waited}

    def play(self) -> None:
        """Execute the rest of the run."""
        updates = self.updates_due()
        batch = next_batch(updates)
        while batch is not None:
            begin = time.perf_counter()
            scalars = self.agent.update(batch)
            self.add_update(time.perf_counter() - begin)
            batch = next_batch(updates, scalars)

    def add_update(self, seconds: float) -> None:
        """Count the time of an update that somebody else has made."""
        self.clock.update += seconds
        self.waited -= seconds

    def updates_due(self) -> Updates:
        """Train to the end of the budget, evaluate the last checkpoint, close.

        Whoever executes it makes the updates: it gives a batch, and takes the scalars.
        """
        if not self.final:
            if self.train_until is None:
                self._prepare()
            yield from self._train()
            self.evaluate(final=True)
            self.final = True
            self._checkpoint()
        self.evaluator.close()
        for observer in self.observers:
            observer.finished(self)

    def stop(self, error: BaseException) -> None:
        """Tell the observers that the run did not finish."""
        for observer in self.observers:
            observer.failed(self, error)

    def evaluate(self, final: bool = False) -> None:
        """Held-out episodes of the deterministic actor, and diagnostics."""
        begin = time.perf_counter()
        for observer in self.observers:
            observer.entered(self, "evaluation")
        wanted = self.config.evaluation
        share = 1.0 if final else self.share
        self.evaluator.enter(evaluation_variants(self.config.variants, share))
        count = wanted.final_episodes if final else wanted.episodes
        episodes = self.evaluator.play(count).episodes
        played = time.perf_counter()
        long = wanted.final_diagnostic_episodes if final else wanted.diagnostic_episodes
        diagnostics = dict(self.evaluator.diagnose(long))
        if final:
            diagnostics |= self.evaluator.compare()
        self.clock.evaluate += played - begin
        self.clock.diagnose += time.perf_counter() - played
        evaluation = Evaluation(
            env_steps=self.env_steps,
            decisions=self.decisions,
            updates=self.updates,
            wall_clock=self.seconds["total"],
            final=final,
            episodes=Episodes.model_validate(episodes),
            diagnostics=diagnostics,
        )
        for observer in self.observers:
            observer.evaluated(self, evaluation)

    def _prepare(self) -> None:
        """Let the agent search or pre-train, in environments that it makes."""
        for observer in self.observers:
            observer.entered(self, "preparing")
        made: list[LatentNoiseEnv] = []

        def make(ignore_terminations: bool) -> LatentNoiseEnv:
            made.append(self._make_env(ignore_terminations))
            return made[-1]

        self.train_until = self.agent.prepare(make, budget_of(self.config))
        for env in made:
            self.env_steps += env.control_steps
            self.decisions += env.decisions
            env.close()

    def _train(self) -> Updates:
        assert self.train_until is not None
        end = min(self.train_until, self.config.env_steps)
        if self.env_steps >= end:
            return
        env, world = self._make_env(ignore_terminations=False), self.world
        while self.env_steps < end:
            self.share = self.env_steps / self.config.env_steps
            if self.world != world:
                env.close()
                env, world = self._make_env(ignore_terminations=False), self.world
            env.control_steps, env.decisions = self.env_steps, self.decisions
            yield from self._train_until_checkpoint(env, end)
        env.close()

    @property
    def world(self) -> tuple[VariantSpec, ...]:
        """The variants of the training environments now."""
        return specs_at(self.config.variants, self.share)

    def _train_until_checkpoint(self, env: LatentNoiseEnv, end: int) -> Updates:
        """Train from one fresh start of all environments to the next, or to the end."""
        config, agent = self.config, self.agent
        if self.next_evaluation == 0:
            self.evaluate()
            self.next_evaluation = config.evaluation.every
        obs = env.reset(env.training_seeds(self.fresh_starts, config.num_envs))
        pause = self.env_steps + config.checkpoint_every * config.num_envs
        for share in (share for spec in config.variants for share in spec.rise or ()):
            change = math.ceil(share * config.env_steps)
            if self.env_steps < change:
                pause = min(pause, change)
        while self.env_steps < min(pause, end):
            step = env.step(agent.act(obs))
            obs = step.obs_after
            self.env_steps, self.decisions = env.control_steps, env.decisions
            scalars: list[Mapping[str, torch.Tensor]] = [
                {f"train/{key}": value for key, value in step.episodes.items()}
            ]
            begin = time.perf_counter()
            agent.observe(step)
            for batch in agent.batches():
                given = time.perf_counter()
                self.clock.update += given - begin
                updated = yield batch
                assert updated is not None
                scalars.append(updated)
                begin = time.perf_counter()
                self.waited += begin - given
                self.updates += 1
            self.clock.update += time.perf_counter() - begin
            for observer in self.observers:
                observer.stepped(self, scalars)
            if self.next_evaluation <= self.env_steps < end:
                self.evaluate()
                self.next_evaluation += config.evaluation.every
        for observer in self.observers:
            observer.paused(self)
        self.fresh_starts += 1
        if self.env_steps < end:
            self._checkpoint()

    def _make_env(self, ignore_terminations: bool) -> LatentNoiseEnv:
        how = (self.config.num_envs, ignore_terminations, self.how.sim_workers)
        env = self.make_env(self.world, *how)
        env.clock = self.clock
        return env

    def _checkpoint(self) -> None:
        """Save everything that the rest of the run depends on; the replay only until the end."""
        replay = None if self.final else self.agent.replay
        state: dict[str, Any] = {
            "base_policy": self.policy.content_hash(),
            "agent": self.agent.state_dict(),
            "replay": replay.state_dict() if replay else None,
            **{name: getattr(self, name) for name in Counters.model_fields},
        }
        for observer in self.observers:
            state |= observer.saving(self)
        save_checkpoint(self.folder, {**state, "seconds": self.seconds})

    def _restore(self, state: Mapping[str, Any]) -> float:
        """Load a checkpoint's state; returns the seconds that the run had taken until then."""
        if state["base_policy"] != self.policy.content_hash():
            raise UserError(
                f"{self.folder / CHECKPOINT} steers another base policy than "
                f"{self.folder / 'policy.safetensors'}; restore that file, or delete the run's "
                "folder to start again"
            )
        with fitting(self.folder / CHECKPOINT):
            self.agent.load_state_dict(state["agent"])
            if self.agent.replay is not None and state["replay"] is not None:
                self.agent.replay.load_state_dict(state["replay"])
        for name in Counters.model_fields:
            setattr(self, name, state[name])
        self.share = self.env_steps / self.config.env_steps
        self.clock = Clock(**{part: state["seconds"][part] for part in vars(self.clock)})
        return state["seconds"]["total"]


def next_batch(updates: Updates, scalars: Mapping[str, torch.Tensor] | None = None) -> Batch | None:
    """The next batch that is due, or None at the end of the run.

    Args:
        updates: the run.
        scalars: of the update with the batch before; None for the first one.
    """
    try:
        return updates.send(scalars)
    except StopIteration:
        return None
