"""Symmetry by augmentation: the plain policy, trained on randomly turned demonstrations."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from symsteer.policies.geometry import Group, Layout
from symsteer.policies.symmetry.unconstrained import PlainDiffusionPolicy, PlainOptions


@dataclass(frozen=True)
class AugmentedOptions(PlainOptions):
    """Options of the augmented plain policy."""

    augmentation: str = "C8"
    """Symmetries that turn the demonstrations: C_n, D_n or SO2 (any angle)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        Group.parse(self.augmentation)


class AugmentedDiffusionPolicy(PlainDiffusionPolicy):
    """Plain diffusion policy, trained on randomly turned demonstrations."""

    name = "plain-augmented"
    Options = AugmentedOptions
    options: AugmentedOptions

    @property
    def data_group(self) -> Group:
        """That of the augmentation."""
        return Group.parse(self.options.augmentation)

    def augment(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Turn each pair of observation and chunk by its own random symmetry."""
        augmentation = Augmentation(self.data_group)
        drawn = augmentation.draw(len(obs), generator).to(obs.device)
        return (
            augmentation.apply(drawn, obs, self.task_layout),
            augmentation.apply(drawn, chunks, self.act_layout),
        )


class Augmentation:
    """Random planar symmetries, one per row; several vectors can be turned by the same ones.

    Args:
        group: a finite group (its elements are drawn) or SO(2) (any angle).
    """

    def __init__(self, group: Group):
        self.group = group

    def draw(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """``[count]`` element indices, or angles for SO(2)."""
        device = generator.device
        if self.group.rotations == 0:
            return 2 * math.pi * torch.rand(count, generator=generator, device=device)
        return torch.randint(self.group.order, (count,), generator=generator, device=device)

    def apply(self, drawn: torch.Tensor, x: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Turn row i of ``x [count, ..., dim]`` by ``drawn[i]``."""
        if self.group.rotations == 0:
            return layout.rotate(x, drawn)
        if layout.picture:
            turned = x.clone()
            for index, element in enumerate(self.group.elements):
                turned[drawn == index] = layout.transform(x[drawn == index], *element)
            return turned
        rho = self.group.representation(layout, x.dtype, x.device)[drawn]
        return torch.einsum("bij,b...j->b...i", rho, x)
