"""Figures that stay readable with many agents, and what describes them."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import pytest
from matplotlib import style as mpl_style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import FillBetweenPolyCollection
from matplotlib.figure import Figure

from symsteer.agents import AGENTS
from symsteer.leaderboard.curve_figures import learning_curves, q_values
from symsteer.leaderboard.figures import MANY, STYLES
from symsteer.leaderboard.plots import cut
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.svg import SHEETS, draw, plain
from tests.leaderboard.record_factory import make_cell, make_evaluation, make_record, summary_of

LEARNERS = [name for name in AGENTS.names() if AGENTS.get(name).role != "reference"]


def drawn(tables: list[Table]) -> Figure:
    with mpl_style.context(SHEETS):
        figure = draw(learning_curves(tables))
        FigureCanvasAgg(figure).draw()
    return figure


def test_every_agent_has_a_look_of_its_own() -> None:
    assert set(AGENTS.names()) <= set(STYLES)
    assert len({(color, line) for color, _, line in STYLES.values()}) == len(STYLES)


@pytest.mark.parametrize("number", [3, MANY, len(LEARNERS)])
def test_the_legend_fits_and_bands_are_left_out_of_crowded_plots(number: int) -> None:
    curve = [make_evaluation([1, 0] * 20, step) for step in (0, 500, 1000)]
    records = [make_record(curve, agent=a, seed=s) for a in LEARNERS[:number] for s in range(5)]
    runs = [Run(Path(f"{i}.json"), record) for i, record in enumerate(records)]
    figure = drawn(summarize(runs).tables)
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    bands = [c for c in figure.axes[0].collections if isinstance(c, FillBetweenPolyCollection)]
    assert len(bands) == (number if number < MANY else 0)


def test_titles_of_plots_say_how_they_differ_and_fit_beside_each_other() -> None:
    few = {"mode": "diverse", "count": 5, "seed": 0}
    rates = {"standard": 0.5, "equivariant": 0.5}
    records = make_cell(rates, 1, demonstrations=few) + make_cell(rates, 1)
    records += make_cell(rates, 1, env_steps=500_000)
    for tau, utd, norm in itertools.product((0.005, 0.05), (1.0, 4.0), (False, True)):
        options = {"tau": tau, "utd": utd, "layer_norm": norm, "target_entropy": 0.5}
        records += make_cell(rates, 1, variant="wind:1", agent_options=options)
    titles = {
        "none": [
            "unbroken, 5 demonstrations",
            "unbroken, 50 demonstrations,\n50 k steps",
            "unbroken, 50 demonstrations,\n500 k steps",
        ],
        "wind:1": ["wind:1\nlayer_norm false, tau 0.005, utd 1.0"],
    }
    for variant, expected in titles.items():
        own = [record for record in records if record.settings.variant == variant]
        runs = [Run(Path(f"{i}.json"), record) for i, record in enumerate(own)]
        shown = [ax.title for ax in drawn(summarize(runs).tables).axes if ax.get_visible()]
        assert [title.get_text() for title in shown][: len(expected)] == expected
        boxes = [title.get_window_extent() for title in shown[:3]]
        assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_names_of_any_kind_are_drawn_as_text() -> None:
    """matplotlib would read mathematics between dollars, and has no glyphs for everything."""
    assert cut("a\n\x00b" + "c" * 60) == "a b" + "c" * 34 + "..."
    assert plain("$x$ \u00a0\u202e") == "?x?  ?"


def test_a_cross_marks_a_q_that_is_not_finite_and_no_missing_bias() -> None:
    def crosses(**diagnostics: float) -> int:
        curve = [make_evaluation([1, 0], 25_000, False, q_mean=-5.0, q_max=-4.0)]
        curve.append(make_evaluation([1, 0], 50_000, q_mean=-5.0, **diagnostics))
        (plot,) = q_values(summary_of([make_record(curve)]).tables).plots
        return sum(trace.cross > 0 for trace in plot.traces)

    assert crosses(q_max=math.inf) == 1
    assert crosses(q_max=-4.0, q_bias=math.nan) == 0
