"""The network of every agent: an ensemble of multilayer perceptrons.

The agents differ only in their layers. A layer is any module with
``dense() -> (weight [out, in], bias [out])``: a plain linear layer, an equivariant layer expanded
to its dense matrix, or the sum of both. All agents then compute the same matrix products. The
members of an ensemble share one batched product (instead of one per critic).

The nonlinearity is LayerNorm (optional, without parameters) followed by ReLU or tanh. All of them
commute with permutations of the features, so regular fields stay regular fields.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol, cast

import torch
from torch import nn
from torch.func import functional_call

from symsteer.policies.networks.equivariant import MatrixLayer

Activation = Literal["relu", "tanh"]

Weights = list[tuple[torch.Tensor, torch.Tensor]]
"""Per layer the matrices ``[members, out, in]`` and biases ``[members, 1, out]``."""

relu_backward = torch.ops.aten.threshold_backward.default
tanh_backward = torch.ops.aten.tanh_backward.default
layer_norm_backward = torch.ops.aten.native_layer_norm_backward.default

Parameters = Mapping[str, torch.Tensor]
"""Parameters of a layer by name; those of several equal layers have one more dimension in front."""


class DenseLayer(Protocol):
    """A linear layer that returns its weight as one dense matrix."""

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Weight ``[out, in]`` and bias ``[out]``."""


class Dense(nn.Linear, MatrixLayer):
    """A plain linear layer."""

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        return parameters["weight"], parameters["bias"]


class Ensemble(nn.Module):
    """``members`` perceptrons of equal shape, evaluated together.

    All parameters lie in one vector, so that one operation changes them all. Those of the layers
    are views of it. Equal layers of the members lie side by side: their matrices are one tensor.

    Args:
        members: the layers of each member, first to last.
        layer_norm: whether hidden features are normalised.
        activation: of the hidden layers.

    Attributes:
        width: features of the first hidden layer.
        vector: all parameters, which the optimiser changes.
        shared: whether a team keeps the parameters in a vector of its own now.
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
        # Per layer the equal ones of successive members.
        self._equal: list[list[list[nn.Module]]] = [
            _equal_layers(layers) for layers in zip(*members, strict=True)
        ]
        self._collect()

    def _collect(self) -> None:
        """Move the parameters into a new vector."""
        self._names = [[k for k, _ in equal[0].named_parameters()] for equal in self._layers()]
        stacks = [
            torch.stack([layer.get_parameter(name).detach() for layer in equal])
            for equal, names in zip(self._layers(), self._names, strict=True)
            for name in names
        ]
        self._shapes = [stack.shape for stack in stacks]
        self._sizes = [stack.numel() for stack in stacks]
        self.vector = torch.cat([stack.flatten() for stack in stacks]).requires_grad_()
        self.own()

    def own(self) -> None:
        """Make the parameters views of :attr:`vector`; they keep their values."""
        with torch.no_grad():
            for parameter, view in zip(self.parameters(), self.pieces(self.vector), strict=True):
                view.copy_(parameter)
                parameter.data = view
        self.values, self.shared = self._stacks(self.vector.detach()), False

    def share(self, values: list[Parameters]) -> None:
        """Use stacked parameters that a team keeps."""
        self.values, self.shared = values, True

    def pieces(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """A vector of the form of :attr:`vector` as tensors like :meth:`parameters`."""
        views: dict[torch.Tensor, torch.Tensor] = {}
        for layers, stacks in zip(self._layers(), self._stacks(vector.detach()), strict=True):
            for name, stack in stacks.items():
                owners = (layer.get_parameter(name) for layer in layers)
                views |= zip(owners, stack, strict=True)
        return [views[parameter] for parameter in self.parameters()]

    def _layers(self) -> Iterator[list[nn.Module]]:
        return itertools.chain.from_iterable(self._equal)

    def _stacks(self, vector: torch.Tensor) -> list[Parameters]:
        """The parameters in a vector, of all equal layers as one, by name."""
        split = vector.split(self._sizes)
        stacks = iter([x.view(shape) for x, shape in zip(split, self._shapes, strict=True)])
        return [{name: next(stacks) for name in names} for names in self._names]

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        """As of any module; afterwards the parameters are in one vector again."""
        result = super()._apply(*args, **kwargs)
        self.changed()
        self._collect()
        return result

    def weights(self) -> Weights:
        """The dense matrices of every layer; differentiable with respect to the parameters.

        The result is cached until :meth:`changed` is called, so acting, critic values and the next
        update use the same one. Only one backward pass per expansion: it frees the graph.
        """
        if self._expanded is None:
            with torch.enable_grad():
                self._expanded = self._expand()
        return self._expanded

    def layers(self) -> Iterator[tuple[nn.Module, Parameters]]:
        """Equal layers of all members as one: the first of them, with the parameters of all.

        With gradients they are differentiable, without they may be changed in place.
        """
        differentiable = torch.is_grad_enabled() and not self.shared
        values = self._stacks(self.vector) if differentiable else self.values
        for equal, stacks in zip(self._layers(), values, strict=True):
            yield equal[0], stacks

    def changed(self) -> None:
        """Drop the cache. Call this after every change of parameters."""
        self._expanded = None

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """As of any module; the cache is dropped."""
        self.changed()
        return super().load_state_dict(state_dict, *args, **kwargs)

    def _expand(self) -> Weights:
        expanded = [dense_of(*layer) for layer in self.layers()]
        weights: Weights = []
        for equal in self._equal:
            (matrix, bias), *others = (expanded.pop(0) for _ in equal)
            if others:
                matrix = torch.cat([matrix, *(more for more, _ in others)])
                bias = torch.cat([bias, *(more for _, more in others)])
            weights.append((matrix, bias.unsqueeze(1)))
        return weights

    def apply_weights(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """Evaluate with the given matrices: ``[B, in] -> [members, B, out]``."""
        return self.propagate(weights, x.expand(len(weights[0][0]), *x.shape))

    def propagate(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """The same with an input for each member: ``[members, B, in] -> [members, B, out]``."""
        flat = itertools.chain.from_iterable(weights)
        return cast(torch.Tensor, Perceptron.apply(x, self.layer_norm, self.activation, *flat))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, in] -> [members, B, out]``."""
        return self.apply_weights(self.weights(), x)


class Perceptron(torch.autograd.Function):
    """Multilayer perceptrons of equal shape, ``[members, B, in] -> [members, B, out]``.

    The derivative is written out: autograd of the same operations takes a third longer, most of it
    in products with a last matrix of one row and in copies. It has no second derivative.
    """

    @staticmethod
    def forward(
        ctx: Any,
        x: torch.Tensor,
        layer_norm: bool,
        activation: Activation,
        *weights: torch.Tensor,
    ) -> torch.Tensor:
        """Weights are a matrix ``[members, out, in]`` and a bias ``[members, 1, out]`` a layer."""
        kept = []
        out = x
        for index in range(0, len(weights), 2):
            matrix, bias = weights[index : index + 2]
            if index:
                sums = out
                kept.append(sums)
                if layer_norm:
                    out, *moments = normalized(out)
                    kept += moments
                out = out.relu_() if activation == "relu" else out.tanh_()
                kept.append(out)
            if _is_slow(matrix):
                out = (out * matrix).sum(-1, keepdim=True) + bias
            else:
                out = torch.baddbmm(bias, out, matrix.mT)
        ctx.layer_norm, ctx.activation = layer_norm, activation
        ctx.save_for_backward(x, *weights[::2], *kept)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Chain rule from the last layer to the first."""
        (gradient,) = gradients
        needed = ctx.needs_input_grad
        depth = (len(needed) - 3) // 2
        x, *saved = ctx.saved_tensors
        matrices, kept = saved[:depth], saved[depth:]
        step = len(kept) // (depth - 1) if depth > 1 else 0
        found: list[torch.Tensor | None] = []
        for index in reversed(range(depth)):
            matrix = matrices[index]
            sums, *moments, seen = kept[(index - 1) * step : index * step] if index else (x, x)
            single = _is_slow(matrix)
            of_matrix = of_bias = None
            if needed[3 + 2 * index]:
                if single:
                    of_matrix = (gradient * seen).sum(-2, keepdim=True)
                else:
                    of_matrix = torch.bmm(gradient.mT, seen)
            if needed[4 + 2 * index]:
                of_bias = gradient.sum(-2, keepdim=True)
            found += [of_bias, of_matrix]
            if index or needed[0]:
                gradient = gradient * matrix if single else torch.bmm(gradient, matrix)
            if index:
                if ctx.activation == "relu":
                    gradient = relu_backward(gradient, seen, 0)
                else:
                    gradient = tanh_backward(gradient, seen)
                if ctx.layer_norm:
                    gradient = layer_norm_backward(
                        gradient, sums, sums.shape[-1:], *moments, None, None, (True, False, False)
                    )[0]
        return (gradient if needed[0] else None, None, None, *reversed(found))


EPSILON = 1e-5
"""Added to the variance of LayerNorm."""

MANY = 2**15
"""Numbers from which on LayerNorm is computed by its formula on a processor."""


def _is_slow(matrix: torch.Tensor) -> bool:
    """Whether a product with the matrix takes longer than a sum: with one row, on a processor."""
    return matrix.shape[-2] == 1 and not matrix.is_cuda


def normalized(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """LayerNorm of the last axis; also the mean and the inverse standard deviation.

    On a processor torch's own function takes twice as long as its formula for many rows.
    """
    size = x.shape[-1]
    if x.is_cuda or x.numel() < MANY:
        return torch.native_layer_norm(x, (size,), None, None, EPSILON)
    mean = x.sum(-1, keepdim=True).div_(size)
    centred = x - mean
    squares = torch.linalg.vector_norm(centred, dim=-1, keepdim=True).square_()
    inverse = squares.div_(size).add_(EPSILON).rsqrt_()
    return centred.mul_(inverse), mean, inverse


@torch.no_grad()
def _equal_layers(layers: Sequence[nn.Module]) -> list[list[nn.Module]]:
    """Successive layers that differ in the values of their parameters alone, together."""
    groups: list[list[nn.Module]] = []
    for layer in layers:
        if not (groups and _are_equal(groups[-1][0], layer)):
            groups.append([])
        groups[-1].append(layer)
    return groups


def _are_equal(first: nn.Module, other: nn.Module) -> bool:
    """Whether the first layer, given the other one's parameters, has the other one's matrix."""
    one, two = (
        {name: x.unsqueeze(0) for name, x in layer.named_parameters()} for layer in (first, other)
    )
    shapes = [{name: x.shape for name, x in stacks.items()} for stacks in (one, two)]
    if type(first) is not type(other) or shapes[0] != shapes[1]:
        return False
    matrices = zip(dense_of(first, two), dense_of(other, two), strict=True)
    return all(torch.equal(x, y) for x, y in matrices)


def dense(layer: nn.Module) -> tuple[torch.Tensor, torch.Tensor]:
    """A layer's matrix ``[out, in]`` and bias ``[out]``."""
    return cast(DenseLayer, layer).dense()


def dense_of(layer: nn.Module, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
    """Matrices ``[..., out, in]`` and biases ``[..., out]`` of equal layers, one of which is given.

    Args:
        layer: one of them.
        parameters: of all, stacked.
    """
    if isinstance(layer, MatrixLayer) and type(layer).dense is MatrixLayer.dense:
        return layer.dense_of(parameters)
    return torch.vmap(lambda each: functional_call(_DenseOf(layer), each, ()))(
        {f"layer.{name}": stack for name, stack in parameters.items()}
    )


def within(name: str, parameters: Parameters) -> Parameters:
    """The parameters of a layer that is a part of another one."""
    return {
        key.removeprefix(f"{name}."): value
        for key, value in parameters.items()
        if key.startswith(f"{name}.")
    }


class _DenseOf(nn.Module):
    """Returns a layer's dense matrix where it is called."""

    def __init__(self, layer: nn.Module):
        super().__init__()
        self.layer = layer

    def forward(self) -> tuple[torch.Tensor, torch.Tensor]:
        return dense(self.layer)


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
