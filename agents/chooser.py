"""A strict and a plain actor on one replay; the critics choose between what both would do.

In each decision both actors draw noise, both chunks are decoded, and the one with the larger Q is
executed (EXPO, arXiv 2507.07986, where one actor is an imitation policy; PEX, arXiv 2302.00935).
The critics' target follows the same choice,

    y = R + gamma (1 - d) max_i Qbar(s', decode(s', w_i)),   w_i drawn from actor i.

Each actor climbs the critics by itself, and they share one temperature. Plain critics cost steps
where the world is symmetric, and strict ones cannot tell where it is not: the critics are those of
``slow``. With one kind of actor the agent is this actor with the critics of ``slow``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import nn

from symsteer.agents.equivariant import equivariant_layers
from symsteer.agents.networks import Weights
from symsteer.agents.presets import tuned
from symsteer.agents.replay import Batch
from symsteer.agents.sac import Drawn
from symsteer.agents.slow import SlowAgent, SlowOptions
from symsteer.agents.standard import plain_layers

Actors = Literal["both", "strict", "plain"]


@dataclass(frozen=True)
class ChooserOptions(SlowOptions):
    """Options of the chooser."""

    actors: Actors = "both"
    """Who makes proposals."""


@tuned
class ChooserAgent(SlowAgent):
    """Executes the better of what a strict and a plain actor propose, by slow critics."""

    name = "chooser"
    Options = ChooserOptions
    options: ChooserOptions

    def _actors(self) -> list[list[nn.Module]]:
        how = (self.actor_inputs, self.actor_layout, self.options, self.options.initial_output)
        kinds = {"strict": equivariant_layers, "plain": plain_layers}
        return [kinds[k](*how) for k in kinds if self.options.actors in (k, "both")]

    @property
    def proposals(self) -> int:
        """Proposals for each decision."""
        return len(self.actor.members)

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """The better one of the actors' means."""
        noise = self.chunk(self.distribution.squash(self.moments(obs)[0]))
        return self._best(obs, noise)[0]

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The better one of a draw from each actor, and its log-probability for this actor."""
        noise, log_prob = self._sample(*self.moments(obs))
        chosen, log_prob = self._best(obs, self.chunk(noise), log_prob)
        return chosen, log_prob

    def _best(self, obs: torch.Tensor, *proposed: torch.Tensor) -> list[torch.Tensor]:
        """For each state the rows of the proposal with the largest Q; noise is the first tensor."""
        q = self.reduced(self.q_values(self._repeated(obs), proposed[0]))
        choice = q.unflatten(-1, (-1, len(obs))).argmax(0)
        states = torch.arange(len(obs), device=self.device)
        return [x.unflatten(0, (-1, len(obs)))[choice, states] for x in proposed]

    def critic_target(self, batch: Batch, following: Drawn) -> torch.Tensor:
        """The target with the better proposal, ``[B]``."""
        next_q = self.reduced(self._q(self.target, following.obs, following.judged))
        if self.options.soft_backup:
            next_q = next_q - self.alpha.unsqueeze(-1) * following.log_prob
        return self.backed_up(batch, next_q.unflatten(-1, (self.proposals, -1)).amax(-2))

    def drawn(self, obs: torch.Tensor, features: torch.Tensor) -> Drawn:
        """Proposals of the first actor for all states, then those of the other one."""
        noise, log_prob = self._sample(*self._heads(self.actor.weights(), features))
        repeated = self._repeated(features)
        return Drawn(repeated, noise, log_prob, lambda: self.judged(self._repeated(obs), noise))

    def _repeated(self, x: torch.Tensor) -> torch.Tensor:
        """Rows ``[B, dim]`` once for each actor."""
        return torch.cat([x] * self.proposals, -2)

    def _actor_output(self, policy: Weights, obs: torch.Tensor) -> torch.Tensor:
        return self.actor.apply_weights(policy, obs).flatten(-3, -2)
