"""The network of every agent: an ensemble of multilayer perceptrons.

The agents differ only in their layers. A layer is any module with
``dense() -> (weight [out, in], bias [out])``: a plain linear layer, an equivariant layer expanded
to its dense matrix, or the sum of both. All agents then compute the same matrix products. The
members of an ensemble share one batched product (instead of one per critic).

The nonlinearity is LayerNorm (optional, without parameters) followed by ReLU or tanh. All of them
commute with permutations of the features, so regular fields stay regular fields.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol, cast

import torch
import torch.nn.functional as F
from torch import nn

Activation = Literal["relu", "tanh"]

Weights = list[tuple[torch.Tensor, torch.Tensor]]
"""Per layer the matrices ``[members, out, in]`` and biases ``[members, 1, out]``."""


class DenseLayer(Protocol):
    """A linear layer that returns its weight as one dense matrix."""

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Weight ``[out, in]`` and bias ``[out]``."""


class Dense(nn.Linear):
    """A plain linear layer."""

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.weight, self.bias


class Ensemble(nn.Module):
    """``members`` perceptrons of equal shape, evaluated together.

    Args:
        members: the layers of each member, first to last.
        layer_norm: whether hidden features are normalised.
        activation: of the hidden layers.

    ``width`` is the number of features of the first hidden layer.
    """

    def __init__(
        self,
        members: Sequence[Sequence[nn.Module]],
        layer_norm: bool,
        activation: Activation = "relu",
    ):
        super().__init__()
        self.width = len(dense(members[0][0])[1])
        self.members = nn.ModuleList([nn.ModuleList(layers) for layers in members])
        self.layer_norm, self.activation = layer_norm, activation
        self._expanded: Weights | None = None

    def weights(self) -> Weights:
        """The dense matrices of every layer; differentiable with respect to the parameters.

        The result is cached until :meth:`changed` is called, so acting, critic values and the next
        update use the same one. Only one backward pass per expansion: it frees the graph.
        """
        if self._expanded is None:
            with torch.enable_grad():
                self._expanded = self._expand()
        return self._expanded

    def layers(self) -> Iterator[tuple[nn.Module, dict[str, torch.Tensor]]]:
        """Every layer of every member with its parameters.

        In a team, equal layers of all members come as one: the first of them, with the parameters
        of all, which then have one more dimension in front.
        """
        for member in self.members:
            for layer in cast(nn.ModuleList, member):
                yield layer, dict(layer.named_parameters())

    def changed(self) -> None:
        """Drop the cache. Call this after every change of parameters."""
        self._expanded = None

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """As of any module; the cache is dropped."""
        self.changed()
        return super().load_state_dict(state_dict, *args, **kwargs)

    def _expand(self) -> Weights:
        stacked = []
        for layers in zip(*self.members, strict=True):
            matrices, biases = zip(*(dense(layer) for layer in layers), strict=True)
            stacked.append((torch.stack(matrices), torch.stack(biases).unsqueeze(1)))
        return stacked

    def apply_weights(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """Evaluate with the given matrices: ``[B, in] -> [members, B, out]``."""
        return self.propagate(weights, x.expand(len(weights[0][0]), *x.shape))

    def propagate(self, weights: Weights, out: torch.Tensor) -> torch.Tensor:
        """The same with an input for each member: ``[members, B, in] -> [members, B, out]``."""
        for index, (matrix, bias) in enumerate(weights):
            if index > 0:
                if self.layer_norm:
                    out = F.layer_norm(out, out.shape[-1:])
                out = F.relu(out, inplace=True) if self.activation == "relu" else out.tanh()
            out = torch.baddbmm(bias, out, matrix.mT)
        return out

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, in] -> [members, B, out]``."""
        return self.apply_weights(self.weights(), x)


def dense(layer: nn.Module) -> tuple[torch.Tensor, torch.Tensor]:
    """A layer's matrix ``[out, in]`` and bias ``[out]``."""
    return cast(DenseLayer, layer).dense()


def detached(weights: Weights) -> Weights:
    """The same matrices without gradients."""
    return [(matrix.detach(), bias.detach()) for matrix, bias in weights]


def shrink_(layer: nn.Module, factor: float) -> None:
    """Multiply all parameters of a layer by a factor, in place, for a small initial output."""
    with torch.no_grad():
        for parameter in layer.parameters():
            parameter.mul_(factor)


def count(module: nn.Module) -> int:
    """Number of trainable parameters."""
    return sum(parameter.numel() for parameter in module.parameters() if parameter.requires_grad)
