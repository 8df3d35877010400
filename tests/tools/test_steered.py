"""How agents steer the base policies of a task: success, and differences in pairs."""

from __future__ import annotations

from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import MINUS, NOTHING, SPACE
from tests.leaderboard.record_factory import make_cell, with_policies
from tools.pages.steered import steering


def test_a_row_for_each_world_and_only_agents_that_are_there_are_compared(tmp_path):
    rates = {"base": 0.25, "standard": 0.5, "equivariant": 0.75}
    for variant, world in (("none", rates), ("wind:1", {"base": 0.25, "equivariant": 0.5})):
        for record in with_policies(make_cell(world, variant=variant, task="PickCube-v1")):
            write_record(record, tmp_path / f"{record.run_id}.json")
    reached, gaps = steering(load_runs([tmp_path])).replace(SPACE, " ").split("\n\n")
    head, _, unbroken, broken = ([c.strip() for c in r.split("|")] for r in reached.splitlines())
    assert head[4:8] == ["base policies", "`base`", "`standard`", "`equivariant`"]
    assert unbroken[3:5] == ["`none`", "5"]
    assert [cell.split()[0] for cell in unbroken[5:8]] == ["0.25", "0.50", "0.75"]
    assert [cell.split()[0] for cell in broken[5:8]] == ["0.25", NOTHING, "0.50"]
    _, _, unbroken, broken = ([c.strip() for c in r.split("|")] for r in gaps.splitlines())
    assert unbroken[5].startswith("+0.25 [")
    assert MINUS not in unbroken[5]
    assert broken[5:7] == [NOTHING, NOTHING]
