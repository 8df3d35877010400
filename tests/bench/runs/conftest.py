"""Finished runs for the tests of this folder."""

import dataclasses
from pathlib import Path

import pytest

from symsteer.bench.runs.config import RunConfig
from tests.bench.tiny_run import tiny_config


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> tuple[RunConfig, Path]:
    """A finished run: its configuration and folder."""
    from symsteer.bench.runs.run import execute

    config = tiny_config()
    return config, execute(config, tmp_path_factory.mktemp("runs"), progress=False)


@pytest.fixture(scope="session")
def broken(finished) -> dict[str, Path]:
    """A finished run of every agent in a broken world: folders by agent."""
    from symsteer.agents import AGENTS
    from symsteer.bench.runs.run import execute

    _, folder = finished
    evaluation = dataclasses.replace(tiny_config().evaluation, every=240)
    change = {"variant": "action_gain:0.5", "env_steps": 240, "evaluation": evaluation}
    return {
        name: execute(tiny_config(agent=name, **change), folder.parent, progress=False)
        for name in AGENTS.builtin
    }
