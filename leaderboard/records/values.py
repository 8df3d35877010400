"""The values that blocks of a record are made of: types with limits, and how they become JSON.

JSON has no NaN and no infinity. A measured number that is not finite is stored as null and named
in the `nonfinite` table of its block; null without an entry means "not measured".
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, model_validator

from symsteer.variant import file_name

DERIVED = ("evaluation_variant", "files")
"""Keys that a run adds to its configuration."""

MAX_TEXT = 2000

LARGEST_COUNT = 2**53
"""Counts and seeds up to this are exact as floating point numbers."""

LARGEST_NUMBER = 1e39
"""Measurements are in single precision, which ends before; larger numbers count as infinite."""

_PLAIN = frozenset({bool, int, float, str, type(None)})


def plain(value: Any) -> Any:
    """Turn arrays, tensors and their scalars into Python numbers and lists (no torch import)."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        if all(type(item) in _PLAIN for item in value):
            return list(value)
        return [plain(item) for item in value]
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
    value = plain(value)
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
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
RunId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._+=:,@-]{0,199}$")]
MetricName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,63}(/[a-z0-9_]{1,63})*$")]


class RecordBlock(BaseModel):
    """Common rules: unknown keys are errors, strings are not numbers, arrays become lists."""

    model_config = ConfigDict(
        extra="forbid",
        strict=True,
        populate_by_name=True,
        validate_assignment=True,
        ser_json_inf_nan="null",
    )

    @classmethod
    def _own(cls, data: Mapping[str, Any]) -> dict[str, Any]:
        """Plain values of the keys that are not blocks themselves: those prepare their own."""
        blocks = {"evaluations"} | {
            name
            for name, field in cls.model_fields.items()
            if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel)
        }
        return {key: plain(item) for key, item in data.items() if key not in blocks}

    @model_validator(mode="before")
    @classmethod
    def _to_plain(cls, data: Any) -> Any:
        return {**data, **cls._own(data)} if isinstance(data, Mapping) else data


class MeasuredBlock(RecordBlock):
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
            if (kind := _nonfinite(value)) is None:
                return value
            flags[path] = kind
            return None

        own = {k: clean(item, k) for k, item in cls._own(data).items() if k != "nonfinite"}
        return {**data, **own, "nonfinite": flags}

    @model_validator(mode="after")
    def _flags_point_at_null(self) -> Self:
        values = leaves(self.model_dump(by_alias=True)) if self.nonfinite else ()
        nulls = {place.replace("/", ".") for place, value in values if value is None}
        for path in self.nonfinite:
            if path.replace("/", ".") not in nulls:
                raise ValueError(f"nonfinite names {path!r}, which is no null of this block")
        return self


def leaves(data: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of nested data that holds no others, and its place: keys joined by dots."""
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from leaves(value, f"{place}.{key}" if place else str(key))
    else:
        yield place, data


def canonical_json(data: Any) -> str:
    """One text for one value: sorted keys, no spaces, ASCII. Raises ValueError on NaN, infinity."""
    return json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)


def json_lines(data: Mapping[str, Any]) -> str:
    """The same in one line for each key, and for each of `evaluations`."""
    lines = []
    for key, value in data.items():
        if key == "evaluations" and value:
            rows = ",\n".join("  " + canonical_json(row) for row in value)
            lines.append(f'"evaluations": [\n{rows}\n ]')
        else:
            lines.append(f'"{key}": {canonical_json(value)}')
    return "{\n " + ",\n ".join(lines) + "\n}\n"


def config_hash(config: Mapping[str, Any]) -> str:
    """sha256 over the canonical JSON of a resolved configuration, in hexadecimal."""
    return hashlib.sha256(canonical_json(config).encode()).hexdigest()


def run_id_of(config: Mapping[str, Any]) -> str:
    """The name of a run: readable, and unique for its resolved configuration."""
    own = {key: value for key, value in config.items() if key not in DERIVED}
    digest = hashlib.sha256(canonical_json([own, config.get("files")]).encode()).hexdigest()
    words = (*(config[key] for key in ("task", "embodiment", "variant", "agent")), config["seed"])
    task, embodiment, variant, agent, seed = map(file_name, map(str, words))
    return f"{task}-{embodiment}-{variant}-{agent}-s{seed}-{digest[:12]}"


def flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as one table, keys joined by dots, e.g. ``policy.width``."""
    table: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            table |= flat(value, f"{prefix}{key}.")
        else:
            table[prefix + key] = value
    return table


def portable(text: str) -> str:
    """Shorten absolute paths in `text` to their last part, so that records name no machine."""
    return re.sub(r"(?<![\w.:/])(?:[A-Za-z]:)?[/\\](?:[^\s/\\:'\",;()]+[/\\])+", "", text)
