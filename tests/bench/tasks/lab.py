"""A task as another package would have it."""

from symsteer.bench.tasks.floating import ACTION_LAYOUT
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.policies.geometry import Layout


class NearPick(PickCube):
    """PickCube with low goals."""

    max_episode_steps = 7
    goal_lift = 0.01


class OtherActions(NearPick):
    """Its actions are in another order."""

    action_layout = Layout(ACTION_LAYOUT.fields[::-1])
