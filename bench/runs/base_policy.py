"""Demonstrations and base policy of a run: built once, found again by content hash."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.demos import FORMAT, MODES, Demonstrations, collect, load
from symsteer.bench.runs.config import Execution, RunConfig, build_config, content_key
from symsteer.bench.steering.evaluation import DRAWS, steerability
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.tasks import make, task_class
from symsteer.errors import UserError
from symsteer.files import built_once, write_together
from symsteer.leaderboard.records import BasePolicy, flat
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy, policy_path, save_policy
from symsteer.terminal import progress_bar, tell

STEERABILITY_ENVS = 128
"""Parallel environments of the steerability report; fewer if it has fewer episodes."""

MEASURED = ("episodes", "action_std", "solvable", "equivariance_error", "jump", "warning")
"""Of the steerability report, in the record under the same names."""


def check_policy(config: RunConfig) -> None:
    """Check that the base policy of a run can be trained, before demonstrations are collected.

    Raises:
        UserError: if it cannot see what one of its tasks shows, or an extra is missing.
    """
    for name in config.policy_tasks:
        observed = task_class(name).observation_layout
        POLICIES.get(config.policy_name).check(config.policy, observed)


def prepare_base(config: RunConfig, how: Execution) -> ChunkPolicy:
    """The frozen base policy of a run, with its steerability report.

    It is trained on demonstrations of the unbroken task in the run's embodiment, for every variant:
    the agent has to handle the broken symmetry, not the base policy. The folder ``base`` of the
    runs keeps demonstrations and policies.

    Raises:
        UserError: if a file does not fit the task, or nothing can be written; see also
            :func:`check_policy`.
    """
    task = task_class(config.task)
    layouts = (task.observation_layout, task.action_layout)
    if how.base_policy is not None:
        policy = load_policy(how.base_policy, *layouts)
        return _measured(config, policy.used_with(config.policy), how)
    check_policy(config)
    paths = {}
    for name in config.policy_tasks:
        given = how.demos if name == config.task else None
        paths[name] = given or demonstration_file(_on(config, name), how.runs, how.quiet)
    demos = _loaded(config, paths)
    folder = _policy_folder(config, how.runs, demos)
    # The policies of several tasks are trained at once.
    place = _policy_folder(_on(config, min(config.policy_tasks)), how.runs, demos)
    with contextlib.nullcontext() if policy_path(folder).is_file() else built_once(place):
        source = _source(config, how.runs, demos)
        if not policy_path(source).is_file():
            for name, policy in _train(_on(config, config.task), demos, how.quiet).items():
                policy.report["world"] = {
                    "task": name,
                    "embodiment": config.embodiment,
                    "demonstrations": dataclasses.asdict(config.demonstrations),
                    "policy_seed": config.policy_seed,
                }
                save_policy(policy, _policy_folder(_on(config, name), how.runs, demos))
        policy = load_policy(source, *layouts).used_with(config.policy)
        new = "steerability" not in policy.report
        policy = _measured(config, policy, how)
        if new:
            save_policy(policy, folder)
    return policy


def with_policy_of(config: RunConfig, path: Path) -> RunConfig:
    """The configuration of a run that uses a saved base policy instead of training one.

    Args:
        config: its settings of the base policy and the demonstrations must be the defaults or
            those of the file.
        path: of the policy.

    Raises:
        UserError: if the policy is of another task or embodiment, or the configuration asks for
            other settings than the policy has.
    """
    task = task_class(config.task)
    base = load_policy(path, task.observation_layout, task.action_layout)
    world = base.report.get("world") or {}
    for key in ("task", "embodiment"):
        here, there = getattr(config, key), world.get(key, getattr(config, key))
        if here != there:
            raise UserError(
                f"{path} was trained for {there}, and this run's {key} is {here}; name a policy of "
                "the same task and embodiment"
            )
    # A setting with its default value was not asked for: the value of the file is used.
    plain = RunConfig(
        task=config.task, agent=config.agent, policy_name=config.policy_name, seed=config.seed
    )
    default, asked = (flat(c.to_json()) for c in (plain, config))
    default["policy.name"] = RunConfig.policy_name
    in_use = {
        key: getattr(config.policy, key)
        for key in base.options.IN_USE
        if asked.get(f"policy.{key}") != default.get(f"policy.{key}")
    }
    settings: dict[str, Any] = {
        "policy": {"name": POLICIES.name_of(type(base)), **base.options.to_json(), **in_use}
    }
    if "demonstrations" in world:
        settings["demonstrations"] = world["demonstrations"]
        settings["policy_seed"] = world.get("policy_seed")
    told = build_config(config.to_json() | settings, str(path))
    known = flat(told.to_json())
    for key, value in asked.items():
        if value not in (default[key], known.get(key)):
            raise UserError(
                f"{path} was trained with {key} {known.get(key)}, and this run asks for {value}; "
                f"leave --{key.replace('_', '-')} out, or name no base policy, to train one like "
                "that"
            )
    return told


def base_key(config: RunConfig) -> tuple:
    """Runs with the same key need one training, if they do not begin from files."""
    # A policy of several tasks is trained once for the runs on all of them.
    data = (config.policy_tasks, config.embodiment, config.demonstrations)
    return (*data, config.policy_name, config.policy.trained(), config.policy_seed)


def find_base(config: RunConfig, out: Path) -> Path | None:
    """The folder of a run's trained base policy; None if it has not been trained yet."""
    paths = _demonstration_paths(config, out)
    if not all(path.is_file() for path in paths.values()):
        return None
    try:
        folder = _source(config, out, _loaded(config, paths))
    except UserError:  # the run that trains the policy reports what is wrong with a file
        return None
    return folder if policy_path(folder).is_file() else None


def take_base(config: RunConfig, content_hash: str, runs: Path, out: Path) -> None:
    """Copy a trained base policy and its demonstrations from ``runs/base`` to ``out/base``.

    The policy is found by its content: a version of SymSteer with further options gives another
    name to its folder.

    Args:
        config: the run that is to steer it.
        content_hash: of the policy.
        runs, out: folders of runs.

    Raises:
        UserError: if the policy or the demonstrations are not there.
    """
    demos = _demonstration_paths(config, runs)
    folders = (runs / "base").glob(f"{config.task}-{config.embodiment}-*")
    same = [
        folder
        for folder in sorted(folders)
        if policy_path(folder).is_file() and load_policy(folder).content_hash() == content_hash
    ]
    if not same or not all(path.is_file() for path in demos.values()):
        raise UserError(
            f"{runs / 'base'} does not have the base policy {content_hash[:12]} and its "
            "demonstrations; name a folder of runs that has, or leave --base-from out to make them "
            "anew"
        )
    pairs = [file for path in demos.values() for file in (path, path.with_suffix(".json"))]
    files = {out / "base" / file.name: file.read_bytes() for file in pairs}
    place = _policy_folder(config, out, _loaded(config, demos))
    write_together(files | {place / file.name: file.read_bytes() for file in same[0].iterdir()})


def demonstration_path(config: RunConfig, out: Path) -> Path:
    """Path of the scripted expert's demonstrations for a run, whether they exist or not."""
    wanted = config.demonstrations
    # The settings of the mode are part of the name: if they change, old files are not found.
    key = content_key(dataclasses.asdict(MODES[wanted.mode]), FORMAT)
    name = f"{config.task}-{config.embodiment}-{wanted.mode}-{wanted.count}-s{wanted.seed}-{key}.h5"
    return out / "base" / name


def demonstration_file(config: RunConfig, out: Path, quiet: bool = False) -> Path:
    """The scripted expert's demonstrations of the unbroken task; collected if they do not exist."""
    wanted = config.demonstrations
    path = demonstration_path(config, out)
    if path.is_file():
        return path
    with built_once(path):
        if not path.is_file():
            with progress_bar("demonstrations", wanted.count, quiet) as advance:
                how = (wanted.count, wanted.mode, wanted.seed, path)
                collect(config.task, config.embodiment, *how, progress=advance)
    return path


def describe_base(policy: ChunkPolicy) -> BasePolicy:
    """The record's block on a base policy."""
    report = policy.report.get("steerability") or {}
    measured: dict[str, Any] = {key: report.get(key) for key in MEASURED}
    return BasePolicy(
        name=policy.name,
        group=str(policy.group),
        content_hash=policy.content_hash(),
        base_success=report.get("success"),
        draws=report.get("draws") or DRAWS,
        training_seconds=policy.training_record.get("seconds"),
        parameters=policy.parameter_count(),
        **measured,
    )


def _demonstration_paths(config: RunConfig, out: Path) -> dict[str, Path]:
    return {task: demonstration_path(_on(config, task), out) for task in config.policy_tasks}


def _loaded(config: RunConfig, paths: Mapping[str, Path]) -> dict[str, Demonstrations]:
    count = config.demonstrations.count
    return {name: load(path, name, config.embodiment, count) for name, path in paths.items()}


def _policy_folder(config: RunConfig, out: Path, demos: Mapping[str, Demonstrations]) -> Path:
    name, options = config.policy_name, config.policy.to_json()
    # Code from outside SymSteer can change under the same name.
    extension = POLICIES.extension(name)
    hashes = [demos[task].content_hash for task in sorted(demos)]
    data = hashes[0] if len(hashes) == 1 else hashes
    key = content_key(data, name, options, extension and extension.sha256, config.policy_seed)
    short = name.rpartition(":")[2]
    return out / "base" / f"{config.task}-{config.embodiment}-{short}-{key}"


def _source(config: RunConfig, out: Path, demos: Mapping[str, Demonstrations]) -> Path:
    """The policy's folder; unless it exists, that of the same one as it was trained."""
    own = _policy_folder(config, out, demos)
    there = policy_path(own).is_file()
    return own if there else _policy_folder(_on(config, config.task), out, demos)


def _on(config: RunConfig, task: str) -> RunConfig:
    """A run on another task of the policy, which is used there as it was trained."""
    return dataclasses.replace(config, task=task, policy=config.policy.trained())


def _train(
    config: RunConfig, demos: Mapping[str, Demonstrations], quiet: bool
) -> dict[str, ChunkPolicy]:
    """The policies of all tasks whose demonstrations the run's policy is trained on."""
    kind: Any = POLICIES.get(config.policy_name)
    with progress_bar("base policy", quiet=quiet) as bar:

        def advance(step: int, steps: int, loss: float) -> None:
            bar(step, steps, loss=f"{loss:.4f}")

        mine = demos[config.task]
        how = (mine.action_layout, config.policy_seed, advance, config.device)
        if len(demos) == 1:
            fitted = kind.fit(config.policy, mine.episodes, mine.observation_layout, *how)
            return {config.task: fitted}
        data = {name: (d.episodes, d.observation_layout) for name, d in demos.items()}
        return kind.fit_tasks(config.policy, data, *how)


def _measured(config: RunConfig, policy: ChunkPolicy, how: Execution) -> ChunkPolicy:
    """The policy on its device, with a report on as many states as the run asks for."""
    states = config.evaluation.steerability_states
    if (policy.report.get("steerability") or {}).get("states") != states:
        num_envs = min(STEERABILITY_ENVS, DRAWS * states)
        env = make(
            config.task,
            num_envs=num_envs,
            embodiment=config.embodiment,
            sim=config.sim,
            workers=min(how.sim_workers, num_envs),
        )
        latent = LatentNoiseEnv(env, policy, ignore_terminations=True)
        with contextlib.closing(latent), torch.no_grad():
            report = steerability(latent, policy, config.policy_seed, states)
        if report["warning"] and not how.quiet:
            tell(f"warning: {report['warning']}")
        policy.report["steerability"] = report
    return policy.to(config.device)
