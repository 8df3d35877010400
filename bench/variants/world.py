"""What a variant may use of the environments that it acts in."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from mani_skill.utils.structs import Actor

from symsteer.policies.geometry import Layout


class Body(Protocol):
    """The robot's embodiment."""

    @property
    def horizontal_step(self) -> float:
        """How far the tool goes in one control step at action 1, metres."""

    def set_bias(self, agent: Any, bias: torch.Tensor) -> None:
        """Add ``bias [N, 2]``, in full steps, to every horizontal step after its bound.

        What is written into ``bias`` later counts from then on.
        """


class World(Protocol):
    """N environments of a task; tasks are of this type without inheriting from it."""

    episode_key: torch.Tensor
    """A number for each episode that seeds noise, ``[N]`` int64."""

    @property
    def num_envs(self) -> int: ...

    @property
    def device(self) -> torch.device: ...

    @property
    def scene(self) -> Any:
        """ManiSkill's scene."""

    @property
    def sim_config(self) -> Any:
        """ManiSkill's settings of the simulation."""

    @property
    def table_scene(self) -> Any:
        """ManiSkill's table with the ground."""

    @property
    def agent(self) -> Any:
        """ManiSkill's robot."""

    @property
    def body(self) -> Body: ...

    @property
    def action_layout(self) -> Layout: ...

    @property
    def workspace_center(self) -> tuple[float, float]:
        """In the world, metres."""

    @property
    def spawn_extent(self) -> float:
        """Radius about the workspace's centre within which objects start, metres."""

    @property
    def manipulated(self) -> Actor:
        """The object that the robot has to move."""

    @property
    def moving_bodies(self) -> list[Actor]:
        """The task's dynamic bodies."""

    @property
    def elapsed_steps(self) -> torch.Tensor:
        """Control steps since the last reset, ``[N]``."""
