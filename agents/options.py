"""The options of all learners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, get_args, get_origin, get_type_hints

from symsteer.agents.agent import AgentOptions
from symsteer.agents.networks import Activation
from symsteer.errors import UserError
from symsteer.names import check
from symsteer.policies.geometry import Group

CriticKind = Literal["noise", "aliased", "sampler"]
Reduce = Literal["min", "mean"]
Distill = Literal["gaussian", "squashed", "actor", "mixture"]
Layers = Literal["plain", "equivariant"]


@dataclass(frozen=True)
class SacOptions(AgentOptions):
    """Options of all SAC agents.

    The defaults are the setting that tuning chose for most of the core agents (docs/tuning.md);
    :func:`~symsteer.agents.presets.defaults_of` gives an agent those of a preset.
    """

    critic_kind: CriticKind = "aliased"
    """What the critics judge. `noise`: the noise (DSRL-SAC). `aliased`: the executed actions; noise
    critics are distilled from them for the actor (DSRL-NA). `sampler`: the executed actions; the
    actor's gradient passes through the sampler."""
    gamma: float = 0.95
    """Discount per decision (not per control step)."""
    lr: float = 2.4e-3
    """Adam's learning rate of actor and critics."""
    alpha_lr: float = 3e-4
    """Adam's learning rate of log alpha."""
    batch_size: int = 128
    """Transitions per update."""
    tau: float = 0.016
    """Weight of the online critics when the target critics are updated."""
    critics: int = 4
    """Number of critics."""
    reduce: Reduce = "mean"
    """One value of several critics: the smallest, or the mean."""
    timeouts_terminal: bool = False
    """Do not bootstrap where the time limit ended an episode (as in the published code of DSRL)."""
    soft_backup: bool = False
    """Add the entropy bonus to the critics' target, as in the SAC paper."""
    target_entropy: float = 0.5
    """Target of the entropy, nats per dimension of the noise."""
    initial_alpha: float = 0.1
    """Entropy weight at the start."""
    noise_bound: float = 1.0
    """Largest norm of an irrep block of the noise."""
    distill: Distill = "squashed"
    """Noise at which `aliased` distils. `gaussian`: N(0, I). `squashed`: N(0, I) inside the bound.
    `actor`: the actor's. `mixture`: half squashed, half the actor's."""
    distill_steps: float = 0.5
    """Gradient steps of the noise critics per update."""
    noise_bank: int = 4
    """Random noises that `aliased` decodes once per stored decision and distils from; 0: decode new
    ones in every step."""
    utd: float = 0.5
    """Updates per decision (not per control step), for any number of environments."""
    warmup: int = 1280
    """Decisions (not control steps) before the first update. Their noise is N(0, I), as that of the
    base policy alone."""
    replay_capacity: int = 200_000
    """Capacity of the replay buffer, in decisions."""
    reward_scale: float = 0.25
    """Factor on rewards in training (0.25: one decision of four steps costs 1). Reported Q-values
    are in unscaled reward units."""
    width: int = 128
    """Hidden features per layer. With a group of order n they form width/n regular fields."""
    depth: int = 2
    """Hidden layers."""
    activation: Activation = "relu"
    """Nonlinearity of the hidden layers."""
    layer_norm: bool = True
    """Normalise hidden features; without it Q often diverges."""
    group: str = "C8"
    """Symmetry group, C_n or D_n. Equivariant layers, turned batches and measured equivariance
    errors use it."""
    initial_output: float = 0.01
    """Factor on the actor's output layer at initialisation; small means w starts around 0."""

    agent: ClassVar[str] = "the agent"
    """The agent in messages."""
    known_critics: ClassVar[tuple[CriticKind, ...]] = get_args(CriticKind)
    """The kinds of critics that the agent can have."""
    least_bank: ClassVar[int] = 0
    """The smallest ``noise_bank`` that the agent can have."""
    entropy_bonus: ClassVar[bool] = True
    """Whether ``soft_backup`` means something for the agent."""

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self)).items():
            if get_origin(kind) is Literal:
                check(name, [getattr(self, name)], get_args(kind))
        if self.critic_kind not in self.known_critics:
            known = " or ".join(self.known_critics)
            raise UserError(f"{self.agent} judges executed actions: its critic_kind is {known}")
        if self.noise_bank < self.least_bank:
            raise UserError(
                f"{self.agent} needs a noise_bank of at least {self.least_bank}, not "
                f"{self.noise_bank}"
            )
        if self.soft_backup and not self.entropy_bonus:
            raise UserError(f"{self.agent} has no entropy bonus: leave out soft_backup")
        self._require(
            "be positive",
            lambda value: value > 0,
            *("lr", "alpha_lr", "batch_size", "critics", "width", "depth", "noise_bound"),
            *("initial_alpha", "reward_scale", "replay_capacity", "utd", "distill_steps"),
        )
        self._require(
            "not be negative", lambda value: value >= 0, "warmup", "initial_output", "noise_bank"
        )
        self._require("lie in [0, 1)", lambda value: 0 <= value < 1, "gamma")
        self._require("lie in (0, 1]", lambda value: 0 < value <= 1, "tau")
        _ = Group.parse(self.group).order

    def _require(self, rule: str, holds: Callable[[Any], bool], *names: str) -> None:
        for name in names:
            if not holds(getattr(self, name)):
                raise UserError(f"agent option {name} must {rule}, not {getattr(self, name)}")


@dataclass(frozen=True)
class EitherOptions(SacOptions):
    """Options of agents with plain or equivariant layers."""

    layers: Layers = "plain"
    """Layers of actor and critics: those of `standard`, or those of `equivariant`."""
