"""Records of older schema versions as records of the next one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from symsteer.leaderboard.records.values import LARGEST_NUMBER

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


CONDITIONAL_BEFORE_5 = {
    "q_bias": "q_bias_successful",
    "q_bias_std": "q_bias_successful_std",
    "q_bias_hard": "q_bias_successful_hard",
    "q_bias_covered": "q_bias_successful_share",
    "return_mean": "return_mean_within_limit",
}
"""What the measures before version 5 are called now.

The bias was that of decisions whose return was known when the time limit came, nearly all of
successful episodes; the mean return ended at the time limit. No number of version 5 compares with
them."""


def _from_4(data: Data) -> Data:
    """Version 5 added degrees of divergence, biases over all decisions, `wall_clock.diagnose`.

    Older biases get other names. `q_magnitude` and `q_overshoot` come from the extremes that
    version 4 has. These are of the smallest critic, so the overshoot is a lower bound.
    """
    _refuse(4, data.get("wall_clock"), "diagnose")
    data = {**data, "schema_version": 5}
    if isinstance(clock := data.get("wall_clock"), dict):
        data["wall_clock"] = {**clock, "diagnose": None}
    if isinstance(evaluations := data.get("evaluations"), list):
        bounds = data.get("feasible_q")
        data["evaluations"] = [_evaluation_from_4(old, bounds) for old in evaluations]
    return data


def _evaluation_from_4(evaluation: Any, bounds: Any) -> Any:
    if not isinstance(evaluation, dict) or not isinstance(evaluation.get("diagnostics"), dict):
        return evaluation
    old = evaluation["diagnostics"]
    _refuse(4, old, *CONDITIONAL_BEFORE_5.values(), "q_magnitude", "q_overshoot")
    new = {CONDITIONAL_BEFORE_5.get(name, name): value for name, value in old.items()}
    evaluation = {**evaluation, "diagnostics": {**new, **_beyond(old, bounds)}}
    if isinstance(flags := evaluation.get("nonfinite"), dict):
        renamed = {f"diagnostics/{a}": f"diagnostics/{b}" for a, b in CONDITIONAL_BEFORE_5.items()}
        evaluation["nonfinite"] = {renamed.get(path, path): kind for path, kind in flags.items()}
    return evaluation


def _beyond(old: Data, bounds: Any) -> dict[str, float]:
    """`q_magnitude` and `q_overshoot`, where their parts are finite numbers."""
    if not isinstance(bounds, dict):
        return {}
    values = [bounds.get("low"), bounds.get("high"), old.get("q_allowance", 0.0)]
    values += [old.get(name) for name in ("q_min", "q_max", "q_abs_max")]
    numbers = [v for v in values if isinstance(v, int | float) and abs(v) <= LARGEST_NUMBER]
    if len(numbers) < len(values):
        return {}
    low, high, allowance, smallest, largest, size = numbers
    low, high = low - allowance, high + allowance
    limit = max(abs(low), abs(high))
    if not low < high:
        return {}
    outside = max(low - smallest, largest - high, size - limit, 0.0)
    return {"q_magnitude": size / limit, "q_overshoot": outside / (high - low)}


def _from_5(data: Data) -> Data:
    """Version 6 added `equivariance_error` and `jump` of the base policy."""
    _refuse(5, data.get("base_policy"), "equivariance_error", "jump")
    return {**data, "schema_version": 6}


def _refuse(version: int, block: Any, *names: str) -> None:
    for name in names:
        if isinstance(block, dict) and name in block:
            raise ValueError(f"{name} does not belong to schema_version {version}")


MIGRATIONS: dict[int, Callable[[Data], Data]] = {
    1: _from_1,
    2: _from_2,
    3: _from_3,
    4: _from_4,
    5: _from_5,
}
"""From each older version of the schema to the next one; applied when a record is read."""
