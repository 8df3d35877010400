"""Pictures of an evaluation: symmetric in a symmetric world, and equal to the episodes."""

import math

import numpy as np
import torch

from symsteer.agents.episodes import Rollout
from symsteer.bench.runs.pictures import FAILURE, SUCCESS, draw_paths
from symsteer.bench.tasks import task_class

LAYOUT = task_class("PushCube-v1").observation_layout


def walks(count=6, decisions=5):
    """Episodes of random walks, every second one a success after its third decision."""
    generator = torch.Generator().manual_seed(0)
    path = torch.randn(decisions + 1, count, LAYOUT.dim, generator=generator).cumsum(0) / 20
    success = torch.arange(count) % 2 == 0
    running = torch.ones(decisions, count, dtype=torch.bool)
    running[3:, success] = False
    return Rollout(
        episodes={"success_once": success},
        obs=path[:-1],
        noise=torch.zeros(decisions, count, 8, 7),
        reward=-running.float(),
        next_obs=path[1:],
        running=running,
        terminal=torch.zeros_like(running),
    )


def turned(rollout, angle):
    obs, next_obs = (LAYOUT.transform(x, angle) for x in (rollout.obs, rollout.next_obs))
    return Rollout(**{**vars(rollout), "obs": obs, "next_obs": next_obs})


def panels(picture):
    """Paths, turned paths and directions."""
    rows = np.array_split(picture[40:].astype(int), 2)
    (above, straight), (rose, _) = (np.array_split(row, 2, axis=1) for row in rows)
    return above, straight, rose


def color(picture, name):
    wanted = [int(name[i : i + 2], 16) for i in (1, 3, 5)]
    return (np.abs(picture.astype(int) - wanted).max(axis=-1) < 12).sum()


def test_turning_the_world_turns_the_view_from_above_alone():
    episodes = walks()
    above, straight, rose = panels(draw_paths(episodes, LAYOUT, "walks"))
    other, other_straight, _ = panels(draw_paths(turned(episodes, math.pi / 2), LAYOUT, "walks"))
    assert np.abs(above - other).mean() > 1
    # Up to the rounding of the transformation, which shifts a few pixels of thin lines.
    assert np.abs(straight - other_straight).mean() < 0.05
    # Colours tell success.
    assert min(color(rose, SUCCESS), color(rose, FAILURE)) > 500
    episodes.episodes["success_once"][:] = True
    rose = panels(draw_paths(episodes, LAYOUT, "walks"))[2]
    assert color(rose, SUCCESS) > 1000
    assert color(rose, FAILURE) == 0


def test_what_follows_the_first_success_is_not_drawn():
    episodes = walks()
    before = draw_paths(episodes, LAYOUT, "walks")
    tail = episodes.episodes["success_once"]
    episodes.obs[4:, tail] += 1
    episodes.next_obs[3:, tail] += 1
    assert np.array_equal(draw_paths(episodes, LAYOUT, "walks"), before)
    episodes.next_obs[4:, ~tail] += 1
    assert not np.array_equal(draw_paths(episodes, LAYOUT, "walks"), before)
