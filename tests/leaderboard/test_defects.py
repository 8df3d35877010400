"""The audited defect of each table: what is read, and every file that is none."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.defects import AUDIT, AuditedDefect, read_audit
from symsteer.leaderboard.statistics import Interval

CELL = {
    "version": 2,
    "task": "PickCube-v1",
    "embodiment": "floating",
    "variant": "action_gain:0.50",
    "group": "C8",
    "part": "object",
    "decision": [0.2, 0.15, 0.3],
    "resets": [-0.001, 0.0, 0.002],
    "resets_p": 0.4,
    "tool": [1.0, 1.0, 1.0],
}


def write(folder: Path, data: object) -> Path:
    path = folder / "summary.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def test_a_cell_has_its_defect_its_part_and_its_resets(tmp_path: Path) -> None:
    differ = {"variant": "none", "part": "cost", "resets": [0.05, 0.04, 0.06], "resets_p": 0.001}
    audit = read_audit(write(tmp_path, [CELL, CELL | differ]))
    place = "PickCube-v1", "floating", "action_gain:0.5", "C8"
    assert audit == read_audit(tmp_path)  # of the folder
    assert audit[place] == AuditedDefect(
        Interval(0.2, 0.15, 0.3), "object", Interval(-0.001, 0.0, 0.002), False
    )
    other = audit[(*place[:2], "none", "C8")]
    assert (other.part, other.resets.value, other.resets_differ) == ("cost", 0.05, True)


def test_an_audit_of_another_version_is_refused(tmp_path: Path) -> None:
    old = {key: value for key, value in CELL.items() if key not in ("version", "decision", "part")}
    for rows in ([old], [CELL, CELL | {"version": 3}]):
        with pytest.raises(UserError, match=r"another version .* measure it again"):
            read_audit(write(tmp_path, rows))


def test_the_committed_audit_can_be_read() -> None:
    audit = read_audit()
    assert len(audit) == len(json.loads(AUDIT.read_text()))

    def of(task: str, variant: str, embodiment: str = "floating") -> AuditedDefect:
        return audit[task, embodiment, variant, "C8"]

    assert 0 < of("PickCube-v1", "none").value < 0.06
    # Horizontal motion by itself: lifting and pushing see the same break alike.
    for task in ("PickCube-v1", "PushCube-v1"):
        assert 0.45 < of(task, "action_gain:1").value < 0.65
        assert of(task, "perception_bias:1").part == "observation"
    # What one step of the tool cannot see.
    assert of("PushCube-v1", "wind:1").part == "object"
    assert of("PushCube-v1", "none").interval.high < of("PushCube-v1", "wind:1").interval.low
    assert of("PickCube-v1", "none", "panda").interval.low > 0.1


@pytest.mark.parametrize(
    "data",
    [
        *("", json.dumps([CELL])[:-9], "{}", "[3]", "[" * 100_000),
        *(json.dumps([CELL]).replace("0.15", number) for number in ("NaN", "1e999", "'0.15'")),
        [{"version": 2, "task": "PickCube-v1"}],
        *([CELL, CELL | {"decision": value}] for value in ([0.1, 0.2], [0.1, 0.2, 0.3], None)),
        [CELL, CELL | {"part": "arm"}],
    ],
)
def test_a_bad_audit_is_one_sentence(tmp_path: Path, data: object) -> None:
    with pytest.raises(UserError, match=r"summary\.json is no summary of an audit") as error:
        read_audit(write(tmp_path, data))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_a_cell_is_audited_once(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds PickCube-v1 .* twice: remove the older"):
        read_audit(write(tmp_path, [CELL, CELL | {"decision": [0.2, 0.1, 0.3]}]))


def test_a_missing_audit_is_an_error(tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere.json", tmp_path):
        with pytest.raises(UserError, match=r"cannot be read"):
            read_audit(path)


def test_the_order_of_variants_does_not_matter(tmp_path: Path) -> None:
    audit = read_audit(write(tmp_path, [CELL | {"variant": "wind:0.50+obstacle:1.0"}]))
    assert list(audit) == [("PickCube-v1", "floating", "obstacle:1+wind:0.5", "C8")]
    # A text that is no variant stands for itself.
    audit = read_audit(write(tmp_path, [CELL | {"variant": "wind:<b>"}]))
    assert [place[2] for place in audit] == ["wind:<b>"]


def test_defects_are_drawn_within_their_interval() -> None:
    defect = AuditedDefect(Interval(0.1, 0.08, 0.16), "tool")
    draws = defect.draw(100_000, np.random.default_rng(0))
    assert np.quantile(draws, (0.025, 0.5, 0.975)) == pytest.approx((0.08, 0.1, 0.16), abs=1e-3)
    near_zero = AuditedDefect(Interval(0.001, -0.01, 0.01), "cost").draw(
        1000, np.random.default_rng(0)
    )
    assert near_zero.min() == 0
