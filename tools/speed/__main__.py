"""Measures speed; docs/speed.md has results.

python -m tools.speed simulation    # against stock ManiSkill and PhysX alone, in five minutes
python -m tools.speed memory        # resident memory over 10,000 steps with resets
python -m tools.speed learner       # an update of each learner, and of Stable-Baselines3
python -m tools.speed decode        # decoding of each base policy
python -m tools.speed runs          # whole runs, alone and in teams: an hour for each repeat
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

import torch
import tyro

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sweep.suite import load_suite
from symsteer.errors import UserError
from symsteer.terminal import complain
from tools.speed import decode as decoding
from tools.speed import learner as learners
from tools.speed import runs as whole_runs
from tools.speed import simulation as simulating


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _devices(device: str) -> tuple[str, ...]:
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError("torch finds no CUDA device here; leave --device out")
    return ("cpu",) if device == "cpu" else ("cpu", "cuda")


def simulation(
    task: str = "PickCube-v1",
    num_envs: tuple[int, ...] = (1, 4, 16, 64, 256),
    repeats: int = 5,
    seconds: float = 0.7,
    cores: int = 0,
    json: bool = False,
) -> None:
    """Compare the speed of simulation with stock ManiSkill and with PhysX alone."""
    data = simulating.measure(task, num_envs, repeats, seconds, cores or None, _tell)
    print(simulating.dump(data) if json else simulating.table(data))


def memory(task: str = "PickCube-v1") -> None:
    """Measure how memory grows over 10,000 steps with resets; prints JSON."""
    print(simulating.dump(simulating.memory_growth(task, report=_tell)))


def learner(
    task: str = "PickCube-v1",
    repeats: int = 5,
    agents: tuple[str, ...] = tuple(AGENTS.builtin),
    device: Literal["cpu", "cuda"] = "cpu",
    sbx: Path | None = None,
    json: bool = False,
) -> None:
    """Measure an update of each learner: CPU time, or with a GPU wall-clock time on both.

    With `--sbx PYTHON` also that of SBX (JAX), by a Python that has sbx-rl.
    """
    rows = learners.measure(task, 20, repeats, _tell, agents, _devices(device), sbx)
    print(simulating.dump({"rows": rows}) if json else learners.table(rows))


def decode(
    task: str = "PickCube-v1",
    repeats: int = 5,
    device: Literal["cpu", "cuda"] = "cpu",
    json: bool = False,
) -> None:
    """Measure decoding by each base policy: CPU time, or with a GPU wall-clock time on both."""
    rows = decoding.measure(task, 10, repeats, _tell, devices=_devices(device))
    print(simulating.dump({"rows": rows}) if json else decoding.table(rows))


def runs(
    task: str = "PickCube-v1",
    repeats: int = 1,
    out: Path = Path("runs"),
    before: Path | None = None,
    json: bool = False,
) -> None:
    """Measure the CPU time of whole runs with the default settings; OUT keeps the base policy.

    With `--before CHECKOUT`, of another version, compare both with the settings of the suite
    `second`, in turns.
    """
    agents = ("standard", "equivariant")
    if before is None:
        configs = [RunConfig(task=task, agent=agent) for agent in agents]
        rows = whole_runs.measure(configs, repeats, out, _tell)
    else:
        suite = (c for c in load_suite("second").runs if (c.task, c.variant) == (task, "none"))
        first = {config.agent: config for config in reversed(list(suite))}
        rows = whole_runs.compare(before, [first[a] for a in agents], repeats, out, _tell)
    print(simulating.dump({"rows": rows}) if json else whole_runs.table(rows))


def main(arguments: list[str]) -> int:
    """Measure what the first argument names; returns the exit code."""
    torch.set_num_threads(1)
    measurements = {f.__name__: f for f in (simulation, memory, learner, decode, runs)}
    try:
        tyro.extras.subcommand_cli_from_dict(
            measurements, prog="python -m tools.speed", args=arguments
        )
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
