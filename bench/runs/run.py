"""One steering run: base policy, environments, agent, the collect/update loop, record and logs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from agents import AGENTS, ReplayBuffer, make_agent
from bench.runs.base_policy import describe_base, origin, prepare_base
from bench.runs.config import RunConfig
from bench.runs.folder import open_run_folder, run_id, save_checkpoint, write_json
from bench.runs.tensorboard import RunLog
from bench.steering.diagnostics import OnPolicy, measure
from bench.steering.evaluation import HELD_OUT_SEED, Rollout, held_out_seeds, rollout
from bench.steering.latent_env import Clock, LatentNoiseEnv
from bench.tasks import check_embodiment, make, task_class
from bench.variants import evaluated, highest_cost, parse
from leaderboard.records import (
    Budget,
    Episodes,
    Evaluation,
    FeasibleQ,
    Parameters,
    Provenance,
    RunRecord,
    WallClock,
    write_record,
)
from policies.base import ChunkPolicy
from policies.errors import UserError
from policies.geometry import Group

TRAINING_SEEDS = 10_000
"""Run s draws its training episodes from seeds ``TRAINING_SEEDS * s`` on: none is held out."""

DIAGNOSTIC_SEED = HELD_OUT_SEED + 500_000
"""On-policy episodes for the bias of Q start here: held out, and apart from the reported ones."""

LOG_EVERY = 25
"""Vectorised decisions between two writes of training scalars."""


def check(config: RunConfig) -> None:
    """Refuse what cannot be run before anything is built.

    Raises:
        UserError: for an unknown task, embodiment, variant, agent or group, a strength out of
            range, or a device that this machine lacks.
    """
    task_class(config.task)
    check_embodiment(config.embodiment)
    parse(config.variant)
    if config.agent not in AGENTS:
        raise UserError(f"there is no agent {config.agent!r}; valid: {', '.join(AGENTS)}")
    _ = Group.parse(config.sac.group).order
    if config.seed >= HELD_OUT_SEED // 2 // TRAINING_SEEDS:
        raise UserError(
            f"seed {config.seed} would reach into the held-out episodes; use a seed below "
            f"{HELD_OUT_SEED // 2 // TRAINING_SEEDS}"
        )
    for option, device in (("--device", config.device), ("--sim", config.sim)):
        if device == "cuda" and not torch.cuda.is_available():
            raise UserError(
                f"{option} cuda was asked for, but torch finds no CUDA device here; "
                f"use {option} cpu (`symsteer doctor` says what is missing)"
            )


def execute(
    config: RunConfig,
    out: Path,
    demonstrations: Path | None = None,
    policy: Path | None = None,
    progress: bool = True,
    workers: int = 1,
) -> Path:
    """Run one configuration from demonstrations to the final evaluation.

    Args:
        config: what to run.
        out: folder of the runs.
        demonstrations: a trajectory file instead of the scripted expert's.
        policy: a saved base policy instead of a trained one.
        progress: whether to show progress bars.
        workers: processes that share the environments. They are no part of the configuration:
            the record is the same but for the clock.

    Returns:
        The run's folder.

    Raises:
        UserError: if the input is wrong, or the run is finished already.
    """
    check(config)
    if not 1 <= workers <= config.num_envs:
        raise UserError(
            f"--workers is {workers}; it must lie between 1 and the number of environments, "
            f"{config.num_envs}"
        )
    if workers > 1 and config.sim == "cuda":
        raise UserError("--workers needs --sim cpu: on CUDA one process simulates all environments")
    files = origin(demonstrations, policy)
    folder = out / run_id(config, files)
    open_run_folder(folder)
    try:
        base = prepare_base(config, out, demonstrations, policy, progress, workers)
    except BaseException:
        folder.rmdir()
        raise
    resolved = {
        **config.to_json(),
        "evaluation_variant": evaluated(config.variant),
        "files": files,
    }
    write_json(folder / "config.json", resolved)
    run = _Run(config, resolved, folder, base, progress, workers)
    try:
        run.play()
    except BaseException as error:
        run.stop(error)
        raise
    return folder


@dataclass
class _Timer:
    update: float = 0.0
    evaluate: float = 0.0


class _Run:
    """State of a run; :meth:`play` is the loop."""

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
        self.start = time.perf_counter()
        self.timer = _Timer()
        self.means = _Means()
        self.decisions = self.updates = 0
        self.training_env: LatentNoiseEnv | None = None
        self.last_scalars: dict[str, float | None] = {}
        self.device = torch.device(config.device)
        self.agent = self._make_agent(config.agent)
        self.feasible = task_class(config.task).feasible_return(
            config.sac.gamma, base.execute, step_cost=highest_cost(parse(config.variant))
        )
        counts = self.agent.parameter_counts()
        self.record = RunRecord(
            run_id=folder.name,
            config=resolved,
            provenance=Provenance.collect(
                device=_device_name(self.device),
                torch_threads=torch.get_num_threads(),
                root=Path(__file__).parents[2],
            ),
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
            base_policy=describe_base(base),
            feasible_q=FeasibleQ(low=self.feasible[0], high=self.feasible[1])
            if self.agent.learns
            else None,
        )
        write_record(self.record, self._record_path)
        self.log = RunLog(folder, resolved)
        evaluation = config.evaluation
        extra = evaluation.diagnostic_episodes if self.agent.learns else 0
        self.evaluator = self._make_env(
            evaluation.episodes + extra, evaluated(config.variant), ignore_terminations=True
        )

    @property
    def _record_path(self) -> Path:
        return self.folder / "record.json"

    def _make_agent(self, name: str) -> Any:
        return make_agent(
            name,
            self.base.obs_layout,
            self.base.act_layout,
            self.base.horizon,
            self.config.sac,
            self.device,
            self.config.seed,
            self.base.normalized_observation,
        )

    def _make_env(self, num_envs: int, variant: str, ignore_terminations: bool) -> LatentNoiseEnv:
        env = make(
            self.config.task,
            num_envs=num_envs,
            embodiment=self.config.embodiment,
            variant=variant,
            sim=self.config.sim,
            workers=min(self.workers, num_envs),
        )
        return LatentNoiseEnv(env, self.base, ignore_terminations)

    def play(self) -> None:
        """Train to the end of the budget, evaluate the last checkpoint, close the record."""
        env_steps = 0
        if self.agent.learns:
            env_steps = self._train()
        self.evaluate(env_steps, final=True)
        self.evaluator.close()
        self._close("finished")
        self.log.finish(
            {
                name.removeprefix("eval/"): value
                for name, value in self.last_scalars.items()
                if value is not None
            }
        )

    def _train(self) -> int:
        config, agent = self.config, self.agent
        env = self._make_env(config.num_envs, config.variant, ignore_terminations=False)
        self.training_env = env
        warm_up = self._make_agent("base")
        replay = ReplayBuffer(
            min(config.sac.replay_capacity, config.env_steps + config.num_envs),
            agent.obs_layout.dim,
            agent.horizon,
            agent.act_layout.dim,
            self.device,
            config.seed,
        )
        self.evaluate(0)
        first = TRAINING_SEEDS * config.seed
        obs = env.reset(list(range(first, first + config.num_envs)))
        next_evaluation = config.evaluation.every
        owed = 0.0
        rounds = 0
        with tqdm(
            total=config.env_steps,
            desc=_title(config),
            unit="step",
            disable=None if self.progress else True,
        ) as bar:
            while env.control_steps < config.env_steps:
                warming = self.decisions < config.sac.warmup
                noise = (warm_up if warming else agent).act(obs)
                result = env.step(noise)
                replay.add(obs, noise, result.reward, result.next_obs, result.terminal)
                obs = result.obs
                self.decisions += config.num_envs
                rounds += 1
                self.means.add({f"train/{k}": v for k, v in result.episodes.items()})
                if not warming:
                    begin = time.perf_counter()
                    owed += config.num_envs * config.sac.utd
                    while owed >= 1:
                        self.means.add(agent.update(replay.sample(config.sac.batch_size)))
                        owed -= 1
                        self.updates += 1
                    self.timer.update += time.perf_counter() - begin
                bar.update(min(env.control_steps, config.env_steps) - bar.n)
                if rounds % LOG_EVERY == 0:
                    values = self._write_training_scalars(env.control_steps)
                    if "train/success_once" in values:
                        bar.set_postfix(
                            success=f"{values['train/success_once']:.2f}",
                            held_out=f"{self.last_scalars['eval/success_once']:.2f}",
                        )
                if next_evaluation <= env.control_steps < config.env_steps:
                    self.evaluate(env.control_steps)
                    next_evaluation += config.evaluation.every
        self._write_training_scalars(env.control_steps)
        env.close()
        return env.control_steps

    def evaluate(self, env_steps: int, final: bool = False) -> None:
        """Held-out episodes of the deterministic actor, diagnostics, record, checkpoint, logs."""
        begin = time.perf_counter()
        config, agent = self.config, self.agent
        count = config.evaluation.final_episodes if final else config.evaluation.episodes
        seeds = held_out_seeds(count)
        if agent.learns:
            # An evaluation draws its own noise, so that it leaves training as it is.
            state = agent.generator.get_state()
            agent.generator.manual_seed(DIAGNOSTIC_SEED + config.seed)
            greedy, on_policy = self._learner_episodes(seeds)
            generator = torch.Generator(self.device).manual_seed(config.seed)
            diagnostics = measure(agent, self.base, greedy, on_policy, self.feasible, generator)
            agent.generator.set_state(state)
        else:
            reference = self._make_agent(agent.name)
            greedy = rollout(self.evaluator, lambda obs, rows: reference.act(obs), seeds)
            diagnostics = {}
        self.timer.evaluate += time.perf_counter() - begin
        columns = greedy.episodes
        self.record.evaluations.append(
            Evaluation(
                env_steps=env_steps,
                decisions=self.decisions,
                updates=self.updates,
                wall_clock=time.perf_counter() - self.start,
                final=final,
                episodes=Episodes.model_validate(columns),
                diagnostics=dict(diagnostics),
            )
        )
        self._update_totals(env_steps)
        write_record(self.record, self._record_path)
        save_checkpoint(
            self.folder / "checkpoint.pt",
            {"agent": agent.state_dict(), "env_steps": env_steps, "decisions": self.decisions},
        )
        self.last_scalars = {
            f"eval/{name}": columns[name].double().mean().item()
            for name in ("success_once", "success_at_end", "return", "episode_len")
        }
        self._write_scalars(
            {**self.last_scalars, **{f"diag/{k}": v for k, v in diagnostics.items()}}, env_steps
        )
        if self.progress:
            success = self.last_scalars["eval/success_once"]
            tqdm.write(
                f"{_title(config)}: {env_steps:7d} steps, held-out success {success:.2f} "
                f"({count} episodes{', final' if final else ''})"
            )

    def _learner_episodes(self, seeds: Sequence[int]) -> tuple[Rollout, OnPolicy]:
        """Deterministic episodes from ``seeds`` and stochastic ones, side by side."""
        agent, greedy_count = self.agent, len(seeds)
        extra = [DIAGNOSTIC_SEED + i for i in range(self.config.evaluation.diagnostic_episodes)]
        log_probs: list[torch.Tensor] = []

        def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
            noise, log_prob = agent.sample(obs)
            log_probs.append(log_prob)
            deterministic = (rows < greedy_count).to(obs.device)
            return torch.where(
                deterministic[:, None, None], agent.act(obs, deterministic=True), noise
            )

        whole = rollout(self.evaluator, act, [*seeds, *extra])
        # One entry a decision and batch: [batches * T] x [N] -> [T, batches * N].
        steps = len(whole.obs)
        log_prob = torch.cat(
            [torch.stack(log_probs[i : i + steps]) for i in range(0, len(log_probs), steps)], dim=1
        )
        return whole.episodes_of(slice(0, greedy_count)), OnPolicy(
            whole.episodes_of(slice(greedy_count, None)),
            log_prob[:, greedy_count : greedy_count + len(extra)],
        )

    def stop(self, error: BaseException) -> None:
        """Close the record of a run that did not finish."""
        interrupted = isinstance(error, KeyboardInterrupt)
        self.record.failure = (
            "interrupted by the user" if interrupted else f"{type(error).__name__}: {error}"
        )
        self._close("interrupted" if interrupted else "failed")
        self.log.close()

    def _close(self, status: Literal["finished", "failed", "interrupted"]) -> None:
        self.record.ended = datetime.now(UTC)
        self.record.status = status
        self.record.wall_clock.total = time.perf_counter() - self.start
        write_record(self.record, self._record_path)

    def _update_totals(self, env_steps: int) -> None:
        clock = self.training_env.clock if self.training_env else Clock()
        self.record.budget = Budget(
            env_steps=env_steps, decisions=self.decisions, updates=self.updates
        )
        self.record.wall_clock = WallClock(
            simulate=clock.simulate,
            decode=clock.decode,
            update=self.timer.update,
            evaluate=self.timer.evaluate,
            total=time.perf_counter() - self.start,
        )

    def _rates(self, env_steps: int) -> dict[str, float]:
        seconds = time.perf_counter() - self.start
        clock = self.training_env.clock if self.training_env else Clock()
        return {
            "time/env_steps_per_second": env_steps / seconds,
            "time/simulate": clock.simulate,
            "time/decode": clock.decode,
            "time/update": self.timer.update,
            "time/evaluate": self.timer.evaluate,
        }

    def _write_training_scalars(self, env_steps: int) -> dict[str, float]:
        values = {**self.means.take(), **self._rates(env_steps)}
        self._write_scalars(values, env_steps)
        return values

    def _write_scalars(self, values: Mapping[str, float | None], step: int) -> None:
        for name, value in values.items():
            namespace, _, rest = name.partition("/")
            self.log.scalars(namespace, {rest: value}, step)


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


def _title(config: RunConfig) -> str:
    return f"{config.agent} on {config.task} ({config.variant}), seed {config.seed}"


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
