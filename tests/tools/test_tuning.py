"""Known numbers in the tables of docs/tuning.md; `test_pages` compares the whole page."""

from __future__ import annotations

from symsteer.bench.tuning.trials import Chosen, Score, TrialResult
from tools.pages import tuning as page


def scores(*areas):
    """Of the first base policy in two worlds, then of the second one."""
    cells = [f"task floating {v} s{i}" for i in (0, 1) for v in ("none", "wind:1")]
    return [Score(cell, area, area, 1800.0) for cell, area in zip(cells, areas, strict=False)]


def trial(number, lr, *areas, state="complete"):
    return TrialResult("standard", number, state, {"lr": lr, "critics": 2}, scores(*areas))


TRIALS = [
    trial(0, 1e-3, 0.2, 0.4),
    trial(1, 2e-3, 0.6, 0.8),
    trial(2, 3e-3, 0.1, state="pruned"),
    trial(3, 4e-3, 0.9, 0.7),
    trial(4, 5e-3, 0.2, 0.1),
    trial(5, 6e-3, state="failed"),
]
CHOSEN = [
    Chosen(
        "standard",
        3,
        {"lr": 4e-3, "critics": 2},
        1.5,
        3.0,
        {"task": 3},
        {"lr": scores(0.5, 0.5)},
        {
            "start": scores(0.3, 0.5, 0.3, 0.5),
            "one_option": scores(0.4, 0.5),
            "chosen": scores(0.7, 0.4, 0.3, 0.6),
            "by_task": scores(0.7, 0.4, 0.3, 0.6),
        },
    )
]


def rows(text):
    return {line.split(" | ")[0].strip("| "): line for line in text.splitlines()[2:]}


def test_effort_counts_trials_hours_and_runs_with_a_q_that_was_not_finite():
    """Of older scores it is not known whether Q was finite."""
    assert rows(page.effort(TRIALS))["`standard`"] == "| `standard` | 6 | 4 | 1 | 1 | 9 | - | 4.5 |"
    looked = [
        Score("PickCube-v1 floating none s1", 0.1, 0.0, 1.0, finite) for finite in (True, False)
    ]
    trial = TrialResult("standard", 0, "complete", {"lr": 1.0}, [*looked, *TRIALS[0].scores])
    (row,) = rows(page.effort([trial])).values()
    assert row.split(" | ")[-2] == "1"


def test_settings_are_compared_cell_by_cell():
    (row,) = rows(page.comparison(CHOSEN)).values()
    # One base policy has no interval.
    assert "| 0.400 | 0.450 (+0.050, better in 1 of 2) |" in row
    # Means of two policies: .15 and .05; t with one degree of freedom is 12.706.
    assert "0.500 (+0.100 [-0.54, +0.74], better in 2 of 4)" in row


def test_the_response_is_the_share_of_other_trials_that_are_beaten():
    """First cells of five trials: .2, .6, .1, .9, .2, so 37.5, 75, 0, 100 and 37.5 percent."""
    shares = rows(page.response(TRIALS, 1))
    assert shares["`critics` 2"] == "| `critics` 2 | 50 (5) | 50 (5) |"
    thirds = [line for name, line in shares.items() if name.startswith("`lr`")]
    assert [line.split(" | ")[1] for line in thirds] == ["56 (2)", "50 (2)", "38 (1)"]
