"""An undisturbed run, with which the runs of sweeps are compared."""

import pytest
import torch

from bench.runs.run import execute
from tests.bench.sweep.cells import LONG


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """The folder of a finished run of ``LONG``, computed with one thread as in a sweep."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return execute(LONG, tmp_path_factory.mktemp("undisturbed"), progress=False)
    finally:
        torch.set_num_threads(threads)
