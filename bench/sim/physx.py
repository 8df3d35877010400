"""N CPU physics scenes behind the interface of SAPIEN's ``PhysxGpuSystem``.

ManiSkill's GPU branch is batched torch code that reads and writes a few large buffers. It asks the
physics system to *fetch* them from the simulation, or to *apply* them to it. `BatchedPhysx` has the
same buffers and methods for N ``PhysxCpuSystem`` scenes: torch tensors on the CPU that share memory
with numpy arrays. It differs from the GPU in ways that task code does not notice:

- *Apply writes only what changed* since the last fetch. So a partial reset does not change a bit of
  the other scenes: writing a fetched value back could move a body, wake it or reset its solver
  state.
- *Fetch reads only scenes that may have changed*, mostly with one call per scene
  (``PhysxCpuSystem.pack``), and only those links whose row was asked for.
- *A reset deletes the contacts of its scene*, so what it reports depends on the new state only,
  not on the episode before.

Repetitions are equal to the bit, with one limit of PhysX: if several contacts begin in the same
substep, the order in which it solves them depends on the scene's history.
``env.reset(options={"reconfigure": True})`` makes scenes without history, in milliseconds per
environment.

Rows of the body buffer: rigid bodies first (dynamic and kinematic, scene by scene), then
articulation links. Columns: position (3), quaternion wxyz (4), linear velocity (3), angular
velocity (3), in metres, radians and seconds, in the world frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partialmethod
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx

from symsteer.bench.sim.contacts import BodyImpulseQuery, Buffer, ContactReader, PairImpulseQuery

_POSE = slice(0, 7)
_VELOCITY = slice(7, 13)

# Where `pack` puts a body's 13 numbers: quaternion first, then position, then velocities.
_PACKED_BODY = np.array([4, 5, 6, 0, 1, 2, 3, 7, 8, 9, 10, 11, 12])


class BatchedPhysx:
    """N ``PhysxCpuSystem`` scenes with the interface of one ``PhysxGpuSystem``.

    Args:
        scenes: one SAPIEN scene per environment, each with its own ``PhysxCpuSystem``.
    """

    # ManiSkill chooses its batched branch by isinstance(system, PhysxGpuSystem). Constructing a
    # real subclass needs CUDA, so this property makes isinstance return True.
    __class__ = property(lambda self: physx.PhysxGpuSystem)  # type: ignore[assignment]

    def __init__(self, scenes: Sequence[sapien.Scene]) -> None:
        self.scenes = list(scenes)
        self.systems: list[physx.PhysxCpuSystem] = [s.physx_system for s in self.scenes]
        self._pending_substeps = 0
        self._deferring = False
        self._initialized = False
        self._paused = np.zeros(len(self.systems), dtype=bool)
        # Per scene: forces by row of the body that they act on in every substep.
        self._held: list[dict[int, np.ndarray]] = [{} for _ in self.systems]

    # ------------------------------------------------------------------ plain system interface
    @property
    def timestep(self) -> float:
        """Duration of a substep in seconds."""
        return self.systems[0].timestep

    @timestep.setter
    def timestep(self, value: float) -> None:
        for system in self.systems:
            system.timestep = value

    def get_timestep(self) -> float:
        """Duration of a substep in seconds."""
        return self.timestep

    def set_timestep(self, value: float) -> None:
        """Set the duration of a substep in seconds."""
        self.timestep = value

    @property
    def config(self) -> physx.PhysxSceneConfig:
        """The scene configuration, the same for all scenes."""
        return self.systems[0].config

    @property
    def rigid_dynamic_components(self) -> list[physx.PhysxRigidDynamicComponent]:
        """Dynamic and kinematic bodies of all scenes."""
        return [c for system in self.systems for c in system.rigid_dynamic_components]

    @property
    def rigid_static_components(self) -> list[physx.PhysxRigidStaticComponent]:
        """Static bodies of all scenes."""
        return [c for system in self.systems for c in system.rigid_static_components]

    @property
    def articulation_link_components(self) -> list[physx.PhysxArticulationLinkComponent]:
        """Articulation links of all scenes."""
        return [c for system in self.systems for c in system.articulation_link_components]

    def get_contacts(self) -> list[physx.PhysxContact]:
        """Contacts of the last substep in all scenes."""
        self.finish_substeps()
        return [contact for system in self.systems for contact in system.get_contacts()]

    def get_scene_offset(self, scene: sapien.Scene) -> np.ndarray:
        """Always zero: each scene has a space of its own."""
        return np.zeros(3, dtype=np.float32)

    # ------------------------------------------------------------------ setup
    def gpu_init(self) -> None:
        """Index every body and articulation, allocate the buffers and fill them.

        Raises:
            RuntimeError: SAPIEN packs a scene in another order than this module expects.
        """
        self._index_scenes()
        n, m = len(self._bodies), len(self._articulations)
        d = max(self._dof, default=0)
        # State of the simulation at the last fetch: buffers that differ were written by the task.
        self._body_state = np.zeros((n, 13), dtype=np.float32)
        self._joint_state = {
            name: np.zeros((m, d), dtype=np.float32)
            for name in ("qpos", "qvel", "qf", "target_qpos", "target_qvel")
        }
        self._body_buffer = np.zeros((n, 13), dtype=np.float32)
        self._joint_buffer = {k: np.zeros_like(v) for k, v in self._joint_state.items()}
        self.cuda_rigid_body_data = Buffer(self._body_buffer)
        self.cuda_rigid_dynamic_data = Buffer(self._body_buffer[: self._n_rigid])
        self.cuda_rigid_body_force = Buffer(np.zeros((n, 4), dtype=np.float32))
        self.cuda_rigid_body_torque = Buffer(np.zeros((n, 4), dtype=np.float32))
        self.cuda_articulation_qpos = Buffer(self._joint_buffer["qpos"])
        self.cuda_articulation_qvel = Buffer(self._joint_buffer["qvel"])
        self.cuda_articulation_qf = Buffer(self._joint_buffer["qf"])
        self.cuda_articulation_target_qpos = Buffer(self._joint_buffer["target_qpos"])
        self.cuda_articulation_target_qvel = Buffer(self._joint_buffer["target_qvel"])
        self.cuda_articulation_qacc = Buffer(
            np.zeros((m, d), dtype=np.float32), fill=self._read_qacc
        )
        links = max((len(a.links) for a in self._articulations), default=0)
        self.cuda_articulation_link_data = Buffer(
            np.zeros((m, links, 13), dtype=np.float32), fill=self._read_link_data
        )
        self.cuda_articulation_link_incoming_joint_forces = Buffer(
            np.zeros((m, links, 6), dtype=np.float32)
        )
        self._contacts = ContactReader(self.systems)
        self._stale = np.ones(len(self.systems), dtype=bool)
        self._qacc_stale = True
        # Articulations whose drives a controller sets. Their targets are written at each control
        # step, as in stock ManiSkill; this also prevents PhysX from putting them to sleep.
        self._driven = np.zeros(m, dtype=bool)
        self._initialized = True
        self._refresh()
        self._check_packing()
        self.fetch_all()

    def _index_scenes(self) -> None:
        """Assign rows to bodies and articulations, and find their places in packed scenes."""
        rigid: list[Any] = []
        links: list[Any] = []
        rigid_scene: list[int] = []
        link_scene: list[int] = []
        self._articulations: list[physx.PhysxArticulation] = []
        self._articulation_scene: list[int] = []
        self._pack_calls = [system.pack for system in self.systems]
        self._step_calls = [system.step for system in self.systems]
        # Offsets of each scene in the concatenation of all packed scenes.
        self._pack_start = [0]
        rigid_at: list[int] = []
        articulation_at: list[int] = []
        for i, system in enumerate(self.systems):
            at = self._pack_start[-1]
            for body in system.rigid_dynamic_components:
                rigid.append(body)
                rigid_scene.append(i)
                rigid_at.append(at)
                at += 13
            for link in system.articulation_link_components:
                links.append(link)
                link_scene.append(i)
                if link.is_root:
                    self._articulations.append(link.articulation)
                    self._articulation_scene.append(i)
                    articulation_at.append(at)
                    # Root pose and velocity; per joint: position, velocity, two drive targets.
                    at += 13 + 4 * link.articulation.dof
            self._pack_start.append(at)
        self._n_rigid = len(rigid)
        self._bodies = rigid + links
        self._body_scene = np.array(rigid_scene + link_scene, dtype=np.int64)
        self._body_row = {body: row for row, body in enumerate(self._bodies)}
        self._articulation_row = {a: row for row, a in enumerate(self._articulations)}
        self._kinematic = np.array([body.kinematic for body in rigid], dtype=bool)
        self._dof = [a.dof for a in self._articulations]
        self._joints = [a.active_joints for a in self._articulations]
        self._set_target_calls = [[j.set_drive_target for j in js] for js in self._joints]
        self._set_target_velocity_calls = [
            [j.set_drive_velocity_target for j in js] for js in self._joints
        ]
        self._fixed_root = [a.root.joint.type == "fixed" for a in self._articulations]
        self._root_row = np.array([self._body_row[a.root] for a in self._articulations], int)
        self._live_links: list[list[int]] = [[] for _ in self.systems]
        self._live = set(range(self._n_rigid)) | set(self._root_row.tolist())
        # Padded joints point to the last number of the flat array, which is zero.
        total = self._pack_start[-1]
        self._packed = np.zeros(total + 1, dtype=np.float32)
        self._rigid_at = np.array(rigid_at, int).reshape(-1, 1) + _PACKED_BODY
        self._root_at = np.array(articulation_at, int).reshape(-1, 1) + _PACKED_BODY
        d = max(self._dof, default=0)
        self._joint_at = {
            name: np.full((len(self._articulations), d), total, dtype=np.int64)
            for name in ("qpos", "qvel", "target_qpos", "target_qvel")
        }
        for row, (at, dof) in enumerate(zip(articulation_at, self._dof, strict=True)):
            joints = np.arange(dof)
            self._joint_at["qpos"][row, :dof] = at + 13 + joints
            self._joint_at["qvel"][row, :dof] = at + 13 + dof + joints
            self._joint_at["target_qpos"][row, :dof] = at + 13 + 2 * dof + 2 * joints
            self._joint_at["target_qvel"][row, :dof] = at + 14 + 2 * dof + 2 * joints

    def _check_packing(self) -> None:
        """Compare unpacked values with those of SAPIEN's objects, once per set-up."""
        for row, body in enumerate(self._bodies[: self._n_rigid]):
            if tuple(self._body_state[row, :7].tolist()) != body.entity.pose.__getstate__():
                raise RuntimeError(f"SAPIEN packs the pose of {body.name} in an unknown order")
        for row, articulation in enumerate(self._articulations):
            dof, state = self._dof[row], self._joint_state
            root = self._body_state[self._root_row[row], :7]
            targets = [float(j.drive_target[0]) for j in self._joints[row]]
            if (
                tuple(root.tolist()) != articulation.root.entity.pose.__getstate__()
                or (state["qpos"][row, :dof] != articulation.qpos).any()
                or (state["qvel"][row, :dof] != articulation.qvel).any()
                or state["target_qpos"][row, :dof].tolist() != targets
            ):
                raise RuntimeError(f"SAPIEN packs {articulation.name} in an unknown order")

    def body_index(self, body: Any) -> int:
        """Row of a rigid body or link in the body buffer; from now on it is kept up to date."""
        row = self._body_row[body]
        if row not in self._live:
            self._live.add(row)
            self._live_links[self._body_scene[row]].append(row)
            self._body_state[row] = self._read_link(row)
            self._body_buffer[row] = self._body_state[row]
        return row

    def articulation_index(self, articulation: physx.PhysxArticulation) -> int:
        """Row of an articulation in the joint buffers."""
        return self._articulation_row[articulation]

    # ------------------------------------------------------------------ simulation
    def step(self) -> None:
        """One substep of every scene."""
        self._pending_substeps += 1
        if not self._deferring:
            self.finish_substeps()

    def pause(self, scenes: np.ndarray) -> None:
        """Let scenes stand still, ``[N]`` bool; the others take substeps (again)."""
        self.finish_substeps()
        self._paused = scenes.copy()

    @contextmanager
    def deferred_substeps(self) -> Iterator[None]:
        """Take the substeps of this block at its end, scene by scene.

        All substeps of a control step then find the scene's data in the processor's cache, which
        makes them a third faster. Any method that depends on the simulation takes the pending
        substeps first, so only code that uses SAPIEN's own objects between substeps would see a
        difference.
        """
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
            self.finish_substeps()

    def finish_substeps(self) -> None:
        """Take the pending substeps."""
        count, self._pending_substeps = self._pending_substeps, 0
        if count == 0:
            return
        substeps = range(count)
        nothing = np.zeros(3, dtype=np.float32)
        moving = np.flatnonzero(~self._paused)
        for i in moving.tolist():
            step, held = self._step_calls[i], self._held[i]
            pushes = [(self._bodies[row].add_force_torque, force) for row, force in held.items()]
            for _ in substeps:
                for push, force in pushes:
                    push(force, nothing)
                step()
        if self._initialized:
            self._stale[moving] = True
            self._contacts.invalidate()

    # ------------------------------------------------------------------ fetch
    def _read_link(self, row: int) -> tuple[float, ...]:
        link = self._bodies[row]
        return (
            *link.entity.pose.__getstate__(),
            *link.linear_velocity.tolist(),
            *link.angular_velocity.tolist(),
        )

    def _refresh(self) -> None:
        """Read the scenes that may have changed since they were last read."""
        self.finish_substeps()
        if not self._stale.any():
            return
        self._qacc_stale = True
        stale = np.flatnonzero(self._stale).tolist()
        packed, start = self._packed, self._pack_start
        if len(stale) == len(self.systems):
            packed[:-1] = np.frombuffer(b"".join([pack() for pack in self._pack_calls]), "f4")
        else:
            for i in stale:
                packed[start[i] : start[i + 1]] = np.frombuffer(self._pack_calls[i](), "f4")
        self._body_state[: self._n_rigid] = packed[self._rigid_at]
        self._body_state[self._root_row] = packed[self._root_at]
        for name, at in self._joint_at.items():
            self._joint_state[name][:] = packed[at]
        rows = [row for i in stale for row in self._live_links[i]]
        if rows:
            bodies = self._bodies
            self._body_state[rows, _POSE] = [bodies[r].entity.pose.__getstate__() for r in rows]
            self._body_state[rows, 7:10] = [bodies[r].linear_velocity for r in rows]
            self._body_state[rows, 10:13] = [bodies[r].angular_velocity for r in rows]
        self._stale[:] = False

    def fetch_all(self) -> None:
        """Update every buffer, except those that are filled on demand."""
        self._refresh()
        self._body_buffer[:] = self._body_state
        for name, state in self._joint_state.items():
            if name != "qf":
                self._joint_buffer[name][:] = state

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        """Fetch poses and velocities of rigid bodies."""
        self._refresh()
        self._body_buffer[: self._n_rigid] = self._body_state[: self._n_rigid]

    def gpu_fetch_articulation_link_pose(self) -> None:
        """Fetch poses of articulation links."""
        self._refresh()
        self._body_buffer[self._n_rigid :, _POSE] = self._body_state[self._n_rigid :, _POSE]

    def gpu_fetch_articulation_link_velocity(self) -> None:
        """Fetch velocities of articulation links."""
        self._refresh()
        self._body_buffer[self._n_rigid :, _VELOCITY] = self._body_state[self._n_rigid :, _VELOCITY]

    def _fetch_joints(self, name: str) -> None:
        """Fetch joint positions or velocities, or their drive targets."""
        self._refresh()
        self._joint_buffer[name][:] = self._joint_state[name]

    gpu_fetch_articulation_qpos = partialmethod(_fetch_joints, "qpos")
    gpu_fetch_articulation_qvel = partialmethod(_fetch_joints, "qvel")
    gpu_fetch_articulation_target_qpos = partialmethod(_fetch_joints, "target_qpos")
    gpu_fetch_articulation_target_qvel = partialmethod(_fetch_joints, "target_qvel")

    def gpu_fetch_articulation_qacc(self) -> None:
        """Do nothing: joint accelerations are read on demand, see `_read_qacc`."""

    def _read_qacc(self) -> None:
        self._refresh()
        if self._qacc_stale:
            for row, articulation in enumerate(self._articulations):
                self.cuda_articulation_qacc.array[row, : self._dof[row]] = articulation.qacc
            self._qacc_stale = False

    def _read_link_data(self) -> None:
        self._refresh()
        data = self.cuda_articulation_link_data.array
        for row, articulation in enumerate(self._articulations):
            for i, link in enumerate(articulation.links):
                data[row, i] = self._read_link(self._body_row[link])

    def gpu_fetch_articulation_link_incoming_joint_forces(self) -> None:
        """Fetch the spatial force that each link receives through its joint."""
        self.finish_substeps()
        data = self.cuda_articulation_link_incoming_joint_forces.array
        for row, articulation in enumerate(self._articulations):
            forces = articulation.get_link_incoming_joint_forces()
            data[row, : len(forces)] = forces

    # ------------------------------------------------------------------ apply
    def apply_all(self) -> None:
        """Write everything that a task changed in the buffers to the simulation."""
        self.gpu_apply_rigid_dynamic_data()
        self.gpu_apply_articulation_qpos()
        self.gpu_apply_articulation_qvel()
        self.gpu_apply_articulation_qf()
        self.gpu_apply_articulation_root_pose()
        self.gpu_apply_articulation_root_velocity()
        self._apply_targets("target_qpos", self._set_target_calls, refresh_driven=False)
        self._apply_targets("target_qvel", self._set_target_velocity_calls, refresh_driven=False)

    @staticmethod
    def _changed(buffer: np.ndarray, state: np.ndarray) -> list[int]:
        """Rows in which the buffer differs from the simulation."""
        return np.flatnonzero((buffer != state).any(axis=1)).tolist()

    def _touch(self, scene: int, moved: bool = False) -> None:
        self._stale[scene] = True
        if moved:
            self._contacts.forget(scene)

    def gpu_apply_rigid_dynamic_data(self) -> None:
        """Apply poses and velocities of rigid bodies."""
        self.finish_substeps()
        n = self._n_rigid
        buffer, state = self._body_buffer[:n], self._body_state[:n]
        for row in self._changed(buffer[:, _POSE], state[:, _POSE]):
            self._bodies[row].entity.pose = sapien.Pose(buffer[row, :3], buffer[row, 3:7])
            self._touch(self._body_scene[row], moved=not self._kinematic[row])
        for row in self._changed(buffer[:, _VELOCITY], state[:, _VELOCITY]):
            if not self._kinematic[row]:
                self._bodies[row].linear_velocity = buffer[row, 7:10]
                self._bodies[row].angular_velocity = buffer[row, 10:13]
            self._touch(self._body_scene[row])
        state[:] = buffer

    def gpu_apply_articulation_root_pose(self) -> None:
        """Apply root poses."""
        self.finish_substeps()
        roots, buffer = self._root_row, self._body_buffer
        for i in self._changed(buffer[roots, _POSE], self._body_state[roots, _POSE]):
            pose = buffer[roots[i]]
            self._articulations[i].root_pose = sapien.Pose(pose[:3], pose[3:7])
            self._touch(self._articulation_scene[i], moved=True)
        self._body_state[roots, _POSE] = buffer[roots, _POSE]

    def gpu_apply_articulation_root_velocity(self) -> None:
        """Apply root velocities; fixed roots are skipped."""
        self.finish_substeps()
        roots, buffer = self._root_row, self._body_buffer
        for i in self._changed(buffer[roots, _VELOCITY], self._body_state[roots, _VELOCITY]):
            if not self._fixed_root[i]:
                velocity = buffer[roots[i]]
                self._articulations[i].set_root_linear_velocity(velocity[7:10])
                self._articulations[i].set_root_angular_velocity(velocity[10:13])
            self._touch(self._articulation_scene[i])
        self._body_state[roots, _VELOCITY] = buffer[roots, _VELOCITY]

    def _apply_joints(self, name: str, moved: bool) -> None:
        """Apply joint positions, velocities, or forces, which act until others are applied."""
        self.finish_substeps()
        buffer, state = self._joint_buffer[name], self._joint_state[name]
        for row in self._changed(buffer, state):
            setattr(self._articulations[row], name, buffer[row, : self._dof[row]])
            self._touch(self._articulation_scene[row], moved)
        state[:] = buffer

    gpu_apply_articulation_qpos = partialmethod(_apply_joints, "qpos", moved=True)
    gpu_apply_articulation_qvel = partialmethod(_apply_joints, "qvel", moved=False)
    gpu_apply_articulation_qf = partialmethod(_apply_joints, "qf", moved=False)

    def _apply_targets(
        self, name: str, calls: list[list[Callable[[float], None]]], refresh_driven: bool
    ) -> None:
        self.finish_substeps()
        buffer, state = self._joint_buffer[name], self._joint_state[name]
        write = (buffer != state).any(axis=1)
        self._driven |= write
        if refresh_driven:
            write = self._driven
        values = buffer.tolist()
        for row in np.flatnonzero(write).tolist():
            for set_target, value in zip(calls[row], values[row], strict=False):
                set_target(value)
        state[:] = buffer
        # The next refresh must find the new targets.
        self._packed[self._joint_at[name]] = buffer
        self._packed[-1] = 0

    def gpu_apply_articulation_target_position(self) -> None:
        """Apply drive targets; those of controlled articulations even if unchanged."""
        self._apply_targets("target_qpos", self._set_target_calls, refresh_driven=True)

    def gpu_apply_articulation_target_velocity(self) -> None:
        """Apply drive velocity targets; those of controlled articulations even if unchanged."""
        self._apply_targets("target_qvel", self._set_target_velocity_calls, refresh_driven=True)

    def _apply_forces(self, buffer: Buffer, is_force: bool) -> None:
        """Apply forces for the next substep only, and clear the buffer."""
        self.finish_substeps()
        zero = np.zeros(3, dtype=np.float32)
        for row in np.flatnonzero(buffer.array[: self._n_rigid].any(axis=1)).tolist():
            vector = buffer.array[row, :3].copy()
            force, torque = (vector, zero) if is_force else (zero, vector)
            if not self._kinematic[row]:
                self._bodies[row].add_force_torque(force, torque)
        buffer.array[:] = 0

    def gpu_apply_rigid_dynamic_force(self) -> None:
        """Apply forces (newtons, world frame) at the centres of mass for the next substep."""
        self._apply_forces(self.cuda_rigid_body_force, is_force=True)

    def hold_forces(self, rows: np.ndarray, forces: np.ndarray) -> None:
        """Apply forces to bodies in every substep, until the next call for the same bodies.

        Unlike `gpu_apply_rigid_dynamic_force` this needs no code between substeps, so these can be
        taken scene by scene.

        Args:
            rows: of dynamic bodies in the body buffer, ``[k]``.
            forces: at their centres of mass, ``[k, 3]`` newtons in the world frame; zero ends the
                force and does not wake the body.
        """
        self.finish_substeps()
        for row, force in zip(rows.tolist(), forces, strict=True):
            held = self._held[self._body_scene[row]]
            if force.any() and not self._kinematic[row]:
                held[row] = force.astype(np.float32)
            else:
                held.pop(row, None)

    def gpu_apply_rigid_dynamic_torque(self) -> None:
        """Apply torques (newton metres, world frame) for the next substep."""
        self._apply_forces(self.cuda_rigid_body_torque, is_force=False)

    def gpu_update_articulation_kinematics(self) -> None:
        """Nothing to do: the CPU system updates link poses when joints are set."""

    def sync_poses_gpu_to_cpu(self) -> None:
        """Take the pending substeps. Nothing to copy: entities are on the CPU."""
        self.finish_substeps()

    # ------------------------------------------------------------------ contacts
    def gpu_create_contact_pair_impulse_query(
        self, body_pairs: Sequence[tuple[Any, Any]]
    ) -> PairImpulseQuery:
        """A query for the impulse on the first body of each pair by the second."""
        return self._contacts.register(PairImpulseQuery(body_pairs))

    def gpu_query_contact_pair_impulses(self, query: PairImpulseQuery) -> None:
        """Answer a pair query with the impulses of the last substep."""
        self.finish_substeps()
        self._contacts.answer(query)

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> BodyImpulseQuery:
        """A query for the net contact impulse on each body."""
        return self._contacts.register(BodyImpulseQuery(bodies))

    def gpu_query_contact_body_impulses(self, query: BodyImpulseQuery) -> None:
        """Answer a body query with the impulses of the last substep."""
        self.finish_substeps()
        self._contacts.answer(query)
