"""All scenes' states as SAPIEN packs them, one call per scene.

A scene's numbers are those of its rigid bodies, 13 each, and of its articulations: 13 of the root,
positions and velocities of the joints, and two drive targets of each joint.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import sapien.physx as physx

# Quaternion first, then position, then velocities: from there to the columns of our buffers.
_BODY = np.array([4, 5, 6, 0, 1, 2, 3, 7, 8, 9, 10, 11, 12])


class PackedScenes:
    """The numbers of N scenes, one scene after the other.

    Attributes:
        numbers: flat, float32; a last one, always zero, stands for joints that do not exist.
        rigid: where those of rigid bodies are, ``[bodies, 13]``, scene by scene.
        roots: where those of articulations' roots are, ``[articulations, 13]``.
        joints: where those of joints are, by name, ``[articulations, most joints of one]``.
    """

    def __init__(self, systems: Sequence[physx.PhysxCpuSystem]) -> None:
        self._calls = [system.pack for system in systems]
        self._starts = [0]
        rigid: list[int] = []
        roots: list[int] = []
        dofs: list[int] = []
        for system in systems:
            at = self._starts[-1]
            for _ in system.rigid_dynamic_components:
                rigid.append(at)
                at += 13
            for link in system.articulation_link_components:
                if link.is_root:
                    roots.append(at)
                    dofs.append(link.articulation.dof)
                    at += 13 + 4 * dofs[-1]
            self._starts.append(at)
        self.numbers = np.zeros(at + 1, dtype=np.float32)
        self.rigid = np.array(rigid, int).reshape(-1, 1) + _BODY
        self.roots = np.array(roots, int).reshape(-1, 1) + _BODY
        first = np.array(roots, int).reshape(-1, 1) + 13
        dof, joint = np.array(dofs, int).reshape(-1, 1), np.arange(max(dofs, default=0))
        self.joints = {
            name: np.where(joint < dof, first + place, at)
            for name, place in (
                ("qpos", joint),
                ("qvel", dof + joint),
                ("target_qpos", 2 * dof + 2 * joint),
                ("target_qvel", 2 * dof + 2 * joint + 1),
            )
        }

    def read(self, scenes: Sequence[int]) -> None:
        """Update the numbers of some scenes."""
        if len(scenes) == len(self._calls):
            everything = b"".join([pack() for pack in self._calls])
            self.numbers[:-1] = np.frombuffer(everything, "f4")
            return
        for i in scenes:
            rows = slice(self._starts[i], self._starts[i + 1])
            self.numbers[rows] = np.frombuffer(self._calls[i](), "f4")

    def write_targets(self, name: str, values: np.ndarray) -> None:
        """Keep new drive targets, which were written to the simulation."""
        self.numbers[self.joints[name]] = values
        self.numbers[-1] = 0
