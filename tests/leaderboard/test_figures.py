"""Figures that stay readable with many agents."""

from __future__ import annotations

from pathlib import Path

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import FillBetweenPolyCollection

from symsteer.agents import AGENTS
from symsteer.leaderboard.figures import MANY, STYLES, learning_curves
from symsteer.leaderboard.site.charts import look
from symsteer.leaderboard.summary import Run, Table, summarize
from tests.leaderboard.record_factory import make_evaluation, make_record

LEARNERS = [name for name in AGENTS.names() if AGENTS.get(name).role != "reference"]


def table_of(agents: list[str]) -> Table:
    records = [
        make_record(
            [make_evaluation([1, 0] * 20, step) for step in (0, 500, 1000)], agent=a, seed=s
        )
        for a in agents
        for s in range(5)
    ]
    return summarize([Run(Path(f"{i}.json"), record) for i, record in enumerate(records)]).tables[0]


def test_every_agent_has_a_look_of_its_own() -> None:
    assert set(AGENTS.names()) <= set(STYLES)
    assert len({(color, line) for color, _, line in STYLES.values()}) == len(STYLES)
    assert all(look(agent)["color"] for agent in STYLES)


@pytest.mark.parametrize("number", [3, MANY, len(LEARNERS)])
def test_the_legend_fits_and_bands_are_left_out_of_crowded_panels(number: int) -> None:
    figure = learning_curves([table_of(LEARNERS[:number])])
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    box = figure.legends[0].get_window_extent(canvas.get_renderer())
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.x1
    bands = [c for c in figure.axes[0].collections if isinstance(c, FillBetweenPolyCollection)]
    assert len(bands) == (number if number < MANY else 0)
