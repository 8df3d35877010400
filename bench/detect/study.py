"""``symsteer detect``: what detectors say of a run's decisions, against simulated truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import rankdata, spearmanr

from symsteer.agents.agent import AgentContext
from symsteer.agents.detectors import DETECTORS
from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.detect.truth import Truth, measure_truth
from symsteer.bench.runs.replays import stored_replay
from symsteer.bench.runs.stored import named, stored_config, stored_policy
from symsteer.errors import UserError
from symsteer.policies.files import policy_path
from symsteer.policies.geometry import Group

RESAMPLES = 1_000


@dataclass(frozen=True)
class Measure:
    """An estimate with its 95 % interval.

    Attributes:
        draws: the estimate in resampled data.
        runs: that it is the mean of.
    """

    value: float
    low: float
    high: float
    draws: np.ndarray = field(repr=False, compare=False)
    runs: int = 1

    @classmethod
    def of(cls, value: float, draws: np.ndarray, runs: int = 1) -> Measure:
        """An estimate with the interval that its draws give; draws may be nan."""
        draws = draws[~np.isnan(draws)]
        low, high = np.quantile(draws, [0.025, 0.975])
        return cls(value, float(low), float(high), draws, runs)

    def to_json(self) -> dict[str, float]:
        """Plain data."""
        return {name: getattr(self, name) for name in ("value", "low", "high", "runs")}


def mean_of_runs(measures: Sequence[Measure | None], seed: int = 0) -> Measure | None:
    """Mean over runs, with an interval over resampled runs and the data of each; None for none."""
    present = [measure for measure in measures if measure is not None]
    if not present:
        return None
    rng = np.random.default_rng(seed)
    draws = [
        np.mean(
            [rng.choice(present[i].draws) for i in rng.integers(len(present), size=len(present))]
        )
        for _ in range(RESAMPLES)
    ]
    return Measure.of(float(np.mean([m.value for m in present])), np.array(draws), len(present))


@dataclass(frozen=True)
class Detection:
    """How well one score finds broken decisions.

    Attributes:
        detector, score: their names.
        auroc: area under the ROC curve for "the symmetry of this state is broken": some copy of its
            orbit ends elsewhere. The score is the largest one of the orbit.
        place_auroc: for "this copy is the one that ends elsewhere", over all copies.
        correlation: Spearman's, with the departure.
        scores: of every copy, ``[S, G]``.

    A measure is None where it is not defined, e.g. if no copy is broken.
    """

    detector: str
    score: str
    auroc: Measure | None
    place_auroc: Measure | None
    correlation: Measure | None
    scores: torch.Tensor


@dataclass(frozen=True)
class Found:
    """What detectors say of one run's decisions.

    Attributes:
        about: the run, the settings and counts, as plain data.
        truth: what was simulated.
        detections: one for each score.
    """

    about: dict[str, Any]
    truth: Truth
    detections: list[Detection]


def detect(
    folder: Path,
    detectors: Sequence[str],
    count: int,
    group: str,
    seed: int = 0,
    report: Callable[[str], None] = lambda text: None,
) -> Found:
    """Fit detectors to a run's decisions and score them.

    Args:
        folder: of a run in a broken world, with its replay.
        detectors: names.
        count: states of expert and of base policy, each.
        group: the symmetry.
        seed: of states, detectors and intervals.
        report: receives a line for each part.

    Raises:
        UserError: if the folder has no replay or policy, or a name is unknown.
    """
    folder = named(folder)
    config, _ = stored_config(folder)
    kinds = {name: DETECTORS.get(name) for name in detectors}
    replay = stored_replay(folder)
    policy = stored_policy(folder, config)
    if policy is None:
        raise UserError(
            f"there is no {policy_path(folder)}; restore it from where the run was made"
        )
    policy = policy.to("cpu")
    world = config.task, config.embodiment, config.variant, group
    settings = AuditSettings(*world, count=count, chunk=policy.execute, seed=seed)
    truth = measure_truth(settings, policy)
    report(f"truth: {int(truth.broken.sum())} of {int(truth.reached.sum())} copies are broken")
    context = AgentContext.of(policy, seed=seed)
    found = []
    for name, kind in kinds.items():
        detector = kind(context, Group.parse(group))
        detector.fit(replay)
        scores = detector.scores(truth.obs.flatten(0, 1), truth.actions.flatten(0, 1))
        found += [_detection(name, score, x, truth, seed) for score, x in scores.items()]
        report(f"{name}: done")
    about = {
        "run": folder.name,
        "settings": dataclasses.asdict(settings),
        "decisions": len(replay.reward),
        "copies": int(truth.reached.sum()),
        "broken": int(truth.broken.sum()),
        "limit_mm": 1e3 * truth.limit,
    }
    return Found(about, truth, found)


def auroc(scores: np.ndarray, labels: np.ndarray) -> float:
    """Area under the ROC curve; ties count half. nan if all labels are equal."""
    positives = int(labels.sum())
    negatives = len(labels) - positives
    if not positives or not negatives:
        return float("nan")
    ranks = rankdata(scores)[labels].sum()
    return float((ranks - positives * (positives + 1) / 2) / (positives * negatives))


def _detection(
    detector: str, score: str, values: torch.Tensor, truth: Truth, seed: int
) -> Detection:
    scores = values.double().reshape(truth.departure.shape)
    # Orbits with all their copies, which are not independent of each other.
    orbits = [
        (s[there].numpy(), d[there].numpy(), b[there].numpy())
        for s, d, b, there in zip(scores, truth.departure, truth.broken, truth.reached, strict=True)
        if there.any()
    ]
    rng = np.random.default_rng(seed)

    def copies(chosen: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s, d, b = (np.concatenate(x) for x in zip(*(orbits[i] for i in chosen), strict=True))
        return s, d, b

    def of_copies(chosen: Sequence[int]) -> float:
        s, _, b = copies(chosen)
        return auroc(s, b)

    def of_orbits(chosen: Sequence[int]) -> float:
        return auroc(
            np.array([orbits[i][0].max() for i in chosen]),
            np.array([orbits[i][2].any() for i in chosen]),
        )

    def correlation(chosen: Sequence[int]) -> float:
        s, d, _ = copies(chosen)
        return float(spearmanr(s, d).statistic) if np.ptp(s) and np.ptp(d) else float("nan")

    draws = rng.integers(len(orbits), size=(RESAMPLES, len(orbits))).tolist()

    def measured(statistic: Callable[[Sequence[int]], float]) -> Measure | None:
        value = statistic(range(len(orbits)))
        if np.isnan(value):
            return None
        return Measure.of(value, np.array([statistic(chosen) for chosen in draws]))

    measures = (measured(of_orbits), measured(of_copies), measured(correlation))
    return Detection(detector, score, *measures, scores)
