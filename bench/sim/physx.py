"""N CPU physics scenes behind the interface of SAPIEN's ``PhysxGpuSystem``.

ManiSkill's GPU branch is batched torch code that reads and writes a few large buffers and asks
the physics system to *fetch* them from, or *apply* them to, the simulation. `BatchedPhysx`
offers the same buffers and calls over N ``PhysxCpuSystem`` scenes: torch tensors on the CPU that
share memory with numpy arrays. Two rules differ from the GPU, both invisible to task code:

- *Apply writes only what changed* since the last fetch. A partial reset therefore leaves the
  other scenes untouched to the last bit: writing a fetched value back could move a body, wake
  it or reset its solver state.
- *Fetch reads only what may have changed* (scenes stepped or written since) and only links that
  somebody has asked for by their index.

Rows: rigid bodies first (dynamic and kinematic, scene by scene), then articulation links.
Columns of the body buffer: position (3), quaternion wxyz (4), linear velocity (3), angular
velocity (3), in metres, radians and seconds, in the world frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx
import torch

from bench.sim.contacts import BodyImpulseQuery, ContactReader, PairImpulseQuery

_POSE = slice(0, 7)
_VELOCITY = slice(7, 13)


class Buffer:
    """A float32 array that numpy and torch share, with the ``.torch()`` of SAPIEN's CudaArray."""

    def __init__(self, *shape: int) -> None:
        self.array = np.zeros(shape, dtype=np.float32)
        self._tensor = torch.from_numpy(self.array)

    @property
    def shape(self) -> tuple[int, ...]:
        return self.array.shape

    def torch(self) -> torch.Tensor:
        return self._tensor


class BatchedPhysx:
    """N ``PhysxCpuSystem`` scenes with the surface of one ``PhysxGpuSystem``.

    Args:
        scenes: one SAPIEN scene per environment, each with its own ``PhysxCpuSystem``.
    """

    # ManiSkill chooses its batched branch by isinstance(system, PhysxGpuSystem). A real subclass
    # would need CUDA to be constructed, so this object only says that it is one.
    __class__ = property(lambda self: physx.PhysxGpuSystem)  # type: ignore[assignment]

    def __init__(self, scenes: Sequence[sapien.Scene]) -> None:
        self.scenes = list(scenes)
        self.systems: list[physx.PhysxCpuSystem] = [s.physx_system for s in self.scenes]
        self._step_calls = [system.step for system in self.systems]
        self._initialized = False

    # ------------------------------------------------------------------ plain system surface
    @property
    def timestep(self) -> float:
        return self.systems[0].timestep

    @timestep.setter
    def timestep(self, value: float) -> None:
        for system in self.systems:
            system.timestep = value

    def get_timestep(self) -> float:
        return self.timestep

    def set_timestep(self, value: float) -> None:
        self.timestep = value

    @property
    def config(self) -> physx.PhysxSceneConfig:
        return self.systems[0].config

    @property
    def rigid_dynamic_components(self) -> list[physx.PhysxRigidDynamicComponent]:
        return [c for system in self.systems for c in system.rigid_dynamic_components]

    @property
    def rigid_static_components(self) -> list[physx.PhysxRigidStaticComponent]:
        return [c for system in self.systems for c in system.rigid_static_components]

    @property
    def articulation_link_components(self) -> list[physx.PhysxArticulationLinkComponent]:
        return [c for system in self.systems for c in system.articulation_link_components]

    def get_contacts(self) -> list[physx.PhysxContact]:
        return [contact for system in self.systems for contact in system.get_contacts()]

    def get_scene_offset(self, scene: sapien.Scene) -> np.ndarray:
        """Scenes do not share a space here, so none is moved aside: always zero."""
        return np.zeros(3, dtype=np.float32)

    # ------------------------------------------------------------------ setup
    def gpu_init(self) -> None:
        """Index every body and articulation, allocate the buffers and fill them."""
        self._bodies: list[Any] = []
        self._body_scene: list[int] = []
        for i, system in enumerate(self.systems):
            for body in system.rigid_dynamic_components:
                self._bodies.append(body)
                self._body_scene.append(i)
        self._n_rigid = len(self._bodies)
        self._articulations: list[physx.PhysxArticulation] = []
        self._articulation_scene: list[int] = []
        for i, system in enumerate(self.systems):
            for link in system.articulation_link_components:
                self._bodies.append(link)
                self._body_scene.append(i)
                if link.is_root:
                    self._articulations.append(link.articulation)
                    self._articulation_scene.append(i)
        self._body_row = {body: row for row, body in enumerate(self._bodies)}
        self._articulation_row = {a: row for row, a in enumerate(self._articulations)}
        self._dof = [a.dof for a in self._articulations]
        self._joints = [a.active_joints for a in self._articulations]
        self._root_row = np.array(
            [self._body_row[a.root] for a in self._articulations], dtype=np.int64
        )
        self._fixed_root = [a.root.joint.type == "fixed" for a in self._articulations]
        n, m, d = len(self._bodies), len(self._articulations), max(self._dof, default=0)
        n_links = max((len(a.links) for a in self._articulations), default=0)
        self.cuda_rigid_body_data = Buffer(n, 13)
        self.cuda_rigid_body_force = Buffer(n, 4)
        self.cuda_rigid_body_torque = Buffer(n, 4)
        self.cuda_articulation_qpos = Buffer(m, d)
        self.cuda_articulation_qvel = Buffer(m, d)
        self.cuda_articulation_qf = Buffer(m, d)
        self.cuda_articulation_qacc = Buffer(m, d)
        self.cuda_articulation_target_qpos = Buffer(m, d)
        self.cuda_articulation_target_qvel = Buffer(m, d)
        self.cuda_articulation_link_incoming_joint_forces = Buffer(m, n_links, 6)
        # What the simulation is known to hold, to tell which rows a task has written.
        self._known_body = np.zeros((n, 13), dtype=np.float32)
        self._known = {
            name: np.zeros((m, d), dtype=np.float32)
            for name in ("qpos", "qvel", "qf", "target_qpos", "target_qvel")
        }
        self._contacts = ContactReader(self.systems)
        self._initialized = True
        self.gpu_fetch_rigid_dynamic_data()
        self.gpu_fetch_articulation_link_pose()
        self.gpu_fetch_articulation_link_velocity()
        for name in ("qpos", "qvel", "qacc", "target_qpos", "target_qvel"):
            getattr(self, f"gpu_fetch_articulation_{name}")()

    def body_index(self, body: Any) -> int:
        """Row of a rigid body or link in the body buffer."""
        return self._body_row[body]

    def articulation_index(self, articulation: physx.PhysxArticulation) -> int:
        """Row of an articulation in the joint buffers."""
        return self._articulation_row[articulation]

    # ------------------------------------------------------------------ simulation
    def step(self) -> None:
        """One substep of every scene."""
        for step in self._step_calls:
            step()
        self._contacts.invalidate()

    # ------------------------------------------------------------------ fetch
    def _fetch_bodies(self, rows: Any, columns: slice) -> None:
        data = self.cuda_rigid_body_data.array
        for row in rows:
            body = self._bodies[row]
            if columns is _POSE:
                data[row, _POSE] = body.entity.pose.__getstate__()
            elif not (row < self._n_rigid and body.kinematic):
                data[row, 7:10] = body.linear_velocity
                data[row, 10:13] = body.angular_velocity
        self._known_body[rows, columns] = data[rows, columns]

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        self._fetch_bodies(range(self._n_rigid), _POSE)
        self._fetch_bodies(range(self._n_rigid), _VELOCITY)

    def gpu_fetch_articulation_link_pose(self) -> None:
        self._fetch_bodies(range(self._n_rigid, len(self._bodies)), _POSE)

    def gpu_fetch_articulation_link_velocity(self) -> None:
        self._fetch_bodies(range(self._n_rigid, len(self._bodies)), _VELOCITY)

    def _fetch_joints(self, name: str) -> None:
        data = getattr(self, f"cuda_articulation_{name}").array
        for row, articulation in enumerate(self._articulations):
            data[row, : self._dof[row]] = getattr(articulation, name)
        if name in self._known:
            self._known[name][:] = data

    def gpu_fetch_articulation_qpos(self) -> None:
        self._fetch_joints("qpos")

    def gpu_fetch_articulation_qvel(self) -> None:
        self._fetch_joints("qvel")

    def gpu_fetch_articulation_qacc(self) -> None:
        self._fetch_joints("qacc")

    def _fetch_targets(self, name: str, attribute: str) -> None:
        data = getattr(self, f"cuda_articulation_{name}").array
        for row, joints in enumerate(self._joints):
            for column, joint in enumerate(joints):
                data[row, column] = getattr(joint, attribute)[0]
        self._known[name][:] = data

    def gpu_fetch_articulation_target_qpos(self) -> None:
        self._fetch_targets("target_qpos", "drive_target")

    def gpu_fetch_articulation_target_qvel(self) -> None:
        self._fetch_targets("target_qvel", "drive_velocity_target")

    # ------------------------------------------------------------------ apply
    def _changed_rows(self, data: np.ndarray, known: np.ndarray) -> np.ndarray:
        return np.flatnonzero((data != known).any(axis=1))

    def gpu_apply_rigid_dynamic_data(self) -> None:
        n = self._n_rigid
        data, known = self.cuda_rigid_body_data.array[:n], self._known_body[:n]
        for row in self._changed_rows(data[:, _POSE], known[:, _POSE]):
            self._bodies[row].entity.pose = sapien.Pose(data[row, :3], data[row, 3:7])
        for row in self._changed_rows(data[:, _VELOCITY], known[:, _VELOCITY]):
            body = self._bodies[row]
            if not body.kinematic:
                body.linear_velocity = data[row, 7:10]
                body.angular_velocity = data[row, 10:13]
        known[:] = data

    def gpu_apply_articulation_root_pose(self) -> None:
        rows = self._root_row
        data, known = self.cuda_rigid_body_data.array, self._known_body
        for i in self._changed_rows(data[rows, _POSE], known[rows, _POSE]):
            row = rows[i]
            self._articulations[i].root_pose = sapien.Pose(data[row, :3], data[row, 3:7])
        known[rows, _POSE] = data[rows, _POSE]

    def gpu_apply_articulation_root_velocity(self) -> None:
        rows = self._root_row
        data, known = self.cuda_rigid_body_data.array, self._known_body
        for i in self._changed_rows(data[rows, _VELOCITY], known[rows, _VELOCITY]):
            if not self._fixed_root[i]:
                row = rows[i]
                self._articulations[i].set_root_linear_velocity(data[row, 7:10])
                self._articulations[i].set_root_angular_velocity(data[row, 10:13])
        known[rows, _VELOCITY] = data[rows, _VELOCITY]

    def _apply_joints(self, name: str) -> None:
        data = getattr(self, f"cuda_articulation_{name}").array
        known = self._known[name]
        for row in self._changed_rows(data, known):
            setattr(self._articulations[row], name, data[row, : self._dof[row]])
        known[:] = data

    def gpu_apply_articulation_qpos(self) -> None:
        self._apply_joints("qpos")

    def gpu_apply_articulation_qvel(self) -> None:
        self._apply_joints("qvel")

    def gpu_apply_articulation_qf(self) -> None:
        self._apply_joints("qf")

    def gpu_apply_articulation_target_position(self) -> None:
        data, known = self.cuda_articulation_target_qpos.array, self._known["target_qpos"]
        for row in self._changed_rows(data, known):
            for joint, target in zip(self._joints[row], data[row].tolist()):
                joint.set_drive_target(target)
        known[:] = data

    def gpu_apply_articulation_target_velocity(self) -> None:
        data, known = self.cuda_articulation_target_qvel.array, self._known["target_qvel"]
        for row in self._changed_rows(data, known):
            for joint, target in zip(self._joints[row], data[row].tolist()):
                joint.set_drive_velocity_target(target)
        known[:] = data

    def gpu_update_articulation_kinematics(self) -> None:
        """Nothing to do: the CPU system updates link poses when joints are set."""

    def sync_poses_gpu_to_cpu(self) -> None:
        """Nothing to do: entities live on the CPU."""

    # ------------------------------------------------------------------ contacts
    def gpu_create_contact_pair_impulse_query(self, body_pairs: Sequence) -> PairImpulseQuery:
        return PairImpulseQuery(body_pairs)

    def gpu_query_contact_pair_impulses(self, query: PairImpulseQuery) -> None:
        self._contacts.read_pairs(query)

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence) -> BodyImpulseQuery:
        return BodyImpulseQuery(bodies)

    def gpu_query_contact_body_impulses(self, query: BodyImpulseQuery) -> None:
        self._contacts.read_bodies(query)
