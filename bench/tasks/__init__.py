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

from typing import TYPE_CHECKING

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from symsteer.lazy import lazily
from symsteer.names import unknown
from symsteer.registry import NAME, Registry

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
        "PushCube-v1": "symsteer.bench.tasks.move_cube:PushCube",
        "PullCube-v1": "symsteer.bench.tasks.move_cube:PullCube",
        "PickCube-v1": "symsteer.bench.tasks.pick_cube:PickCube",
        "StackCube-v1": "symsteer.bench.tasks.stack_cube:StackCube",
        "PlaceSphere-v1": "symsteer.bench.tasks.place_sphere:PlaceSphere",
        "LiftPegUpright-v1": "symsteer.bench.tasks.lift_peg_upright:LiftPegUpright",
        "PokeCube-v1": "symsteer.bench.tasks.poke_cube:PokeCube",
        "ClutterPick-v1": "symsteer.bench.tasks.clutter_pick:ClutterPick",
        "PushT-v1": "symsteer.bench.tasks.push_t:PushT",
        "TiltedPushCube-v1": "symsteer.bench.tasks.tilted:TiltedPushCube",
        "TiltedPickCube-v1": "symsteer.bench.tasks.tilted:TiltedPickCube",
        "HeightPushCube-v1": "symsteer.bench.tasks.heights:HeightPushCube",
        "HeightPickCube-v1": "symsteer.bench.tasks.heights:HeightPickCube",
        "HandPushCube-v1": "symsteer.bench.tasks.in_hand:HandPushCube",
        "HandPickCube-v1": "symsteer.bench.tasks.in_hand:HandPickCube",
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


__getattr__ = lazily(
    __name__,
    {
        "SymmetricTask": "base",
        "make": "making",
        "make_batched": "making",
        "make_single": "making",
    },
)


class TaskSpec(EnvSpec):
    """Takes the limit of episodes from the task's class, which is imported on first use."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.task = self.kwargs["task"]  # gymnasium empties ``kwargs`` in gym.make_vec

    @property
    def max_episode_steps(self) -> int | None:  # type: ignore[override]
        """Control steps of an episode."""
        return self._limit or task_class(self.task).max_episode_steps

    @max_episode_steps.setter
    def max_episode_steps(self, limit: int | None) -> None:
        self._limit = limit


def register() -> None:
    """Register four ids of every task with gymnasium, also of those of other distributions.

    ``SymSteer/PickCube-v1`` is N environments on torch tensors, as ManiSkill's;
    ``SymSteer/PickCube-single-v1`` is one environment on NumPy arrays, for software that calls
    ``gym.make`` with an id only. Rewards are sparse; ``SymSteer/PickCube-dense-v1`` and
    ``SymSteer/PickCube-single-dense-v1`` have ManiSkill's normalised dense reward instead.
    """
    for name in filter(NAME.fullmatch, TASKS):
        stem, dash, version = name.rpartition("-v")
        stem, dash, version = (stem, dash, version) if version.isdigit() else (name, "", "")
        for suffix, reward in (("", {}), ("-dense", {"reward_mode": "normalized_dense"})):
            batched = TaskSpec(
                f"{NAMESPACE}{stem}{suffix}{dash}{version}",
                entry_point=f"{__name__}:make_batched",
                # Makes gym.make_vec refuse, which would put batches of one into a batch.
                vector_entry_point=f"{__name__}:make_batched",
                # gymnasium's checker does not expect batched torch tensors.
                disable_env_checker=True,
                order_enforce=False,
                kwargs={"task": name, **reward},
                additional_wrappers=(
                    WrapperSpec("EpisodeLimit", f"{__name__}.making:EpisodeLimit", {}),
                ),
            )
            single = TaskSpec(
                f"{NAMESPACE}{stem}-single{suffix}{dash}{version}",
                entry_point=f"{__name__}:make_single",
                kwargs={"task": name, **reward},
            )
            gym.registry.update({batched.id: batched, single.id: single})


register()
