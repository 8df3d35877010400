"""SymSteer's tasks in gymnasium's registry, four ids each.

``SymSteer/PickCube-v1`` is N environments on torch tensors, as ManiSkill's;
``SymSteer/PickCube-single-v1`` is one environment on NumPy arrays, for software that calls
``gym.make`` with an id only. Rewards are sparse; ``SymSteer/PickCube-dense-v1`` and
``SymSteer/PickCube-single-dense-v1`` have ManiSkill's normalised dense reward instead.
"""

from __future__ import annotations

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, WrapperSpec

from symsteer.bench.tasks import NAMESPACE, TASKS, task_class
from symsteer.registry import NAME

_PACKAGE = "symsteer.bench.tasks"


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
    """Register the ids of every task, also of those of other distributions."""
    for name in filter(NAME.fullmatch, TASKS):
        stem, dash, version = name.rpartition("-v")
        stem, dash, version = (stem, dash, version) if version.isdigit() else (name, "", "")
        for suffix, reward in (("", {}), ("-dense", {"reward_mode": "normalized_dense"})):
            batched = TaskSpec(
                f"{NAMESPACE}{stem}{suffix}{dash}{version}",
                entry_point=f"{_PACKAGE}:make_batched",
                # Makes gym.make_vec refuse, which would put batches of one into a batch.
                vector_entry_point=f"{_PACKAGE}:make_batched",
                # gymnasium's checker does not expect batched torch tensors.
                disable_env_checker=True,
                order_enforce=False,
                kwargs={"task": name, **reward},
                additional_wrappers=(
                    WrapperSpec("EpisodeLimit", f"{_PACKAGE}.gym_env:EpisodeLimit", {}),
                ),
            )
            single = TaskSpec(
                f"{NAMESPACE}{stem}-single{suffix}{dash}{version}",
                entry_point=f"{_PACKAGE}:make_single",
                kwargs={"task": name, **reward},
            )
            gym.registry.update({batched.id: batched, single.id: single})
