"""A tiny but complete configuration: everything happens, nothing is learned."""

import dataclasses
import json

import pytest

from symsteer.agents import AGENTS
from symsteer.bench.runs import run
from symsteer.bench.runs.config import (
    DemonstrationConfig,
    EvaluationConfig,
    Execution,
    RunConfig,
)
from symsteer.bench.runs.folder import run_id, state_of
from symsteer.bench.runs.trainer import Trainer
from symsteer.policies import POLICIES

AGENT = {
    **{"width": 16, "batch_size": 16, "warmup": 16, "utd": 1.0, "group": "C4"},
    **{"critics": 2, "distill": "mixture", "distill_steps": 1.0},
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
        # Its search plays whole episodes.
        "env_steps": 240 if agent == "golden-ticket" else 160,
        "num_envs": 4,
        "demonstrations": DemonstrationConfig(count=3),
        "policy_name": policy_name,
        "policy": POLICIES.get(policy_name).Options(**POLICY),
        "evaluation": EvaluationConfig(
            every=160,
            episodes=3,
            final_episodes=3,
            diagnostic_episodes=2,
            final_diagnostic_episodes=2,
            steerability_states=2,
        ),
    }
    return RunConfig(**{**values, **changes})


def execute(config, out, **options):
    """Execute a run without progress bars; further options of an `Execution` as keywords."""
    return run.execute(config, quiet(runs=out, **options))


def resume(folder, **options):
    """Continue a run without progress bars."""
    return run.execute(folder, quiet(**options))


def quiet(**options) -> Execution:
    """How a run is executed, without progress bars if nothing else is said."""
    return Execution(**{"quiet": True, **options})


def stop(config, out, env_steps, **options):
    """Execute a run until after the evaluation at a step or later, which is in no checkpoint."""
    evaluate = Trainer.evaluate

    def evaluate_and_stop(self, final=False):
        evaluate(self, final)
        if self.env_steps >= env_steps:
            raise RuntimeError("stopped")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "evaluate", evaluate_and_stop)
        with pytest.raises(RuntimeError, match="stopped"):
            execute(config, out, **options)
    folder = out / run_id(config, {})
    assert state_of(folder) == "failed"
    return folder


def write_suite(tmp_path, config: RunConfig, grid: str) -> str:
    """A suite file of which every run is ``config`` but for the grid."""
    lines = [f"[grid]\n{grid}\n[run]"]
    settings = config.to_json()
    settings["agent"] = {"name": settings["agent"], **settings.pop("agent_options")}
    for key, value in settings.items():
        if isinstance(value, dict):
            items = {name: item for name, item in value.items() if item is not None}
            lines += [f"{key}.{name} = {json.dumps(item)}" for name, item in items.items()]
        elif key not in grid:
            lines.append(f"{key} = {json.dumps(value)}")
    path = tmp_path / "tiny.toml"
    path.write_text("\n".join(lines))
    return str(path)


def without_clock(folder):
    """The record, but for times and the checkout, which may change while the tests run."""
    data = json.loads((folder / "record.json").read_text())
    for key in ("started", "ended", "wall_clock", "provenance", "continued"):
        del data[key]
    del data["base_policy"]["training_seconds"]
    for evaluation in data["evaluations"]:
        del evaluation["wall_clock"]
    return data
