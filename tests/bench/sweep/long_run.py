"""What the tests of sweeps share: a run that is long enough to be killed, and waiting."""

import dataclasses
import time

from tests.bench.tiny_run import tiny_config

_TINY = tiny_config()
LONG = dataclasses.replace(
    _TINY,
    env_steps=320,
    checkpoint_every=30,
    evaluation=dataclasses.replace(_TINY.evaluation, every=320),
)
"""Long enough to be killed after its first checkpoint."""


def wait_for(condition, seconds=240.0):
    """Wait until a condition holds; on a busy machine that may take long."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
