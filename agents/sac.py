"""Soft actor-critic in the latent noise of a frozen diffusion policy: the core of every learner.

After Haarnoja et al., arXiv 1812.05905, used for steering as in DSRL, arXiv 2506.15799. An action
is the whole noise chunk ``w [Tp, Da]``. A step is one decision of the latent-noise environment.

The critics judge the noise or what it is decoded to (option ``critic_kind``):

- ``noise`` (DSRL-SAC): Q(s, w).
- ``aliased`` (DSRL-NA): Q(s, a) of the executed actions a. The noise critics Q_W(s, w) are trained
  towards Q(s, decode(s, w)), head by head, and the actor climbs Q_W.
- ``sampler``: Q(s, a) again; the actor climbs Q(s, decode(s, w)), its gradient passes through the
  sampler.

Deviations from the papers are numbered in ``docs/agents.md``.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import nn

from symsteer.agents.agent import Agent, AgentContext, Budget, MakeEnv, Role
from symsteer.agents.diagnostics import critic_diagnostics
from symsteer.agents.distributions import SquashedGaussian
from symsteer.agents.episodes import Played
from symsteer.agents.generators import continue_stream, owned, tensor_like
from symsteer.agents.graphs import GraphedUpdates
from symsteer.agents.networks import Ensemble, Weights, detached
from symsteer.agents.optimization import Adam, Multiplier, in_chunks
from symsteer.agents.options import SacOptions
from symsteer.agents.replay import Batch, ReplayBuffer, Transition
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout

VALUE = Layout([Field("value", 0)])
BANK = ("bank_noise", "bank_actions")
COUNTERS = ("decisions", "owed", "distillation_owed", "updates")
MOST_OWED = 1e6


@dataclass
class Drawn:
    """Noise that the actor drew, one row per state.

    Attributes:
        obs: normalised observations, ``[B, obs_dim]``.
        noise: flat, ``[B, Tp * Da]``.
        log_prob: ``[B]``.
        judge: computes :attr:`judged`.
    """

    obs: torch.Tensor
    noise: torch.Tensor
    log_prob: torch.Tensor
    judge: Callable[[], torch.Tensor]

    @functools.cached_property
    def judged(self) -> torch.Tensor:
        """What the critics see of the noise; see :meth:`SacAgent.judged`."""
        return self.judge()


class SacAgent(Agent):
    """Actor, critics, temperature and their updates; subclasses define the layers.

    Attributes:
        optimizers: the Adam of each network.
        target: the target critics, as dense matrices. Expansion is linear, so averaging the
            matrices equals averaging the parameters, and the targets need no expansion.
        multipliers: trained numbers by name; ``alpha`` is the entropy weight.
        streams: draw the random numbers of an update; a team has those of its members.
        stacked: whether tensors have one more dimension in front, the members of a team.
        synchronize: called before the state is read; a team writes there what it keeps for its
            members.
    """

    role: ClassVar[Role] = "learner"
    Options = SacOptions
    options: SacOptions
    replay: ReplayBuffer

    in_teams: ClassVar[bool] = False
    """Whether the hooks of this very class work on the stacked tensors of a team, and neither wait
    for the device nor branch on data; subclasses say it anew. `after_update` stays as it is."""

    always_banks: ClassVar[bool] = False
    """Whether a bank of decoded noises is kept with all kinds of critics, not with `aliased` alone.
    """

    bank_at: ClassVar[Literal["obs", "next_obs"]] = "obs"
    """The state of a decision at which its bank of noises is decoded."""

    def __init__(self, context: AgentContext, options: SacOptions | None = None):
        super().__init__(context, options)
        options = self.options
        self.noise_layout = self.act_layout.repeat(self.drawn_rows)
        self.distribution = SquashedGaussian(self.noise_layout, options.noise_bound)
        self.actor_layout = self.distribution.parameter_layout
        self.noise_inputs = Layout.join(obs=self.obs_layout, noise=self.noise_layout)
        executed = self.act_layout.repeat(context.execute)
        self.action_inputs = Layout.join(obs=self.obs_layout, actions=executed)
        self.target_entropy = options.target_entropy * self.noise_layout.dim
        with torch.random.fork_rng(devices=[]):  # does not change the global generator
            torch.manual_seed(context.seed)
            self.networks = {
                name: Ensemble(members, options.layer_norm, options.activation)
                for name, members in self._members().items()
            }
        for network in self.networks.values():
            network.to(self.device, self.dtype)
        self.distribution.to(self.device, self.dtype)
        copy = functools.partial(torch.clone, memory_format=torch.contiguous_format)
        self.target = [(copy(w), copy(b)) for w, b in detached(self.critic.weights())]
        self.optimizers = {
            name: Adam(network, options.lr) for name, network in self.networks.items()
        }
        self.multipliers = {
            "alpha": Multiplier.starting_at(
                options.initial_alpha, options.alpha_lr, self.device, self.dtype
            )
        }
        self.generators = {"warm_up": self._new_generator(), "bank": self._new_generator(1)}
        self.streams: Sequence[torch.Generator] = [self.generator]
        self.stacked = False
        self.replay = self._new_replay()
        self.decisions = self.updates = 0
        self.owed = self.distillation_owed = 0.0
        self.synchronize: Callable[[], None] = lambda: None
        self.graphs: GraphedUpdates | None = None

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

    @property
    def actor(self) -> Ensemble:
        """The network of the policy."""
        return self.networks["actor"]

    @property
    def critic(self) -> Ensemble:
        """The critics."""
        return self.networks["critic"]

    # What agents change.

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        """Layers of a network; the parameters of the last one are multiplied by ``scale``."""
        raise NotImplementedError(f"{type(self).__name__} must give its layers")

    def actor_layers(self) -> list[nn.Module]:
        """Layers from what the actor sees to ``actor_layout``."""
        return self.layers(self.actor_inputs, self.actor_layout, self.options.initial_output)

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        """Layers from ``inputs`` (observation, and noise or actions) to one value."""
        return self.layers(inputs, VALUE)

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
        return self.options.reward_scale * batch.reward + self.options.gamma * (1 - ends) * next_q

    def critic_loss(self, q: torch.Tensor, target: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Squared error, mean over the batch, summed over critics; ``q [critics, B]``."""
        return (q - target.unsqueeze(-2)).square().mean(-1).sum(-1)

    def actor_loss(
        self, q: torch.Tensor, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> torch.Tensor:
        """Mean of alpha log pi - Q.

        Args:
            q: values of ``noise``, ``[critics, B]``; differentiable with respect to ``noise``.
            noise: drawn from the actor, flat, ``[B, Tp * Da]``; see :meth:`chunk`.
            log_prob: ``[B]``.
            batch: transitions.
        """
        return (self.alpha.unsqueeze(-1) * log_prob - self.reduced(q)).mean(-1)

    def augment(self, batch: Batch) -> Batch:
        """Change a batch before the update."""
        return batch

    def penalty(self, name: str, batch: Batch) -> torch.Tensor | None:
        """A regulariser, added to the loss of a network; None: no regulariser."""
        return None

    def settle(self, name: str) -> None:
        """Called after each step of a network; may change its parameters, in place."""

    def after_update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Called after each update; returns more scalars."""
        return {}

    def bank_noise(self, count: int, generator: torch.Generator) -> torch.Tensor:
        """Random noise to bank and to distil at, ``[count, Tp, Da]``."""
        noise = self.gaussian_noise(count, generator)
        if self.options.distill == "gaussian":
            return noise
        return self.chunk(self.distribution.squash(noise.flatten(1)))

    @property
    def drawn_rows(self) -> int:
        """The last rows of an action, which the actor draws: all of them."""
        return self.rows

    @property
    def actor_inputs(self) -> Layout:
        """What the actor sees: the observation."""
        return self.obs_layout

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; during the warm-up N(0, I), if not ``deterministic``."""
        if deterministic:
            return self.mode(obs)
        if self.decisions < self.options.warmup:
            return self.gaussian_noise(len(obs), self.generators["warm_up"])
        return self.sample(obs)[0]

    @torch.no_grad()
    def mode(self, obs: torch.Tensor) -> torch.Tensor:
        """Noise ``[B, Tp, Da]`` at the mean of the policy; turns with the scene if the actor does.

        Diagnostics of symmetry measure it.
        """
        return self.chunk(self.distribution.squash(self.moments(obs)[0]))

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
        q = self._q(self.critic.weights(), self._features(obs), judged)
        return q / self.options.reward_scale

    @torch.no_grad()
    def noise_q_values(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """The same by the critics that the actor climbs (with ``aliased``: the distilled ones)."""
        if self.options.critic_kind != "aliased":
            return self.q_values(obs, noise)
        weights = self.networks["noise_critic"].weights()
        q = self._q(weights, self._features(obs), noise.to(self.dtype).flatten(1))
        return q / self.options.reward_scale

    def judged(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """What the critics see of flat noise ``[B, Tp * Da]``: itself, or the executed actions.

        Args:
            obs: in environment units.
            noise: actions are differentiable with respect to it.
        """
        if self.options.critic_kind == "noise":
            return noise
        return self.executed(obs, self.chunk(noise)).flatten(-2)

    def executed(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """The actions ``[B, Ta, Da]`` that noise ``[B, Tp, Da]`` is decoded to."""
        return self.decode(obs, noise)[..., : self.context.execute, :]

    def reduced(self, q: torch.Tensor) -> torch.Tensor:
        """One value per state, ``[B]``, of all critics' values ``[critics, B]``."""
        return q.mean(-2) if self.options.reduce == "mean" else q.amin(-2)

    def random(self, draw: Callable[[torch.Generator], torch.Tensor]) -> torch.Tensor:
        """A draw by the agent's generator; in a team a draw by each member's, stacked."""
        drawn = [draw(generator) for generator in self.streams]
        return torch.stack(drawn) if self.stacked else drawn[0]

    @property
    def alpha(self) -> torch.Tensor:
        """Entropy weight."""
        return self.multipliers["alpha"].value

    def chunk(self, noise: torch.Tensor) -> torch.Tensor:
        """Flat noise ``[..., Tp * Da]`` as a chunk ``[..., Tp, Da]``."""
        return noise.unflatten(-1, (-1, self.act_layout.dim))

    # Learning.

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Train for the whole budget."""
        return budget.env_steps

    def observe(self, transition: Transition) -> None:
        """Store the decisions; each one after the warm-up adds ``utd`` due updates."""
        fields = vars(transition)
        self.replay.add({**fields, **self._banked(fields[self.bank_at])})
        decisions = len(transition.reward)
        if self.decisions >= self.options.warmup:
            self.owed += decisions * self.options.utd
        self.decisions += decisions

    def batches(self) -> Iterator[Batch]:
        """One batch for each update that is due."""
        while self.owed >= 1:
            self.owed -= 1
            yield Batch() if self.in_graphs else self.new_batch()

    def new_batch(self) -> Batch:
        """Transitions from the replay."""
        return self.replay.sample(self.options.batch_size)

    @property
    def in_graphs(self) -> bool:
        """Whether updates are CUDA graphs; these draw their batches, those given to them are empty.

        Only this very class says whether all that it does can be repeated by a graph.
        """
        return self.device.type == "cuda" and can_join(type(self))

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step of critics, actor, multipliers and target critics.

        Args:
            batch: from :meth:`batches`.

        Returns:
            Scalars as tensors on the device; reading them waits for the device.
        """
        distillations = self.count_update()
        if not batch:
            if self.graphs is None:
                streams = [self.generator, self.replay.generator]
                self.graphs = GraphedUpdates(self, self._draw, [self.replay], streams)
            return self.graphs.update(distillations)
        batch = self.augment(batch)
        return {**self.learn(batch, distillations), **self.after_update(batch)}

    def _draw(self) -> Batch:
        """A batch as an update sees it."""
        return self.augment(self.new_batch())

    def count_update(self) -> int:
        """Count an update; returns how many distillations it makes."""
        self.updates += 1
        if self.options.critic_kind != "aliased":
            return 0
        owed = self.distillation_owed + self.options.distill_steps
        self.distillation_owed = owed - int(owed)
        return int(owed)

    def tensors(self) -> list[torch.Tensor]:
        """All that an update changes."""
        trained = [*self.optimizers.values(), *(one.optimizer for one in self.multipliers.values())]
        changed = [tensor for adam in trained for tensor in adam.tensors()]
        return changed + _flat(self.target)

    def learn(self, batch: Batch, distillations: int) -> dict[str, torch.Tensor]:
        """An update without counting it; in a team with the batches of all members, stacked."""
        both = self._features(torch.cat([batch.obs, batch.next_obs], -2))
        obs, next_obs = both.chunk(2, -2)
        batch = batch.replace(features=obs)
        with torch.no_grad():
            following = self.drawn(batch.next_obs, next_obs)
            target = self.critic_target(batch, following)
        q = self._q(self.critic.weights(), obs, self._stored(batch))
        critic_loss = self.critic_loss(q, target, batch)
        self._descend("critic", critic_loss, batch)
        scalars = {"losses/critic": critic_loss.detach()}
        judge = detached(self.critic.weights())  # no gradient of other losses in the critics

        for _ in range(distillations):
            scalars["losses/distillation"] = self._distil(batch, obs, following, judge)

        scalars |= self._improve(batch, judge)

        with torch.no_grad():
            averaged, newest = (in_chunks(_flat(weights)) for weights in (self.target, judge))
            torch._foreach_lerp_(averaged, newest, self.options.tau)
        q = q.detach() / self.options.reward_scale
        return {
            **scalars,
            "train/q_mean": q.mean((-2, -1)),
            "train/q_max_abs": q.abs().amax((-2, -1)),
            "train/target_mean": target.mean(-1) / self.options.reward_scale,
        }

    def _improve(self, batch: Batch, judge: Weights) -> dict[str, torch.Tensor]:
        """One step of the actor and the temperature; returns scalars."""
        drawn, alpha = self.drawn_to_improve(batch), self.alpha
        if self.options.critic_kind == "aliased":
            climbed = detached(self.networks["noise_critic"].weights())
            values = self._q(climbed, drawn.obs, drawn.noise)
        else:
            values = self._q(judge, drawn.obs, drawn.judged)
        actor_loss = self.actor_loss(values, drawn.noise, drawn.log_prob, batch)
        self._descend("actor", actor_loss, batch)
        entropy = -drawn.log_prob.detach().mean(-1)
        return {
            "losses/actor": actor_loss.detach(),
            "losses/alpha": self.multipliers["alpha"].step(entropy - self.target_entropy),
            "train/alpha": alpha,
            "train/entropy": entropy,
        }

    def drawn(self, obs: torch.Tensor, features: torch.Tensor) -> Drawn:
        """Noise that the actor draws at observations.

        Args:
            obs: in environment units.
            features: the same, normalised.
        """
        noise, log_prob = self._sample(*self._heads(self.actor.weights(), features))
        return Drawn(features, noise, log_prob, lambda: self.judged(obs, noise))

    def drawn_to_improve(self, batch: Batch) -> Drawn:
        """Noise that the actor draws at the states of a batch, to be improved."""
        return self.drawn(batch.obs, batch.features)

    def _distil(
        self, batch: Batch, obs: torch.Tensor, following: Drawn, judge: Weights
    ) -> torch.Tensor:
        """One step of the noise critics towards the action critics; returns the loss.

        The actor's noise is that of the next observations, which the target has decoded already.
        """
        source, points = self.options.distill, []
        if source != "actor":
            points.append((obs, *self._random_pairs(batch)))
        if source in ("actor", "mixture"):
            points.append((following.obs, following.noise, following.judged))
        features, noise, actions = (torch.cat(x, -2) for x in zip(*points, strict=True))
        with torch.no_grad():
            wanted = self._q(judge, features, actions)
        q = self._q(self.networks["noise_critic"].weights(), features, noise)
        loss = (q - wanted).square().mean(-1).sum(-1)
        self._descend("noise_critic", loss, batch)
        return loss.detach()

    def _random_pairs(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """Random noise for each row and the actions that it is decoded to, both flat."""
        count, size = batch.obs.shape[-2], self.options.noise_bank
        if not size:
            noise = self.random(lambda generator: self.bank_noise(count, generator))
            return noise.flatten(-2), self.executed(batch.obs, noise).flatten(-2)
        picked = self.random(
            lambda generator: torch.randint(size, (count,), generator=generator, device=self.device)
        )
        banks = (batch[name].flatten(-2) for name in BANK)
        noise, actions = (x.take_along_dim(picked[..., None, None], -2).squeeze(-2) for x in banks)
        return noise, actions

    @property
    def _bank_size(self) -> int:
        """Random noises that are decoded when a decision is stored."""
        banks = self.always_banks or self.options.critic_kind == "aliased"
        return self.options.noise_bank if banks else 0

    @torch.no_grad()
    def _banked(self, obs: torch.Tensor) -> dict[str, torch.Tensor]:
        """Random noises for each stored decision and what they are decoded to."""
        if not (size := self._bank_size):
            return {}
        noise = self.bank_noise(size * len(obs), self.generators["bank"])
        actions = self.executed(obs.repeat_interleave(size, 0), noise)
        both = (noise, actions)
        return {name: x.unflatten(0, (len(obs), size)) for name, x in zip(BANK, both, strict=True)}

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Errors of Q, equivariance errors, temperature (docs/metrics.md)."""
        return critic_diagnostics(self, played)

    # Saving.

    def description(self) -> dict[str, Any]:
        """Agent, geometry and sizes; a checkpoint must have the same."""
        keys = ("group", "width", "depth", "critics", "layer_norm", "activation")
        sizes = {key: getattr(self.options, key) for key in keys}
        named = {"critic": self.options.critic_kind, "noise_bound": self.options.noise_bound}
        return {**super().description(), **sizes, **named}

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, multipliers, generators; loads with ``weights_only=True``."""
        self.synchronize()
        return owned(
            {
                **super().state_dict(),
                "networks": {k: network.state_dict() for k, network in self.networks.items()},
                "optimizers": {k: adam.state_dict() for k, adam in self.optimizers.items()},
                "target": _flat(self.target),
                "multipliers": {k: m.state_dict() for k, m in self.multipliers.items()},
                "generators": {k: g.get_state() for k, g in self.generators.items()},
                **{name: getattr(self, name) for name in COUNTERS},
            }
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            UserError: if the checkpoint is of another agent, layout or size.
        """
        super().load_state_dict(state)
        for kind in ("networks", "optimizers", "multipliers"):
            for name, loadable in getattr(self, kind).items():
                loadable.load_state_dict(state[kind][name])
        with torch.no_grad():
            for tensor, stored in zip(_flat(self.target), state["target"], strict=True):
                tensor.copy_(tensor_like(stored, tensor))
        for name, generator in self.generators.items():
            continue_stream(generator, state["generators"][name])
        for name in COUNTERS:
            setattr(self, name, type(getattr(self, name))(state[name]))
        if not 0 <= max(self.owed, self.distillation_owed) < MOST_OWED:
            raise ValueError(f"{self.owed} and {self.distillation_owed} updates are due")

    # Inner parts.

    def _members(self) -> dict[str, list[list[nn.Module]]]:
        """The layers of each member of each network, new ones."""
        judged = self.noise_inputs if self.options.critic_kind == "noise" else self.action_inputs
        members = {"actor": self._actors(), "critic": self._critics(judged)}
        if self.options.critic_kind == "aliased":
            members["noise_critic"] = self._critics(self.noise_inputs)
        return members

    def _actors(self) -> list[list[nn.Module]]:
        return [self.actor_layers()]

    def _critics(self, inputs: Layout) -> list[list[nn.Module]]:
        return [self.critic_layers(inputs) for _ in range(self.options.critics)]

    def _descend(self, name: str, loss: torch.Tensor, batch: Batch) -> None:
        self.optimizers[name].descend(loss, self.penalty(name, batch))
        with torch.no_grad():
            self.settle(name)
        self.networks[name].changed()

    @property
    def vector_fields(self) -> dict[str, Layout]:
        """The fields of a batch that turn with the scene, and the geometry of their last axis."""
        states = dict.fromkeys(("obs", "next_obs"), self.obs_layout)
        return {**states, **dict.fromkeys(("noise", "actions", *BANK), self.act_layout)}

    def _new_replay(self) -> ReplayBuffer:
        act, obs = self.act_layout.dim, (self.obs_layout.dim,)
        noise, actions = (self.rows, act), (self.context.execute, act)
        shapes = {"obs": obs, "noise": noise, "actions": actions, "reward": (), "next_obs": obs}
        shapes |= {"terminal": (), "truncated": ()}
        if size := self._bank_size:
            shapes |= {BANK[0]: (size, *noise), BANK[1]: (size, *actions)}
        capacity, seed = self.options.replay_capacity, self.context.seed
        return ReplayBuffer(capacity, shapes, self.device, seed, self.dtype)

    def _stored(self, batch: Batch) -> torch.Tensor:
        """What the critics see of a stored decision, flat."""
        return (batch.noise if self.options.critic_kind == "noise" else batch.actions).flatten(-2)

    def _features(self, obs: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return self.context.normalize_obs(obs).to(self.dtype)

    def _heads(self, policy: Weights, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log-scale of what the actor draws where it sees ``obs``."""
        return self.distribution.parameters_of(self._actor_output(policy, obs))

    def _actor_output(self, policy: Weights, obs: torch.Tensor) -> torch.Tensor:
        """``[B, dim]`` of ``actor_layout``."""
        return self.actor.apply_weights(policy, obs).squeeze(-3)

    def _q(self, critics: Weights, obs: torch.Tensor, judged: torch.Tensor) -> torch.Tensor:
        """Values ``[critics, B]`` of normalised observations, and flat noise or actions."""
        return self.critic.apply_weights(critics, torch.cat([obs, judged], -1)).squeeze(-1)

    def _sample(
        self, mean: torch.Tensor, log_scale: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return self.distribution.sample(mean, log_scale, self._eps(mean))

    def _eps(self, mean: torch.Tensor) -> torch.Tensor:
        """N(0, I) in the shape of the mean."""
        shape, device, dtype = mean.shape[-2:], self.device, self.dtype
        return self.random(
            lambda generator: torch.randn(shape, generator=generator, device=device, dtype=dtype)
        )


def can_join(agent_class: type) -> bool:
    """Whether agents of a class can be members of a team."""
    return (
        issubclass(agent_class, SacAgent)
        and bool(vars(agent_class).get("in_teams"))
        and agent_class.after_update is SacAgent.after_update
    )


def _flat(weights: Weights) -> list[torch.Tensor]:
    return [tensor for layer in weights for tensor in layer]
