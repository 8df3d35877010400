"""Records of older schema versions as records of the newest one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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


def migrated(data: Data) -> Data:
    """A record in the newest version.

    Version 2 added `continued` and `wall_clock.resumed`: no run of version 1 was continued. Version
    3 left out `training` and `feasible_q.entropy_allowance`, which held nothing. Version 4 added
    `role`, and version, hash and extensions to the provenance. Version 5 added degrees of
    divergence, biases over all decisions, `wall_clock.diagnose`. Version 6 added
    `equivariance_error` and `jump` of the base policy.
    """
    version, data = data["schema_version"], dict(data)
    if version < 3:
        data.pop("training", None)
        if isinstance(bounds := data.get("feasible_q"), dict):
            data["feasible_q"] = {k: v for k, v in bounds.items() if k != "entropy_allowance"}
    if version < 4:
        config = data.get("config")
        agent = config.get("agent") if isinstance(config, dict) else None
        data["role"] = "reference" if agent in REFERENCES_BEFORE_4 else "learner"
        data["provenance"] = _with(data.get("provenance"), CODE)
        if isinstance(parts := data.get("continued"), list):
            data["continued"] = [_with(part, CODE) for part in parts]
    if version < 5:
        data["wall_clock"] = _with(data.get("wall_clock"), {"diagnose": None})
        if isinstance(evaluations := data.get("evaluations"), list):
            bounds = data.get("feasible_q")
            data["evaluations"] = [_evaluation(old, bounds) for old in evaluations]
    return data


def _with(block: Any, values: Mapping[str, Any]) -> Any:
    return {**block, **values} if isinstance(block, dict) else block


def _evaluation(evaluation: Any, bounds: Any) -> Any:
    """Older biases get other names. `q_magnitude` and `q_overshoot` come from the extremes.

    These are of the smallest critic, so the overshoot is a lower bound.
    """
    if not isinstance(evaluation, dict) or not isinstance(evaluation.get("diagnostics"), dict):
        return evaluation
    old = evaluation["diagnostics"]
    new = {CONDITIONAL_BEFORE_5.get(name, name): value for name, value in old.items()}
    evaluation = {**evaluation, "diagnostics": {**new, **_beyond(old, bounds)}}
    if isinstance(flags := evaluation.get("nonfinite"), dict):
        renamed = {f"diagnostics/{a}": f"diagnostics/{b}" for a, b in CONDITIONAL_BEFORE_5.items()}
        evaluation["nonfinite"] = {renamed.get(path, path): kind for path, kind in flags.items()}
    return evaluation


def _beyond(old: Data, bounds: Any) -> dict[str, float]:
    """`q_magnitude` and `q_overshoot`, where what they are made of was measured."""
    try:
        allowance = old.get("q_allowance", 0.0)
        low, high = bounds["low"] - allowance, bounds["high"] + allowance
        limit = max(abs(low), abs(high))
        outside = max(low - old["q_min"], old["q_max"] - high, old["q_abs_max"] - limit, 0.0)
        return {"q_magnitude": old["q_abs_max"] / limit, "q_overshoot": outside / (high - low)}
    except (ArithmeticError, KeyError, TypeError):  # one of them is missing, null or no number
        return {}
