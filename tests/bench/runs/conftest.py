"""A finished run that the tests of this folder look at."""

from pathlib import Path

import pytest

from bench.runs.config import RunConfig
from tests.bench.tiny_run import tiny_config


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> tuple[RunConfig, Path]:
    """A finished run: its configuration and folder."""
    from bench.runs.run import execute

    config = tiny_config()
    return config, execute(config, tmp_path_factory.mktemp("runs"), progress=False)
