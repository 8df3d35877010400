"""`--check`: each rule has forged records that it alone refuses."""

from __future__ import annotations

import copy
import functools
import hashlib
import json
import operator
import subprocess
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

from symsteer.agents import AGENTS
from symsteer.bench.tasks import EMBODIMENTS, TASKS, task_class
from symsteer.bench.variants import VARIANTS
from symsteer.errors import UserError
from symsteer.leaderboard import catalogue, command
from symsteer.leaderboard.admission import EVALUATION_RULES, RULES, Admission, check
from symsteer.leaderboard.paths import RECORDS, RESULTS
from symsteer.leaderboard.records import config_hash, read_record
from symsteer.policies import POLICIES
from symsteer.variant import VariantSpec
from tests.leaderboard.command_line import main

REPOSITORY = Path(__file__).parents[2]

Data = dict[str, Any]
Change = Callable[[Data], Any]


@functools.cache
def committed(agent: str = "standard", seed: int = 25, variant: str = "none") -> Path:
    """A committed record with the budget and the settings of most."""
    for path in sorted(RECORDS.rglob(f"PickCube-v1-floating-{variant}-{agent}-s{seed}-*.json")):
        config = json.loads(path.read_text())["config"]
        if config["env_steps"] == 24_000 and config["demonstrations"]["count"] == 50:
            return path
    raise AssertionError("there is no such record")


def forge(path: Path, change: Change | Data, folder: Path) -> Path:
    """A changed copy as a careful forger makes it: hash, run id and name of the file are right."""
    data = json.loads(path.read_text())
    old = data["run_id"]
    (put(change) if isinstance(change, dict) else change)(data)
    config = data["config"]
    data["config_hash"] = config_hash(config)
    if data["run_id"] == old:
        own = {k: v for k, v in config.items() if k not in ("evaluation_variant", "files")}
        text = json.dumps([own, config.get("files")], sort_keys=True, separators=(",", ":"))
        keys = config["task"], config["embodiment"], config["variant"], config["agent"]
        key = hashlib.sha256(text.encode()).hexdigest()[:12]
        data["run_id"] = "-".join([*keys, f"s{config['seed']}", key]).replace(":", "=")
    target = folder / f"{data['run_id']}.json"
    folder.mkdir(exist_ok=True)
    target.write_text(json.dumps(data))
    return target


def judge(*paths: Path, among: Path = Path("/nowhere")) -> list[Admission]:
    return check(paths, among)


def five(folder: Path) -> list[Path]:
    return [forge(committed(seed=seed), {}, folder) for seed in range(25, 30)]


def test_five_seeds_are_admitted_without_a_word(tmp_path: Path) -> None:
    verdicts = judge(*five(tmp_path), committed("base"))
    assert all(verdict.is_admissible and not verdict.notes for verdict in verdicts)


# Forgeries: what a hostile author changes, with all that follows from it.

GONE = object()
LAST = "evaluations/-1/"


def put(values: Data) -> Change:
    """Give what is at the places of a record other values; `GONE` removes it."""

    def change(data: Any) -> None:
        for place, value in values.items():
            *keys, last = (int(k) if k.lstrip("-").isdigit() else k for k in place.split("/"))
            inner = functools.reduce(operator.getitem, keys, data)
            if value is GONE:
                del inner[last]
            else:
                inner[last] = value

    return change


def both(*changes: Change) -> Change:
    return lambda data: [change(data) for change in changes]


def config(**values: Any) -> Change:
    """Keys of the configuration; a double underscore leads into a table."""
    return put({f"config/{name.replace('__', '/')}": value for name, value in values.items()})


def everywhere(change: Change) -> Change:
    return lambda data: [change(evaluation) for evaluation in data["evaluations"]]


def solved(data: Data) -> None:
    """Every episode of the final evaluation is a success, but nobody corrects the returns."""
    columns = data["evaluations"][-1]["episodes"]
    columns["success_once"] = columns["success_at_end"] = [1] * len(columns["seed"])


def extension(kind: str, name: str, **more: Any) -> Data:
    sha256 = hashlib.sha256(b"code").hexdigest()
    target = {"kind": kind, "name": name, "target": f"mine:{kind}", "sha256": sha256}
    return target | {"distribution": "mine", "version": "1.0"} | more


def extended(*extensions: Data, **values: Any) -> Change:
    return both(config(**values), put({"provenance/extensions": list(extensions)}))


def all_at(end: int) -> Change:
    """The run ends at another step."""

    def change(data: Data) -> None:
        last = data["evaluations"][-1]
        last["env_steps"] = data["budget"]["env_steps"] = end
        last["decisions"] = data["budget"]["decisions"] = end // 4
        updates = max(0, int((end // 4 - 1280) * data["config"]["agent_options"]["utd"]))
        last["updates"] = data["budget"]["updates"] = updates

    return change


def extra_evaluation(data: Data) -> None:
    early = copy.deepcopy(data["evaluations"][0]) | {"env_steps": 256, "decisions": 64}
    data["evaluations"].insert(1, early)


def few_episodes(data: Data) -> None:
    config(evaluation__final_episodes=99)(data)
    columns = data["evaluations"][-1]["episodes"]
    for name, values in columns.items():
        columns[name] = values[:99] if isinstance(values, list) else values


def short(data: Data) -> None:
    """One decision of all environments is more than a tenth of the budget."""
    config(env_steps=2_000)(data)
    data["evaluations"] = [data["evaluations"][0], data["evaluations"][-1]]
    all_at(2_048)(data)


def decide(factor: float) -> Change:
    """As many decisions, and the updates that belong to them."""

    def change(data: Data) -> None:
        for place in [*data["evaluations"], data["budget"]]:
            place["decisions"] = int(place["decisions"] * factor)
            utd = data["config"]["agent_options"]["utd"]
            place["updates"] = max(0, int((place["decisions"] - 1280) * utd))

    return change


def endless(data: Data) -> None:
    for evaluation in data["evaluations"]:
        columns = evaluation["episodes"]
        columns["episode_len"] = [9_999] * len(columns["seed"])
        pairs = zip(columns["success_once"], columns["return"], strict=True)
        columns["return"] = [value if once else -9_999.0 for once, value in pairs]


def late_failure(data: Data) -> None:
    columns = data["evaluations"][-1]["episodes"]
    columns["return"][columns["success_once"].index(0)] = -20.0


def continued(data: Data) -> None:
    data["wall_clock"]["resumed"] = 1
    data["continued"] = [copy.deepcopy(data["provenance"]) | {"dirty": True}]


def hidden(*names: str) -> Change:
    return everywhere(put({f"diagnostics/{name}": GONE for name in names}))


FIRST = LAST + "episodes/{}/0"
NO_CODE = {"provenance/commit": None, "provenance/dirty": None}
UNVERSIONED = {
    "provenance/version": "0.2.dev3+g0123456",
    "provenance/sha256": "0123456789abcdef" * 4,
}

FORGERIES: dict[str, list[Change | Data]] = {
    "its code can be looked up": [
        {"provenance/dirty": True},
        NO_CODE,
        {**NO_CODE, **UNVERSIONED},
        continued,
        extended(
            extension("agent", "mine:Mine", distribution=None, version=None), agent="mine:Mine"
        ),
    ],
    "names are SymSteer's, or extensions'": [
        {"config/task": "FetchCube-v1"},
        {"config/embodiment": "hand"},
        {"config/agent": "wonder"},
        config(variant="earthquake:1", evaluation_variant="earthquake:1"),
        {"config/policy/name": "oracle", "base_policy/name": "oracle"},
        extended(extension("agent", "standard")),
        extended(extension("task", "PickCube-v1")),
        extended(extension("agent", "unused")),
    ],
    "its name is its configuration's": [
        {"run_id": "PickCube-v1-floating-none-standard-s25-0123456789ab"},
        {"run_id": "PickCube-v1-floating-none-equivariant-s25-4fbbd8847ddd"},
    ],
    "seeds are the configuration's": [
        {"seeds/run": 77},
        {"seeds/policy": 7},
        {"seeds/first_held_out": 7},
        {"seeds/demonstrations": GONE},
    ],
    "role and variant are its agent's and its evaluations'": [
        {"role": "control"},
        config(evaluation_variant="wind:1"),
        config(variant="action_gain:0.50", evaluation_variant="action_gain:0.5"),
    ],
    "hashes have many different digits": [
        {"base_policy/content_hash": "0" * 64},
        {"provenance/commit": "ab" * 20},
        config(files={"demonstrations": "0" * 64}),
        extended(extension("agent", "mine", sha256="01" * 32), agent="mine"),
    ],
    "the device is the configuration's, runs in a process at most 100": [
        {"provenance/together": 5_000},
        {"provenance/device": "NVIDIA H100"},
    ],
    "the whole budget is used, and not exceeded": [all_at(23_808), all_at(48_128)],
    "a decision takes at most a tenth of the budget": [config(policy__horizon=3), short],
    "evaluations are the configuration's": [
        lambda data: data.update(evaluations=data["evaluations"][-1:]),
        {"evaluations/0": GONE},
        {"evaluations/3": GONE},
        extra_evaluation,
        config(evaluation__every=2_000),
    ],
    "feasible Q-values are the reward's": [
        config(agent_options__timeouts_terminal=True),
        config(agent_options__gamma=0.9),
    ],
    "the base policy's shares are its draws'": [
        {"base_policy/base_success": 0.0005},
        {"base_policy/solvable": 0.99},
        {"base_policy/solvable": 0.0},
        {"base_policy/episodes": 1000},
        {"base_policy/base_success": None},
        {"base_policy/name": "plain"},
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
    "seeds are the held-out ones in order": [
        {FIRST.format("seed"): 17},
        {"evaluations/1/episodes/seed/0": 17},
    ],
    "episodes are as many as configured, 100 at the end": [
        few_episodes,
        config(evaluation__episodes=31),
        config(evaluation__final_episodes=200),
    ],
    "the final one counts what the run used": [{"budget/updates": 1}, {"budget/decisions": 1}],
    "so many decisions take so many steps": [config(num_envs=60), decide(2), decide(0.5)],
    "so many decisions lead to so many updates": [
        config(agent_options__utd=5.0),
        config(agent_options__warmup=0),
        {"evaluations/2/updates": 3},
    ],
    "episodes last to the time limit": [endless, {LAST + "episodes/episode_len/1": 49}],
    "returns are the reward's": [
        solved,
        *({FIRST.format("return"): value} for value in (1e30, 1.0, -12.5, -51.0, None)),
        late_failure,
        {
            FIRST.format("return"): -49.0,
            FIRST.format("success_once"): 1,
            FIRST.format("success_at_end"): 0,
        },
    ],
    "no diagnostic is left out": [
        hidden("q_mean"),
        hidden("q_magnitude", "q_overshoot"),
        {LAST + "diagnostics/td_error": GONE},
        {LAST + "diagnostics/q_magnitude": None},
    ],
    "diagnostics agree with each other": [
        {LAST + f"diagnostics/{name}": value}
        for name, value in (
            *(("q_magnitude", 0.1), ("q_mean", 50.0), ("q_abs_max", 0.0), ("q_overshoot", -1.0)),
            *(("q_overshoot", 1e30), ("q_bias", 1e30), ("return_mean", -500.0)),
            *(("q_violation", 2.0), ("q_correlation", 7.0), ("q_overestimated", 1.5)),
            ("td_error", -3.0),
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
    few = data["config"]["evaluation"]["episodes"]
    columns = data["evaluations"][0]["episodes"]
    data["evaluations"][0]["episodes"] = {
        name: values[:few] if isinstance(values, list) else values
        for name, values in columns.items()
    }


@pytest.mark.parametrize(
    ("agent", "change", "sentence"),
    [
        ("zero", searched, "the run (256 environment steps of 24000) breaks the rule"),
        ("base", evaluated_twice, "the run (a reference has one) breaks the rule"),
        ("base", {"parameters": {"actor": 1, "critic": 0, "total": 1}}, "parameters add up"),
        ("zero", {"feasible_q": {"low": -80.0, "high": 0.0}}, "feasible Q-values are"),
        ("base", {"budget/updates": 3}, "counts what the run used"),
    ],
)
def test_references_are_judged_as_well(
    agent: str, change: Change | Data, sentence: str, tmp_path: Path
) -> None:
    (problem,) = judge(forge(committed(agent), change, tmp_path))[0].problems
    assert sentence in problem


@pytest.mark.parametrize("steps", [9, 10**9])
def test_long_decisions_hide_no_steps(steps: int, tmp_path: Path) -> None:
    path = forge(committed(), config(policy__execute=steps, policy__horizon=steps), tmp_path)
    found = [
        text for text in judge(path)[0].problems if "a decision takes at most a tenth of" in text
    ]
    assert len(found) == (steps > 50)


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
        (config(variant="action_gain:77"), r"strength of variant 'action_gain' must lie in [0, 1]"),
        (config(variant="action_gain"), "needs a strength"),
        (config(evaluation__every=0), "evaluation.every"),
        (config(policy__execute="4"), "policy.execute"),
        (config(num_envs=10**6), "num_envs"),
        (config(sim="tpu"), "sim"),
        (config(policy_seed=2**32), "policy_seed"),
        (config(demonstrations={"mode": "best", "count": 50, "seed": 25}), "demonstrations.mode"),
        (config(secret=1), "a key 'secret'"),
        (config(sac={"utd": 9.0}), "a key 'sac'"),
        ({"config/evaluation": GONE}, "evaluation.every"),
        (config(files={"policy": "zero"}), "files.policy"),
    ],
)
def test_a_configuration_that_nothing_runs(
    change: Change | Data, words: str, tmp_path: Path
) -> None:
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
    path = forge(
        committed(),
        extended(
            extension("agent", "mine", distribution="my-agents", version="1.2"),
            extension("variant", "fog", distribution="numpy", version=version),
            agent="mine",
            variant="fog:1",
            evaluation_variant="fog:1",
        ),
        tmp_path,
    )
    data = json.loads(path.read_text())
    code = hashlib.sha256(b"symsteer").hexdigest()
    data["provenance"].update(commit=None, dirty=None, sha256=code)
    path.write_text(json.dumps(data))
    verdict = judge(path)[0]
    assert verdict.problems == []
    sha256 = extension("", "")["sha256"][:12]
    assert verdict.notes[1:] == [
        f"it ran symsteer 0.2.0 as installed, not a checkout; sha256 {code[:12]}",
        f"it uses the agent mine of my-agents 1.2; sha256 {sha256}, unresolved: not installed here",
        f"it uses the variant fog of numpy {version}; sha256 {sha256}",
    ]


def moved(seed: int) -> Change:
    """The run of another seed, as a forger claims."""
    return put({"config/seed": seed, "seeds/run": seed})


def unmeasured(data: Data) -> None:
    """Without diagnostics nobody looks for a copy."""
    everywhere(put({"diagnostics": {}}))(data)
    data["feasible_q"] = None


def nudged(data: Data) -> None:
    """A few successes of the final evaluation come a step later."""
    moved(7)(data)
    columns = data["evaluations"][-1]["episodes"]
    later = [n for n, value in enumerate(columns["return"]) if -40 < value < 0][:4]
    for number in later:
        columns["return"][number] -= 1


def test_copies_are_found_whatever_else_the_record_says(tmp_path: Path) -> None:
    old, new = five(tmp_path / "old"), tmp_path / "new"
    same = forge(old[1], {}, new)
    slower = forge(old[2], {"wall_clock/diagnose": 0.0}, new)
    renamed = forge(old[3], moved(8), new)
    silent = forge(old[4], both(moved(9), unmeasured, config(agent="mine")), new)
    changed = forge(old[0], nudged, new)
    verdicts = judge(same, slower, renamed, silent, changed, among=tmp_path / "old")
    sentences = [
        f"it is a copy of {old[1]}: remove one of the two",
        f"{old[2]} holds the same configuration, seeds and base policy already: remove one",
        *(f"its final episodes are nearly all those of {old[n]}, more than" for n in (3, 4, 0)),
    ]
    for verdict, sentence in zip(verdicts, sentences, strict=True):
        assert any(problem.startswith(sentence) for problem in verdict.problems)
    note = "its seed 7 is none of those of the committed runs of its table (25, 26"
    assert any(text.startswith(note) for text in verdicts[4].notes)
    assert all(verdict.is_admissible for verdict in judge(*old, among=tmp_path / "old"))


def invented(data: Data) -> None:
    """Every other failure of the final evaluation becomes a success like the one before it."""
    columns = data["evaluations"][-1]["episodes"]
    failures = [n for n, once in enumerate(columns["success_once"]) if not once]
    for n in failures[::2]:
        columns["success_once"][n] = columns["success_at_end"][n] = 1
        columns["return"][n] = -20.0 - n % 7
    for n, value in enumerate(columns["return"]):
        columns["return"][n] = value - n % 2 if value > -40 else value


def test_invented_numbers_that_agree_with_each_other_pass(tmp_path: Path) -> None:
    """The limit of arithmetic: only a run that is made again shows them (docs/submit.md)."""
    old = five(tmp_path / "old")
    path = forge(old[0], both(moved(7), invented), tmp_path / "new")
    (verdict,) = judge(path, among=tmp_path / "old")
    assert verdict.is_admissible
    better, worse = (sum(read_record(p).final.episodes.success_once) for p in (path, old[0]))
    assert better > worse


@pytest.mark.parametrize(
    ("change", "fact"),
    [
        ({"parameters": {"actor": 1, "critic": 1, "total": 2}}, "sizes of networks"),
        ({"base_policy/parameters": 7}, "parameters of the base policy"),
        ({"base_policy/base_success": 0.0625}, "successes of the base policy"),
        ({LAST + "episodes/direction/3": 0.5}, "initial states"),
    ],
)
def test_what_other_records_say_differently(
    change: Change | Data, fact: str, tmp_path: Path
) -> None:
    """The same agent, base policy and cell; a new seed of the run alone."""
    old = committed(variant="action_gain=1")
    five_copies = forge(old, {}, tmp_path / "old")
    path = forge(old, both(moved(7), put(change)), tmp_path / "new")
    problems = judge(path, among=five_copies.parent)[0].problems
    (problem,) = [p for p in problems if "a copy" not in p and "breaks" not in p]
    assert problem.startswith(f"its {fact} are not those of {five_copies}")


def test_two_learners_that_always_fail_are_no_copies(tmp_path: Path) -> None:
    def fail(data: Data) -> None:
        for evaluation in data["evaluations"]:
            columns = evaluation["episodes"]
            columns["success_once"] = columns["success_at_end"] = [0] * len(columns["seed"])
            columns["return"] = [-50.0] * len(columns["seed"])

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
    shallow = subprocess.run(
        ["git", "-C", str(REPOSITORY), "rev-parse", "--is-shallow-repository"],
        capture_output=True,
        text=True,
    )
    if shallow.stdout.strip() != "false":
        pytest.skip("needs a whole clone of the repository")
    path = forge(committed("base"), {"provenance/commit": "0123456789" * 4}, tmp_path)
    verdict = judge(path)[0]
    assert verdict.is_admissible
    assert verdict.notes == [
        "its commit 012345678901 is not in this clone: push it with the pull request, so that "
        "others can run the same code"
    ]


def test_a_damaged_committed_record_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "bad.json").write_text("{")
    with pytest.raises(UserError, match=r"bad\.json is not strict JSON"):
        judge(committed(), among=tmp_path / "old")


# Command line


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nothing is committed yet."""
    (tmp_path / "nothing").mkdir()
    monkeypatch.setattr(command, "RECORDS", tmp_path / "nothing")


@pytest.mark.usefixtures("alone")
def test_the_command_says_what_to_mend(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of many records it names those that it complains about."""
    new = tmp_path / "new"
    paths = five(new)
    assert main(["--check", *map(str, paths)]) == 0
    admitted = [f"{path}: admissible" for path in paths]
    assert capsys.readouterr().out.splitlines() == [*admitted, "5 of 5 records are admissible"]
    for variant in ("action_gain=1", "perception_bias=1"):
        for seed in range(25, 30):
            forge(committed(seed=seed, variant=variant), {}, new)
    assert main(["--check", str(new)]) == 0
    assert capsys.readouterr().out == "15 of 15 records are admissible\n"
    edit(paths[4], status="running", ended=None)
    (new / "hostile.json").write_text(
        '{"schema_version": 5, "config_hash": "", "\\u001b[2J\\nadmissible": 1}'
    )
    assert main(["--check", str(new)]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "14 of 16 records are admissible"
    assert f"{paths[4]}: NOT ADMISSIBLE" in lines
    assert sum(line.startswith("  problem: ") for line in lines) == 2
    assert all(line.isprintable() for line in lines)
    assert any("the run is running, not finished" in line for line in lines)


@pytest.mark.long
@pytest.mark.parametrize("folder", ["records", "zoo", "learners", "first", "stress", "policies"])
def test_what_is_committed_keeps_every_rule(folder: str) -> None:
    """Runs of `stress` have 64 final episodes, as their study declares."""
    verdicts = check([RESULTS / folder], RESULTS / folder)
    assert [problem for verdict in verdicts for problem in verdict.problems] == []
