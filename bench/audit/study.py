"""Many cells in one go; states and base policy are shared between the cells of a task."""

from __future__ import annotations

import dataclasses
import gc
from collections.abc import Callable, Sequence
from pathlib import Path

from symsteer.bench.audit.cell import Cell, Settings, audit, reference_task, visit_all
from symsteer.bench.audit.report import read_cell, same_settings, write_cell
from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.tasks import EMBODIMENTS, TASKS, task_class
from symsteer.bench.variants import VARIANTS, read
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy
from symsteer.variant import UNBROKEN, lacks_strength, variant_text

Progress = Callable[[Cell], None]


def variant_texts(variants: Sequence[str], strengths: Sequence[float]) -> list[str]:
    """Every variant at every strength, as ``name:strength``.

    Args:
        variants: names, ``name:strength`` or compositions, ``none``, or ``all`` for ``none`` and
            every variant.
        strengths: of the single names.

    Raises:
        UserError: for what :func:`symsteer.bench.variants.read` refuses, or a strength that no
            variant takes.
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
            f"no variant takes the strength {strengths[0]:g}: name one without a strength of its "
            f"own, e.g. --variant {min(VARIANTS)}"
        )
    return list(dict.fromkeys(texts))


def expand(names: Sequence[str], valid: Sequence[str]) -> list[str]:
    """``names`` without repetition, with ``all`` for every valid one."""
    wanted = [n for name in names for n in (valid if name == "all" else [name])]
    return list(dict.fromkeys(wanted))


def run_cells(
    cells: Sequence[Settings],
    runs: Path,
    base_policy: Path | None = None,
    out: Path | None = None,
    resume: bool = False,
    progress: bool = True,
    done: Progress = lambda cell: None,
) -> list[Cell]:
    """Measure cells, task by task.

    Args:
        cells: what to measure.
        runs: folder whose ``base`` keeps demonstrations and base policies, as of ``run``.
        base_policy: a saved policy instead of a trained one.
        out: folder of the results; one cell is written there, several into a folder each.
        resume: take cells from ``out`` that were measured with the same settings.
        progress: whether to show progress bars of a training.
        done: called after each cell.

    Raises:
        UserError: if the input is wrong; nothing has been simulated then.
    """
    for settings in cells:
        settings.check()
    if resume and out is None:
        raise UserError("--resume takes cells from --out; name that folder")
    places = {(s.task, s.embodiment) for s in cells}
    if base_policy is not None:
        if len(places) > 1:
            raise UserError("--base-policy is for one task and embodiment; name one of each")
        if cells[0].states == "expert":
            raise UserError(
                "--base-policy is given but --states expert does not use it; leave one of them out"
            )
        # Refuse a bad file before the simulation starts.
        _policy(cells[0], runs, base_policy, progress)
    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"cannot write to {out}: {error.strerror}; choose another folder with --out"
            ) from error
    results: dict[Settings, Cell] = {}
    for place in dict.fromkeys((s.task, s.embodiment) for s in cells):
        todo = []
        for settings in (s for s in cells if (s.task, s.embodiment) == place):
            folder = _folder(out, settings, len(cells))
            if resume and folder is not None and (folder / "audit.json").is_file():
                found = read_cell(folder / "audit.json")
                if same_settings(found, settings):
                    results[settings] = found
                    continue
            todo.append(settings)
        if not todo:
            continue
        policy = None
        if "policy" in todo[0].visitors:
            policy = _policy(todo[0], runs, base_policy, progress)
        gc.collect()
        reference = reference_task(todo[0])
        visited = visit_all(reference, todo[0], policy)
        for settings in todo:
            cell = audit(settings, reference, visited, policy)
            results[settings] = cell
            folder = _folder(out, settings, len(cells))
            if folder is not None:
                write_cell(cell, folder)
            done(cell)
        reference.close()
        del reference
        gc.collect()
    return [results[settings] for settings in cells]


def _folder(out: Path | None, settings: Settings, count: int) -> Path | None:
    return out if out is None or count == 1 else out / settings.name


def _policy(settings: Settings, runs: Path, path: Path | None, progress: bool) -> ChunkPolicy:
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
    template: Settings,
) -> list[Settings]:
    """All cells of tasks x embodiments x variants x strengths; ``all`` names every one.

    Raises:
        UserError: for what cannot be measured.
    """
    texts = variant_texts(variants, strengths)
    return [
        dataclasses.replace(template, task=task, embodiment=body, variant=text)
        for task in expand(tasks, TASKS.names())
        for body in expand(bodies, list(EMBODIMENTS))
        for text in texts
    ]
