"""How agents steer the base policies of a task: success, and differences in pairs."""

from __future__ import annotations

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import MINUS, SPACE
from tests.leaderboard.record_factory import make_cell, with_policies
from tools.pages.steered import PAIRS, steering

RATES = {"base": 0.5, "zero": 0.1, "standard": 0.2, "equivariant": 0.8, "residual-pathway": 0.6}


def runs(folder, **config):
    folder.mkdir(exist_ok=True)
    for record in with_policies(make_cell(RATES, task="PickCube-v1", **config)):
        write_record(record, folder / f"{record.run_id}.json")
    return load_runs([folder])


def test_each_agent_and_each_difference(tmp_path):
    reached, gaps = steering(runs(tmp_path)).replace(SPACE, " ").split("\n\n")
    rows = [[c.strip() for c in line.split("|")[1:-1]] for line in reached.splitlines()[2:]]
    assert {row[0].strip("`"): row[1] for row in rows} == {
        agent: f"{rate:.2f} [{rate:.2f}, {rate:.2f}]" for agent, rate in RATES.items()
    }
    assert {row[2] for row in rows} == {"5"}
    rows = [[c.strip() for c in line.split("|")[1:-1]] for line in gaps.splitlines()[2:]]
    assert len(rows) == len(PAIRS)
    for (first, second), (title, value, pairs) in zip(PAIRS, rows, strict=True):
        assert title == f"`{first}` minus `{second}`"
        expected = f"{RATES[first] - RATES[second]:+.2f}".replace("-", MINUS)
        assert value.startswith(f"{expected} [")
        assert pairs == "5"


def test_runs_of_two_worlds_are_refused(tmp_path):
    runs(tmp_path / "a")
    both = runs(tmp_path / "b", variant="wind:1")
    with pytest.raises(UserError, match="runs of one task and world are needed"):
        steering([*load_runs([tmp_path / "a"]), *both])
