"""The standard agent: plain perceptrons without symmetry, as in DSRL."""

from __future__ import annotations

import itertools

from torch import nn

from symsteer.agents.equivariant import equivariant_layers
from symsteer.agents.networks import Dense, count, shrink_
from symsteer.agents.options import EitherOptions, SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.sac import SacAgent
from symsteer.policies.geometry import Layout


@defaults_of("minimax")
class StandardAgent(SacAgent):
    """SAC with a plain actor and plain critics."""

    name = "standard"
    in_teams = True

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        width = self.width_of(inputs, outputs)
        return plain_layers(inputs, outputs, self.options, scale, width)

    def width_of(self, inputs: Layout, outputs: Layout) -> int:
        """Hidden features of a network."""
        return self.options.width


def plain_layers(
    inputs: Layout,
    outputs: Layout,
    options: SacOptions,
    scale: float = 1.0,
    width: int | None = None,
) -> list[nn.Module]:
    """``depth`` hidden layers of equal width, by default that of the options, and an output layer.

    The parameters of the output layer are multiplied by ``scale``.
    """
    sizes = [inputs.dim, *[width or options.width] * options.depth, outputs.dim]
    layers: list[nn.Module] = [Dense(a, b) for a, b in itertools.pairwise(sizes)]
    shrink_(layers[-1], scale)
    return layers


@defaults_of("minimax")
class MatchedStandardAgent(StandardAgent):
    """The standard agent with as many parameters as the equivariant one.

    At equal width, plain hidden layers have |G| times the parameters of equivariant ones. This
    agent separates the effect of symmetry from that of size. Actor and critics are matched
    separately.
    """

    name = "standard-matched"
    in_teams = True

    def width_of(self, inputs: Layout, outputs: Layout) -> int:
        """That with which plain layers have about as many parameters as equivariant ones."""
        wanted = count(nn.ModuleList(equivariant_layers(inputs, outputs, self.options)))
        depth = self.options.depth

        def size(width: int) -> int:
            hidden = (depth - 1) * (width + 1) * width
            return (inputs.dim + 1) * width + hidden + (width + 1) * outputs.dim

        width = 1
        while size(width + 1) <= wanted:
            width += 1
        return min(width, width + 1, key=lambda w: abs(size(w) - wanted))


class EitherAgent(StandardAgent):
    """Plain or equivariant layers, as the options say: what is added to them works with both."""

    Options = EitherOptions
    options: EitherOptions

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        if self.options.layers == "equivariant":
            return equivariant_layers(inputs, outputs, self.options, scale)
        return super().layers(inputs, outputs, scale)
