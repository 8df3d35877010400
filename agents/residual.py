"""A bounded correction of the executed chunk on top of the frozen policy.

The base policy draws its noise from N(0, I). The actor sees the observation and the chunk that this
noise is decoded to, and adds a correction:

    a = clip(decode(s, eps) + bound r),   r ~ pi(. | s, decode(s, eps)),

with |r| <= 1 for each irrep block, so that the bound is radial and commutes with the group. The
critics judge executed actions, as in Policy Decorator (arXiv 2412.13630). Our choices: its actor
sees the observation alone, and it plays the correction with a probability that grows; here the
bound grows (``ramp``). An action of this agent has the rows of the noise, then those of r:
``[Tp + Ta, Da]``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.agents.agent import AgentContext
from symsteer.agents.distributions import SquashedGaussian
from symsteer.agents.either import EitherAgent, EitherOptions
from symsteer.agents.networks import Weights
from symsteer.agents.options import Critic, NoiseSource
from symsteer.agents.presets import tuned
from symsteer.agents.replay import Batch
from symsteer.agents.sac import Drawn
from symsteer.errors import UserError
from symsteer.policies.geometry import Layout
from symsteer.policies.normalizer import clip_blocks


@dataclass(frozen=True)
class ResidualOptions(EitherOptions):
    """Options of the residual agent."""

    critic: Critic = "sampler"
    """`sampler`: critics of the executed actions; this agent knows no other ones."""
    residual_bound: float = 0.2
    """Largest norm of an irrep block of the correction; the actions of the policy have norm 1 at
    most."""
    ramp: int = 0
    """Decisions over which the bound grows from 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.critic != "sampler":
            raise UserError(
                "the residual agent judges executed actions: its critic is sampler, not "
                f"{self.critic}"
            )
        self._require("lie in (0, 2]", lambda value: 0 < value <= 2, "residual_bound")
        self._require("not be negative", lambda value: value >= 0, "ramp")


@tuned
class ResidualAgent(EitherAgent):
    """Corrects the actions of the base policy, within a bound."""

    name = "residual"
    in_teams = True
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
    def keeps_bank(self) -> bool:
        """The actor is trained at banked actions of the base policy."""
        return True

    @property
    def _bank_source(self) -> NoiseSource:
        return "gaussian"

    @property
    def drawn_rows(self) -> int:
        """The correction."""
        return self.context.execute

    @property
    def actor_inputs(self) -> Layout:
        """The observation and the executed part of the base policy's chunk."""
        return self.action_inputs

    def drawn_part(self, action: torch.Tensor) -> torch.Tensor:
        """The correction ``[B, Ta * Da]``."""
        return action[:, self.context.horizon :].flatten(1)

    @property
    def bound(self) -> float:
        """The bound of the correction now."""
        ramp = self.options.ramp
        share = min(1.0, self.decisions / ramp) if ramp else 1.0
        return self.options.residual_bound * share

    def decode(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """The base policy's chunks with corrected executed actions, ``[B, Tp, Da]``."""
        chunk = self.context.decode(obs, action[..., : self.context.horizon, :])
        first, rest = chunk.split(
            [self.context.execute, self.context.horizon - self.context.execute], dim=-2
        )
        return torch.cat([self.corrected(first, action[..., self.context.horizon :, :]), rest], -2)

    def corrected(self, actions: torch.Tensor, correction: torch.Tensor) -> torch.Tensor:
        """Actions ``[..., Ta, Da]`` plus a correction of the same shape, within norm 1."""
        return clip_blocks(actions + self.bound * correction, self.act_layout, 1.0)

    def gaussian_noise(self, count: int, generator: torch.Generator | None = None) -> torch.Tensor:
        """Actions of the base policy ``[count, Tp + Ta, Da]``: the correction is 0."""
        noise = super().gaussian_noise(count, generator)
        noise[:, self.context.horizon :] = 0
        return noise

    def random_noise(
        self, source: NoiseSource, count: int, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        """The same; with ``squashed`` the correction is random, too."""
        noise = super().gaussian_noise(count, generator)
        squashed = self.distribution.squash(self.drawn_part(noise))
        return self._with(noise, squashed if source == "squashed" else 0 * squashed)

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Actions ``[B, Tp + Ta, Da]``; their noise is random even if ``deterministic``."""
        if not deterministic:
            return super().act(obs)
        action = self.gaussian_noise(len(obs))
        return self._with(action, self.distribution.mode(self._moments(obs, action)[0]))

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """The correction of what noise 0 is decoded to, ``[B, Tp + Ta, Da]``."""
        shape = (len(obs), self.rows, self.act_layout.dim)
        action = torch.zeros(shape, device=self.device, dtype=self.dtype)
        return self._with(action, self.distribution.mode(self._moments(obs, action)[0]))

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions with a drawn correction, and the log-probability of the correction."""
        action = self.gaussian_noise(len(obs))
        correction, log_prob = self._sample(*self._moments(obs, action))
        return self._with(action, correction), log_prob

    # Learning.

    def drawn(self, obs: torch.Tensor) -> Drawn:
        """Corrections that the actor draws at observations in environment units."""
        count = obs.shape[-2]
        noise = self.random(lambda generator: self.gaussian_noise(count, generator))
        return self._corrected(obs, self._base_actions(obs, noise))

    def _improve(self, batch: Batch, obs: torch.Tensor, judge: Weights) -> dict[str, torch.Tensor]:
        """One step of the actor at actions of the base policy that were decoded before."""
        _, actions = self._random_pairs(batch)
        drawn = self._corrected(batch.obs, self.chunk(actions))
        values = self._q(judge, obs, drawn.judged)
        return self._climb(values, drawn.noise, drawn.log_prob, batch)

    def _corrected(self, obs: torch.Tensor, actions: torch.Tensor) -> Drawn:
        """The actor's corrections of actions ``[..., Ta, Da]``."""
        features = self._features(obs)
        inputs = torch.cat([features, actions.flatten(-2)], -1)
        correction, log_prob = self._sample(*self._heads(self.actor.weights(), inputs))
        judged = self.corrected(actions, self.chunk(correction)).flatten(-2)
        return Drawn(features, correction, log_prob, judged)

    # Inner parts.

    def _base_actions(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """The executed actions ``[..., Ta, Da]`` that the noise of an action is decoded to."""
        chunk = self.context.decode(obs, action[..., : self.context.horizon, :])
        return chunk[..., : self.context.execute, :]

    def _moments(
        self, obs: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        actions = self._base_actions(obs, action).flatten(1)
        inputs = torch.cat([self._features(obs), actions], -1)
        return self._heads(self.actor.weights(), inputs)

    def _with(self, action: torch.Tensor, correction: torch.Tensor) -> torch.Tensor:
        action[:, self.context.horizon :] = self.chunk(correction)
        return action
