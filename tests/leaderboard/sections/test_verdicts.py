"""What became of the paper's statements, and how many more base policies a claim needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import norm

from symsteer.leaderboard.page import other_files
from symsteer.leaderboard.sections import View, claims
from symsteer.leaderboard.sections.claims import ClaimOutcome
from symsteer.leaderboard.sections.verdicts import (
    SECTION,
    needed,
    standard_error,
    standing,
    statements,
)
from symsteer.leaderboard.statistics import Interval, p_difference, p_equivalence
from symsteer.leaderboard.study import Statement, Study
from symsteer.leaderboard.text import compact
from tests.leaderboard.record_factory import make_cell, table_after, view_of
from tests.leaderboard.sections.test_claims import claim_of

ERROR = 0.04
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
def test_studies_of_the_needed_size_find_and_exclude() -> None:
    tests = 4
    found = needed(ClaimOutcome(CLAIM, Normal(0.01)), tests)
    assert found is not None
    assert found.to_exclude is not None
    draws = np.random.default_rng(0).standard_normal(300)

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


def test_what_cannot_be_excluded_or_was_not_tested_has_no_size() -> None:
    found = needed(ClaimOutcome(CLAIM, Normal(-0.06)), 1)
    assert found is not None
    assert found.to_exclude is None
    assert standard_error(Normal(0.3).interval()) == pytest.approx(ERROR)
    assert needed(ClaimOutcome(CLAIM, reason="no runs"), 1) is None
    assert needed(ClaimOutcome(CLAIM, Normal(0.1), reason="few"), 1) is None


def test_the_page_says_what_an_undecided_claim_needs() -> None:
    study = Study("", "", "", (CLAIM,), (Statement(says="it", claims=(CLAIM.name,)),), "", "")

    def last(outcome: ClaimOutcome) -> str:
        findings = replace(view_of(make_cell({"base": 0.5}, 1)).findings, study=study, _results={})
        # What was not tested does not count in the family.
        other = ClaimOutcome(CLAIM.model_copy(update={"name": "other"}), reason="no runs")
        findings._results[claims.SECTION] = [outcome, other]
        (row,) = table_after(other_files(View(findings))["PAPER.md"], "### it")[2:]
        return row[-1]

    found = needed(ClaimOutcome(CLAIM, Normal(0.01)), 1)
    assert found is not None
    assert last(ClaimOutcome(CLAIM, Normal(0.01), p=0.5, p_equal=0.5)) == (
        f"{compact(found.to_find)} times to find 0.05<br>{compact(found.to_exclude)} times to show "
        "that it is below"
    )
    large = last(ClaimOutcome(CLAIM, Normal(0.06), p=0.5, p_equal=0.5))
    assert large == f"{compact(found.to_find)} times to find 0.05"
    assert last(ClaimOutcome(CLAIM, Normal(0.2), p=0.01)) == "\u2013"


def test_the_front_says_on_which_tasks_verdicts_rest_and_what_else_was_declared() -> None:
    other = CLAIM.model_copy(update={"name": "other"})
    statement = Statement(says="it", claims=(CLAIM.name,))
    study = Study("", "", "", (CLAIM, other), (statement,), "", "")
    findings = replace(view_of(make_cell({"base": 0.5}, 1)).findings, study=study, _results={})
    rests = ClaimOutcome(CLAIM, Normal(0.2), policies=5, p=0.01, rests_on=("A-v1", "B-v1"))
    findings._results[claims.SECTION] = [rests, ClaimOutcome(other, reason="no runs")]
    _, verdicts, _, _, others = View(findings).blocks(SECTION)
    assert verdicts == "- it: **supported** (rests on `A-v1`, `B-v1`)."
    assert others == "- **Not tested** (1): other."
    assert standing([rests, ClaimOutcome(other, reason="no runs")]).startswith("1 supported, 1 not")
    assert standing([rests, rests]).endswith("(2 of 2 rest on `A-v1`, `B-v1`)")
    apart = ClaimOutcome(
        CLAIM,
        Normal(0.0),
        policies=5,
        p=0.9,
        p_equal=0.01,
        by_task={"C-v1": Interval(0.2, 0.1, 0.3)},
    )
    assert standing([apart]) == "**equivalent** (on average, but not in `C-v1`)"
    assert standing([rests, apart]).endswith(
        "(1 of 2 rests on `A-v1`, `B-v1`; 1 of 2 on average, but not in `C-v1`)"
    )


def test_the_papers_statements_have_their_tests() -> None:
    rates = {"base": 0.3, "standard": 0.5, "standard-matched": 0.5, "equivariant": 0.8}
    view = view_of(make_cell(rates, episodes=100))
    text = other_files(view)["PAPER.md"].replace("\u00a0", " ")
    overall = {row[0]: row[1] for row in table_after(text, "What the paper says")[2:]}
    said = statements(view.findings)
    assert list(overall) == [each.says for each in view.findings.study.statements] == list(said)
    efficiency, divergence, *_ = said
    assert overall[efficiency] == "2 supported, 1 not tested"
    assert overall[divergence] == "**not tested**"
    _, verdicts, link, *_ = view.blocks(SECTION)
    assert f"- {efficiency}: 2 supported, 1 not tested.\n" in verdicts
    assert "(PAPER.md)" in link
    for statement, tested in said.items():
        rows = table_after(text, f"### {statement}")[2:]
        for row, outcome in zip(rows, tested, strict=True):
            assert row[0] == outcome.claim.name
            assert row[1].startswith(f"**{outcome.verdict}**")
