"""Soft actor-critic in the latent noise of a frozen diffusion policy: the core of every learner.

After Haarnoja et al., arXiv 1812.05905, used for steering as in DSRL, arXiv 2506.15799. An action
is the whole noise chunk ``w [Tp, Da]``. A step is one decision of the latent-noise environment.

The critics judge the noise or what it is decoded to (option ``critic``):

- ``noise`` (DSRL-SAC): Q(s, w).
- ``aliased`` (DSRL-NA): Q(s, a) of the executed actions a. The noise critics Q_W(s, w) are trained
  towards Q(s, decode(s, w)), head by head, and the actor climbs Q_W.
- ``sampler``: Q(s, a) again; the actor climbs Q(s, decode(s, w)), its gradient passes through the
  sampler.

Subclasses override only what they change:

====================  ===============================================================
``actor_layers``    layers of the actor
``critic_layers``   layers of one critic
``parameter_groups``  Adam's parameter groups of a network
``critic_target``   target of the critics
``critic_loss``     loss of the critics
``actor_loss``      loss of the actor
``augment``         changes a batch before the update
``penalty``         a regulariser, added to the loss of a network
``settle``          changes a network after each of its steps
``constraints``     gaps of the trained multipliers; the temperature is one of them
``after_update``    called after each update; returns more scalars
====================  ===============================================================

Deviations from the papers, numbered as in ``docs/agents.md``:

1. the squash is radial, one scale per irrep block (``distributions.py``);
2. the target has no entropy bonus (hard backup), except with ``soft_backup``;
3. time-outs bootstrap, except with ``timeouts_terminal``;
4. LayerNorm in actor and critics; the actor's output layer starts small;
5. most of the noise to distil from is decoded once, when a decision is stored.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import nn

from symsteer.agents.agent import Agent, AgentContext, Budget, MakeEnv, Role
from symsteer.agents.diagnostics import critic_diagnostics
from symsteer.agents.distributions import LOG_SCALE_MAX, LOG_SCALE_MIN, SquashedGaussian
from symsteer.agents.episodes import Played
from symsteer.agents.generators import continue_stream, tensor_like
from symsteer.agents.networks import Ensemble, Weights, count, detached
from symsteer.agents.optimization import Multiplier, adam, descend, restore_adam
from symsteer.agents.options import NoiseSource, SacOptions
from symsteer.agents.replay import Batch, ReplayBuffer, Transition
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout

BANK = ("bank_noise", "bank_actions")
MOST_OWED = 1e6
COUNTERS = ("decisions", "owed", "distillation_owed", "updates")


@dataclass
class Drawn:
    """Noise that the actor drew, one row per state.

    Attributes:
        obs: normalised observations, ``[B, obs_dim]``.
        noise: flat, ``[B, Tp * Da]``.
        log_prob: ``[B]``.
        judged: what the critics see of the noise; see :meth:`SacAgent.judged`.
    """

    obs: torch.Tensor
    noise: torch.Tensor
    log_prob: torch.Tensor
    judged: torch.Tensor


class SacAgent(Agent):
    """Actor, critics, temperature and their updates; subclasses define the layers."""

    role: ClassVar[Role] = "learner"
    Options = SacOptions
    options: SacOptions

    in_teams: ClassVar[bool] = False
    """Whether the hooks of this very class work on the stacked tensors of a team, which have one
    more dimension in front; subclasses say it anew."""

    bank_at: ClassVar[Literal["obs", "next_obs"]] = "obs"
    """The state of a decision at which its bank of noises is decoded."""

    replay: ReplayBuffer

    def __init__(self, context: AgentContext, options: SacOptions | None = None):
        super().__init__(context, options)
        options = self.options
        self.noise_layout = self.act_layout.repeat(self.drawn_rows)
        hard = options.bound_penalty == 0
        self.distribution = SquashedGaussian(self.noise_layout, options.noise_bound, hard)
        blocks = Field("log_scales", 0, self.distribution.blocks)
        # Output of the actor: the means, then one invariant number per irrep block.
        self.actor_layout = Layout([*self.noise_layout.fields, blocks])
        self.noise_inputs = Layout.join(obs=self.obs_layout, noise=self.noise_layout)
        executed = self.act_layout.repeat(context.execute)
        self.action_inputs = Layout.join(obs=self.obs_layout, actions=executed)
        self.target_entropy = options.target_entropy * self.noise_layout.dim
        with torch.random.fork_rng(devices=[]):  # does not change the global generator
            torch.manual_seed(context.seed)
            self.actor = self._network(self._actors())
            judged = self.noise_inputs if options.critic == "noise" else self.action_inputs
            self.critic = self._critics(judged)
            self.noise_critic = self.critic
            if options.critic == "aliased":
                self.noise_critic = self._critics(self.noise_inputs)
        self.distribution.to(self.device, self.dtype)
        # The targets are stored as dense matrices. Expansion is linear, so averaging the matrices
        # equals averaging the parameters, and the targets need no expansion.
        self.target = [(w.clone(), b.clone()) for w, b in detached(self.critic.weights())]
        self.optimizers = {
            name: adam(self.parameter_groups(network), options.lr)
            for name, network in self.networks.items()
        }
        self.multipliers = {
            "alpha": Multiplier(options.initial_alpha, options.alpha_lr, self.device, self.dtype)
        }
        self.warm_up_generator = self._new_generator()
        self.bank_generator = self._new_generator(1)
        self.replay = self._new_replay(options.replay_capacity)
        self.demonstrations = self._new_replay(options.replay_capacity)
        self.decisions = 0
        self.owed = self.distillation_owed = 0.0
        self.updates = 0
        self.synchronize: Callable[[], None] = lambda: None
        """Called before the state is read; a team writes there what it keeps for its members."""

    @classmethod
    def check(cls, options: SacOptions, budget: Budget) -> None:
        """Check that training begins within the budget, and that the replay is large enough."""
        warm_up = max(options.warmup, options.first_update) * budget.execute
        if budget.env_steps <= warm_up:
            raise UserError(
                f"env_steps is {budget.env_steps}, which ends within the warm-up of {warm_up} "
                "environment steps, so that nothing would be learned; raise env_steps or lower "
                "agent.warmup and agent.learning_starts"
            )
        if options.replay_capacity < budget.num_envs:
            raise UserError(
                f"agent.replay_capacity is {options.replay_capacity}, less than one decision of "
                f"each of {budget.num_envs} environments; raise it or lower num_envs"
            )

    @property
    def networks(self) -> dict[str, Ensemble]:
        """All trained networks by name."""
        found = {"actor": self.actor, "critic": self.critic}
        if self.noise_critic is not self.critic:
            found["noise_critic"] = self.noise_critic
        return found

    # What agents change.

    def actor_layers(self) -> list[nn.Module]:
        """Layers from an observation to ``actor_layout``."""
        raise NotImplementedError(f"{type(self).__name__} must give the layers of its actor")

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        """Layers from ``inputs`` (observation, and noise or actions) to one value."""
        raise NotImplementedError(f"{type(self).__name__} must give the layers of a critic")

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        """Adam's parameter groups of the actor or the critics."""
        return [{"params": list(network.parameters())}]

    def critic_target(self, batch: Batch, following: Drawn) -> torch.Tensor:
        """Target of every critic, ``[B]``, in scaled rewards; called without gradients.

        Args:
            batch: transitions.
            following: the actor's noise at the next observations.
        """
        next_q = self.reduced(self._q(self.target, following.obs, following.judged))
        if self.options.soft_backup:
            next_q = next_q - self.alpha.unsqueeze(-1) * following.log_prob
        return self.backed_up(batch, next_q)

    def backed_up(self, batch: Batch, next_q: torch.Tensor) -> torch.Tensor:
        """Rewards plus discounted values ``[B]`` of the next states, in scaled rewards."""
        ends = batch.terminal
        if self.options.timeouts_terminal:
            ends = ends.maximum(batch.truncated)
        return self.options.reward_scale * batch.reward + batch.discount * (1 - ends) * next_q

    def critic_loss(self, q: torch.Tensor, target: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Squared error, mean over the batch, summed over critics; ``q [critics, B]``."""
        return (q - target.unsqueeze(-2)).square().mean(-1).sum(-1)

    def actor_loss(
        self, q: torch.Tensor, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> torch.Tensor:
        """Mean of alpha log pi - Q, and the price of noise beyond a soft bound.

        Args:
            q: values of ``noise``, ``[critics, B]``; differentiable with respect to ``noise``.
            noise: drawn from the actor, flat, ``[B, Tp * Da]``; see :meth:`chunk`.
            log_prob: ``[B]``.
            batch: transitions.
        """
        # A random subset makes targets pessimistic; the actor follows the mean (REDQ).
        value = q.mean(-2) if self.options.reduce == "subset" else self.reduced(q)
        cost = self.alpha.unsqueeze(-1) * log_prob - value
        if not self.distribution.hard:
            cost = cost + self.options.bound_penalty * self.distribution.excess(noise)
        return cost.mean(-1)

    def augment(self, batch: Batch) -> Batch:
        """Change a batch before the update."""
        return batch

    def penalty(self, name: str, batch: Batch) -> torch.Tensor | None:
        """A regulariser, added to the loss of a network; None: no regulariser."""
        return None

    def constraints(
        self, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> dict[str, torch.Tensor]:
        """Gap of each constraint in ``multipliers``, a scalar; negative: the multiplier grows."""
        return {"alpha": -log_prob.mean(-1) - self.target_entropy}

    def settle(self, name: str) -> None:
        """Called after each step of a network; may change its parameters, in place."""

    def after_update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Called after each update; returns more scalars."""
        return {}

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; random during the warm-up, if not ``deterministic``."""
        if deterministic:
            return self.mode(obs)
        if self.decisions < self.options.warmup:
            return self.random_noise(self.options.warmup_noise, len(obs), self.warm_up_generator)
        return self.sample(obs)[0]

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """Noise ``[B, Tp, Da]`` at the mean of the policy; turns with the scene if the actor does.

        Diagnostics of symmetry measure it.
        """
        return self.chunk(self.distribution.mode(self.moments(obs)[0]))

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
        """Every critic's value of ``noise [B, Tp, Da]`` in reward units, ``[critics, B]``."""
        judged = self.judged(obs, noise.to(self.dtype).flatten(1))
        return self._q(self.critic.weights(), self._features(obs), judged) / self.reward_scale

    @torch.no_grad()
    def noise_q_values(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """The same by the critics that the actor climbs (with ``aliased``: the distilled ones)."""
        if self.options.critic == "sampler":
            return self.q_values(obs, noise)
        weights, flat = self.noise_critic.weights(), noise.to(self.dtype).flatten(1)
        return self._q(weights, self._features(obs), flat) / self.reward_scale

    def judged(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """What the critics see of flat noise ``[B, Tp * Da]``: itself, or the executed actions.

        Args:
            obs: in environment units.
            noise: actions are differentiable with respect to it.
        """
        if self.options.critic == "noise":
            return noise
        return self.executed(obs, self.chunk(noise)).flatten(-2)

    def executed(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """The actions ``[B, Ta, Da]`` that noise ``[B, Tp, Da]`` is decoded to."""
        return self.decode(obs, noise)[..., : self.context.execute, :]

    def reduced(self, q: torch.Tensor) -> torch.Tensor:
        """One value per state, ``[B]``, of all critics' values ``[critics, B]``."""
        if self.options.reduce == "mean":
            return q.mean(-2)
        if self.options.reduce == "subset":
            order = self.random(
                lambda generator: torch.randperm(
                    q.shape[-2], generator=generator, device=self.device
                )
            )
            q = q.take_along_dim(order[..., : self.options.subset, None], -2)
        return q.amin(-2)

    def random(self, draw: Callable[[torch.Generator], torch.Tensor]) -> torch.Tensor:
        """A draw by the agent's generator; in a team a draw by each member's, stacked."""
        return draw(self.generator)

    def random_noise(
        self, source: NoiseSource, count: int, generator: torch.Generator | None = None
    ) -> torch.Tensor:
        """``count`` chunks ``[count, Tp, Da]`` from N(0, I), squashed into the bound if wanted."""
        noise = self.gaussian_noise(count, generator)
        if source == "gaussian":
            return noise
        return self.chunk(self.distribution.squash(noise.flatten(1)))

    @property
    def keeps_bank(self) -> bool:
        """Whether random noises are decoded when a decision is stored."""
        return self.options.critic == "aliased"

    @property
    def drawn_rows(self) -> int:
        """Rows of an action that the actor draws: all of them."""
        return self.rows

    @property
    def actor_inputs(self) -> Layout:
        """What the actor sees: the observation."""
        return self.obs_layout

    def drawn_part(self, action: torch.Tensor) -> torch.Tensor:
        """The part of actions ``[B, rows, Da]`` that the actor draws, flat."""
        return action.flatten(1)

    @property
    def reward_scale(self) -> float:
        """Factor on rewards in training."""
        return self.options.reward_scale

    @property
    def alpha(self) -> torch.Tensor:
        """Entropy weight."""
        return self.multipliers["alpha"].value

    def chunk(self, noise: torch.Tensor) -> torch.Tensor:
        """Flat noise ``[..., Tp * Da]`` as a chunk ``[..., Tp, Da]``."""
        return noise.unflatten(-1, (-1, self.act_layout.dim))

    # Learning.

    @classmethod
    def wants_demonstrations(cls, options: SacOptions) -> bool:
        """Only if they have a share in the batches."""
        return options.demonstration_share > 0

    def observe_demonstrations(self, decisions: Transition) -> None:
        """Keep the decisions beside the replay; they are not part of checkpoints."""
        banked = self._banked(getattr(decisions, self.bank_at), self._new_generator(2))
        noise = decisions.noise.new_zeros(len(decisions.noise), self.rows, self.act_layout.dim)
        self.demonstrations.add({**vars(decisions), "noise": noise, **banked})
        # One row begins at every control step.
        self.demonstrations.stride = self.context.execute

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Train for the whole budget."""
        return budget.env_steps

    def observe(self, transition: Transition) -> None:
        """Store the decisions; each one after ``learning_starts`` adds ``utd`` due updates."""
        banked = self._banked(getattr(transition, self.bank_at), self.bank_generator)
        self.replay.add({**vars(transition), **banked})
        if self.decisions >= self.options.first_update:
            self.owed += len(transition.reward) * self.options.utd
        self.decisions += len(transition.reward)

    def batches(self) -> Iterator[Batch]:
        """One batch for each update that is due."""
        options = self.options
        shown = round(options.demonstration_share * options.batch_size)
        while self.owed >= 1:
            self.owed -= 1
            count = options.batch_size - shown
            batch = self.replay.sample(count, options.gamma, options.n_step)
            if shown:
                more = self.demonstrations.sample(shown, options.gamma, options.n_step)
                batch = Batch({name: torch.cat([x, more[name]]) for name, x in batch.items()})
            yield batch

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step of critics, actor, multipliers and target critics.

        Returns:
            Scalars as tensors on the device; reading them waits for the device.
        """
        return self.learn(self.augment(batch))

    def learn(self, batch: Batch) -> dict[str, torch.Tensor]:
        """The same, with the batch as it is; in a team the batches of all members, stacked."""
        obs = self._features(batch.obs)
        with torch.no_grad():
            following = self.drawn(batch.next_obs)
            target = self.critic_target(batch, following)
        stored = batch.noise if self.options.critic == "noise" else batch.actions
        q = self._q(self.critic.weights(), obs, stored.flatten(-2))
        critic_loss = self.critic_loss(q, target, batch)
        self._descend("critic", critic_loss, batch)
        scalars = {"losses/critic": critic_loss.detach()}
        judge = detached(self.critic.weights())  # no gradient of other losses in the critics

        if self.options.critic == "aliased":
            self.distillation_owed += self.options.distill_steps
            while self.distillation_owed >= 1:
                self.distillation_owed -= 1
                scalars["losses/distillation"] = self._distil(batch, obs, following, judge)

        if self.updates >= self.options.actor_delay:
            scalars |= self._improve(batch, obs, judge)

        with torch.no_grad():
            torch._foreach_lerp_(_flat(self.target), _flat(judge), self.options.tau)
        self.updates += 1
        q = q.detach() / self.reward_scale
        return {
            **scalars,
            "train/q_mean": q.mean((-2, -1)),
            "train/q_max_abs": q.abs().amax((-2, -1)),
            "train/target_mean": target.mean(-1) / self.reward_scale,
            **self.after_update(batch),
        }

    def _improve(self, batch: Batch, obs: torch.Tensor, judge: Weights) -> dict[str, torch.Tensor]:
        """One step of the actor and the multipliers; returns scalars."""
        noise, log_prob = self._sample(*self._heads(self.actor.weights(), obs))
        if self.options.critic == "aliased":
            values = self._q(detached(self.noise_critic.weights()), obs, noise)
        else:
            values = self._q(judge, obs, self.judged(batch.obs, noise))
        return self._climb(values, noise, log_prob, batch)

    def _climb(
        self, values: torch.Tensor, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> dict[str, torch.Tensor]:
        """The step, for what the actor drew and its values ``[critics, B]``."""
        alpha = self.alpha
        actor_loss = self.actor_loss(values, noise, log_prob, batch)
        self._descend("actor", actor_loss, batch)
        log_prob = log_prob.detach()
        gaps = self.constraints(noise.detach(), log_prob, batch)
        return {
            "losses/actor": actor_loss.detach(),
            **{f"losses/{name}": self.multipliers[name].step(gap) for name, gap in gaps.items()},
            "train/alpha": alpha,
            "train/entropy": -log_prob.mean(-1),
        }

    def drawn(self, obs: torch.Tensor) -> Drawn:
        """Noise that the actor draws at observations in environment units."""
        features = self._features(obs)
        noise, log_prob = self._sample(*self._heads(self.actor.weights(), features))
        return Drawn(features, noise, log_prob, self.judged(obs, noise))

    def _distil(
        self, batch: Batch, obs: torch.Tensor, following: Drawn, judge: Weights
    ) -> torch.Tensor:
        """One step of the noise critics towards the action critics; returns the loss.

        The actor's noise is that of the next observations, which the target has decoded already.
        """
        source, pairs = self.options.distill, []
        if source != "actor":
            pairs.append((obs, *self._random_pairs(batch)))
        if source in ("actor", "mixture"):
            pairs.append((following.obs, following.noise, following.judged))
        features, noise, actions = (torch.cat(parts, -2) for parts in zip(*pairs, strict=True))
        with torch.no_grad():
            wanted = self._q(judge, features, actions)
        found = self._q(self.noise_critic.weights(), features, noise)
        loss = (found - wanted).square().mean(-1).sum(-1)
        self._descend("noise_critic", loss, batch)
        return loss.detach()

    def _random_pairs(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """Random noise for each row and the actions that it is decoded to, both flat."""
        count, bank = batch.obs.shape[-2], self.options.noise_bank
        if not bank:
            noise = self.random(
                lambda generator: self.random_noise(self._bank_source, count, generator)
            )
            return noise.flatten(-2), self.executed(batch.obs, noise).flatten(-2)
        picked = self.random(
            lambda generator: torch.randint(bank, (count,), generator=generator, device=self.device)
        )
        banks = (batch[name].flatten(-2) for name in BANK)
        noise, actions = (x.take_along_dim(picked[..., None, None], -2).squeeze(-2) for x in banks)
        return noise, actions

    @torch.no_grad()
    def _banked(self, obs: torch.Tensor, generator: torch.Generator) -> dict[str, torch.Tensor]:
        """Random noises for each stored decision and what they are decoded to."""
        size = self.options.noise_bank
        if not self.keeps_bank or not size:
            return {}
        noise = self.random_noise(self._bank_source, size * len(obs), generator)
        actions = self.executed(obs.repeat_interleave(size, 0), noise)
        both = (noise, actions)
        return {name: x.unflatten(0, (len(obs), size)) for name, x in zip(BANK, both, strict=True)}

    @property
    def _bank_source(self) -> NoiseSource:
        return "gaussian" if self.options.distill == "gaussian" else "squashed"

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Errors of Q, equivariance errors, temperature (docs/metrics.md)."""
        return critic_diagnostics(self, played)

    # Saving.

    def description(self) -> dict[str, Any]:
        """Agent, geometry and sizes; a checkpoint must have the same."""
        keys = (
            *("critic", "group", "width", "depth", "critics", "layer_norm", "activation"),
            *("noise_bound", "bound_penalty"),
        )
        return {**super().description(), **{key: getattr(self.options, key) for key in keys}}

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, multipliers, generators; loads with ``weights_only=True``."""
        self.synchronize()
        return _copied(
            {
                **super().state_dict(),
                "networks": {k: network.state_dict() for k, network in self.networks.items()},
                "optimizers": {k: adam.state_dict() for k, adam in self.optimizers.items()},
                "target": _flat(self.target),
                "multipliers": {k: m.state_dict() for k, m in self.multipliers.items()},
                "generators": {k: g.get_state() for k, g in self._generators.items()},
                **{name: getattr(self, name) for name in COUNTERS},
            }
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            UserError: if the checkpoint is of another agent, layout or size.
        """
        super().load_state_dict(state)
        for name, network in self.networks.items():
            network.load_state_dict(state["networks"][name])
            network.changed()
            restore_adam(self.optimizers[name], state["optimizers"][name])
        for name, multiplier in self.multipliers.items():
            multiplier.load_state_dict(state["multipliers"][name])
        with torch.no_grad():
            for own, stored in zip(_flat(self.target), state["target"], strict=True):
                own.copy_(tensor_like(stored, own))
        for name, generator in self._generators.items():
            continue_stream(generator, state["generators"][name])
        for name in COUNTERS:
            setattr(self, name, type(getattr(self, name))(state[name]))
        if not 0 <= max(self.owed, self.distillation_owed) < MOST_OWED:
            raise ValueError(f"{self.owed} and {self.distillation_owed} updates are due")

    def parameter_counts(self) -> dict[str, int]:
        """Numbers of trainable parameters (without target critics), and the hidden width."""
        sizes = {name: count(network) for name, network in self.networks.items()}
        total, actor = sum(sizes.values()), sizes.get("actor", 0)
        return {
            "actor": actor,
            "critic": total - actor,
            "total": total,
            "width": next(iter(self.networks.values())).width,
        }

    # Inner parts.

    @property
    def _generators(self) -> dict[str, torch.Generator]:
        return {
            "warm_up": self.warm_up_generator,
            "bank": self.bank_generator,
            "demonstrations": self.demonstrations.generator,
        }

    def _network(self, members: list[list[nn.Module]]) -> Ensemble:
        network = Ensemble(members, self.options.layer_norm, self.options.activation)
        return network.to(self.device, self.dtype)

    def _actors(self) -> list[list[nn.Module]]:
        return [self.actor_layers()]

    def _critics(self, inputs: Layout) -> Ensemble:
        return self._network([self.critic_layers(inputs) for _ in range(self.options.critics)])

    def _descend(self, name: str, loss: torch.Tensor, batch: Batch) -> None:
        descend(loss, self.optimizers[name], self.penalty(name, batch))
        with torch.no_grad():
            self.settle(name)
        self.networks[name].changed()

    @property
    def vector_fields(self) -> dict[str, Layout]:
        """The fields of a batch that turn with the scene, and the geometry of their last axis."""
        states = dict.fromkeys(("obs", "next_obs"), self.obs_layout)
        return {**states, **dict.fromkeys(("noise", "actions", *BANK), self.act_layout)}

    def _new_replay(self, capacity: int, **more: tuple[int, ...]) -> ReplayBuffer:
        if self.keeps_bank and (size := self.options.noise_bank):
            rows = self.rows, self.context.execute
            more |= {k: (size, n, self.act_layout.dim) for k, n in zip(BANK, rows, strict=True)}
        return super()._new_replay(capacity, **more)

    def _features(self, obs: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return self.context.normalize_obs(obs).to(self.dtype)

    def _heads(self, policy: Weights, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self._parameters(self._actor_output(policy, obs))

    def _actor_output(self, policy: Weights, obs: torch.Tensor) -> torch.Tensor:
        """``[B, dim]`` of ``actor_layout``."""
        return self.actor.apply_weights(policy, obs).select(-3, 0)

    def _parameters(self, out: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log-scale before the squash."""
        mean, raw = out.split([self.distribution.dim, self.distribution.blocks], dim=-1)
        share = (math.log(self.options.initial_scale) - LOG_SCALE_MIN) / (
            LOG_SCALE_MAX - LOG_SCALE_MIN
        )
        start = math.log(share / (1 - share))
        return mean, LOG_SCALE_MIN + (LOG_SCALE_MAX - LOG_SCALE_MIN) * (raw + start).sigmoid()

    def _q(self, critics: Weights, obs: torch.Tensor, judged: torch.Tensor) -> torch.Tensor:
        """Values ``[critics, B]`` of normalised observations, and flat noise or actions."""
        return self.critic.apply_weights(critics, torch.cat([obs, judged], -1)).squeeze(-1)

    def _sample(
        self, mean: torch.Tensor, log_scale: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        shape = mean.shape[-2:]
        eps = self.random(
            lambda generator: torch.randn(
                shape, generator=generator, device=self.device, dtype=self.dtype
            )
        )
        return self.distribution.sample(mean, log_scale, eps)


def _copied(tree: Any) -> Any:
    """A copy with tensors in memory of their own: those of a team's member are views."""
    if isinstance(tree, torch.Tensor):
        return tree.detach().clone()
    if isinstance(tree, Mapping):
        return {key: _copied(value) for key, value in tree.items()}
    return [_copied(value) for value in tree] if isinstance(tree, list) else tree


def _flat(weights: Weights) -> list[torch.Tensor]:
    return [tensor for layer in weights for tensor in layer]
