"""Videos of agents, alone or side by side, and pictures of paths where nothing can be rendered."""

from __future__ import annotations

import contextlib
import errno
import io
import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from imageio_ffmpeg import count_frames_and_secs, write_frames
from mani_skill.utils.sapien_utils import look_at
from PIL import Image, ImageDraw, ImageFont

from symsteer.bench.runs.evaluator import Evaluator
from symsteer.bench.runs.pictures import FAILURE, SUCCESS, draw_paths
from symsteer.bench.runs.stored import Restored, restored
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.tasks import make
from symsteer.bench.variants import evaluation_variants, read
from symsteer.errors import UserError
from symsteer.files import prepare_folder, staged, write_atomically
from symsteer.variant import VariantSpec, file_name, variant_text

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

CAPTION = 26
"""Height of a caption, pixels."""

COLOURS, PALETTE_FRAMES = 128, 6
"""Colours of a GIF, and the number of its frames that they are from."""

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
    """What `symsteer film` does; its help explains the options.

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
        names = " and ".join(sorted(" ".join(place) for place in places))
        raise UserError(
            f"these runs are of different tasks ({names}), which cannot be side by side; film "
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
        folder, name = first.folder, f"{kind}-{variant_text(variants)}"
        if len(runs) > 1:
            place = "-".join(first.config.place)
            folder, name = folder.parent, f"{kind}-{place}-{variant_text(variants)}"
        out = folder / f"{file_name(name)}.mp4"
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
        for frame in _episode(runs, variants, seed, every)
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


def to_gif(frames: Sequence[np.ndarray], rate: float) -> bytes:
    """An animated GIF that repeats for ever.

    Args:
        frames: ``[height, width, 3]`` uint8.
        rate: frames per second.
    """
    pictures = [Image.fromarray(frame) for frame in frames]
    # One palette, and no dithering: parts that stay the same then take no space.
    chosen = np.linspace(0, len(frames) - 1, PALETTE_FRAMES).round().astype(int)
    some = Image.fromarray(np.concatenate([frames[i] for i in chosen]))
    palette = some.quantize(COLOURS, Image.Quantize.MAXCOVERAGE)
    first, *others = (p.quantize(palette=palette, dither=Image.Dither.NONE) for p in pictures)
    file, duration = io.BytesIO(), round(1000 / rate)
    first.save(file, "GIF", save_all=True, append_images=others, duration=duration, loop=0)
    return file.getvalue()


def captioned(
    picture: np.ndarray, text: str, colour: str = "black", ground: str = "white"
) -> np.ndarray:
    """A picture ``[height, width, 3]`` below a line of text, ``[CAPTION + height, width, 3]``."""
    bar = Image.new("RGB", (picture.shape[1], CAPTION), ground)
    font = ImageFont.load_default(15)
    ImageDraw.Draw(bar).text((8, CAPTION / 2), text, fill=colour, font=font, anchor="lm")
    return np.concatenate([np.asarray(bar), picture])


def _captions(runs: Sequence[Restored]) -> list[str]:
    """Names of the agents, with the seed where an agent occurs twice."""
    agents = [run.config.agent.rpartition(":")[2] for run in runs]
    return [
        agent if agents.count(agent) == 1 else f"{agent}, seed {run.config.seed}"
        for agent, run in zip(agents, runs, strict=True)
    ]


def _episode(
    runs: Sequence[Restored], variants: Sequence[VariantSpec], seed: int, every: int
) -> list[np.ndarray]:
    """Frames of one episode, those of several runs side by side below captions."""
    films = [_filmed(run, variants, seed, every) for run in runs]
    if len(runs) == 1:
        return films[0][0]
    panels = []
    for (frames, ending, solved), caption in zip(films, _captions(runs), strict=True):
        ground = SUCCESS if solved else FAILURE
        last = captioned(frames[-1], f"{caption}: {ending}", "white", ground)
        panels.append([*(captioned(frame, caption) for frame in frames[:-1]), last])
    length = max(map(len, panels)) + PAUSE // every
    return [_in_rows([panel[min(t, len(panel) - 1)] for panel in panels]) for t in range(length)]


def _filmed(
    run: Restored, variants: Sequence[VariantSpec], seed: int, every: int
) -> tuple[list[np.ndarray], str, bool]:
    """Play an episode up to its first success or time limit, and render it.

    Returns:
        The frames, ``[height, width, 3]`` uint8, one at the start, one after every so many control
        steps and the last one; how the episode ended, in words; whether with success.
    """
    config, agent = run.config, run.agent
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
    frames = []

    def render() -> None:
        # The upper fifth shows only the horizon.
        frames.append(env.render()[0].cpu().numpy()[SIZE // 5 :, :, :3])

    # Not through the latent-noise environment: it starts a new episode before the last frame.
    with contextlib.closing(env):
        obs, _ = env.reset(seed=[seed])
        render()
        for step in itertools.count():
            if step % run.policy.execute == 0:
                seen = run.policy.see(obs.to(config.device))
                chunk = agent.decode(seen, agent.act(seen, deterministic=True)).to(env.device)
            obs, _, _, truncated, info = env.step(chunk[:, step % run.policy.execute])
            done = bool(info["success"] | truncated)
            if done or (step + 1) % every == 0:
                render()
            if done:
                break
    solved = bool(info["success"])
    ending = f"solved in {(step + 1) / FRAMES_PER_SECOND:.1f} s" if solved else "not solved"
    return frames, ending, solved


def _in_rows(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures of one size side by side, in as many rows as they need; the rest is white."""
    columns = min(len(pictures), COLUMNS)
    blank = np.full_like(pictures[0], 255)
    filled = [*pictures, *[blank] * (-len(pictures) % columns)]
    rows = [filled[i : i + columns] for i in range(0, len(filled), columns)]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _paths(run: Restored, variants: Sequence[VariantSpec], episodes: int) -> np.ndarray:
    config = run.config
    with contextlib.closing(Evaluator(run, variants)) as evaluator:
        played = evaluator.play(episodes)
    title = f"{config.agent} on {config.task} ({variant_text(variants)}), seed {config.seed}"
    return draw_paths(played, run.policy.obs_layout, title)
