"""Other measures of success, with known differences."""

from symsteer.leaderboard.sections.other_success import SECTION
from tests.leaderboard.record_factory import make_cell, view_of, with_policies


def view(stochastic=()):
    """Strict is better once, plain at the end; some policies were also played at random."""
    records = with_policies(make_cell({"standard": 0.4, "equivariant": 0.9}))
    for record in records:
        episodes = record.final.episodes
        strict = record.settings.agent == "equivariant"
        if strict:
            # Half of the successes are lost again.
            once = [i for i, success in enumerate(episodes.success_once) if success]
            end = [int(i in once[::3]) for i in range(len(episodes.success_once))]
            episodes.success_at_end = end
        if record.settings.seed in stochastic:
            record.final.diagnostics["success_stochastic"] = 0.7 if strict else 0.2
    return view_of(records)


def cells(seen, table=1):
    """Of the differences, or (3) of success at the end."""
    lines = seen.blocks(SECTION)[table].splitlines()
    header, _, row = (line.strip("| ").split(" | ") for line in lines)
    return dict(zip(header, row, strict=True))


def test_each_measure_has_its_own_difference():
    shown = cells(view())
    assert shown["World"] == "unbroken"
    assert shown["once"].startswith("\u25b2") or "+0.50" in shown["once"]
    # 36 of 40 episodes succeed once, 12 at the end; of the others 16 in both.
    assert "\u22120.10" in shown["at the end"]
    assert "once, stochastic" not in shown
    ends = cells(view(), table=3)
    assert (ends["`standard`"], ends["`equivariant`"]) == ("0.40", "0.30")


def test_a_measure_needs_enough_base_policies():
    assert "once, stochastic" not in cells(view(stochastic=range(4)))
    assert "+0.50" in cells(view(stochastic=range(5)))["once, stochastic"]


def test_without_both_agents_there_is_no_section():
    assert view_of(make_cell({"standard": 0.4})).blocks(SECTION) == []
