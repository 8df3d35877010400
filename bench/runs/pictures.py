"""Pictures of the last evaluation: paths from above, and frames of one episode.

The paths are drawn from the observations of the evaluation. The frames need a Vulkan driver.
One episode is simulated again for them.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mani_skill.utils.sapien_utils import look_at
from matplotlib import style as mpl_style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from symsteer.agents.agent import Agent
from symsteer.agents.episodes import Rollout
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.steering.directions import directions, positions
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.tasks import make
from symsteer.bench.variants import evaluation_variants
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Field, Layout
from symsteer.variant import VariantSpec

EPISODES = 32
"""Number of episodes with drawn paths; more paths would cover each other."""

PLANAR_VECTOR = Layout([Field("xy", 1)])

SECTORS = 12
"""Number of sectors in which successes are counted."""

FRAMES = 6
"""Frames of an episode, in two rows; a GIF has its colours from as many."""

SIZE = 320
"""Width and height of a rendered frame, pixels."""

CAMERA = {
    "pose": look_at([0.5, 0.65, 0.55], [0.0, 0.0, 0.08]),
    "fov": 0.8,
    "width": SIZE,
    "height": SIZE,
}
"""The camera of rendered frames."""

FRAMES_PER_SECOND = 20
"""ManiSkill's control frequency: films with a frame for each control step run in real time."""

COLOURS = 128
"""Colours of a GIF."""

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
    found = directions(rollout.obs[0], layout)
    assert found is not None  # a picture needs two positions
    direction = found.cpu().numpy()

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


def first_episode(config: RunConfig, policy: ChunkPolicy, agent: Agent) -> list[np.ndarray]:
    """Frames of the first held-out episode, from its start to its first success or time limit.

    Args:
        config: of the run; the episode is in the world of its evaluations.
        policy: decodes the noise.
        agent: plays deterministically.

    Returns:
        One frame at the start and one after each decision, ``[height, width, 3]`` uint8.

    Raises:
        UserError: if there is no Vulkan driver.
    """
    variants, seed = evaluation_variants(config.variants), held_out_seeds(1)[0]
    return filmed(config, policy, agent, variants, seed, every=policy.execute).frames


def contact_sheet(frames: Sequence[np.ndarray]) -> np.ndarray:
    """Six frames in two rows, evenly spaced in time, ``[height, width, 3]`` uint8."""
    rows = np.split(_spaced(frames), 2)
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def to_gif(frames: Sequence[np.ndarray], rate: float) -> bytes:
    """An animated GIF that repeats for ever.

    Args:
        frames: ``[height, width, 3]`` uint8.
        rate: frames per second.
    """
    pictures = [Image.fromarray(frame) for frame in frames]
    # One palette, and no dithering: parts that stay the same then take no space.
    some = Image.fromarray(np.concatenate(_spaced(frames)))
    palette = some.quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    file = io.BytesIO()
    first.save(
        file, "GIF", save_all=True, append_images=others, duration=round(1000 / rate), loop=0
    )
    return file.getvalue()


def _spaced(frames: Sequence[np.ndarray]) -> np.ndarray:
    """Six frames, evenly spaced in time."""
    chosen = np.linspace(0, len(frames) - 1, FRAMES).round().astype(int)
    return np.stack([frames[i] for i in chosen])


@dataclass(frozen=True)
class Filmed:
    """An episode up to its first success or time limit.

    Attributes:
        frames: ``[height, width, 3]`` uint8, the first one before the first action.
        steps: control steps.
        solved: whether it ended with success.
    """

    frames: list[np.ndarray]
    steps: int
    solved: bool


def filmed(
    config: RunConfig,
    policy: ChunkPolicy,
    agent: Agent,
    variants: Sequence[VariantSpec],
    seed: int,
    every: int = 1,
) -> Filmed:
    """Play an episode, and render it.

    Args:
        config: task, embodiment and simulator.
        policy, agent: the deterministic actor plays.
        variants: how the symmetry is broken.
        seed: of the episode.
        every: control steps between two frames; the last one is always rendered.

    Raises:
        UserError: if there is no Vulkan driver.
    """
    env = make(
        config.task,
        num_envs=1,
        embodiment=config.embodiment,
        variant=variants,
        sim=config.sim,
        render=True,
        render_mode="rgb_array",
        human_render_camera_configs=CAMERA,
    )
    # Not through the latent-noise environment: it starts a new episode before the last frame.
    with contextlib.closing(env):
        obs, _ = env.reset(seed=[seed])
        frames = [_frame(env)]
        steps, done, info = 0, False, {}
        while not done:
            obs = obs.to(config.device)
            actions = agent.decode(obs, agent.act(obs, deterministic=True)).to(env.device)
            for t in range(policy.execute):
                obs, _, _, truncated, info = env.step(actions[:, t])
                steps += 1
                done = bool(info["success"] | truncated)
                if done or steps % every == 0:
                    frames.append(_frame(env))
                if done:
                    break
        return Filmed(frames, steps, bool(info["success"]))


def _frame(env: Any) -> np.ndarray:
    # The upper fifth shows only the horizon.
    return env.render()[0].cpu().numpy()[SIZE // 5 :, :, :3]
