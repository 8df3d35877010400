"""Agents between strict and free: equivariant layers that may leave the symmetry.

The matrix W of every layer is the sum of its nearest equivariant matrix P(W) and an asymmetric part
A. The agents differ in how A is parametrised and held. All start with A = 0, where the equivariant
agent starts. Agents with a penalty on A have the same dial: after each step of Adam with rate lr,

    A <- A / (1 + 2 lr penalty),

the proximal step for the loss ``penalty |A|^2`` (Parikh and Boyd, Proximal Algorithms, 2014). As a
weight decay inside Adam the same penalty hardly binds, because Adam divides it by the size of the
gradient. Here a step of Adam moves a number by about lr at most, so that the numbers of A stay
below 1 / (2 penalty): 0 lets A go, infinity is the equivariant agent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import torch
from torch import nn

from symsteer.agents.episodes import Played
from symsteer.agents.equivariant import EquivariantAgent, equivariant_layers
from symsteer.agents.networks import Dense, Ensemble, Parameters, dense, dense_of, within
from symsteer.agents.options import SacOptions
from symsteer.policies.geometry import Layout
from symsteer.policies.networks.equivariant import EquivariantLayer, MatrixLayer


class AsymmetricLayer(MatrixLayer):
    """An equivariant layer that may leave the symmetry, made of one or more equivariant ones.

    Attributes:
        strict: says which matrices are equivariant here.
    """

    strict: EquivariantLayer

    def pull(self, parameters: Parameters, factor: torch.Tensor) -> None:
        """Multiply the asymmetric part by a factor, in place."""
        raise NotImplementedError


class TwoPaths(AsymmetricLayer):
    """An equivariant layer and a plain one of the same shape, which starts at 0."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__()
        self.strict = strict
        outputs, inputs = dense(strict)[0].shape
        # It must not draw: the strict layers are those of the equivariant agent.
        self.free = torch.nn.utils.skip_init(Dense, inputs, outputs)
        for parameter in self.free.parameters():
            nn.init.zeros_(parameter)

    def strict_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        """What the equivariant layer contributes to :meth:`dense_of`."""
        return dense_of(self.strict, within("strict", parameters))


class AsymmetricAgent(EquivariantAgent):
    """Layers that may leave the symmetry; subclasses say which, and what holds them."""

    Layer: ClassVar[type[AsymmetricLayer]]

    @property
    def copies(self) -> int:
        """Equivariant layers of which each layer is made."""
        return 1

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        strict = [
            equivariant_layers(inputs, outputs, self.options, scale) for _ in range(self.copies)
        ]
        return [self.Layer(*layers) for layers in zip(*strict, strict=True)]

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Also |A| / |W| of each network, over all layers."""
        shares = {
            f"asymmetry_{name}": asymmetry(network)
            for name, network in self.networks.items()
            if all(isinstance(layer, AsymmetricLayer) for layer, _ in network.layers())
        }
        return {**super().diagnostics(played), **shares}


@dataclass(frozen=True)
class PenaltyOptions(SacOptions):
    """Options of the agents with a penalty on the asymmetric part."""

    penalty: float = 1.0
    """The dial: weight of the squared asymmetric part, which keeps its numbers below
    1 / (2 penalty). 0: free; 1e8: strict to 1e-4."""
    half_life: float = 0.0
    """Updates of a network after which the penalty has fallen to a half; 0: it stays."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("not be negative", lambda value: value >= 0, "penalty", "half_life")


class PenaltyAgent(AsymmetricAgent):
    """Layers whose asymmetric part is pulled to 0 after each step."""

    Options = PenaltyOptions
    options: PenaltyOptions

    def settle(self, name: str) -> None:
        """The proximal step."""
        if step := 2 * self.options.lr * self.options.penalty:
            updates = self.optimizers[name].steps.to(self.dtype)
            rate = 1 / self.options.half_life if self.options.half_life else 0.0
            factor = 1 / (1 + step * 0.5 ** (updates * rate))
            for layer, parameters in self.networks[name].layers():
                cast(AsymmetricLayer, layer).pull(parameters, factor)


@torch.no_grad()
def asymmetry(network: Ensemble) -> float:
    """|W - P(W)| / |W| over the matrices and biases of all layers (Frobenius norms)."""
    apart, whole = [], []
    for layer, parameters in network.layers():
        tensors = dense_of(layer, parameters)
        nearest = cast(AsymmetricLayer, layer).strict.nearest(*tensors)
        apart += [(tensor - near).norm() for tensor, near in zip(tensors, nearest, strict=True)]
        whole += [tensor.norm() for tensor in tensors]
    return (torch.stack(apart).norm() / torch.stack(whole).norm()).item()
