"""The configuration of a run. On the CPU, the same configuration gives the same record."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from pydantic import TypeAdapter, ValidationError

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentOptions
from symsteer.bench.tasks import TASKS, task_name
from symsteer.bench.variants import VARIANTS
from symsteer.bench.variants.levels import with_numbers
from symsteer.errors import UserError
from symsteer.leaderboard.records import without_retired
from symsteer.names import check
from symsteer.policies import POLICIES
from symsteer.policies.contract import PolicyOptions
from symsteer.variant import VariantSpec, parse_variant, variant_text

LARGEST_COUNT = 10**12
LARGEST_BATCH = 100_000

LONGEST_VARIANT = 120
"""In characters; the variant is part of the run's name."""

if TYPE_CHECKING:
    LaterSeed = int
else:  # None may be given; it is a number once the run's configuration is complete
    LaterSeed = int | None


@dataclass(frozen=True)
class DemonstrationConfig:
    """Demonstrations of the unbroken task by the scripted expert."""

    mode: Literal["clean", "diverse"] = "diverse"
    """`diverse` perturbs the expert and keeps successes. A policy trained on `clean` ones leaves
    little to steer."""
    count: int = 50
    """Number of demonstrations."""
    seed: LaterSeed = None  # type: ignore[assignment]
    """Seed of the collection; None: the run's seed."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Held-out episodes. Their initial states are the same for every agent, variant and seed."""

    every: int = 5_000
    """Control steps of training between two evaluations."""
    episodes: int = 50
    """Episodes of an evaluation during training."""
    final_episodes: int = 100
    """Episodes of the last evaluation, which tables report."""
    diagnostic_episodes: int = 8
    """Long episodes of the stochastic actor at an evaluation; Q is compared with their returns.
    Half of them begin with noise from N(0, I)."""
    final_diagnostic_episodes: int = 64
    """Long episodes at the last evaluation."""
    steerability_states: int = 24
    """Initial states of the base policy's steerability report, each with 16 noise draws."""


@dataclass(frozen=True)
class RunConfig:
    """One steering run.

    Options of the agent and of the policy that are not given have their defaults. Seeds of the base
    policy and of the demonstrations that are not given are the run's seed: run and base policy are
    one factor, so several runs say something about base policies, not about one of them.
    """

    task: str = "PickCube-v1"
    """Task; `symsteer list` names them."""
    embodiment: str = "floating"
    """`floating` (gripper without an arm: near-exact symmetry) or `panda` (arm)."""
    variant: str = "none"
    """How the symmetry is broken: `none`, `action_gain:0.5`, or several joined with `+`."""
    agent: str = "equivariant"
    """Agent; `symsteer list` names them. Your own class: `package.module:Class`."""
    seed: int = 0
    """Seed of the run: networks, exploration, training episodes, and the base policy with its
    demonstrations."""
    env_steps: int = 50_000
    """Budget in control steps, summed over the parallel environments."""
    num_envs: int = 64
    """Parallel training environments."""
    checkpoint_every: int = 250
    """Control steps of each environment between two checkpoints. After each checkpoint, all
    environments begin new episodes in fresh scenes, because a checkpoint cannot contain the
    contacts that PhysX remembers."""
    keep_replay: bool = False
    """Write all decisions to `replay.safetensors` at the end, to learn from them."""
    sim: Literal["cpu", "cuda"] = "cpu"
    """Device of the simulation."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the networks."""
    demonstrations: DemonstrationConfig = field(default_factory=DemonstrationConfig)
    policy_name: str = "edp"
    """Base policy; `symsteer list` names them. Your own class: `package.module:Class`."""
    policy: PolicyOptions = None  # type: ignore[assignment]
    policy_seed: LaterSeed = None  # type: ignore[assignment]
    """Seed of the base policy's training; None: the run's seed."""
    agent_options: AgentOptions = None  # type: ignore[assignment]
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        for task in self.policy_tasks:
            TASKS.check_allowed(task_name(task))
        for kind, name, options in (
            ("agent_options", self.agent, AGENTS.get(self.agent).Options),
            ("policy", self.policy_name, POLICIES.get(self.policy_name).Options),
        ):
            given = getattr(self, kind)
            if given is None:
                object.__setattr__(self, kind, options())
            elif type(given) is not options:
                raise UserError(
                    f"{kind} are {type(given).__name__}, but {name!r} takes {options.__name__}"
                )
        if len(self.policy_tasks) > 1:
            # All of them, so that runs on each of these tasks ask for the same base policy.
            policy = dataclasses.replace(self.policy, tasks=self.policy_tasks)  # type: ignore[call-arg]
            object.__setattr__(self, "policy", policy)
        if self.policy_seed is None:
            object.__setattr__(self, "policy_seed", self.seed)
        if self.demonstrations.seed is None:
            drawn = dataclasses.replace(self.demonstrations, seed=self.seed)
            object.__setattr__(self, "demonstrations", drawn)
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
        object.__setattr__(self, "variant", with_numbers(self.variant, *self.place))
        # The variant is a part of the run's identity: each strength in its shortest form.
        object.__setattr__(self, "variant", variant_text(self.variants))
        for spec in self.variants:
            VARIANTS.check_allowed(spec.name)

    @property
    def place(self) -> tuple[str, str]:
        """Task and embodiment, for which levels of variants are defined."""
        return self.task, self.embodiment

    @property
    def policy_tasks(self) -> tuple[str, ...]:
        """The tasks whose demonstrations the base policy is trained on."""
        return tuple(sorted({self.task, *getattr(self.policy, "tasks", ())}))

    @functools.cached_property
    def variants(self) -> tuple[VariantSpec, ...]:
        """The variant, parsed."""
        return parse_variant(self.variant)

    def to_json(self) -> dict[str, Any]:
        """Nested plain data; :func:`build_config` reads it."""
        data = dataclasses.asdict(self)
        data["policy"] = {"name": data.pop("policy_name"), **data["policy"]}
        return json.loads(json.dumps(data))


def build_config(data: Mapping[str, Any], source: str) -> RunConfig:
    """A run's configuration from nested plain data; missing keys have their defaults.

    Args:
        data: as from :meth:`RunConfig.to_json`, or a part of it.
        source: the origin of the data, for messages.

    Raises:
        UserError: for an unknown key (the message has the nearest valid one) or a wrong type.
    """
    data = dict(data)
    _check_plain(data, f"{source}: ", "")
    tables = {key: _table(data, key, source) for key in ("policy", "agent_options")}
    policy_name = tables["policy"].pop("name", RunConfig.policy_name)
    agent = data.get("agent", RunConfig.agent)
    for key, name in (("policy.name", policy_name), ("agent", agent)):
        if not isinstance(name, str):
            raise UserError(f"{source}: {key} must be a text in quotes, not {name!r}")
    try:
        defaults, plain = _defaults(agent, policy_name)
        tables["agent_options"] = without_retired(tables["agent_options"], plain["agent_options"])
        _check_nested_keys({**data, **tables}, plain, source, "")
        chosen = {
            key: _validated(type(getattr(defaults, key)), {**plain[key], **table}, key)
            for key, table in tables.items()
        }
        rest = {key: value for key, value in data.items() if key not in tables}
        merged = _merge({key: plain[key] for key in plain if key not in tables}, rest)
        config = _validated(RunConfig, {**merged, "policy_name": policy_name}, "")
        return dataclasses.replace(config, **chosen)
    except UserError as error:
        where = "" if str(error).startswith(f"{source}: ") else f"{source}: "
        raise UserError(f"{where}{error}") from error


def content_key(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the JSON-able parts."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@functools.cache
def _defaults(agent: str, policy_name: str) -> tuple[RunConfig, dict[str, Any]]:
    """The default configuration of an agent and a policy, and its plain data without their names.

    Cached per pair, because a suite can have thousands of configurations.
    """
    defaults = RunConfig(agent=agent, policy_name=policy_name)
    plain = defaults.to_json()
    del plain["policy"]["name"]
    # Not those of these defaults: each run resolves them with its own seed.
    plain["policy_seed"] = plain["demonstrations"]["seed"] = None
    return defaults, plain


@functools.cache
def _adapter(of: type) -> TypeAdapter[Any]:
    return TypeAdapter(of)


def _validated(of: type, data: Mapping[str, Any], prefix: str) -> Any:
    """An instance of a dataclass from plain data."""
    try:
        # As JSON: strict mode then accepts 1 for 1.0, but neither "1" nor true for a number.
        return _adapter(of).validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in (*([prefix] if prefix else []), *first["loc"]))
        problem = first["msg"].removeprefix("Value error, ")
        given = "" if isinstance(first["input"], dict) else f" (got {first['input']!r})"
        raise UserError(f"{key}{': ' * bool(key)}{problem}{given}") from error


def _table(data: Mapping[str, Any], key: str, source: str) -> dict[str, Any]:
    table = data.get(key, {})
    if not isinstance(table, Mapping):
        raise UserError(f"{source}: {key} must be a table, not {table!r}")
    return dict(table)


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
    check("key", [prefix + key for key in data], [prefix + key for key in sorted(defaults)], source)
    for key, value in data.items():
        if isinstance(defaults[key], dict):
            if not isinstance(value, dict):
                raise UserError(f"{source}: {prefix}{key} must be a table, not {value!r}")
            _check_nested_keys(value, defaults[key], source, f"{prefix}{key}.")


def _check_plain(data: Any, head: str, key: str) -> None:
    """Refuse values that JSON does not have: NaN, infinities, and TOML's dates and times."""
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
