"""Episodes of the unbroken floating task are symmetric; those with a variant are not."""

import pytest
import torch

from symsteer.bench.audit import rotated_rollout_error
from symsteer.bench.demos import collect, load
from symsteer.bench.tasks import task_class
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy

TASK = "PickCube-v1"


@pytest.mark.parametrize(
    ("actions", "group", "steps"),
    [("random", "C8", 16), ("expert", "D4", 16)],
)
def test_rotated_episodes_coincide(actions, group, steps):
    result = rotated_rollout_error(TASK, episodes=4, actor=actions, group=group, steps=steps)
    assert result.share_close() == 1.0
    assert result.contact_free_path.min() > 0.05
    assert result.contact.any() == (actions == "expert")
    assert result.contact_free_tcp.max() < 1e-3
    # Float32 physics is not exact: an error of nothing would mean that nothing was compared.
    assert result.contact_free_tcp.min() > 1e-8


def fresh_policy(name: str) -> ChunkPolicy:
    torch.manual_seed(0)
    task = task_class(TASK)
    kind = POLICIES.get(name)
    options = kind.Options(channels=16, width=32, depth=1)
    return kind(options, task.observation_layout, task.action_layout)


def test_turned_noise_gives_the_turned_episode():
    options = {"episodes": 4, "steps": 16}
    result = rotated_rollout_error(TASK, actor=fresh_policy("edp"), **options)
    assert result.share_close() == 1.0
    assert result.contact_free_path.min() > 0.02
    # A policy without the symmetry takes the copies elsewhere.
    plain = rotated_rollout_error(TASK, actor=fresh_policy("plain"), **options)
    assert plain.share_close() == 0.0


@pytest.mark.parametrize(("group", "share"), [("C8", 0.0), ("C2", 1.0)])
def test_a_variant_breaks_what_is_not_a_symmetry_of_it(group, share):
    options = {"episodes": 4, "steps": 10, "variant": "action_gain:0.5"}
    result = rotated_rollout_error(TASK, group=group, **options)
    assert result.share_close() == share


@pytest.mark.slow
def test_turned_noise_of_a_trained_policy_over_200(tmp_path):
    """State and noise of whole closed-loop episodes, turned by every element of C8."""
    demos = load(
        collect(TASK, "floating", 50, "diverse", 0, tmp_path / "pick.h5"), TASK, "floating"
    )
    kind, layouts = POLICIES.get("edp"), (demos.observation_layout, demos.action_layout)
    policy = kind.fit(kind.Options(), demos.episodes, *layouts)
    result = rotated_rollout_error(TASK, episodes=200, actor=policy)
    assert result.share_close() >= 0.95


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["random", "expert"])
@pytest.mark.parametrize("task", ["PushCube-v1", "PickCube-v1", "StackCube-v1"])
def test_rotated_episodes_coincide_over_200(task, actions):
    result = rotated_rollout_error(task, episodes=200, actor=actions)
    assert result.share_close() >= 0.95
