"""Records of older schema versions as records of the next one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Data = dict[str, Any]

REFERENCES_BEFORE_4 = ("base", "zero", "golden-ticket")
"""The agents that did not learn before a record named the agent's role."""


def _from_1(data: Data) -> Data:
    """Version 2 added `continued` and `wall_clock.resumed`: no run of version 1 was continued."""
    _refuse(1, data, "continued")
    _refuse(1, data.get("wall_clock"), "resumed")
    return {**data, "schema_version": 2}


def _from_2(data: Data) -> Data:
    """Version 3 left out `training` and `feasible_q.entropy_allowance`, which held nothing."""
    data = {**data, "schema_version": 3}
    if data.pop("training", None) is not None:
        raise ValueError("training must be null in schema_version 2")
    if isinstance(bounds := data.get("feasible_q"), dict):
        data["feasible_q"] = bounds = dict(bounds)
        if bounds.pop("entropy_allowance", 0) != 0:
            raise ValueError("feasible_q.entropy_allowance must be 0 in schema_version 2")
    return data


def _from_3(data: Data) -> Data:
    """Version 4 added `role`, and version, hash and extensions to the provenance."""
    _refuse(3, data, "role")
    config = data.get("config")
    agent = config.get("agent") if isinstance(config, dict) else None
    role = "reference" if agent in REFERENCES_BEFORE_4 else "learner"
    data = {**data, "schema_version": 4, "role": role}
    data["provenance"] = _part_from_3(data.get("provenance"))
    if isinstance(parts := data.get("continued"), list):
        data["continued"] = [_part_from_3(part) for part in parts]
    return data


def _part_from_3(provenance: Any) -> Any:
    if not isinstance(provenance, dict):
        return provenance
    _refuse(3, provenance, "version", "sha256", "extensions")
    return {**provenance, "version": None, "sha256": None, "extensions": []}


def _refuse(version: int, block: Any, *names: str) -> None:
    for name in names:
        if isinstance(block, dict) and name in block:
            raise ValueError(f"{name} does not belong to schema_version {version}")


MIGRATIONS: dict[int, Callable[[Data], Data]] = {1: _from_1, 2: _from_2, 3: _from_3}
"""From each older version of the schema to the next one; applied when a record is read."""
