"""Which agent, in which world: known success, and what a centimetre costs."""

import pytest

from symsteer.leaderboard.sections import in_which_world
from tests.leaderboard.record_factory import (
    make_cell,
    make_record,
    view_of,
    with_policies,
)


def view(*cells):
    """Of cells: success by agent, and settings."""
    records = [record for rates, settings in cells for record in make_cell(rates, **settings)]
    for record in records:
        record.base_policy.content_hash = f"{record.settings.seed:064d}"
    return view_of(records)


def rows(seen, table=1):
    """The cells of a table, without its header: that of worlds, or (3) that of camera errors."""
    blocks = in_which_world.render(seen.findings.of(in_which_world.SECTION), seen)
    lines = blocks[table].replace("\u00a0", " ").splitlines()[2:]
    return [line.strip("| ").split(" | ") for line in lines]


def test_the_best_learner_and_those_as_good_are_bold():
    rates = {"base": 0.95, "standard": 0.5, "equivariant": 0.9, "slow": 0.9}
    assert rows(view((rates, {}))) == [
        ["unbroken", "50 k", "0.95", "0.50", "**0.90**", "**0.90**", "1"]
    ]


def test_of_two_that_are_equally_good_both_are_what_others_are_compared_with(monkeypatch):
    monkeypatch.setattr(in_which_world, "_above", lambda _, *pair: pair == ("equivariant", "slow"))
    summary = view(
        ({"standard": 0.1, "augmented": 0.5, "equivariant": 0.5, "slow": 0.4}, {})
    ).summary
    world = in_which_world.world_of("unbroken", summary.tables, summary.agents)
    assert world.best == ["standard", "augmented", "equivariant"]


def test_what_is_below_the_best_in_one_task_alone_is_bold_too():
    """`standard` is far below in A and as good in B; in both it is below, but not without A."""
    tasks = {"A-v1": (0.3, 0.9), "B-v1": (0.5, 0.5)}
    seen = view(
        *(({"standard": s, "equivariant": e}, {"task": task}) for task, (s, e) in tasks.items())
    )
    assert rows(seen)[0][2:] == ["**0.40**", "**0.70**", "2"]
    seen = view(*(({"standard": 0.3, "equivariant": 0.9}, {"task": task}) for task in tasks))
    assert rows(seen)[0][2:] == ["0.30", "**0.90**", "2"]


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


def test_five_runs_on_one_base_policy_are_not_enough():
    records = make_cell({"standard": 0.5, "equivariant": 0.9})
    seen = view_of(records)
    assert len({record.base_policy.content_hash for record in records}) == 1
    assert in_which_world.render(seen.findings.of(in_which_world.SECTION), seen) == []


def test_controls_are_never_the_best():
    records = make_cell({"standard": 0.2, "equivariant": 0.6, "wrong-group": 0.9})
    for record in records:
        record.base_policy.content_hash = f"{record.settings.seed:064d}"
        if record.settings.agent == "wrong-group":
            record.role = "control"
    assert rows(view_of(records)) == [["unbroken", "50 k", "0.20", "**0.60**", "1"]]


def test_what_a_camera_error_costs():
    """From .8 to .6 over 2 cm, from .8 to .75 over 1 cm; not in proportion.

    PushCube has 1 cm alone, so that it would count in one row and not in the other.
    """
    worlds = {"none": 0.8, "perception_bias:1": 0.6, "perception_bias:0.5": 0.75}
    seen = view(
        *(({"standard": rate, "equivariant": 0.8}, {"variant": v}) for v, rate in worlds.items()),
        ({"standard": 0.1}, {"variant": "perception_bias:0.5+wind:1"}),
        ({"standard": 0.1}, {"variant": "perception_bias:0..1"}),
        ({"standard": 0.9, "equivariant": 0.9}, {"task": "PushCube-v1"}),
        (
            {"standard": 0.1, "equivariant": 0.1},
            {"task": "PushCube-v1", "variant": "perception_bias:0.5"},
        ),
    )
    near, far = seen.findings.of(in_which_world.SECTION).errors
    assert (near.centimetres, far.centimetres) == (1, 2)
    assert near.change["standard"].value == pytest.approx(-0.05)
    assert far.change["standard"].value == pytest.approx(-0.2)
    assert far.change["equivariant"].value == pytest.approx(0.0)
    assert [row[0] for row in rows(seen, 3)] == ["1 cm", "2 cm"]
    assert rows(seen, 3)[1][1].startswith("0.60<br>\u22120.20 [")


def test_camera_errors_are_of_the_same_base_policies():
    """A sixth policy, which is good in the unbroken world alone, was not run at 1 cm."""
    both = {"standard": 0.5, "equivariant": 0.5}
    records = []
    for variant in ("none", "perception_bias:0.5", "perception_bias:1"):
        records += make_cell(both, variant=variant)
        for agent in both if variant != "perception_bias:0.5" else ():
            (sixth,) = make_cell({agent: float(variant == "none")}, seeds=1, variant=variant)
            records.append(make_record(sixth.evaluations, agent=agent, seed=5, variant=variant))
    near, far = view_of(with_policies(records, 6)).findings.of(in_which_world.SECTION).errors
    assert near.success == far.success == both
    assert [far.change[agent].value for agent in both] == [0, 0]


def test_places_with_one_distance_each_have_rows_of_their_own():
    both = {"standard": 0.5, "equivariant": 0.5}
    worlds = [("A-v1", "perception_bias:1"), ("B-v1", "perception_bias:0.8")]
    seen = view(
        *((both, {"task": task, "variant": v}) for task, far in worlds for v in ("none", far))
    )
    assert [row[0] for row in rows(seen, 3)] == ["1.6 cm", "2 cm"]


def test_camera_errors_compare_agents_in_the_same_cells():
    """`equivariant` was not run at 2 cm, so that it is left out at 1 cm, too."""
    both = {"standard": 0.5, "equivariant": 0.5}
    worlds = {"none": both, "perception_bias:0.5": both, "perception_bias:1": {"standard": 0.5}}
    seen = view(*((rates, {"variant": variant}) for variant, rates in worlds.items()))
    for error in seen.findings.of(in_which_world.SECTION).errors:
        assert list(error.change) == ["standard"]
