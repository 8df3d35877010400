"""Which agent, in which world: known success, and what a centimetre costs."""

import pytest

from symsteer.leaderboard.sections import in_which_world
from tests.leaderboard.record_factory import make_cell, view_of


def view(*cells):
    """Of cells: success by agent, and settings."""
    records = [record for rates, settings in cells for record in make_cell(rates, **settings)]
    for record in records:
        record.base_policy.content_hash = f"{record.settings.seed:064d}"
    return view_of(records)


def rows(seen):
    """The cells of the table, without its header."""
    _, table, *_ = in_which_world.render(seen.findings.of(in_which_world.SECTION), seen)
    lines = table.replace("\u00a0", " ").splitlines()[2:]
    return [line.strip("| ").split(" | ") for line in lines]


def test_the_best_learner_and_those_as_good_are_bold():
    rates = {"base": 0.95, "standard": 0.5, "equivariant": 0.9, "slow": 0.9}
    assert rows(view((rates, {}))) == [
        ["unbroken", "50 k", "0.95", "0.50", "**0.90**", "**0.90**", "1"]
    ]


def test_worlds_are_said_in_words_and_strengths_are_pooled():
    weak = {"standard": 0.5, "equivariant": 0.9}
    strong = {"standard": 0.7, "equivariant": 0.3}
    found = rows(view((weak, {"variant": "wind:0.5"}), (strong, {"variant": "wind:1"})))
    assert [found[0][0], *found[0][2:]] == ["wind on the object", "**0.60**", "**0.60**", "2"]


def test_cells_that_lack_a_learner_take_it_out_of_the_comparison():
    """With it, the other learners would be shown in one world and it in another."""
    both = {"standard": 0.5, "equivariant": 0.9}
    found = rows(
        view(({**both, "slow": 0.9}, {"variant": "wind:0.5"}), (both, {"variant": "wind:1"}))
    )
    assert found == [["wind on the object", "50 k", "0.50", "**0.90**", "2"]]


def test_one_learner_alone_is_not_compared():
    seen = view(({"standard": 0.5, "base": 0.2}, {}))
    assert in_which_world.render(seen.findings.of(in_which_world.SECTION), seen) == []


def test_what_a_centimetre_costs():
    """From .8 to .6 over the 2 cm of full strength, from .8 to .7 over 1 cm."""
    worlds = {"none": 0.8, "perception_bias:1": 0.6, "perception_bias:0.5": 0.7}
    seen = view(
        *(({"standard": rate, "equivariant": 0.8}, {"variant": v}) for v, rate in worlds.items()),
        ({"standard": 0.1}, {"variant": "perception_bias:0.5+wind:1"}),
        ({"standard": 0.1}, {"variant": "perception_bias:0..1"}),
    )
    found = seen.findings.of(in_which_world.SECTION).centimetre
    assert {agent: cost.value for agent, cost in found.items()} == {
        "standard": pytest.approx(-0.1),
        "equivariant": pytest.approx(0.0),
    }
