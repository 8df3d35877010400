"""Best of n: critics choose among chunks of the base policy; nothing else is learned.

In each decision n noises are drawn from N(0, I) and decoded, and the chunk whose executed actions
have the largest Q is played, as in IDQL (arXiv 2304.10573). The critics' target follows the same
choice, as in Q-chunking (arXiv 2507.07969):

    y = R + gamma (1 - d) max_i min_j Qbar_j(s', a'_i),   a'_i = decode(s', w_i).

The candidates of the next state are decoded once, when a decision is stored. There is no actor, so
that nothing can leave what the base policy does; with one candidate it is the base policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from symsteer.agents.agent import AgentContext
from symsteer.agents.episodes import Played
from symsteer.agents.options import CriticKind, EitherOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Batch
from symsteer.agents.sac import Drawn
from symsteer.agents.standard import EitherAgent


@dataclass(frozen=True)
class BestOfNOptions(EitherOptions):
    """Options of best of n."""

    critic_kind: CriticKind = "sampler"
    """`sampler`: critics of the executed actions; this agent knows no other ones."""
    noise_bank: int = 8
    """n: chunks to choose from, in a decision and in the critics' target."""

    agent = "best-of-n"
    known_critics = ("sampler",)
    least_bank = 1
    entropy_bonus = False


@defaults_of("tuned")
class BestOfNAgent(EitherAgent):
    """Plays the best of n chunks of the base policy, by its critics."""

    name = "best-of-n"
    in_teams = True
    always_banks = True
    bank_at = "next_obs"
    Options = BestOfNOptions
    options: BestOfNOptions

    def __init__(self, context: AgentContext, options: BestOfNOptions | None = None):
        super().__init__(context, options)
        self.multipliers = {}

    def _members(self) -> dict[str, list[list[nn.Module]]]:
        """Those of the critics."""
        return {"critic": super()._members()["critic"]}

    @property
    def alpha(self) -> torch.Tensor:
        """There is no entropy bonus."""
        return torch.zeros((), device=self.device, dtype=self.dtype)

    def bank_noise(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """The candidates."""
        return self.gaussian_noise(count, generator)

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; candidates are random even if ``deterministic``."""
        return self.mode(obs) if deterministic else super().act(obs)

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The same; there is no log-probability, and it is given as 0."""
        noise = self.mode(obs)
        return noise, noise.new_zeros(len(noise))

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """The best of n new noises, ``[B, Tp, Da]``."""
        size = self.options.noise_bank
        noise = self.gaussian_noise(size * len(obs))
        repeated = obs.repeat_interleave(size, 0)
        q = self.reduced(self.q_values(repeated, noise)).view(len(obs), size)
        states = torch.arange(len(obs), device=self.device)
        return noise.unflatten(0, (len(obs), size))[states, q.argmax(1)]

    def drawn(self, obs: torch.Tensor, features: torch.Tensor) -> Drawn:
        """Nothing is drawn: the candidates are in the batch."""
        nothing = features[..., :0]
        return Drawn(features, nothing, nothing, lambda: nothing)

    def critic_target(self, batch: Batch, following: Drawn) -> torch.Tensor:
        """The target with the best candidate, ``[B]``."""
        actions = batch["bank_actions"].flatten(-2)
        size = actions.shape[-2]
        features = following.obs.unsqueeze(-2).expand(*actions.shape[:-1], -1)
        q = self.reduced(self._q(self.target, features.flatten(-3, -2), actions.flatten(-3, -2)))
        return self.backed_up(batch, q.unflatten(-1, (-1, size)).amax(-1))

    def _improve(self, *update: Any) -> dict[str, torch.Tensor]:
        return {}

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Those of the critics; an actor's are not measured."""
        absent = ("alpha", "entropy", "saturated", "equivariance_actor", "mode_norm")
        return {**super().diagnostics(played), **dict.fromkeys(absent)}
