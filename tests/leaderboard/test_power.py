"""How many more base policies a claim needs, against simulated studies of that size."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import norm

from symsteer.leaderboard.claims import Outcome
from symsteer.leaderboard.claims_page import paper_section
from symsteer.leaderboard.power import needed, standard_error
from symsteer.leaderboard.statistics import Interval, p_difference, p_equivalence
from symsteer.leaderboard.study import Statement, Study
from symsteer.leaderboard.text import compact
from tests.leaderboard.test_claims import claim_of

ERROR, TESTS = 0.04, 4
CLAIM = claim_of(smallest=0.05)


@dataclass(frozen=True)
class Normal:
    """An effect with a known standard error."""

    value: float
    error: float = ERROR

    def interval(self, confidence: float = 0.95) -> Interval:
        half = float(norm.isf((1 - confidence) / 2)) * self.error
        return Interval(self.value, self.value - half, self.value + half)


@pytest.mark.long
@pytest.mark.parametrize("tests", [1, TESTS])
def test_studies_of_the_needed_size_find_and_exclude(tests: int) -> None:
    measured = Outcome(CLAIM, Normal(0.01))
    found = needed(measured, tests)
    assert found is not None
    assert found.to_exclude is not None
    draws = np.random.default_rng(0).standard_normal(500)

    def share(truth: float, factor: float, excluded: bool) -> float:
        error = ERROR / np.sqrt(factor)
        effects = [Normal(truth + error * z, error) for z in draws]
        level = 0.05 / tests
        if excluded:
            return float(np.mean([p_equivalence(e, 0.05) < level for e in effects]))
        return float(np.mean([p_difference(e) < level for e in effects]))

    assert share(0.05, found.to_find, False) == pytest.approx(0.8, abs=0.05)
    # Its true effect need not be in the middle, so the size that is asked for may be too large.
    assert 0.75 < share(0.01, found.to_exclude, True) < 0.95
    assert share(0.0, found.to_exclude, True) > 0.8


def test_what_is_as_large_as_the_smallest_effect_cannot_be_excluded() -> None:
    found = needed(Outcome(CLAIM, Normal(-0.06)), 1)
    assert found is not None
    assert found.to_exclude is None
    assert standard_error(Normal(0.3).interval()) == pytest.approx(ERROR)


def test_the_page_says_what_an_undecided_claim_needs() -> None:
    def last(outcome: Outcome) -> str:
        study = Study("", "", "", (CLAIM,), (Statement(says="it", claims=(CLAIM.name,)),), "", "")
        # What was not tested does not count in the family.
        other = Outcome(CLAIM.model_copy(update={"name": "other"}), reason="no runs")
        findings = cast(Any, SimpleNamespace(study=study, claims=[outcome, other]))
        return paper_section(findings)[-1].splitlines()[-1].split(" | ")[-1].removesuffix(" |")

    found = needed(Outcome(CLAIM, Normal(0.01)), 1)
    assert found is not None
    assert last(Outcome(CLAIM, Normal(0.01), p=0.5, p_equal=0.5)) == (
        f"{compact(found.to_find)} times to find 0.05<br>{compact(found.to_exclude)} times to show "
        "that it is below"
    )
    large = last(Outcome(CLAIM, Normal(0.06), p=0.5, p_equal=0.5))
    assert large == f"{compact(found.to_find)} times to find 0.05"
    assert last(Outcome(CLAIM, Normal(0.2), p=0.01)) == "\u2013"


def test_what_was_not_tested_has_no_size() -> None:
    assert needed(Outcome(claim_of(), reason="no runs"), 1) is None
    assert needed(Outcome(claim_of(), Normal(0.1), reason="few"), 1) is None
