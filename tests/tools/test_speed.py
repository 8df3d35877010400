"""The parts of `python -m tools.speed`, with small numbers."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from symsteer.agents import AGENTS
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config
from tools.speed import decode, learner, runs, simulation
from tools.speed.simulation import Replay, Row, Turn
from tools.speed.timing import clock_of, products_of, time_on

TASK = "PickCube-v1"
CHECKOUT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def env_cls():
    return simulation.stock_class(TASK)


def test_the_limit_moves_the_robots_that_ours_moved(env_cls):
    """The replayed substeps end in the same state as the recorded episode."""
    replay = Replay(env_cls, 2)
    robots = [a.get_qpos() for a in replay.env.scene.px._articulations]
    assert len(replay.targets) == simulation.EPISODE
    wall, cpu = replay.play()
    assert 0 < cpu <= wall * 1.5
    again = [a.get_qpos() for a in replay.env.scene.px._articulations]
    np.testing.assert_allclose(robots, again, atol=1e-3)
    starts = []
    for system, packed in zip(replay.systems, replay.start, strict=True):
        system.unpack(packed)
        starts.append(system)
    first = [a.get_qpos() for a in replay.env.scene.px._articulations]
    assert np.abs(np.array(first) - np.array(again)).max() > 0.1


def test_parts_of_a_step_add_up(env_cls):
    split = simulation.split_step(env_cls, 4, episodes=1)
    parts = ("physics", "fetch", "apply", "controller", "task", "other")
    assert all(split[part] > 0 for part in parts)
    assert split["total"] == pytest.approx(sum(split[part] for part in parts))
    assert split["physics"] > split["apply"]


def rows() -> list[Row]:
    def row(letter, processes, num_envs, *rates):
        return Row(
            letter, letter, processes, num_envs, [Turn(r, 1.0, processes / 2) for r in rates]
        )

    return [
        row("a", 1, 1, 240, 250, 260),
        row("b", 1, 1, 200, 100, 300),
        row("b", 2, 2, 400, 400, 400),
        row("c", 1, 4, 900, 900, 900),
        row("c", 1, 64, 2000, 1800, 1900),
        row("c", 2, 64, 3000, 3000, 3100),
        row("d", 1, 64, 3800, 3800, 3000),
        row("d", 2, 64, 6000, 6000, 6000),
    ]


def test_summary_compares_like_with_like():
    """Medians of the best contender of each kind with the same number of processes."""
    found = simulation.summarise(rows(), 2)
    assert found["1"]["num_envs"] == 64
    assert found["1"]["times_stock"] == pytest.approx(1900 / 200)
    assert found["1"]["share_of_limit"] == pytest.approx(0.5)
    assert found["2"]["times_stock"] == pytest.approx(7.5)
    assert found["2"]["share_of_limit"] == pytest.approx(0.5)
    assert rows()[0].cpu_rate == pytest.approx(500)


def test_table_and_json(env_cls):
    data = {
        "settings": {"task": TASK, "controller": "c", "repeats": 3, "episode": 50},
        "machine": simulation._machine(),
        "rows": [row.to_json() for row in rows()],
        "summary": simulation.summarise(rows(), 2),
        "step": simulation.split_step(env_cls, 2, episodes=1),
        "creation": simulation.creation(env_cls, 3),
    }
    text = simulation.table(data)
    assert "1,900 (1,800 to 2,000)" in text
    assert "ours on 2 cores: 3,000 steps/s with 64 environments, 7.5 x stock (b), 50%" in text
    assert json.loads(simulation.dump(data)) == data
    assert data["creation"]["per_env_ms"] > 0


@pytest.mark.slow
def test_memory_does_not_grow_over_10_000_steps():
    growth = simulation.memory_growth(TASK, num_envs=4)
    assert growth["steps"][-1] == 10_000
    assert growth["growth_kib"] < 2**10


@pytest.mark.slow
def test_the_whole_measurement():
    """All contenders in turns; ours is faster than stock and slower than the limit."""
    data = simulation.measure(TASK, num_envs=(16,), repeats=2, seconds=0.2, cores=2)
    kinds = [(row["letter"], row["processes"]) for row in data["rows"]]
    assert [k for k in kinds if k[0] != "g"] == [
        *[("a", 1), ("b", 1), ("b", 2)],
        *[("c", 1), ("d", 1), ("c", 2), ("d", 2)],
    ]
    one = data["summary"]["1"]
    assert one["times_stock_cpu"] > 2
    assert 0.1 < one["share_of_limit_cpu"] < 1
    simulation.table(data)


@pytest.mark.long
def test_learners_are_timed_alone_and_in_a_team_with_every_kind_of_critic():
    # All critics, one kind of critics and rows of its own, no team, no learner.
    agents = ("standard", "residual", "partial", "zero")
    rows = learner.measure(TASK, 1, 2, lambda text: None, agents)
    kinds = {(row["agent"], row["members"], row["critic"]) for row in rows}
    assert all(0 < row["min"] <= row["median"] <= row["max"] for row in rows)
    for name in agents[:3]:
        for critic in AGENTS.get(name).Options.known_critics:
            assert (name, 1, critic) in kinds
            assert ((name, 5, critic) in kinds) == (name != "partial")
    assert {kind[0] for kind in kinds} - set(agents[:3]) == {"stable-baselines3"}
    first = next(line for line in learner.table(rows).splitlines() if " noise " in line)
    assert first.endswith("1.00")


def test_a_gpu_is_timed_by_the_wall_clock():
    """CPU time would not count what the GPU does, and the two devices share one table."""
    assert (clock_of(["cpu"]), time_on(["cpu"])) == (time.process_time, "CPU time")
    assert clock_of(["cpu", "cuda"]) is not time.process_time
    assert time_on(["cpu", "cuda"]) == "Wall-clock time"


def test_decoders_are_timed_beside_their_products():
    names = ("edp", "plain", "so2")
    rows = decode.measure(TASK, 1, 2, lambda text: None, names)
    timed = [(name, {}) for name in names]
    timed += [varied for varied in decode.VARIATIONS if varied[0] in names]
    assert [(row["policy"], row["options"], row["chunks"]) for row in rows] == [
        (*one, chunks) for one in timed for chunks in (64, 192)
    ]
    for row in rows:
        assert row["products"] > 0
        assert row["see"] >= 0
        assert 0 < row["min"] <= row["median"] <= row["max"]
        assert row["sampling_steps"] == row["options"].get("sampling_steps", 2)
    assert "\ncpu    edp width 32 channels 32 " in decode.table(rows)
    *_, first, second = decode.table(rows[:2]).splitlines()
    assert first.split()[:5] == ["cpu", "edp", f"{rows[0]['parameters']:,}", "2", "64"]
    assert second.split()[1] == "edp"
    assert " 1.00 " in first
    assert " 1.00 " in second


@pytest.mark.slow
def test_whole_runs_are_timed_alone_and_in_teams(tmp_path):
    config = tiny_config("standard", env_steps=160)
    lines = []
    rows = runs.measure([config], 1, tmp_path, lines.append, team=2)
    assert [(row["agent"], row["team"]) for row in rows] == [("standard", 1), ("standard", 2)]
    for row in rows:
        assert row["median"] > 0
        assert all(row[part] > 0 for part in ("simulate", "update", "evaluate", "diagnose"))
    assert len(lines) == 2
    # Only the base policy is kept.
    assert [path.name for path in tmp_path.iterdir()] == ["base"]
    *_, alone, team = runs.table(rows).splitlines()
    assert alone.split()[:2] == ["standard", "1"]
    assert team.split()[:2] == ["standard", "2"]


@pytest.mark.slow
def test_two_versions_execute_the_same_run_in_turns(tmp_path):
    config = tiny_config("standard", env_steps=160)
    lines = []
    rows = runs.compare(CHECKOUT, [config], 1, tmp_path, lines.append)
    assert [row["agent"] for row in rows] == ["standard, before", "standard, now"]
    assert all(row["median"] > 0 and row["evaluate"] > 0 for row in rows)
    assert lines[1] == "round 1 of 1: standard, now"
    # Both had the base policy that was trained before.
    assert [path.name for path in tmp_path.iterdir()] == ["base"]
    assert len(list(tmp_path.glob("base/*/policy.safetensors"))) == 1


def test_a_folder_without_a_version_is_named(tmp_path):
    with pytest.raises(UserError, match=f"{tmp_path} is no checkout"):
        runs.compare(tmp_path, [], 1, tmp_path, print)


def test_the_products_of_an_update_are_the_same_products():
    """As many multiplications, and cheaper than the update that they are part of."""
    a, b = torch.randn(8, 4), torch.randn(4, 2)
    done = []

    def compute():
        done.append((a @ b).relu().sum())

    products = products_of(compute)
    assert len(done) == 1
    with FlopCounterMode(display=False) as counter:
        products()
    assert counter.get_total_flops() == 2 * 8 * 4 * 2
    assert len(done) == 1
