"""Runs that share a process have the records of runs that do not, but for rounding."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from symsteer.agents.standard import StandardAgent
from symsteer.agents.team import Team
from symsteer.bench.runs import trainer
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.together import _next, execute_together
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import execute, quiet, tiny_config

pytestmark = pytest.mark.long

SEEDS = (0, 1)


def configs(agent="standard", seeds=SEEDS):
    return [tiny_config(agent, seed=seed, checkpoint_every=15) for seed in seeds]


@pytest.fixture(scope="module")
def alone(tmp_path_factory, lend):
    """The folder of runs that were executed one after the other."""
    out = tmp_path_factory.mktemp("alone")
    lend(out)
    for config in configs():
        execute(config, out)
    return out


def assert_same(folder, other):
    """Equal episode by episode, with diagnostics but for rounding."""
    mine, theirs = (read_record(one / "record.json") for one in (folder, other))
    assert mine.status == theirs.status == "finished"
    assert mine.budget == theirs.budget
    for e, f in zip(mine.evaluations, theirs.evaluations, strict=True):
        assert (e.env_steps, e.updates) == (f.env_steps, f.updates)
        assert e.episodes.success_once == f.episodes.success_once
        for key, value in e.diagnostics.items():
            wanted = f.diagnostics[key]
            if wanted is not None:
                wanted = pytest.approx(wanted, rel=1e-2, abs=1e-2)
            assert value == wanted, key


def test_the_records_are_those_of_single_runs(alone, tmp_path):
    begin = time.perf_counter()
    assert execute_together(configs(), quiet(runs=tmp_path)) == [None] * len(SEEDS)
    seconds, total = time.perf_counter() - begin, 0.0
    before = {}
    for config in configs():
        name = run_id(config, {})
        assert_same(tmp_path / name, alone / name)
        record = read_record(tmp_path / name / "record.json")
        assert record.provenance.together == len(SEEDS)
        assert read_record(alone / name / "record.json").provenance.together == 1
        # The time of a run does not contain that of the others.
        clock = record.wall_clock
        parts = ("simulate", "decode", "update", "evaluate", "diagnose")
        assert 0 < clock.update < sum(getattr(clock, part) for part in parts) <= clock.total
        total += clock.total
        before[tmp_path / name] = (tmp_path / name / "record.json").read_bytes()
    assert total <= seconds
    # Finished runs are left alone.
    assert execute_together(configs(), quiet(runs=tmp_path)) == [None] * len(SEEDS)
    assert {path: (path / "record.json").read_bytes() for path in before} == before


def test_runs_that_are_behind_are_served_first():
    """So they become a team with the others again."""

    def member(index, updates, options="equal"):
        agent = StandardAgent.__new__(StandardAgent)
        agent.updates, agent.options, agent.description = updates, options, dict
        return SimpleNamespace(index=index, agent=agent)

    ahead, behind, other, last = member(0, 8), member(1, 5), member(2, 5, "other"), member(3, 5)
    assert _next([ahead, behind, last]) == [behind, last]
    assert _next([other, ahead, behind, last]) == [other]
    assert _next([ahead]) == [ahead]


def test_a_killed_team_continues_and_an_error_of_one_run_does_not_stop_the_others(
    alone, lend, tmp_path, monkeypatch
):
    """One run got further than the others before the process was killed."""
    lend(tmp_path)
    written = []
    stock = trainer.save_checkpoint

    def save(folder, state):
        stock(folder, state)
        written.append(folder)
        if len(written) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(trainer, "save_checkpoint", save)
    with pytest.raises(KeyboardInterrupt):
        execute_together(configs(), quiet(runs=tmp_path))
    folders = [tmp_path / run_id(config, {}) for config in configs()]
    assert {read_record(f / "record.json").status for f in folders} == {"interrupted"}
    monkeypatch.setattr(trainer, "save_checkpoint", stock)
    observe = StandardAgent.observe

    def fail(self, transition):
        if self.context.seed == 1 and self.decisions > 30:
            raise FloatingPointError("a number is not finite")
        observe(self, transition)

    monkeypatch.setattr(StandardAgent, "observe", fail)
    first, error = execute_together(configs(), quiet(runs=tmp_path))
    assert first is None
    assert_same(folders[0], alone / folders[0].name)
    record = read_record(folders[1] / "record.json")
    assert record.status == "failed"
    assert "not finite" in str(error)
    assert "not finite" in record.failure
    monkeypatch.setattr(StandardAgent, "observe", observe)
    assert execute_together(configs(), quiet(runs=tmp_path)) == [None] * len(SEEDS)
    assert_same(folders[1], alone / folders[1].name)


@pytest.mark.slow
def test_an_error_of_an_update_ends_its_team_alone(tmp_path, monkeypatch):
    """Runs that cannot be members share the process, and go on."""

    def update(self, batches):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(Team, "update", update)
    mixed = [*configs(), *configs("equivariant", seeds=(0,)), *configs("zero", seeds=(0,))]
    first, second, *others = execute_together(mixed, quiet(runs=tmp_path))
    assert "out of memory" in str(first)
    assert "out of memory" in str(second)
    assert others == [None, None]
    found = [read_record(tmp_path / run_id(c, {}) / "record.json").status for c in mixed]
    assert found == ["failed", "failed", "finished", "finished"]
