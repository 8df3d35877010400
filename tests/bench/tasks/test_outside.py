"""Tasks of other packages."""

import gymnasium as gym
import pytest

from symsteer.bench.demos import collect, load
from symsteer.bench.tasks import TASKS, gym_id, make, register, task_class
from symsteer.errors import UserError
from symsteer.registry import allow

TARGET = "tests.bench.tasks.lab:NearPick"

allow(TARGET)


def test_a_class_is_named_by_its_module():
    assert task_class(TARGET).max_episode_steps == 7
    env = make(TARGET, num_envs=2, variant="wind:0.5")
    env.reset(seed=[0, 1])
    assert env.goal_site.pose.p[:, 2].max() < 0.031
    # Code that makes the same task again gets this one, not the class's parent.
    assert env.task_id == TARGET
    assert gym_id(TARGET) == TARGET
    with pytest.raises(UserError, match="must be a class that inherits from"):
        task_class("tests.bench.tasks.lab:__name__")


def test_an_entry_point_gets_ids(monkeypatch):
    """Here in SymSteer's own table: the registry's tests cover entry points."""
    monkeypatch.setitem(TASKS.builtin, "NearPick", TARGET)
    before = set(gym.registry)
    register()
    new = set(gym.registry) - before
    try:
        assert new == {
            f"SymSteer/NearPick{kind}" for kind in ("", "-dense", "-single", "-single-dense")
        }
        env = gym.make("SymSteer/NearPick-single-dense")
        assert env.spec.max_episode_steps == 7
        assert gym_id("NearPick") == "symsteer.bench.tasks:SymSteer/NearPick"
    finally:
        for name in new:
            gym.registry.pop(name)


def test_its_demonstrations_are_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(task_class(TARGET), "max_episode_steps", 40)
    path = collect(TARGET, "floating", 1, "clean", 0, tmp_path / "near.h5")
    assert load(path, TARGET, "floating").meta["task"] == TARGET
    with pytest.raises(UserError, match="but PickCube-v1 is wanted"):
        load(path, "PickCube-v1", "floating")
