"""A tiny but complete configuration: everything happens, nothing is learned."""

import dataclasses
import json

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import DemonstrationConfig, EvaluationConfig, RunConfig
from symsteer.policies import POLICIES

AGENT = {
    **{"width": 16, "batch_size": 16, "warmup": 16, "utd": 1.0, "group": "C4"},
    "refit": 16,
    # Episodes that Q is compared with are longer the larger the discount is.
    "gamma": 0.5,
}
POLICY = {"channels": 8, "width": 16, "depth": 1, "steps": 20, "batch_size": 32}


def tiny_config(agent="equivariant", policy_name="edp", options=None, **changes) -> RunConfig:
    """A run of an agent; ``options`` are those of the agent that differ from ``AGENT``."""
    kind = AGENTS.get(agent).Options
    known = {field.name for field in dataclasses.fields(kind)}
    shared = {key: value for key, value in AGENT.items() if key in known}
    values = {
        "agent": agent,
        "agent_options": kind(**{**shared, **(options or {})}),
        "env_steps": 320,
        "num_envs": 4,
        "demonstrations": DemonstrationConfig(count=3),
        "policy_name": policy_name,
        "policy": POLICIES.get(policy_name).Options(**POLICY),
        "evaluation": EvaluationConfig(
            every=160,
            episodes=3,
            final_episodes=5,
            diagnostic_episodes=2,
            final_diagnostic_episodes=4,
            steerability_states=2,
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
