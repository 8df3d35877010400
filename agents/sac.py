"""Soft actor-critic in the latent noise of a frozen diffusion policy: the core of every learner.

After Haarnoja et al., arXiv 1812.05905, used for steering as in DSRL, arXiv 2506.15799. An action
is the whole noise chunk ``w [Tp, Da]``. A step is one decision of the latent-noise environment.
Subclasses override only what they change:

====================  ===============================================================
``actor_layers``    layers of the actor
``critic_layers``   layers of one critic
``parameter_groups``  Adam's parameter groups of a network
``critic_target``   target of the critics
``critic_loss``     loss of the critics
``actor_loss``      loss of the actor
``critic_penalty``, ``actor_penalty``  regularisers, added to the losses
``constraints``     gaps of the trained multipliers; the temperature is one of them
``after_update``    called after each update; returns more scalars
====================  ===============================================================

Deviations from the paper, numbered as in ``docs/agents.md``:

1. the squash is radial, one scale per irrep block (``distributions.py``);
2. the target has no entropy bonus (hard backup), except with ``soft_backup``;
3. time-outs bootstrap; only success is terminal;
4. LayerNorm in actor and critics; the actor's output layer starts small.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import nn

from symsteer.agents.agent import Agent, AgentContext, AgentOptions, Budget, MakeEnv
from symsteer.agents.diagnostics import critic_diagnostics
from symsteer.agents.distributions import SquashedGaussian
from symsteer.agents.episodes import Played
from symsteer.agents.networks import Ensemble, Weights, count, detached
from symsteer.agents.replay import Batch, ReplayBuffer, Transition
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout

LOG_SCALE_MIN, LOG_SCALE_MAX = -5.0, 1.0


@dataclass(frozen=True)
class SacOptions(AgentOptions):
    """Options of all SAC agents.

    The defaults are for many environments and few updates. Data are cheap here, and the actor
    exploits a critic that is trained with many updates on few decisions. They were chosen on
    PickCube, floating, unbroken, with the equivariant and the standard agent, seeds 0 and 1.
    """

    gamma: float = 0.95
    """Discount per decision (not per environment step)."""
    lr: float = 6e-4
    """Adam's learning rate of actor and critics."""
    alpha_lr: float = 6e-4
    """Adam's learning rate of log alpha."""
    batch_size: int = 192
    """Transitions per update."""
    tau: float = 0.015
    """Weight of the online critics when the target critics are updated."""
    critics: int = 2
    """Number of critics; the smallest of their values is used."""
    layer_norm: bool = True
    """Normalise hidden features; without it Q often diverges."""
    width: int = 128
    """Hidden features per layer; with a group of order n they are width/n regular fields."""
    depth: int = 2
    """Hidden layers."""
    group: str = "C8"
    """Symmetry group, C_n or D_n, of equivariant layers and of the measured equivariance errors."""
    noise_bound: float = 1.5
    """Largest norm of an irrep block of the noise."""
    target_entropy: float | None = None
    """Target of the entropy, nats per decision; default: minus half the noise dimension."""
    initial_alpha: float = 0.01
    """Entropy weight at the start."""
    initial_scale: float = 0.5
    """Standard deviation of the untrained policy before the squash."""
    initial_output: float = 0.01
    """Factor on the actor's output layer at initialisation; small means w starts around 0."""
    soft_backup: bool = False
    """Add the entropy bonus to the critics' target, as in the paper."""
    reward_scale: float = 0.25
    """Factor on rewards in training (0.25: one decision of four steps costs 1). Reported Q-values
    are in unscaled reward units."""
    utd: float = 0.3
    """Updates per collected decision."""
    warmup: int = 1280
    """Decisions with noise from N(0, I) (the base policy) before the first update."""
    replay_capacity: int = 200_000
    """Capacity of the replay buffer, in decisions."""

    def __post_init__(self) -> None:
        positive = (
            *("lr", "alpha_lr", "batch_size", "critics", "width", "depth", "noise_bound"),
            *("initial_alpha", "reward_scale", "replay_capacity", "utd"),
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise UserError(f"agent option {name} must be positive, not {getattr(self, name)}")
        for name in ("warmup", "initial_output"):
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
        _ = Group.parse(self.group).order


class Multiplier:
    """A positive number ``exp(log)`` that grows while the gap of its constraint is negative.

    Adam minimises its loss ``log * gap``. The gap of the temperature is the entropy minus its
    target (Haarnoja et al., arXiv 1812.05905, section 5).
    """

    def __init__(self, initial: float, lr: float, device: torch.device, dtype: torch.dtype):
        self.log = torch.tensor(math.log(initial), dtype=dtype, device=device, requires_grad=True)
        self.optimizer = adam([{"params": [self.log]}], lr)

    @property
    def value(self) -> torch.Tensor:
        """The current value, without gradient."""
        return self.log.detach().exp()

    def step(self, gap: torch.Tensor) -> torch.Tensor:
        """One gradient step; returns the loss."""
        loss = self.log * gap
        descend(loss, self.optimizer)
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Value and optimiser."""
        return {"log": self.log.detach(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.optimizer.load_state_dict(state["optimizer"])
        with torch.no_grad():
            self.log.copy_(state["log"])


class SacAgent(Agent):
    """Actor, critics, temperature and their updates; subclasses define the layers."""

    role = "learner"
    Options = SacOptions
    options: SacOptions

    replay_fields: ClassVar[tuple[str, ...]] = ("obs", "noise", "reward", "next_obs", "terminal")
    """Fields of :class:`Transition` that the replay stores; a subclass may add ``actions``."""

    replay: ReplayBuffer

    def __init__(self, context: AgentContext, options: SacOptions | None = None):
        super().__init__(context, options)
        options = self.options
        self.noise_layout = context.noise_layout
        self.distribution = SquashedGaussian(self.noise_layout, options.noise_bound)
        blocks = Field("log_scales", 0, self.distribution.blocks)
        # Output of the actor: the means, then one invariant number per irrep block.
        self.actor_layout = Layout([*self.noise_layout.fields, blocks])
        self.critic_layout = _side_by_side(obs=self.obs_layout, noise=self.noise_layout)
        self.target_entropy = (
            -0.5 * self.noise_layout.dim
            if options.target_entropy is None
            else options.target_entropy
        )
        with torch.random.fork_rng(devices=[]):  # does not change the global generator
            torch.manual_seed(context.seed)
            actor = Ensemble([self.actor_layers()], options.layer_norm)
            critics = [self.critic_layers() for _ in range(options.critics)]
            critic = Ensemble(critics, options.layer_norm)
        self.distribution.to(self.device, self.dtype)
        self.actor = actor.to(self.device, self.dtype)
        self.critic = critic.to(self.device, self.dtype)
        # The targets are stored as dense matrices. Expansion is linear, so averaging the matrices
        # equals averaging the parameters, and the targets need no expansion.
        self.target = [(w.clone(), b.clone()) for w, b in detached(self.critic.weights())]
        self.actor_optimizer = adam(self.parameter_groups(self.actor), options.lr)
        self.critic_optimizer = adam(self.parameter_groups(self.critic), options.lr)
        self.multipliers = {
            "alpha": Multiplier(options.initial_alpha, options.alpha_lr, self.device, self.dtype)
        }
        self.warm_up_generator = self._new_generator()
        self.replay = ReplayBuffer(
            options.replay_capacity, self._replay_shapes(), self.device, context.seed, self.dtype
        )
        self.decisions = 0
        self.owed = 0.0
        self.updates = 0

    @classmethod
    def check(cls, options: SacOptions, budget: Budget) -> None:
        """Check that training begins within the budget, and that the replay is large enough."""
        warm_up = options.warmup * budget.execute
        if budget.env_steps <= warm_up:
            raise UserError(
                f"env_steps is {budget.env_steps}, which ends within the warm-up of {warm_up} "
                "environment steps, so that nothing would be learned; raise env_steps or lower "
                "agent.warmup"
            )
        if options.replay_capacity < budget.num_envs:
            raise UserError(
                f"agent.replay_capacity is {options.replay_capacity}, less than one decision of "
                f"each of {budget.num_envs} environments; raise it or lower num_envs"
            )

    # What agents change.

    def actor_layers(self) -> list[nn.Module]:
        """Layers from an observation to ``actor_layout``."""
        raise NotImplementedError(f"{type(self).__name__} must give the layers of its actor")

    def critic_layers(self) -> list[nn.Module]:
        """Layers from ``critic_layout`` to one value."""
        raise NotImplementedError(f"{type(self).__name__} must give the layers of a critic")

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        """Adam's parameter groups of the actor or the critics."""
        return [{"params": list(network.parameters())}]

    def critic_target(self, batch: Batch, next_obs: torch.Tensor) -> torch.Tensor:
        """Target of every critic, ``[B]``, in scaled rewards; called without gradients.

        Args:
            batch: transitions.
            next_obs: the normalised next observations, ``[B, obs_dim]``.
        """
        noise, log_prob = self._sample(*self._heads(self.actor.weights(), next_obs))
        next_q = self._q(self.target, next_obs, noise).amin(0)
        if self.options.soft_backup:
            next_q = next_q - self.alpha * log_prob
        # Only success is terminal; a time-out has terminal 0 and bootstraps.
        reward = self.options.reward_scale * batch.reward
        return reward + self.options.gamma * (1 - batch.terminal) * next_q

    def critic_loss(self, q: torch.Tensor, target: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Squared error, mean over the batch, summed over critics; ``q [critics, B]``."""
        return (q - target).square().mean(1).sum()

    def actor_loss(
        self, q: torch.Tensor, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> torch.Tensor:
        """Mean of alpha log pi - min Q.

        Args:
            q: values of ``noise``, ``[critics, B]``; differentiable with respect to ``noise``.
            noise: drawn from the actor, flat, ``[B, Tp * Da]``; see :meth:`chunk`.
            log_prob: ``[B]``.
            batch: transitions.
        """
        return (self.alpha * log_prob - q.amin(0)).mean()

    def critic_penalty(self, batch: Batch) -> torch.Tensor | None:
        """A regulariser, added to the critics' loss; None: no regulariser."""
        return None

    def actor_penalty(self, batch: Batch) -> torch.Tensor | None:
        """A regulariser, added to the actor's loss; None: no regulariser."""
        return None

    def constraints(
        self, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> dict[str, torch.Tensor]:
        """Gap of each constraint in ``multipliers``, a scalar; negative: the multiplier grows."""
        return {"alpha": -log_prob.mean() - self.target_entropy}

    def after_update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Called after each update; returns more scalars."""
        return {}

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; N(0, I) during the warm-up, if not ``deterministic``."""
        if deterministic:
            return self.chunk(self.distribution.mode(self.moments(obs)[0]))
        if self.decisions < self.options.warmup:
            return self.gaussian_noise(len(obs), self.warm_up_generator)
        return self.sample(obs)[0]

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A draw from the policy ``[B, Tp, Da]`` and its log-probability ``[B]``."""
        noise, log_prob = self._sample(*self.moments(obs))
        return self.chunk(noise), log_prob

    @torch.no_grad()
    def moments(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean ``[B, Tp * Da]`` and log-scale ``[B, blocks]`` before the squash."""
        return self._heads(self.actor.weights(), self._features(obs))

    @torch.no_grad()
    def q_values(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Every critic's value in the environment's reward units, ``[critics, B]``."""
        q = self._q(self.critic.weights(), self._features(obs), noise.to(self.dtype).flatten(1))
        return q / self.options.reward_scale

    @property
    def alpha(self) -> torch.Tensor:
        """Entropy weight."""
        return self.multipliers["alpha"].value

    def chunk(self, noise: torch.Tensor) -> torch.Tensor:
        """Flat noise ``[..., Tp * Da]`` as a chunk ``[..., Tp, Da]``."""
        return noise.unflatten(-1, (self.horizon, self.act_layout.dim))

    # Learning.

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Train for the whole budget."""
        return budget.env_steps

    def observe(self, transition: Transition) -> None:
        """Store the decisions; after the warm-up, each one adds ``utd`` updates that are due."""
        self.replay.add(transition)
        if self.decisions >= self.options.warmup:
            self.owed += len(transition.reward) * self.options.utd
        self.decisions += len(transition.reward)

    def batches(self) -> Iterator[Batch]:
        """One batch for each update that is due."""
        while self.owed >= 1:
            self.owed -= 1
            yield self.replay.sample(self.options.batch_size)

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step of critics, actor, multipliers and target critics.

        Returns:
            Scalars as tensors on the device; reading them waits for the device.
        """
        obs, next_obs = self._features(batch.obs), self._features(batch.next_obs)
        alpha = self.alpha

        with torch.no_grad():
            target = self.critic_target(batch, next_obs)
        q = self._q(self.critic.weights(), obs, batch.noise.flatten(1))
        critic_loss = self.critic_loss(q, target, batch)
        descend(critic_loss, self.critic_optimizer, self.critic_penalty(batch))
        self.critic.changed()

        noise, log_prob = self._sample(*self._heads(self.actor.weights(), obs))
        judge = detached(self.critic.weights())  # no gradient of the actor's loss in the critics
        actor_loss = self.actor_loss(self._q(judge, obs, noise), noise, log_prob, batch)
        descend(actor_loss, self.actor_optimizer, self.actor_penalty(batch))
        self.actor.changed()

        log_prob = log_prob.detach()
        gaps = self.constraints(noise.detach(), log_prob, batch)
        losses = {f"losses/{name}": self.multipliers[name].step(gap) for name, gap in gaps.items()}

        with torch.no_grad():
            torch._foreach_lerp_(_flat(self.target), _flat(judge), self.options.tau)
        self.updates += 1
        q = q.detach() / self.options.reward_scale
        return {
            "losses/critic": critic_loss.detach(),
            "losses/actor": actor_loss.detach(),
            **losses,
            "train/q_mean": q.mean(),
            "train/q_max_abs": q.abs().max(),
            "train/target_mean": target.mean() / self.options.reward_scale,
            "train/alpha": alpha,
            "train/entropy": -log_prob.mean(),
            **self.after_update(batch),
        }

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Errors of Q, equivariance errors, temperature (docs/metrics.md)."""
        return critic_diagnostics(self, played)

    # Saving.

    def description(self) -> dict[str, Any]:
        """Agent, geometry and sizes; a checkpoint must have the same."""
        keys = ("group", "width", "depth", "critics", "layer_norm", "noise_bound")
        return {**super().description(), **{key: getattr(self.options, key) for key in keys}}

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, multipliers, generators; loads with ``weights_only=True``."""
        return copy.deepcopy(
            {
                **super().state_dict(),
                **{name: getattr(self, name).state_dict() for name in self._parts()},
                "target": _flat(self.target),
                "multipliers": {k: m.state_dict() for k, m in self.multipliers.items()},
                "warm_up_generator": self.warm_up_generator.get_state(),
                "decisions": self.decisions,
                "owed": self.owed,
                "updates": self.updates,
            }
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            UserError: if the checkpoint is of another agent, layout or size.
        """
        super().load_state_dict(state)
        for name in self._parts():
            getattr(self, name).load_state_dict(state[name])
        self.actor.changed()
        self.critic.changed()
        for name, multiplier in self.multipliers.items():
            multiplier.load_state_dict(state["multipliers"][name])
        with torch.no_grad():
            flat = _flat(self.target)
            torch._foreach_copy_(flat, [t.to(flat[0]) for t in state["target"]])
        self.warm_up_generator.set_state(state["warm_up_generator"].cpu())
        self.decisions, self.owed = int(state["decisions"]), float(state["owed"])
        self.updates = int(state["updates"])

    def parameter_counts(self) -> dict[str, int]:
        """Numbers of trainable parameters (without target critics), and the actor's width."""
        actor, critic = count(self.actor), count(self.critic)
        return {
            "actor": actor,
            "critic": critic,
            "total": actor + critic,
            "width": self.actor.width,
        }

    # Inner parts.

    @staticmethod
    def _parts() -> tuple[str, ...]:
        return ("actor", "critic", "actor_optimizer", "critic_optimizer")

    def _replay_shapes(self) -> dict[str, tuple[int, ...]]:
        obs, act = (self.obs_layout.dim,), self.act_layout.dim
        known: dict[str, tuple[int, ...]] = {
            "obs": obs,
            "noise": (self.horizon, act),
            "actions": (self.context.execute, act),
            "reward": (),
            "next_obs": obs,
            "terminal": (),
            "truncated": (),
        }
        return {name: known[name] for name in self.replay_fields}

    def _features(self, obs: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return self.context.normalize_obs(obs).to(self.dtype)

    def _heads(self, policy: Weights, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = self.actor.apply_weights(policy, obs)[0]
        mean, raw = out.split([self.distribution.dim, self.distribution.blocks], dim=-1)
        share = (math.log(self.options.initial_scale) - LOG_SCALE_MIN) / (
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


def adam(groups: list[dict[str, Any]], lr: float) -> torch.optim.Adam:
    """The Adam of all parts of the learner."""
    return torch.optim.Adam(groups, lr=lr, fused=True)


def descend(
    loss: torch.Tensor, optimizer: torch.optim.Optimizer, penalty: torch.Tensor | None = None
) -> None:
    """One gradient step on a loss plus its regulariser."""
    optimizer.zero_grad()
    (loss if penalty is None else loss + penalty).backward()
    optimizer.step()


def _flat(weights: Weights) -> list[torch.Tensor]:
    return [tensor for layer in weights for tensor in layer]


def _side_by_side(**layouts: Layout) -> Layout:
    """The layout of several concatenated vectors."""
    return Layout(
        [
            Field(f"{prefix}.{f.name}", f.frequency, f.multiplicity, f.odd)
            for prefix, layout in layouts.items()
            for f in layout.fields
        ]
    )
