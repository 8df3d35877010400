"""Tasks that depth cameras see: the observation has points on surfaces in place of poses.

Four cameras look at the workspace from the corners of a square, so that what they see turns with
the scene, exactly under quarter turns up to their pixels. Their depth pictures become one cloud of
points in the workspace's frame. The table and the robot are cut off (a lab knows both), and the
rest is thinned out to a fixed number of points.

A cloud is two fields of the layout, ``cloud_xy`` and ``cloud_z``, each with one block per point: it
is rotated like every other observation, without interpolation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.sapien_utils import look_at
from mani_skill.utils.structs import Link, Pose
from sapien.physx import PhysxCollisionShapeConvexMesh
from sapien.render import RenderBodyComponent, RenderMaterial, RenderShapeTriangleMesh

from symsteer.bench.sim.patches import is_batched
from symsteer.bench.sim.rotations import quaternion_multiply, quaternion_to_matrix
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.move_cube import PushCube
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.policies.geometry import Field

POINTS = 64
"""Points of a cloud."""

CAMERAS = 4

PIXELS = 64
"""Height and width of a picture; a pixel is 1 cm wide in the workspace's centre."""

FIELD_OF_VIEW = 0.8
"""Radians."""

DISTANCE = 0.55
"""Of the cameras from the centre's vertical, and their height, metres."""

REACH = 0.4
"""Points farther from the centre's vertical are cut off, metres."""

TABLE = 0.002
"""Points below are the table's, metres; the pictures' depth is in millimetres."""


def cloud_fields(kept: Sequence[Field]) -> tuple[Field, ...]:
    """Fields of a task that is seen: what no camera shows, and the cloud."""
    return *kept, Field("cloud_xy", 1, POINTS), Field("cloud_z", 0, POINTS)


class Seen(SymmetricTask):
    """Mixin; list it before the class of a task whose bodies are seen.

    Of the task's fields only those that are in ``task_fields`` are told, such as the goal. Variants
    of perception move the cloud as they move the pose of the manipulated body.

    Rendering needs a Vulkan driver; a software one is enough.
    """

    needs_cameras: ClassVar[bool] = True
    _last_cloud: torch.Tensor | None = None
    _for_cameras: dict[RenderBodyComponent, bool]
    """Of parts that only the cameras or only films draw: whether the cameras do."""

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        cameras = []
        for k in range(CAMERAS):
            bearing = 2 * math.pi * (k + 0.5) / CAMERAS
            eye = [DISTANCE * math.cos(bearing), DISTANCE * math.sin(bearing), DISTANCE]
            cameras.append(
                CameraConfig(
                    uid=f"corner_{k}",
                    pose=look_at(eye, [0.0, 0.0, 0.0]),
                    width=PIXELS,
                    height=PIXELS,
                    fov=FIELD_OF_VIEW,
                    near=0.01,
                    far=5.0,
                )
            )
        return cameras

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        # No cloud has points of table, ground and robot, and drawing them would take most of the
        # time. The robot hides what is behind it, so its hulls are drawn: they have few triangles.
        self._for_cameras = {}
        if not is_batched(self.scene):
            # On a GPU ManiSkill moves one drawn part of each body, and cannot hide it later.
            return
        for furniture in (self.table_scene.table, self.table_scene.ground):
            for entity in furniture._objs:
                self._for_cameras[entity.find_component_by_type(RenderBodyComponent)] = False
        for link in self.agent.robot.links:
            for body in link._objs:
                mesh = body.entity.find_component_by_type(RenderBodyComponent)
                shapes = body.collision_shapes
                # Fingers collide as boxes, which would hide more.
                convex = {isinstance(shape, PhysxCollisionShapeConvexMesh) for shape in shapes}
                if mesh and convex == {True}:
                    hulls = hulls_of(shapes)
                    body.entity.add_component(hulls)
                    self._for_cameras |= {mesh: False, hulls: True}
        self._draw(for_cameras=False)

    def _draw(self, for_cameras: bool) -> None:
        for component, of_cameras in self._for_cameras.items():
            component.visibility = float(of_cameras == for_cameras)

    def _observe_task(self) -> dict[str, torch.Tensor]:
        true = self.manipulated.pose
        cloud = moved(self._seen_cloud(), true, self.seen(true, "object"))
        points = {"cloud_xy": cloud[:, :, :2].flatten(1), "cloud_z": cloud[:, :, 2]}
        return {**super()._observe_task(), **points}

    def _seen_cloud(self) -> torch.Tensor:
        """The present cloud; if nobody looks, the last one, but for episodes at their time limit.

        From their last observation the critic bootstraps. Row by row, so that environments do not
        depend on their neighbours.
        """
        last = self._last_cloud
        due = self.elapsed_steps >= self.max_episode_steps
        if self.looks or last is None or due.any():
            now = self.cloud()
            self._last_cloud = (
                now if self.looks or last is None else torch.where(due[:, None, None], now, last)
            )
        assert self._last_cloud is not None
        return self._last_cloud

    def cloud(self) -> torch.Tensor:
        """What the cameras see now, ``[N, POINTS, 3]`` metres in the world's frame."""
        points, label = self.look()
        robot = [i for i, body in self.segmentation_id_map.items() if isinstance(body, Link)]
        valid = (points[:, :, 2] > TABLE) & (points[:, :, :2].norm(dim=2) < REACH)
        valid &= ~torch.isin(label, torch.tensor([0, *robot], device=self.device))
        return thinned(points, valid, POINTS)

    def look(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Take the pictures.

        Returns:
            The points of all pixels, ``[N, CAMERAS * PIXELS * PIXELS, 3]`` metres in the world's
            frame, and ManiSkill's segmentation ids of what they belong to.
        """
        # Marks such as a goal in the air would hide what is behind them.
        marks = [body for body in self._hidden_objects if not body.hidden]
        for body in marks:
            body.hide_visual()
        self._draw(for_cameras=True)
        self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        self.capture_sensor_data()
        self._draw(for_cameras=False)
        for body in marks:
            body.show_visual()
        points, labels = [], []
        for sensor in self._sensors.values():
            picture = sensor.get_obs(rgb=False, depth=False, position=True, segmentation=True)
            local = picture["position"].flatten(1, 2).to(self.device, torch.float32) / 1000
            to_world = sensor.get_params()["cam2world_gl"].to(local)
            points.append(local @ to_world[:, :3, :3].transpose(1, 2) + to_world[:, None, :3, 3])
            labels.append(picture["segmentation"].flatten(1).to(self.device))
        return torch.cat(points, dim=1), torch.cat(labels, dim=1)


def hulls_of(shapes: Sequence[PhysxCollisionShapeConvexMesh]) -> RenderBodyComponent:
    """What is drawn where convex collision shapes are."""
    component = RenderBodyComponent()
    for shape in shapes:
        vertices = shape.scale * shape.vertices
        surface = RenderShapeTriangleMesh(
            vertices,
            shape.triangles,
            np.zeros_like(vertices),
            np.zeros_like(vertices[:, :2]),
            RenderMaterial(),
        )
        surface.local_pose = shape.local_pose
        component.attach(surface)
    return component


def moved(points: torch.Tensor, true: Pose, seen: Pose) -> torch.Tensor:
    """Points ``[N, M, 3]``, moved as a body is from its true pose to where it is seen."""
    back = true.q * true.q.new_tensor([1.0, -1.0, -1.0, -1.0])
    matrix = quaternion_to_matrix(quaternion_multiply(seen.q, back))
    arms = points - true.p[:, None]
    # Sums of columns: a matrix product may round differently for another N.
    turned = (matrix[:, None] * arms[:, :, None]).sum(3) - arms
    # Where nothing turns, points stay to the bit.
    turns = (seen.q != true.q).any(dim=1)[:, None, None]
    return points + (seen.p - true.p)[:, None] + torch.where(turns, turned, 0.0)


def thinned(points: torch.Tensor, valid: torch.Tensor, count: int) -> torch.Tensor:
    """Some of the valid points, far from each other (farthest point sampling).

    The first one is the farthest from the origin's vertical, so that the choice turns with the
    points. Where there are fewer than ``count``, some occur several times; where there are none,
    all are the origin.

    Args:
        points: ``[N, M, 3]``.
        valid: ``[N, M]`` bool.
        count: how many.

    Returns:
        ``[N, count, 3]``.
    """
    # Most pixels show the table.
    most = max(1, int(valid.sum(dim=1).max()))
    kept = valid.int().argsort(dim=1, descending=True, stable=True)[:, :most]
    valid = valid.gather(1, kept)
    points = points.gather(1, kept[:, :, None].expand(-1, -1, 3)) * valid[:, :, None]
    rows = torch.arange(len(points), device=points.device)
    # Invalid points are never the farthest, unless there is no other.
    distance = torch.where(valid, points[:, :, :2].norm(dim=2), -1.0)
    nearest = torch.where(valid, torch.inf, -1.0)
    chosen = []
    for _ in range(count):
        last = points[rows, distance.argmax(dim=1)]
        chosen.append(last)
        nearest = torch.minimum(nearest, (points - last[:, None]).norm(dim=2))
        distance = nearest
    return torch.stack(chosen, dim=1)


def _named(fields: Sequence[Field], *names: str) -> list[Field]:
    return [field for field in fields if field.name in names]


class SeenPushCube(Seen, PushCube):
    """Push a cube that four depth cameras see into a disc on the table, in any direction."""

    task_id = "SeenPushCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = cloud_fields(
        _named(PushCube.task_fields, "goal_xy", "tcp_to_goal_xy")
    )


class SeenPickCube(Seen, PickCube):
    """Pick up a cube that four depth cameras see, and hold it at a goal in the air."""

    task_id = "SeenPickCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = cloud_fields(
        _named(PickCube.task_fields, "goal_xy", "goal_z")
    )
