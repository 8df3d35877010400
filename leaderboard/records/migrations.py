"""Records of older schema versions as records of the newest one."""

from __future__ import annotations

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

    Raises:
        ValueError: a part of the record is missing or has another form.
    """
    try:
        return _migrated(dict(data))
    except (AttributeError, KeyError, TypeError) as error:
        raise ValueError(
            f"a record of version {data['schema_version']} has another form"
        ) from error


def _migrated(data: Data) -> Data:
    version, bounds = data["schema_version"], data.get("feasible_q")
    if version < 3:
        data.pop("training", None)
        if bounds:
            data["feasible_q"] = {k: v for k, v in bounds.items() if k != "entropy_allowance"}
    if version < 4:
        learns = data["config"].get("agent") not in REFERENCES_BEFORE_4
        data["role"] = "learner" if learns else "reference"
        data["provenance"] = {**data["provenance"], **CODE}
        data["continued"] = [{**part, **CODE} for part in data.get("continued", [])]
    if version < 5:
        data["wall_clock"] = {**data["wall_clock"], "diagnose": None}
        data["evaluations"] = [_evaluation(old, bounds) for old in data["evaluations"]]
    return data


def _evaluation(evaluation: Data, bounds: Any) -> Data:
    """Older biases get other names. `q_magnitude` and `q_overshoot` come from the extremes.

    These are of the smallest critic, so the overshoot is a lower bound.
    """
    old, flags = evaluation.get("diagnostics", {}), evaluation.get("nonfinite", {})
    new = {CONDITIONAL_BEFORE_5.get(name, name): value for name, value in old.items()}
    renamed = {f"diagnostics/{a}": f"diagnostics/{b}" for a, b in CONDITIONAL_BEFORE_5.items()}
    flags = {renamed.get(path, path): kind for path, kind in flags.items()}
    return {**evaluation, "diagnostics": {**new, **_beyond(old, bounds)}, "nonfinite": flags}


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
