"""A tuning plan for tests, and runs whose success is a known function of the options."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.bench.sweep.plan import Plan
from symsteer.bench.sweep.schedule import EndedRun
from symsteer.bench.sweep.workforce import Workforce
from symsteer.leaderboard.records import write_record
from tests.leaderboard.record_factory import make_evaluation, make_record

TEXT = """
description = "for tests"
agents = ["standard", "equivariant"]
trials = 12
batch = 3
probe = 1

[grid]
seed = [1]
variant = ["none", "action_gain:1"]

[confirm]
seed = [2, 3]

[run]
env_steps = 20_000

[start]
lr = 6e-4
batch_size = 64
critics = 2

[space]
lr = { low = 1e-4, high = 1e-1, log = true }
batch_size = [32, 64]

[space.equivariant]
critics = { low = 2, high = 6 }
"""

BEST = {"standard": 1e-2, "equivariant": 2e-3}
"""The learning rate with the highest success."""


def write_plan(folder: Path, text: str = TEXT, name: str = "tiny") -> str:
    """The path of a plan."""
    path = folder / f"{name}.toml"
    path.write_text(text)
    return str(path)


class KnownRuns:
    """Executes plans at once: success falls with the distance of lr from the best one.

    Args:
        stop_after: number of runs after which the process is interrupted.
        failing: learning rates above this fail.
    """

    def __init__(self, stop_after: int | None = None, failing: float = math.inf):
        self.left, self.failing = stop_after, failing
        self.played: list[str] = []

    def __call__(self, plan: Plan, workforce: Workforce) -> list[EndedRun]:
        ends = []
        for run, config in plan.configs.items():
            folder = plan.out / run_id(config, {})
            if (folder / RECORD).is_file():
                continue
            if self.left is not None and len(self.played) >= self.left:
                raise KeyboardInterrupt
            options = config.agent_options
            if options.lr > self.failing:
                ends.append(EndedRun(run, "failed", "Q is not finite"))
                continue
            distance = abs(math.log10(options.lr / BEST[config.agent]))
            rate = max(0.0, 0.9 - 0.3 * distance - 0.1 * (config.variant != "none"))
            draws = np.arange(100) < round(100 * rate)
            record = make_record(
                [make_evaluation(draws, env_steps=0, final=False), make_evaluation(draws, 20_000)],
                agent=config.agent,
                seed=config.seed,
                variant=config.variant,
                env_steps=20_000,
            )
            folder.mkdir(parents=True)
            write_record(record, folder / RECORD)
            self.played.append(folder.name)
            ends.append(EndedRun(run, "finished"))
        return ends
