"""An encoder of clouds of points that commutes with the group and with every order of the points.

    point --Lift--> regular fields --largest over the points, Mix--> a weight for every point
    keypoint (g, k) = mean of all points under the weights of group element g, channel k

A shared network sees each point beside the largest value over all points (PointNet, arXiv
1612.00593). In regular fields the group permutes components, so that a maximum of each component
commutes with it. Nothing is interpolated: the encoder is exact for every turn of the group.
"""

from __future__ import annotations

import copy
from typing import ClassVar, Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError
from symsteer.policies.geometry import Cloud, Field, Group, Layout
from symsteer.policies.networks.equivariant import ExpandedLayer, Lift, RegularLinear
from symsteer.policies.networks.keypoints import REACH, KeypointEncoder

POINT = Layout([Field("xy", 1), Field("z", 0)])
"""The coordinates of a point that the encoder knows."""


class CloudEncoder(KeypointEncoder):
    """Puts what a cloud of points tells in its place in an observation.

    Args:
        cloud: geometry of the cloud.
        group: of rotations, C_n.

    Raises:
        UserError: if points have other coordinates than ``cloud_xy`` and ``cloud_z``.
    """

    counts: ClassVar[dict[bool, tuple[int, int]]] = {True: (16, 4), False: (41, 24)}
    """Channels and keypoints for each element of a group, and those of the trivial group: as many
    parameters as C8 has, about as many numbers (tests/policies/test_points.py)."""

    def __init__(self, cloud: Cloud, group: Group):
        channels, keypoints = self.counts[group.order > 1]
        super().__init__(cloud, group, keypoints, ["z"], 1.0)
        if cloud.point != POINT:
            raise UserError(
                "the encoder of clouds needs the fields cloud_xy (vectors) and cloud_z (scalars), "
                "and no other one of its points"
            )
        self.lift: nn.Module = Lift(POINT, group, channels)
        self.mix: nn.Module = RegularLinear(group, channels, channels)
        self.all: nn.Module = RegularLinear(group, channels, channels)
        self.weigh: nn.Module = RegularLinear(group, channels, keypoints)

    def points(self, obs: torch.Tensor) -> torch.Tensor:
        """``[M, points, 3]``, metres."""
        return obs[:, self.seen.columns.to(obs.device)]

    def seen_values(self, obs: torch.Tensor) -> torch.Tensor:
        return self.points(obs)[:, None, :, 2]

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        points = self.points(obs)
        known = torch.cat([points[..., :2] / REACH, points[..., 2:] / self.scale], dim=-1)
        hidden = functional.silu(self.lift(known))
        hidden = functional.silu(self.mix(hidden) + self.all(hidden.amax(1))[:, None])
        # A point that occurs several times counts once.
        times = (points[:, :, None] == points[:, None]).all(-1).sum(-1)
        logits = self.weigh(hidden) - times.to(points).log()[..., None, None]
        weights = logits.permute(0, 3, 2, 1).softmax(-1)
        return self.tell(weights, points[:, None, :, :2], points[:, None, :, 2])

    def expanded(self) -> Self:
        fast = copy.deepcopy(self)
        for name in ("lift", "mix", "all", "weigh"):
            fast.register_module(name, ExpandedLayer(getattr(self, name)))
        return fast.requires_grad_(False).eval()
