"""What a user sees: verbs, and one sentence with exit code 2 for each mistake."""

import ast
import fcntl
import functools
import importlib
import itertools
import os
import pty
import re
import shlex
import struct
import subprocess
import sys
import termios
import typing
from collections import defaultdict
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path

import h5py
import pytest

import symsteer as symsteer_package
from symsteer import bench
from symsteer.bench import cli
from symsteer.bench.demos import collect
from symsteer.bench.runs.brief import COMMON
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.sweep.survey import look
from symsteer.bench.sweep.workforce import Workforce
from symsteer.bench.tasks import task_class
from symsteer.cli import GROUPS, VERBS, _threads, main
from symsteer.hints import _ELSEWHERE, _OPTIONS
from symsteer.leaderboard.records import Episodes, write_record
from symsteer.policies.files import save_policy
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions
from tests.leaderboard.record_factory import make_evaluation, make_record


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect("PickCube-v1", "floating", 2, "clean", 0, tmp_path_factory.mktemp("d") / "a.h5")


def refused(command, *words) -> str:
    """The one line on stderr about a mistake."""
    code, shown = command(*words)
    assert code == 2
    (line,) = shown.err.strip().splitlines()
    assert line.startswith("error: ")
    return line


RUN = ("run", "--quiet")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((*RUN, "--embodiment", "hand"), "floating, panda"),
        ((*RUN, "--agent.group", "E8"), "C8"),
        ((*RUN, "--agent.preset", "frist"), "did you mean 'first'"),
        ((*RUN, "--policy.name", "plian"), "did you mean 'plain'"),
        ((*RUN, "--env-steps", "0"), "env_steps: Input should be greater than"),
        ((*RUN, "--seed", str(2**32)), "seed: Input should be less than"),
        ((*RUN, "--agent", "residual-pathway", "--agent.penalty", "inf"), "penalty is inf"),
        (("demos", "/proc/nowhere/a.h5"), "/proc/nowhere cannot be written"),
        (("demos", "a.h5", "--seed", "-1"), "seed"),
        (("demos", "a.txt"), ".h5"),
        (("demos", "a.h5", "--count", "0"), "at least 1"),
        (("sweep", "smoke", "--runs", "/proc/nowhere"), "/proc/nowhere"),
        (("sweep", "dmeo"), "demo"),
    ],
)
def test_mistakes(arguments, words, command, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert words in refused(command, *arguments)
    assert not any(tmp_path.rglob("record.json"))


def test_the_brief_help_of_run_has_options_of_the_whole_one(command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    briefly, whole = (command("run", *words)[1].out for words in (["--help"], ["--help", "all"]))
    assert len(briefly.splitlines()) <= 50
    assert max(map(len, briefly.splitlines())) <= 100
    listed = re.findall(r"^  (--\S+) .*\S", briefly, re.MULTILINE)
    assert listed == [f"--{name}" for name in COMMON]
    assert [name for name in listed if not re.search(rf"{name}[ ,]", whole)] == []
    assert "--agent.gamma" in whole


def cut_off(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 3])


def with_nan(path):
    with h5py.File(path, "r+") as file:
        file["traj_0/actions"][0, 0] = float("nan")


@pytest.mark.parametrize(
    ("damage", "task", "words"),
    [
        (lambda path: None, "PushCube-v1", "PickCube-v1"),
        (cut_off, "PickCube-v1", "truncated"),
        (with_nan, "PickCube-v1", "bad.h5"),
    ],
)
def test_demonstrations_that_do_not_fit(damage, task, words, demos, command, tmp_path):
    bad = tmp_path / "bad.h5"
    for suffix in (".h5", ".json"):
        bad.with_suffix(suffix).write_bytes(demos.with_suffix(suffix).read_bytes())
    damage(bad)
    arguments = ("--task", task, "--demos", bad, "--demonstrations.count", 2)
    assert words in refused(command, *RUN, *arguments, "--runs", tmp_path / "runs")
    assert not (tmp_path / "runs").is_dir() or not any((tmp_path / "runs").iterdir())


def test_a_checkpoint_of_another_layout(command, tmp_path):
    task = task_class("PushCube-v1")
    options = EquivariantOptions(channels=8, width=16, depth=1)
    policy = EquivariantDiffusionPolicy(options, task.observation_layout, task.action_layout)
    path = save_policy(policy, tmp_path / "push.safetensors")
    words = refused(command, *RUN, "--base-policy", path, "--runs", tmp_path / "runs")
    assert "observation layout" in words


def test_what_verbs_print(command, tmp_path):
    for arguments in ((), ("--help",)):
        code, shown = command(*arguments)
        assert code == 0
        assert re.findall(r"^(\w.*):$", shown.out, re.MULTILINE) == list(GROUPS)
        assert re.findall(r"^  ([\w-]+) ", shown.out, re.MULTILINE) == list(VERBS)
    _, shown = command("--version")
    assert shown.out == f"symsteer {version('symsteer')}\n"
    _, shown = command("list")
    lines = {line.split()[0]: line for line in shown.out.splitlines() if line.startswith("  ")}
    for word in ("StackCube-v1", "panda", "action_gain", "residual-pathway", "plain", "demo"):
        assert len(lines[word].split()) > 3, word
    code, shown = command("doctor")
    assert code == 0
    assert "CUDA" in shown.out
    push = ("--task", "PushCube-v1", "--count", 2, "--mode", "clean")
    code, shown = command("demos", tmp_path / "push.h5", *push)
    assert code == 0
    assert "wrote 2 demonstrations" in shown.out
    assert (tmp_path / "push.json").is_file()


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb != "run"])
def test_every_verb_has_help(verb, command):
    code, shown = command(verb, "--help")
    assert code == 0
    assert f"usage: symsteer {verb} " in shown.out


@pytest.mark.parametrize("arguments", [["--help"], ["list"], ["sweep", "--help"], ["run", "-h"]])
def test_names_and_help_cost_no_import_of_torch_or_maniskill(arguments):
    program = (
        "import sys; from symsteer.cli import main; "
        f"sys.argv = ['symsteer', *{arguments!r}]\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'mani_skill', 'sapien', 'pandas'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_commands_can_be_pasted(command, capsys, tmp_path):
    out = tmp_path / "my runs; x$(y)'s"
    out.mkdir()
    _, shown = command("status", out)
    assert shlex.split(shown.out.partition("start some: ")[2]) == [
        "symsteer",
        "sweep",
        "SUITE",
        "--runs",
        str(out),
    ]
    write_record(make_record(), out / "run" / "record.json")
    bench.cli._print_places(out / "run")
    board, page = capsys.readouterr().out.splitlines()[1:]
    assert shlex.split(board)[1:4] == ["tensorboard", "--logdir", str(out)]
    expected = ["symsteer", "report", str(out), "--out", str(out / "leaderboard")]
    assert shlex.split(page)[1:] == expected
    _, shown = command("new", "agent", "mine", "--out", out)
    move = next(line for line in shown.out.splitlines() if line.startswith("cd "))
    assert shlex.split(move) == ["cd", str(out)]


COMMAND = re.compile(r"(symsteer [a-z][a-z-]+|tensorboard|\bcd)( [\w.-]+)* $")


def test_no_command_has_words_that_are_not_quoted():
    """In no text of the source a value follows the words of a command, but one of to_paste."""
    root = Path(symsteer_package.__file__).parents[1]
    files = [f for f in root.glob("[!.]*/**/*.py") if f.parts[len(root.parts)] != "tests"]
    found = []
    for file in files:
        for node in ast.walk(ast.parse(file.read_bytes())):
            parts = node.values if isinstance(node, ast.JoinedStr) else []
            for before, value in itertools.pairwise(parts):
                text = before.value if isinstance(before, ast.Constant) else ""
                if COMMAND.search(str(text)) and isinstance(value, ast.FormattedValue):
                    found.append(f"{file}:{value.lineno}")
    assert (len(files) > 200, found) == (True, [])


@pytest.mark.parametrize(("verb", "now"), [("base", "sweep policies"), ("detect", "audit")])
def test_a_removed_verb_names_what_does_it_now(verb, now, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["symsteer", verb, "anything"])
    assert main() == 2
    assert f"the verb {verb!r} was removed in version 0.3.0; `symsteer {now}`" in (
        capsys.readouterr().err
    )


@pytest.mark.long
def test_a_class_in_the_present_folder_can_be_tried(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from symsteer.agents.references import ZeroAgent\n"
        "class Mine(ZeroAgent):\n    name = 'mine'\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-m", "symsteer", "run", "--agent", "mine:Mine", "--help", "all"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "mine:Mine" in done.stdout


def run_cli(arguments, **how):
    words = [sys.executable, "-m", "symsteer", *arguments]
    return subprocess.run(words, text=True, timeout=120, check=False, **how)


def test_a_reader_that_has_seen_enough_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "wb") as output:
        done = run_cli(["list"], stdout=output, stderr=subprocess.PIPE)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.parametrize(
    ("arguments", "full", "code", "words"),
    [
        (["list"], ["stdout"], 2, "error: the output cannot be written: No space"),
        (["status", "--help"], ["stderr"], 0, ""),
        (["swep"], ["stdout"], 2, "error: there is no verb 'swep'; did you mean 'sweep'?"),
        (["x"], ["stdout", "stderr"], 2, ""),
    ],
)
def test_a_full_device_is_one_sentence(arguments, full, code, words):
    with open("/dev/full", "wb") as device:
        streams = dict.fromkeys(("stdout", "stderr"), subprocess.PIPE) | dict.fromkeys(full, device)
        done = run_cli(arguments, **streams)
    assert done.returncode == code
    if "stderr" not in full:
        assert done.stderr.startswith(words)
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("arguments", "columns"), [(["list"], None), (["film", "--help"], "1")])
def test_a_narrow_terminal_has_help(arguments, columns):
    """Its width is in COLUMNS, or the system says it."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("4H", 1, 1, 0, 0))
    variables = {k: v for k, v in os.environ.items() if k != "COLUMNS"}
    variables |= {"COLUMNS": columns} if columns else {}
    how = {"stdin": theirs, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": variables}
    done = run_cli(arguments, **how)
    os.close(ours)
    os.close(theirs)
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout.splitlines()) > 10


@pytest.mark.parametrize(("wanted", "threads"), [("", 1), ("3", 3), ("2,1", 2), ("0", 1), ("x", 1)])
def test_numbers_of_threads(wanted, threads):
    assert _threads(wanted) == threads


def test_the_end_of_a_run_and_status_say_what_was_not_finite(tmp_path, capsys):
    last = make_evaluation([1, 0], 320)
    columns = {**last.episodes.model_dump(by_alias=True), "return": [float("nan"), -1.0]}
    last = last.model_copy(update={"episodes": Episodes.model_validate(columns)})
    for evaluation, words in ((last, "return (first after 320 steps)"), (None, "")):
        record = make_record(evaluation and [evaluation])
        (tmp_path / "record.json").unlink(missing_ok=True)
        write_record(record, tmp_path / "record.json")
        cli._print_places(tmp_path)
        place = tmp_path / "record.json"
        expected = f"warning: not finite: {words}; see {place}\n" if words else ""
        assert capsys.readouterr().err == expected
        assert look(tmp_path).success.endswith(f", not finite: {words}" if words else "of 5")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((*RUN, "--total-timesteps", "1000000"), "--env-steps"),
        ((*RUN, "--env-id=PickCube-v1"), "--task"),
        ((*RUN, "--n_envs", "16"), "--num-envs"),
        ((*RUN, "--learning-rate", "3e-4"), "--agent.lr"),
        ((*RUN, "--agent", "sac"), "there is no agent 'sac'; all learners here are soft actor"),
        ((*RUN, "--agent", "ppo"), "`symsteer new agent`"),
        ((*RUN, "--policy.name", "dp"), "'plain' is a diffusion policy"),
        ((*RUN, "--agent.critic", "2"), "--agent.critic-kind"),
        ((*RUN, "--workers", "2"), "--sim-workers"),
        (("sweep", "smoke", "--out", "runs"), "--runs"),
        (("train",), "`symsteer run`"),
    ],
)
def test_words_of_other_software_get_the_name_here(arguments, words, command):
    line = refused(command, *arguments)
    assert words in line
    assert "did you mean" not in line


ROOT = Path(symsteer_package.__file__).parents[1]


@functools.cache
def options_by_name():
    """The kinds of value of every option, by its name, and the verbs that have it."""
    kinds, verbs = defaultdict(set), defaultdict(set)
    for verb, target in ((name, verb.target) for name, verb in VERBS.items()):
        module, _, attribute = target.partition(":")
        function = getattr(importlib.import_module(module), attribute)
        hints = typing.get_type_hints(function)
        if verb == "run":
            hints = {field.name: field.type for field in fields(Execution)}
        if "workforce" in hints:
            hints |= typing.get_type_hints(Workforce)
        for name, hint in hints.items():
            parts = re.findall(r"\b(?:bool|int|float|str|Path)\b", str(hint))
            option = "--" + name.replace("_", "-")
            kinds[option].add(parts[0] if parts else str(hint))
            verbs[option].add(verb)
    return kinds, verbs


def test_an_option_takes_the_same_kind_of_value_in_all_verbs():
    kinds, _ = options_by_name()
    assert {name: found for name, found in kinds.items() if len(found) > 1} == {}


def test_no_hint_is_about_an_option_that_there_is():
    _, verbs = options_by_name()
    foreign = {option for words in _OPTIONS for option in words.split()}
    assert not foreign & set(verbs)
    for option, (refusing, _) in _ELSEWHERE.items():
        assert not verbs[option] & set(refusing.split())


PAGES = [
    *(page for page in (ROOT / "docs").rglob("*.md") if page.name != "detect.md"),  # of 0.2.0
    *(ROOT / "examples").rglob("*.md"),
    *(ROOT / "agents" / "templates").glob("*.txt"),
    ROOT / "README.md",
    ROOT / ".ci" / "end-to-end",
]

TYPED = re.compile(r"symsteer ([a-z][a-z-]+)((?: [^\s`#|>]+)*)")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_documentation_types_options_that_the_verb_has(page):
    _, verbs = options_by_name()
    config = {field.name.replace("_", "-") for field in fields(RunConfig)}
    unknown = []
    for verb, words in TYPED.findall(page.read_text().replace("\\\n", " ")):
        for option in re.findall(r"--[\w.-]+", words):
            known = verb in verbs[option.replace("--no-", "--")] or option == "--help"
            known |= verb == "run" and ("." in option or option[2:] in config)
            if verb in VERBS and not known:
                unknown.append(f"{verb} {option}")
    assert unknown == []
