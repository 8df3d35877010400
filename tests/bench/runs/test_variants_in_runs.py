"""Runs in variants that change training only, or the cost of steps."""

import pytest

from symsteer.bench.runs import evaluator
from symsteer.bench.runs.run import execute
from symsteer.bench.tasks import make, task_class
from symsteer.leaderboard.records import read_record
from symsteer.variant import variant_text
from tests.bench.tiny_run import tiny_config


def test_training_alone_sees_the_wedge_and_bounds_follow_the_costs(finished, monkeypatch):
    """Evaluation uses the full disc, and the costs of both variants; the record says so."""
    _, folder = finished
    made = []

    def noting(task, **kwargs):
        made.append(variant_text(kwargs["variant"]))
        return make(task, **kwargs)

    monkeypatch.setattr(evaluator, "make", noting)
    variant = "spawn_sector:1+directional_reward:0.5"
    config = tiny_config(variant=variant, env_steps=160)
    record = read_record(execute(config, folder.parent, progress=False) / "record.json")
    # Held-out episodes and those that Q is compared with have environments of their own.
    assert made.count(variant) == 1
    assert set(made) == {"directional_reward:0.5", variant}
    assert record.config["variant"] == variant
    assert record.config["evaluation_variant"] == "directional_reward:0.5"
    low, _ = task_class(config.task).feasible_return(
        config.agent_options.gamma, config.policy.execute
    )
    assert record.feasible_q.low == pytest.approx(1.5 * low)
    for evaluation in record.evaluations:
        for cost, length in zip(
            evaluation.episodes.return_, evaluation.episodes.episode_len, strict=True
        ):
            assert -1.5 * length <= cost <= 0
