"""The standard agent: plain perceptrons without symmetry, as in DSRL."""

from __future__ import annotations

import itertools

from torch import nn

from symsteer.agents.equivariant import equivariant_layers
from symsteer.agents.networks import Dense, count, shrink_
from symsteer.agents.options import EitherOptions
from symsteer.agents.presets import tuned
from symsteer.agents.sac import SacAgent
from symsteer.policies.geometry import Layout


@tuned
class StandardAgent(SacAgent):
    """SAC with a plain actor and plain critics."""

    name = "standard"
    in_teams = True

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        width = self.width_of(inputs, outputs)
        layers = plain_layers(inputs.dim, width, self.options.depth, outputs.dim)
        shrink_(layers[-1], scale)
        return layers

    def width_of(self, inputs: Layout, outputs: Layout) -> int:
        """Hidden features of a network."""
        return self.options.width


@tuned
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


def plain_layers(inputs: int, width: int, depth: int, outputs: int) -> list[nn.Module]:
    """``depth`` hidden layers of ``width`` and an output layer."""
    sizes = [inputs, *[width] * depth, outputs]
    return [Dense(a, b) for a, b in itertools.pairwise(sizes)]
