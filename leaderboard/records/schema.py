"""The blocks of a record, and the rules between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    JsonValue,
    ValidationError,
    field_validator,
    model_validator,
)

from symsteer.errors import first_problem
from symsteer.leaderboard.records.provenance import Provenance
from symsteer.leaderboard.records.values import (
    MAX_TEXT,
    Count,
    Finite,
    Flags,
    MeasuredBlock,
    MetricName,
    Moment,
    Name,
    RecordBlock,
    RunId,
    Seconds,
    Sha256,
    Share,
    Text,
    canonical_json,
    config_hash,
    plain,
    portable,
)

SCHEMA_VERSION: Literal[6] = 6

HELD_OUT_SEED = 1_000_000
"""Evaluation episode i starts from seed ``HELD_OUT_SEED + i``, the same for every agent, variant
and run. Steerability draws its seeds below it, training far above it (from 2^22 on), and
demonstrations anywhere below 2^31."""

MAX_GROWTH = 2.0
MAX_OVERSHOOT = 0.1
"""Q-values that double in the second half of a run and end further than this outside what is
feasible, in units of the feasible interval, diverge. With a discount of 0.95 it is the cost of two
decisions."""

Q_VALUES = ("q_mean", "q_min", "q_max", "q_abs_max")
"""Diagnostics that are Q-values themselves: an agent that has them has a critic."""

Role = Literal["reference", "learner", "control"]
ROLES: tuple[Role, ...] = ("reference", "learner", "control")
"""What an agent is there for: to be compared with, to be ranked, or to explain a learner's result.

References are evaluated once; learners and controls use the whole budget."""


class DemonstrationSettings(BaseModel):
    """The demonstrations of the base policy, as named in the configuration."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)
    mode: Name
    count: Count
    seed: Count


class RunSettings(BaseModel):
    """The keys that the configuration of every run must have; it may have more."""

    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)
    task: Name
    embodiment: Name
    variant: Name
    agent: Name
    seed: Count
    env_steps: Annotated[Count, Field(gt=0)]
    demonstrations: DemonstrationSettings


class Parameters(RecordBlock):
    """Trainable parameters: the networks that act (`actor`), all critics, and their sum.

    `width` is the hidden width in channels (null for agents without networks).
    """

    actor: Count
    critic: Count
    total: Count
    width: Count | None = None


class WallClock(RecordBlock):
    """Seconds spent; `total` also holds what the five named parts do not.

    `evaluate` is for the held-out episodes, `diagnose` for the long episodes and all diagnostics;
    null in records before version 5, where `evaluate` holds both. `resumed` counts how often the
    run was continued from a checkpoint. What an interrupted process did after its last checkpoint
    was done again and is not part of the seconds.
    """

    simulate: Seconds = 0.0
    decode: Seconds = 0.0
    update: Seconds = 0.0
    evaluate: Seconds = 0.0
    diagnose: Seconds | None = 0.0
    total: Seconds = 0.0
    resumed: Count = 0


class UsedBudget(RecordBlock):
    """What was used: environment control steps, decisions (chunks), gradient updates."""

    env_steps: Count = 0
    decisions: Count = 0
    updates: Count = 0


class BasePolicy(MeasuredBlock):
    """The frozen base policy and its steerability report.

    `base_success`: success_once with Gaussian noise; `action_std`: standard deviation of normalised
    actions over noise draws, mean over states; `solvable`: share of initial states that at least
    one of `draws` noise draws solves; `equivariance_error`: of its actions, under C8; `jump`:
    99.9 % quantile of the change of its actions if the observation moves by a millimetre;
    `warning`: why steering cannot work, if it cannot.
    """

    name: Name
    group: Name | None = None
    content_hash: Sha256
    base_success: Share | None = None
    episodes: Count | None = None
    action_std: Annotated[Finite, Field(ge=0)] | None = None
    solvable: Share | None = None
    draws: Count = 16
    equivariance_error: Annotated[Finite, Field(ge=0)] | None = None
    jump: Annotated[Finite, Field(ge=0)] | None = None
    training_seconds: Seconds | None = None
    parameters: Count | None = None
    warning: Text | None = None


class FeasibleQ(RecordBlock):
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


class Episodes(MeasuredBlock):
    """Evaluation episodes as columns of equal length; ManiSkill's metric names.

    `direction` is the angle, in radians, from the object to its goal in the first observation; null
    for tasks without two positions, and in older records.
    """

    seed: list[Count]
    success_once: Flags
    success_at_end: Flags
    return_: list[Finite | None] = Field(alias="return")
    episode_len: list[Annotated[Count, Field(ge=1)]]
    direction: list[Finite | None] | None = None

    @model_validator(mode="after")
    def _columns_agree(self) -> Self:
        columns = self.success_once, self.success_at_end, self.return_, self.episode_len
        direction = self.seed if self.direction is None else self.direction
        if not self.seed or {len(c) for c in (*columns, direction)} != {len(self.seed)}:
            raise ValueError("the columns must be equally long and not empty")
        if len(set(self.seed)) != len(self.seed):
            raise ValueError("an evaluation seed occurs twice")
        if any(end and not once for once, end in zip(*columns[:2], strict=True)):
            raise ValueError("an episode ends in success without having had success once")
        return self


class Evaluation(MeasuredBlock):
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


@dataclass(frozen=True)
class Divergence:
    """How far the Q-values of a run left what is feasible; docs/metrics.md has the formulas.

    None where no evaluation has measured it. Evaluations before the first update do not count: an
    untrained critic has not diverged from anything.

    Attributes:
        magnitude: largest |Q| over the largest feasible magnitude, largest over the evaluations.
        overshoot: distance of the worst Q from the feasible interval, in units of its width,
            largest over the evaluations.
        growth: largest |Q| at the last evaluation over that at the middle one.
        td_error: root mean square temporal-difference error at the last evaluation, in reward.
        diverged: a Q-value was not finite, or `magnitude` is above 1 (soft divergence, van Hasselt
            et al., arXiv 1812.02648), or Q grew out of the interval: `growth` of at least
            `MAX_GROWTH`, and an overshoot above `MAX_OVERSHOOT` at the last evaluation, which is
            larger than that at the middle one.
    """

    magnitude: float | None
    overshoot: float | None
    growth: float | None
    td_error: float | None
    diverged: bool


class RunRecord(RecordBlock):
    """Everything the leaderboard may know about one run."""

    schema_version: Literal[6] = SCHEMA_VERSION
    run_id: RunId
    config: dict[str, JsonValue]
    config_hash: str = ""
    role: Role
    provenance: Provenance
    continued: list[Provenance] = Field(default_factory=list)
    """Later parts of a continued run, where it differs from what was before."""
    seeds: dict[Name, Count]
    started: Moment
    ended: Moment | None = None
    status: Literal["running", "finished", "failed", "interrupted"] = "running"
    failure: Text | None = None
    parameters: Parameters
    wall_clock: WallClock = Field(default_factory=WallClock)
    budget: UsedBudget = Field(default_factory=UsedBudget)
    base_policy: BasePolicy
    feasible_q: FeasibleQ | None
    evaluations: list[Evaluation] = Field(default_factory=list)

    @field_validator("config")
    @classmethod
    def _has_its_settings(cls, config: dict[str, JsonValue]) -> dict[str, JsonValue]:
        try:
            canonical_json(config)
        except ValueError as error:
            raise ValueError("the configuration holds a number that is not finite") from error
        try:
            RunSettings.model_validate(config)
        except ValidationError as error:
            raise ValueError(first_problem(error)) from error
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
                return {**data, "config_hash": config_hash(plain(data["config"]))}
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
    def settings(self) -> RunSettings:
        """Typed view of the configuration's required keys."""
        return RunSettings.model_validate(self.config)

    @property
    def final(self) -> Evaluation | None:
        """The evaluation of the last checkpoint, or None while there is none."""
        return self.evaluations[-1] if self.evaluations and self.evaluations[-1].final else None

    @property
    def has_critic(self) -> bool:
        """Whether any evaluation measured a Q-value."""
        return any(name in e.diagnostics for e in self.evaluations for name in Q_VALUES)

    @property
    def nonfinite_q(self) -> bool:
        """Whether a Q-value of any evaluation was not finite (`Q_VALUES`; a bias may be)."""
        flags = [f"diagnostics/{name}" for name in Q_VALUES]
        return any(flag in e.nonfinite for e in self.evaluations for flag in flags)

    @property
    def not_finite(self) -> str:
        """Measured numbers that were not finite, and when first; those of Q are its divergence."""
        first = {f"{name} of the base policy": 0 for name in self.base_policy.nonfinite}
        for evaluation in self.evaluations:
            for path in (*evaluation.nonfinite, *evaluation.episodes.nonfinite):
                name = path.removeprefix("diagnostics/").partition("/")[0]
                if not name.startswith("q_"):
                    first.setdefault(name, evaluation.env_steps)
        return ", ".join(f"{name} (first after {steps} steps)" for name, steps in first.items())

    @property
    def divergence(self) -> Divergence | None:
        """How far the Q-values left what is feasible; None for runs without a critic."""
        if not self.has_critic:
            return None
        trained = [evaluation for evaluation in self.evaluations if evaluation.updates > 0]
        last = trained[-1] if trained else None
        half = last.env_steps / 2 if last else 0
        middle = min(trained[:-1], key=lambda e: abs(e.env_steps - half), default=None)

        def at(evaluation: Evaluation | None, name: str) -> float | None:
            return evaluation.diagnostics.get(name) if evaluation else None

        def largest(name: str) -> float | None:
            return max((v for e in trained if (v := at(e, name)) is not None), default=None)

        magnitude = largest("q_magnitude")
        ends, was = at(last, "q_abs_max"), at(middle, "q_abs_max")
        growth = ends / was if ends is not None and was else None
        outside, before = at(last, "q_overshoot") or 0.0, at(middle, "q_overshoot") or 0.0
        grew = growth is not None and growth >= MAX_GROWTH
        return Divergence(
            magnitude=magnitude,
            overshoot=largest("q_overshoot"),
            growth=growth,
            td_error=at(last, "td_error"),
            diverged=self.nonfinite_q
            or (magnitude is not None and magnitude > 1)
            or (grew and outside > max(MAX_OVERSHOOT, before)),
        )

    @property
    def diverged(self) -> bool | None:
        """Whether the Q-values diverged; None for runs without a critic."""
        divergence = self.divergence
        return None if divergence is None else divergence.diverged
