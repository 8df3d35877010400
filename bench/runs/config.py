"""Everything that determines a run; the same configuration gives the same record on the CPU."""

from __future__ import annotations

import dataclasses
import difflib
import functools
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from pydantic import TypeAdapter, ValidationError

from symsteer.agents.sac import SacConfig
from symsteer.errors import UserError
from symsteer.policies.base import PolicyConfig
from symsteer.variant import parse_variant, variant_text

LARGEST_COUNT = 10**12
LARGEST_BATCH = 100_000

LONGEST_VARIANT = 120
"""Characters; the variant is a part of the run's name."""


@dataclass(frozen=True)
class DemonstrationConfig:
    """Demonstrations of the unbroken task by the scripted expert."""

    mode: Literal["clean", "diverse"] = "diverse"
    """`diverse` perturbs the expert and keeps successes; a policy trained on `clean` ones leaves
    little to steer."""
    count: int = 50
    """Number of demonstrations."""
    seed: int = 0
    """Seed of the collection."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Held-out episodes, the same initial states for every agent, variant and seed."""

    every: int = 5_000
    """Control steps of training between two evaluations."""
    episodes: int = 50
    """Episodes of an evaluation during training."""
    final_episodes: int = 100
    """Episodes of the last evaluation, the one that tables report."""
    diagnostic_episodes: int = 32
    """Stochastic on-policy episodes against whose returns Q is held at every evaluation."""
    steerability_states: int = 24
    """Initial states of the base policy's steerability report, each with 16 noise draws."""


STEERING = SacConfig(
    lr=6e-4,
    alpha_lr=6e-4,
    tau=0.015,
    width=128,
    batch_size=192,
    utd=0.3,
    warmup=1280,
    # The cost of one decision of four steps becomes 1.
    reward_scale=0.25,
)
"""The learner's settings: many environments and few updates, because data are cheap here and a
critic trained hard on few decisions is exploited by the actor. Chosen on PickCube, floating,
unbroken, with the equivariant and the standard agent, seeds 0 and 1."""


@dataclass(frozen=True)
class RunConfig:
    """One steering run."""

    task: str = "PickCube-v1"
    """Task; `symsteer list` names them."""
    embodiment: str = "floating"
    """`floating` (gripper without an arm: near-exact symmetry) or `panda` (arm)."""
    variant: str = "none"
    """How the symmetry is broken: `none`, `action_gain:0.5`, or several joined with `+`."""
    agent: str = "equivariant"
    """Agent; `symsteer list` names them."""
    seed: int = 0
    """Seed of the run: networks, exploration, training episodes."""
    env_steps: int = 50_000
    """Budget in control steps, summed over the parallel environments."""
    num_envs: int = 64
    """Parallel training environments."""
    checkpoint_every: int = 250
    """Control steps of each environment between two checkpoints. There all environments begin new
    episodes in fresh scenes, for PhysX remembers contacts that no checkpoint can hold."""
    sim: Literal["cpu", "cuda"] = "cpu"
    """Where physics runs."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where networks run."""
    demonstrations: DemonstrationConfig = field(default_factory=DemonstrationConfig)
    policy: PolicyConfig = field(default_factory=lambda: PolicyConfig(execute=4, sampling_steps=4))
    policy_seed: int = 0
    """Seed of the base policy's training; runs that share it share the base policy."""
    sac: SacConfig = field(default_factory=lambda: STEERING)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        _check_plain(dataclasses.asdict(self), "", "")
        counts = {
            **{name: getattr(self, name) for name in ("env_steps", "num_envs", "checkpoint_every")},
            "demonstrations.count": self.demonstrations.count,
            **{f"evaluation.{k}": v for k, v in dataclasses.asdict(self.evaluation).items()},
        }
        for name, count in counts.items():
            if not 1 <= count <= LARGEST_COUNT:
                raise UserError(f"{name} is {count}; it must lie between 1 and 10^12")
        if self.num_envs > LARGEST_BATCH:
            raise UserError(f"num_envs is {self.num_envs}; it must not exceed {LARGEST_BATCH}")
        seeds = {
            "seed": self.seed,
            "policy_seed": self.policy_seed,
            "demonstrations.seed": self.demonstrations.seed,
        }
        for name, seed in seeds.items():
            if not 0 <= seed < 2**32:
                raise UserError(f"{name} is {seed}; it must lie in [0, 2^32)")
        if len(self.variant) > LONGEST_VARIANT:
            raise UserError(
                f"the variant {self.variant[:40]!r}... has {len(self.variant)} characters; it must "
                f"not have more than {LONGEST_VARIANT}, so join fewer of them"
            )
        # The variant is a part of the run's identity, however its strengths were written.
        object.__setattr__(self, "variant", variant_text(parse_variant(self.variant)))

    def to_json(self) -> dict[str, Any]:
        """Nested plain data."""
        return dataclasses.asdict(self)


FIRST_TRAINING_SEED = 2**22
"""Episodes of evaluation, diagnostics and steerability have smaller seeds."""


def training_seeds(run_seed: int, start: int, count: int) -> list[int]:
    """Seeds of ``count`` training episodes, for the ``start``-th fresh start of a run."""
    words = np.random.SeedSequence((run_seed, start)).generate_state(count, np.uint64)
    span = 2**31 - FIRST_TRAINING_SEED
    return [FIRST_TRAINING_SEED + int(word % span) for word in words]


@functools.cache
def _adapter() -> TypeAdapter[RunConfig]:
    # Made once: a suite has thousands of configurations, and making it takes longer than using it.
    return TypeAdapter(RunConfig)


def build_config(data: Mapping[str, Any], source: str) -> RunConfig:
    """A run's configuration from nested plain data; what is left out keeps its default.

    Args:
        data: as :meth:`RunConfig.to_json` returns it, or a part of that.
        source: where the data come from, for messages.

    Raises:
        UserError: on an unknown key (with the nearest valid one) or a value of a wrong type.
    """
    defaults = RunConfig().to_json()
    _check_nested_keys(data, defaults, source, "")
    _check_plain(data, f"{source}: ", "")
    # As JSON, in which strictness still takes 1 for 1.0, but "1" or true for no number.
    text = json.dumps(_merge(defaults, data))
    try:
        return _adapter().validate_json(text, strict=True)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        problem = first["msg"].removeprefix("Value error, ")
        given = "" if isinstance(first["input"], dict) else f" (got {first['input']!r})"
        raise UserError(f"{source}: {key}{': ' * bool(key)}{problem}{given}") from error


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one, keys joined by dots, e.g. ``sac.critic_lr``."""
    found: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[prefix + key] = value
    return found


def check_keys(data: Iterable[str], valid: Iterable[str], source: str, prefix: str = "") -> None:
    """Refuse keys that are not valid.

    Raises:
        UserError: naming the nearest valid key.
    """
    valid = sorted(valid)
    for key in data:
        if key not in valid:
            close = difflib.get_close_matches(key, valid, n=1)
            hint = f"did you mean {prefix}{close[0]}?" if close else f"valid: {', '.join(valid)}"
            raise UserError(f"{source}: there is no key {prefix + key!r}; {hint}")


def _merge(defaults: dict[str, Any], data: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _merge(value, data[key])
        if key in data and isinstance(value, dict)
        else data.get(key, value)
        for key, value in defaults.items()
    }


def _check_nested_keys(
    data: Mapping[str, Any], defaults: dict[str, Any], source: str, prefix: str
) -> None:
    check_keys(data, defaults, source, prefix)
    for key, value in data.items():
        if isinstance(defaults[key], dict):
            if not isinstance(value, dict):
                raise UserError(f"{source}: {prefix}{key} must be a table, not {value!r}")
            _check_nested_keys(value, defaults[key], source, f"{prefix}{key}.")


def _check_plain(data: Any, head: str, key: str) -> None:
    """Refuse what JSON has no word for: NaN, infinities, and TOML's dates and times."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            _check_plain(value, head, f"{key}.{name}" if key else name)
    elif isinstance(data, list | tuple):
        for value in data:
            _check_plain(value, head, key)
    elif isinstance(data, float):
        if not math.isfinite(data):
            raise UserError(f"{head}{key} is {data}; it must be finite")
    elif data is not None and not isinstance(data, str | int):
        raise UserError(f"{head}{key} must be a number, a text or a flag, not {data!r}")


def content_key(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the JSON-able parts."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]
