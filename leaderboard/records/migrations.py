"""Records of older schema versions as records of the newest one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from symsteer.leaderboard.records.values import LARGEST_NUMBER

Data = dict[str, Any]

REFERENCES_BEFORE_4 = ("base", "zero", "golden-ticket")
"""The agents that did not learn before a record named the agent's role."""

CODE: Data = {"version": None, "sha256": None, "extensions": []}
"""What the provenance of each part says since version 4."""

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

ADDED: dict[int, dict[str, tuple[str, ...]]] = {
    2: {"": ("continued",), "wall_clock": ("resumed",)},
    4: {"": ("role",), "provenance": (*CODE,)},
    5: {"wall_clock": ("diagnose",)},
    6: {"base_policy": ("equivariance_error", "jump")},
}
"""Keys of the record and of its blocks that a version added: older records must not have them."""

ADDED_DIAGNOSTICS = {*CONDITIONAL_BEFORE_5.values(), "q_magnitude", "q_overshoot"}
"""The same of the diagnostics, in version 5."""


def migrated(data: Data) -> Data:
    """A record in the newest version; a ValueError where it has what its version did not have.

    Version 2 added `continued` and `wall_clock.resumed`: no run of version 1 was continued. Version
    3 left out `training` and `feasible_q.entropy_allowance`, which held nothing. Version 4 added
    `role`, and version, hash and extensions to the provenance. Version 5 added degrees of
    divergence, biases over all decisions, `wall_clock.diagnose`. Version 6 added
    `equivariance_error` and `jump` of the base policy.
    """
    version, data = data["schema_version"], dict(data)
    for newer, blocks in ADDED.items():
        for name, keys in blocks.items() if version < newer else ():
            _refuse(version, data.get(name) if name else data, keys)
    if version < 3:
        if data.pop("training", None) is not None:
            raise ValueError("training must be null before schema_version 3")
        if isinstance(bounds := data.get("feasible_q"), dict):
            data["feasible_q"] = bounds = dict(bounds)
            if bounds.pop("entropy_allowance", 0) != 0:
                raise ValueError("feasible_q.entropy_allowance must be 0 before schema_version 3")
    if version < 4:
        config = data.get("config")
        agent = config.get("agent") if isinstance(config, dict) else None
        data["role"] = "reference" if agent in REFERENCES_BEFORE_4 else "learner"
        data["provenance"] = _with(data.get("provenance"), CODE)
        if isinstance(parts := data.get("continued"), list):
            for part in parts:
                _refuse(version, part, CODE)
            data["continued"] = [_with(part, CODE) for part in parts]
    if version < 5:
        data["wall_clock"] = _with(data.get("wall_clock"), {"diagnose": None})
        if isinstance(evaluations := data.get("evaluations"), list):
            bounds = data.get("feasible_q")
            data["evaluations"] = [_evaluation(version, old, bounds) for old in evaluations]
    return data


def _with(block: Any, values: Mapping[str, Any]) -> Any:
    return {**block, **values} if isinstance(block, dict) else block


def _refuse(version: int, block: Any, names: Any) -> None:
    for name in names:
        if isinstance(block, dict) and name in block:
            raise ValueError(f"{name} does not belong to schema_version {version}")


def _evaluation(version: int, evaluation: Any, bounds: Any) -> Any:
    """Older biases get other names. `q_magnitude` and `q_overshoot` come from the extremes.

    These are of the smallest critic, so the overshoot is a lower bound.
    """
    if not isinstance(evaluation, dict) or not isinstance(evaluation.get("diagnostics"), dict):
        return evaluation
    old = evaluation["diagnostics"]
    _refuse(version, old, ADDED_DIAGNOSTICS)
    new = {CONDITIONAL_BEFORE_5.get(name, name): value for name, value in old.items()}
    evaluation = {**evaluation, "diagnostics": {**new, **_beyond(old, bounds)}}
    if isinstance(flags := evaluation.get("nonfinite"), dict):
        renamed = {f"diagnostics/{a}": f"diagnostics/{b}" for a, b in CONDITIONAL_BEFORE_5.items()}
        evaluation["nonfinite"] = {renamed.get(path, path): kind for path, kind in flags.items()}
    return evaluation


def _beyond(old: Data, bounds: Any) -> dict[str, float]:
    """`q_magnitude` and `q_overshoot`, where what they are made of are finite numbers."""
    if not isinstance(bounds, dict):
        return {}
    values = [bounds.get("low"), bounds.get("high"), old.get("q_allowance", 0.0)]
    values += [old.get(name) for name in ("q_min", "q_max", "q_abs_max")]
    numbers = [v for v in values if isinstance(v, int | float) and abs(v) <= LARGEST_NUMBER]
    if len(numbers) < len(values):
        return {}
    low, high, allowance, smallest, largest, size = numbers
    low, high = low - allowance, high + allowance
    if not low < high:
        return {}
    limit = max(abs(low), abs(high))
    outside = max(low - smallest, largest - high, size - limit, 0.0)
    return {"q_magnitude": size / limit, "q_overshoot": outside / (high - low)}
