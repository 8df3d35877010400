"""One steering run, from demonstrations to the record: start, continue, evaluate again."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from symsteer.agents import AGENTS
from symsteer.bench.runs.base_policy import check_policy, prepare_base, with_policy_of
from symsteer.bench.runs.checkpoint import load_checkpoint
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.evaluator import Evaluator, check_room
from symsteer.bench.runs.folder import (
    CONFIG,
    RECORD,
    claimed,
    discard_empty,
    is_finished,
    write_json,
)
from symsteer.bench.runs.observers import ProgressFile, RecordWriter, TerminalProgress
from symsteer.bench.runs.scalars import Scalars
from symsteer.bench.runs.stored import RunFolder, restored
from symsteer.bench.runs.trainer import Trainer, budget_of
from symsteer.bench.tasks import check_embodiment, task_class
from symsteer.bench.variants import build, evaluation_variants, read
from symsteer.errors import UserError
from symsteer.leaderboard.records import Episodes, Evaluation, read_record, run_id_of
from symsteer.policies.files import save_policy
from symsteer.terminal import to_paste
from symsteer.variant import specs_at, variant_text


def check(
    config: RunConfig, workers: int | None = None, trains: bool = True, begun: str = ""
) -> None:
    """Check that a configuration can be run, before anything is built.

    Args:
        config: what to run.
        workers: processes that have to hold its environments; None: that is not checked.
        trains: whether there are training environments among them.
        begun: the name of a run that was begun already, for the message.

    Raises:
        UserError: for an unknown task, embodiment or variant, tasks of a base policy that do not
            fit together, a strength out of range, a budget in which nothing is learned, a device
            that this machine does not have, or too few or too many processes.
    """
    actions = task_class(config.task).action_layout
    check_embodiment(config.embodiment)
    for name in config.policy_tasks:
        if task_class(name).action_layout != actions:
            raise UserError(
                f"the actions of {name} have another layout than those of {config.task}; one "
                "policy cannot be trained on both, so leave it out of --policy.tasks"
            )
    check_policy(config)
    build(specs_at(read(config.variants), 1))
    if any(spec.changes_nothing for spec in config.variants):
        raise UserError(
            f"the variant {config.variant} has a part of strength 0, which changes nothing; leave "
            "it out, or use none, the unbroken task"
        )
    AGENTS.get(config.agent).check(config.agent_options, budget_of(config))
    for option, device in (("--device", config.device), ("--sim", config.sim)):
        if device == "cuda" and not torch.cuda.is_available():
            what, cure = f"{option} cuda was asked for", f"use {option} cpu"
            if begun:
                what = f"{begun} was begun with {option} cuda"
                cure = "go on with it on a machine that has one"
            raise UserError(
                f"{what}, but torch finds no CUDA device here; {cure} (`symsteer doctor` says what "
                "is missing)"
            )
    if workers is None:
        return
    if not 1 <= workers <= config.num_envs:
        raise UserError(
            f"--sim-workers is {workers}; it must lie between 1 and the number of environments, "
            f"{config.num_envs}"
        )
    if workers > 1 and config.sim == "cuda":
        raise UserError(
            "--sim-workers needs --sim cpu: on CUDA one process simulates all environments"
        )
    check_room([config], workers, trains)


def execute(run: RunConfig | Path, how: Execution) -> Path:
    """Run a configuration, or what the folder of a run holds, to the final evaluation.

    An unfinished run is continued from its last checkpoint.

    Returns:
        The run's folder.

    Raises:
        UserError: if the input is wrong, the folder is not a run's, its checkpoint is damaged, the
            run is finished already, or another process is working on it (``RunBusyError``).
    """
    with opened(run, how) as trainer:
        trainer.play()
    return trainer.folder


@contextlib.contextmanager
def opened(begun: RunConfig | Path, how: Execution, together: int = 1) -> Iterator[Trainer]:
    """The trainer of a run that this process alone works on; it is told of errors.

    Args:
        begun: a configuration, or the folder of a run, which stays in its folder of runs.
        how: it is executed.
        together: number of runs in this process.
    """
    if isinstance(begun, Path):
        run = RunFolder.stored(begun)
        how = replace(how, runs=run.folder.parent)
        check(run.config, how.sim_workers, begun=f"the run {run.folder.name}")
    else:
        if how.base_policy is not None:
            if how.demos is not None:
                raise UserError(
                    "a base policy of yours needs no demonstrations; leave one of them out"
                )
            begun = with_policy_of(begun, how.base_policy)
        check(begun, how.sim_workers)
        variant = variant_text(evaluation_variants(begun.variants))
        resolved = {**begun.to_json(), "evaluation_variant": variant, "files": how.files}
        run = RunFolder(how.runs / run_id_of(resolved), begun, resolved)
    config, folder = run.config, run.folder
    with claimed(folder):
        try:
            write_json(folder / CONFIG, run.resolved)
            policy = run.policy()
            if policy is None:
                if run.files != how.files:
                    raise UserError(
                        f"the run {folder.name} began from files of yours and was stopped before "
                        "it had its base policy; start it again with `symsteer run` and the same "
                        "options"
                    )
                ProgressFile(folder, config.env_steps).write("base policy", 0)
                policy = prepare_base(config, how)
                save_policy(policy, folder)
        except BaseException:
            discard_empty(folder)
            raise
        records = RecordWriter()
        # The record is closed before the pictures are drawn, TensorBoard after them.
        observers = [records, TerminalProgress(), Scalars(records)]
        checkpoint = load_checkpoint(folder)
        trainer = Trainer(run, policy, checkpoint, observers, how, together)
        try:
            yield trainer
        except BaseException as error:
            trainer.stop(error)
            names = [config.agent, config.policy_name, config.task]
            typed = [n for n in (*names, *(v.name for v in config.variants)) if ":" in n]
            words = ("--sim-workers", how.sim_workers) * (how.sim_workers > 1)
            words += ("--trust", *typed) * bool(typed)
            command = to_paste("symsteer", "resume", folder, *words)
            error.add_note(f"continue the run with: {command}")
            raise


@dataclass(frozen=True)
class EvaluationResult:
    """Held-out episodes of a run's last checkpoint, in a variant.

    ``recorded`` says whether the final evaluation in the record is equal; it is None if that has
    another variant or number of episodes, or if the run was made on a GPU.
    """

    run_id: str
    variant: str
    recorded: bool | None
    evaluation: Evaluation

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        data = dict(vars(self))
        return data | data.pop("evaluation").model_dump(mode="json", by_alias=True)


def evaluate(
    folder: Path, variant: str | None = None, episodes: int | None = None, workers: int = 1
) -> EvaluationResult:
    """What `symsteer evaluate` does; its help explains the options.

    Raises:
        UserError: if the folder is not a run's, it has no checkpoint yet, or it was simulated on a
            GPU and this machine has none.
    """
    run = restored(folder)
    config, name = run.config, run.folder.name
    check(config, workers, trains=False, begun=f"the run {name}")
    share = 1.0 if run.state["final"] else run.state["env_steps"] / config.env_steps
    trained = evaluation_variants(config.variants, share)
    variants = trained if variant is None else read(variant, place=config.place)
    count = config.evaluation.final_episodes if episodes is None else episodes
    if count < 1:
        raise UserError(f"--episodes is {count}; it must be at least 1")
    begin = time.perf_counter()
    with contextlib.closing(Evaluator(run, variants, workers)) as evaluator:
        played = evaluator.play(count).episodes
        diagnostics = evaluator.diagnose(config.evaluation.final_diagnostic_episodes)
    evaluation = Evaluation(
        **{key: run.state[key] for key in ("env_steps", "decisions", "updates", "final")},
        wall_clock=time.perf_counter() - begin,
        episodes=Episodes.model_validate(played),
        diagnostics=dict(diagnostics),
    )
    recorded = None
    if variants == trained and is_finished(run.folder):
        record = read_record(run.folder / RECORD)
        repeatable = "cuda" not in (record.config["sim"], record.config["device"])
        if repeatable and record.final and len(record.final.episodes.seed) == count:
            recorded = _alike(evaluation.episodes, record.final.episodes)
    return EvaluationResult(name, variant_text(variants), recorded, evaluation)


def _alike(one: Episodes, other: Episodes) -> bool:
    """Whether episodes are equal. Their directions follow from the seeds; old records lack them."""
    mine, theirs = (episodes.model_copy(update={"direction": None}) for episodes in (one, other))
    return mine == theirs
