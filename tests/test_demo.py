"""What `symsteer demo` needs comes with SymSteer; packaging tests see that the wheel has it."""

import pytest

from symsteer.bench.runs.base_policy import find_base
from symsteer.bench.sweep.suite import load_suite
from symsteer.demo import copy_base
from symsteer.errors import UserError
from symsteer.leaderboard import paths
from symsteer.leaderboard.rows import MIN_SEEDS


def test_the_base_policy_of_the_demo_comes_with_it(tmp_path, monkeypatch):
    runs = load_suite("demo").runs
    assert len({(run.policy_seed, run.demonstrations, run.policy) for run in runs}) == 1
    copy_base(runs[0], tmp_path)
    assert find_base(runs[-1], tmp_path)
    monkeypatch.setattr(paths, "RESULTS", tmp_path / "empty")
    with pytest.raises(UserError, match="empty/base lacks the base policy; install SymSteer"):
        copy_base(runs[0], tmp_path / "other")


def test_the_runs_of_the_demo_are_enough_for_a_verdict():
    runs = load_suite("demo").runs
    for agent in ("standard", "equivariant"):
        assert sum(run.agent == agent for run in runs) == MIN_SEEDS
