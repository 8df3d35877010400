"""Tables of policies that see: by task, over both, paired, less the unbroken world."""

from __future__ import annotations

import re

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.text import MINUS, NOTHING, SPACE
from tests.leaderboard.record_factory import make_cell, with_policies
from tools.pages.seen import render

# The strict agent loses more where motions end to one side than where objects are seen there.
RATES = {
    "none": {
        "base": 0.25,
        "standard": 0.5,
        "standard-matched": 0.625,
        "augmented": (0.125, 0.375, 0.375),
        "equivariant": 0.75,
        "residual-pathway": 0.75,
    },
    "perception_bias:1": {"standard": 0.5, "equivariant": 0.25, "residual-pathway": 0.75},
    "actuator_offset:0.5": {"standard": 0.75, "equivariant": 0.25, "residual-pathway": 0.25},
}
SECONDS = {"standard": 60.0, "equivariant": 90.0, "residual-pathway": 120.0}


def runs_of(folder, *tasks: str, **changes) -> list[Run]:
    for task in tasks:
        for variant, rates in RATES.items():
            for record in with_policies(make_cell(rates, variant=variant, task=task, **changes)):
                # One base policy's runs were paused.
                paused = 10 if record.config["seed"] == 0 else 1
                record.wall_clock.total = paused * SECONDS.get(record.config["agent"], 5.0)
                write_record(record, folder / task / f"{record.run_id}.json")
    return load_runs([folder], area_from="first update")


def audits_of(*tasks: str) -> list[dict]:
    """What is observed breaks the symmetry by 0.25 where something is displaced."""
    aside = dict.fromkeys(RATES, 0.25) | {"none": 1e-6, "camera_rotation:1": 1e-6}
    return [
        {
            "task": task,
            "variant": variant,
            "object": [0.125, 0.1, 0.2],
            "observation": [value, value, value],
        }
        for task in tasks
        for variant, value in aside.items()
    ]


def rows_of(table: str) -> list[list[str]]:
    lines = table.replace(SPACE, " ").splitlines()[2:]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_tables_are_by_task_and_over_both(tmp_path):
    tasks = "PushCube-v1", "PickCube-v1", "HeightPushCube-v1"
    runs = runs_of(tmp_path, *tasks)
    answers, tables = render(runs, audits_of(*tasks))
    parts = (rows_of(table) for table in tables.split("\n\n")[::2])
    policies, audits, seconds, success, strict, area, approximate = parts
    assert [row[:2] for row in policies] == [
        ["`HeightPushCube-v1`", "heights from above"],
        ["`PickCube-v1`", "poses"],
        ["`PushCube-v1`", "poses"],
    ]
    assert {row[4] for row in policies} == {"0.25 [0.25, 0.25]"}
    assert [row[0] for row in audits] == ["poses", "poses", "heights from above"]
    assert [cell.split()[0] for cell in audits[0][2:]] == ["12", "0", "25", "0"]
    assert seconds[0] == ["poses", "`PickCube-v1`", "60", "90", "120"]
    unbroken = ["0.25", "0.50", "0.62", "0.38", "0.75", "0.75"]
    assert success[0] == ["poses", "`PickCube-v1`", "`none`", *unbroken]
    assert success[1][3:] == [NOTHING, "0.75", NOTHING, NOTHING, "0.25", "0.25"]
    assert len(success) == 9
    found = {tuple(row[:2]): [cell.split()[0] for cell in row[2:]] for row in strict}
    assert found["poses", "`none`"] == [*["+0.25"] * 3, NOTHING]
    assert found["poses", "`perception_bias:1`"] == [*[f"{MINUS}0.25"] * 3, f"{MINUS}0.50"]
    both = "`perception_bias:1` and `actuator_offset:0.5`"
    assert found["poses", both][3] == f"{MINUS}0.62"
    assert found["heights from above", "`none`"] == ["+0.25", NOTHING, NOTHING, NOTHING]
    assert {tuple(row[:2]) for row in area} == found.keys()
    freed = {tuple(row[:2]): row[2].split()[0] for row in approximate}
    assert freed["poses", "`perception_bias:1`"] == "+0.50"
    # Of poses both tasks are here, of heights one; no run saw a turned camera.
    answered = [[re.split("[ <]", cell)[0] for cell in row[1:]] for row in rows_of(answers)]
    assert {heights for _, heights in answered} == {NOTHING}
    rivals, broken = answered[2:6], answered[6:]
    assert [poses for poses, _ in rivals[1::2]] == ["+0.12", "+0.38"]
    assert [poses for poses, _ in rivals[::2]] == ["+0.12", "+0.44"]
    found = [f"{MINUS}0.38", f"{MINUS}0.62", NOTHING, "0.00", "+0.25"]
    assert [poses for poses, _ in [answered[1], *broken]] == ["+0.25", *found]


def test_runs_of_two_kinds_are_not_mixed(tmp_path):
    runs_of(tmp_path / "few", "PushCube-v1")
    more = {"demonstrations": {"mode": "diverse", "count": 200, "seed": 0}}
    few = load_runs([tmp_path / "few"])
    with pytest.raises(UserError, match=r"several kinds of runs of PushCube-v1"):
        render([*runs_of(tmp_path / "many", "PushCube-v1", **more), *few], [])
