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

    Equal layers of the members lie side by side: a parameter of all is one tensor, and those of the
    layers are views of it.

    Args:
        members: the layers of each member, first to last.
        layer_norm: whether hidden features are normalised.
        activation: of the hidden layers.

    Attributes:
        width: features of the first hidden layer.
        tensors: all parameters, which the optimiser changes; of a team's member they are views.
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
        self._expanded: list[Weights] = []
        # Per layer the equal ones of successive members.
        self._equal: list[list[list[nn.Module]]] = [
            _equal_layers(layers) for layers in zip(*members, strict=True)
        ]
        self._names = [[k for k, _ in equal[0].named_parameters()] for equal in self._layers()]
        self.own()

    def own(self) -> None:
        """Move the parameters into new tensors; they keep their values."""
        self.tensors = [
            torch.stack([p.detach() for p in parameters]).requires_grad_()
            for parameters in self._stacks()
        ]
        for parameter, view in zip(self.parameters(), self.pieces(self.tensors), strict=True):
            parameter.data = view

    def pieces(self, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Tensors of the form of :attr:`tensors` as ones like :meth:`parameters`."""
        views: dict[torch.Tensor, torch.Tensor] = {}
        for parameters, tensor in zip(self._stacks(), tensors, strict=True):
            views |= zip(parameters, tensor.detach(), strict=True)
        return [views[parameter] for parameter in self.parameters()]

    def _stacks(self) -> Iterator[list[nn.Parameter]]:
        """The parameters that are one tensor, for each of :attr:`tensors`."""
        for layers, names in zip(self._layers(), self._names, strict=True):
            for name in names:
                yield [layer.get_parameter(name) for layer in layers]

    def _layers(self) -> Iterator[list[nn.Module]]:
        return itertools.chain.from_iterable(self._equal)

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        """As of any module; afterwards the parameters are in tensors side by side again."""
        result = super()._apply(*args, **kwargs)
        self.changed()
        self.own()
        return result

    def weights(self) -> Weights:
        """The dense matrices of every layer; differentiable with respect to the parameters.

        The result is cached until :meth:`changed` is called, so acting, critic values and the next
        update use the same one. Only one backward pass per expansion: it frees the graph.
        """
        if not self._expanded:
            with torch.enable_grad():
                self._expanded.append(self._expand())
        return self._expanded[0]

    def layers(self) -> Iterator[tuple[nn.Module, Parameters]]:
        """Equal layers of all members as one: the first of them, with the parameters of all.

        With gradients they are differentiable, without they may be changed in place.
        """
        tensors = iter(self.tensors)
        for equal, names in zip(self._layers(), self._names, strict=True):
            yield equal[0], {name: next(tensors) for name in names}

    def changed(self) -> None:
        """Drop the cache. Call this after every change of parameters."""
        self._expanded.clear()

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> Any:
        """As of any module; the cache is dropped."""
        self.changed()
        return super().load_state_dict(state_dict, *args, **kwargs)

    def _expand(self) -> Weights:
        expanded = iter([dense_of(*layer) for layer in self.layers()])
        weights: Weights = []
        for equal in self._equal:
            matrix, bias = next(expanded)
            for more, more_bias in itertools.islice(expanded, len(equal) - 1):
                matrix, bias = torch.cat([matrix, more]), torch.cat([bias, more_bias])
            weights.append((matrix, bias.unsqueeze(1)))
        return weights

    def apply_weights(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """Evaluate with the given matrices: ``[B, in] -> [members, B, out]``."""
        return self.propagate(weights, x.expand(weights[0][0].shape[0], *x.shape))

    def propagate(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """The same with an input for each member: ``[members, B, in] -> [members, B, out]``."""
        if not torch.is_grad_enabled():
            return perceptrons(x, weights, self.layer_norm, self.activation)[0]
        flat = itertools.chain.from_iterable(weights)
        return cast(torch.Tensor, Perceptron.apply(x, self.layer_norm, self.activation, *flat))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, in] -> [members, B, out]``."""
        return self.apply_weights(self.weights(), x)


def perceptrons(
    x: torch.Tensor, weights: Weights, layer_norm: bool, activation: Activation
) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Multilayer perceptrons of equal shape, ``[members, B, in] -> [members, B, out]``.

    Also what their derivative needs: of each hidden layer the sums, the moments of LayerNorm, and
    the features.
    """
    kept = []
    *hidden, (last, bias) = weights
    for matrix, offset in hidden:
        x = torch.baddbmm(offset, x, matrix.mT)
        kept.append(x)
        if layer_norm:
            x, *moments = normalized(x)
            kept += moments
        x = x.relu_() if activation == "relu" else x.tanh_()
        kept.append(x)
    if _is_slow(last):
        return (x * last).sum(-1, keepdim=True) + bias, kept
    return torch.baddbmm(bias, x, last.mT), kept


class Perceptron(torch.autograd.Function):
    """:func:`perceptrons` with a derivative that is written out.

    Autograd of the same operations takes a third longer, most of it in products with a last matrix
    of one row and in copies. There is no second derivative.
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
        matrices, biases = weights[::2], weights[1::2]
        pairs = list(zip(matrices, biases, strict=True))
        out, kept = perceptrons(x, pairs, layer_norm, activation)
        ctx.layer_norm, ctx.activation = layer_norm, activation
        ctx.save_for_backward(x, *matrices, *kept)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Chain rule from the last layer to the first."""
        (gradient,) = gradients
        of_x, _, _, *of_weights = ctx.needs_input_grad
        depth, wanted = len(of_weights) // 2, any(of_weights)
        x, *saved = ctx.saved_tensors
        matrices, kept = saved[:depth], saved[depth:]
        step = 4 if ctx.layer_norm else 2
        single = _is_slow(matrices[-1])
        found: list[torch.Tensor | None] = []
        for index in reversed(range(depth)):
            matrix = matrices[index]
            sums, *moments, seen = kept[(index - 1) * step : index * step] if index else (x, x)
            if not wanted:
                found += [None, None]
            elif single:
                found += [gradient.sum(-2, True), (gradient * seen).sum(-2, True)]
            else:
                found += [gradient.sum(-2, True), torch.bmm(gradient.mT, seen)]
            if index or of_x:
                gradient = gradient * matrix if single else torch.bmm(gradient, matrix)
            single = False
            if index:
                if ctx.activation == "relu":
                    gradient = relu_backward(gradient, seen, 0)
                else:
                    gradient = tanh_backward(gradient, seen)
                if ctx.layer_norm:
                    gradient = layer_norm_backward(
                        gradient, sums, sums.shape[-1:], *moments, None, None, (True, False, False)
                    )[0]
        return (gradient if of_x else None, None, None, *reversed(found))


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
