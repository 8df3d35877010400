"""The rivals without group structure: the same denoiser over the trivial group.

A plain policy is EDP with C1: one slice, ordinary dense layers, the same code path. Its width is
chosen so that its parameter count comes closest to that of the equivariant policy it is compared
with; ``plain-augmented`` also trains on randomly turned copies of the demonstrations.
"""

from __future__ import annotations

import torch

from symsteer.policies.edp import Denoiser, parameter_count
from symsteer.policies.geometry import Group, Layout


def matched_size(
    obs_layout: Layout,
    act_layout: Layout,
    horizon: int,
    group: Group,
    network: str,
    channels: int,
    width: int,
    depth: int,
) -> tuple[int, int]:
    """(channels, width) of the plain denoiser with as many parameters as the equivariant one.

    Both grow together, in steps of 4 features; depth and horizon stay.
    """

    def count(group: Group, channels: int, width: int) -> int:
        with torch.device("meta"):
            return parameter_count(
                Denoiser(obs_layout, act_layout, horizon, group, network, channels, width, depth)
            )

    target = count(group, channels, width)
    best: tuple[int, int, int] | None = None
    for plain_width in range(width - width % 4, 8 * width + 1, 4):
        plain_channels = max(4, round(channels * plain_width / width / 4) * 4)
        size = count(Group.parse("C1"), plain_channels, plain_width)
        if best is None or abs(size - target) < best[0]:
            best = (abs(size - target), plain_channels, plain_width)
        if size > target:
            break
    assert best is not None
    return best[1], best[2]
