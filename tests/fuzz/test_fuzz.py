"""A thousand damaged inputs: each is refused in one clear sentence, or rightly accepted."""

from __future__ import annotations

import contextlib
import re
import resource
import shutil
import signal
from collections import Counter
from pathlib import Path

import pytest

from tests.fuzz.judge import BadEndingError
from tests.fuzz.kinds import KINDS
from tests.marks import need

COUNT = 100
"""Inputs of a kind in the whole test."""

SECONDS = 60
"""The longest that reading a damaged file may take: a limit for hangs."""

GIGABYTES = 2
"""The most that it may take."""


@pytest.fixture(autouse=True)
def limits():
    """A damaged size may ask for any amount; the machine and other tests shall not suffer."""
    used = int(re.search(r"VmData:\s*(\d+) kB", Path("/proc/self/status").read_text())[1]) * 1024
    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (used + GIGABYTES * 2**30, before[1]))

    def hangs(number, frame):
        raise BadEndingError(f"it takes longer than {SECONDS} s")

    handler = signal.signal(signal.SIGALRM, hangs)
    yield
    signal.signal(signal.SIGALRM, handler)
    resource.setrlimit(resource.RLIMIT_DATA, before)


def tried(workshop, run, numbers, folder):
    """How the inputs of these numbers ended; reports all bad endings together."""
    endings, failures = Counter(), []
    for number in numbers:
        place = folder / str(number)
        place.mkdir()
        signal.alarm(SECONDS)
        try:
            with contextlib.chdir(place):
                endings[run(workshop, number, place).kind] += 1
            assert not list(place.rglob("sprung")), "code in a file was executed"
        except AssertionError as error:
            failures.append(f"{number}: {error}")
        signal.alarm(0)
        shutil.rmtree(place)
    assert not failures, f"{len(failures)} of {len(numbers)}:\n" + "\n".join(failures)
    return endings


@pytest.mark.parametrize("kind", KINDS)
def test_some_damaged_inputs(kind, workshop, tmp_path):
    """Each way to damage a file once; the intact one is accepted."""
    if kind == "plan":
        need("tune")
    assert tried(workshop, KINDS[kind], [None], tmp_path).keys() < {"accepted", "done"}
    numbers = range(max(2, len(KINDS[kind].ways)))
    assert tried(workshop, KINDS[kind], numbers, tmp_path)["refused"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_all_damaged_inputs(kind, workshop, tmp_path, capsys):
    if kind == "plan":
        need("tune")
    endings = tried(workshop, KINDS[kind], range(COUNT), tmp_path)
    with capsys.disabled():
        print(f"\n{kind}: {COUNT} inputs, " + ", ".join(f"{n} {k}" for k, n in endings.items()))
