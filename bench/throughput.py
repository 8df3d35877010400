"""How many runs an hour this machine executes, and in which way: measured with short runs, in
as many processes at the same time as a sweep would have."""

from __future__ import annotations

import contextlib
import itertools
import math
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from symsteer.agents import AGENTS
from symsteer.agents.sac import can_join
from symsteer.bench.runs.config import EvaluationConfig, Execution, RunConfig
from symsteer.bench.runs.evaluator import check_room
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.bench.runs.run import check
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.records import RunRecord, read_record
from symsteer.policies import POLICIES
from symsteer.policies.files import save_policy
from symsteer.tables import aligned

UPDATES = {"cpu": 128, "cuda": 1000}
"""Of a short run. On a GPU the first ones, which record graphs, must not count much."""

LEAST = EvaluationConfig(**dict.fromkeys(vars(EvaluationConfig()), 1))


class Setting(NamedTuple):
    """How runs are executed: in so many processes at a time, each with so many runs together."""

    device: Literal["cpu", "cuda"]
    num_envs: int
    workers: int
    together: int

    def __str__(self) -> str:
        return "--workers {2} --together {3} with {1} environments on {0}".format(*self)


def fastest(
    choices: Mapping[str, Sequence[Any]], measure: Callable[[Setting], float]
) -> dict[Setting, float]:
    """What ``measure`` says of settings, the highest first.

    The values of each field of a setting are tried with the best ones of the fields before it.
    """
    best = Setting(**{name: values[0] for name, values in choices.items()})
    rates: dict[Setting, float] = {}
    for name, values in choices.items():
        for setting in [best._replace(**{name: value}) for value in values]:
            rates[setting] = rates[setting] if setting in rates else measure(setting)
        best = max(rates, key=rates.__getitem__)
    return dict(sorted(rates.items(), key=lambda item: -item[1]))


def measure(
    config: RunConfig,
    choices: Mapping[str, Sequence[Any]],
    new_pool: Callable[[int, Path], Any],
    report: Callable[[str], None],
) -> dict[Setting, float]:
    """Runs per hour of a learner with untrained base policies.

    Args:
        config: of a run, but for what is chosen.
        choices: for each field of :class:`Setting`, in this order, the values to try.
        new_pool: :class:`symsteer.bench.sweep.pool.LocalPool`.
        report: receives a line for each setting.

    Returns:
        Those of each setting, the fastest first; 0 for one with too little memory or room.

    Raises:
        UserError: if the run cannot be started or does not learn, or no setting can be measured.
    """
    agent = AGENTS.get(config.agent)
    for num_envs in choices["num_envs"] or [0]:  # none at all is refused like 0
        check(replace(config, num_envs=num_envs))
    if agent.role != "learner":
        raise UserError(f"{config.agent} does not learn; name a learner with --agent")
    if not can_join(agent):
        choices = {**choices, "together": [1]}
    evaluating: dict[tuple[str, int], float] = {}

    def play(teams: Sequence[Sequence[RunConfig]], out: Path) -> list[str]:
        """Why runs failed."""
        futures = [pool.submit("run", team, Execution(out, quiet=True)) for team in teams]
        results = itertools.chain(*[pool.result(future) for future in futures])
        return [result.reason for result in results if result.status != "done"]

    def rate(setting: Setting) -> float:
        report(f"trying {setting}")
        device, num_envs, workers, together = setting
        full = replace(config, device=device, num_envs=num_envs)
        evaluation = LEAST if (device, workers) in evaluating else full.evaluation
        runs = [_shortened(full, evaluation, seed) for seed in range(workers * together)]
        with tempfile.TemporaryDirectory() as folder:
            places = [Path(folder) / run_id(run, {}) for run in runs]
            for run, place in zip(runs, places, strict=True):
                policy = new_policy(run.task, run.policy_name, run.seed, **vars(run.policy))
                save_policy(policy, place)
            try:
                check_room([full] * together, cure="lower --num-envs or --together")
                failures = play([runs[i::workers] for i in range(workers)], Path(folder))
            except UserError as error:
                failures = [str(error)]
            if failures:
                report(f"it is left out: {failures[0]}")
                return 0.0
            records = [read_record(place / RECORD) for place in places]
        each = [_seconds(full, *pair) for pair in zip(runs, records, strict=True)]
        train, evaluate = map(statistics.fmean, zip(*each, strict=True))
        return 3600 * workers / (train + evaluating.setdefault((device, workers), evaluate))

    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        pool = new_pool(max(choices["workers"]), folder / "log")
        stack.callback(pool.stop)
        pool.patience = 0.0  # for base policies, which short runs have in their own folders
        play([()] * pool.capacity, folder)  # imports take seconds
        rates = fastest(choices, rate)
    if not any(rates.values()):
        raise UserError("no setting can be measured here; correct what the lines above say")
    return rates


def _shortened(config: RunConfig, evaluation: EvaluationConfig, seed: int) -> RunConfig:
    """A run with one decision of warm-up, few updates, an evaluation before and after them."""
    options: Any = config.agent_options
    if hasattr(options, "warmup"):
        options = replace(options, warmup=config.num_envs)
    turns = math.ceil(UPDATES[config.device] / getattr(options, "utd", 1.0) / config.num_envs)
    steps = (1 + turns) * config.num_envs * config.policy.execute
    evaluation = replace(evaluation, every=steps)
    changes: dict[str, Any] = {"env_steps": steps, "evaluation": evaluation, "seed": seed}
    return replace(config, agent_options=options, **changes)


def _seconds(full: RunConfig, short: RunConfig, record: RunRecord) -> tuple[float, float]:
    """Seconds of a run without its evaluations, and with only them, from a short run's record."""
    clock, (first, last) = record.wall_clock, record.evaluations
    simulated, evaluated = clock.simulate + clock.decode, clock.evaluate + (clock.diagnose or 0.0)
    final = last.wall_clock - first.wall_clock - simulated - clock.update
    learning, learned = (
        run.env_steps - getattr(run.agent_options, "warmup", 0) * run.policy.execute
        for run in (full, short)
    )
    other = clock.total - simulated - clock.update - evaluated
    train = simulated * full.env_steps / short.env_steps + clock.update * learning / learned
    evaluations = math.ceil(full.env_steps / full.evaluation.every)
    return train + other, evaluations * (evaluated - final) + final


def new_policy(task: str, name: str = "edp", seed: int = 0, **options: Any) -> Any:
    """An untrained base policy; its weights do not change what it costs."""
    kind, policy_class = task_class(task), POLICIES.get(name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        policy = policy_class(
            policy_class.Options(**options), kind.observation_layout, kind.action_layout
        )
    policy.freeze()
    return policy


def to_text(run: RunConfig, rates: Mapping[Setting, float]) -> str:
    """Runs per hour, the fastest setting, and what a run is, for a terminal."""
    header = ["device", "environments", "workers", "together", "runs/hour"]
    lines = [[*map(str, setting), f"{rate:.1f}"] for setting, rate in rates.items()]
    return (
        f"{aligned(header, lines)}\n\nfastest: {max(rates, key=rates.__getitem__)}\n"
        f"a run: {run.env_steps:,} steps of {run.agent} on {run.task}, and the evaluations of the "
        "suite second; its base policy comes on top"
    )
