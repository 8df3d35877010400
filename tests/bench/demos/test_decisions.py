"""Demonstrations as decisions: observations, actions, costs and ends, by hand."""

import torch

from symsteer.bench.demos import Demonstrations
from symsteer.bench.demos.decisions import decisions
from symsteer.policies.geometry import Field, Layout

OBS = Layout([Field("height", 0)])
ACT = Layout([Field("z", 0), Field("gripper", 0)])


def episode(length, first):
    obs = torch.arange(length + 1.0)[:, None] + first
    return obs, torch.stack([obs[:-1, 0], -obs[:-1, 0]], dim=1)


def test_every_step_begins_a_decision_and_the_last_one_is_free():
    demos = Demonstrations([episode(5, 10.0), episode(2, 50.0)], OBS, ACT, {}, "")
    found = decisions(demos, execute=3, horizon=4, hold=("gripper",))
    assert found.obs.flatten().tolist() == [10, 11, 12, 13, 14, 50, 51]
    # The environment ends the episode with its success, at the last step.
    assert found.next_obs.flatten().tolist() == [13, 14, 15, 15, 15, 52, 52]
    assert found.reward.tolist() == [-3, -3, -2, -1, 0, -1, 0]
    assert found.terminal.tolist() == [False, False, True, True, True, True, True]
    assert not found.truncated.any()
    assert found.noise.shape == (7, 4, 2)
    assert found.actions[0].tolist() == [[10, -10], [11, -11], [12, -12]]
    # Behind the end: no motion, and the gripper keeps its last value.
    assert found.actions[4].tolist() == [[14, -14], [0, -14], [0, -14]]
