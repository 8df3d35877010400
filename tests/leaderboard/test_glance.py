"""What a terminal shows of a few runs."""

from __future__ import annotations

from pathlib import Path

from symsteer.leaderboard.glance import glance
from symsteer.leaderboard.records import write_record
from tests.leaderboard.record_factory import make_evaluation, make_record


def test_learners_have_a_curve_and_references_one_number(tmp_path: Path):
    learning = [
        make_evaluation([0, 0, 0, 1], 0, final=False),
        make_evaluation([1, 1, 0, 0], 5_016, final=False),
        make_evaluation([1, 1, 1, 1], 10_032),
    ]
    slower = [
        make_evaluation([0, 0, 0, 1], 0, final=False),
        make_evaluation([0, 0, 0, 0], 5_040, final=False),
        make_evaluation([1, 1, 1, 0], 10_000),
    ]
    records = [
        make_record(learning, seed=0, env_steps=10_000),
        make_record(slower, seed=1, env_steps=10_000),
        make_record([make_evaluation([1, 0, 1, 0], 3)], agent="base", env_steps=10_000),
        make_record(learning[:2], "interrupted", seed=2, env_steps=10_000),
    ]
    for record in records:
        write_record(record, tmp_path / f"{record.run_id}.json")
    title, head, base, standard = glance([tmp_path]).splitlines()
    assert title == "PickCube-v1 floating, unbroken"
    assert head.split() == ["success", "after", "steps", "0k", "5k", "10k"]
    assert base.split() == ["base", "50%"]
    assert len(base) == len(head) == len(standard)
    assert standard.split() == ["standard", "25%", "25%", "88%"]
