"""One steering run, from demonstrations to the record: start it, continue it, evaluate it again."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from symsteer.agents import AGENTS
from symsteer.bench.runs.base_policy import origin, prepare_base, with_policy_of
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.runs.evaluator import Evaluator
from symsteer.bench.runs.folder import (
    CONFIG,
    RECORD,
    Heartbeat,
    claimed,
    discard_empty,
    is_finished,
    load_checkpoint,
    read_config,
    run_id,
    write_json,
)
from symsteer.bench.runs.loop import Loop, feasible_return, new_agent
from symsteer.bench.steering.search import rounds
from symsteer.bench.tasks import check_embodiment, task_class
from symsteer.bench.variants import evaluated, parse
from symsteer.errors import UserError
from symsteer.leaderboard.records import Episodes, Evaluation, read_record
from symsteer.policies.base import ChunkPolicy, load_policy, policy_path, save_policy
from symsteer.policies.geometry import Group
from symsteer.variant import parse_variant, variant_text


def check(config: RunConfig) -> None:
    """Refuse what cannot be run before anything is built.

    Raises:
        UserError: for an unknown task, embodiment, variant, agent or group, a strength out of
            range, a budget in which nothing is learned, or a device that this machine lacks.
    """
    task_class(config.task)
    check_embodiment(config.embodiment)
    variants = parse(config.variant)
    if config.agent not in AGENTS:
        raise UserError(f"there is no agent {config.agent!r}; valid: {', '.join(AGENTS)}")
    if config.variant != "none" and len(variants) < len(config.variant.split("+")):
        raise UserError(
            f"the variant {config.variant} has a part of strength 0, which changes nothing; leave "
            "it out, or use none, the unbroken task"
        )
    _ = Group.parse(config.sac.group).order
    if AGENTS[config.agent].learns:
        warm_up = config.sac.warmup * config.policy.execute
        if config.env_steps <= warm_up:
            raise UserError(
                f"env_steps is {config.env_steps}, which ends within the warm-up of {warm_up} "
                "environment steps, so that nothing would be learned; raise env_steps or lower "
                "sac.warmup"
            )
        if config.sac.replay_capacity < config.num_envs:
            raise UserError(
                f"sac.replay_capacity is {config.sac.replay_capacity}, less than one decision of "
                f"each of {config.num_envs} environments; raise it or lower num_envs"
            )
    if AGENTS[config.agent].searches:
        rounds(config.num_envs, task_class(config.task).max_episode_steps, config.env_steps)
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

    An unfinished run of the same configuration is continued from its last checkpoint.

    Args:
        config: what to run.
        out: folder of the runs.
        demonstrations: a trajectory file instead of the scripted expert's.
        policy: a saved base policy instead of a trained one; the configuration takes over its
            settings.
        progress: whether to show progress bars.
        workers: processes that share the environments. They are no part of the configuration:
            the record is the same but for the clock.

    Returns:
        The run's folder.

    Raises:
        UserError: if the input is wrong, the run is finished already, or another process is
            working on it (:class:`symsteer.bench.runs.folder.RunBusyError`).
    """
    if policy is not None:
        if demonstrations is not None:
            raise UserError("a base policy of yours needs no demonstrations; leave one of them out")
        config = with_policy_of(config, policy)
    _check_all(config, workers)
    files = origin(demonstrations, policy)

    def prepare() -> ChunkPolicy:
        return prepare_base(config, out, demonstrations, policy, progress, workers)

    return _play(config, out / run_id(config, files), files, prepare, progress, workers)


def resume(folder: Path, progress: bool = True, workers: int = 1) -> Path:
    """Continue an unfinished run from its last checkpoint.

    Args:
        folder: of the run.
        progress, workers: as for :func:`execute`.

    Raises:
        UserError: if the folder is no run's, the run is finished, its checkpoint is damaged, or
            another process is working on it.
    """
    folder = _named(folder)
    config, files = _stored(folder)
    _check_all(config, workers)

    def prepare() -> ChunkPolicy:
        if files:
            raise UserError(
                f"the run {folder.name} began from files of yours and was stopped before it had "
                "its base policy; start it again with `symsteer run` and the same options"
            )
        return prepare_base(config, folder.parent, None, None, progress, workers)

    return _play(config, folder, files, prepare, progress, workers)


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """Held-out episodes of a run's last checkpoint.

    Attributes:
        run_id: of the run.
        variant: how the world was broken in these episodes.
        evaluation: as in a record.
        recorded: whether the record's final evaluation has the same episodes; None where it is of
            another variant or number of episodes.
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
) -> Evaluated:
    """Evaluate a run's last checkpoint again, in its own world or in one broken otherwise.

    Args:
        folder: of the run; nothing in it changes.
        variant: how the world is broken; default: as in the run.
        episodes: number of held-out episodes; default: the run's final ones.
        workers: processes that share the environments.

    Raises:
        UserError: if the folder is no run's, or it has no checkpoint yet.
    """
    folder = _named(folder)
    config, _ = _stored(folder)
    _check_all(config, workers)
    own = evaluated(config.variant)
    variant = own if variant is None else variant_text(parse_variant(variant))
    parse(variant)
    count = config.evaluation.final_episodes if episodes is None else episodes
    if count < 1:
        raise UserError(f"--episodes is {count}; it must be at least 1")
    state = load_checkpoint(folder)
    if state is None:
        raise UserError(
            f"the run {folder.name} has no checkpoint yet; `symsteer resume` brings it to its end"
        )
    base = _stored_policy(folder, config)
    if base is None or base.content_hash() != state["base_policy"]:
        raise UserError(
            f"{policy_path(folder)} is not the base policy that the checkpoint of {folder.name} "
            "steers; restore it from where the run was made"
        )
    agent = new_agent(config.agent, config, base)
    agent.load_state_dict(state["agent"])
    evaluator = Evaluator(
        config, base, feasible_return(config, base), agent.learns, variant, workers
    )
    begin = time.perf_counter()
    try:
        columns, diagnostics = evaluator.measure(agent, count)
    finally:
        evaluator.close()
    evaluation = Evaluation(
        env_steps=state["env_steps"],
        decisions=state["decisions"],
        updates=state["updates"],
        wall_clock=time.perf_counter() - begin,
        final=state["final"],
        episodes=Episodes.model_validate(columns),
        diagnostics=diagnostics,
    )
    final = read_record(folder / RECORD).final if is_finished(folder) else None
    comparable = final and variant == own and len(final.episodes.seed) == count
    return Evaluated(
        run_id=folder.name,
        variant=variant,
        evaluation=evaluation,
        recorded=evaluation.episodes == final.episodes if final and comparable else None,
    )


def _check_all(config: RunConfig, workers: int) -> None:
    check(config)
    if not 1 <= workers <= config.num_envs:
        raise UserError(
            f"--workers is {workers}; it must lie between 1 and the number of environments, "
            f"{config.num_envs}"
        )
    if workers > 1 and config.sim == "cuda":
        raise UserError("--workers needs --sim cpu: on CUDA one process simulates all environments")


def _play(
    config: RunConfig,
    folder: Path,
    files: dict[str, Any],
    prepare: Callable[[], ChunkPolicy],
    progress: bool,
    workers: int,
) -> Path:
    resolved = {
        **config.to_json(),
        "evaluation_variant": evaluated(config.variant),
        "files": files,
    }
    with claimed(folder):
        try:
            write_json(folder / CONFIG, resolved)
            base = _stored_policy(folder, config)
            if base is None:
                Heartbeat(folder, config.env_steps).beat("base policy", 0)
                base = prepare()
                save_policy(base, folder)
        except BaseException:
            discard_empty(folder)
            raise
        loop = Loop(config, resolved, folder, base, progress, workers)
        try:
            loop.play()
        except BaseException as error:
            loop.stop(error)
            error.add_note(f"continue the run with: symsteer resume {folder}")
            raise
    return folder


def _named(folder: Path) -> Path:
    """The folder by its own name, which is the run's, however it was called (".", a link)."""
    return Path(os.path.realpath(folder))


def _stored(folder: Path) -> tuple[RunConfig, dict[str, Any]]:
    """Configuration of a run's folder, and the content hashes of the files it began from."""
    data = read_config(folder)
    files = data.pop("files", {})
    data.pop("evaluation_variant", None)
    config = build_config(data, str(folder / CONFIG))
    if not isinstance(files, dict) or run_id(config, files) != folder.name:
        raise UserError(
            f"{folder / CONFIG} does not belong to a folder of this name: it was edited, or the "
            "folder renamed; undo that"
        )
    return config, files


def _stored_policy(folder: Path, config: RunConfig) -> ChunkPolicy | None:
    """The base policy that lies in a run's folder, if it has got that far."""
    if not policy_path(folder).is_file():
        return None
    task = task_class(config.task)
    base = load_policy(folder, task.observation_layout, task.action_layout)
    return base.to(config.device)
