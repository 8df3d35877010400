"""Regret: known truth, and the table."""

from dataclasses import replace

import numpy as np
import pytest

from symsteer.leaderboard.regret import Cell, of_an_agent_without_regret, over_cells, regrets
from symsteer.leaderboard.sections import regret
from symsteer.leaderboard.study import Safe
from tests.leaderboard.record_factory import make_cell, view_of

GAPS = np.array([[0.0], [0.1], [0.3]])
"""By how much three agents are below the best one."""


def cell(generator, gaps=GAPS, policies=12, scatter=0.1):
    """Values with a part of the base policy and one of agent and base policy."""
    shared = 0.1 * generator.standard_normal((1, policies))
    return 0.7 - gaps + shared + scatter * generator.standard_normal((len(gaps), policies))


def test_without_scatter_regrets_are_the_gaps():
    np.testing.assert_allclose(regrets(cell(np.random.default_rng(0), scatter=0.0)), GAPS[:, 0])


def test_equal_agents_have_no_regret_on_average():
    """The naive regret, below the largest mean, would be about half of the scatter of a mean."""
    generator = np.random.default_rng(0)
    cells = [cell(generator, np.zeros((3, 1))) for _ in range(300)]
    naive = np.mean([each.mean(1).max() - each.mean(1) for each in cells])
    assert naive > 0.02
    assert abs(np.mean([regrets(each, splits=20) for each in cells])) < 0.005


def test_the_worst_cell_of_an_agent_without_regret_is_known():
    """Simulated from the cells, it is that of an agent which is truly one of the best."""
    generator = np.random.default_rng(0)
    gaps = np.vstack([GAPS, [[0.0]]])
    repetitions = [[cell(generator, gaps) for _ in range(8)] for _ in range(60)]
    true = np.mean([max(regrets(c, 10)[3] for c in cells) for cells in repetitions])
    simulated = np.mean(
        [
            of_an_agent_without_regret([c[:3] for c in cells], 20, 10).max(1).mean()
            for cells in repetitions[:10]
        ]
    )
    assert simulated == pytest.approx(true, abs=0.01)
    assert true > 0.01


def test_its_scatter_is_not_too_small_with_few_policies():
    """Residuals from a mean of four policies are too small by a seventh."""
    generator, gaps = np.random.default_rng(0), 3 * GAPS
    cells = [cell(generator, np.vstack([gaps, [[0.0]]]), 4) for _ in range(1500)]
    true = np.std([regrets(each, 10)[3] for each in cells])
    simulated = np.std(of_an_agent_without_regret([c[:3] for c in cells[:150]], 20, 10))
    assert 0.85 < simulated / true < 1.1


def test_intervals_hold_what_other_policies_show():
    """Eight cells of two places whose cells share base policies: at least 93 % of the intervals of
    the mean have the expected value in them, and they are at most three times too wide."""
    generator, names = np.random.default_rng(0), [str(i) for i in range(8)]
    found = []
    for _ in range(60):
        own = 0.1 * generator.standard_normal((2, 3, 8))
        cells = [
            Cell(cell(generator, policies=8, scatter=0.05) + own[place], names, place)
            for place in (0, 1)
            for _ in range(4)
        ]
        found.append(over_cells(cells, lambda each: each.mean(1), splits=10))
    values = np.array([[each.value for each in row] for row in found])
    inside = [
        row[agent].low <= values[:, agent].mean() <= row[agent].high
        for row in found
        for agent in range(3)
    ]
    assert np.mean(inside) >= 0.93
    widths = np.array([[each.high - each.low for each in row] for row in found])
    assert np.all(widths.mean(0) < 3 * 4 * values.std(0))


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
    assert explained.endswith("Worlds: 2.")
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
    result = two_worlds().findings.of(regret.SECTION)
    assert verdict in regret.verdict(result, Safe(agent=agent, success=success, area=0.5))


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
