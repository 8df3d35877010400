"""Videos of agents, alone or side by side, and pictures of paths where nothing can be rendered."""

from __future__ import annotations

import contextlib
import errno
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from imageio_ffmpeg import count_frames_and_secs, write_frames

from symsteer.bench.caption import captioned
from symsteer.bench.runs.evaluator import Evaluator
from symsteer.bench.runs.pictures import (
    FAILURE,
    FRAMES_PER_SECOND,
    SUCCESS,
    Filmed,
    draw_paths,
    filmed,
    to_gif,
)
from symsteer.bench.runs.stored import Restored, restored
from symsteer.bench.runs.trainer import feasible_return
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.variants import evaluation_variants, read
from symsteer.errors import UserError
from symsteer.files import prepare_folder, staged, write_atomically
from symsteer.variant import VariantSpec, file_name, variant_text

COLUMNS = 4
"""Films side by side, at most; more of them begin another row."""

PAUSE = 12
"""Control steps that an episode stays when all films of it have ended."""

GIF_EVERY = 2
"""Control steps between two frames of a GIF, which would be large otherwise."""


def film(
    folders: Sequence[Path],
    variant: str | None = None,
    episodes: int = 3,
    out: Path | None = None,
) -> Path:
    """Film held-out episodes of the last checkpoints of runs.

    Several runs play the same episodes side by side, each with a caption that says when the
    episode was solved.

    Args:
        folders: of the runs; several must be of one task and embodiment.
        variant: how the symmetry is broken; default: as in the runs' evaluations.
        episodes: how many, from the first held-out seed on.
        out: the film, .mp4 or .gif; default: ``film-VARIANT.mp4`` in the run's folder, for several
            runs ``film-TASK-EMBODIMENT-VARIANT.mp4`` beside the first one.

    Returns:
        The file that was written: the film where a Vulkan driver works, else a picture, .png, of
        the paths seen from above; its name begins with ``paths``, unless ``out`` names it.

    Raises:
        UserError: if a folder is not a run's or has no checkpoint, the runs are of different tasks
            or worlds, the variant is unknown, or ``out`` has another suffix.
    """
    if episodes < 1:
        raise UserError(f"--episodes is {episodes}; it must be at least 1")
    if out is not None and out.suffix not in (".mp4", ".gif"):
        raise UserError(f"a film is written to .mp4 or .gif; give --out such a name, not {out}")
    runs = [restored(folder) for folder in folders]
    first = runs[0]
    places = {run.config.place for run in runs}
    if len(places) > 1:
        found = " and ".join(sorted(" ".join(place) for place in places))
        raise UserError(
            f"these runs are of different tasks ({found}), which cannot be side by side; film "
            "runs of one task and embodiment"
        )
    if variant is None:
        worlds = {run.config.variant for run in runs}
        if len(worlds) > 1:
            raise UserError(
                f"these runs are of different worlds ({', '.join(sorted(worlds))}); say with "
                "--variant in which one they play"
            )
        variants = evaluation_variants(first.config.variants)
    else:
        variants = read(variant, place=first.config.place)
    kind = "film" if rendering_works() else "paths"
    if out is None:
        name = variant_text(variants)
        if len(runs) == 1:
            out = first.folder / f"{kind}-{file_name(name)}.mp4"
        else:
            stem = f"{kind}-{'-'.join(first.config.place)}-{name}"
            out = first.folder.parent / f"{file_name(stem)}.mp4"
    prepare_folder(out.parent)
    if kind == "paths":
        out = out.with_suffix(".png")
        with staged(out) as file:
            rows = _in_rows([_paths(run, variants, episodes) for run in runs])
            imageio.imwrite(file, rows, "PNG")
        return out
    moving = out.suffix == ".gif"
    every = GIF_EVERY if moving else 1
    frames: list[Any] = [
        frame
        for seed in held_out_seeds(episodes)
        for frame in _episode(runs, _captions(runs), variants, seed, every)
    ]
    if moving:
        write_atomically(out, to_gif(frames, FRAMES_PER_SECOND / every))
    else:
        write_video(out, iter(frames))
    return out


def write_video(path: Path, frames: Iterator[np.ndarray], encoding: Sequence[str] = ()) -> None:
    """Write ``[height, width, 3]`` uint8 frames as .mp4, with further parameters of ffmpeg."""
    with staged(path) as file:
        first, count = next(frames), 0
        how: dict[str, Any] = {"quality": None, "macro_block_size": 1, "fps": FRAMES_PER_SECOND}
        how["output_params"] = [*encoding, "-f", "mp4"]
        with contextlib.closing(write_frames(file, first.shape[1::-1], **how)) as writer:
            writer.send(None)
            for frame in itertools.chain([first], frames):
                writer.send(np.ascontiguousarray(frame))
                count += 1
        # An ffmpeg that fails says nothing.
        with contextlib.suppress(RuntimeError):
            if count_frames_and_secs(file)[0] == count:
                return
        raise OSError(errno.EIO, "ffmpeg failed")


def _captions(runs: Sequence[Restored]) -> list[str]:
    """Names of the agents, with the seed where an agent occurs twice."""
    agents = [run.config.agent.rpartition(":")[2] for run in runs]
    return [
        agent if agents.count(agent) == 1 else f"{agent}, seed {run.config.seed}"
        for agent, run in zip(agents, runs, strict=True)
    ]


def _episode(
    runs: Sequence[Restored],
    captions: Sequence[str],
    variants: Sequence[VariantSpec],
    seed: int,
    every: int,
) -> list[np.ndarray]:
    """Frames of one episode, those of several runs side by side."""
    played = [filmed(run.config, run.policy, run.agent, variants, seed, every) for run in runs]
    if len(runs) == 1:
        return played[0].frames
    length = max(len(one.frames) for one in played) + PAUSE // every
    return [
        _in_rows([_panel(one, text, t) for one, text in zip(played, captions, strict=True)])
        for t in range(length)
    ]


def _panel(played: Filmed, caption: str, step: int) -> np.ndarray:
    """A frame below its caption; the last frame stays."""
    last = len(played.frames) - 1
    text, color, ground = caption, "black", "white"
    if step >= last:
        seconds = played.steps / FRAMES_PER_SECOND
        text += f": solved in {seconds:.1f} s" if played.solved else ": not solved"
        color, ground = "white", SUCCESS if played.solved else FAILURE
    return captioned(played.frames[min(step, last)], text, color, ground)


def _in_rows(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one size side by side, in as many rows as they need; the rest is white."""
    columns = min(len(pictures), COLUMNS)
    blank = np.full_like(pictures[0], 255)
    filled = [*pictures, *[blank] * (-len(pictures) % columns)]
    rows = [filled[i : i + columns] for i in range(0, len(filled), columns)]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _paths(run: Restored, variants: Sequence[VariantSpec], episodes: int) -> np.ndarray:
    config = run.config
    feasible = feasible_return(config, run.agent, run.policy)
    evaluator = Evaluator(config, run.policy, run.agent, feasible, variants)
    with contextlib.closing(evaluator):
        played = evaluator.play(episodes)
    title = f"{config.agent} on {config.task} ({variant_text(variants)}), seed {config.seed}"
    return draw_paths(played, run.policy.obs_layout, title)
