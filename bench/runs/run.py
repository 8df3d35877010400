"""One steering run, from demonstrations to the record: start, continue, evaluate again."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from symsteer.agents import AGENTS
from symsteer.bench.runs.base_policy import (
    origin,
    prepare_base,
    with_policy_of,
)
from symsteer.bench.runs.checkpoint import load_checkpoint
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.evaluator import Evaluator, check_room
from symsteer.bench.runs.folder import (
    CONFIG,
    RECORD,
    claimed,
    discard_empty,
    is_finished,
    read_config,
    run_id,
    write_json,
)
from symsteer.bench.runs.observers import ProgressFile, observers_of
from symsteer.bench.runs.stored import (
    named,
    restored,
    stored_config,
    stored_policy,
)
from symsteer.bench.runs.tracking import Tracking
from symsteer.bench.runs.trainer import Trainer, budget_of, feasible_return
from symsteer.bench.tasks import check_embodiment, task_class
from symsteer.bench.variants import build, evaluation_variants, read
from symsteer.errors import UserError
from symsteer.leaderboard.records import Episodes, Evaluation, read_record
from symsteer.policies.files import save_policy
from symsteer.terminal import to_paste
from symsteer.variant import specs_at, variant_text


def check(config: RunConfig) -> None:
    """Check that a configuration can be run, before anything is built.

    Raises:
        UserError: for an unknown task, embodiment or variant, tasks of a base policy that do not
            fit together, a strength out of range, a budget in which nothing is learned, or a device
            that this machine does not have.
    """
    own = task_class(config.task)
    check_embodiment(config.embodiment)
    for name in config.policy_tasks:
        if task_class(name).action_layout != own.action_layout:
            raise UserError(
                f"the actions of {name} have another layout than those of {config.task}; one "
                "policy cannot be trained on both, so leave it out of --policy.tasks"
            )
    build(specs_at(read(config.variants), 1))
    if any(spec.changes_nothing for spec in config.variants):
        raise UserError(
            f"the variant {config.variant} has a part of strength 0, which changes nothing; leave "
            "it out, or use none, the unbroken task"
        )
    AGENTS.get(config.agent).check(config.agent_options, budget_of(config))
    if option := _option_of_missing_device(config):
        raise UserError(
            f"{option} cuda was asked for, but torch finds no CUDA device here; "
            f"use {option} cpu (`symsteer doctor` says what is missing)"
        )


def check_device(config: RunConfig, name: str) -> None:
    """Check that this machine has the devices of a run that was begun already.

    Raises:
        UserError: if it has not; it calls the run ``name``.
    """
    if option := _option_of_missing_device(config):
        raise UserError(
            f"{name} was begun with {option} cuda, but torch finds no CUDA device here; go on with "
            "it on a machine that has one (`symsteer doctor` says what is missing)"
        )


def _option_of_missing_device(config: RunConfig) -> str | None:
    if torch.cuda.is_available():
        return None
    options = (("--device", config.device), ("--sim", config.sim))
    return next((option for option, device in options if device == "cuda"), None)


def execute(
    config: RunConfig,
    out: Path,
    demonstrations: Path | None = None,
    policy: Path | None = None,
    progress: bool = True,
    workers: int = 1,
    tracking: Tracking | None = None,
) -> Path:
    """Run one configuration from demonstrations to the final evaluation.

    An unfinished run of the same configuration is continued from its last checkpoint.

    Args:
        config: what to run.
        out: folder of the runs.
        demonstrations: a trajectory file, instead of demonstrations of the scripted expert.
        policy: a saved base policy, instead of training one; the run uses its settings.
        progress: whether to show progress bars.
        workers: processes that share the environments. They are not part of the configuration:
            the record is the same except for times.
        tracking: a service that shows the run; it changes nothing in the record.

    Returns:
        The run's folder.

    Raises:
        UserError: if the input is wrong, the run is finished already, or another process is
            working on it (``RunBusyError``).
    """
    with opened(config, out, demonstrations, policy, progress, workers, tracking) as trainer:
        trainer.play()
    return trainer.folder


@contextlib.contextmanager
def opened(
    config: RunConfig,
    out: Path,
    demonstrations: Path | None = None,
    policy: Path | None = None,
    progress: bool = True,
    workers: int = 1,
    tracking: Tracking | None = None,
    together: int = 1,
) -> Iterator[Trainer]:
    """The trainer of one of ``together`` runs in a process; see :func:`execute`."""
    if policy is not None:
        if demonstrations is not None:
            raise UserError("a base policy of yours needs no demonstrations; leave one of them out")
        config = with_policy_of(config, policy)
    check_all(config, workers)
    files = origin(demonstrations, policy)
    how = (demonstrations, policy, progress, workers, tracking, together)
    with _opened(config, out / run_id(config, files), files, *how) as trainer:
        yield trainer


def resume(
    folder: Path, progress: bool = True, workers: int = 1, tracking: Tracking | None = None
) -> Path:
    """Continue an unfinished run from its last checkpoint.

    Args:
        folder: of the run.
        progress, workers, tracking: as for :func:`execute`.

    Raises:
        UserError: if the folder is not a run's, the run is finished, its checkpoint is damaged, or
            another process is working on it, or this machine lacks its device.
    """
    folder = named(folder)
    config, files = stored_config(folder)
    check_device(config, f"the run {folder.name}")
    check_all(config, workers)
    with _opened(config, folder, files, None, None, progress, workers, tracking) as trainer:
        trainer.play()
    return folder


@dataclasses.dataclass(frozen=True)
class EvaluationResult:
    """Held-out episodes of a run's last checkpoint.

    Attributes:
        run_id: of the run.
        variant: of these episodes.
        evaluation: as in a record.
        recorded: whether the final evaluation in the record is equal; None if it has another
            variant or number of episodes, or if the run was made on a GPU.
    """

    run_id: str
    variant: str
    evaluation: Evaluation
    recorded: bool | None

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "run_id": self.run_id,
            "variant": self.variant,
            "recorded": self.recorded,
            **self.evaluation.model_dump(mode="json", by_alias=True),
        }


def evaluate(
    folder: Path, variant: str | None = None, episodes: int | None = None, workers: int = 1
) -> EvaluationResult:
    """Evaluate a run's last checkpoint again, with its own variant or another one.

    Args:
        folder: of the run; it is not changed.
        variant: default: the variant of the run.
        episodes: number of held-out episodes; default: as in the final evaluation.
        workers: processes that share the environments.

    Raises:
        UserError: if the folder is not a run's, it has no checkpoint yet, or it was simulated on a
            GPU and this machine has none.
    """
    run = restored(folder)
    config, folder = run.config, run.folder
    check_device(config, f"the run {folder.name}")
    check_all(config, workers, trains=False)
    share = 1.0 if run.state["final"] else run.state["env_steps"] / config.env_steps
    own = evaluation_variants(config.variants, share)
    variants = own if variant is None else read(variant, place=config.place)
    count = config.evaluation.final_episodes if episodes is None else episodes
    if count < 1:
        raise UserError(f"--episodes is {count}; it must be at least 1")
    feasible = feasible_return(config, run.agent, run.policy)
    evaluator = Evaluator(config, run.policy, run.agent, feasible, variants, workers)
    begin = time.perf_counter()
    with contextlib.closing(evaluator):
        columns = evaluator.play(count).episodes
        diagnostics = evaluator.diagnose(config.evaluation.final_diagnostic_episodes)
    evaluation = Evaluation(
        **{key: run.state[key] for key in ("env_steps", "decisions", "updates", "final")},
        wall_clock=time.perf_counter() - begin,
        episodes=Episodes.model_validate(columns),
        diagnostics=dict(diagnostics),
    )
    final = None
    if is_finished(folder):
        record = read_record(folder / RECORD)
        repeatable = "cuda" not in (record.config["sim"], record.config["device"])
        final = record.final if repeatable else None
    comparable = final and variants == own and len(final.episodes.seed) == count
    return EvaluationResult(
        run_id=folder.name,
        variant=variant_text(variants),
        evaluation=evaluation,
        recorded=_alike(evaluation.episodes, final.episodes) if final and comparable else None,
    )


def _alike(one: Episodes, other: Episodes) -> bool:
    """Whether episodes are equal. Their directions follow from the seeds; old records lack them."""
    parts = [episodes.model_copy(update={"direction": None}) for episodes in (one, other)]
    return parts[0] == parts[1]


def check_all(config: RunConfig, workers: int, trains: bool = True) -> None:
    """:func:`check`, and whether these processes can hold the run's environments."""
    check(config)
    if not 1 <= workers <= config.num_envs:
        raise UserError(
            f"--workers is {workers}; it must lie between 1 and the number of environments, "
            f"{config.num_envs}"
        )
    if workers > 1 and config.sim == "cuda":
        raise UserError("--workers needs --sim cpu: on CUDA one process simulates all environments")
    check_room([config], workers, trains)


@contextlib.contextmanager
def _opened(
    config: RunConfig,
    folder: Path,
    files: dict[str, Any],
    demonstrations: Path | None,
    policy: Path | None,
    progress: bool,
    workers: int,
    tracking: Tracking | None,
    together: int = 1,
) -> Iterator[Trainer]:
    """The trainer of a run that this process alone works on; it is told of errors."""
    out = folder.parent
    resolved = {
        **config.to_json(),
        "evaluation_variant": variant_text(evaluation_variants(config.variants)),
        "files": files,
    }
    if run_id(config, files) != folder.name:  # it was begun with options that are no more
        resolved = read_config(folder)

    def check_files() -> None:
        if files and demonstrations is None and policy is None:
            raise UserError(
                f"the run {folder.name} began from files of yours and was stopped before it had "
                "its base policy; start it again with `symsteer run` and the same options"
            )

    with claimed(folder):
        try:
            write_json(folder / CONFIG, resolved)
            base = stored_policy(folder, config)
            if base is None:
                check_files()
                ProgressFile(folder, config.env_steps).write("base policy", 0)
                base = prepare_base(config, out, demonstrations, policy, progress, workers)
                save_policy(base, folder)
        except BaseException:
            discard_empty(folder)
            raise
        observers = observers_of(config, resolved, progress, tracking)
        checkpoint = load_checkpoint(folder)
        trainer = Trainer(config, folder, base, checkpoint, observers, workers, together)
        try:
            yield trainer
        except BaseException as error:
            trainer.stop(error)
            names = (
                config.agent,
                config.policy_name,
                config.task,
                *(v.name for v in config.variants),
            )
            typed = [name for name in names if ":" in name]
            how = ("--workers", workers) * (workers > 1) + ("--trust", *typed) * bool(typed)
            error.add_note(f"continue the run with: {to_paste('symsteer', 'resume', folder, *how)}")
            raise
