"""Results of ``symsteer detect`` as text, data and maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from symsteer.bench.audit.result import BIN
from symsteer.bench.detect.study import Detection, Measure
from symsteer.bench.detect.truth import BODIES, Truth
from symsteer.bench.runs.folder import write_json

LEAST_COPIES = 3
"""A square with fewer copies is left out of a map."""


def to_json(about: dict[str, Any], found: Sequence[Detection]) -> dict[str, Any]:
    """Plain data."""

    def plain(measure: Measure | None) -> dict[str, float] | None:
        return None if measure is None else dataclasses.asdict(measure)

    return {
        **about,
        "detections": [
            {
                "detector": d.detector,
                "score": d.score,
                "auroc": plain(d.auroc),
                "place_auroc": plain(d.place_auroc),
                "correlation": plain(d.correlation),
            }
            for d in found
        ],
    }


def text(about: dict[str, Any], found: Sequence[Detection]) -> str:
    """A table for the terminal."""
    settings = about["settings"]
    lines = [
        f"{settings['task']}, {settings['embodiment']}, {settings['variant']}, "
        f"{settings['group']}: {about['broken']} of {about['copies']} simulated decisions end more "
        f"than {about['limit_mm']:.1f} mm from the majority of their orbit.",
        f"Detectors saw {about['decisions']} decisions of {about['run']}.",
        "",
        f"{'detector':12s} {'score':14s} {'AUROC':>18s} {'AUROC of places':>18s} "
        f"{'correlation':>20s}",
    ]
    lines += [
        f"{d.detector:12s} {d.score:14s} {_text(d.auroc):>18s} {_text(d.place_auroc):>18s} "
        f"{_text(d.correlation):>20s}"
        for d in found
    ]
    return "\n".join(lines)


def write(folder: Path, about: dict[str, Any], truth: Truth, found: Sequence[Detection]) -> None:
    """Write ``detect.json`` and ``detect.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "detect.json", to_json(about, found))
    maps(about, truth, found).savefig(folder / "detect.png", dpi=120)


def maps(about: dict[str, Any], truth: Truth, found: Sequence[Detection]) -> Figure:
    """The workspace: departures that were simulated, and the mean rank of each score."""
    columns = {"simulated: mm from the majority": 1e3 * truth.departure}
    for d in found:
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
    settings = about["settings"]
    figure.suptitle(
        f"{settings['task']}, {settings['embodiment']}, {settings['variant']}", fontsize=10
    )
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


def _text(measure: Measure | None) -> str:
    if measure is None:
        return "-"
    return f"{measure.value:.2f} [{measure.low:.2f}, {measure.high:.2f}]"
