"""The paper's claims: each test on records whose answer is known, and every way to be undecided."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from symsteer.leaderboard.claims import Claim, claims
from symsteer.leaderboard.defects import Audit, Defect, defect_map
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.summary import Run, summarize
from tests.leaderboard.record_factory import make_cell, make_evaluation, make_record

NAMES = (
    "faster than standard",
    "faster than standard-matched",
    "divergence",
    "divergence, matched",
    "bias",
    "bias, matched",
    "fewest demonstrations",
    "fewer demonstrations",
    "slope, area",
    "slope, success",
    "approximate beyond",
)
DEFECTS = {"none": 0.01, "wind:0.1": 0.04, "wind:0.5": 0.1, "wind:0.8": 0.26, "wind:1": 0.4}


def audit_of(defects: dict[str, float]) -> Audit:
    return {
        ("PickCube-v1", "floating", variant, "C8"): Defect(Interval(d, d, d), "tool_step")
        for variant, d in defects.items()
    }


def found(records: Sequence[RunRecord], audit: Audit | None = None) -> dict[str, Claim]:
    audit = audit_of(DEFECTS) if audit is None else audit
    summary = summarize([Run(Path(f"{i}.json"), r) for i, r in enumerate(records)])
    tests = claims(summary, audit, defect_map(summary, audit))
    return dict(zip(NAMES, tests, strict=True))


def cells(rates: dict[str, dict[str, float]], seeds: int = 5) -> list[RunRecord]:
    return [r for variant, cell in rates.items() for r in make_cell(cell, seeds, variant=variant)]


def value(claim: Claim) -> float:
    assert claim.effect is not None
    return claim.effect.value


def test_sample_efficiency_is_tested_where_symmetry_holds() -> None:
    rates = {
        "none": {"standard": 0.5, "standard-matched": 0.9, "equivariant": 0.75},
        "wind:0.1": {"standard": 0.5, "standard-matched": 0.9, "equivariant": 0.85},
        # Broken beyond the limit, so these must not count.
        "wind:0.5": {"standard": 0.9, "standard-matched": 0.1, "equivariant": 0.1},
        "wind:1": {"standard": 0.9, "standard-matched": 0.1, "equivariant": 0.1},
    }
    tests = found(cells(rates))
    standard, matched = tests[NAMES[0]], tests[NAMES[1]]
    assert value(standard) == pytest.approx(0.3)
    assert (standard.verdict, standard.cells, standard.seeds) == ("supported", 2, 10)
    assert value(matched) == pytest.approx(-0.1)
    assert matched.verdict == "contradicted"
    # 80 % of the best is 0.72 in both cells.
    assert standard.beside == "steps: 0 % (10/10) against > 100 % (0/10) of the budget"


def test_no_difference_is_undecided() -> None:
    rates = {"none": {"standard": 0.6, "equivariant": 0.6}}
    claim = found(cells(rates))[NAMES[0]]
    assert value(claim) == pytest.approx(0)
    assert (claim.verdict, claim.reason) == ("undecided", "")


def test_without_enough_seeds_the_effect_is_shown_and_nothing_decided() -> None:
    rates = {"none": {"standard": 0.1, "equivariant": 0.9, "approximate": 0.9}}
    tests = found(cells(rates, seeds=4))
    for name in NAMES[0], "divergence":
        assert tests[name].effect is not None
        assert tests[name].verdict == "undecided"
        assert tests[name].reason == "at most 4 paired seeds in a cell, 5 are needed"


def test_cells_with_few_seeds_do_not_count_beside_full_ones() -> None:
    rates = {"none": {"standard": 0.4, "equivariant": 0.6}}
    few = {"wind:0.1": {"standard": 0.9, "equivariant": 0.1}}
    claim = found(cells(rates) + cells(few, seeds=3))[NAMES[0]]
    assert value(claim) == pytest.approx(0.2)
    assert (claim.cells, claim.seeds) == (1, 5)


def test_without_an_audit_or_an_agent_there_is_a_reason() -> None:
    records = cells({"none": {"standard": 0.4, "equivariant": 0.6}})
    tests = found(records, {})
    assert "where the audited defect is at most 0.05" in tests[NAMES[0]].reason
    assert "no cell has an audited defect" in tests["fewest demonstrations"].reason
    assert "0 audited cells" in tests["slope, area"].reason
    tests = found(records)
    assert "`standard-matched`" in tests[NAMES[1]].reason
    assert "`approximate`" in tests["approximate beyond"].reason
    assert all(t.verdict == "undecided" and t.effect is None for t in tests.values() if t.reason)


def diverging(agent: str, seeds: Sequence[int], status: str = "finished") -> list[RunRecord]:
    """Five runs of which `seeds` diverge."""
    records = []
    for seed in range(5):
        q = {"q_mean": -5.0, "q_violation": 0.5 if seed in seeds else 0.0}
        curve = [make_evaluation([1, 0], 10_000 * (i + 1), i == 4, **q) for i in range(5)]
        broke = seed in seeds and status != "finished"
        run_status = status if broke else "finished"
        records.append(make_record(curve, run_status, agent=agent, seed=seed))
    return records


def test_divergence_counts_seeds() -> None:
    claim = found(diverging("standard", range(5)) + diverging("equivariant", []))["divergence"]
    assert claim.verdict == "supported"
    assert claim.effect is not None
    assert (claim.effect.value, claim.effect.high) == (1.0, 1.0)
    assert 0.3 < claim.effect.low < 0.6
    assert claim.beside == "5/5 against 0/5 diverged"
    claim = found(diverging("standard", [0]) + diverging("equivariant", [1]))["divergence"]
    assert (value(claim), claim.verdict) == (0.0, "undecided")
    claim = found(diverging("standard", []) + diverging("equivariant", range(5)))["divergence"]
    assert claim.verdict == "contradicted"
    matched = diverging("standard-matched", range(5)) + diverging("equivariant", [])
    assert found(matched)["divergence, matched"].verdict == "supported"


def test_the_bias_of_q_counts_by_its_size_in_the_final_window() -> None:
    def biased(agent: str, biases: Sequence[float]) -> list[RunRecord]:
        records = []
        for seed, bias in enumerate(biases):
            curve = [
                make_evaluation([1, 0], steps, steps == 50_000, q_mean=0.0, q_bias=value)
                for steps, value in ((0, 99.0), (45_000, bias - 1), (50_000, bias + 1))
            ]
            records.append(make_record(curve, agent=agent, seed=seed))
        return records

    far, near = [-6.0, 6.0, 7.0, -7.0, 6.0], [2.0, -2.0, 3.0, -3.0, 2.0]
    claim = found(biased("standard", far) + biased("equivariant", near))["bias"]
    assert value(claim) == pytest.approx(4.0)
    assert (claim.verdict, claim.seeds) == ("supported", 5)
    claim = found(biased("standard", near) + biased("equivariant", far))["bias"]
    assert claim.verdict == "contradicted"
    claim = found(biased("standard-matched", far) + biased("equivariant", near))["bias, matched"]
    assert value(claim) == pytest.approx(4.0)


def test_q_is_compared_on_the_same_base_policy() -> None:
    others = diverging("equivariant", [])
    for record in others:
        record.base_policy.content_hash = "f" * 64
    tests = found(diverging("standard", range(5)) + others)
    assert tests["divergence"].effect is tests["bias"].effect is None


def test_runs_that_broke_off_after_diverging_count() -> None:
    standard = diverging("standard", range(5), status="failed")
    claim = found(standard + diverging("equivariant", []))["divergence"]
    assert (claim.seeds, claim.verdict) == (5, "supported")
    # A run that has not finished can still diverge.
    running = [make_record(r.evaluations, "running", seed=r.settings.seed) for r in standard]
    for record in running:
        for evaluation in record.evaluations:
            evaluation.diagnostics["q_violation"] = 0.0
    claim = found(running + diverging("equivariant", []))["divergence"]
    assert claim.effect is None


def demonstrations(advantages: dict[int, float], seeds: int = 5) -> list[RunRecord]:
    return [
        record
        for count, advantage in advantages.items()
        for record in make_cell(
            {"standard": 0.4, "equivariant": 0.4 + advantage},
            seeds,
            demonstrations={"mode": "diverse", "count": count, "seed": 0},
        )
    ]


def test_few_demonstrations_compare_the_ends() -> None:
    tests = found(demonstrations({10: 0.4, 50: 0.2, 100: 0.1}))
    fewest, fewer = tests["fewest demonstrations"], tests["fewer demonstrations"]
    assert value(fewest) == pytest.approx(0.4)
    assert value(fewer) == pytest.approx(0.3)
    assert (fewest.verdict, fewer.verdict) == ("supported", "supported")
    assert (fewest.cells, fewest.seeds, fewer.cells, fewer.seeds) == (1, 5, 1, 5)
    tests = found(demonstrations({10: 0.2, 50: 0.5}))
    assert tests["fewest demonstrations"].verdict == "supported"
    assert tests["fewer demonstrations"].verdict == "contradicted"


def test_one_number_of_demonstrations_decides_nothing() -> None:
    for name in ("fewest demonstrations", "fewer demonstrations"):
        claim = found(demonstrations({50: 0.3}))[name]
        assert claim.verdict == "undecided"
        assert claim.reason.endswith("(all have 50)")
        few = found(demonstrations({10: 0.4, 50: 0.2}, seeds=3))[name]
        assert few.verdict == "undecided"
        assert "5" in few.reason
        assert few.effect is not None


def test_limits_follow_the_line_and_the_largest_defects() -> None:
    rates = {
        variant: {"standard": 0.5, "equivariant": 0.75 - 1.2 * d, "approximate": 0.7}
        for variant, d in DEFECTS.items()
    }
    tests = found(cells(rates))
    for name in ("slope, area", "slope, success"):
        assert value(tests[name]) == pytest.approx(-0.12, abs=0.01)
        assert (tests[name].verdict, tests[name].cells) == ("supported", 5)
    beyond = tests["approximate beyond"]
    assert value(beyond) == pytest.approx(
        np.mean([0.7 - 0.75 + 1.2 * d for d in (0.26, 0.4)]), abs=0.02
    )
    assert (beyond.verdict, beyond.cells) == ("supported", 2)
    rising = {v: {"standard": 0.5, "equivariant": 0.3 + 1.2 * d} for v, d in DEFECTS.items()}
    assert found(cells(rising))["slope, success"].verdict == "contradicted"
