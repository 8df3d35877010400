"""A bounded correction of the executed chunk on top of the frozen policy.

The base policy draws its noise from N(0, I). The actor sees the observation and the chunk that this
noise is decoded to, and adds a correction:

    a = clip(decode(s, eps) + bound r),   r ~ pi(. | s, decode(s, eps)),

with |r| <= 1 for each irrep block, so that the bound is radial and commutes with the group. The
critics judge executed actions, as in Policy Decorator (arXiv 2412.13630). Our choices: its actor
sees the observation alone, and it plays the correction with a probability that grows; here the
bound grows (``ramp``). An action of this agent has the rows of the noise, then those of r:
``[Tp + Ta, Da]``. What the learner calls noise of the actor is r.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.agents.agent import AgentContext
from symsteer.agents.distributions import SquashedGaussian
from symsteer.agents.options import CriticKind, EitherOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Batch
from symsteer.agents.sac import Drawn
from symsteer.agents.standard import EitherAgent
from symsteer.policies.geometry import Layout
from symsteer.policies.normalizer import clip_blocks


@dataclass(frozen=True)
class ResidualOptions(EitherOptions):
    """Options of the residual agent."""

    critic_kind: CriticKind = "sampler"
    """`sampler`: critics of the executed actions; this agent knows no other ones."""
    residual_bound: float = 0.2
    """Largest norm of an irrep block of the correction; the actions of the policy have norm 1 at
    most."""
    ramp: int = 0
    """Decisions over which the bound grows from 0."""

    agent = "the residual agent"
    known_critics = ("sampler",)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("lie in (0, 2]", lambda value: 0 < value <= 2, "residual_bound")
        self._require("not be negative", lambda value: value >= 0, "ramp")


@defaults_of("tuned")
class ResidualAgent(EitherAgent):
    """Corrects the actions of the base policy, within a bound."""

    name = "residual"
    in_teams = True
    always_banks = True
    Options = ResidualOptions
    options: ResidualOptions

    def __init__(self, context: AgentContext, options: ResidualOptions | None = None):
        super().__init__(context, options)
        self.distribution = SquashedGaussian(self.noise_layout, 1.0).to(self.device, self.dtype)

    @staticmethod
    def action_rows(context: AgentContext) -> int:
        """The noise, and a correction of each executed action."""
        return context.horizon + context.execute

    @property
    def drawn_rows(self) -> int:
        """The correction."""
        return self.context.execute

    @property
    def actor_inputs(self) -> Layout:
        """The observation and the executed part of the base policy's chunk."""
        return self.action_inputs

    @property
    def in_graphs(self) -> bool:
        """Not while the bound grows: it is a number of the processor."""
        return super().in_graphs and not self.options.ramp

    @property
    def bound(self) -> float:
        """The bound of the correction now."""
        ramp = self.options.ramp
        share = min(1.0, self.decisions / ramp) if ramp else 1.0
        return self.options.residual_bound * share

    def decode(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """The base policy's chunks with corrected executed actions, ``[B, Tp, Da]``."""
        chunk = self.context.decode(obs, action[..., : self.context.horizon, :])
        executed, rest = chunk.tensor_split([self.context.execute], dim=-2)
        correction = action[..., self.context.horizon :, :]
        return torch.cat([self.corrected(executed, correction), rest], -2)

    def corrected(self, actions: torch.Tensor, correction: torch.Tensor) -> torch.Tensor:
        """Actions ``[..., Ta, Da]`` plus a correction of the same shape, within norm 1."""
        return clip_blocks(actions + self.bound * correction, self.act_layout, 1.0)

    def gaussian_noise(self, count: int, generator: torch.Generator | None = None) -> torch.Tensor:
        """Actions of the base policy ``[count, Tp + Ta, Da]``: the correction is 0."""
        noise = super().gaussian_noise(count, generator)
        noise[:, self.context.horizon :].zero_()
        return noise

    def bank_noise(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """The actor is trained at banked actions of the base policy."""
        return self.gaussian_noise(count, generator)

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Actions ``[B, Tp + Ta, Da]``; their noise is random even if ``deterministic``."""
        if deterministic:
            return self._with_mean(obs, self.gaussian_noise(len(obs)))
        return super().act(obs)

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """The correction of what noise 0 is decoded to, ``[B, Tp + Ta, Da]``."""
        shape = (len(obs), self.rows, self.act_layout.dim)
        return self._with_mean(obs, torch.zeros(shape, device=self.device, dtype=self.dtype))

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions with a drawn correction, and the log-probability of the correction."""
        action = self.gaussian_noise(len(obs))
        drawn = self._corrections(self._features(obs), self._base_actions(obs, action))
        return self._with(action, drawn.noise), drawn.log_prob

    def _with_mean(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        inputs = self._inputs(self._features(obs), self._base_actions(obs, action))
        mean, _ = self._heads(self.actor.weights(), inputs)
        return self._with(action, self.distribution.squash(mean))

    def _with(self, action: torch.Tensor, correction: torch.Tensor) -> torch.Tensor:
        action[:, self.context.horizon :] = self.chunk(correction)
        return action

    # Learning.

    def drawn(self, obs: torch.Tensor, features: torch.Tensor) -> Drawn:
        """Corrections that the actor draws at observations."""
        count = obs.shape[-2]
        noise = self.random(lambda generator: self.gaussian_noise(count, generator))
        return self._corrections(features, self._base_actions(obs, noise))

    def drawn_to_improve(self, batch: Batch) -> Drawn:
        """Corrections of actions of the base policy that were decoded before."""
        return self._corrections(batch.features, self.chunk(self._random_pairs(batch)[1]))

    def _corrections(self, features: torch.Tensor, actions: torch.Tensor) -> Drawn:
        """The actor's corrections of actions ``[..., Ta, Da]``."""
        heads = self._heads(self.actor.weights(), self._inputs(features, actions))
        correction, log_prob = self._sample(*heads)
        judged = self.corrected(actions, self.chunk(correction)).flatten(-2)
        return Drawn(features, correction, log_prob, lambda: judged)

    def _inputs(self, features: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return torch.cat([features, actions.flatten(-2)], -1)

    def _base_actions(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """The executed actions ``[..., Ta, Da]`` that the noise of an action is decoded to."""
        chunk = self.context.decode(obs, action[..., : self.context.horizon, :])
        return chunk[..., : self.context.execute, :]
