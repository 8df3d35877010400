"""ManiSkill tasks with their geometry, and what their robots are.

- `TASKS`, `EMBODIMENTS`: what there is, by name.
- `make(task, num_envs=...)`: N parallel environments of a task.
- `gym.make("SymSteer/PickCube-v1", num_envs=...)`: the same for users of gymnasium.
- `gym.make("SymSteer/PickCube-single-v1")`: one environment on NumPy arrays.
- `task_class(task)`: layouts, limits and feasible returns without making an environment.

Importing this package registers the tasks with gymnasium. It is cheap: torch and ManiSkill are not
imported here.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from symsteer.names import unknown
from symsteer.registry import Registry

if TYPE_CHECKING:
    from symsteer.bench.tasks.base import SymmetricTask
    from symsteer.bench.tasks.making import make, make_batched, make_single

__all__ = [
    "EMBODIMENTS",
    "TASKS",
    "SymmetricTask",
    "check_embodiment",
    "gym_id",
    "make",
    "make_batched",
    "make_single",
    "task_class",
    "task_name",
]

TASKS: Registry[type[SymmetricTask]] = Registry(
    "task",
    "symsteer.tasks",
    {
        "PushCube-v1": "symsteer.bench.tasks.push_cube:PushCube",
        "PullCube-v1": "symsteer.bench.tasks.pull_cube:PullCube",
        "PickCube-v1": "symsteer.bench.tasks.pick_cube:PickCube",
        "StackCube-v1": "symsteer.bench.tasks.stack_cube:StackCube",
        "PlaceSphere-v1": "symsteer.bench.tasks.place_sphere:PlaceSphere",
        "LiftPegUpright-v1": "symsteer.bench.tasks.lift_peg_upright:LiftPegUpright",
        "PokeCube-v1": "symsteer.bench.tasks.poke_cube:PokeCube",
        "PushT-v1": "symsteer.bench.tasks.push_t:PushT",
        "TiltedPushCube-v1": "symsteer.bench.tasks.tilted:TiltedPushCube",
        "TiltedPickCube-v1": "symsteer.bench.tasks.tilted:TiltedPickCube",
        "SeenPushCube-v1": "symsteer.bench.tasks.clouds:SeenPushCube",
        "SeenPickCube-v1": "symsteer.bench.tasks.clouds:SeenPickCube",
    },
    "symsteer.bench.tasks.base:SymmetricTask",
)
"""All tasks by name, easiest first."""

EMBODIMENTS = {
    "floating": "The armless gripper: actions and states turn with the world.",
    "panda": "ManiSkill's stock Panda arm: its kinematics break the symmetry.",
}
"""All embodiments by name, each in one line; their classes are in the module ``embodiments``."""

NAMESPACE = "SymSteer/"
"""Before a task's name in ids of gymnasium."""

_HOME = {
    "SymmetricTask": "base",
    "make": "making",
    "make_batched": "making",
    "make_single": "making",
}


def check_embodiment(embodiment: str) -> None:
    """Raise `UserError` if there is no such embodiment."""
    if embodiment not in EMBODIMENTS:
        raise unknown("embodiment", embodiment, EMBODIMENTS)


def task_name(task: str) -> str:
    """The name of a task that may be given as an id of gymnasium, with or without its module."""
    return task.removeprefix(f"{__name__}:").removeprefix(NAMESPACE)


def gym_id(task: str) -> str:
    """An id that ``gym.make`` resolves without an import; of an unregistered class its target."""
    return f"{__name__}:{NAMESPACE}{task}" if task in TASKS else task


def task_class(task: str) -> type[SymmetricTask]:
    """The class of a task, which knows its layouts without a simulation.

    Args:
        task: its name, an id of gymnasium, or ``package.module:Class``.

    Raises:
        UserError: if there is no such task.
    """
    return TASKS.get(task_name(task))


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)


# At the end: it needs the names above.
importlib.import_module(f"{__name__}.registration").register()
