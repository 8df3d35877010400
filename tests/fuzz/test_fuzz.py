"""A thousand damaged inputs: one clear sentence and exit code 2, or rightly accepted."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.fuzz.judge import BadEndingError
from tests.fuzz.kinds import KINDS

SHARE = 0.15
"""Of the inputs, how many are tried by default."""


def tried(workshop, kind, numbers, folder):
    """How the inputs of these numbers ended; all that ended badly are told at once."""
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
    count = round(SHARE * KINDS[kind][1])
    endings = tried(workshop, kind, range(count), tmp_path)
    assert endings["refused"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_all_damaged_inputs(kind, workshop, tmp_path, capsys):
    count = KINDS[kind][1]
    endings = tried(workshop, kind, range(count), tmp_path)
    with capsys.disabled():
        print(f"\n{kind}: {count} inputs, " + ", ".join(f"{n} {k}" for k, n in endings.items()))


def test_there_are_a_thousand():
    assert sum(count for _, count in KINDS.values()) == 1000
