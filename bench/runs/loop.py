"""The loop of one run: search or training, evaluations, checkpoints, record and logs.

A checkpoint holds networks, optimisers, replay, random generators and counters, and falls where
all environments begin new episodes in fresh scenes. What follows depends on nothing else, so that
a run that was killed and continued ends with the record of an undisturbed one but for the clock
(on the CPU; CUDA's sums are not repeatable).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from symsteer.agents import ReplayBuffer, make_agent
from symsteer.bench.runs.base_policy import describe_base
from symsteer.bench.runs.config import RunConfig, content_key, training_seeds
from symsteer.bench.runs.evaluator import Evaluator, make_env
from symsteer.bench.runs.folder import (
    CHECKPOINT,
    RECORD,
    Heartbeat,
    load_checkpoint,
    save_checkpoint,
)
from symsteer.bench.runs.pictures import draw_paths, film
from symsteer.bench.runs.tensorboard import RunLog
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.steering.evaluation import HELD_OUT_SEED
from symsteer.bench.steering.latent_env import Clock
from symsteer.bench.steering.search import search_ticket
from symsteer.bench.tasks import task_class
from symsteer.bench.variants import evaluated, highest_cost, parse
from symsteer.errors import UserError
from symsteer.leaderboard.records import (
    Budget,
    Episodes,
    Evaluation,
    FeasibleQ,
    Parameters,
    Provenance,
    RunRecord,
    WallClock,
    config_hash,
    read_record,
    write_record,
)
from symsteer.policies.base import ChunkPolicy

LOG_EVERY = 10
"""Vectorised decisions between two writes of training scalars."""


def new_agent(name: str, config: RunConfig, base: ChunkPolicy) -> Any:
    """An untrained agent for a run's base policy."""
    return make_agent(
        name,
        base.obs_layout,
        base.act_layout,
        base.horizon,
        config.sac,
        torch.device(config.device),
        config.seed,
        base.normalized_observation,
    )


def feasible_return(config: RunConfig, base: ChunkPolicy) -> tuple[float, float]:
    """Lowest and highest discounted return that the run's reward allows, per decision."""
    return task_class(config.task).feasible_return(
        config.sac.gamma, base.execute, step_cost=highest_cost(parse(config.variant))
    )


class Loop:
    """State of a run; :meth:`play` brings it to its end.

    Args:
        config: what to run.
        resolved: the configuration as the record holds it.
        folder: the run's folder; a checkpoint in it is continued.
        base: the frozen policy.
        progress: whether to show progress.
        workers: processes that share the environments.

    Raises:
        UserError: if the checkpoint is damaged or was made with another base policy.
    """

    def __init__(
        self,
        config: RunConfig,
        resolved: dict[str, Any],
        folder: Path,
        base: ChunkPolicy,
        progress: bool,
        workers: int,
    ):
        self.config, self.folder, self.base, self.progress = config, folder, base, progress
        self.workers = workers
        self.device = torch.device(config.device)
        self.agent = new_agent(config.agent, config, base)
        self.warm_up = new_agent("base", config, base)
        self.replay = self._make_replay() if self.agent.learns else None
        self.means = _Means()
        self.env_steps = self.decisions = self.updates = 0
        self.owed = 0.0
        self.next_evaluation = 0
        self.fresh_starts = 0
        self.final = False
        self.clock = Clock()
        self.update_seconds = self.evaluate_seconds = 0.0
        self.last_scalars: dict[str, float] = {}

        checkpoint = load_checkpoint(folder)
        self.record = self._open_record(resolved, checkpoint)
        earlier = self._restore(checkpoint) if checkpoint else 0.0
        self.start = time.perf_counter() - earlier
        write_record(self.record, folder / RECORD)
        # Without a checkpoint an earlier process may have left events all the same.
        self.log = RunLog(folder, self.record, self.env_steps + 1 if checkpoint else 0)
        self.heartbeat = Heartbeat(folder, config.env_steps, self.env_steps)
        try:
            self.evaluator = Evaluator(
                config,
                base,
                feasible_return(config, base),
                self.agent.learns,
                evaluated(config.variant),
                workers,
            )
        except BaseException as error:
            self.stop(error)
            raise

    def play(self) -> None:
        """Search or train to the end of the budget, evaluate the last checkpoint, close."""
        if not self.final:
            if self.agent.searches:
                self._search()
            elif self.agent.learns:
                self._train()
            self.evaluate(final=True)
            self.final = True
            self._checkpoint(with_replay=False)
        self.evaluator.close()
        self._close("finished")
        self._draw()
        self.log.finish()

    def stop(self, error: BaseException) -> None:
        """Close the record of a run that did not finish; its last checkpoint stays."""
        interrupted = isinstance(error, KeyboardInterrupt)
        self.record.failure = (
            "interrupted by the user" if interrupted else f"{type(error).__name__}: {error}"
        )
        try:
            self._close("interrupted" if interrupted else "failed")
        except UserError:
            # The folder cannot be written, which is most likely what stopped the run.
            return
        finally:
            self.log.close()

    # The two ways to use the budget.

    def _search(self) -> None:
        config = self.config
        self.heartbeat.beat("search", 0)
        env = make_env(config, self.base, config.num_envs, config.variant, True, self.workers)
        env.clock = self.clock
        found = search_ticket(
            env,
            self.agent.candidates,
            config.env_steps,
            lambda number, count: training_seeds(config.seed, number, count),
        )
        self.agent.ticket = found.ticket
        self.agent.searched = {
            "ticket_success": found.success,
            "ticket_episodes": float(found.episodes),
            "ticket_candidates": float(found.candidates),
        }
        self.env_steps = env.control_steps
        # The last decision of an episode is cut short where its time limit is.
        episodes = env.control_steps // env.max_episode_steps
        self.decisions = episodes * math.ceil(env.max_episode_steps / env.execute)
        env.close()

    def _train(self) -> None:
        config = self.config
        env = make_env(config, self.base, config.num_envs, config.variant, False, self.workers)
        env.clock, env.control_steps = self.clock, self.env_steps
        with tqdm(
            total=config.env_steps,
            initial=min(self.env_steps, config.env_steps),
            desc=_title(config),
            unit="step",
            disable=None if self.progress else True,
        ) as bar:
            while self.env_steps < config.env_steps:
                self._train_until_checkpoint(env, bar)
        env.close()

    def _train_until_checkpoint(self, env: Any, bar: tqdm) -> None:
        """From a fresh start of all environments to the next one, or to the budget's end."""
        config, agent, replay = self.config, self.agent, self.replay
        assert replay is not None
        if self.next_evaluation == 0:
            self.evaluate()
            self.next_evaluation = config.evaluation.every
        seeds = training_seeds(config.seed, self.fresh_starts, config.num_envs)
        obs = env.reset(seeds)
        end = self.env_steps + config.checkpoint_every * config.num_envs
        rounds = 0
        while self.env_steps < min(end, config.env_steps):
            warming = self.decisions < config.sac.warmup
            noise = (self.warm_up if warming else agent).act(obs)
            result = env.step(noise)
            replay.add(obs, noise, result.reward, result.next_obs, result.terminal)
            obs = result.obs
            self.env_steps = env.control_steps
            self.decisions += config.num_envs
            rounds += 1
            self.means.add({f"train/{k}": v for k, v in result.episodes.items()})
            if not warming:
                self._update()
            bar.update(min(self.env_steps, config.env_steps) - bar.n)
            self.heartbeat.beat(
                "training", self.env_steps, self.last_scalars.get("eval/success_once")
            )
            if rounds % LOG_EVERY == 0:
                self._write_training_scalars(bar)
            if self.next_evaluation <= self.env_steps < config.env_steps:
                self.evaluate()
                self.next_evaluation += config.evaluation.every
        self._write_training_scalars(bar)
        self.fresh_starts += 1
        if self.env_steps < config.env_steps:
            self._checkpoint(with_replay=True)

    def _update(self) -> None:
        assert self.replay is not None
        begin = time.perf_counter()
        self.owed += self.config.num_envs * self.config.sac.utd
        while self.owed >= 1:
            batch = self.replay.sample(self.config.sac.batch_size)
            self.means.add(self.agent.update(batch))
            self.owed -= 1
            self.updates += 1
        self.update_seconds += time.perf_counter() - begin

    # What is kept.

    def evaluate(self, final: bool = False) -> None:
        """Held-out episodes of the deterministic actor, diagnostics, record, logs."""
        begin = time.perf_counter()
        config = self.config
        self.heartbeat.beat(
            "evaluation", self.env_steps, self.last_scalars.get("eval/success_once")
        )
        count = config.evaluation.final_episodes if final else config.evaluation.episodes
        columns, diagnostics = self.evaluator.measure(self.agent, count)
        self.evaluate_seconds += time.perf_counter() - begin
        self.record.evaluations.append(
            Evaluation(
                env_steps=self.env_steps,
                decisions=self.decisions,
                updates=self.updates,
                wall_clock=time.perf_counter() - self.start,
                final=final,
                episodes=Episodes.model_validate(columns),
                diagnostics=diagnostics,
            )
        )
        self._update_totals()
        write_record(self.record, self.folder / RECORD)
        self.last_scalars = {
            f"eval/{name}": columns[name].double().mean().item()
            for name in ("success_once", "success_at_end", "return", "episode_len")
        }
        self._write_scalars(
            {**self.last_scalars, **{f"diag/{k}": v for k, v in diagnostics.items()}}
        )
        if self.progress:
            success = self.last_scalars["eval/success_once"]
            tqdm.write(
                f"{_title(config)}: {self.env_steps:7d} steps, held-out success {success:.2f} "
                f"({count} episodes{', final' if final else ''})"
            )

    def _checkpoint(self, with_replay: bool) -> None:
        """Everything that the rest of the run depends on."""
        keep = self.replay if with_replay else None
        # A continued run does not write again what lies before its checkpoint.
        self.log.flush()
        save_checkpoint(
            self.folder,
            {
                "base_policy": self.base.content_hash(),
                "agent": self.agent.state_dict(),
                "warm_up": self.warm_up.state_dict(),
                "replay": keep.state_dict() if keep else None,
                "env_steps": self.env_steps,
                "decisions": self.decisions,
                "updates": self.updates,
                "owed": self.owed,
                "next_evaluation": self.next_evaluation,
                "fresh_starts": self.fresh_starts,
                "evaluations": len(self.record.evaluations),
                "history": _history(self.record),
                "final": self.final,
                "last_scalars": self.last_scalars,
                "seconds": {
                    "simulate": self.clock.simulate,
                    "decode": self.clock.decode,
                    "update": self.update_seconds,
                    "evaluate": self.evaluate_seconds,
                    "total": time.perf_counter() - self.start,
                },
            },
        )

    def _restore(self, state: Mapping[str, Any]) -> float:
        """Take a checkpoint's state; returns the seconds that the run had taken then."""
        if state["base_policy"] != self.base.content_hash():
            raise UserError(
                f"{self.folder / CHECKPOINT} steers another base policy than "
                f"{self.folder / 'policy.safetensors'}; restore that file, or delete the run's "
                "folder to start again"
            )
        self.agent.load_state_dict(state["agent"])
        self.warm_up.load_state_dict(state["warm_up"])
        if self.replay is not None and state["replay"] is not None:
            self.replay.load_state_dict(state["replay"])
        self.env_steps, self.decisions = state["env_steps"], state["decisions"]
        self.updates, self.owed = state["updates"], state["owed"]
        self.next_evaluation = state["next_evaluation"]
        self.fresh_starts, self.final = state["fresh_starts"], state["final"]
        self.last_scalars = dict(state["last_scalars"])
        seconds = state["seconds"]
        self.clock.simulate, self.clock.decode = seconds["simulate"], seconds["decode"]
        self.update_seconds, self.evaluate_seconds = seconds["update"], seconds["evaluate"]
        return seconds["total"]

    def _open_record(
        self, resolved: dict[str, Any], checkpoint: Mapping[str, Any] | None
    ) -> RunRecord:
        """The record of a new run, or that of a continued one as it was at the checkpoint."""
        provenance = Provenance.collect(
            device=_device_name(self.device),
            torch_threads=torch.get_num_threads(),
        )
        if checkpoint:
            record = read_record(self.folder / RECORD)
            del record.evaluations[checkpoint["evaluations"] :]
            mine = (self.folder.name, config_hash(resolved), checkpoint["history"])
            if (record.run_id, record.config_hash, _history(record)) != mine:
                raise UserError(
                    f"{self.folder / RECORD} is not the record that {CHECKPOINT} beside it "
                    "continues; restore both as they were, or delete the run's folder to start "
                    "again"
                )
            if provenance not in (record.provenance, *record.continued):
                record.continued = [*record.continued, provenance]
            record.wall_clock.resumed += 1
            record.ended, record.status, record.failure = None, "running", None
            return record
        config, counts = self.config, self.agent.parameter_counts()
        feasible = feasible_return(config, self.base)
        return RunRecord(
            run_id=self.folder.name,
            config=resolved,
            role="learner" if self.agent.learns else "reference",
            provenance=provenance,
            seeds={
                "run": config.seed,
                "policy": config.policy_seed,
                "demonstrations": config.demonstrations.seed,
                "first_held_out": HELD_OUT_SEED,
            },
            started=datetime.now(UTC),
            parameters=Parameters(
                actor=counts["actor"],
                critic=counts["critic"],
                total=counts["total"],
                width=counts["actor_width"] or None,
            ),
            base_policy=describe_base(self.base),
            feasible_q=FeasibleQ(low=feasible[0], high=feasible[1]) if self.agent.learns else None,
        )

    def _draw(self) -> None:
        """Pictures of the last evaluation; the record is closed, so they can harm no number."""
        config, played = self.config, self.evaluator.played
        if played is None:
            return
        try:
            paths = draw_paths(played, self.base.obs_layout, _title(config))
            self.log.picture("eval/paths", paths, self.env_steps)
            if rendering_works():
                frames = film(config, self.base, self.agent)
                self.log.picture("eval/frames", frames, self.env_steps)
        except Exception as error:
            if self.progress:
                tqdm.write(f"no picture of the evaluation: {type(error).__name__}: {error}")

    def _close(self, status: Literal["finished", "failed", "interrupted"]) -> None:
        self.record.ended = datetime.now(UTC)
        self.record.status = status
        self.record.wall_clock.total = time.perf_counter() - self.start
        write_record(self.record, self.folder / RECORD)

    def _make_replay(self) -> ReplayBuffer:
        config = self.config
        return ReplayBuffer(
            min(config.sac.replay_capacity, config.env_steps + config.num_envs),
            self.base.obs_layout.dim,
            self.base.horizon,
            self.base.act_layout.dim,
            self.device,
            config.seed,
        )

    def _update_totals(self) -> None:
        self.record.budget = Budget(
            env_steps=self.env_steps, decisions=self.decisions, updates=self.updates
        )
        self.record.wall_clock = WallClock(
            simulate=self.clock.simulate,
            decode=self.clock.decode,
            update=self.update_seconds,
            evaluate=self.evaluate_seconds,
            total=time.perf_counter() - self.start,
            resumed=self.record.wall_clock.resumed,
        )

    def _write_training_scalars(self, bar: tqdm) -> None:
        means = self.means.take()
        seconds = time.perf_counter() - self.start
        self._write_scalars(
            {
                **means,
                "time/env_steps_per_second": self.env_steps / seconds,
                "time/simulate": self.clock.simulate,
                "time/decode": self.clock.decode,
                "time/update": self.update_seconds,
                "time/evaluate": self.evaluate_seconds,
            }
        )
        if "train/success_once" in means:
            bar.set_postfix(
                success=f"{means['train/success_once']:.2f}",
                held_out=f"{self.last_scalars['eval/success_once']:.2f}",
            )

    def _write_scalars(self, values: Mapping[str, float | None]) -> None:
        for name, value in values.items():
            namespace, _, rest = name.partition("/")
            self.log.scalars(namespace, {rest: value}, self.env_steps)


class _Means:
    """Means of named tensors since they were last taken; reads the device only then."""

    def __init__(self) -> None:
        self._sums: dict[str, torch.Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, values: dict[str, torch.Tensor]) -> None:
        for name, value in values.items():
            if value.numel():
                total = value.detach().double().sum()
                self._sums[name] = self._sums.get(name, 0.0) + total
                self._counts[name] = self._counts.get(name, 0) + value.numel()

    def take(self) -> dict[str, float]:
        means = {name: (total / self._counts[name]).item() for name, total in self._sums.items()}
        self._sums.clear()
        self._counts.clear()
        return means


def _history(record: RunRecord) -> str:
    """A key of all that the record says about the evaluations so far."""
    return content_key(
        [evaluation.model_dump(mode="json", by_alias=True) for evaluation in record.evaluations]
    )


def _title(config: RunConfig) -> str:
    return f"{config.agent} on {config.task} ({config.variant}), seed {config.seed}"


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
