"""Audits of many tasks, embodiments and variants. Those of a task share states and base policy."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Sequence
from pathlib import Path

from symsteer.bench.audit.defects import audit, reference_task, visit_all
from symsteer.bench.audit.report import read_result, write_result
from symsteer.bench.audit.result import AuditResult, AuditSettings
from symsteer.bench.audit.rollout import Actions, RolloutError, rotated_rollout_error
from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sim.environment import MAX_SCENES
from symsteer.bench.tasks import EMBODIMENTS, TASKS, task_class
from symsteer.bench.variants import VARIANTS, read
from symsteer.bench.variants.levels import with_numbers
from symsteer.errors import UserError
from symsteer.files import prepare_folder
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy
from symsteer.policies.geometry import Group
from symsteer.variant import UNBROKEN, lacks_strength, variant_text

Progress = Callable[[AuditResult], None]


def variant_texts(variants: Sequence[str], strengths: Sequence[float]) -> list[str]:
    """Combine variants and strengths to texts ``name:strength``.

    Args:
        variants: names, ``name:strength`` or compositions, ``none``, or ``all`` for ``none`` and
            every variant.
        strengths: strengths of the variants that are given as a name only.

    Raises:
        UserError: a variant is unknown or badly written, or no variant needs the strengths.
    """
    names = [v for v in variants if v != "all"]
    if "all" in variants:
        names += [v for v in (UNBROKEN, *sorted(VARIANTS)) if v not in names]
    texts: list[str] = []
    used = False
    for name in names:
        takes = bool(strengths) and lacks_strength(name)
        used = used or takes
        for strength in strengths if takes else (None,):
            texts.append(variant_text(s for s in read(name, strength) if not s.changes_nothing))
    if strengths and not used:
        raise UserError(
            f"no variant takes the strength {strengths[0]:g}: name a variant without a strength, "
            f"e.g. --variant {min(VARIANTS)}"
        )
    return list(dict.fromkeys(texts))


def expand(names: Sequence[str], valid: Sequence[str]) -> list[str]:
    """``names`` without repetitions; ``all`` stands for every valid name."""
    wanted = [n for name in names for n in (valid if name == "all" else [name])]
    return list(dict.fromkeys(wanted))


def run_audits(
    wanted: Sequence[AuditSettings],
    runs: Path,
    base_policy: Path | None = None,
    out: Path | None = None,
    resume: bool = False,
    progress: bool = True,
    done: Progress = lambda result: None,
) -> list[AuditResult]:
    """Run audits, task by task.

    Args:
        wanted: what to measure.
        runs: folder of the runs; its subfolder ``base`` keeps demonstrations and base policies.
        base_policy: a saved policy to use instead of training one.
        out: folder of the results; several results get a subfolder each.
        resume: read results with the same settings from ``out`` instead of measuring again.
        progress: whether to show the progress of training.
        done: called after each audit.

    Returns:
        The results, in the order of ``wanted``.

    Raises:
        UserError: the input is wrong; this is checked before any simulation.
    """
    for settings in wanted:
        settings.check()
    if resume and out is None:
        raise UserError("--resume reads results from --out; name that folder")
    places = list(dict.fromkeys((s.task, s.embodiment) for s in wanted))
    if base_policy is not None:
        if len(places) > 1:
            raise UserError("--base-policy is for one task and embodiment; name one of each")
        if wanted[0].states == "expert":
            raise UserError(
                "--base-policy is given but --states expert does not use it; leave one of them out"
            )
        # Refuse a bad file before the simulation starts.
        _policy(wanted[0], runs, base_policy, progress)
    if out is not None:
        prepare_folder(out)
    folders = {
        settings: None if out is None else out / settings.name if len(wanted) > 1 else out
        for settings in wanted
    }
    results: dict[AuditSettings, AuditResult] = {}
    if resume:
        for settings, folder in folders.items():
            if folder is not None and (folder / "audit.json").is_file():
                found = read_result(folder / "audit.json")
                if found.settings == settings:
                    results[settings] = found
    for place in places:
        todo = [s for s in folders if (s.task, s.embodiment) == place and s not in results]
        if not todo:
            continue
        policy = None
        if "policy" in todo[0].visitors:
            policy = _policy(todo[0], runs, base_policy, progress)
        gc.collect()
        reference = reference_task(todo[0])
        visited = visit_all(reference, todo[0], policy)
        for settings in todo:
            results[settings] = audit(settings, reference, visited, policy)
            folder = folders[settings]
            if folder is not None:
                write_result(results[settings], folder)
            done(results[settings])
        reference.close()
        del reference
        gc.collect()
    return [results[settings] for settings in wanted]


def compare_rollouts(
    settings: AuditSettings,
    episodes: int,
    actions: Actions,
    runs: Path,
    base_policy: Path | None = None,
    progress: bool = True,
) -> RolloutError:
    """Compare whole episodes with their turned copies.

    Args:
        settings: task, variant, group and seed are used.
        episodes: number of episodes.
        actions: who acts; see :func:`rotated_rollout_error`.
        runs, base_policy, progress: see :func:`run_audits`; used for the actions of the policy.

    Raises:
        UserError: the settings are wrong, or the embodiment is not the floating gripper.
    """
    settings.check()
    if settings.embodiment != "floating":
        raise UserError("--rollouts needs the floating gripper; use --embodiment floating")
    if episodes < 1:
        raise UserError(f"--rollouts is {episodes}; it must be at least 1")
    if base_policy is not None and actions != "policy":
        raise UserError(f"--actions {actions} does not use --base-policy; leave one of them out")
    policy = _policy(settings, runs, base_policy, progress) if actions == "policy" else None
    return rotated_rollout_error(
        settings.task,
        episodes=episodes,
        actions=actions,
        group=settings.group,
        seed=settings.seed,
        variant=settings.variant,
        batch=min(episodes, 25, MAX_SCENES // Group.parse(settings.group).order),
        policy=policy,
    )


def _policy(settings: AuditSettings, runs: Path, path: Path | None, progress: bool) -> ChunkPolicy:
    task = task_class(settings.task)
    if path is not None:
        return load_policy(path, task.observation_layout, task.action_layout)
    config = RunConfig(task=settings.task, embodiment=settings.embodiment)
    return prepare_base(config, runs, progress=progress)


def grid(
    tasks: Sequence[str],
    bodies: Sequence[str],
    variants: Sequence[str],
    strengths: Sequence[float],
    template: AuditSettings,
) -> list[AuditSettings]:
    """Settings for tasks x embodiments x variants x strengths; ``all`` stands for every name.

    Tasks that need cameras cannot be audited, and are no part of all.

    Raises:
        UserError: see :func:`variant_texts`.
    """
    names = [name for name in TASKS.names() if not task_class(name).needs_cameras]
    return [
        dataclasses.replace(template, task=task, embodiment=body, variant=text)
        for task in expand(tasks, names)
        for body in expand(bodies, list(EMBODIMENTS))
        for text in variant_texts([with_numbers(v, task, body) for v in variants], strengths)
    ]
