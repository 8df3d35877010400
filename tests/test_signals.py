"""Ctrl-C and SIGTERM at any time: one sentence, the right exit code, and nothing is lost."""

from __future__ import annotations

import os
import shutil
import signal
import time
from pathlib import Path

import pytest

from symsteer.bench.runs.folder import RECORD, read_config
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import tiny_config, without_clock, write_suite
from tests.children import start
from tests.fuzz.kinds import options_of

WATCH = """
import os, sys
wanted = os.environ.pop("SIGNAL_AT", "")  # child processes are left alone
number, log = int(os.environ.pop("SIGNAL", 0)), os.environ.pop("MODULES", "")

def look(event, args):
    global wanted
    if event == "import" and args[0] == wanted:
        wanted = None
        os.kill(os.getpid(), number)
    elif event == "import" and log:
        with open(log, "a") as file:
            file.write(args[0] + "\\n")

sys.addaudithook(look)
"""
"""Sends a signal when a module is about to be imported, or lists the modules."""

WORDS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}

CONFIG = tiny_config(agent="equivariant", env_steps=320, checkpoint_every=20)


@pytest.fixture(scope="module", params=["run", "sweep"])
def program(request, tmp_path_factory):
    """Arguments of a verb, its modules in the order of their imports, seconds, and its record."""
    place = tmp_path_factory.mktemp(request.param)
    arguments = ["run", *options_of(CONFIG)]
    if request.param == "sweep":
        suite = write_suite(place, CONFIG, 'agent = ["equivariant"]')
        arguments = ["sweep", suite, "--workers", "1"]
    begin = time.monotonic()
    child = start(*arguments, watch=WATCH, cwd=place, MODULES=str(place / "modules"))
    _, errors = child.communicate(timeout=300)
    assert child.returncode == 0, errors
    modules = (place / "modules").read_text().split()
    modules = list(dict.fromkeys(modules[modules.index("symsteer.launch") + 1 :]))
    (folder,) = (path.parent for path in (place / "runs").glob("*/record.json"))
    return arguments, modules, time.monotonic() - begin, folder


def interrupted(program, place: Path, index: int, of: int) -> int:
    """Give a signal in the ``index``-th of ``of`` parts of the program's life; its exit code."""
    arguments, modules, seconds, _ = program
    number = (signal.SIGINT, signal.SIGTERM)[index % 2]
    code, word = WORDS[number]
    by_module = index // 2 % 2 == 0
    where = modules[index * len(modules) // of] if by_module else f"{index / of:.0%} of its time"
    at = {"SIGNAL_AT": where, "SIGNAL": str(int(number))} if by_module else {}
    place.mkdir()
    child = start(*arguments, watch=WATCH, cwd=place, **at)
    if not by_module:
        time.sleep(0.2 + seconds * index / of)  # the interpreter starts first
        os.kill(child.pid, number)
    output, errors = child.communicate(timeout=120)
    assert "Traceback" not in output + errors, (where, errors)
    ended = (child.returncode, errors.splitlines().count(word))
    # Done before the signal came, or without this module.
    assert ended in ((code, 1), (0, 0)), (where, errors)
    for path in (place / "runs").rglob("*"):
        assert not path.name.endswith(".tmp"), (where, path)
        if path.name == RECORD:
            read_config(path.parent)
            read_record(path)
    return child.returncode


@pytest.mark.long
def test_a_signal_ends_the_program_with_one_sentence(program, tmp_path):
    """One before the work begins, at an import, and one in the middle of it.

    If the machine has become faster, the program has ended: the next signal comes earlier.
    """
    for index in (4, 7):
        places = (tmp_path / f"{index}-{parts}" for parts in (12, 24, 48))
        assert any(interrupted(program, place, index, int(place.name[2:])) for place in places)


@pytest.mark.slow
def test_signals_at_any_time_lose_nothing(program, tmp_path):
    """A hundred over the life of each program; each tenth time it goes on, with its own record."""
    for index in range(100):
        place = tmp_path / str(index)
        if interrupted(program, place, index, 100) and index % 10 == 5:
            child = start(*program[0], watch="", cwd=place)
            child.communicate(timeout=300)
            whole = program[3]
            assert without_clock(place / "runs" / whole.name) == without_clock(whole)
        shutil.rmtree(place)
