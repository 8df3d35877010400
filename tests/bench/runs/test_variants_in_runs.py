"""Runs in variants that change training only, the cost of steps, or with time."""

import pytest

from symsteer.bench.runs import evaluator
from symsteer.bench.runs.observers import TerminalProgress
from symsteer.bench.tasks import make, task_class
from symsteer.leaderboard.records import read_record
from symsteer.variant import variant_text
from tests.bench.tiny_run import execute, tiny_config


@pytest.fixture
def made(monkeypatch):
    """The number and the variant of all environments that are made."""
    noted = []

    def noting(task, **options):
        noted.append((options["num_envs"], variant_text(options["variant"])))
        return make(task, **options)

    monkeypatch.setattr(evaluator, "make", noting)
    return noted


def test_training_alone_sees_the_wedge_and_bounds_follow_the_costs(finished, made):
    """Evaluation uses the full disc, and the costs of both variants; the record says so."""
    _, folder = finished
    variant = "spawn_sector:1+directional_reward:0.5"
    config = tiny_config(variant=variant)
    record = read_record(execute(config, folder.parent) / "record.json")
    # Held-out episodes and those that Q is compared with have environments of their own.
    variants = [text for _, text in made]
    assert variants.count(variant) == 1
    assert set(variants) == {"directional_reward:0.5", variant}
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


def test_the_world_may_break_in_the_course_of_a_run(finished, made, monkeypatch):
    """At the given shares of the budget, all environments begin in a new world."""
    _, folder = finished
    begun, evaluated = [], []

    class Noting(TerminalProgress):
        def paused(self, run):
            begun.append(run.env_steps)

        def evaluated(self, run, evaluation):
            super().evaluated(run, evaluation)
            evaluated.append((run.env_steps, variant_text(run.evaluator.variants)))

    monkeypatch.setattr("symsteer.bench.runs.run.TerminalProgress", Noting)
    config = tiny_config(
        variant="action_gain:1@0.25..0.75+wind:0.5@0.5", env_steps=320, checkpoint_every=28
    )
    record = read_record(execute(config, folder.parent) / "record.json")
    # 28 steps of 4 environments, and the ends of the ramp at 80 and 240, and the step at 160.
    assert begun == [80, 160, 240, 320]
    training = [text for count, text in made if count == config.num_envs]
    half, whole = "action_gain:0.5+wind:0.5", "action_gain:1+wind:0.5"
    assert list(dict.fromkeys(training)) == ["none", half, whole]
    assert evaluated == [(0, "none"), (160, "none"), (320, whole)]
    assert record.config["variant"] == config.variant
    assert record.config["evaluation_variant"] == whole
