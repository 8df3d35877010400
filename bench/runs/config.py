"""The configuration of a run. On the CPU, the same configuration gives the same record."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro
from pydantic import ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

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
from symsteer.policies.files import policy_path
from symsteer.variant import VariantSpec, parse_variant, variant_text

LONGEST_VARIANT = 120
"""In characters; the variant is part of the run's name."""

STRICT = ConfigDict(strict=True, allow_inf_nan=False)

Count = Annotated[int, Field(ge=1, le=10**12)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]

if TYPE_CHECKING:
    LaterSeed = int
else:
    LaterSeed = Seed | None
LATER: Any = None
"""May be given; once a run's configuration is complete, it has a value."""


@dataclass(frozen=True, config=STRICT)
class _Checked:
    """What is built from wrong values raises a `UserError`, which names the option."""

    prefix: ClassVar[str] = ""

    @model_validator(mode="wrap")
    @classmethod
    def _explain(cls, data: Any, build: Any) -> Any:
        try:
            return build(data)
        except ValidationError as error:
            raise _mistake(error, cls.prefix) from error


@dataclass(frozen=True, config=STRICT)
class DemonstrationConfig(_Checked):
    """Demonstrations of the unbroken task by the scripted expert."""

    prefix: ClassVar[str] = "demonstrations."
    mode: Literal["clean", "diverse"] = "diverse"
    """`diverse` perturbs the expert and keeps successes. A policy trained on `clean` ones leaves
    little to steer."""
    count: Count = 50
    """Number of demonstrations."""
    seed: LaterSeed = LATER
    """Seed of the collection; None: the run's seed."""


@dataclass(frozen=True, config=STRICT)
class EvaluationConfig(_Checked):
    """Held-out episodes. Their initial states are the same for every agent, variant and seed."""

    prefix: ClassVar[str] = "evaluation."
    every: Count = 5_000
    """Control steps of training between two evaluations."""
    episodes: Count = 50
    """Episodes of an evaluation during training."""
    final_episodes: Count = 100
    """Episodes of the last evaluation, which tables report."""
    diagnostic_episodes: Count = 8
    """Long episodes of the stochastic actor at an evaluation; Q is compared with their returns.
    Half of them begin with noise from N(0, I)."""
    final_diagnostic_episodes: Count = 64
    """Long episodes at the last evaluation."""
    stochastic_episodes: Annotated[int, Field(ge=0, le=10**12)] = 0
    """Episodes of the stochastic actor at the last evaluation, to compare with the first
    `final_episodes`, which are deterministic."""
    steerability_states: Count = 24
    """Initial states of the base policy's steerability report, each with 16 noise draws."""


@dataclass(frozen=True, config=STRICT)
class RunConfig(_Checked):
    """One steering run.

    Options of the agent and of the policy that are not given have their defaults. Seeds of the base
    policy and of the demonstrations that are not given are the run's seed: run and base policy are
    one factor, so several runs say something about base policies, not about one of them.
    """

    task: str = "PickCube-v1"
    """Task; `symsteer list` names them."""
    embodiment: str = "floating"
    """`floating`: a gripper without an arm, almost exactly symmetric. `panda`: an arm."""
    variant: str = "none"
    """How the symmetry is broken: `none`, NAME:STRENGTH such as `action_gain:0.5`, or several of
    them joined with `+`."""
    agent: str = "equivariant"
    """Agent; `symsteer list` names them. Your own class: `package.module:Class`."""
    seed: Seed = 0
    """Seed of the run: networks, exploration and training episodes. The base policy and its
    demonstrations change with it, too."""
    env_steps: Count = 50_000
    """Budget: control steps, summed over the parallel environments."""
    num_envs: Annotated[int, Field(ge=1, le=100_000)] = 64
    """Parallel training environments."""
    checkpoint_every: Count = 250
    """Control steps of each environment between two checkpoints. After each checkpoint, all
    environments begin new episodes in fresh scenes, because a checkpoint cannot contain the
    contacts that PhysX remembers."""
    sim: Literal["cpu", "cuda"] = "cpu"
    """Device of the simulation: `cpu` or `cuda`."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the networks: `cpu` or `cuda`."""
    demonstrations: DemonstrationConfig = field(default_factory=DemonstrationConfig)
    policy_name: Annotated[str, tyro.conf.arg(name="policy.name")] = "edp"
    """Base policy; `symsteer list` names them. Your own class: `package.module:Class`."""
    policy: PolicyOptions = LATER
    policy_seed: LaterSeed = LATER
    """Seed of the base policy's training; None: the run's seed."""
    agent_options: Annotated[AgentOptions, tyro.conf.arg(name="agent")] = LATER
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        complete = vars(self)
        for task in self.policy_tasks:
            TASKS.check_allowed(task_name(task))
        for kind, name, options in (
            ("agent_options", self.agent, AGENTS.get(self.agent).Options),
            ("policy", self.policy_name, POLICIES.get(self.policy_name).Options),
        ):
            given = getattr(self, kind)
            if given is None:
                complete[kind] = options()
            elif type(given) is not options:
                raise UserError(
                    f"{kind} are {type(given).__name__}, but {name!r} takes {options.__name__}"
                )
        complete["policy"] = self.policy.on(self.task)
        if self.policy_seed is None:
            complete["policy_seed"] = self.seed
        if self.demonstrations.seed is None:
            complete["demonstrations"] = dataclasses.replace(self.demonstrations, seed=self.seed)
        for key, value in [*vars(self.policy).items(), *vars(self.agent_options).items()]:
            if isinstance(value, float) and not math.isfinite(value):
                raise UserError(f"{key} is {value}; it must be finite")
        if len(self.variant) > LONGEST_VARIANT:
            raise UserError(
                f"the variant {self.variant[:40]!r}... has {len(self.variant)} characters; it must "
                f"not have more than {LONGEST_VARIANT}, so join fewer of them"
            )
        # The variant is a part of the run's identity: each strength in its shortest form.
        specs = parse_variant(with_numbers(self.variant, self.task, self.embodiment))
        complete |= {"variant": variant_text(specs), "variants": specs}
        for spec in specs:
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

    @property
    def title(self) -> str:
        """The run as a short text."""
        return f"{self.agent} on {self.task} ({self.variant}), seed {self.seed}"

    def to_json(self) -> dict[str, Any]:
        """Nested plain data; :func:`build_config` reads it.

        An option that older configurations lack is left out where it is as they were.
        """
        data = dataclasses.asdict(self)
        if not self.evaluation.stochastic_episodes:
            del data["evaluation"]["stochastic_episodes"]
        data["policy"] = {"name": data.pop("policy_name"), **data["policy"]}
        return json.loads(json.dumps(data))


@dataclasses.dataclass(frozen=True)
class Execution:
    """How runs are executed. These options do not change the results."""

    runs: Path = Path("runs")
    """Folder of the runs. Demonstrations and base policies are in RUNS/base."""
    demos: Path | None = None
    """Trajectory file (.h5 with .json) to train the base policy on, instead of demonstrations of
    the scripted expert."""
    base_policy: Path | None = None
    """Saved base policy (policy.safetensors) to steer, instead of training one. Its settings and
    those of its demonstrations become those of the run."""
    sim_workers: int = 1
    """Processes that share the simulation. Only times in the record depend on it."""
    track: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show the run in Weights & Biases, too. WANDB_MODE=offline needs no network and no login."""
    quiet: bool = False
    """No progress bars."""
    trust: tuple[str, ...] = ()
    """Code of other authors that files name, as module:Class. It is executed."""
    group: Annotated[str | None, tyro.conf.Suppress] = None
    """Name of what tracked runs belong to: the suite of a sweep."""

    @functools.cached_property
    def files(self) -> dict[str, str]:
        """Content hashes of the files that a run starts from, for its name and record.

        Raises:
            UserError: if a file is missing.
        """
        hashes = {}
        for kind, path in {"demonstrations": self.demos, "policy": self.base_policy}.items():
            if path is not None:
                try:
                    file = policy_path(path) if kind == "policy" else path
                    hashes[kind] = hashlib.sha256(file.read_bytes()).hexdigest()
                except OSError as error:
                    raise UserError(
                        f"cannot read the {kind} file {path}: {error.strerror}; name another one"
                    ) from error
        return hashes


def build_config(data: Mapping[str, Any], source: str) -> RunConfig:
    """A run's configuration from nested plain data; missing keys have their defaults.

    Args:
        data: as from :meth:`RunConfig.to_json`, or a part of it.
        source: the origin of the data, for messages.

    Raises:
        UserError: for an unknown key (the message has the nearest valid one) or a wrong type.
    """
    try:
        return _build_config(data)
    except UserError as error:
        raise UserError(f"{source}: {error}") from error


def _build_config(data: Mapping[str, Any]) -> RunConfig:
    tables: dict[str, Mapping[str, Any]] = {}
    for key in ("policy", "agent_options", "demonstrations", "evaluation"):
        if not isinstance(table := data.get(key, {}), Mapping):
            raise UserError(f"{key} must be a table, not {table!r}")
        tables[key] = table
    agent = data.get("agent", RunConfig.agent)
    policy_name = tables["policy"].get("name", RunConfig.policy_name)
    for key, name in (("agent", agent), ("policy.name", policy_name)):
        if not isinstance(name, str):
            raise UserError(f"{key} must be a text in quotes, not {name!r}")
    kinds = {
        "policy": POLICIES.get(policy_name).Options,
        "agent_options": AGENTS.get(agent).Options,
        "demonstrations": DemonstrationConfig,
        "evaluation": EvaluationConfig,
    }
    data = without_retired({**data, **tables}, _fields(kinds["agent_options"]))
    check("key", data, sorted(_fields(RunConfig) - {"policy_name"}))
    data["policy"] = {key: value for key, value in data["policy"].items() if key != "name"}
    parts = {key: _from_table(kind, data[key], key) for key, kind in kinds.items()}
    return RunConfig(**{**data, **parts, "policy_name": policy_name})


def _fields(kind: type) -> set[str]:
    return {field.name for field in dataclasses.fields(kind)}


def _from_table(kind: type, table: Mapping[str, Any], key: str) -> Any:
    """An instance of a dataclass from plain data; ``key`` is that of the table, for messages."""
    valid = [f"{key}.{name}" for name in sorted(_fields(kind))]
    check("key", [f"{key}.{name}" for name in table], valid)
    try:
        # As JSON: strict mode then accepts 1 for 1.0, but neither "1" nor true for a number.
        return _adapter(kind).validate_json(json.dumps(table, default=str), strict=True)
    except ValidationError as error:
        raise _mistake(error, f"{key}.") from error


@functools.cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _mistake(error: ValidationError, prefix: str) -> UserError:
    """The first of the errors in one sentence."""
    first = error.errors()[0]
    key = prefix + ".".join(map(str, first["loc"]))
    problem = first["msg"].removeprefix("Value error, ")
    given = "" if isinstance(first["input"], dict) else f" (got {first['input']!r})"
    return UserError(f"{key}: {problem}{given}" if first["loc"] else f"{prefix}{problem}{given}")


def content_key(*parts: Any) -> str:
    """Twelve hexadecimal digits that change with any of the JSON-able parts."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]
