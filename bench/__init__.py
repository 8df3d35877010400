"""Simulation, tasks, symmetry breaking, runs and the command line."""

from typing import TYPE_CHECKING

from symsteer.bench.sim.headless import silence_import_noise
from symsteer.lazy import lazily

if TYPE_CHECKING:
    from symsteer.bench.bundles.film import RENDERING
    from symsteer.bench.sim.headless import rendering_works
    from symsteer.bench.steering.latent_env import LatentNoiseEnv
    from symsteer.bench.tasks import EMBODIMENTS, TASKS, SymmetricTask, make, task_class
    from symsteer.bench.tasks.move_cube import PushCube
    from symsteer.bench.tasks.pick_cube import PickCube
    from symsteer.bench.variants import VARIANTS
    from symsteer.bench.variants.base import Variant

__all__ = [
    "EMBODIMENTS",
    "RENDERING",
    "TASKS",
    "VARIANTS",
    "LatentNoiseEnv",
    "PickCube",
    "PushCube",
    "SymmetricTask",
    "Variant",
    "make",
    "rendering_works",
    "task_class",
]

__getattr__ = lazily(
    __name__,
    {
        "EMBODIMENTS": "tasks",
        "RENDERING": "bundles.film",
        "TASKS": "tasks",
        "VARIANTS": "variants",
        "LatentNoiseEnv": "steering.latent_env",
        "PickCube": "tasks.pick_cube",
        "PushCube": "tasks.move_cube",
        "SymmetricTask": "tasks.base",
        "Variant": "variants.base",
        "make": "tasks",
        "rendering_works": "sim.headless",
        "task_class": "tasks",
    },
)

# Before anything imports SAPIEN or escnn, which warn about drivers that state-only runs lack.
silence_import_noise()
