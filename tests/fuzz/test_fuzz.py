"""A thousand damaged inputs: each is refused in one clear sentence, or rightly accepted."""

from __future__ import annotations

import resource
import shutil
from collections import Counter
from random import Random

import pytest

from tests.fuzz.judge import BadEndingError
from tests.fuzz.kinds import KINDS
from tests.fuzz.sealed import SEALED, in_child

WAYS = {
    "suite": ("suite", 10),
    "config": ("config", 10),
    "command": ("command", 8),
    "demonstrations": ("demos", 8),
    "policy": ("policy", 6),
    "checkpoint": ("checkpoint", 8),
    "bundle": ("bundle", 6),
}
"""Prefix of the seeds, and number of ways to damage: the first draw chooses the way."""


def default_numbers(kind):
    """A few inputs of a kind: one for each way to damage it."""
    if kind not in WAYS:
        return range(4)
    prefix, ways = WAYS[kind]
    first = {}
    for number in range(KINDS[kind][1]):
        first.setdefault(Random(f"{prefix} {number}").randrange(ways), number)
    assert len(first) == ways
    return sorted(first.values())


@pytest.fixture(autouse=True)
def little_memory():
    """A damaged size may ask for any amount; the machine and other tests shall not suffer."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (8 * 2**30, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_DATA, before)


def tried(workshop, kind, numbers, folder):
    """How the inputs of these numbers ended; reports all bad endings together."""
    run, _ = KINDS[kind]
    endings, failures = Counter(), []
    for number in numbers:
        place = folder / str(number)
        place.mkdir()
        try:
            endings[run(workshop, number, place).kind] += 1
        except BadEndingError as error:
            failures.append(f"{kind} {number}: {error}")
    assert not failures, f"{len(failures)} of {len(numbers)}:\n" + "\n".join(failures)
    return endings


@pytest.mark.parametrize("kind", KINDS)
def test_some_damaged_inputs(kind, workshop, tmp_path):
    endings = tried(workshop, kind, default_numbers(kind), tmp_path)
    assert endings["refused"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_all_damaged_inputs(kind, workshop, tmp_path, capsys):
    count = KINDS[kind][1]
    endings = tried(workshop, kind, range(count), tmp_path)
    with capsys.disabled():
        print(f"\n{kind}: {count} inputs, " + ", ".join(f"{n} {k}" for k, n in endings.items()))


def tried_in_children(workshop, kind, count, folder):
    """The same for files whose checksums are right; none takes a GiB more than the intact one."""
    run, endings, failures = SEALED[kind], Counter(), []
    (folder / "intact").mkdir()
    ended, sentence, usual = in_child(lambda: run(workshop, None, folder / "intact"))
    assert ended in ("accepted", "done"), sentence
    for number in range(count):
        place = folder / str(number)
        place.mkdir()
        random = Random(f"sealed {kind} {number}")
        ended, sentence, peak = in_child(lambda r=random, p=place: run(workshop, r, p))
        endings[ended] += 1
        if ended == "failed" or peak > usual + 2**30:
            failures.append(f"{kind} {number} ({peak - usual} bytes more): {ended} {sentence}")
        shutil.rmtree(place)
    assert not failures, f"{len(failures)} of {count}:\n" + "\n".join(failures)
    return endings


@pytest.mark.parametrize("kind", SEALED)
def test_some_wrong_contents(kind, workshop, tmp_path):
    tried_in_children(workshop, kind, 4, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SEALED)
def test_three_hundred_wrong_contents(kind, workshop, tmp_path, capsys):
    endings = tried_in_children(workshop, kind, 300, tmp_path)
    assert endings["refused"] > 100
    with capsys.disabled():
        print(f"\n{kind}: 300 inputs, " + ", ".join(f"{n} {k}" for k, n in endings.items()))


def test_there_are_a_thousand():
    assert sum(count for _, count in KINDS.values()) == 1000
