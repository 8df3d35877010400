"""Regret: known truth, and the table."""

from dataclasses import replace

import numpy as np
import pytest

from symsteer.leaderboard.regret import Cell, intervals, of_an_agent_without_regret, regrets
from symsteer.leaderboard.sections import regret
from symsteer.leaderboard.study import Safe
from tests.leaderboard.record_factory import make_cell, summary_of, view_of

GAPS = np.array([[0.0], [0.1], [0.3]])
"""By how much three agents are below the best one."""


def cell(generator, gaps=GAPS, policies=12, scatter=0.1, place=""):
    """Values with a part of the base policy and one of agent and base policy."""
    shared = 0.1 * generator.standard_normal((1, policies))
    values = 0.7 - gaps + shared + scatter * generator.standard_normal((len(gaps), policies))
    return Cell(values, [f"{place}{policy}" for policy in range(policies)], place)


def test_without_scatter_regrets_are_the_gaps():
    found = regrets(
        [cell(np.random.default_rng(0), gaps, scatter=0.0) for gaps in (GAPS, 2 * GAPS)]
    )
    np.testing.assert_allclose(found.cells, np.hstack([GAPS, 2 * GAPS]), atol=1e-12)
    np.testing.assert_allclose(found.mean, 1.5 * GAPS[:, 0], atol=1e-12)
    np.testing.assert_allclose(found.worst, 2 * GAPS[:, 0], atol=1e-12)


def test_equal_agents_have_no_regret_on_average():
    """The naive regret, below the largest mean, would be about half of the scatter of a mean, and
    the largest of eight cells far more."""
    generator, found = np.random.default_rng(0), []
    for _ in range(60):
        found.append(regrets([cell(generator, np.zeros((3, 1))) for _ in range(8)], splits=20))
    naive = np.mean([each.cells.max(1) for each in found])
    assert naive > 0.04
    assert abs(np.mean([each.mean for each in found])) < 0.005
    assert abs(np.mean([each.worst for each in found])) < 0.01


def test_the_halves_are_so_many_that_their_luck_does_not_show():
    """Five policies, whose worst cells are nearly alike: other halves change less than .01."""
    generator = np.random.default_rng(0)
    cells = [cell(generator, GAPS / 2, policies=5) for _ in range(6)]
    again = np.array([regrets(cells, seed=seed).worst for seed in range(5)])
    assert np.ptp(again, axis=0).max() < 0.01
    nothing = [of_an_agent_without_regret(cells, seed=seed)[1].mean() for seed in range(5)]
    assert np.ptp(nothing) < 0.004


def test_the_worst_cell_is_found():
    """One cell of eight, with a loss of .3 behind a scatter of .1."""
    generator = np.random.default_rng(0)
    gaps = np.array([[0.0], [0.3]])
    cells = [cell(generator, gaps if index == 5 else 0 * gaps) for index in range(8)]
    assert regrets(cells).worst[1] == pytest.approx(0.3, abs=0.08)


def test_an_agent_without_regret_is_like_one_that_is_truly_among_the_best():
    generator = np.random.default_rng(0)
    gaps = np.vstack([GAPS, [[0.0]]])
    repetitions = [[cell(generator, gaps) for _ in range(8)] for _ in range(60)]
    true = np.array([(r.mean[3], r.worst[3]) for r in (regrets(c, 10) for c in repetitions)])
    simulated = np.array(
        [
            of_an_agent_without_regret([Cell(c.values[:3], c.policies) for c in cells], 20, 10)
            for cells in repetitions[:10]
        ]
    )
    np.testing.assert_allclose(simulated.mean((0, 2)), true.mean(0), atol=0.01)


def test_its_scatter_is_not_too_small_with_few_policies():
    """Residuals from a mean of four policies are too small by a seventh."""
    generator, gaps = np.random.default_rng(0), 3 * GAPS
    cells = [cell(generator, np.vstack([gaps, [[0.0]]]), 4) for _ in range(1500)]
    true = np.std([regrets([each], 10).mean[3] for each in cells])
    without = [Cell(each.values[:3], each.policies) for each in cells[:150]]
    simulated = np.std([of_an_agent_without_regret([each], 20, 10)[0] for each in without])
    assert 0.85 < simulated / true < 1.1


def test_intervals_hold_what_other_policies_show():
    """At least 93 % of those of the mean and of the worst cell have the expected value in them.

    Policies differ in how they suit an agent, in all cells of their place alike.
    """
    generator, found = np.random.default_rng(0), []
    for _ in range(60):
        cells = []
        for place, policies, scatter in (("few", 5, 0.15), ("many", 9, 0.05)):
            own = scatter * generator.standard_normal((3, policies))
            drawn = [cell(generator, GAPS / 5, policies, scatter / 2, place) for _ in range(4)]
            cells += [replace(each, values=each.values + own) for each in drawn]
        found.append(intervals(cells, splits=10))
    value, low, high = (
        np.array([[[getattr(e, end) for e in each] for each in row] for row in found])
        for end in ("value", "low", "high")
    )
    expected = value.mean(0)
    assert ((low <= expected) & (expected <= high)).mean((0, 2)).min() >= 0.93
    assert np.all((high - low).mean(0) < 3 * 4 * value.std(0))


def test_degrees_of_freedom_are_those_of_the_places_with_the_variance():
    """A place whose policies all agree adds none; five policies leave four, not twelve."""
    generator = np.random.default_rng(0)
    noisy = cell(generator, 10 * GAPS, 5, place="noisy")
    sure = cell(generator, 10 * GAPS, 9, scatter=0.0, place="sure")
    alone, both = (intervals(cells)[0][2] for cells in ([noisy], [noisy, sure]))
    # A mean over two cells halves the width.
    assert both.high - both.low == pytest.approx((alone.high - alone.low) / 2)


def two_worlds():
    """In one world the first learner is best, in the other one the second."""
    worlds = {"none": (0.9, 0.5), "wind:1": (0.7, 0.8)}
    records = [
        record
        for variant, (first, second) in worlds.items()
        for record in make_cell(
            {"base": 0.2, "standard": first, "equivariant": second}, variant=variant
        )
    ]
    for record in records:
        record.base_policy.content_hash = f"{record.settings.seed:064d}"
    return view_of(records)


def test_the_table_orders_learners_by_their_worst_cell():
    view = two_worlds()
    result = view.findings.of(regret.SECTION)
    np.testing.assert_allclose(result.success, [[0.0, 0.1], [0.4, 0.0]], atol=1e-9)
    explained, table, *_ = regret.render(result, view)
    assert explained.endswith("Cells: 2, of 50\u00a0k steps.")
    first, second, last = table.splitlines()[2:]
    assert first.replace("\u00a0", " ").startswith(
        "| `standard` | 0.05 [0.05, 0.05] | 0.10 [0.10, 0.10] |"
    )
    assert first.endswith("| PickCube, wind 1 |")
    assert second.startswith("| `equivariant` | 0.20")
    assert last.startswith("| *without regret* |")


@pytest.mark.parametrize(
    ("agent", "success", "verdict"),
    [
        ("standard", 0.11, "**Supported**: above an agent without regret by +0.100 of success"),
        ("standard", 0.09, "**Contradicted**"),
        ("equivariant", 0.5, "**Contradicted**"),  # within what is allowed, but not the best
        ("slow", 0.5, "**Not tested**"),
    ],
)
def test_a_declared_agent_is_safe_or_not(agent, success, verdict):
    """The worst cells of the two lose .1 and .4; nothing scatters."""
    view = two_worlds()
    safe = Safe(agent=agent, success=success, area=0.5)
    assert verdict in regret.verdict(view.findings.of(regret.SECTION), safe, view.summary)


def test_a_declared_agent_is_judged_without_the_tasks_that_tested_it():
    """`standard` loses .1 in the known task, and .3 in the new one."""
    worlds = [("A-v1", 0.7), ("B-v1", 0.5)]
    cells = [make_cell({"standard": s, "equivariant": 0.8}, task=t) for t, s in worlds]
    safe = Safe(agent="standard", success=0.9, area=0.9, tested_on=("A-v1",))
    for cell in cells:
        for record in cell:
            record.base_policy.content_hash = f"{record.settings.seed:064d}"
    summary = summary_of(*cells)
    everywhere = regret.compute(summary)
    _, text = regret.verdict(everywhere, safe, summary).split(" Without `A-v1`, where")
    without, in_all = text.split(" In all: ")
    assert "agent without regret by +0.300 of success" in without
    assert "agent without regret by +0.300 of success" in in_all
    assert [table.key.task for table in regret.compute(summary, ["A-v1"]).cells] == ["B-v1"]
    nowhere = safe.model_copy(update={"tested_on": ("A-v1", "B-v1")})
    assert "there is no cell that two learners share" in regret.verdict(
        everywhere, nowhere, summary
    )


@pytest.mark.parametrize(
    "safe",
    [
        None,
        Safe(agent="equivariant", success=0.5, area=0.5),  # contradicted
        Safe(agent="slow", success=0.5, area=0.5),  # not tested
    ],
)
def test_without_a_proven_agent_the_plain_one_is_taken(safe):
    assert regret.fallback(two_worlds().summary, safe) == "standard"


def test_a_proven_agent_is_taken_where_nothing_is_known():
    cell = make_cell({"standard": 0.5, "slow": 0.8})
    for record in cell:
        record.base_policy.content_hash = f"{record.settings.seed:064d}"
    safe = Safe(agent="slow", success=0.1, area=0.1)
    assert regret.fallback(summary_of(cell), safe) == "slow"


def test_the_page_tells_the_verdict():
    view = two_worlds()
    study = replace(view.findings.study, safe=Safe(agent="standard", success=0.11, area=0.5))
    view = replace(view, findings=replace(view.findings, study=study))
    assert "**Supported**" in regret.render(view.findings.of(regret.SECTION), view)[1]


def test_the_figure_has_every_learner_in_every_cell():
    view = two_worlds()
    figure = regret.figure(view.findings.of(regret.SECTION), view.summary)
    success, area = figure.plots
    assert [(dot.name, dot.y, dot.x.value) for dot in success.dots] == [
        ("standard", 0, pytest.approx(0.0)),
        ("standard", 1, pytest.approx(0.1)),
        ("equivariant", 0, pytest.approx(0.4)),
        ("equivariant", 1, pytest.approx(0.0)),
    ]
    assert len(area.dots) == 4


def test_one_learner_has_no_regret():
    view = view_of(make_cell({"base": 0.2, "standard": 0.5}))
    assert regret.render(view.findings.of(regret.SECTION), view) == []


def test_cells_of_every_budget_count():
    cells = [
        make_cell({"standard": 0.5, "equivariant": 0.8}, env_steps=s) for s in (240, 240, 1200)
    ]
    cells[1] = make_cell({"standard": 0.5, "equivariant": 0.8}, env_steps=240, variant="wind:1")
    for cell in cells:
        for record in cell:
            record.base_policy.content_hash = f"{record.settings.seed:064d}"
    budgets = [table.key.env_steps for table in regret.compute(summary_of(*cells)).cells]
    assert sorted(budgets) == [240, 240, 1200]
