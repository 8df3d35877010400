"""What one sees of a sweep: status, time left, the lines of the display."""

import io
import json
import os
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from filelock import FileLock

from symsteer.bench.runs.folder import CONFIG, LOCK, PROGRESS, RECORD
from symsteer.bench.sweep.command import look_at
from symsteer.bench.sweep.display import Display
from symsteer.bench.sweep.plan import PlannedRun, make_plan, sweep_path, write_sweep
from symsteer.bench.sweep.schedule import EndedRun, Task, tasks_of
from symsteer.bench.sweep.status import read_status, to_text
from symsteer.bench.sweep.suite import Suite
from symsteer.bench.sweep.survey import Sighting, duration, time_left
from symsteer.bench.sweep.work import Result
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from symsteer.policies import POLICIES
from tests.bench.sweep.long_run import LONG
from tests.bench.tiny_run import tiny_config

AGENTS = ("equivariant", "standard", "augmented", "standard-matched", "zero")


def planned(agent="equivariant", task="PickCube-v1", env_steps=1000, seed=0):
    return PlannedRun("x", task, "floating", "none", agent, seed, env_steps)


def test_a_run_is_judged_by_the_most_similar_finished_ones():
    known = {
        planned(): Sighting("finished", 100.0),
        planned(seed=1): Sighting("finished", 300.0),
        planned("standard"): Sighting("finished", 50.0),
        planned("zero"): Sighting("finished", 1.0),
    }

    def left(*todo, workers=1, state=Sighting("missing")):  # noqa: B008
        return time_left({**known, **dict.fromkeys(todo, state)}, workers)

    four = [planned(seed=seed) for seed in range(2, 6)]
    assert time_left({planned(): Sighting("missing")}, 1) is None
    assert left(*four) == pytest.approx(800)
    assert left(*four, workers=2) == pytest.approx(400)
    # Ten workers are as fast as the longest run.
    assert left(*four, workers=10) == pytest.approx(200)
    assert left(planned("standard", env_steps=4000)) == pytest.approx(200)
    assert left(planned("standard", task="PushCube-v1")) == pytest.approx(50)
    # Learners are alike; other agents are only compared with themselves.
    assert left(planned("augmented")) == pytest.approx(100)
    assert left(planned("golden-ticket")) is None
    assert left(planned("foreign")) is None
    progress = {"env_steps": 500, "budget": 1000, "steps_per_second": 10.0}
    half = Sighting("running", progress=progress)
    assert left(planned("standard", seed=1), state=half) == pytest.approx(25)
    # Running runs serve as long as none of the agent is finished.
    assert left(planned("golden-ticket"), state=half) == pytest.approx(50)


def test_lengths_of_time():
    texts = [duration(seconds) for seconds in (5, 89, 90, 3600, 5400, 86400, 200000)]
    assert texts == ["5 s", "89 s", "2 min", "60 min", "1.5 h", "24.0 h", "2.3 days"]


@pytest.fixture
def sweep(undisturbed, tmp_path):
    """A sweep of which one run is finished, one runs, one was stopped, one failed, one is to do."""
    configs = [
        replace(LONG, agent=agent, agent_options=tiny_config(agent=agent).agent_options)
        for agent in AGENTS
    ]
    plan = make_plan(Suite("tiny", "five", tuple(configs)), tmp_path)
    folders = [tmp_path / one.run_id for one in plan.runs]
    shutil.copytree(undisturbed, folders[0])
    for folder in folders[1:3]:
        shutil.copytree(undisturbed, folder)
        record = read_record(folder / RECORD)
        record.status, record.ended = "running", None
        (folder / RECORD).write_text(record.model_dump_json(by_alias=True))
    progress = {
        "phase": "training",
        "env_steps": 120,
        "budget": 320,
        "success": 0.25,
        "steps_per_second": 12.0,
        "seconds_left": 30.0,
        "updated": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    (folders[1] / PROGRESS).write_text(json.dumps(progress))
    write_sweep(plan, 2, {plan.runs[3].run_id: "its process was killed by SIGKILL"})
    with FileLock(folders[1] / LOCK):
        yield plan


def test_status_tells_states_reasons_and_time_left(sweep, command):
    [status] = read_status(sweep.out).sweeps
    assert [status.state(one) for one in sweep.runs] == [
        "finished",
        "running",
        "interrupted",
        "failed",
        "missing",
    ]
    text = to_text([status], sweep.out)
    assert text.startswith("tiny: five (5 runs)\n  finished         1\n")
    assert "standard seed 0: 120 of 320 steps, success 25%, 12 steps/s, about 30 s left" in text
    assert "standard-matched seed 0: its process was killed by SIGKILL" in text
    # zero does not learn: nothing is known of it.
    assert text.endswith("time left: unknown, no similar run is finished yet")
    code, shown = command("status", sweep.out, "--suite", "tiny")
    assert (code, shown.out) == (0, text + "\n")


def test_runs_and_sweeps_are_found_at_any_depth(sweep, undisturbed, tmp_path_factory):
    """As ``symsteer status runs`` after ``symsteer demo``, whose runs are in runs/demo."""
    top, name = tmp_path_factory.mktemp("top"), "PickCube-v1-floating-none-equivariant-s7-0"
    (top / "deep").mkdir()
    sweep.out.rename(top / "deep" / "demo")
    shutil.copytree(undisturbed, top / "single" / name)
    listed, others = read_status(top).sweeps
    assert listed.title == "deep/demo: tiny: five"
    assert [len(listed.in_state(state)) for state in ("finished", "missing")] == [1, 1]
    assert others.title == "runs of no sweep"
    assert [run.run_id for run in others.runs] == [name]
    assert "run (1 runs)\n  finished         1" in to_text(read_status(undisturbed).sweeps, top)
    [only] = read_status(top, "tiny").sweeps
    assert only.title == listed.title
    # Without their list, the two that never began have left nothing.
    sweep_path(top / "deep" / "demo", "tiny").unlink()
    [status] = read_status(top).sweeps
    assert len(status.runs) == 4
    (top / "deep" / "demo").rename(sweep.out)


def test_what_is_damaged_does_not_hide_the_rest(sweep, undisturbed, tmp_path, command):
    other = tmp_path / "PickCube-v1-floating-none-equivariant-s7-0"
    shutil.copytree(undisturbed, other)
    (other / CONFIG).write_text("{")
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / CONFIG).write_text("[1]")
    # What is not of SymSteer is no damage.
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / CONFIG).write_text('{"task": ["PickCube-v1"]}')
    sweep_path(tmp_path, "older").write_text("[]")
    code, shown = command("status", tmp_path)
    assert code == 2
    assert shown.out.startswith("tiny: five (5 runs)\n  finished         1\n")
    one, two, three = sorted(shown.err.splitlines())
    assert re.match(r"error: \S+7-0/config.json cannot be read .*; restore it", one)
    assert re.match(r"error: \S+a/config.json is not the configuration of a run", two)
    assert re.match(r"error: \S+older.json is not the list of a sweep; run the sweep again", three)
    with pytest.raises(UserError, match=CONFIG):
        read_status(other)


def test_mistakes_with_status(sweep, tmp_path):
    with pytest.raises(UserError, match="there is no folder"):
        read_status(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"no sweep of a suite 'tin'; did you mean 'tiny'"):
        read_status(tmp_path, "tin")
    (tmp_path / "empty").mkdir()
    assert to_text(read_status(tmp_path / "empty").sweeps, tmp_path).startswith(
        "there are no runs in"
    )
    path = sweep_path(tmp_path, "tiny")
    for damage in (path.read_text()[:-9], "[]", '{"suite": 3}', "\x00"):
        path.write_text(damage)
        with pytest.raises(UserError, match="run the sweep again to replace it"):
            read_status(tmp_path, "tiny")


class Terminal(io.StringIO):
    """A terminal that remembers what is written to it."""

    def isatty(self):
        return True


@pytest.mark.parametrize("terminal", [False, True])
def test_each_run_that_ended_has_a_line_and_a_terminal_a_bar_for_all(sweep, terminal, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    bar, lines = Terminal() if terminal else io.StringIO(), io.StringIO()
    monkeypatch.setattr("sys.stderr", bar)
    team = Task("run", "a team", list(sweep.runs[1:3]))
    base = Task("base policy", "edp for PickCube-v1", list(sweep.runs[3:]))
    with Display(sweep, look_at(sweep), 3, lines) as shown:
        for _ in range(2):
            shown.refresh([team, base])
        shown.retried(team, Result("failed", "why"))
        shown.ended(EndedRun(sweep.runs[1], "failed", "why " * 30))
        shown.refresh([])
    *again, failed = lines.getvalue().splitlines()
    assert again == ["again     run a team: why"] * terminal
    label = "PickCube-v1 floating none standard seed 0"
    assert re.fullmatch(rf"failed    \[2/5\] {label} +{'why ' * 30}", failed)
    words = "1 of 5 runs finished, 2 running, base policy edp for PickCube-v1, time left unknown"
    assert (words in bar.getvalue()) == ("1 of 5 runs finished, 1 failed" in bar.getvalue())
    assert (words in bar.getvalue()) == terminal == bool(bar.getvalue())


def test_a_sweep_goes_on_when_nobody_reads_its_lines_any_more(sweep):
    reading, writing = os.pipe()
    os.close(reading)
    output = os.fdopen(writing, "w")
    with Display(sweep, look_at(sweep), 2, output) as shown:
        shown.ended(EndedRun(sweep.runs[1], "failed", "why"))
        assert shown.counts["failed"] == 1
    with pytest.raises(BrokenPipeError):
        output.close()


def test_a_reason_is_one_line_of_bounded_length():
    reason = Result("failed", "first\nsecond\x1b[2J " + "x" * 9999).reason
    assert reason.startswith("first second?[2J xxx")
    assert len(reason) == 500


def test_learners_that_differ_in_seeds_and_variants_alone_are_a_team(tmp_path):
    def learner(agent="standard", **changes):
        return tiny_config(agent, **changes)

    configs = (
        *(learner(seed=seed) for seed in range(3)),
        learner(seed=0, variant="wind:1"),
        learner(seed=0, task="PushCube-v1"),
        learner(seed=1, task="PushCube-v1"),
        learner("equivariant", seed=0),
        learner(options={"lr": 0.01}, seed=0),
        *(learner("zero", seed=seed) for seed in range(2)),
    )
    plan = make_plan(Suite("teams", "", configs), tmp_path)

    def teams(together):
        tasks = [task for task in tasks_of(plan, plan.runs, together) if task.kind == "run"]
        return [[plan.runs.index(run) for run in task.runs] for task in tasks], tasks

    assert teams(1)[0] == [[i] for i in range(10)]
    assert teams(3)[0] == [[0, 1, 2], [3], [4, 5], [6], [7], [8], [9]]
    found, tasks = teams(4)
    assert found == [[0, 1, 2, 3], [4, 5], [6], [7], [8], [9]]
    # Each seed has a base policy of its own; a team waits for all of them, each once.
    assert [len(task.needs) for task in tasks] == [3, 2, 1, 1, 1, 1]


def test_a_base_policy_of_several_tasks_is_built_once(tmp_path):
    names = ("PickCube-v1", "PushCube-v1")
    policy = POLICIES.get("edp-joint").Options(tasks=names)
    configs = tuple(
        tiny_config(task=task, policy_name="edp-joint", policy=policy, seed=seed)
        for task in names
        for seed in (0, 1)
    )
    plan = make_plan(Suite("shared", "", configs), tmp_path)
    kinds = [task.kind for task in tasks_of(plan, plan.runs)]
    assert kinds == ["demonstrations"] * 2 + ["base policy"] * 2 + ["run"] * 4
