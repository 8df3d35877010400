"""Latent policy displacement (LP-DS, arXiv 2606.01151): stay near the noise of the base policy.

The noise is that of the base policy plus a displacement, w = eps + Delta(s) with eps ~ N(0, I), and
the actor maximises Q under the constraint E |Delta|^2 <= delta:

    E[alpha (|Delta(s)|^2 - delta) - min_j Q_j(s, w)],   alpha grows while the constraint is broken.

|Delta|^2 / 2 is the KL divergence of w from the base policy's noise, and invariant under the group.
There is no entropy bonus, no squash and no bound. Evaluations draw eps, too, as the base policy
does; the final one also plays Delta alone (``success_mean``). Our choice: delta is given per number
of the noise, as a share of the variance of eps.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.agents.agent import AgentContext, Deterministic
from symsteer.agents.options import EitherOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.standard import EitherAgent


@dataclass(frozen=True)
class DisplacedOptions(EitherOptions):
    """Options of the displaced agent."""

    displacement: float = 0.25
    """delta: mean squared displacement per number of the noise."""

    agent = "the displaced agent"
    entropy_bonus = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("be positive", lambda value: value > 0, "displacement")


@defaults_of("tuned")
class DisplacedAgent(EitherAgent):
    """Moves the base policy's noise by a displacement whose size is limited."""

    name = "displaced"
    in_teams = True
    Options = DisplacedOptions
    options: DisplacedOptions

    def __init__(self, context: AgentContext, options: DisplacedOptions | None = None):
        super().__init__(context, options)
        # What the learner calls log-probability is |Delta|^2 here, and its entropy -|Delta|^2.
        self.target_entropy = -self.options.displacement * self.noise_layout.dim

    def bank_noise(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """That of the base policy."""
        return self.gaussian_noise(count, generator)

    def alternatives(self) -> dict[str, Deterministic]:
        """The displacement alone."""
        return {"mean": self.mode}

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; it is random even if ``deterministic``."""
        return self.sample(obs)[0] if deterministic else super().act(obs)

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """The displacement ``[B, Tp, Da]``."""
        return self.chunk(self.moments(obs)[0])

    def _sample(
        self, mean: torch.Tensor, log_scale: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return mean + self._eps(mean), mean.square().sum(-1)
