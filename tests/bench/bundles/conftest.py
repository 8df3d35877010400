"""A finished run, and what is taken away of it."""

from pathlib import Path

import pytest

from symsteer.bench.bundles.bundle import write_bundle
from tests.bench.tiny_run import execute, tiny_config


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Path:
    """The folder of a finished run."""
    return execute(tiny_config(agent="zero"), tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="session")
def bundle(run, tmp_path_factory) -> Path:
    """Its base policy and demonstrations as a bundle."""
    path = tmp_path_factory.mktemp("bundle") / "all.zip"
    _, absent = write_bundle(run, path)
    assert absent is None
    return path
