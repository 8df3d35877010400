"""The blocks of a record, and the rules between them."""

from __future__ import annotations

from collections.abc import Mapping
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

from symsteer.leaderboard.records.provenance import Provenance
from symsteer.leaderboard.records.values import (
    MAX_TEXT,
    Block,
    Count,
    Finite,
    Flags,
    Measured,
    MetricName,
    Moment,
    Name,
    Seconds,
    Sha256,
    Share,
    Text,
    canonical_json,
    config_hash,
    first_problem,
    plain,
    portable,
)

SCHEMA_VERSION: Literal[4] = 4

HELD_OUT_SEED = 1_000_000
"""Evaluation episode i starts from seed ``HELD_OUT_SEED + i``, the same for every agent, variant
and run. Steerability draws its seeds below it, training far above it (from 2^22 on), and
demonstrations anywhere below 2^31."""

DIVERGED_SHARE = 0.05
DIVERGED_EVALUATIONS = 3

Q_VALUES = ("q_mean", "q_min", "q_max", "q_abs_max")
"""Diagnostics that are Q-values themselves: an agent that has them has a critic."""

Role = Literal["reference", "learner", "control"]
ROLES: tuple[Role, ...] = ("reference", "learner", "control")
"""What an agent is there for: to be compared with, to be ranked, or to explain a learner's result.

References are evaluated once; learners and controls use the whole budget."""


class Demonstrations(BaseModel):
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
    demonstrations: Demonstrations


class Parameters(Block):
    """Trainable parameters: the networks that act (`actor`), all critics, and their sum.

    `width` is the hidden width in channels (null for agents without networks).
    """

    actor: Count
    critic: Count
    total: Count
    width: Count | None = None


class WallClock(Block):
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


class Budget(Block):
    """What was used: environment control steps, decisions (chunks), gradient updates."""

    env_steps: Count = 0
    decisions: Count = 0
    updates: Count = 0


class BasePolicy(Measured):
    """The frozen base policy and its steerability report.

    `base_success`: success_once with Gaussian noise; `action_std`: standard deviation of normalised
    actions over noise draws, mean over states; `solvable`: share of initial states that at least
    one of `draws` noise draws solves; `warning`: why steering cannot work, if it cannot.
    """

    name: Name
    group: Name | None = None
    content_hash: Sha256
    base_success: Share | None = None
    episodes: Count | None = None
    action_std: Annotated[Finite, Field(ge=0)] | None = None
    solvable: Share | None = None
    draws: Count = 16
    training_seconds: Seconds | None = None
    parameters: Count | None = None
    warning: Text | None = None


class FeasibleQ(Block):
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


class Episodes(Measured):
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


class Evaluation(Measured):
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


class RunRecord(Block):
    """Everything the leaderboard may know about one run."""

    schema_version: Literal[4] = SCHEMA_VERSION
    run_id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._+=:,@-]{0,199}$")]
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
    budget: Budget = Field(default_factory=Budget)
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
