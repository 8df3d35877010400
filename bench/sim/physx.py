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

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partialmethod
from typing import Any

import numpy as np
import sapien
import sapien.physx as physx

from symsteer.bench.sim.contacts import Buffer, ContactReader, ImpulseQuery
from symsteer.bench.sim.packed import PackedScenes

_POSE = slice(0, 7)
_VELOCITY = slice(7, 13)

_NOTHING = np.zeros(3, dtype=np.float32)


class Mirror(Buffer):
    """A buffer that tasks read and write, beside what the simulation held when it was last read."""

    def __init__(self, rows: int, columns: int) -> None:
        super().__init__(np.zeros((rows, columns), dtype=np.float32))
        self.state = np.zeros_like(self.array)

    def changed(self, rows: Any = slice(None), columns: slice = slice(None)) -> np.ndarray:
        """In which of these rows the buffer differs from the simulation, bool."""
        return (self.array[rows, columns] != self.state[rows, columns]).any(axis=1)


class BatchedPhysx:
    """N ``PhysxCpuSystem`` scenes with the interface of one ``PhysxGpuSystem``.

    Its members are those that ManiSkill's batched branch uses.

    Args:
        scenes: one SAPIEN scene per environment, each with its own ``PhysxCpuSystem``.
    """

    # ManiSkill chooses its batched branch by isinstance(system, PhysxGpuSystem). Constructing a
    # real subclass needs CUDA, so this property makes isinstance return True.
    __class__ = property(lambda self: physx.PhysxGpuSystem)  # type: ignore[assignment]

    def __init__(self, scenes: Sequence[sapien.Scene]) -> None:
        self.systems: list[physx.PhysxCpuSystem] = [s.physx_system for s in scenes]
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

    def get_scene_offset(self, scene: sapien.Scene) -> np.ndarray:
        """Always zero: each scene has a space of its own."""
        return np.zeros(3, dtype=np.float32)

    # ------------------------------------------------------------------ setup
    def gpu_init(self) -> None:
        """Index every body and articulation, allocate the buffers and fill them."""
        self._index_scenes()
        self._packed = PackedScenes(self.systems)
        self.cuda_rigid_body_data = Mirror(len(self._bodies), 13)
        self.cuda_rigid_body_force = Buffer(np.zeros((len(self._bodies), 4), dtype=np.float32))
        shape = len(self._articulations), max(self._dof, default=0)
        self.joints = {
            name: Mirror(*shape) for name in ("qpos", "qvel", "qf", "target_qpos", "target_qvel")
        }
        """By name; each is an attribute too, such as ``cuda_articulation_qpos``."""
        for name, mirror in self.joints.items():
            setattr(self, f"cuda_articulation_{name}", mirror)
        self._contacts = ContactReader(self.systems)
        self._stale = np.ones(len(self.systems), dtype=bool)
        # Articulations whose drives a controller sets. Their targets are written at each control
        # step, as in stock ManiSkill; this also prevents PhysX from putting them to sleep.
        self._driven = np.zeros(len(self._articulations), dtype=bool)
        self._initialized = True
        self.fetch_all()

    def _index_scenes(self) -> None:
        """Assign rows to bodies and articulations."""
        scenes = list(enumerate(self.systems))
        rigid = [(body, i) for i, s in scenes for body in s.rigid_dynamic_components]
        links = [(link, i) for i, s in scenes for link in s.articulation_link_components]
        roots = [(link, i) for link, i in links if link.is_root]
        self._bodies = [body for body, _ in rigid + links]
        self._scene_of = [scene for _, scene in rigid + links]
        self._body_row = {body: row for row, body in enumerate(self._bodies)}
        self._rigid_rows = np.arange(len(rigid))
        self._articulations = [root.articulation for root, _ in roots]
        self._articulation_scene = [scene for _, scene in roots]
        self._articulation_row = {a: row for row, a in enumerate(self._articulations)}
        self._root_rows = np.array([self._body_row[root] for root, _ in roots], int)
        self._roots = dict(zip(self._root_rows.tolist(), self._articulations, strict=True))
        self._kinematic = {row for row, (body, _) in enumerate(rigid) if body.kinematic}
        fixed = {row for row, a in self._roots.items() if a.root.joint.type == "fixed"}
        self._without_velocity = self._kinematic | fixed
        # Links are read only once somebody has asked for their rows.
        self._live = {*self._rigid_rows.tolist(), *self._roots}
        self._live_links: list[list[int]] = [[] for _ in self.systems]
        self._dof = [a.dof for a in self._articulations]
        joints = [a.active_joints for a in self._articulations]
        self._set_targets = {
            "target_qpos": [[j.set_drive_target for j in js] for js in joints],
            "target_qvel": [[j.set_drive_velocity_target for j in js] for js in joints],
        }

    def body_index(self, body: Any) -> int:
        """Row of a rigid body or link in the body buffer; from now on it is kept up to date."""
        row = self._body_row[body]
        if row not in self._live:
            self._live.add(row)
            self._live_links[self._scene_of[row]].append(row)
            self._read_links([row])
            self.cuda_rigid_body_data.array[row] = self.cuda_rigid_body_data.state[row]
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
        moving = np.flatnonzero(~self._paused).tolist()
        for i in moving:
            step, held = self.systems[i].step, self._held[i]
            pushes = [(self._bodies[row].add_force_torque, force) for row, force in held.items()]
            for _ in substeps:
                for push, force in pushes:
                    push(force, _NOTHING)
                step()
        if self._initialized:
            self._stale[moving] = True
            self._contacts.invalidate(moving)

    # ------------------------------------------------------------------ fetch
    def _refresh(self) -> None:
        """Read the scenes that may have changed since they were last read."""
        self.finish_substeps()
        if not self._stale.any():
            return
        stale = np.flatnonzero(self._stale).tolist()
        packed = self._packed
        packed.read(stale)
        state = self.cuda_rigid_body_data.state
        state[: len(self._rigid_rows)] = packed.numbers[packed.rigid]
        state[self._root_rows] = packed.numbers[packed.roots]
        for name, at in packed.joints.items():
            self.joints[name].state[:] = packed.numbers[at]
        rows = [row for i in stale for row in self._live_links[i]]
        if rows:
            self._read_links(rows)
        self._stale[:] = False

    def _read_links(self, rows: list[int]) -> None:
        state, links = self.cuda_rigid_body_data.state, [self._bodies[row] for row in rows]
        state[rows, _POSE] = [link.entity.pose.__getstate__() for link in links]
        state[rows, 7:10] = [link.linear_velocity for link in links]
        state[rows, 10:13] = [link.angular_velocity for link in links]

    def fetch_all(self) -> None:
        """Update every buffer."""
        self._refresh()
        self.cuda_rigid_body_data.array[:] = self.cuda_rigid_body_data.state
        for name in self._packed.joints:
            self.joints[name].array[:] = self.joints[name].state

    def gpu_fetch_rigid_dynamic_data(self) -> None:
        """Fetch poses and velocities of rigid bodies."""
        self._refresh()
        rigid, data = slice(len(self._rigid_rows)), self.cuda_rigid_body_data
        data.array[rigid] = data.state[rigid]

    # ------------------------------------------------------------------ apply
    def apply_all(self) -> None:
        """Write everything that a task changed in the buffers to the simulation."""
        self._apply_bodies(self._rigid_rows)
        self._apply_joints("qpos", moved=True)
        self._apply_joints("qvel")
        self._apply_joints("qf")
        self._apply_bodies(self._root_rows)
        self._apply_targets("target_qpos")
        self._apply_targets("target_qvel")

    def _touch(self, scene: int, moved: bool = False) -> None:
        self._stale[scene] = True
        if moved:
            self._contacts.forget(scene)

    def _apply_bodies(self, rows: np.ndarray) -> None:
        """Apply changed poses and velocities of rigid bodies or roots of articulations."""
        self.finish_substeps()
        data = self.cuda_rigid_body_data
        for row in rows[data.changed(rows, _POSE)].tolist():
            pose = sapien.Pose(data.array[row, :3], data.array[row, 3:7])
            if row in self._roots:
                self._roots[row].root_pose = pose
            else:
                self._bodies[row].entity.pose = pose
            self._touch(self._scene_of[row], moved=row not in self._kinematic)
        for row in rows[data.changed(rows, _VELOCITY)].tolist():
            linear, angular = data.array[row, 7:10], data.array[row, 10:13]
            if row in self._roots and row not in self._without_velocity:
                self._roots[row].set_root_linear_velocity(linear)
                self._roots[row].set_root_angular_velocity(angular)
            elif row not in self._without_velocity:
                self._bodies[row].linear_velocity = linear
                self._bodies[row].angular_velocity = angular
            self._touch(self._scene_of[row])
        data.state[rows] = data.array[rows]

    def gpu_apply_rigid_dynamic_data(self) -> None:
        """Apply poses and velocities of rigid bodies."""
        self._apply_bodies(self._rigid_rows)

    def _apply_joints(self, name: str, moved: bool = False) -> None:
        """Apply joint positions, velocities, or forces, which act until others are applied."""
        self.finish_substeps()
        mirror = self.joints[name]
        for row in np.flatnonzero(mirror.changed()).tolist():
            setattr(self._articulations[row], name, mirror.array[row, : self._dof[row]])
            self._touch(self._articulation_scene[row], moved)
        mirror.state[:] = mirror.array

    def _apply_targets(self, name: str, refresh_driven: bool = False) -> None:
        """Apply drive targets; those of controlled articulations maybe even if unchanged."""
        self.finish_substeps()
        mirror = self.joints[name]
        write = mirror.changed()
        self._driven |= write
        if refresh_driven:
            write = self._driven
        values = mirror.array.tolist()
        for row in np.flatnonzero(write).tolist():
            for set_target, value in zip(self._set_targets[name][row], values[row], strict=False):
                set_target(value)
        mirror.state[:] = mirror.array
        # The next refresh must find the new targets.
        self._packed.write_targets(name, mirror.array)

    gpu_apply_articulation_target_position = partialmethod(_apply_targets, "target_qpos", True)
    gpu_apply_articulation_target_velocity = partialmethod(_apply_targets, "target_qvel", True)

    def gpu_apply_rigid_dynamic_force(self) -> None:
        """Apply forces (newtons, world frame) for the next substep only, and clear the buffer."""
        self.finish_substeps()
        forces = self.cuda_rigid_body_force.array
        for row in np.flatnonzero(forces[: len(self._rigid_rows)].any(axis=1)).tolist():
            if row not in self._kinematic:
                self._bodies[row].add_force_torque(forces[row, :3].copy(), _NOTHING)
        forces[:] = 0

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
            held = self._held[self._scene_of[row]]
            if force.any() and row not in self._kinematic:
                held[row] = force.astype(np.float32)
            else:
                held.pop(row, None)

    def gpu_update_articulation_kinematics(self) -> None:
        """Nothing to do: the CPU system updates link poses when joints are set."""

    def sync_poses_gpu_to_cpu(self) -> None:
        """Take the pending substeps. Nothing to copy: entities are on the CPU."""
        self.finish_substeps()

    # ------------------------------------------------------------------ contacts
    def gpu_create_contact_pair_impulse_query(
        self, body_pairs: Sequence[tuple[Any, Any]]
    ) -> ImpulseQuery:
        """A query for the impulse on the first body of each pair by the second."""
        return self._contacts.register(body_pairs)

    def gpu_create_contact_body_impulse_query(self, bodies: Sequence[Any]) -> ImpulseQuery:
        """A query for the net contact impulse on each body."""
        return self._contacts.register((body, None) for body in bodies)

    def gpu_query_contact_pair_impulses(self, query: ImpulseQuery) -> None:
        """Answer a query with the impulses of the last substep."""
        self.finish_substeps()
        self._contacts.update()

    gpu_query_contact_body_impulses = gpu_query_contact_pair_impulses
