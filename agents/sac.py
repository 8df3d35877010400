"""Soft actor-critic in the latent noise of a frozen diffusion policy: the core of every agent.

After Haarnoja et al., arXiv 1812.05905, as used for steering by DSRL, arXiv 2506.15799. An action
is the whole noise chunk ``w [Tp, Da]``; a step is one decision of the latent-noise environment.
Agents differ only in where the matrices of their networks come from (``actor_layers``,
``critic_layers``) and in how those are penalised (``parameter_groups``). Deviations from the
paper, numbered as in ``docs/agents.md``:

1. the squash is radial, one scale per irrep block (``distributions.py``);
2. the target carries no entropy bonus unless ``soft_backup`` (hard backup);
3. time-outs bootstrap; only success is terminal;
4. LayerNorm in actor and critics; the actor's output layer starts small.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import nn

from symsteer.agents.distributions import SquashedGaussian
from symsteer.agents.networks import Ensemble, Weights, count, detached
from symsteer.agents.replay import Batch
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout

Normalize = Callable[[torch.Tensor], torch.Tensor]

LOG_SCALE_MIN, LOG_SCALE_MAX = -5.0, 1.0


@dataclass(frozen=True)
class SacConfig:
    """Everything that the learner can be told; the same for all agents."""

    gamma: float = 0.95
    """Discount per decision (not per environment step)."""
    lr: float = 5e-4
    """Adam's learning rate of actor and critics."""
    alpha_lr: float = 5e-4
    """Adam's learning rate of log alpha."""
    batch_size: int = 256
    """Transitions per update."""
    tau: float = 0.005
    """Share of the online critics that enters the target critics at each update."""
    critics: int = 2
    """Number of critics; the smallest value counts."""
    layer_norm: bool = True
    """Normalise hidden features; without it Q diverges easily."""
    width: int = 256
    """Hidden features per layer; a group of order n shares them out over width/n fields."""
    depth: int = 2
    """Hidden layers."""
    group: str = "C8"
    """Symmetry of the equivariant and approximate agents: C_n or D_n."""
    noise_bound: float = 1.5
    """Largest norm of an irrep block of the noise."""
    target_entropy: float | None = None
    """Entropy that alpha aims at, nats per decision; default: minus half the noise's numbers."""
    initial_alpha: float = 0.01
    """Entropy weight at the start."""
    initial_scale: float = 0.5
    """Standard deviation, before the squash, of the untrained policy."""
    initial_output: float = 0.01
    """Factor on the actor's output layer at initialisation; small means w starts around 0."""
    soft_backup: bool = False
    """Put the entropy bonus into the critics' target, as in the paper."""
    reward_scale: float = 1.0
    """Factor on rewards before learning; reported Q values are divided by it again."""
    utd: float = 1.0
    """Updates per collected decision (the collecting loop reads it)."""
    warmup: int = 600
    """Decisions played by the base policy before the first update (the loop reads it)."""
    replay_capacity: int = 200_000
    """Decisions kept for replay."""
    free_penalty: float = 0.1
    """Approximate agent: weight of the squared free path, per network (w_b)."""
    equivariant_penalty: float = 0.0
    """Approximate agent: weight of the squared equivariant path (w_e < w_b)."""
    free_init: float = 0.01
    """Approximate agent: factor on the free path at initialisation."""

    def __post_init__(self) -> None:
        positive = (
            *("lr", "alpha_lr", "batch_size", "critics", "width", "depth", "noise_bound"),
            *("initial_alpha", "reward_scale", "replay_capacity", "utd"),
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise UserError(f"agent option {name} must be positive, not {getattr(self, name)}")
        for name in ("warmup", "initial_output", "free_init"):
            if not getattr(self, name) >= 0:
                raise UserError(
                    f"agent option {name} must not be negative, not {getattr(self, name)}"
                )
        if not 0 <= self.gamma < 1:
            raise UserError(f"agent option gamma must lie in [0, 1), not {self.gamma}")
        if not 0 < self.tau <= 1:
            raise UserError(f"agent option tau must lie in (0, 1], not {self.tau}")
        low, high = math.exp(LOG_SCALE_MIN), math.exp(LOG_SCALE_MAX)
        if not low < self.initial_scale < high:
            raise UserError(
                f"agent option initial_scale must lie between {low:.4f} and {high:.2f}, "
                f"not {self.initial_scale}"
            )
        if not 0 <= self.equivariant_penalty <= self.free_penalty:
            raise UserError(
                "agent options need 0 <= equivariant_penalty <= free_penalty, not "
                f"{self.equivariant_penalty} and {self.free_penalty}"
            )


class SacAgent:
    """Actor, critics, temperature and their updates; subclasses supply the layers.

    Args:
        obs_layout, act_layout: geometry of an observation and of one action of the chunk.
        horizon: actions in a chunk, Tp.
        config: see :class:`SacConfig`.
        device, dtype: of all tensors.
        seed: of initialisation and of the agent's own noise.
        normalize_obs: maps observations ``[B, obs_dim]`` to the networks' scale. It must commute
            with the group, as the base policy's normaliser does; the identity by default.
    """

    name: ClassVar[str]
    learns: ClassVar[bool] = True
    searches: ClassVar[bool] = False

    def __init__(
        self,
        obs_layout: Layout,
        act_layout: Layout,
        horizon: int,
        config: SacConfig,
        device: torch.device | str = "cpu",
        seed: int = 0,
        normalize_obs: Normalize | None = None,
        dtype: torch.dtype = torch.float32,
    ):
        self.obs_layout, self.act_layout, self.horizon = obs_layout, act_layout, horizon
        self.config, self.device, self.dtype = config, torch.device(device), dtype
        self.normalize_obs = normalize_obs or (lambda obs: obs)
        self.noise_layout = act_layout.repeat(horizon)
        self.distribution = SquashedGaussian(self.noise_layout, config.noise_bound)
        blocks = Field("log_scales", 0, self.distribution.blocks)
        # The actor's output: means, then one invariant number per irrep block.
        self.actor_layout = Layout([*self.noise_layout.fields, blocks])
        self.critic_layout = _side_by_side(obs=obs_layout, noise=self.noise_layout)
        self.target_entropy = (
            -0.5 * self.noise_layout.dim if config.target_entropy is None else config.target_entropy
        )
        with torch.random.fork_rng(devices=[]):  # the caller's generator stays as it is
            torch.manual_seed(seed)
            actor = Ensemble([self.actor_layers()], config.layer_norm)
            critics = [self.critic_layers() for _ in range(config.critics)]
            critic = Ensemble(critics, config.layer_norm)
        self.distribution.to(self.device, dtype)
        self.actor, self.critic = actor.to(self.device, dtype), critic.to(self.device, dtype)
        # The targets are kept as dense matrices: expansion is linear, so following the matrices is
        # following the parameters, without an expansion of their own.
        self.target = [(w.clone(), b.clone()) for w, b in detached(self.critic.weights())]
        self.log_alpha = torch.tensor(
            math.log(config.initial_alpha), dtype=dtype, device=self.device, requires_grad=True
        )
        self.actor_optimizer = self._adam(self.parameter_groups(self.actor), config.lr)
        self.critic_optimizer = self._adam(self.parameter_groups(self.critic), config.lr)
        self.alpha_optimizer = self._adam([{"params": [self.log_alpha]}], config.alpha_lr)
        self.generator = torch.Generator(device=self.device).manual_seed(seed)
        self.updates = 0

    # What subclasses decide.

    def actor_layers(self) -> list[nn.Module]:
        """Layers from an observation to ``actor_layout``."""
        raise NotImplementedError

    def critic_layers(self) -> list[nn.Module]:
        """Layers from ``critic_layout`` to one value."""
        raise NotImplementedError

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        """Adam's parameter groups of the actor or the critics."""
        return [{"params": list(network.parameters())}]

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]`` for observations ``[B, obs_dim]``."""
        if deterministic:
            return self._chunk(self.distribution.mode(self.moments(obs)[0]))
        return self.sample(obs)[0]

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A draw from the policy ``[B, Tp, Da]`` and its log-probability ``[B]``."""
        noise, log_prob = self._sample(*self.moments(obs))
        return self._chunk(noise), log_prob

    @torch.no_grad()
    def log_prob(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Log-probability ``[B]`` of given noise ``[B, Tp, Da]``."""
        return self.distribution.log_prob(*self.moments(obs), noise.to(self.dtype).flatten(1))

    @torch.no_grad()
    def moments(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean ``[B, Tp * Da]`` and log-scale ``[B, blocks]`` before the squash."""
        return self._heads(self.actor.weights(), self._features(obs))

    @torch.no_grad()
    def q_values(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Every critic's value in the environment's reward units, ``[critics, B]``."""
        q = self._q(self.critic.weights(), self._features(obs), noise.to(self.dtype).flatten(1))
        return q / self.config.reward_scale

    # Learning.

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step of critics, actor, temperature and target critics.

        Returns:
            Scalars as tensors on the device (reading them waits for the device).
        """
        config = self.config
        obs, next_obs = self._features(batch.obs), self._features(batch.next_obs)
        alpha = self.log_alpha.detach().exp()
        policy = self.actor.weights()

        with torch.no_grad():
            noise, log_prob = self._sample(*self._heads(policy, next_obs))
            next_q = self._q(self.target, next_obs, noise).amin(0)
            if config.soft_backup:
                next_q = next_q - alpha * log_prob
            # Only success ends the future; a time-out has terminal 0 and bootstraps.
            wanted = (
                config.reward_scale * batch.reward + config.gamma * (1 - batch.terminal) * next_q
            )
        q = self._q(self.critic.weights(), obs, batch.noise.flatten(1))
        critic_loss = (q - wanted).square().mean(1).sum()
        _descend(critic_loss, self.critic_optimizer)
        self.critic.changed()

        noise, log_prob = self._sample(*self._heads(policy, obs))
        judge = detached(self.critic.weights())  # the actor's loss must not reach the critics
        actor_loss = (alpha * log_prob - self._q(judge, obs, noise).amin(0)).mean()
        _descend(actor_loss, self.actor_optimizer)
        self.actor.changed()

        entropy = -log_prob.detach().mean()
        alpha_loss = self.log_alpha * (entropy - self.target_entropy)
        _descend(alpha_loss, self.alpha_optimizer)

        with torch.no_grad():
            torch._foreach_lerp_(_flat(self.target), _flat(judge), config.tau)
        self.updates += 1
        q = q.detach() / config.reward_scale
        return {
            "losses/critic": critic_loss.detach(),
            "losses/actor": actor_loss.detach(),
            "losses/alpha": alpha_loss.detach(),
            "train/q_mean": q.mean(),
            "train/q_max_abs": q.abs().max(),
            "train/target_mean": wanted.mean() / config.reward_scale,
            "train/alpha": alpha,
            "train/entropy": entropy,
        }

    # Saving.

    def description(self) -> dict[str, Any]:
        """What a checkpoint must agree with: agent, geometry, sizes."""
        keys = ("group", "width", "depth", "critics", "layer_norm", "noise_bound")
        return {
            "agent": self.name,
            "obs_layout": self.obs_layout.to_json(),
            "act_layout": self.act_layout.to_json(),
            "horizon": self.horizon,
            **{key: getattr(self.config, key) for key in keys},
        }

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, temperature, generator; loads with ``weights_only=True``."""
        state = {name: getattr(self, name).state_dict() for name in self._parts()}
        return copy.deepcopy(
            {
                "description": self.description(),
                **state,
                "target": _flat(self.target),
                "log_alpha": self.log_alpha.detach(),
                "generator": self.generator.get_state(),
                "updates": self.updates,
            }
        )

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            UserError: if the checkpoint is of another agent, layout or size.
        """
        check_description(self.description(), state.get("description", {}))
        for name in self._parts():
            getattr(self, name).load_state_dict(state[name])
        self.actor.changed()
        self.critic.changed()
        with torch.no_grad():
            self.log_alpha.copy_(state["log_alpha"])
            torch._foreach_copy_(
                _flat(self.target), [t.to(self.log_alpha) for t in state["target"]]
            )
        self.generator.set_state(state["generator"].cpu())
        self.updates = int(state["updates"])

    def parameter_counts(self) -> dict[str, int]:
        """Trainable numbers (all critics together, without targets) and hidden widths."""
        actor, critic = count(self.actor), count(self.critic)
        return {
            "actor": actor,
            "critic": critic,
            "total": actor + critic,
            "actor_width": self.actor.width,
            "critic_width": self.critic.width,
        }

    # Inner parts.

    @staticmethod
    def _parts() -> tuple[str, ...]:
        return ("actor", "critic", "actor_optimizer", "critic_optimizer", "alpha_optimizer")

    @staticmethod
    def _adam(groups: list[dict[str, Any]], lr: float) -> torch.optim.Adam:
        return torch.optim.Adam(groups, lr=lr, fused=True)

    def _features(self, obs: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return self.normalize_obs(obs).to(self.dtype)

    def _heads(self, policy: Weights, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = self.actor.apply_weights(policy, obs)[0]
        mean, raw = out.split([self.distribution.dim, self.distribution.blocks], dim=-1)
        share = (math.log(self.config.initial_scale) - LOG_SCALE_MIN) / (
            LOG_SCALE_MAX - LOG_SCALE_MIN
        )
        start = math.log(share / (1 - share))
        return mean, LOG_SCALE_MIN + (LOG_SCALE_MAX - LOG_SCALE_MIN) * (raw + start).sigmoid()

    def _q(self, critics: Weights, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Values ``[critics, B]`` of normalised observations and flat noise."""
        return self.critic.apply_weights(critics, torch.cat([obs, noise], -1)).squeeze(-1)

    def _sample(
        self, mean: torch.Tensor, log_scale: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        eps = torch.randn(
            mean.shape, generator=self.generator, device=self.device, dtype=self.dtype
        )
        return self.distribution.sample(mean, log_scale, eps)

    def _chunk(self, noise: torch.Tensor) -> torch.Tensor:
        return noise.unflatten(-1, (self.horizon, self.act_layout.dim))


def entropy_allowance(gamma: float, alpha: float, log_prob_size: float) -> float:
    """Room that soft Q may need: ``alpha * gamma / (1 - gamma) * |log pi|``.

    The bonus of a decision's own noise is not part of its Q value, hence the leading gamma.

    Args:
        gamma: discount per decision.
        alpha: entropy weight.
        log_prob_size: typical magnitude of log pi, e.g. its largest mean over evaluations.
    """
    return abs(alpha) * gamma / (1 - gamma) * abs(log_prob_size)


def check_description(mine: dict[str, Any], saved: dict[str, Any]) -> None:
    """Compare an agent with a checkpoint.

    Raises:
        UserError: naming the first thing that differs.
    """
    for key, value in mine.items():
        if saved.get(key) != value:
            raise UserError(
                f"this checkpoint has {key} {saved.get(key)!r}, the agent has {value!r}; "
                "load it with the run's own configuration"
            )


def _descend(loss: torch.Tensor, optimizer: torch.optim.Optimizer) -> None:
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


def _flat(weights: Weights) -> list[torch.Tensor]:
    return [tensor for layer in weights for tensor in layer]


def _side_by_side(**layouts: Layout) -> Layout:
    """One layout of several vectors written one after the other."""
    return Layout(
        [
            Field(f"{prefix}.{f.name}", f.frequency, f.multiplicity, f.odd)
            for prefix, layout in layouts.items()
            for f in layout.fields
        ]
    )
