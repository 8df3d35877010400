"""An undisturbed run, with which the runs of sweeps are compared."""

import pytest

from tests.bench.sweep.long_run import LONG
from tests.bench.tiny_run import execute


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The folder of a finished run of ``LONG``."""
    return execute(LONG, tmp_path_factory.mktemp("undisturbed"))
