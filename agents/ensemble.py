"""Equivariant ensembles (arXiv 2403.12856): plain networks, averaged over the group.

The actor's parameters and the critics' values are means over all turned copies of the input,

    mu(s) = mean_g g^-1 f(g s),     Q(s, w) = mean_g q(g s, g w),

so that the actor is equivariant and the critics are invariant, with any network inside. The copies
need not agree. Two regularisers of the paper make them agree more:

    actor:   mean_g KL(pi_g || pi) + KL(pi || pi_g),     critics:   mean_g (q_g - Q)^2,

without gradient in pi and Q. An update costs |G| times the products of `standard`.
:func:`symsteer.policies.geometry.group_average` does the same to any function.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.agents.networks import Weights
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Batch
from symsteer.agents.standard import StandardAgent
from symsteer.policies.geometry import Group, Layout


@dataclass(frozen=True)
class GroupEnsembleOptions(SacOptions):
    """Options of equivariant ensembles."""

    actor_regularizer: float = 0.01
    """Weight of the divergence between the actor's copies and their mean."""
    critic_regularizer: float = 0.01
    """Weight of the variance of the critics' copies."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(
            "not be negative", lambda value: value >= 0, "actor_regularizer", "critic_regularizer"
        )


@defaults_of("tuned")
class GroupEnsembleAgent(StandardAgent):
    """Plain networks whose outputs are averaged over the group."""

    name = "ensemble"
    in_teams = True
    Options = GroupEnsembleOptions
    options: GroupEnsembleOptions

    @property
    def symmetry(self) -> Group:
        """The group whose copies are averaged."""
        return Group.parse(self.options.group)

    def penalty(self, name: str, batch: Batch) -> torch.Tensor | None:
        """The regularisers, at the states and actions of the batch."""
        obs = self._features(batch.obs)
        if name == "actor" and self.options.actor_regularizer:
            outputs = self._copies_of_output(self.actor.weights(), obs)
            gap = self._divergence(outputs, outputs.detach().mean(-3, keepdim=True))
            return self.options.actor_regularizer * gap.mean((-2, -1))
        if name == "critic" and self.options.critic_regularizer:
            q = self._copies_of_q(self.critic.weights(), obs, self._stored(batch))
            gap = (q - q.detach().mean(-2, keepdim=True)).square().mean((-2, -1))
            return self.options.critic_regularizer * gap.sum(-1)
        return None

    def _actor_output(self, policy: Weights, obs: torch.Tensor) -> torch.Tensor:
        return self._copies_of_output(policy, obs).mean(-3)

    def _q(self, critics: Weights, obs: torch.Tensor, judged: torch.Tensor) -> torch.Tensor:
        return self._copies_of_q(critics, obs, judged).mean(-2)

    def _copies_of_output(self, policy: Weights, obs: torch.Tensor) -> torch.Tensor:
        """What every copy of ``obs [B, obs_dim]`` gives, turned back, ``[|G|, B, dim]``."""
        turned = self._turned(self.obs_layout, obs)
        out = super()._actor_output(policy, turned.flatten(-3, -2))
        rho = self.symmetry.representation(self.actor_layout, self.dtype, self.device)
        return torch.einsum("gij,...gbi->...gbj", rho, out.unflatten(-2, turned.shape[-3:-1]))

    def _copies_of_q(
        self, critics: Weights, obs: torch.Tensor, judged: torch.Tensor
    ) -> torch.Tensor:
        """Values of every copy, ``[critics, |G|, B]``."""
        chunk = self.act_layout.repeat(judged.shape[-1] // self.act_layout.dim)
        turned = self._turned(self.obs_layout, obs), self._turned(chunk, judged)
        q = super()._q(critics, *(x.flatten(-3, -2) for x in turned))
        return q.unflatten(-1, turned[0].shape[-3:-1])

    def _turned(self, layout: Layout, x: torch.Tensor) -> torch.Tensor:
        """Every turned copy of ``x [B, dim]``, ``[|G|, B, dim]``."""
        rho = self.symmetry.representation(layout, self.dtype, self.device)
        return torch.einsum("gij,...bj->...gbi", rho, x)

    def _divergence(self, outputs: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """KL(p || q) + KL(q || p) of the Gaussians before the squash, sum over their numbers."""
        gaussian = self.distribution
        mean, log_scale = gaussian.parameters_of(outputs)
        other, other_log = gaussian.parameters_of(others)
        ratio = 2 * (log_scale - other_log)
        precision = (-2 * log_scale).exp() + (-2 * other_log).exp()
        apart = (mean - other).square() @ gaussian.membership
        spread = gaussian.sizes * (ratio.exp() + (-ratio).exp() - 2)
        return 0.5 * (spread + apart * precision).sum(-1)
