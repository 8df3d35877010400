"""An undisturbed run, with which the runs of sweeps are compared."""

import pytest

from symsteer.bench.runs.run import execute
from tests.bench.sweep.long_run import LONG


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The folder of a finished run of ``LONG``."""
    return execute(LONG, tmp_path_factory.mktemp("undisturbed"), progress=False)
