"""Audits of many tasks and variants. Those of a task share states and base policy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

from symsteer.bench.audit.defects import audit, reference_task, visit_all
from symsteer.bench.audit.report import read_result, write_result
from symsteer.bench.audit.result import AuditResult, AuditSettings
from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.tasks import TASKS, task_class
from symsteer.bench.variants import VARIANTS, read
from symsteer.errors import UserError
from symsteer.files import prepare_folder
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy
from symsteer.variant import variant_text

RUNS = Path("runs")
"""The folder where runs are by default; its subfolder ``base`` keeps demonstrations and base
policies."""

ALL = "all"
"""Stands for every task, and with a strength for every variant."""


def cells(
    tasks: Sequence[str], variants: Sequence[str], template: AuditSettings
) -> list[AuditSettings]:
    """Settings for tasks x variants; the strengths of a variant stand together.

    Args:
        tasks: names, or ``all``: every task that tells the poses of its bodies.
        variants: texts of variants; ``all:0.5`` stands for every variant at this strength.
        template: the other settings.

    Raises:
        UserError: a variant is unknown or badly written.
    """
    known = [name for name in TASKS.names() if not task_class(name).is_seen()]
    tasks = [name for task in tasks for name in (known if task == ALL else [task])]
    texts = []
    for text in variants:
        name, colon, strength = text.partition(":")
        texts += [f"{v}{colon}{strength}" for v in sorted(VARIANTS)] if name == ALL else [text]
    settings = []
    for task in dict.fromkeys(tasks):
        strengths: dict[tuple[str, ...], dict[str, None]] = {}
        for text in texts:
            specs = read(text, place=(task, template.embodiment))
            specs = tuple(spec for spec in specs if not spec.changes_nothing)
            strengths.setdefault(tuple(s.name for s in specs), {})[variant_text(specs)] = None
        settings += [
            dataclasses.replace(template, task=task, variant=variant)
            for same in strengths.values()
            for variant in same
        ]
    return settings


def run_audits(
    wanted: Sequence[AuditSettings],
    base_policy: Path | None = None,
    out: Path | None = None,
    done: Callable[[AuditResult], None] = lambda result: None,
) -> list[AuditResult]:
    """Run audits, task by task.

    Args:
        wanted: what to measure.
        base_policy: a saved policy to use instead of training one.
        out: folder of the results; several results get a subfolder each. What it has with the same
            settings and base policy is not measured again.
        done: called after each audit.

    Returns:
        The results, in the order of ``wanted``.

    Raises:
        UserError: the input is wrong; this is checked before any simulation.
    """
    for settings in wanted:
        settings.check()
    places: dict[tuple[str, str], list[AuditSettings]] = {}
    for settings in dict.fromkeys(wanted):
        places.setdefault((settings.task, settings.embodiment), []).append(settings)
    given = None
    if base_policy is not None:
        if len(places) > 1:
            raise UserError("--base-policy is for one task; name one")
        given = audited_policy(wanted[0], base_policy)
    if out is not None:
        prepare_folder(out)
    results: dict[AuditSettings, AuditResult] = {}
    for same_place in places.values():
        first = same_place[0]
        policy = None
        if "policy" in first.visitors:
            policy = given or audited_policy(first, None)
        reference = visited = None
        for settings in same_place:
            folder = out and (out / settings.name if len(wanted) > 1 else out)
            stored = None
            if folder and (folder / "audit.json").is_file():
                stored = read_result(folder / "audit.json")
            digest = policy and policy.content_hash()[:12]
            if stored and (stored.settings, stored.base_policy) == (settings, digest):
                results[settings] = stored
                continue
            if reference is None or visited is None:
                reference = reference_task(first)
                visited = visit_all(reference, first, policy)
            results[settings] = audit(settings, reference, visited, policy)
            if folder:
                write_result(results[settings], folder)
            done(results[settings])
        if reference is not None:
            reference.close()
    return [results[settings] for settings in wanted]


def audited_policy(settings: AuditSettings, path: Path | None) -> ChunkPolicy:
    """The base policy that visits states: a saved one, or that of a run with default settings."""
    task = task_class(settings.task)
    if path is not None:
        return load_policy(path, task.observation_layout, task.action_layout)
    config = RunConfig(task=settings.task, embodiment=settings.embodiment)
    return prepare_base(config, Execution(RUNS))
