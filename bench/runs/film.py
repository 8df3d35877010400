"""Videos of a run's agent, and the picture of paths where nothing can be rendered."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np

from symsteer.bench.runs.evaluator import Evaluator
from symsteer.bench.runs.pictures import FRAMES_PER_SECOND, draw_paths, episode_frames
from symsteer.bench.runs.stored import Restored, restored
from symsteer.bench.runs.trainer import feasible_return
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.variants import evaluation_variants, read
from symsteer.errors import UserError
from symsteer.variant import VariantSpec, file_name, variant_text


def film(folder: Path, variant: str | None = None, episodes: int = 3) -> Path:
    """Film held-out episodes of a run's last checkpoint.

    Args:
        folder: of the run.
        variant: how the symmetry is broken; default: as in the run's evaluations.
        episodes: how many, from the first held-out seed on.

    Returns:
        The file written into the run's folder: ``film-VARIANT.mp4`` where a Vulkan driver works,
        else ``paths-VARIANT.png``, the paths of the episodes seen from above.

    Raises:
        UserError: if the folder is not a run's, it has no checkpoint, or the variant is unknown.
    """
    if episodes < 1:
        raise UserError(f"--episodes is {episodes}; it must be at least 1")
    run = restored(folder)
    own = evaluation_variants(run.config.variants)
    variants = own if variant is None else read(variant, place=run.config.place)
    name = file_name(variant_text(variants))
    if rendering_works():
        path = run.folder / f"film-{name}.mp4"
        frames: list[Any] = [
            frame
            for seed in held_out_seeds(episodes)
            for frame in episode_frames(run.config, run.policy, run.agent, variants, seed)
        ]
        imageio.mimwrite(path, frames, fps=FRAMES_PER_SECOND, macro_block_size=1)
        return path
    path = run.folder / f"paths-{name}.png"
    imageio.imwrite(path, _paths(run, variants, episodes))
    return path


def _paths(run: Restored, variants: Sequence[VariantSpec], episodes: int) -> np.ndarray:
    config = run.config
    feasible = feasible_return(config, run.agent, run.policy)
    evaluator = Evaluator(config, run.policy, run.agent, feasible, variants)
    try:
        played = evaluator.play(episodes)
    finally:
        evaluator.close()
    title = f"{config.agent} on {config.task} ({variant_text(variants)}), seed {config.seed}"
    return draw_paths(played, run.policy.obs_layout, title)
