"""The picture of an evaluation: the observed paths of tool and objects from above."""

from __future__ import annotations

import math

import numpy as np
import torch
from matplotlib import style as mpl_style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from symsteer.agents.episodes import Rollout
from symsteer.bench.steering.directions import directions, positions
from symsteer.policies.geometry import Field, Layout

EPISODES = 32
"""Number of episodes with drawn paths; more paths would cover each other."""

PLANAR_VECTOR = Layout([Field("xy", 1)])

SECTORS = 12
"""Number of sectors in which successes are counted."""

# Colours that colour-blind readers can distinguish, from Okabe and Ito.
SUCCESS, FAILURE, TOOL = "#0072B2", "#D55E00", "#999999"


def draw_paths(rollout: Rollout, layout: Layout, title: str) -> np.ndarray:
    """Paths of tool and objects from above, and successes by direction.

    Left: the first 32 episodes, each up to its first success. Right: the same paths, each turned
    about the workspace centre so that the vector between the last two positions of the layout
    (object to goal; tool to object in tasks without a goal) points to the right. In a symmetric
    world, the turned paths of a symmetric agent do not depend on the turn. Below: episodes and
    successes by the direction of this vector.

    Args:
        rollout: episodes of the deterministic actor.
        layout: of the observation. The observed positions are drawn, with the errors that a
            variant adds.
        title: name of the run.

    Returns:
        A picture ``[height, width, 3]`` uint8.
    """
    names = positions(layout)
    # Decisions begin with an observation; the last one also ends with one.
    seen = torch.cat([rollout.obs, rollout.next_obs[-1:]]).double().cpu()
    paths = np.stack([seen[..., layout.slice(name)].numpy() for name in names])
    paths *= 100  # [names, T + 1, N, 2] in cm
    lengths = rollout.running.sum(dim=0).cpu().numpy() + 1
    success = rollout.episodes["success_once"].cpu().numpy().astype(bool)
    angles = directions(rollout.obs[0], layout)
    assert angles is not None  # a picture needs two positions
    direction = angles.cpu().numpy()

    source, target = (name.removesuffix("_xy").replace("_", " ") for name in names[-2:])
    drawn = min(EPISODES, len(success))
    note = (
        f"{success.sum()} of {len(success)} held-out episodes succeed.\n"
        f"Paths: the first {drawn}, each up to its first success.\n"
        "Seen from above, about the workspace centre."
    )
    # "default": no settings of a file in the current folder.
    with mpl_style.context(["default", {"font.family": "DejaVu Sans", "font.size": 9}]):
        # Almost square, because TensorBoard scales pictures to the width of a card.
        figure = Figure(figsize=(8.4, 8.4), dpi=110, layout="constrained")
        figure.suptitle(title, fontsize=11)
        above, turned = figure.add_subplot(2, 2, 1), figure.add_subplot(2, 2, 2)
        rose, key = figure.add_subplot(2, 2, 3, projection="polar"), figure.add_subplot(2, 2, 4)
        _draw_paths(above, paths[:, :, :drawn], lengths, success)
        above.set_title("paths")
        _draw_paths(turned, _turn(paths, -direction)[:, :, :drawn], lengths, success)
        # The same scale and centre in both panels, so that they differ by turns only.
        reach = 1.05 * max(np.abs(a.dataLim.get_points()).max() for a in (above, turned))
        for axes in (above, turned):
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
            axes.set(xlabel="x (cm)", ylabel="y (cm)")
        turned.set_title(f"paths turned: {source} to {target} points right")
        _draw_rose(rose, direction, success)
        rose.set_title(f"episodes by direction, {source} to {target}")
        key.axis("off")
        key.legend(
            handles=[
                Line2D([], [], color=SUCCESS, lw=2.5, label="object, success"),
                Line2D([], [], color=FAILURE, lw=2.5, label="object, no success"),
                Line2D([], [], color=TOOL, lw=0.8, label="tool"),
                Line2D([], [], color="black", lw=0, marker=".", label="start"),
                Line2D([], [], color="black", lw=0, marker="o", mfc="none", label=target),
            ],
            loc="upper left",
            fontsize=10,
            frameon=False,
        )
        key.text(0.03, 0.6, note, fontsize=10, va="top", transform=key.transAxes)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _turn(paths: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Turn the paths ``[names, T + 1, N, 2]`` of episode i by ``angle[i]``."""
    episodes = torch.from_numpy(paths).movedim(2, 0)
    return PLANAR_VECTOR.rotate(episodes, torch.from_numpy(angle)).movedim(0, 2).numpy()


def _draw_paths(axes: Axes, paths: np.ndarray, lengths: np.ndarray, success: np.ndarray) -> None:
    """Draw the episodes ``paths [names, T + 1, N, 2]``, each up to its length."""
    for i in range(paths.shape[2]):
        color = SUCCESS if success[i] else FAILURE
        tool, *objects = paths[:, : lengths[i], i]
        axes.plot(*tool.T, color=TOOL, lw=0.6, alpha=0.7, zorder=1)
        for path in objects:
            axes.plot(*path.T, color=color, lw=1.4, alpha=0.8, zorder=2)
            axes.plot(*path[0], ".", color=color, ms=4, zorder=3)
        axes.plot(*objects[-1][-1], "o", color=color, mfc="none", ms=7, mew=0.8, zorder=3)
    axes.grid(color="#E4E4E4", lw=0.6)
    axes.set_axisbelow(True)


def _draw_rose(axes: Axes, direction: np.ndarray, success: np.ndarray) -> None:
    """Count episodes and successes in sectors of the directions."""
    width = 2 * math.pi / SECTORS
    sector = np.round(direction / width).astype(int) % SECTORS
    counts = np.bincount(sector, minlength=SECTORS)
    good = np.bincount(sector[success], minlength=SECTORS)
    angles = width * np.arange(SECTORS)
    axes.bar(angles, good, width=0.9 * width, color=SUCCESS)
    axes.bar(angles, counts - good, bottom=good, width=0.9 * width, color=FAILURE)
    axes.tick_params(labelsize=7.5, colors="#555555")
    axes.set_yticks(range(0, counts.max() + 1, max(1, math.ceil(counts.max() / 5))))
