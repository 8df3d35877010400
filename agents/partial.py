"""Partially equivariant SAC (PE-SAC, arXiv 2512.00915): strict where the world is symmetric.

Two predictors of the next state and reward, one equivariant and one plain, are trained on the
replay. Where they disagree, the symmetry is broken, and a gate lambda(s, a) in [0, 1] learns where
this is. It mixes equivariant and plain networks, which have trunks of their own:

    Q = (1 - lambda(s, a)) Q_E + lambda(s, a) Q_N,
    pi proportional to pi_E^(1 - lambda(s)) pi_N^lambda(s),

for Gaussians the product weighted by precision. lambda(s) is the largest lambda(s, a) over sampled
actions. The gates get no gradient of the losses of actor and critics.

Found in the paper: the gate, its loss, both mixtures. Our choices, for they were not found:

- disagreement: d = mean over irrep blocks k of |f_E - f_N|_k^2 c_k / (c_k + c)^2, where c_k is the
  running variance of the change that is predicted (of vectors: its mean square), the reward being
  one more block, and c its mean over blocks: units do not matter, and blocks that never vary do not
  count;
- label: 1 above the fence m + ``fence`` (m - q25) of log d in the batch, else 0; m is the median,
  so that the symmetry may be broken in almost half of the states;
- sampled actions: the bank of decoded noise. A network is trained towards their maximum, so that
  acting needs no samples.

Upper-tail outliers are relative: where the symmetry is broken everywhere alike, nothing stands out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import nn

from symsteer.agents.agent import AgentContext
from symsteer.agents.episodes import Played
from symsteer.agents.equivariant import equivariant_layers
from symsteer.agents.generators import tensor_like
from symsteer.agents.networks import Weights
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Batch
from symsteer.agents.sac import VALUE
from symsteer.agents.standard import StandardAgent
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout

Gate = Literal["hard", "soft"]

START = -3.0
"""Output of untrained gates before the sigmoid: closed, so that the agent starts equivariant."""

MEMORY = 0.99
"""Share of a running mean that an update keeps."""


@dataclass(frozen=True)
class PartialOptions(SacOptions):
    """Options of the partially equivariant agent."""

    gate: Gate = "hard"
    """`hard`: lambda is 0 or 1; `soft`: lambda as predicted."""
    fence: float = 1.5
    """Distance of the fence above the median, in units of that of the first quartile below it."""

    agent = "the partial agent"
    known_critics = ("aliased", "sampler")
    least_bank = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("not be negative", lambda value: value >= 0, "fence")


@defaults_of("tuned")
class PartialAgent(StandardAgent):
    """Equivariant and plain networks, mixed by a gate that sees where the symmetry is broken."""

    name = "partial"
    always_banks = True
    Options = PartialOptions
    options: PartialOptions

    def __init__(self, context: AgentContext, options: PartialOptions | None = None):
        super().__init__(context, options)
        if self.options.critic_kind == "aliased" and context.horizon == context.execute:
            raise UserError(
                "the partial agent cannot tell noise from actions if a whole chunk is executed; "
                "set critic_kind to sampler, or execute less than the horizon"
            )
        following = self.following
        self.blocks = following.block_means.to(self.device, self.dtype)
        reflections = Group.parse(self.options.group).reflections
        self.invariant = following.invariant_mask(reflections).to(self.device, self.dtype)
        self.sizes = torch.ones(self.blocks.shape[1], device=self.device, dtype=self.dtype)

    @property
    def following(self) -> Layout:
        """What is predicted: the change of the observation, and the reward."""
        return Layout([*self.obs_layout.fields, Field("reward", 0)])

    def _members(self) -> dict[str, list[list[nn.Module]]]:
        """Those of actor and critics, both kinds of layers, and of predictors and gates."""
        members, predicted = super()._members(), (self.action_inputs, self.following)
        torch.manual_seed(self.context.seed + 1)
        return members | {
            "strict_predictor": [equivariant_layers(*predicted, self.options)],
            "plain_predictor": [self.layers(*predicted)],
            "gate": [self.layers(self.action_inputs, VALUE)],
            "state_gate": [self.layers(self.obs_layout, VALUE)],
        }

    # The mixtures.

    def share(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """lambda(s, a) ``[B]`` of observations in environment units and ``[B, Ta, Da]``."""
        return self._share(self._features(obs), actions.flatten(-2))

    @torch.no_grad()
    def _share(self, obs: torch.Tensor, judged: torch.Tensor | None) -> torch.Tensor:
        """lambda(s, a), or lambda(s) without actions, as the options say."""
        inputs = obs if judged is None else torch.cat([obs, judged], -1)
        share = self._opening("state_gate" if judged is None else "gate", inputs)
        return (share > 0.5).to(share) if self.options.gate == "hard" else share

    def _opening(self, name: str, inputs: torch.Tensor) -> torch.Tensor:
        """What a gate predicts, in (0, 1)."""
        return (self.networks[name](inputs)[..., 0, :, 0] + START).sigmoid()

    def _actors(self) -> list[list[nn.Module]]:
        how = (self.actor_inputs, self.actor_layout, self.options, self.options.initial_output)
        return [equivariant_layers(*how), self.actor_layers()]

    def _critics(self, inputs: Layout) -> list[list[nn.Module]]:
        count = range(self.options.critics)
        strict = [equivariant_layers(inputs, VALUE, self.options) for _ in count]
        return strict + super()._critics(inputs)

    def _heads(self, policy: Weights, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        outputs = self.actor.apply_weights(policy, obs).unbind(-3)
        both = map(self.distribution.parameters_of, outputs)
        (strict, strict_log), (plain, plain_log) = both
        share = self._share(obs, None).unsqueeze(-1)
        strict_precision = (1 - share) * (-2 * strict_log).exp()
        plain_precision = share * (-2 * plain_log).exp()
        precision = strict_precision + plain_precision
        spread = self.distribution.spread
        mean = strict * spread(strict_precision / precision)
        mean = mean + plain * spread(plain_precision / precision)
        return mean, -0.5 * precision.log()

    def _q(self, critics: Weights, obs: torch.Tensor, judged: torch.Tensor) -> torch.Tensor:
        strict, plain = super()._q(critics, obs, judged).chunk(2, dim=-2)
        is_noise = judged.shape[-1] != self.action_inputs.dim - self.obs_layout.dim
        share = self._share(obs, None if is_noise else judged).unsqueeze(-2)
        return (1 - share) * strict + share * plain

    # Where the symmetry is broken.

    def after_update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step of predictors and gates."""
        obs, next_obs = self._features(batch.obs), self._features(batch.next_obs)
        inputs = torch.cat([obs, batch.actions.flatten(-2)], -1)
        reward = self.options.reward_scale * batch.reward.unsqueeze(-1)
        wanted = torch.cat([next_obs - obs, reward], -1)
        # The first update has nothing to remember.
        share = 1 - MEMORY if self.updates > 1 else 1.0
        centred = wanted - wanted.mean(0) * self.invariant
        self.sizes.lerp_((centred.square() @ self.blocks).mean(0), share)
        predictions = []
        for name in ("strict_predictor", "plain_predictor"):
            prediction = self.networks[name](inputs)[0]
            self._descend(name, self._distance(prediction, wanted).mean(), batch)
            predictions.append(prediction.detach())
        disagreement = self._distance(*predictions)
        label = self._outlying(disagreement.log())
        opening = self._opening("gate", inputs)
        self._descend("gate", F.binary_cross_entropy(opening, label), batch)
        banked = batch["bank_actions"].flatten(-2)
        repeated = obs.unsqueeze(1).expand(-1, banked.shape[1], -1)
        with torch.no_grad():
            each = self._opening("gate", torch.cat([repeated, banked], -1).flatten(0, 1))
            highest = each.view(banked.shape[:2]).amax(1)
        gap = (self._opening("state_gate", obs) - highest).square().mean()
        self._descend("state_gate", gap, batch)
        return {
            "train/disagreement": disagreement.mean(),
            "train/gate": opening.detach().mean(),
        }

    def _outlying(self, size: torch.Tensor) -> torch.Tensor:
        """1 above the fence, else 0, ``[B]``."""
        low, middle = torch.quantile(
            size, torch.tensor([0.25, 0.5], device=self.device, dtype=self.dtype)
        )
        return (size > middle + self.options.fence * (middle - low)).to(self.dtype)

    def _distance(self, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """d ``[B]`` of two predictions ``[B, dim]``."""
        apart = (one - other).square() @ self.blocks
        # About 1 / c_k for a block that varies much, 0 for one that never does.
        weights = self.sizes / (self.sizes + self.sizes.mean()).square()
        return (apart * weights).mean(-1).clamp(min=1e-12)

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Also the mean of lambda(s) on the states that were visited."""
        obs = played.greedy.obs[played.greedy.running]
        share = self._share(self._features(obs), None)
        return {**super().diagnostics(played), "gate": share.mean().item()}

    def state_dict(self) -> dict[str, Any]:
        """Also the running mean squares."""
        return {**super().state_dict(), "sizes": self.sizes.clone()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        self.sizes.copy_(tensor_like(state["sizes"], self.sizes))
