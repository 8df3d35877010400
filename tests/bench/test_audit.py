"""The unbroken floating task has the symmetry; a variant breaks it, and the audit sees that."""

import pytest

from bench.audit import rotated_rollout_error
from policies.errors import UserError

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


def test_bad_arguments_are_explained():
    with pytest.raises(UserError, match="'random' or 'expert'"):
        rotated_rollout_error("PickCube-v1", episodes=1, actions="none")
    with pytest.raises(UserError, match="floating"):
        rotated_rollout_error(
            "PickCube-v1", episodes=1, batch=1, env_options={"embodiment": "panda"}
        )


@pytest.mark.slow
@pytest.mark.parametrize("actions", ["random", "expert"])
@pytest.mark.parametrize("task", TASKS)
def test_rotated_episodes_coincide_over_200(task, actions):
    result = rotated_rollout_error(task, episodes=200, actions=actions)
    print(f"{task} {actions}\n{result.summary()}")
    assert result.share_within(0.01) >= 0.95
