"""Tables of policies that see: means over tasks, paired differences, less the unbroken world."""

from __future__ import annotations

from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import MINUS, NOTHING, SPACE
from tests.leaderboard.record_factory import make_cell, with_policies
from tools.pages.seen import render

RATES = {
    "none": {"base": 0.25, "standard": 0.5, "equivariant": 0.75, "residual-pathway": 0.75},
    "perception_bias:1": {"standard": 0.5, "equivariant": 0.25, "residual-pathway": 0.75},
}


def test_ways_to_see_are_means_over_their_tasks(tmp_path):
    for task in ("PushCube-v1", "PickCube-v1", "HeightPushCube-v1"):
        for variant, rates in RATES.items():
            for record in with_policies(make_cell(rates, variant=variant, task=task)):
                write_record(record, tmp_path / task / f"{record.run_id}.json")
    policies, steering = render(load_runs([tmp_path])).replace(SPACE, " ").split("\n\n")
    cells = [[c.strip() for c in row.split("|")[1:-1]] for row in policies.splitlines()[2:]]
    assert [row[:2] for row in cells] == [
        ["`HeightPushCube-v1`", "heights from above"],
        ["`PickCube-v1`", "poses"],
        ["`PushCube-v1`", "poses"],
    ]
    assert {row[3] for row in cells} == {"0.25 [0.25, 0.25]"}
    rows = [[c.strip() for c in row.split("|")[1:-1]] for row in steering.splitlines()[2:]]
    found = {(row[0], row[1]): row[2:] for row in rows}
    assert set(found) == {
        (way, f"`{world}`") for way in ("poses", "heights from above") for world in RATES
    }
    broken = found["poses", "`perception_bias:1`"]
    assert broken[:3] == ["0.50", "0.25", "0.75"]
    assert [cell.split()[0] for cell in broken[4:]] == [f"{MINUS}0.25", f"{MINUS}0.50", "+0.50"]
    assert found["poses", "`none`"][5] == NOTHING
