"""Finished runs for the tests of this folder. Pytest's processes share them, and the work."""

import contextlib
import dataclasses
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from filelock import FileLock, Timeout

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import is_finished, run_id
from tests.bench.tiny_run import execute, quiet, tiny_config

LEARNERS = ("standard", "equivariant", "constrained")


@pytest.fixture(scope="session")
def shared(tmp_path_factory, worker_id) -> Path:
    """A folder that all processes share."""
    base = tmp_path_factory.getbasetemp()
    return (base if worker_id == "master" else base.parent) / "shared"


def ensure(config: RunConfig, out: Path, patience: float = -1) -> Path:
    """Execute a run if it is not finished; leave it to another process that does so already.

    Args:
        config: the run.
        out: the shared folder.
        patience: seconds to wait for the other process; -1 for no limit.
    """
    folder = out / run_id(config, {})
    out.mkdir(exist_ok=True)
    with contextlib.suppress(Timeout), FileLock(f"{folder}.lock", patience):
        if not is_finished(folder):
            execute(config, out)
    return folder


@pytest.fixture(scope="session")
def finished(shared, tmp_path_factory) -> tuple[RunConfig, Path]:
    """A finished run: its configuration and folder, which is the process's own."""
    config, own = tiny_config(), tmp_path_factory.mktemp("runs")
    folder = ensure(config, shared)
    for name in ("base", folder.name):
        shutil.copytree(shared / name, own / name)
    return config, own / folder.name


@pytest.fixture(scope="session")
def lend(shared) -> Callable[[Path], Path]:
    """Copies the base policies of tiny runs with seeds 0 and 1 into a folder."""
    from symsteer.bench.runs.base_policy import prepare_base

    bases = shared.with_name("bases")
    with FileLock(f"{bases}.lock"):
        for seed in (0, 1):
            prepare_base(tiny_config(seed=seed), quiet(runs=bases))
    return lambda out: shutil.copytree(bases / "base", out / "base")


@pytest.fixture(scope="session")
def broken(shared) -> dict[str, Path]:
    """Finished runs of agents of all kinds in a broken world: folders by agent."""
    return in_broken_world(shared, [*LEARNERS, "base", "zero", "golden-ticket"])


@pytest.fixture(scope="session")
def every(shared) -> dict[str, Path]:
    """The same of every agent; for tests with the mark `long`."""
    from symsteer.agents import AGENTS

    return in_broken_world(shared, AGENTS.builtin)


def in_broken_world(shared: Path, agents: Iterable[str]) -> dict[str, Path]:
    """A finished run of each agent in a broken world, beside an unbroken one: folders by agent."""
    # Long enough for a training episode to end.
    usual = tiny_config().evaluation
    evaluation = dataclasses.replace(usual, every=240, stochastic_episodes=2)
    change = {"variant": "action_gain:0.5", "env_steps": 240, "evaluation": evaluation}
    configs = {name: tiny_config(agent=name, **change) for name in agents}
    ensure(tiny_config(), shared)  # with the base policy of all
    for patience in (0, -1):  # first those that no other process executes
        for config in configs.values():
            ensure(config, shared, patience)
    return {name: shared / run_id(config, {}) for name, config in configs.items()}
