"""Strict, unless a test during the warm-up says that the world has a direction (ours).

During the warm-up an agent plays the base policy's noise and learns nothing. So its episodes are a
sample of the base policy's own, and in a symmetric world they look the same on all sides. Whether
they do is asked by an exact test (`symsteer.policies.sides`), once, after the last decision of the
warm-up. If opposite sides are unlike with a p-value of at most ``level``, every layer gets a free
path with a penalty, as in ``residual-pathway``. If not, the agent is ``equivariant`` to its end.

It can be wrong in two ways. In a symmetric world it leaves the symmetry with probability ``level``.
And it does not see what has no direction (a weak motor along an axis), nor what the base policy
does not meet (a wall where it never goes).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from symsteer.agents.agent import AgentContext, Budget
from symsteer.agents.asymmetry import PenaltyAgent, PenaltyOptions
from symsteer.agents.episodes import Played
from symsteer.agents.networks import Parameters
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Transition
from symsteer.agents.residual_pathway import ResidualPathway
from symsteer.errors import UserError
from symsteer.policies.networks.equivariant import EquivariantLayer
from symsteer.policies.sides import sides


@dataclass(frozen=True)
class ScreenedOptions(PenaltyOptions):
    """Options of the screened agent; the penalty holds the free paths, if there are any."""

    penalty: float = 30.0
    level: float = 0.01
    """Largest p-value with which the symmetry is given up. 0: never; 1: always."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("lie in [0, 1]", lambda value: 0 <= value <= 1, "level")


class Screened(ResidualPathway):
    """An equivariant layer, with a plain one beside it that counts if it is open."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__(strict)
        # A parameter, because a team stacks parameters; the optimiser leaves it alone.
        self.open = nn.Parameter(torch.zeros(()), requires_grad=False)

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = self.strict_of(parameters)
        opened = parameters["open"].detach().unsqueeze(-1)
        bias = bias + opened * parameters["free.bias"]
        return weight + opened.unsqueeze(-1) * parameters["free.weight"], bias


@defaults_of("minimax")
class ScreenedAgent(PenaltyAgent):
    """Strict where the base policy's episodes look the same on all sides.

    Attributes:
        direction: p-value of the test; None before it.
    """

    name = "screened"
    in_teams = True
    Options = ScreenedOptions
    options: ScreenedOptions
    Layer = Screened

    def __init__(self, context: AgentContext, options: ScreenedOptions | None = None):
        super().__init__(context, options)
        self.direction: float | None = None

    @classmethod
    def check(cls, options: SacOptions, budget: Budget) -> None:
        """Also that the replay holds the warm-up."""
        super().check(options, budget)
        if options.replay_capacity < options.warmup + budget.num_envs:
            raise UserError(
                f"agent.replay_capacity is {options.replay_capacity}, too small for the warm-up of "
                f"{options.warmup} decisions, which are tested; raise it"
            )

    def observe(self, transition: Transition) -> None:
        """Store the decisions; after the last one of the warm-up, test all of them."""
        super().observe(transition)
        if self.direction is None and self.decisions >= self.options.warmup:
            self._screen(len(transition.reward))

    def _screen(self, num_envs: int) -> None:
        kept = self.replay.storage
        fields = ("obs", "actions", "next_obs")
        obs, actions, next_obs = (kept[name][: len(self.replay)] for name in fields)
        # An episode begins where an observation is not the one that the last decision led to.
        begins = torch.ones(len(obs), dtype=torch.int64, device=self.device)
        begins[num_envs:] = (obs[num_envs:] != next_obs[:-num_envs]).any(-1)
        # Environment by environment.
        episodes = begins.view(-1, num_envs).T.flatten().cumsum(0).view(num_envs, -1).T.flatten()
        seen = (self.obs_layout, self.act_layout, obs, actions, next_obs)
        self.direction = sides(*seen, episodes, self._new_generator(2)).direction
        for network in self.networks.values():
            with torch.no_grad():
                for _, parameters in network.layers():
                    parameters["open"].fill_(self.direction <= self.options.level)
            network.changed()

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Also the p-value of the test."""
        return {**super().diagnostics(played), "direction_p": self.direction}

    def state_dict(self) -> dict[str, Any]:
        """Also the p-value."""
        return {**super().state_dict(), "direction": self.direction}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        self.direction = state["direction"]
