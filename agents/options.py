"""The options of all learners."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from symsteer.agents.agent import AgentOptions
from symsteer.agents.distributions import LOG_SCALE_MAX, LOG_SCALE_MIN
from symsteer.agents.networks import Activation
from symsteer.errors import UserError
from symsteer.names import check
from symsteer.policies.geometry import Group

Critic = Literal["noise", "aliased", "sampler"]
Reduce = Literal["min", "mean", "subset"]
NoiseSource = Literal["gaussian", "squashed"]
Distill = Literal["gaussian", "squashed", "actor", "mixture"]


@dataclass(frozen=True)
class SacOptions(AgentOptions):
    """Options of all SAC agents.

    The defaults are the setting that tuning chose for most of the core agents (docs/tuning.md);
    :func:`~symsteer.agents.presets.tuned` gives each of those agents its own.
    """

    critic: Critic = "aliased"
    """What the critics judge. `noise`: the noise (DSRL-SAC). `aliased`: the executed actions; noise
    critics are distilled from them for the actor (DSRL-NA). `sampler`: the executed actions; the
    actor's gradient passes through the sampler."""
    gamma: float = 0.95
    """Discount per decision (not per environment step)."""
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
    """One value of several critics: the smallest, the mean, or the smallest of a random subset
    (REDQ; the actor then follows the mean)."""
    subset: int = 2
    """Critics in a random subset."""
    n_step: int = 1
    """Decisions whose rewards a target sums before it bootstraps."""
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
    bound_penalty: float = 0.0
    """0: the noise is squashed into the bound. Above 0: no squash; the actor pays this weight for
    the squared excess over the bound, summed over blocks."""
    distill: Distill = "squashed"
    """Noise at which `aliased` distils: N(0, I), N(0, I) squashed into the bound, the actor's, or a
    mixture of squashed and actor's in equal parts."""
    distill_steps: float = 0.5
    """Gradient steps of the noise critics per update."""
    noise_bank: int = 4
    """Random noises that `aliased` decodes once per stored decision and distils from; 0: decode new
    ones in every step."""
    utd: float = 0.5
    """Updates per collected decision, for any number of environments."""
    warmup: int = 1280
    """Decisions with random noise at the start."""
    warmup_noise: NoiseSource = "gaussian"
    """This noise: N(0, I), that is the base policy, or N(0, I) squashed into the bound."""
    learning_starts: int | None = None
    """Decisions before the first update; default: `warmup`. Fewer: updates during the warm-up."""
    actor_delay: int = 0
    """Updates of the critics alone before the first one of the actor."""
    replay_capacity: int = 200_000
    """Capacity of the replay buffer, in decisions."""
    demonstration_share: float = 0.0
    """Share of each batch that comes from the demonstrations; not with noise critics."""
    reward_scale: float = 0.25
    """Factor on rewards in training (0.25: one decision of four steps costs 1). Reported Q-values
    are in unscaled reward units."""
    width: int = 128
    """Hidden features per layer; with a group of order n they are width/n regular fields."""
    depth: int = 2
    """Hidden layers."""
    activation: Activation = "relu"
    """Nonlinearity of the hidden layers."""
    layer_norm: bool = True
    """Normalise hidden features; without it Q often diverges."""
    group: str = "C8"
    """Symmetry group, C_n or D_n, of equivariant layers and of the measured equivariance errors."""
    initial_scale: float = 0.5
    """Standard deviation of the untrained policy before the squash."""
    initial_output: float = 0.01
    """Factor on the actor's output layer at initialisation; small means w starts around 0."""

    def __post_init__(self) -> None:
        for name, choices in (
            ("critic", Critic),
            ("reduce", Reduce),
            ("distill", Distill),
            ("warmup_noise", NoiseSource),
            ("activation", Activation),
        ):
            check(name, [getattr(self, name)], get_args(choices))
        self._require(
            "be positive",
            lambda value: value > 0,
            *("lr", "alpha_lr", "batch_size", "critics", "subset", "n_step", "width", "depth"),
            *("noise_bound", "initial_alpha", "reward_scale", "replay_capacity", "utd"),
            "distill_steps",
        )
        self._require(
            "not be negative",
            lambda value: value >= 0,
            *("warmup", "initial_output", "bound_penalty", "noise_bank"),
            "actor_delay",
        )
        self._require("lie in [0, 1)", lambda value: 0 <= value < 1, "gamma", "demonstration_share")
        self._require("lie in (0, 1]", lambda value: 0 < value <= 1, "tau")
        low, high = math.exp(LOG_SCALE_MIN), math.exp(LOG_SCALE_MAX)
        self._require(
            f"lie between {low:.4f} and {high:.2f}", lambda v: low < v < high, "initial_scale"
        )
        if self.reduce == "subset" and self.subset > self.critics:
            raise UserError(
                f"agent option subset is {self.subset}, more than the {self.critics} critics"
            )
        if self.demonstration_share and self.critic == "noise":
            raise UserError(
                "agent option demonstration_share needs critics of actions, because demonstrations "
                "have no noise; choose critic aliased or sampler"
            )
        if self.learning_starts is not None:
            self._require("not be negative", lambda value: value >= 0, "learning_starts")
        _ = Group.parse(self.group).order

    @property
    def first_update(self) -> int:
        """Decisions before the first update."""
        return self.warmup if self.learning_starts is None else self.learning_starts

    def _require(self, rule: str, holds: Any, *names: str) -> None:
        for name in names:
            if not holds(getattr(self, name)):
                raise UserError(f"agent option {name} must {rule}, not {getattr(self, name)}")


def critics_of(options: type[SacOptions]) -> list[Critic]:
    """The kinds of critics that an agent's options accept."""
    found: list[Critic] = []
    for critic in get_args(Critic):
        with contextlib.suppress(UserError):
            options(critic=critic)
            found.append(critic)
    return found
