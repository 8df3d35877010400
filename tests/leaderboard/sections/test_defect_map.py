"""The map: panels by embodiment, agent and measure, slopes of dials, and what is not audited."""

from __future__ import annotations

import pytest

from symsteer.leaderboard.sections.defect_map import SECTION, audit_commands, defect_map
from symsteer.leaderboard.text import NOTHING
from tests.leaderboard.record_factory import (
    audit_of,
    make_cell,
    steered,
    summary_of,
    table_after,
    view_of,
)


def test_arm_and_gripper_are_apart() -> None:
    gripper = {"none": (0.5, 0.9, 0.5), "action_gain:1": (0.5, 0.8, 0.5)}
    arm = {"none": (0.5, 0.6, 0.5), "action_gain:1": (0.5, 0.7, 0.5)}
    defects = {"none": 0.0, "action_gain:1": 0.5}
    audit = {**audit_of(defects), **audit_of(defects, embodiment="panda")}
    found = defect_map(summary_of(steered(gripper), steered(arm, embodiment="panda")), audit)
    assert found.embodiments == ["floating", "panda"]
    for embodiment, slope in (("floating", -0.2), ("panda", 0.2)):
        panel = found.panel(embodiment, "equivariant", "success")
        assert {p.table.key.embodiment for p in panel.points} == {embodiment}
        assert panel.fit is not None
        assert panel.fit.slope.value == pytest.approx(slope)
    nothing = found.panel("hand", "equivariant", "success")
    assert (nothing.fit, nothing.points) == (None, ())
    assert nothing.reason


def test_the_map_has_the_fair_rival() -> None:
    rates = {"standard": 0.5, "augmented": 0.7, "equivariant": 0.9}
    summary = summary_of(make_cell(rates), make_cell(rates, variant="wind:1"))
    found = defect_map(summary, audit_of({"none": 0.0, "wind:1": 0.3}))
    assert found.agents("floating") == ["augmented", "equivariant"]


def test_every_dial_has_a_slope() -> None:
    rates = dict.fromkeys(("none", "action_gain:0.5", "action_gain:1"), (0.5, 0.6, 0.5))
    rates |= {"wind:1": (0.5, 0.2, 0.5), "wind:1+obstacle:0.5": (0.5, 0.6, 0.5)}
    defects = dict(zip(rates, (0.0, 0.2, 0.4, 0.4, 0.4), strict=True))
    defects["obstacle:0.5+wind:1"] = defects.pop("wind:1+obstacle:0.5")
    found = defect_map(summary_of(steered(rates)), audit_of(defects))
    panel = found.panel("floating", "equivariant", "success")
    slopes = {dial: fit.slope.value for dial, fit in panel.dials.items()}
    assert slopes == pytest.approx({"action_gain": 0.0, "obstacle+wind": 0.0, "wind": -1.0})
    assert panel.fit is not None
    assert -1 < panel.fit.slope.value < 0


def test_an_advantage_ends_in_a_task_and_not_in_a_mean_of_tasks() -> None:
    """A's advantage ends at 0.1, that of B at 0.3: the mean of both, 0.2, is true of neither."""
    defects = {"none": 0.0, "wind:0.5": 0.2, "wind:1": 0.4}
    records, audit = [], {}
    for task, end in (("A-v1", 0.1), ("B-v1", 0.3)):
        rates = {variant: (0.5, 0.5 + end - defect, 0.5) for variant, defect in defects.items()}
        records += steered(rates, task=task)
        audit |= audit_of(defects, width=0.001, task=task)
    view = view_of(records, audit=audit)
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for block in view.blocks(SECTION)
        for line in block.splitlines()
        if line.startswith("| `equivariant` | success |")
    ]
    ends = {row[2]: row[5].partition("\u00a0")[0] for row in rows if len(row) == 7}
    assert ends == {"`wind`": NOTHING, "all, `A-v1`": "0.10", "all, `B-v1`": "0.30"}


def test_the_page_names_slopes_parts_and_what_is_missing() -> None:
    defects = {"none": 0.002, "wind:0.25": 0.1, "wind:0.5": 0.2, "wind:1": 0.4}
    records = [
        record
        for variant, defect in (defects | {"wind:0.75": 0.3}).items()
        for record in make_cell(
            {"standard": 0.5, "equivariant": 0.8 - defect}, variant=variant, episodes=100
        )
    ]
    blocks = view_of(records, audit=audit_of(defects, width=0.01)).blocks(SECTION)
    text = "\n".join(blocks).replace("\u00a0", " ")
    by_measure = {row[1]: row for row in table_after(text, "### `floating`")[2:]}
    strict = by_measure["success"]
    assert strict[2:4] == ["`wind`", "1"]
    assert strict[4].startswith("\u22121.00<br>[\u22121.")
    # With one base policy no slope is marked as a finding.
    assert "\u25bc" not in strict[4]
    assert strict[5:] == ["\u2013", "base policies at several defects: 1, 5 are needed"]
    cells = table_after(text, "<summary>The map's numbers")[2:]
    sizes = [cell[1].split("<br>") for cell in cells]
    assert [size[0] for size in sizes] == ["0.002", "0.100", "0.200", "0.400"]
    assert {size[2] for size in sizes} == {"tool"}
    assert "Not audited, so not in the map: PickCube, wind 0.75." in text
    assert (
        "`symsteer audit --task PickCube-v1 --embodiment floating --group C8 "
        "--variant wind:0.75 --out runs/audit`" in text
    )


def test_defects_that_are_alike_or_missing_have_no_slope() -> None:
    records = steered({"none": (0.5, 0.9, 0.5), "wind:1": (0.5, 0.5, 0.5)})
    view = view_of(records, audit=audit_of({"none": 0.1, "wind:1": 0.1}))
    panel = view.findings.of(SECTION).panel("floating", "equivariant", "success")
    assert (panel.fit, len(panel.points)) == (None, 2)
    assert panel.reason == "no base policy was steered at two audited defects"
    assert panel.reason in "".join(view.blocks(SECTION))
    assert "There is no map yet" in "".join(view_of(records).blocks(SECTION))


@pytest.mark.parametrize("text", ["a; rm -rf b", "$(x)", "`x`", "a b", "-rf", "a\nb", "x'"])
def test_a_hostile_name_becomes_no_command(text: str) -> None:
    rates = dict.fromkeys(("none", text, "wind:1"), (0.5, 0.6, 0.5))
    assert audit_commands([table.key for table in summary_of(steered(rates)).tables]) == [
        "symsteer audit --task PickCube-v1 --embodiment floating --group C8 "
        "--variant none wind:1 --out runs/audit"
    ]
