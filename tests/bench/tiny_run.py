"""A tiny but complete configuration: everything happens, nothing is learned."""

import json

from symsteer.agents.sac import SacConfig
from symsteer.bench.runs.config import (
    DemonstrationConfig,
    EvaluationConfig,
    PolicyConfig,
    RunConfig,
)


def tiny_config(**changes) -> RunConfig:
    values = {
        "agent": "equivariant",
        "env_steps": 320,
        "num_envs": 4,
        "demonstrations": DemonstrationConfig(count=3),
        "policy": PolicyConfig(channels=8, width=16, depth=1, steps=20, batch_size=32, execute=4),
        "sac": SacConfig(width=16, batch_size=16, warmup=16, group="C4"),
        "evaluation": EvaluationConfig(
            every=160, episodes=3, final_episodes=5, diagnostic_episodes=2, steerability_states=2
        ),
    }
    return RunConfig(**{**values, **changes})


def without_clock(folder):
    """The record, but for times and the checkout, which may change while the tests run."""
    data = json.loads((folder / "record.json").read_text())
    for key in ("started", "ended", "wall_clock", "provenance", "continued"):
        del data[key]
    del data["base_policy"]["training_seconds"]
    for evaluation in data["evaluations"]:
        del evaluation["wall_clock"]
    return data
