"""The camera that sees the objects shakes."""

from __future__ import annotations

from mani_skill.utils.structs import Pose

from symsteer.bench.variants.base import Role, Variant
from symsteer.bench.variants.noise import normal_pairs

STD_X, STD_Y = 0.01, 0.0025


class ObservationNoise(Variant):
    """Objects are reported with Gaussian noise, four times larger along x than along y.

    Standard deviations are 10 mm * strength along x and 2.5 mm * strength along y. The noise is
    new in every control step and the same for all objects of an environment, as of a camera that
    shakes. Tool and goal are reported exactly. The noise depends only on the episode's key (its
    seed, see ``SymmetricTask.episode_key``) and the elapsed steps: reading an observation twice
    gives the same one, on any device and with any number of environments.
    Breaks the observation, everywhere; the half turn and mirror images in the axes survive in
    distribution.
    """

    def perceive(self, pose: Pose, role: Role) -> Pose:
        if role != "object":
            return pose
        normal = normal_pairs(self.env.episode_key, self.env.elapsed_steps)
        return self.moved(pose, normal * normal.new_tensor([STD_X, STD_Y]) * self.amount[:, None])
