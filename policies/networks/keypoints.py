"""What cameras see, told as keypoints: the part that all encoders share.

    keypoint (g, k) = mean of what is seen under the weights of group element g, channel k

Turning the scene turns the keypoints and permutes their group elements. So the numbers

    z_j = mean over g of (cos j a_g, sin j a_g) (g^-1 keypoint (g, k))     (a complex product)

are planar vectors that turn by j times the angle (frequency j). z_1 is the mean place of keypoint
k; the others tell of its shape.
"""

from __future__ import annotations

import abc
import math
from collections import Counter
from collections.abc import Sequence
from typing import Self

import torch
from torch import nn

from symsteer.policies.geometry import Cloud, Field, Group, Layout
from symsteer.policies.normalizer import MINIMUM_RANGE, Normalizer
from symsteer.policies.picture import Picture

REACH = 0.1
"""Metres that have unit size for the networks. Most of a keypoint's weights lie elsewhere, so that
it moves less than what it follows."""


class KeypointEncoder(nn.Module, abc.ABC):
    """Puts keypoints in the place of what is seen in an observation.

    Args:
        seen: where it lies in an observation.
        group: of rotations, C_n.
        keypoints: for each group element.
        values: names of what a place has beside its coordinates, invariant under rotations.
        unit: metres in which shapes are told.

    Attributes:
        told: geometry of what is told: for each keypoint its mean place in metres and, there, the
            mean of each value; then the shapes.
        layout: the same in its place in the observation.
        scale: the largest magnitude of each value, ``[values]``.
    """

    scale: torch.Tensor

    def __init__(
        self,
        seen: Picture | Cloud,
        group: Group,
        keypoints: int,
        values: Sequence[str],
        unit: float,
    ):
        super().__init__()
        self.seen, self.group, self.keypoints = seen, group, keypoints
        self.values, self.unit = tuple(values), unit
        self.register_buffer("scale", torch.ones(len(self.values)))
        n = group.order
        turns = sorted((j if 2 * j <= n else j - n for j in range(n)), key=abs) if n > 1 else [1]
        self.turns = [1, *(j for j in turns if j != 1)]
        self.told = Layout(self.told_fields())
        # Numbers of the observation before what is seen.
        self.start = int(seen.columns.min())
        before, after = seen.rest.split(self.start)
        self.layout = Layout([*before, *self.told.fields, *after])

    def told_fields(self) -> list[Field]:
        """Geometry of what is told."""
        fields = [
            field
            for k in range(self.keypoints)
            for field in (
                Field(f"keypoint{k}_place", 1),
                *(Field(f"keypoint{k}_{name}", 0) for name in self.values),
            )
        ]
        count = Counter(abs(j) for j in self.turns[1:])
        return fields + [
            Field(f"shape{j}", j, times * self.keypoints * (1 if j else 2))
            for j, times in count.items()
        ]

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations of the task as ``[B, layout.dim]``, environment units."""
        rest = obs[:, self.seen.rest_columns.to(obs.device)]
        told = self.encode(obs)
        return torch.cat([rest[:, : self.start], told, rest[:, self.start :]], dim=1)

    @abc.abstractmethod
    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """What is told of what observations see, ``[B, told.dim]``, environment units."""

    @abc.abstractmethod
    def expanded(self) -> Self:
        """A copy for inference whose filters or matrices are ready."""

    @abc.abstractmethod
    def seen_values(self, obs: torch.Tensor) -> torch.Tensor:
        """The values of all that observations ``[M, dim]`` see, ``[M, values, places]``."""

    def statistics(self, obs: torch.Tensor, rest: Normalizer) -> Normalizer:
        """Learn the scale from ``obs [M, dim]``; the normaliser of what is made of them.

        What is told has a size by itself. Statistics would change while it is learned.

        Args:
            obs: demonstrated observations.
            rest: normaliser of the other fields.
        """
        self.scale.copy_(self.seen_values(obs).abs().amax(dim=(0, 2)).clamp_min(MINIMUM_RANGE))
        sizes = self.sizes()

        def around(values: torch.Tensor, told: torch.Tensor) -> torch.Tensor:
            return torch.cat([values[: self.start], told.to(values), values[self.start :]])

        return Normalizer(
            self.layout,
            around(rest.scale, sizes),
            around(rest.offset, 0 * sizes),
            around(rest.deviation, sizes),
        )

    def sizes(self) -> torch.Tensor:
        """What has unit size for the networks of what is told, ``[told.dim]``."""
        sizes = torch.full((self.told.dim,), REACH / self.unit)
        for field in self.told.fields:
            _, _, part = field.name.partition("_")
            if part in self.values:
                sizes[self.told.slice(field.name)] = float(self.scale[self.values.index(part)])
            elif part:
                sizes[self.told.slice(field.name)] = REACH
        return sizes

    def tell(
        self, weights: torch.Tensor, places: torch.Tensor, values: torch.Tensor
    ) -> torch.Tensor:
        """Keypoints under weights, ``[B, told.dim]``.

        Args:
            weights: ``[B, keypoints, order, places]``; those of a keypoint sum to 1.
            places: ``[places, 2]`` or ``[B, 1, places, 2]``, in units of ``unit``.
            values: ``[B, values, places]``, environment units.
        """
        # [B, keypoints, order]; `turn` turns each back by its element.
        z = torch.view_as_complex((weights @ places).contiguous())
        n = self.group.order
        angle = torch.arange(n, device=z.device, dtype=weights.dtype) * (2 * math.pi / n)
        parts = []
        for j in self.turns:
            turn = torch.polar(torch.ones_like(angle), angle * (j - 1)).to(z)
            mean = torch.view_as_real((z * turn).mean(-1))
            # The conjugate of a vector of frequency -j has frequency j.
            parts.append(mean * mean.new_tensor([1, -1 if j < 0 else 1]))
        first = torch.cat([self.unit * parts[0], weights.mean(2) @ values.mT], dim=-1)
        return torch.cat([first.flatten(1), *(part.flatten(1) for part in parts[1:])], dim=1)
