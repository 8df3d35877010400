"""`--check`: each rule has forged records that it alone refuses."""

from __future__ import annotations

import copy
import functools
import hashlib
import json
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from symsteer.agents import AGENTS
from symsteer.bench.tasks import EMBODIMENTS, TASKS, task_class
from symsteer.bench.variants import VARIANTS
from symsteer.leaderboard import catalogue, command
from symsteer.leaderboard.admission import EVALUATION_RULES, RULES, Admission, check
from symsteer.leaderboard.paths import RECORDS, RESULTS
from symsteer.leaderboard.records import config_hash, run_id_of
from symsteer.leaderboard.records.provenance import git
from symsteer.policies import POLICIES
from symsteer.variant import VariantSpec
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import GONE, put

REPOSITORY = Path(__file__).parents[2]

Data = dict[str, Any]
Change = Data | Callable[[Data], Any]


@functools.cache
def committed(agent: str = "standard", seed: int = 25, variant: str = "none") -> Path:
    """A committed record with the budget and the settings of most."""
    for path in sorted(RECORDS.rglob(f"PickCube-v1-floating-{variant}-{agent}-s{seed}-*.json")):
        config = json.loads(path.read_text())["config"]
        if config["env_steps"] == 24_000 and config["demonstrations"]["count"] == 50:
            return path
    raise AssertionError("there is no such record")


def forge(path: Path, change: Change, folder: Path) -> Path:
    """A changed copy as a careful forger makes it: hash, run id and name of the file are right."""
    data = json.loads(path.read_text())
    old = data["run_id"]
    put(data, change) if isinstance(change, dict) else change(data)
    data["config_hash"] = config_hash(data["config"])
    if data["run_id"] == old:
        data["run_id"] = run_id_of(data["config"])
    target = folder / f"{data['run_id']}.json"
    folder.mkdir(exist_ok=True)
    target.write_text(json.dumps(data))
    return target


def judge(*paths: Path, among: Path = Path("/nowhere")) -> list[Admission]:
    return check(paths, among)


def five(folder: Path) -> list[Path]:
    return [forge(committed(seed=seed), {}, folder) for seed in range(25, 30)]


# Forgeries: what a hostile author changes, with all that follows from it.

LAST = "evaluations/-1/"


def both(first: Data, then: Callable[[Data], Any]) -> Change:
    return lambda data: then(put(data, first))


def config(key: str, value: Any) -> Data:
    """A key of the configuration; a slash leads into a table."""
    return {f"config/{key}": value}


def world(variant: str) -> Data:
    return {**config("variant", variant), **config("evaluation_variant", variant)}


def extension(kind: str, name: str, **more: Any) -> Data:
    sha256 = hashlib.sha256(b"code").hexdigest()
    target = {"kind": kind, "name": name, "target": f"mine:{kind}", "sha256": sha256}
    return target | {"distribution": "mine", "version": "1.0"} | more


def extended(*extensions: Data) -> Data:
    return {"provenance/extensions": list(extensions)}


def updates(data: Data, decisions: int) -> int:
    return max(0, int((decisions - 1280) * data["config"]["agent_options"]["utd"]))


def all_at(end: int) -> Callable[[Data], None]:
    """The run ends at another step."""

    def change(data: Data) -> None:
        used = {"decisions": end // 4, "updates": updates(data, end // 4), "env_steps": end}
        data["evaluations"][-1].update(used)
        data["budget"].update(used)

    return change


def decide(factor: float) -> Change:
    """As many decisions, and the updates that belong to them."""

    def change(data: Data) -> None:
        for place in [*data["evaluations"], data["budget"]]:
            place["decisions"] = int(place["decisions"] * factor)
            place["updates"] = updates(data, place["decisions"])

    return change


def short(data: Data) -> None:
    """One decision of all environments is more than a tenth of the budget."""
    data["config"]["env_steps"] = 2_000
    data["evaluations"][1:-1] = []
    all_at(2_048)(data)


def extra_evaluation(data: Data) -> None:
    early = copy.deepcopy(data["evaluations"][0]) | {"env_steps": 256, "decisions": 64}
    data["evaluations"].insert(1, early)


def first_episodes(number: int, evaluation: Data) -> None:
    """Only the first episodes of an evaluation."""
    columns = evaluation["episodes"]
    for name, values in columns.items():
        columns[name] = values[:number] if isinstance(values, list) else values


def few_episodes(data: Data) -> None:
    data["config"]["evaluation"]["final_episodes"] = 99
    first_episodes(99, data["evaluations"][-1])


def outcome(once: int, which: str = "*", **columns: float) -> Data:
    """Every episode of an evaluation, or of all, has the same outcome; the other columns stay."""
    same = {"success_once": once, "success_at_end": once, **columns}
    return {f"evaluations/{which}/episodes/{name}/*": value for name, value in same.items()}


def late_failure(data: Data) -> None:
    columns = data["evaluations"][-1]["episodes"]
    columns["return"][columns["success_once"].index(0)] = -20.0


def continued(data: Data) -> None:
    data["wall_clock"]["resumed"] = 1
    data["continued"] = [copy.deepcopy(data["provenance"]) | {"dirty": True}]


FIRST, END = LAST + "episodes/{}/0", ("success_at_end", 0)
NO_CODE = {"provenance/commit": None, "provenance/dirty": None}
UNVERSIONED = {
    "provenance/version": "0.2.dev3+g0123456",
    "provenance/sha256": "0123456789abcdef" * 4,
}

FORGERIES: dict[str, list[Change]] = {
    "its code can be looked up": [
        {"provenance/dirty": True},
        NO_CODE,
        NO_CODE | UNVERSIONED,
        continued,
        config("agent", "mine:Mine")
        | extended(extension("agent", "mine:Mine", distribution=None, version=None)),
    ],
    "names are SymSteer's, or extensions'": [
        config("task", "FetchCube-v1"),
        config("agent", "wonder"),
        world("earthquake:1"),
        config("policy/name", "oracle") | {"base_policy/name": "oracle"},
        extended(extension("agent", "standard")),
        extended(extension("agent", "unused")),
    ],
    "its name is its configuration's": [{"run_id": "PickCube-v1-floating-none-standard-s25-012"}],
    "seeds are the configuration's": [{"seeds/run": 7}, {"seeds/demonstrations": GONE}],
    "role and variant are its agent's and its evaluations'": [
        {"role": "control"},
        config("evaluation_variant", "wind:1"),
        config("variant", "action_gain:0.50") | config("evaluation_variant", "action_gain:0.5"),
    ],
    "hashes have many different digits": [
        {"base_policy/content_hash": "0" * 64},
        {"provenance/commit": "ab" * 20},
        config("files", {"demonstrations": "0" * 64}),
        config("agent", "mine") | extended(extension("agent", "mine", sha256="01" * 32)),
    ],
    "the device is the configuration's, runs in a process at most 100": [
        {"provenance/together": 5_000},
        {"provenance/device": "NVIDIA H100"},
    ],
    "the whole budget is used, and not exceeded": [all_at(23_808), all_at(48_128)],
    "a decision takes at most a tenth of the budget": [config("policy/horizon", 3), short],
    "evaluations are the configuration's": [
        lambda data: data.update(evaluations=data["evaluations"][-1:]),
        {"evaluations/0": GONE},
        {"evaluations/3": GONE},
        extra_evaluation,
        config("evaluation/every", 2_000),
    ],
    "feasible Q-values are the reward's": [
        config("agent_options/timeouts_terminal", True),
        config("agent_options/gamma", 0.9),
    ],
    "the base policy's shares are its draws'": [
        {f"base_policy/{name}": value}
        for name, value in (
            *(("base_success", 0.0005), ("solvable", 0.99), ("solvable", 0.0), ("episodes", 1000)),
            *(("base_success", None), ("name", "plain")),
        )
    ],
    "numbers of parameters add up": [{"parameters/total": 1}],
    "times are in order and within the run": [
        {"wall_clock/total": 0.1},
        {"wall_clock/simulate": 1e6},
        {"evaluations/2/wall_clock": 0.0},
        lambda data: data.update(ended=data["started"]),
        {"started": "2126-01-31T12:00:00+00:00", "ended": "2126-01-31T19:00:00+00:00"},
        lambda data: data.update(continued=[data["provenance"]]),
    ],
    "no text holds a path of a machine": [
        {"base_policy/warning": "trained in /home/somebody/runs/base"},
        {"provenance/platform": "C:\\Users\\somebody\\gpu"},
    ],
    "seeds are the held-out ones in order": [{"evaluations/1/episodes/seed/0": 17}],
    "episodes are as many as configured, 100 at the end": [
        few_episodes,
        config("evaluation/episodes", 31),
    ],
    "the final one counts what the run used": [{"budget/updates": 1}, {"budget/decisions": 1}],
    "so many decisions take so many steps": [config("num_envs", 60), decide(2), decide(0.5)],
    "so many decisions lead to so many updates": [
        config("agent_options/utd", 5.0),
        {"evaluations/2/updates": 3},
    ],
    "episodes last to the time limit": [
        outcome(0, episode_len=9_999, **{"return": -9_999.0}),
        {LAST + "episodes/episode_len/1": 49},
    ],
    "returns are the reward's": [
        outcome(1, "-1"),
        *({FIRST.format("return"): value} for value in (1e30, 1.0, -12.5, -51.0, None)),
        late_failure,
        {FIRST.format(k): v for k, v in (("return", -49.0), ("success_once", 1), END)},
    ],
    "no diagnostic is left out": [
        {"evaluations/*/diagnostics/q_mean": GONE},
        {LAST + "diagnostics/q_magnitude": None},
    ],
    "diagnostics agree with each other": [
        {LAST + f"diagnostics/{name}": value}
        for name, value in (
            *(("q_magnitude", 0.1), ("q_mean", 50.0), ("q_abs_max", 0.0), ("q_overshoot", -1.0)),
            *(("q_overshoot", 1e30), ("q_bias", 1e30), ("return_mean", -500.0)),
            *(("q_violation", 2.0), ("q_correlation", 7.0), ("td_error", -3.0)),
        )
    ],
}
"""By rule, each of which alone refuses them: what is changed, or a function that does it."""


@pytest.mark.parametrize(
    ("rule", "number"), [(rule, n) for rule, found in FORGERIES.items() for n in range(len(found))]
)
def test_a_forgery_is_refused_by_one_rule_alone(rule: str, number: int, tmp_path: Path) -> None:
    verdict = judge(forge(committed(seed=26), FORGERIES[rule][number], tmp_path))[0]
    assert len(verdict.problems) == 1, verdict.problems
    assert f"breaks the rule that {rule}: " in verdict.problems[0]


def test_every_rule_has_a_forgery_and_is_documented() -> None:
    rules = [*RULES, *EVALUATION_RULES]
    assert list(FORGERIES) == [rule.partition(" | ")[0] for rule in rules]
    page = (REPOSITORY / "docs" / "submit.md").read_text()
    assert [rule for rule in rules if f"\n| {rule} |\n" not in page] == []


def searched(data: Data) -> None:
    for place in (data["evaluations"][0], data["budget"]):
        place.update(env_steps=256, decisions=64)


def evaluated_twice(data: Data) -> None:
    data["evaluations"].insert(0, copy.deepcopy(data["evaluations"][0]) | {"final": False})
    first_episodes(data["config"]["evaluation"]["episodes"], data["evaluations"][0])


@pytest.mark.parametrize(
    ("agent", "change", "sentence"),
    [
        ("zero", searched, "the run (256 environment steps of 24000) breaks the rule"),
        ("base", evaluated_twice, "the run (a reference has one) breaks the rule"),
        ("base", {"parameters": {"actor": 1, "critic": 0, "total": 1}}, "parameters add up"),
        ("zero", {"feasible_q": {"low": -80.0, "high": 0.0}}, "feasible Q-values are"),
    ],
)
def test_references_are_judged_as_well(
    agent: str, change: Change, sentence: str, tmp_path: Path
) -> None:
    (problem,) = judge(forge(committed(agent), change, tmp_path))[0].problems
    assert sentence in problem


def edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_the_form_of_a_record(tmp_path: Path) -> None:
    paths = five(tmp_path)
    moved = paths[0].rename(tmp_path / "record.json")
    edit(paths[1], config_hash="0" * 64)
    paths[2].write_bytes(paths[2].read_bytes()[:-300])
    edit(paths[3], favourite="seed")
    edit(paths[4], status="failed", failure="out of memory")
    sentences = [
        f"rename it to {paths[0].name}",
        "config_hash does not belong",
        "not strict JSON",
        "favourite",
        "the run is failed, not finished: continue it with `symsteer resume RUN_FOLDER`",
    ]
    for verdict, sentence in zip(judge(moved, *paths[1:]), sentences, strict=True):
        assert len(verdict.problems) == 1
        assert sentence in verdict.problems[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (config("variant", "action_gain:77"), "of variant 'action_gain' must lie in [0, 1]"),
        (config("evaluation/every", 0), "evaluation.every"),
        (config("secret", 1), "a key 'secret'"),
        (config("sac", {"utd": 9.0}), "a key 'sac'"),
        (config("evaluation", GONE), "evaluation.every"),
        (config("files", {"policy": "zero"}), "files.policy"),
    ],
)
def test_a_configuration_that_nothing_runs(change: Data, words: str, tmp_path: Path) -> None:
    (problem,) = judge(forge(committed(), change, tmp_path))[0].problems
    assert problem.startswith("its configuration is none of `symsteer run` (")
    assert words in problem


def test_names_and_limits_are_those_of_the_registries() -> None:
    limits = {name: task_class(name).max_episode_steps for name in TASKS.builtin}
    assert limits == catalogue.TASKS
    assert sorted(EMBODIMENTS) == sorted(catalogue.EMBODIMENTS)
    assert set(POLICIES.builtin) == set(catalogue.POLICIES)
    roles = {name: AGENTS.get(name).role for name in AGENTS.builtin}
    assert roles | catalogue.RETIRED_AGENTS == catalogue.AGENTS
    classes = {name: VARIANTS.get(name) for name in VARIANTS.builtin}
    costs = {name: found(VariantSpec(name, 1.0)).highest_cost for name, found in classes.items()}
    assert costs == catalogue.VARIANTS
    assert {name for name, c in classes.items() if c.training_only} == catalogue.TRAINING_ONLY


def test_what_others_can_install_is_admitted_with_a_note(tmp_path: Path) -> None:
    version = metadata.version("numpy")
    sha256, code = (hashlib.sha256(text).hexdigest() for text in (b"code", b"symsteer"))
    installed = {**NO_CODE, "provenance/sha256": code}
    mine = extension("agent", "mine", distribution="my-agents", version="1.2")
    fog = extension("variant", "fog", distribution="numpy", version=version)
    change = config("agent", "mine") | world("fog:1") | extended(mine, fog) | installed
    (verdict,) = judge(forge(committed(), change, tmp_path))
    assert verdict.problems == []
    assert verdict.notes[1:] == [
        f"it ran symsteer 0.2.0 as installed, not a checkout; sha256 {code[:12]}",
        f"it uses the agent mine of my-agents 1.2; sha256 {sha256[:12]}, unresolved: not "
        "installed here",
        f"it uses the variant fog of numpy {version}; sha256 {sha256[:12]}",
    ]


def moved(seed: int) -> Data:
    """The run of another seed, as a forger claims."""
    return {"config/seed": seed, "seeds/run": seed}


def nudged(data: Data) -> None:
    """A few successes of the final evaluation come a step later."""
    columns = data["evaluations"][-1]["episodes"]
    for number in [n for n, value in enumerate(columns["return"]) if -40 < value < 0][:4]:
        columns["return"][number] -= 1


def test_copies_are_found_whatever_else_the_record_says(tmp_path: Path) -> None:
    old, new = five(tmp_path / "old"), tmp_path / "new"
    # Without diagnostics nobody looks for a copy.
    unmeasured = {"evaluations/*/diagnostics": {}, "feasible_q": None}
    cases: list[tuple[Change, str]] = [
        ({}, f"it is a copy of {old[0]}: remove one of the two"),
        (
            {"wall_clock/diagnose": 0.0},
            f"{old[1]} holds the same configuration, seeds and base policy already: remove one",
        ),
        (moved(8), f"its final episodes are nearly all those of {old[2]}, more than"),
        (
            moved(9) | unmeasured | config("agent", "mine"),
            f"its final episodes are nearly all those of {old[3]}, more than",
        ),
        (both(moved(7), nudged), f"its final episodes are nearly all those of {old[4]}, more than"),
    ]
    copies = [forge(path, change, new) for path, (change, _) in zip(old, cases, strict=True)]
    verdicts = judge(*copies, among=tmp_path / "old")
    for verdict, (_, sentence) in zip(verdicts, cases, strict=True):
        assert any(problem.startswith(sentence) for problem in verdict.problems)
    note = "its seed 7 is none of those of the committed runs of its table (25, 26"
    assert any(text.startswith(note) for text in verdicts[4].notes)
    assert all(v.is_admissible and not v.notes for v in judge(*old, among=tmp_path / "old"))


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"parameters": {"actor": 1, "critic": 1, "total": 2}}, "sizes of networks"),
        ({"base_policy/parameters": 7}, "parameters of the base policy"),
        ({"base_policy/base_success": 0.0625}, "successes of the base policy"),
        ({LAST + "episodes/direction/3": 0.5}, "initial states"),
    ],
)
def test_what_other_records_say_differently(change: Data, fact: str, tmp_path: Path) -> None:
    """The same agent, base policy and cell; a new seed of the run alone."""
    old = committed(variant="action_gain=1")
    other = forge(old, {}, tmp_path / "old")
    path = forge(old, moved(7) | change, tmp_path / "new")
    problems = judge(path, among=other.parent)[0].problems
    (problem,) = [p for p in problems if "a copy" not in p and "breaks" not in p]
    assert problem.startswith(f"its {fact} are not those of {other}")


def test_two_learners_that_always_fail_are_no_copies(tmp_path: Path) -> None:
    fail = outcome(0, **{"return": -50.0})
    paths = [forge(committed(seed=seed), fail, tmp_path) for seed in (25, 26)]
    assert all(verdict.is_admissible for verdict in judge(*paths))


def test_another_base_policy_is_said(tmp_path: Path) -> None:
    old, new = tmp_path / "old", tmp_path / "new"
    five(old)
    for agent in ("base", "zero"):
        forge(committed(agent), {}, old)
    content = hashlib.sha256(b"another").hexdigest()

    def on_another(agent: str) -> Path:
        return forge(committed(agent, 26), {"base_policy/content_hash": content}, new)

    learner = on_another("standard")
    note = judge(learner, among=old)[0].notes[-1]
    assert f"base policy {content[:12]} is not that of the committed runs" in note
    assert "submit base, zero on it" in note
    verdicts = judge(learner, on_another("base"), among=old)
    assert "submit zero on it" in verdicts[0].notes[-1]
    assert all("same configuration" not in problem for problem in verdicts[1].problems)


def test_a_commit_that_nobody_has_is_said(tmp_path: Path) -> None:
    if git(REPOSITORY, "rev-parse", "--is-shallow-repository") != "false":
        pytest.skip("needs a whole clone of the repository")
    path = forge(committed("base"), {"provenance/commit": "0123456789" * 4}, tmp_path)
    (verdict,) = judge(path)
    assert verdict.is_admissible
    (note,) = verdict.notes
    assert note.startswith("its commit 012345678901 is not in this clone: push it with the pull")


def test_the_command_says_what_to_mend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many records it names those that it complains about; none is committed yet."""
    monkeypatch.setattr(command, "RECORDS", tmp_path / "nothing")
    new = tmp_path / "new"
    paths = five(new)
    assert main(["--check", *map(str, paths)]) == 0
    admitted = [f"{path}: admissible" for path in paths]
    assert capsys.readouterr().out.splitlines() == [*admitted, "5 of 5 records are admissible"]
    for seed in range(25, 30):
        forge(committed(seed=seed, variant="action_gain=1"), {}, new)
    running = forge(paths[4], moved(30) | {"status": "running", "ended": None}, new)
    (new / "hostile.json").write_text(
        '{"schema_version": 5, "config_hash": "", "\\u001b[2J\\nadmissible": 1}'
    )
    assert main(["--check", str(new)]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "10 of 12 records are admissible"
    assert f"{running}: NOT ADMISSIBLE" in lines
    assert f"{paths[0]}: admissible" not in lines
    assert all(line.isprintable() for line in lines)
    assert any("the run is running, not finished" in line for line in lines)


@pytest.mark.long
@pytest.mark.parametrize("folder", ["records", "zoo", "learners", "first", "stress", "policies"])
def test_what_is_committed_keeps_every_rule(folder: str) -> None:
    """A tenth of it. Runs of `stress` have 64 final episodes, as their study declares."""
    files = sorted((RESULTS / folder).rglob("*.json"))[::10]
    verdicts = check(files, Path("/nowhere"))
    assert [problem for verdict in verdicts for problem in verdict.problems] == []
