"""Encoders of pictures from the hand, as signals on a sphere (after ISP, arXiv 2505.16969).

A pixel is a direction n from the camera. On this sphere lie two signals: s = 1 where something is
seen, and its distance d.

    picture --convolutions--> weights of the places, 0 to 1, for each keypoint
    mean of s H(n) and of d H(n) under the weights --hand's orientation R--> the same of H(R n)

H are the spherical harmonics of degree 0, 1 and 2, R turns them by Wigner's matrices
(:class:`~symsteer.policies.networks.irreps.SpatialIrreps`). The mean of d n is the mean of the
points that are seen. A picture does not change when scene and hand turn together, so what is told
turns with them: exactly, by any angle, whatever the convolutions are.

Degree 2 does not tell how a cube is turned, which has frequency 4. So these are told, too, of the
seen points z, complex numbers in the world's horizontal plane: the mean of (z - mean z)^4 over that
of |z - mean z|^4.

They matter when the hand alone rolls about the camera's axis, which turns the picture. Steerable
ones commute with it (:class:`HandEncoder`), ordinary ones do in the mean over the quarter turns of
the picture (:class:`AveragedHandEncoder`): both exactly for quarter turns, else roughly.
"""

from __future__ import annotations

import functools
import math
from typing import ClassVar

import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group
from symsteer.policies.networks.irreps import SpatialIrreps
from symsteer.policies.networks.pictures import SHRINK, PictureEncoder
from symsteer.policies.picture import Picture, hand_rays

AXES = ("tcp_x_axis", "tcp_y_axis", "tcp_z_axis")
"""Fields with the horizontal parts of the tool's axes."""

LEAST = 0.01
"""Seen pixels that are too few to have a mean: added to what a mean is divided by."""

IRREPS = SpatialIrreps()

SMALL = 1e-9
"""Fourth powers of metres that are too few to divide by: 0.3 of that of 1 cm."""

PLANAR = {0: [8], 1: [6, 5], 2: [7, 4]}
"""The parts of degree 2 by their frequency, where the vertical is fixed."""


class HandEncoder(PictureEncoder):
    """Puts what a picture from the hand tells, in the world's axes, in its place in an observation.

    Args:
        picture: geometry of the picture.
        group: of the convolutions, C_n; ordinary ones if it is trivial.

    Attributes:
        told: for each keypoint the mean direction from the camera, the mean distance, and the mean
            of the points from the camera on, in metres; then the parts of degree 2, and of
            frequency 4.

    Raises:
        UserError: if the picture has other channels than its distance, the observation does not
            tell the tool's axes, or quarter turns do not keep the places.
    """

    counts: ClassVar = {True: (4, 4), False: (6, 4)}

    def __init__(self, picture: Picture, group: Group):
        super().__init__(picture, group)
        told = {field.name for field in picture.rest.fields if field.frequency == 1}
        if picture.channels != ("distance",) or not told.issuperset(AXES):
            raise UserError(
                "a picture from the hand is one field hand_distance, beside the vectors "
                f"{', '.join(AXES)} that say how the hand is turned; the encoder needs all of them"
            )

    def told_fields(self) -> list[Field]:
        fields = []
        for k in range(self.keypoints):
            fields += [Field(f"keypoint{k}_axis_xy", 1), Field(f"keypoint{k}_axis_z", 0)]
            fields += [Field(f"keypoint{k}_distance", 0)]
            fields += [Field(f"camera_to_keypoint{k}_xy", 1), Field(f"camera_to_keypoint{k}_z", 0)]
        fields += [Field(f"shape{j}", j, 2 * self.keypoints) for j in PLANAR]
        return [*fields, Field("shape4", 4, self.keypoints)]

    def sizes(self) -> torch.Tensor:
        sizes = torch.ones(self.told.dim)
        for field in self.told.fields:
            if field.name.startswith("camera") or field.name.endswith("distance"):
                # Half of the largest distance: no vector in space is longer than 2 of it.
                sizes[self.told.slice(field.name)] = float(self.scale) / 2
        return sizes

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        return self.in_world(self.picture.of(obs), self.orientation(obs))

    def orientation(self, obs: torch.Tensor) -> torch.Tensor:
        """R: the tool's axes in the world, one in each column, ``[B, 3, 3]``."""
        rest, layout = obs[:, self.picture.rest_columns.to(obs.device)], self.picture.rest
        level = torch.stack([rest[:, layout.slice(name)] for name in AXES], dim=-1)
        heights = torch.linalg.cross(level[:, 0], level[:, 1])
        return torch.cat([level, heights[:, None]], dim=1)

    def weights(self, picture: torch.Tensor) -> torch.Tensor:
        """Of the places of pictures ``[B, 1, side, side]``, 0 to 1, ``[B, keypoints, places]``."""
        return self.logits(picture).sigmoid().mean(2)

    def in_world(self, picture: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        """What pictures ``[B, 1, side, side]`` of hands turned by ``turn [B, 3, 3]`` tell."""
        signals = _by_place(torch.cat([(picture > 0).to(picture), picture], dim=1))
        weights = self.weights(picture)
        # [B, places, signals, harmonics], summed over the pixels of a place.
        harmonics = _harmonics(self.picture.side, picture.dtype, picture.device)
        sums = torch.einsum("bspi,pih->bpsh", signals, harmonics)
        sums = torch.einsum("bkp,bpsh->bksh", weights, sums)
        means = sums / (sums[:, :, :1, :1] + LEAST)
        means = means @ IRREPS.rotation(turn).mT[:, None]
        near = [means[:, :, 0, 1:4], means[:, :, 1, :4]]
        shapes = [means[..., parts] for parts in PLANAR.values()]
        level = torch.einsum("bij,bpx,pxj->bpxi", turn[:, :2], signals[:, 1], harmonics[..., 1:4])
        shapes.append(_frequency_4(weights[..., None] * signals[:, :1], level))
        return torch.cat([torch.cat(near, -1).flatten(1), *(s.flatten(1) for s in shapes)], dim=1)


class AveragedHandEncoder(HandEncoder):
    """The mean of ordinary convolutions over turned pictures (frame averaging, arXiv 2505.13431).

    Args:
        picture: geometry of the picture.
        group: the picture is turned by those of its elements that are quarter turns, which keep
            all pixels.
    """

    def __init__(self, picture: Picture, group: Group):
        super().__init__(picture, Group.parse("C1"))
        self.quarters = range(0, 4, 4 // math.gcd(4, group.order_of_rotations))

    def weights(self, picture: torch.Tensor) -> torch.Tensor:
        turned = torch.cat([torch.rot90(picture, q, (-2, -1)) for q in self.quarters])
        side = self.picture.side // SHRINK
        weights = super().weights(turned).unflatten(-1, (side, side)).chunk(len(self.quarters))
        back = [torch.rot90(w, -q, (-2, -1)) for q, w in zip(self.quarters, weights, strict=True)]
        return torch.stack(back).mean(0).flatten(2)


def _frequency_4(weights: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
    """Of the horizontal places of points about their mean, ``[B, keypoints, 2]``, norm 1 at most.

    Args:
        weights: ``[B, keypoints, places, pixels]``.
        level: ``[B, places, pixels, 2]``, metres.
    """
    z = torch.view_as_complex(level.contiguous()).flatten(1)[:, None]
    weights = weights.flatten(2)
    mean = (weights * z).sum(-1, keepdim=True) / (weights.sum(-1, keepdim=True) + LEAST)
    squares = (z - mean).square()
    size = (weights * torch.view_as_real(squares).square().sum(-1)).sum(-1) + SMALL
    return torch.view_as_real((weights * squares.square()).sum(-1) / size)


def _by_place(pixels: torch.Tensor) -> torch.Tensor:
    """Pictures ``[..., side, side]`` by place: ``[..., places, pixels of a place]``."""
    blocks = pixels.unflatten(-1, (-1, SHRINK)).unflatten(-3, (-1, SHRINK))
    return blocks.transpose(-3, -2).flatten(-2).flatten(-3, -2)


@functools.lru_cache(maxsize=8)
def _harmonics(side: int, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Of the pixels of a picture, ``[places, pixels of a place, 9]``, computed in float64."""
    rays = _by_place(hand_rays(side).T.unflatten(1, (side, -1)))
    return IRREPS.harmonics(rays.permute(1, 2, 0)).to(device, dtype)
