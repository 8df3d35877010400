"""The run record: one strict JSON document per run, the only source of the leaderboard.

A record says what was run (`config`, `provenance`, `seeds`), how it went (`status`, `wall_clock`,
`budget`, `parameters`) and what came out: every episode of every evaluation with its seed, and the
diagnostics measured at that evaluation. It is validated on write and on read, written atomically,
and a finished record is never overwritten. docs/metrics.md defines every scalar.

JSON knows no NaN and no infinity. A measured number that is not finite is stored as null and named
in the `nonfinite` table of the block that holds it; null without an entry means "not measured".
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    JsonValue,
    PlainSerializer,
    ValidationError,
    field_validator,
    model_validator,
)

from symsteer.leaderboard.errors import RecordError

SCHEMA_VERSION = 3
MAX_BYTES = 64 * 2**20
"""A record of this project has some ten to a few hundred kilobytes; larger files are not ours."""

MAX_TEXT = 2000

LARGEST_COUNT = 2**53
"""Counts and seeds up to this are exact as floating point numbers."""

LARGEST_NUMBER = 1e39
"""Beyond single precision, in which everything is measured; larger numbers count as infinite."""

HELD_OUT_SEED = 1_000_000
"""Evaluation episode i starts from seed ``HELD_OUT_SEED + i``, the same for every agent, variant
and run. Steerability draws its seeds below it, training far above it (from 2^22 on), and
demonstrations anywhere below 2^31."""

DIVERGED_SHARE = 0.05
DIVERGED_EVALUATIONS = 3

Q_VALUES = ("q_mean", "q_min", "q_max", "q_abs_max")
"""Diagnostics that are Q-values themselves: their presence shows a critic."""

CODE = tuple(f"{folder}/*.py" for folder in ("agents", "bench", "leaderboard", "policies"))
"""What git must know for a commit to say which code has run (git's patterns)."""

PACKAGES = ("torch", "mani-skill", "sapien", "escnn", "gymnasium", "numpy")

_PLAIN = frozenset({bool, int, float, str, type(None)})


def _plain(value: Any) -> Any:
    """Turn arrays, tensors and their scalars into Python numbers and lists (no torch import)."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        if all(type(item) in _PLAIN for item in value):
            return list(value)
        return [_plain(item) for item in value]
    return value.tolist() if hasattr(value, "tolist") else value


def _moment(value: Any) -> Any:
    """Read an ISO 8601 time as UTC in whole seconds; times without a zone are refused."""
    if isinstance(value, str):
        value = datetime.fromisoformat(value)
    if not isinstance(value, datetime) or value.tzinfo is None:
        raise ValueError("expected an ISO 8601 time with a zone, such as 2026-01-31T12:00:00+00:00")
    return value.astimezone(UTC).replace(microsecond=0)


def _flags(value: Any) -> Any:
    """Read flags stored as 0/1 (half the size of false/true in a file of many episodes)."""
    value = _plain(value)
    if not isinstance(value, list):
        return value
    if any(type(flag) not in (bool, int, float) or flag not in (0, 1) for flag in value):
        raise ValueError("expected a list of 0 and 1")
    return [bool(flag) for flag in value]


def _nonfinite(value: Any) -> str | None:
    if isinstance(value, float) and not abs(value) <= LARGEST_NUMBER:
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    return None


Moment = Annotated[
    datetime,
    BeforeValidator(_moment),
    PlainSerializer(lambda moment: moment.isoformat(), return_type=str),
]
Flags = Annotated[
    list[bool],
    BeforeValidator(_flags),
    PlainSerializer(lambda flags: [int(flag) for flag in flags], return_type=list[int]),
]
Count = Annotated[int, Field(ge=0, le=LARGEST_COUNT)]
Finite = Annotated[float, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=LARGEST_COUNT, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=120)]
Text = Annotated[str, Field(max_length=MAX_TEXT)]
MetricName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,63}(/[a-z0-9_]{1,63})*$")]


class _Block(BaseModel):
    """Common rules: unknown keys are errors, strings are not numbers, arrays become lists."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        populate_by_name=True,
        validate_assignment=True,
        ser_json_inf_nan="null",
    )

    @classmethod
    def _own(cls, data: Mapping[str, Any]) -> list[str]:
        """The keys of `data` that are not blocks themselves: those look after their own values."""
        blocks = {
            name
            for name, field in cls.model_fields.items()
            if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        }
        return [key for key in data if key not in blocks and key != "evaluations"]

    @model_validator(mode="before")
    @classmethod
    def _to_plain(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        return {**data, **{key: _plain(data[key]) for key in cls._own(data)}}


class _Measured(_Block):
    """A block of measured numbers: non-finite ones become null and are named in `nonfinite`."""

    nonfinite: dict[str, Literal["nan", "inf", "-inf"]] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _flag_nonfinite(cls, data: Any) -> Any:
        flags = data.get("nonfinite", {}) if isinstance(data, Mapping) else None
        if not isinstance(flags, Mapping):
            return data
        flags = dict(flags)

        def clean(value: Any, path: str) -> Any:
            if isinstance(value, dict):
                return {key: clean(item, f"{path}/{key}") for key, item in value.items()}
            if isinstance(value, list):
                if all(_nonfinite(item) is None for item in value):
                    return value
                return [clean(item, f"{path}/{index}") for index, item in enumerate(value)]
            kind = _nonfinite(value)
            if kind is None:
                return value
            flags[path] = kind
            return None

        own = {key: clean(_plain(data[key]), key) for key in cls._own(data) if key != "nonfinite"}
        return {**data, **own, "nonfinite": flags}

    @model_validator(mode="after")
    def _flags_point_at_null(self) -> Self:
        data = self.model_dump(by_alias=True) if self.nonfinite else {}
        for path in self.nonfinite:
            value: Any = data
            for key in path.split("/"):
                if isinstance(value, list) and key.isdigit() and int(key) < len(value):
                    value = value[int(key)]
                elif isinstance(value, dict) and key in value:
                    value = value[key]
                else:
                    raise ValueError(f"nonfinite names {path!r}, which does not exist")
            if value is not None:
                raise ValueError(f"nonfinite names {path!r}, whose value is not null")
        return self


class Demonstrations(BaseModel):
    """The demonstrations of the base policy, as named in the configuration."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)
    mode: Name
    count: Count
    seed: Count


class Cell(BaseModel):
    """The keys of a configuration that every run must have; a configuration may hold more."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)
    task: Name
    embodiment: Name
    variant: Name
    agent: Name
    seed: Count
    env_steps: Annotated[Count, Field(gt=0)]
    demonstrations: Demonstrations

    @property
    def key(self) -> tuple[str, str, str]:
        """(task, embodiment, variant): the runs that one table compares."""
        return self.task, self.embodiment, self.variant


class Provenance(_Block):
    """Where the numbers come from. `commit` and `dirty` are null outside a git checkout.

    `dirty`: whether tracked files differ from the commit, or git does not know some of the code.
    """

    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")] | None
    dirty: bool | None
    packages: dict[Name, Name]
    python: Name
    platform: Name
    device: Name
    torch_threads: Annotated[Count, Field(ge=1)]

    @classmethod
    def collect(
        cls,
        device: str,
        torch_threads: int,
        root: Path,
        packages: Iterable[str] = PACKAGES,
    ) -> Provenance:
        """Describe this machine and the checkout at `root`; packages not installed are left out."""
        versions = {}
        for name in packages:
            try:
                versions[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
        commit = _git(root, "rev-parse", "HEAD")
        changes = _git(root, "status", "--porcelain", "--untracked-files=no")
        # A file that git does not know runs as well: a new agent's, for one.
        unknown = _git(root, "ls-files", "--others", "--exclude-standard", *CODE)
        return cls(
            commit=commit,
            dirty=None if None in (commit, changes, unknown) else bool(changes or unknown),
            packages=versions,
            python=platform.python_version(),
            platform=f"{platform.system()} {platform.machine()}",
            device=device,
            torch_threads=torch_threads,
        )


class Parameters(_Block):
    """Trainable parameters: the networks that act (`actor`), all critics, and their sum.

    `width` is the hidden width in channels (null for agents without networks).
    """

    actor: Count
    critic: Count
    total: Count
    width: Count | None = None


class WallClock(_Block):
    """Seconds spent; `total` also holds what the four named parts do not.

    `resumed` counts how often the run was continued from a checkpoint. What an interrupted process
    did after its last checkpoint was done again and is not part of the seconds.
    """

    simulate: Seconds = 0.0
    decode: Seconds = 0.0
    update: Seconds = 0.0
    evaluate: Seconds = 0.0
    total: Seconds = 0.0
    resumed: Count = 0


class Budget(_Block):
    """What was used: environment control steps, decisions (chunks), gradient updates."""

    env_steps: Count = 0
    decisions: Count = 0
    updates: Count = 0


class BasePolicy(_Measured):
    """The frozen base policy and its steerability report.

    `base_success`: success_once with Gaussian noise; `action_std`: standard deviation of normalised
    actions over noise draws, mean over states; `solvable`: share of initial states that at least
    one of `draws` noise draws solves; `warning`: why steering cannot work, if it cannot.
    """

    name: Name
    group: Name | None = None
    content_hash: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    base_success: Share | None = None
    episodes: Count | None = None
    action_std: Annotated[Finite, Field(ge=0)] | None = None
    solvable: Share | None = None
    draws: Count = 16
    training_seconds: Seconds | None = None
    parameters: Count | None = None
    warning: Text | None = None


class FeasibleQ(_Block):
    """Bounds of the discounted return that the task's reward allows, per decision.

    A soft critic may exceed them on either side by the diagnostic `q_allowance`.
    """

    low: Finite
    high: Finite

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError("low must not exceed high")
        return self


class Episodes(_Measured):
    """Evaluation episodes as columns of equal length; ManiSkill's metric names."""

    seed: list[Count]
    success_once: Flags
    success_at_end: Flags
    return_: list[Finite | None] = Field(alias="return")
    episode_len: list[Annotated[Count, Field(ge=1)]]

    @model_validator(mode="after")
    def _columns_agree(self) -> Self:
        columns = (
            self.success_once,
            self.success_at_end,
            self.return_,
            self.episode_len,
        )
        if not self.seed or any(len(column) != len(self.seed) for column in columns):
            raise ValueError("the columns must be equally long and not empty")
        if len(set(self.seed)) != len(self.seed):
            raise ValueError("an evaluation seed occurs twice")
        if any(end and not once for once, end in zip(*columns[:2], strict=True)):
            raise ValueError("an episode ends in success without having had success once")
        return self


class Evaluation(_Measured):
    """One evaluation: where in the run it was, its episodes, its diagnostics.

    `wall_clock` is seconds since the start of the run. `final` marks the evaluation of the last
    checkpoint, which is the reported number.
    """

    env_steps: Count
    decisions: Count
    updates: Count
    wall_clock: Seconds
    final: bool = False
    episodes: Episodes
    diagnostics: dict[MetricName, Finite | None] = Field(default_factory=dict)

    @property
    def success_once(self) -> float:
        """Share of episodes that succeeded at least once."""
        return sum(self.episodes.success_once) / len(self.episodes.success_once)


def _from_1(data: dict[str, Any]) -> dict[str, Any]:
    """Version 2 added `continued` and `wall_clock.resumed`: a run of version 1 never was."""
    for name, block in (("continued", data), ("resumed", data.get("wall_clock"))):
        if isinstance(block, dict) and name in block:
            raise ValueError(f"{name} does not belong to schema_version 1")
    return {**data, "schema_version": 2}


def _from_2(data: dict[str, Any]) -> dict[str, Any]:
    """Version 3 left out `training` and `feasible_q.entropy_allowance`, which held nothing."""
    data = {**data, "schema_version": 3}
    if data.pop("training", None) is not None:
        raise ValueError("training must be null in schema_version 2")
    if isinstance(bounds := data.get("feasible_q"), dict):
        data["feasible_q"] = bounds = dict(bounds)
        if bounds.pop("entropy_allowance", 0) != 0:
            raise ValueError("feasible_q.entropy_allowance must be 0 in schema_version 2")
    return data


MIGRATIONS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {1: _from_1, 2: _from_2}
"""From each older version of the schema to the next one; applied when a record is read."""


class RunRecord(_Block):
    """Everything the leaderboard may know about one run."""

    schema_version: Literal[3] = 3
    run_id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._+=:,@-]{0,199}$")]
    config: dict[str, JsonValue]
    config_hash: str = ""
    provenance: Provenance
    continued: list[Provenance] = Field(default_factory=list)
    """Where the run was continued, as far as that differs from where it began."""
    seeds: dict[Name, Count]
    started: Moment
    ended: Moment | None = None
    status: Literal["running", "finished", "failed", "interrupted"] = "running"
    failure: Text | None = None
    parameters: Parameters
    wall_clock: WallClock = Field(default_factory=WallClock)
    budget: Budget = Field(default_factory=Budget)
    base_policy: BasePolicy
    feasible_q: FeasibleQ | None
    evaluations: list[Evaluation] = Field(default_factory=list)

    @field_validator("config")
    @classmethod
    def _config_is_a_cell(cls, config: dict[str, JsonValue]) -> dict[str, JsonValue]:
        try:
            canonical_json(config)
        except ValueError as error:
            raise ValueError("the configuration holds a number that is not finite") from error
        try:
            Cell.model_validate(config)
        except ValidationError as error:
            raise ValueError(_first_problem(error)) from error
        return config

    @field_validator("failure", mode="before")
    @classmethod
    def _short_without_paths(cls, failure: Any) -> Any:
        # Cut rather than refuse: a long message must not keep a failed run from being recorded.
        return portable(failure[: 4 * MAX_TEXT])[:MAX_TEXT] if isinstance(failure, str) else failure

    @model_validator(mode="before")
    @classmethod
    def _fill_hash(cls, data: Any) -> Any:
        # Only where the key is absent: a file always has it, so a damaged file cannot slip through.
        if isinstance(data, Mapping) and "config_hash" not in data and "config" in data:
            try:
                return {**data, "config_hash": config_hash(_plain(data["config"]))}
            except (TypeError, ValueError):
                return data
        return data

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.config_hash != config_hash(self.config):
            raise ValueError("config_hash does not belong to config")
        # `ended`, `failure` and `status` are set one after the other while a run closes its record,
        # so the rules that join them are checked on write and on read, not on assignment.
        return self

    def check(self) -> None:
        """Raise ValueError where blocks contradict each other (called on write and on read)."""
        steps = [evaluation.env_steps for evaluation in self.evaluations]
        if steps != sorted(steps):
            raise ValueError("evaluations are not in the order of env_steps")
        if any(evaluation.final for evaluation in self.evaluations[:-1]):
            raise ValueError("an evaluation before the last one is marked final")
        if self.ended is not None and self.ended < self.started:
            raise ValueError("ended lies before started")
        if self.status == "finished" and not (self.evaluations and self.evaluations[-1].final):
            raise ValueError("a finished run needs a final evaluation")
        if (self.status == "running") != (self.ended is None):
            raise ValueError("ended must be set when the run is no longer running, and only then")
        if self.status == "failed" and not self.failure:
            raise ValueError("a failed run needs a failure message")

    @property
    def cell(self) -> Cell:
        """Typed view of the configuration's required keys."""
        return Cell.model_validate(self.config)

    @property
    def final(self) -> Evaluation | None:
        """The evaluation of the last checkpoint, or None while there is none."""
        return self.evaluations[-1] if self.evaluations and self.evaluations[-1].final else None

    @property
    def has_critic(self) -> bool:
        """Whether any evaluation measured a Q-value."""
        return any(
            name in evaluation.diagnostics for evaluation in self.evaluations for name in Q_VALUES
        )

    @property
    def nonfinite_q(self) -> bool:
        """Whether a Q-value of any evaluation was not finite (`Q_VALUES`; a bias may be)."""
        return any(
            f"diagnostics/{name}" in evaluation.nonfinite
            for evaluation in self.evaluations
            for name in Q_VALUES
        )

    @property
    def diverged(self) -> bool | None:
        """Whether the Q-values diverged; None for runs without a critic.

        The rule: `q_violation` above 5 % at 3 consecutive evaluations, or Q-values that are not
        finite. Evaluations before the first update do not count: what an untrained critic says
        has not diverged from anything.
        """
        if not self.has_critic:
            return None
        if self.nonfinite_q:
            return True
        streak = 0
        for evaluation in self.evaluations:
            if evaluation.updates == 0:
                continue
            violation = evaluation.diagnostics.get("q_violation")
            streak = streak + 1 if violation is not None and violation > DIVERGED_SHARE else 0
            if streak == DIVERGED_EVALUATIONS:
                return True
        return False


def canonical_variant(variant: str) -> str:
    """``variant`` with each strength in its shortest form: ``wind:0.50`` becomes ``wind:0.5``.

    What is no number stays as it is.
    """
    parts = [part.partition(":") for part in variant.split("+")]
    return "+".join(f"{name}{colon}{_shortest(strength)}" for name, colon, strength in parts)


def _shortest(number: str) -> str:
    try:
        value = float(number)
    except ValueError:
        return number
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


def canonical_json(data: Any) -> str:
    """One text for one value: sorted keys, no spaces, ASCII. Raises ValueError on NaN, infinity."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)


def config_hash(config: Mapping[str, Any]) -> str:
    """sha256 over the canonical JSON of a resolved configuration, in hexadecimal."""
    return hashlib.sha256(canonical_json(config).encode()).hexdigest()


def portable(text: str) -> str:
    """Shorten absolute paths in `text` to their last part, so that records name no machine."""
    return re.sub(r"(?<![\w.:/])(?:[A-Za-z]:)?[/\\](?:[^\s/\\:'\",;()]+[/\\])+", "", text)


def dump_record(record: RunRecord) -> str:
    """The text of a record: strict JSON, sorted keys, one line per block and per evaluation."""
    data = record.model_dump(mode="json", by_alias=True)
    lines = []
    for key, value in data.items():
        if key == "evaluations" and value:
            rows = ",\n".join("  " + canonical_json(row) for row in value)
            lines.append(f'"evaluations": [\n{rows}\n ]')
        else:
            lines.append(f'"{key}": {canonical_json(value)}')
    return "{\n " + ",\n ".join(lines) + "\n}\n"


def write_record(record: RunRecord, path: Path | str) -> None:
    """Validate `record` and write it atomically (temporary file, fsync, rename).

    A file that exists is replaced only while it holds the same run, not finished yet. Raises
    RecordError otherwise, and when the record is invalid or the folder cannot be written.
    """
    path = Path(path)
    try:
        text = dump_record(_validated(record.model_dump(by_alias=True)))
    except (ValidationError, ValueError) as error:
        raise RecordError(f"{path}: the record is not written: {_first_problem(error)}.") from error
    if path.exists():
        old = read_record(path)
        if old.status == "finished":
            raise RecordError(f"{path} holds a finished run: choose another folder or delete it.")
        if old.run_id != record.run_id:
            raise RecordError(
                f"{path} holds another run ({old.run_id}): choose another folder or delete it."
            )
    write_atomically(path, text.encode())


def read_record(path: Path | str) -> RunRecord:
    """Read and validate the record at `path`; raises RecordError with one sentence if it is bad."""
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RecordError(f"{path} is larger than {MAX_BYTES >> 20} MiB: not a run record.")
        text = path.read_bytes().decode("utf-8")
    except OSError as error:
        raise RecordError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise RecordError(
            f"{path} is not UTF-8 text: not a run record; name records or run folders only."
        ) from error
    try:
        data = json.loads(
            text,
            parse_constant=_refuse,
            parse_float=_finite,
            object_pairs_hook=_unique_keys,
        )
    except (ValueError, RecursionError) as error:
        problem = error.msg if isinstance(error, json.JSONDecodeError) else str(error)
        raise RecordError(
            f"{path} is not strict JSON ({problem[:120]}): truncated or edited; "
            "restore it or run the cell again."
        ) from error
    if not isinstance(data, dict) or "schema_version" not in data:
        raise RecordError(
            f"{path} is JSON but has no schema_version: not a run record; "
            "name records or run folders only."
        )
    version = data["schema_version"]
    if type(version) is not int or not 1 <= version <= SCHEMA_VERSION:
        raise RecordError(
            f"{path} has schema_version {str(version)[:20]!r}, "
            f"this program reads 1 to {SCHEMA_VERSION}: "
            "use the version of symsteer that wrote it or run the cell again."
        )
    if "config_hash" not in data:
        raise RecordError(f"{path} is not a valid record: config_hash is missing; run it again.")
    try:
        for old in range(version, SCHEMA_VERSION):
            data = MIGRATIONS[old](data)
        return _validated(data)
    except (ValidationError, ValueError) as error:
        raise RecordError(
            f"{path} is not a valid record: {_first_problem(error)}; "
            "restore it or run the cell again."
        ) from error


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` so that `path` holds either its old content or all of the new one.

    Raises RecordError when the folder cannot be written or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise RecordError(
            f"{path} cannot be written: {error.strerror}; free space or choose another folder."
        ) from error


def _validated(data: dict[str, Any]) -> RunRecord:
    record = RunRecord.model_validate(data)
    record.check()
    return record


def _first_problem(error: Exception) -> str:
    """The first validation error as a phrase: where, what, how many more."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in first["loc"])[:120]
    what = first["msg"].removeprefix("Value error, ")
    more = error.error_count() - 1
    return (
        f"{where}: {what}" * bool(where) + what * (not where) + f" (and {more} more)" * bool(more)
    )


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:20]} is too large")
    return value


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) != len(pairs):
        raise ValueError("a key occurs twice")
    return data


def _git(root: Path, *arguments: str) -> str | None:
    try:
        result = subprocess.run(
            ["git", "-C", str(root), *arguments],
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()
