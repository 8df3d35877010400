"""Finished runs for the tests of this folder."""

import contextlib
import dataclasses
from pathlib import Path

import pytest
from filelock import FileLock, Timeout

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import is_finished, run_id
from tests.bench.tiny_run import tiny_config


@pytest.fixture(scope="session")
def finished(tmp_path_factory) -> tuple[RunConfig, Path]:
    """A finished run: its configuration and folder."""
    from symsteer.bench.runs.run import execute

    config = tiny_config()
    return config, execute(config, tmp_path_factory.mktemp("runs"), progress=False)


@pytest.fixture(scope="session")
def broken(tmp_path_factory, worker_id) -> dict[str, Path]:
    """A finished run of every agent in a broken world, beside an unbroken one: folders by agent.

    Pytest's processes share them, and the work.
    """
    from symsteer.agents import AGENTS
    from symsteer.bench.runs.run import execute

    base = tmp_path_factory.getbasetemp()
    out = (base if worker_id == "master" else base.parent) / "every-agent"
    evaluation = dataclasses.replace(tiny_config().evaluation, every=240)
    change = {"variant": "action_gain:0.5", "env_steps": 240, "evaluation": evaluation}
    configs = {name: tiny_config(agent=name, **change) for name in AGENTS.builtin}

    def ensure(config, patience):
        with contextlib.suppress(Timeout), FileLock(f"{out}-{run_id(config, {})}.lock", patience):
            if not is_finished(out / run_id(config, {})):
                execute(config, out, progress=False)

    ensure(tiny_config(), patience=-1)  # with the base policy of all
    for patience in (0, -1):  # first those that no other process executes
        for config in configs.values():
            ensure(config, patience)
    return {name: out / run_id(config, {}) for name, config in configs.items()}
