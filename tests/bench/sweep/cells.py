"""What the tests of sweeps share: a cell worth killing, and what two runs have in common."""

import dataclasses
import json
import time

from tests.bench.tiny_run import tiny_config

_TINY = tiny_config()
LONG = dataclasses.replace(
    _TINY,
    env_steps=480,
    checkpoint_every=120,
    evaluation=dataclasses.replace(_TINY.evaluation, every=240),
)
"""Long enough to be killed behind its first checkpoint."""


def without_clock(folder):
    """The record, but for times and the checkout, which may change while the tests run."""
    data = json.loads((folder / "record.json").read_text())
    for key in ("started", "ended", "wall_clock", "provenance", "continued"):
        del data[key]
    del data["base_policy"]["training_seconds"]
    for evaluation in data["evaluations"]:
        del evaluation["wall_clock"]
    return data


def wait_for(condition, seconds=240.0):
    """Wait until something holds; on a busy machine that may take a while."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
