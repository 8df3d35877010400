"""The interface of a steering agent: its inputs, and the methods that the trainer calls.

The trainer's loop is the same for every agent::

    wanted = agent.prepare(make_env, budget)       # search or pre-training; 0: no training
    while steps < wanted:
        action = agent.act(obs)                    # noise, for most agents
        agent.observe(env.step(action))            # plays agent.decode(obs, action)
        for batch in agent.batches():              # as many as are due
            scalars = agent.update(batch)
    agent.diagnostics(played)                      # at every evaluation
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Protocol, Self, runtime_checkable

import torch

from symsteer.agents.episodes import Played
from symsteer.agents.generators import continue_stream
from symsteer.agents.networks import Ensemble, count
from symsteer.agents.replay import Batch, ReplayBuffer, Transition
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Layout

Role = Literal["reference", "learner", "control"]
"""``reference``: every learner must beat it. ``control``: trained, but must not win."""

Deterministic = Callable[[torch.Tensor], torch.Tensor]
"""``obs [B, obs_dim] -> action [B, rows, Da]``; see :class:`Agent`."""

Decode = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
Normalize = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class AgentContext:
    """The problem, as an agent sees it.

    Attributes:
        obs_layout: geometry of an observation.
        act_layout: geometry of one action, and of one noise vector of the chunk.
        horizon: Tp, actions in a chunk.
        execute: Ta, actions executed per decision.
        decode: the frozen policy, ``(obs [B, obs_dim], noise [B, Tp, Da]) -> actions [B, Tp, Da]``.
            Differentiable with respect to the noise.
        normalize_obs: scales observations ``[B, obs_dim]`` for the networks. It commutes with the
            group, as the base policy's normaliser does.
        device, dtype: of all tensors.
        seed: for the initialisation and for the agent's noise.
    """

    obs_layout: Layout
    act_layout: Layout
    horizon: int
    execute: int
    decode: Decode
    normalize_obs: Normalize
    device: torch.device = torch.device("cpu")  # noqa: RUF009 (immutable)
    dtype: torch.dtype = torch.float32
    seed: int = 0

    @classmethod
    def of(cls, policy: ChunkPolicy, device: torch.device | str = "cpu", seed: int = 0) -> Self:
        """The problem of steering a frozen policy.

        Args:
            policy: on this device.
            device: of all tensors.
            seed: of the agent.
        """
        return cls(
            policy.obs_layout,
            policy.act_layout,
            policy.horizon,
            policy.execute,
            policy.decode,
            policy.observation_for_agents,
            torch.device(device),
            seed=seed,
        )

    @property
    def noise_layout(self) -> Layout:
        """Geometry of the flattened noise chunk, ``Tp * Da`` numbers."""
        return self.act_layout.repeat(self.horizon)


@dataclass(frozen=True)
class Budget:
    """What an agent may use in a run.

    Attributes:
        env_steps: control steps, summed over the parallel environments.
        num_envs: parallel training environments.
        execute: control steps per decision.
        max_episode_steps: time limit of an episode.
    """

    env_steps: int
    num_envs: int
    execute: int
    max_episode_steps: int


class NoiseEnv(Protocol):
    """The training environments, as :meth:`Agent.prepare` sees them."""

    num_envs: int
    execute: int
    max_episode_steps: int
    control_steps: int

    def training_seeds(self, start: int, count: int) -> list[int]:
        """Seeds of ``count`` training episodes, for the ``start``-th fresh start."""

    def reset(self, seeds: list[int]) -> torch.Tensor:
        """Start episodes; observations ``[N, obs_dim]``."""

    def step(self, action: torch.Tensor, /) -> Any:
        """Play actions ``[N, rows, Da]``; a transition with ``episodes``, those that ended."""


MakeEnv = Callable[[bool], NoiseEnv]
"""``make_env(ignore_terminations)``: training environments; the trainer closes them."""


@dataclass(frozen=True)
class AgentOptions:
    """For agents without options."""


class Agent:
    """Steers the frozen policy. Subclasses override what they need.

    What an agent chooses is its *action* ``[rows, Da]``. Most agents choose the noise of a chunk,
    so that ``rows`` is Tp; :meth:`decode` says what an action does.

    Attributes:
        name: in configurations and records.
        role: see :data:`Role`; the record holds it.
        Options: a frozen dataclass. Its fields become ``--agent.X`` on the command line.
        generator: draws the agent's noise. An evaluation restores its state afterwards.
        networks: all trained networks by name, ``actor`` first.
        replay: transitions, saved with each checkpoint; None for agents without a replay.
    """

    name: ClassVar[str]
    role: ClassVar[Role]
    Options: ClassVar[type] = AgentOptions

    def __init__(self, context: AgentContext, options: Any = None):
        self.context = context
        self.options = self.Options() if options is None else options
        self.device, self.dtype = torch.device(context.device), context.dtype
        self.obs_layout, self.act_layout = context.obs_layout, context.act_layout
        self.rows = self.action_rows(context)
        self.generator = self._new_generator()
        self.networks: dict[str, Ensemble] = {}
        self.replay: ReplayBuffer | None = None

    @staticmethod
    def action_rows(context: AgentContext) -> int:
        """Rows of an action: those of the noise."""
        return context.horizon

    @classmethod
    def check(cls, options: Any, budget: Budget) -> None:
        """Check the options against the budget, before anything is built.

        Raises:
            UserError: if they cannot work together; the message says what to change.
        """

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Search or pre-train, with a part of the budget.

        Returns:
            The control step at which training ends, counted from the start of the run; 0 for
            agents that do not train.
        """
        return 0

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Actions ``[B, rows, Da]`` for observations ``[B, obs_dim]``.

        Args:
            obs: in environment units.
            deterministic: True in evaluations. False in training, with exploration.
        """
        raise NotImplementedError(f"{type(self).__name__} must say how it acts")

    def decode(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """What actions ``[B, rows, Da]`` do: chunks ``[B, Tp, Da]``; noise is decoded."""
        return self.context.decode(obs, action)

    def observe(self, transition: Transition) -> None:
        """Receive one decision of all training environments, e.g. to store it."""

    def batches(self) -> Iterable[Batch]:
        """Batches for the updates that are due now."""
        return ()

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One gradient step; scalars by name (``losses/...``, ``train/...``) on the device."""
        return {}

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Scalars that an evaluation reports in addition to success (docs/metrics.md)."""
        return {}

    def alternatives(self) -> Mapping[str, Deterministic]:
        """Other ways to act, whose success the final evaluation measures, too, by name."""
        return {}

    def parameter_counts(self) -> dict[str, int]:
        """Trainable parameters (``actor``; ``critic``: all others; ``total``) and ``width``."""
        sizes = {name: count(network) for name, network in self.networks.items()}
        total, actor = sum(sizes.values()), sizes.get("actor", 0)
        widths = [network.width for network in self.networks.values()]
        return {
            **{"actor": actor, "critic": total - actor, "total": total},
            "width": widths[0] if widths else 0,
        }

    def description(self) -> dict[str, Any]:
        """Properties that a checkpoint must have in common with the agent."""
        return {
            "agent": self.name,
            "obs_layout": self.obs_layout.to_json(),
            "act_layout": self.act_layout.to_json(),
            "horizon": self.context.horizon,
        }

    def state_dict(self) -> dict[str, Any]:
        """Tensors and plain data, without the replay; loads with ``weights_only=True``."""
        return {"description": self.description(), "generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken.

        Raises:
            UserError: if the checkpoint is of another agent, layout or size.
        """
        saved = state.get("description", {})
        for key, value in self.description().items():
            if saved.get(key) != value:
                raise UserError(
                    f"this checkpoint has {key} {saved.get(key)!r}, the agent has {value!r}; "
                    "load it with the run's own configuration"
                )
        continue_stream(self.generator, state["generator"])

    def gaussian_noise(self, count: int, generator: torch.Generator | None = None) -> torch.Tensor:
        """``count`` actions ``[count, rows, Da]`` with which it is the base policy: N(0, I)."""
        return torch.randn(
            count,
            self.rows,
            self.act_layout.dim,
            generator=generator or self.generator,
            device=self.device,
            dtype=self.dtype,
        )

    def _new_generator(self, stream: int = 0) -> torch.Generator:
        """A generator from the agent's seed; other streams draw other numbers."""
        # Seeds of runs are below 2^32.
        seed = self.context.seed + stream * 2**32
        return torch.Generator(device=self.device).manual_seed(seed)


@runtime_checkable
class HasCritic(Protocol):
    """An agent with Q-values, which an evaluation compares with on-policy returns."""

    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A drawn action ``[B, rows, Da]`` and its log-probability ``[B]``."""

    def q_values(self, obs: torch.Tensor, action: torch.Tensor, /) -> torch.Tensor:
        """Every critic's value in the environment's reward units, ``[critics, B]``."""
