"""The choice of strengths: what is kept, and where a half of it is."""

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.records import write_record
from tests.leaderboard.record_factory import make_cell
from tools.strengths import chosen, kept, main, read, render


def test_each_base_policy_counts_against_its_own_unbroken_success():
    successes = {"none": {0: 0.4, 1: 0.8}, "wind:1": {0: 0.2, 1: 0.2}}
    assert kept(successes, "wind:1") == pytest.approx((0.5 + 0.25) / 2)
    with pytest.raises(UserError, match="base policy 1 has a run in wind:1, but no unbroken one"):
        kept({"none": {0: 0.4}, "wind:1": {1: 0.2}}, "wind:1")
    with pytest.raises(UserError, match="solves an unbroken episode"):
        kept({"none": {0: 0.0}, "wind:1": {0: 0.2}}, "wind:1")


@pytest.mark.parametrize(
    ("shares", "strength"),
    [
        ([0.8, 0.6, 0.2], 0.8),  # Between .5 (.6) and 1 (.2), at 0.625 + 0.
        ([0.4, 0.3, 0.1], 0.2),  # Before the first one: from 1 at 0.
        ([0.9, 0.5, 0.1], 0.75),
        ([0.9, 0.8, 0.6], None),
        ([0.6, 0.9, 0.3], 0.85),  # A share that rises is chance.
        ([0.0, 0.0, 0.0], 0.1),
    ],
)
def test_half_is_kept_at_the_chosen_strength(shares, strength):
    found = chosen([0.25, 0.75, 1.0], shares)
    assert found == (strength and pytest.approx(strength, abs=0.026))


def test_the_table_of_runs(tmp_path, capsys):
    for variant, rate in (("none", 0.9), ("wind:0.5", 0.6), ("wind:1", 0.3)):
        for record in make_cell({"base": rate, "zero": 0.1}, seeds=2, variant=variant):
            folder = tmp_path / f"{variant}-{record.run_id}"
            folder.mkdir()
            write_record(record, folder / "record.json")
    assert main([str(tmp_path)]) == 0
    *_, row = capsys.readouterr().out.splitlines()
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:4] == [
        "PickCube-v1 floating, 50 demonstrations",
        "0.90, no room",
        "`wind`",
        "0.67 at 0.5, 0.33 at 1",
    ]
    assert cells[4] == "`wind:0.75`"
    assert render(read([tmp_path])).endswith(row)
    # The committed records lie side by side.
    for path in tmp_path.glob("*/record.json"):
        path.rename(tmp_path / f"{path.parent.name}.json")
    assert render(read([tmp_path])).endswith(row)


def test_without_runs_there_is_one_sentence(tmp_path):
    with pytest.raises(UserError, match="holds no record"):
        read([tmp_path])
    (learner,) = make_cell({"standard": 0.5}, seeds=1)
    write_record(learner, tmp_path / "record.json")
    with pytest.raises(UserError, match="no finished run of base; run the suite strengths first"):
        read([tmp_path])
