"""Agents with plain or equivariant layers: what they add to the learner works with both."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from torch import nn

from symsteer.agents.equivariant import equivariant_actor_layers, equivariant_critic_layers
from symsteer.agents.options import SacOptions
from symsteer.agents.standard import StandardAgent
from symsteer.names import check
from symsteer.policies.geometry import Layout

Layers = Literal["plain", "equivariant"]


@dataclass(frozen=True)
class EitherOptions(SacOptions):
    """Options of agents with plain or equivariant layers."""

    layers: Layers = "plain"
    """Layers of actor and critics: those of `standard`, or those of `equivariant`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check("layers", [self.layers], get_args(Layers))


class EitherAgent(StandardAgent):
    """The layers that the options say."""

    Options = EitherOptions
    options: EitherOptions

    def actor_layers(self) -> list[nn.Module]:
        if self.options.layers == "equivariant":
            return equivariant_actor_layers(self)
        return super().actor_layers()

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        if self.options.layers == "equivariant":
            return equivariant_critic_layers(self, inputs)
        return super().critic_layers(inputs)
