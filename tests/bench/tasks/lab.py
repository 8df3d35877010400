"""A task as another package would have it."""

from symsteer.bench.tasks.pick_cube import PickCube


class NearPick(PickCube):
    """PickCube with low goals."""

    max_episode_steps = 7
    goal_lift = 0.01
