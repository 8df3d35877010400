"""Results of ``symsteer detect`` as text, data and maps."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import style as mpl_style
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from symsteer.bench.audit.result import BIN
from symsteer.bench.detect.study import Detection, Found, mean_of_runs
from symsteer.bench.detect.truth import BODIES
from symsteer.bench.runs.folder import write_json
from symsteer.files import write_atomically

LEAST_COPIES = 3
"""A square with fewer copies is left out of a map."""


WORLD = ("task", "embodiment", "variant", "group")
MEASURES = ("auroc", "place_auroc", "correlation")


def to_json(found: Found) -> dict[str, Any]:
    """Plain data of one run."""
    return {**found.about, "detections": [_plain(d) for d in found.detections]}


def _plain(detection: Detection) -> dict[str, Any]:
    measures = {name: getattr(detection, name) for name in MEASURES}
    return {
        "detector": detection.detector,
        "score": detection.score,
        **{name: m and m.to_json() for name, m in measures.items()},
    }


def summary(runs: Sequence[Found]) -> list[dict[str, Any]]:
    """One row for each world and score: means over the runs in this world."""
    worlds: dict[tuple[str, ...], list[Found]] = {}
    for found in runs:
        worlds.setdefault(tuple(_world(found.about).values()), []).append(found)
    rows = []
    for own in worlds.values():
        shared = {
            **_world(own[0].about),
            "runs": [found.about["run"] for found in own],
            "decisions": [found.about["decisions"] for found in own],
            "broken": [found.about["broken"] / found.about["copies"] for found in own],
        }
        for same in zip(*(found.detections for found in own), strict=True):
            means = {name: mean_of_runs([getattr(d, name) for d in same]) for name in MEASURES}
            names = {"detector": same[0].detector, "score": same[0].score}
            plain = {name: m and m.to_json() for name, m in means.items()}
            rows.append({**shared, **names, **plain})
    return rows


def _world(about: dict[str, Any]) -> dict[str, str]:
    return {name: about["settings"][name] for name in WORLD}


def text(found: Found) -> str:
    """A table of one run for the terminal."""
    about = found.about
    lines = [
        f"{', '.join(_world(about).values())}: {about['broken']} of {about['copies']} simulated "
        f"decisions end more than {about['limit_mm']:.1f} mm from the majority of their orbit.",
        f"Detectors saw {about['decisions']} decisions of {about['run']}.",
        "",
        _line("detector", "score", "AUROC", "AUROC of places", "correlation"),
    ]
    for row in to_json(found)["detections"]:
        lines.append(_line(row["detector"], row["score"], *(interval(row[m]) for m in MEASURES)))
    return "\n".join(lines)


def _line(*cells: str) -> str:
    return "{:12s} {:14s} {:>18s} {:>18s} {:>20s}".format(*cells)


def summary_text(rows: Sequence[dict[str, Any]]) -> str:
    """Tables of several runs, in markdown; one for each world."""
    parts = []
    for world in dict.fromkeys(tuple(row[name] for name in WORLD) for row in rows):
        own = [row for row in rows if tuple(row[name] for name in WORLD) == world]
        task, embodiment, variant, group = world
        decisions, broken = own[0]["decisions"], own[0]["broken"]
        parts.append(
            f"### {task}, {embodiment}, `{variant}`, {group}\n\n{len(decisions)} replay buffers of "
            f"{_range(decisions, '{:,.0f}')} decisions; of the simulated copies "
            f"{_range([100 * share for share in broken], '{:.0f}')} % are broken."
        )
        table = [
            "| detector | score | AUROC | AUROC of places | correlation |",
            "|---|---|--:|--:|--:|",
        ]
        for row in own:
            cells = [interval(row[measure], len(decisions)) for measure in MEASURES]
            table.append(f"| `{row['detector']}` | `{row['score']}` | {' | '.join(cells)} |")
        parts.append("\n".join(table))
    return "\n\n".join(parts)


def _range(values: Sequence[float], form: str) -> str:
    low, high = (form.format(end) for end in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


@mpl_style.context("default")  # no settings of a file in the current folder
def write(folder: Path, found: Found) -> None:
    """Write ``detect.json`` and ``detect.png``."""
    picture = io.BytesIO()
    maps(found).savefig(picture, format="png", dpi=120)
    write_atomically(folder / "detect.png", picture.getvalue())
    write_json(folder / "detect.json", to_json(found))


def maps(found: Found) -> Figure:
    """The workspace: departures that were simulated, and the mean rank of each score."""
    truth = found.truth
    columns = {"simulated: mm from the majority": 1e3 * truth.departure}
    for d in found.detections:
        ranks = d.scores.flatten().argsort().argsort().double() / (d.scores.numel() - 1)
        columns[d.score] = ranks.view_as(d.scores)
    figure = Figure(figsize=(2.6 * len(columns), 5.6), layout="constrained")
    axes = figure.subplots(len(BODIES), len(columns), squeeze=False, sharex=True, sharey=True)
    for row, body in zip(axes, BODIES, strict=True):
        for ax, (title, values) in zip(row, columns.items(), strict=True):
            squares = _squares(truth.place[body][truth.reached], values[truth.reached])
            image = ax.scatter(
                [1e3 * BIN * (i + 0.5) for i, _ in squares],
                [1e3 * BIN * (j + 0.5) for _, j in squares],
                c=list(squares.values()),
                marker="s",
                s=45,
                cmap="magma_r",
                norm=Normalize(vmin=0, vmax=max([*squares.values(), 1e-9])),
            )
            figure.colorbar(image, ax=ax, shrink=0.6)
            ax.set(aspect="equal")
            ax.set_title(title, fontsize=8)
        row[0].set_ylabel(f"{body}: y, mm", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("x, mm", fontsize=8)
    figure.suptitle(", ".join(_world(found.about).values()), fontsize=10)
    return figure


def _squares(place: torch.Tensor, values: torch.Tensor) -> dict[tuple[int, int], float]:
    """Mean of the values in each square of the workspace."""
    index = np.floor(place.numpy() / BIN).astype(int)
    squares, which, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
    sums = np.bincount(which.ravel(), weights=values.double().numpy(), minlength=len(squares))
    return {
        (int(i), int(j)): float(total / n)
        for (i, j), n, total in zip(squares, count, sums, strict=True)
        if n >= LEAST_COPIES
    }


def interval(measure: dict[str, float] | None, runs: int = 1) -> str:
    """A measure of :func:`to_json` as text; how many of the runs have it, if not all do."""
    if measure is None:
        return "-"
    some = f" ({measure['runs']:.0f} of {runs} runs)" if measure["runs"] < runs else ""
    return f"{measure['value']:.2f} [{measure['low']:.2f}, {measure['high']:.2f}]{some}"
