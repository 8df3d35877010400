"""The tables of cells, their CSV, and what the page says above and beside them."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from symsteer.leaderboard.page import other_files, render_page
from symsteer.leaderboard.records import Evaluation, RunRecord
from symsteer.leaderboard.sections import View, provenance, spread_of_results, wins_and_losses
from symsteer.leaderboard.study import FOLDER
from symsteer.leaderboard.text import NOTHING
from tests.leaderboard.record_factory import (
    diverging,
    make_cell,
    make_evaluation,
    make_record,
    page_of,
    summary_of,
    table_after,
    view_of,
)


@pytest.fixture(scope="module")
def board() -> View:
    """An unbroken cell and a broken one; strictness pays in the first one."""
    records = []
    for variant, defect in {"none": 0.0, "wind:1": 0.4}.items():
        rates = {"base": 0.3, "zero": 0.4, "golden-ticket": 0.45, "standard": 0.5}
        rates |= {"standard-matched": 0.5, "equivariant": 0.8 - defect, "residual-pathway": 0.7}
        records += make_cell(rates, episodes=100, variant=variant)
    for record in records:
        if record.settings.agent == "golden-ticket":
            record.budget.env_steps = 12_800
    first = records[0]
    session = {"commit": "f" * 40, "device": "cuda", "processor": "One (model 2)"}
    first.continued = [first.provenance.model_copy(update=session)]
    first.wall_clock.resumed = 1
    view = view_of(records)
    return View(view.findings, {run.path: str(run.path) for run in view.summary.runs})


@pytest.fixture(scope="module")
def page(board: View) -> str:
    return render_page(board).replace("\u00a0", " ")


def tallies(*groups: list[RunRecord]) -> dict[str, list[str]]:
    """The table of learners at a glance: against `standard` and the best reference, divergence."""
    _, table = view_of(*groups).blocks(wins_and_losses.SECTION)
    _, _, *rows = table_after("\n" + table.replace("\u00a0", " "), "|")
    return {agent.strip("`"): row for agent, *row in rows}


def test_the_main_table_ranks_with_ties_and_never_references(page: str) -> None:
    _, _, *rows = table_after(page, "### Unbroken symmetry")
    shown = {row[0]: row for row in rows}
    assert [(agent, row[1]) for agent, row in shown.items()] == [
        ("`base`", "\u2013"),
        ("`zero`", "\u2013"),
        ("`golden-ticket`<br>search 12.8 k", "\u2013"),
        ("`equivariant`", "1"),
        ("`residual-pathway`", "2"),
        ("`standard`", "3="),
        ("`standard-matched`", "3="),
    ]
    assert shown["`standard`"][6] == "> 50 k (0/5)"
    strict = shown["`equivariant`"]
    assert strict[6] == "0 (5/5)"
    assert re.fullmatch(r"0\.80<br>\[0\.\d\d, 0\.\d\d\]", strict[2])
    assert re.fullmatch(r"\+0\.50 \u25b2<br>\[\+0\.\d\d, \+0\.\d\d\]", strict[4])
    assert strict[7].startswith("5 \u00d7 100<br>")
    assert [seed for seed, _ in re.findall(r"\[(\d)\]\((\d+\.json)\)", strict[7])] == list("01234")
    assert "Best reference: `golden-ticket`, 0.45. Against it: `equivariant` +0.35 [" in page


def test_the_second_table_shows_q_and_cost(page: str) -> None:
    header, _, *rows = table_after(page, "Q-values, symmetry and cost")
    assert header[2].endswith("(feasible Q: \u221220 to 0)")
    assert [(row[1], row[2], row[-1]) for row in rows] == [("0/5", "0.5<br>\u2013", "4.2")] * 4
    # Nobody measured it.
    assert "TD error" not in header


def test_the_csv_holds_the_numbers_of_the_page(board: View) -> None:
    rows = list(csv.DictReader(other_files(board)["leaderboard.csv"].splitlines()))
    assert len(rows) == 14
    strict = next(r for r in rows if r["agent"] == "equivariant" and r["variant"] == "none")
    assert strict["best_reference"] == "golden-ticket"
    assert float(strict["success_iqm"]) == pytest.approx(0.8)
    assert float(strict["against_best"]) == pytest.approx(0.35)
    assert float(strict["against_base"]) == pytest.approx(0.5)
    # Three evaluations, none in the fourth fifth.
    assert strict["rise"] == ""
    assert (strict["devices"], strict["feasible_low"]) == ("cpu", "-20")
    ticket = next(r for r in rows if r["agent"] == "golden-ticket")
    assert (ticket["search_steps"], ticket["auc"]) == ("12800", "")


def test_every_record_has_a_line_and_every_session_is_named(board: View) -> None:
    rows = list(csv.DictReader(other_files(board)["records.csv"].splitlines()))
    assert len(rows) == 70
    strict = [row for row in rows if (row["agent"], row["variant"]) == ("equivariant", "none")]
    assert [row["seed"] for row in strict] == list("01234")
    assert {float(row["success"]) for row in strict} == {0.8}
    assert all(len(row["config_sha256"]) == 64 for row in rows)
    text = "\n".join(board.blocks(provenance.SECTION))
    for words in (
        "1 of them continued after an interruption",
        "- Commits: `0123456789ab`, `ffffffffffff`",
        "- Devices: `cpu`, `cuda`",
        "- Processors: `One (model 2)`",
    ):
        assert words in text


def test_headings_tell_apart_budgets_and_demonstrations_of_one_break() -> None:
    few = {"mode": "diverse", "count": 5, "seed": 0}
    rates = {"base": 0.3, "standard": 0.5}
    records = make_cell(rates) + make_cell(rates, demonstrations=few)
    records += make_cell(rates, embodiment="panda", variant="wind:1")
    records += make_cell(rates, embodiment="panda", variant="wind:1", env_steps=100_000)
    headings = re.findall(r"^### (.*)$", page_of(records), re.MULTILINE)
    assert headings[-4:] == [
        "Unbroken symmetry, 5 demonstrations",
        "Unbroken symmetry, 50 demonstrations",
        "Broken by arm kinematics and `wind:1`, 50 k steps",
        "Broken by arm kinematics and `wind:1`, 100 k steps",
    ]


def test_agents_that_a_cell_does_not_have_and_missing_seeds_are_named() -> None:
    records = make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.5})
    records += make_cell({"base": 0.3, "standard": 0.5}, variant="wind:1")
    text = page_of(records)
    assert "Not ranked" not in text
    assert text.count("Not run here: `equivariant`.") == 1
    assert [row[0] for row in table_after(text, "### Broken by")[2:]] == ["`base`", "`standard`"]
    few = make_cell({"equivariant": 0.5}, seeds=1, variant="wind:1")
    text = page_of(records + few)
    assert "Not every agent here has the 5 finished seeds" in text
    assert "1 finished, 4 missing" in text
    text = page_of(make_cell({"standard": 0.5}, seeds=4))
    assert "No agent here has the 5 finished seeds" in text
    assert "Rank |" not in text
    assert "1 running" in page_of([make_record([], status="running")])


def test_the_glance_counts_wins_and_diverged_runs_of_all_worlds() -> None:
    # There is no reference, and no column for it.
    assert tallies(
        *(diverging("standard", [1]), diverging("standard", [0, 3], variant="wind:1")),
        *(diverging("equivariant", []), diverging("equivariant", [], variant="wind:1")),
    ) == {"standard": [NOTHING, "3/10"], "equivariant": ["0 ▲ 0 ▼ of 2", "0/10"]}
    # A cell with too few seeds is no win.
    assert tallies(
        make_cell({"base": 0.3, "standard": 0.1, "equivariant": 0.9}),
        make_cell({"base": 0.3, "standard": 0.9, "equivariant": 0.1}, seeds=4, variant="wind:1"),
    ) == {
        "standard": [NOTHING, "0 ▲ 1 ▼ of 1", "0/9"],
        "equivariant": ["1 ▲ 0 ▼ of 1", "1 ▲ 0 ▼ of 1", "0/9"],
    }


def test_the_page_says_how_symmetric_the_base_policies_are() -> None:
    records = make_cell({"base": 0.3, "standard": 0.5}, episodes=20)
    said = "Equivariance error of its actions: "
    assert f"{said}2.0e-7." in page_of(records).replace("\u2212", "-")
    for number, record in enumerate(records):
        record.base_policy.content_hash = f"{number:064x}"
        record.base_policy.equivariance_error = 2e-7 if number else 0.5
    assert f"{said}2.0e-7 to 0.5." in page_of(records).replace("\u2212", "-")
    for record in records:
        record.base_policy.equivariance_error = None
    assert said not in page_of(records)


def test_a_study_can_say_what_a_reader_must_know(tmp_path: Path) -> None:
    study = tmp_path / "mine.toml"
    said = ['notice = "> **Mind this.**"', 'details = "*Limits*: one."']
    study.write_text("\n".join([*said, 'declared = "abcdef0"', 'claims = "other.toml"']))
    (tmp_path / "other.toml").write_text((FOLDER / "paper.toml").read_text())
    text = page_of(make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.7}), str(study))
    # There is no git here that could say that the commit is another one.
    assert "> **Mind this.**\n\n<details>" in text
    assert text.index("*Limits*: one.\n\n</details>") < text.index("## Verdicts")
    assert re.search(r"declared in `other.toml` \(sha256 `[0-9a-f]{12}`, commit `abcdef0`\)", text)


def test_notes_name_what_is_not_finite_failures_and_twins() -> None:
    """Returns of a run, at its last evaluation; Q has its own mark."""
    records = make_cell({"base": 0.3, "standard": 0.5})
    for record in records[-2:]:
        last = record.evaluations[-1].model_dump(by_alias=True)
        last["episodes"]["return"][3] = float("nan")
        last["diagnostics"]["q_bias"] = float("inf")
        record.evaluations[-1] = Evaluation.model_validate(last)
    records.append(make_record(status="failed", seed=9))
    records.append(make_record([make_evaluation([1, 0])], learning_rate=1e-3, seed=0))
    text = page_of(records)
    told = f"return (first after {last['env_steps']} steps)"
    assert text.count(f": not finite: `{told}`") == 2
    assert "- `standard`, seed 9: failed, last evaluated after 50 k steps: `the simulator" in text
    twin = "`standard (learning_rate 0.001)`"
    assert f"Same agent with different settings, in rows of their own: {twin}" in text


def test_differences_that_are_alike_have_no_width() -> None:
    rates = {"base": [0.3], "standard": [0.0] * 7, "equivariant": [0.0, *[1.0] * 6]}
    text = page_of(make_cell(rates, seeds=7))
    alike = "`equivariant` 0.00 [0.00, 0.00]; `standard` 0.00 [0.00, 0.00]."
    assert f"From the fourth to the last fifth of the budget: {alike}" in text


def test_the_page_says_how_much_of_the_spread_is_the_policys() -> None:
    rates = (0.1, 0.3, 0.5, 0.7, 0.9)

    def spreads(of_policy: int, policies: int = 5) -> tuple[str, dict[str, str]]:
        records = []
        for policy, rate in enumerate(rates[:policies]):
            made = make_cell({"standard": rate}, seeds=of_policy, episodes=100, policy_seed=policy)
            for record in made:
                record.base_policy.content_hash = f"{policy}" * 64
            records += made
        text, table = view_of(records).blocks(spread_of_results.SECTION)
        header, _, row = table_after("\n" + table.replace("\u00a0", " "), "|")
        return text, dict(zip(header[1:], row[1:], strict=True))

    text, shown = spreads(3)
    # The episodes that succeed are others in every run, their number is not.
    assert (shown["Runs on one"], shown["Base policies' share of the variance"]) == (
        "0.000",
        "98 %",
    )
    assert float(shown["Base policies"]) == pytest.approx(np.std(rates, ddof=1), abs=0.01)
    assert float(shown["Episodes"]) == pytest.approx(0.04, abs=0.01)
    text, shown = spreads(5, policies=1)
    assert list(shown) == ["Runs on one", "Episodes"]
    assert "Each cell steers one base policy: intervals are about this policy alone" in text
    text, shown = spreads(1)
    assert list(shown) == ["Both together", "Episodes"]
    assert "only the sum of both is known" in text
    assert spread_of_results.spreads(summary_of(make_cell({"standard": 0.5}, 1))) == {}
