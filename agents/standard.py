"""The standard agent: plain perceptrons without symmetry, as in DSRL."""

from __future__ import annotations

import itertools

from torch import nn

from symsteer.agents.equivariant import equivariant_actor_layers, equivariant_critic_layers
from symsteer.agents.networks import Dense, count, shrink_
from symsteer.agents.presets import tuned
from symsteer.agents.sac import SacAgent
from symsteer.policies.geometry import Layout


@tuned
class StandardAgent(SacAgent):
    """SAC with a plain actor and plain critics."""

    name = "standard"
    in_teams = True

    def actor_layers(self) -> list[nn.Module]:
        layers = plain_layers(
            self.actor_inputs.dim, self.actor_width(), self.options.depth, self.actor_layout.dim
        )
        shrink_(layers[-1], self.options.initial_output)
        return layers

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        return plain_layers(inputs.dim, self.critic_width(inputs), self.options.depth, 1)

    def actor_width(self) -> int:
        """Hidden features of the actor."""
        return self.options.width

    def critic_width(self, inputs: Layout) -> int:
        """Hidden features of each critic of ``inputs``."""
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

    def actor_width(self) -> int:
        rival = nn.ModuleList(equivariant_actor_layers(self))
        return matched_width(
            count(rival), self.actor_inputs.dim, self.options.depth, self.actor_layout.dim
        )

    def critic_width(self, inputs: Layout) -> int:
        rival = nn.ModuleList(equivariant_critic_layers(self, inputs))
        return matched_width(count(rival), inputs.dim, self.options.depth, 1)


def plain_layers(inputs: int, width: int, depth: int, outputs: int) -> list[nn.Module]:
    """``depth`` hidden layers of ``width`` and an output layer."""
    sizes = [inputs, *[width] * depth, outputs]
    return [Dense(a, b) for a, b in itertools.pairwise(sizes)]


def matched_width(parameters: int, inputs: int, depth: int, outputs: int) -> int:
    """The width with which ``plain_layers`` has about the given number of parameters."""

    def size(width: int) -> int:
        hidden = (depth - 1) * (width + 1) * width
        return (inputs + 1) * width + hidden + (width + 1) * outputs

    width = 1
    while size(width + 1) <= parameters:
        width += 1
    return min(width, width + 1, key=lambda w: abs(size(w) - parameters))
