"""Episodes of the unbroken floating task are symmetric; those with a variant are not."""

import pytest
import torch

from symsteer.bench.audit import rotated_rollout_error
from symsteer.bench.demos import collect, load
from symsteer.bench.tasks import task_class
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy

TASKS = ("PushCube-v1", "PickCube-v1", "StackCube-v1")


@pytest.mark.parametrize("actions", ["random", "expert"])
def test_rotated_episodes_coincide(actions):
    result = rotated_rollout_error("PickCube-v1", episodes=8, batch=8, actions=actions, steps=20)
    print(result.summary())
    assert result.share_within(0.01) == 1.0
    assert result.contact_free_path.min() > 0.05
    assert result.contact.any() == (actions == "expert")
    assert result.contact_free_tcp.max() < 1e-3
    # Float32 physics is not exact: an error of nothing would mean that nothing was compared.
    assert result.contact_free_tcp.min() > 1e-8


def fresh_policy(name: str = "edp") -> ChunkPolicy:
    torch.manual_seed(0)
    task = task_class("PickCube-v1")
    kind = POLICIES.get(name)
    options = kind.Options(channels=16, width=32, depth=1)
    return kind(options, task.observation_layout, task.action_layout)


def test_turned_noise_gives_the_turned_episode():
    options = {"episodes": 8, "batch": 8, "actions": "policy", "steps": 20}
    result = rotated_rollout_error("PickCube-v1", policy=fresh_policy(), **options)
    assert result.share_within(0.01) == 1.0
    assert result.contact_free_path.min() > 0.02
    # A policy without the symmetry takes the copies elsewhere.
    plain = rotated_rollout_error("PickCube-v1", policy=fresh_policy("plain"), **options)
    assert plain.share_within(0.01) == 0.0


@pytest.mark.slow
def test_turned_noise_of_a_trained_policy_over_200(tmp_path):
    """State and noise of whole closed-loop episodes, turned by every element of C8."""
    path = collect("PickCube-v1", "floating", 50, "diverse", 0, tmp_path / "pick.h5")
    demos = load(path, "PickCube-v1", "floating")
    kind = POLICIES.get("edp")
    policy = kind.fit(
        kind.Options(),
        demos.episodes,
        demos.observation_layout,
        demos.action_layout,
    )
    result = rotated_rollout_error("PickCube-v1", episodes=200, actions="policy", policy=policy)
    print(f"PickCube-v1 policy\n{result.summary()}")
    assert result.share_within(0.01) >= 0.95


def test_reflections_too():
    result = rotated_rollout_error(
        "PickCube-v1", episodes=4, batch=4, group="D4", actions="expert", steps=16
    )
    assert result.share_within(0.01) == 1.0


def test_a_variant_breaks_it():
    result = rotated_rollout_error(
        "PickCube-v1", episodes=4, batch=4, steps=10, variant="action_gain:0.5"
    )
    assert result.share_within(0.01) == 0.0
    half_turn = rotated_rollout_error(
        "PickCube-v1", episodes=4, batch=4, steps=10, variant="action_gain:0.5", group="C2"
    )
    assert half_turn.share_within(0.01) == 1.0


def test_a_policy_is_for_its_actions_only():
    with pytest.raises(ValueError, match="policy is needed"):
        rotated_rollout_error("PickCube-v1", episodes=1, actions="policy")
    with pytest.raises(ValueError, match="only there"):
        rotated_rollout_error("PickCube-v1", episodes=1, policy=fresh_policy())


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["random", "expert"])
@pytest.mark.parametrize("task", TASKS)
def test_rotated_episodes_coincide_over_200(task, actions):
    result = rotated_rollout_error(task, episodes=200, actions=actions)
    print(f"{task} {actions}\n{result.summary()}")
    assert result.share_within(0.01) >= 0.95
