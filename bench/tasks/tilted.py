"""Tasks on a tilted table: symmetric about the table's normal, and about no fixed vertical.

The bodies are those of the flat task: the same initial states, contacts and expert, and a gravity
that tilts with the table. What differs is the frame in which the world is told to the policy and
told by it. In each episode a rotation R takes the flat task's frame to the laboratory's. Vectors of
the observation are turned by R, those of the action by its inverse. A policy that commutes with
every rotation of space needs one table to know all of them; one that commutes with rotations about
the laboratory's vertical has to learn how the table leans.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from mani_skill.utils import common

from symsteer.bench.sim.rotations import (
    quaternion_multiply,
    quaternion_to_matrix,
    transform_quaternion,
    yaw_quaternion,
)
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.features import GRASP_YAW, in_parts, vector_fields
from symsteer.bench.tasks.move_cube import PushCube
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.bench.variants.base import STREAM
from symsteer.bench.variants.noise import uniform
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout
from symsteer.policies.normalizer import clip_blocks

LARGEST_TILT = math.radians(30)


def in_space(fields: Sequence[Field]) -> tuple[Field, ...]:
    """A flat task's fields for a tilted table.

    Horizontal vectors get a vertical part. Frequencies above 1 are left out: they are angles about
    the vertical, which has no meaning here.

    Raises:
        UserError: if a vector is not named ``NAME_xy``, as vectors in space are.
    """
    names = {field.name for field in fields}
    kept = []
    for field in fields:
        if field.frequency < 2:
            kept.append(field)
        if field.frequency == 1 and not field.name.endswith("_xy"):
            raise UserError(
                f"the vector {field.name!r} has no place in space; name it {field.name}_xy, or "
                "leave it out of a tilted task"
            )
        vertical = field.name.removesuffix("xy") + "z"
        if field.frequency == 1 and vertical not in names:
            kept.append(Field(vertical, 0, odd=field.odd))
    return tuple(kept)


class Tilted(SymmetricTask):
    """Mixin; list it before the class of a flat task.

    In each episode the table's normal is uniform on the spherical cap of 30 degrees about the
    laboratory's vertical; R is the smallest rotation that brings the vertical there. It is a
    function of the episode's key alone, so that it changes nothing else, and it is part of the
    state: ``frame``, unit quaternions ``[N, 4]``. Variants act in the table's frame.
    """

    gripper_fields: ClassVar[tuple[Field, ...]] = (
        *vector_fields("normal", "tcp", "tcp_x_axis"),
        Field("tcp_y_axis_xy", 1, odd=True),
        Field("tcp_y_axis_z", 0, odd=True),
        *vector_fields("tcp_z_axis"),
        Field("gripper_width", 0),
    )

    frame: torch.Tensor
    """R of each environment as a unit quaternion, ``[N, 4]``."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.frame = torch.tensor([1.0, 0.0, 0.0, 0.0], device=self.device).repeat(self.num_envs, 1)

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        key = self.episode_key[env_idx]
        # Control steps and strengths of variants have other streams.
        height, bearing = uniform(key, 2 * STREAM), 2 * math.pi * uniform(key, 2 * STREAM + 1)
        half = torch.acos(1 - height * (1 - math.cos(LARGEST_TILT))) / 2
        about = [torch.cos(bearing), torch.sin(bearing), torch.zeros_like(bearing)]
        quaternion = [torch.cos(half), *(torch.sin(half) * component for component in about)]
        self.frame[env_idx] = torch.stack(quaternion, dim=1).to(self.frame)

    # ------------------------------------------------------------- observation

    def _observe_gripper(
        self, position: torch.Tensor, axes: torch.Tensor, width: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        normal = torch.tensor([0.0, 0.0, 1.0], device=self.device).expand_as(position)
        turned = {f"tcp_{name}_axis": axes[:, :, i] for i, name in enumerate("xyz")}
        return {**in_parts(normal=normal, tcp=position, **turned), "gripper_width": width}

    def _observe_task(self) -> dict[str, torch.Tensor]:
        flat = {field.name for field in super().task_fields}
        # What lies along the table in the flat task has no height.
        level = torch.zeros(self.num_envs, 1, device=self.device)
        return {
            name: level if name.endswith("_z") and name not in flat else value
            for name, value in super()._observe_task().items()
        }

    def _reported(self, fields: dict[str, torch.Tensor], layout: Layout) -> dict[str, torch.Tensor]:
        seen = torch.cat(list(super()._reported(fields, layout).values()), dim=1)
        turned = layout.turn(seen, quaternion_to_matrix(self.frame))
        return {name: turned[:, layout.slice(name)] for name in fields}

    # ------------------------------------------------------------------- action

    def commanded(self, action: torch.Tensor) -> torch.Tensor:
        """An action ``[N, 7]`` in the table's frame as :meth:`step` takes it.

        Its vectors in space are shortened to norm 1, so that policies of any kind can express it.
        """
        bounded = clip_blocks(action, self.action_layout.spatial, 1.0)
        return self.action_layout.turn(bounded, quaternion_to_matrix(self.frame))

    def _step_action(self, action: Any) -> Any:
        vectors = self.agent.control_mode == self.body.control_mode
        if vectors and isinstance(action, torch.Tensor):
            action = action.reshape(self.num_envs, -1)
            back = quaternion_to_matrix(self.frame).transpose(1, 2)
            action = self.action_layout.turn(action, back)
        return super()._step_action(action)

    # -------------------------------------------------------------------- state

    def get_state_dict(self) -> dict:
        """As ManiSkill's, with ``frame``."""
        return {**super().get_state_dict(), "frame": self.frame.clone()}

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """As for every task; the state's ``frame`` comes with it.

        Raises:
            UserError: if the state has none.
        """
        if "frame" not in state:
            raise UserError(
                f"a state of {self.task_id} has the table's rotation under 'frame'; take states "
                "from its own get_state_dict, not from flat tasks or get_state"
            )
        super().set_state_dict(state, env_idx)
        rows = slice(None) if env_idx is None else env_idx
        self.frame[rows] = common.to_tensor(state["frame"], device=self.device).to(self.frame)

    def transform_state(self, state: dict, angle: float, reflect: bool = False) -> dict:
        """Turn a whole simulation state about the laboratory's vertical.

        The bodies turn about the table's normal, and the table leans to the turned direction:
        the frame becomes g R g^-1, the smallest rotation to the turned normal.
        """
        leaning = transform_quaternion(state["frame"], angle, reflect)
        heading = yaw_quaternion(leaning.new_tensor(-angle)).expand_as(leaning)
        return {
            **super().transform_state(state, angle, reflect),
            "frame": quaternion_multiply(leaning, heading),
        }


class TiltedPickCube(Tilted, PickCube):
    """Pick up a cube and hold it at a goal in the air, above a table tilted by up to 30 degrees."""

    task_id = "TiltedPickCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = in_space(PickCube.task_fields)


class TiltedPushCube(Tilted, PushCube):
    """Push a cube into a disc on a table tilted by up to 30 degrees."""

    task_id = "TiltedPushCube-v1"
    # In place of the cube's yaw.
    task_fields: ClassVar[tuple[Field, ...]] = (*in_space(PushCube.task_fields), *GRASP_YAW)
