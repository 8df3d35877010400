"""Where an episode has to go: the direction that a symmetric agent is indifferent to."""

from __future__ import annotations

import torch

from symsteer.bench.tasks.features import is_direction
from symsteer.policies.geometry import Layout


def positions(layout: Layout) -> list[str]:
    """Fields with horizontal positions in the workspace: first the tool, last the goal."""
    return [
        field.name
        for field in layout.fields
        if field.name.endswith("_xy")
        and field.dim == 2
        and "_to_" not in field.name
        and not is_direction(field.name)
    ]


def directions(obs: torch.Tensor, layout: Layout) -> torch.Tensor | None:
    """The direction from the last but one position to the last one.

    This is from the object to its goal, or from the tool to the object in tasks without a goal.

    Args:
        obs: first observations of episodes, ``[N, obs_dim]``, with the errors that a variant of
            perception adds.
        layout: of the observation.

    Returns:
        Angles from the x axis in radians, ``[N]``, or None for a layout with fewer than two
        positions.
    """
    names = positions(layout)
    if len(names) < 2:
        return None
    start, end = (obs[:, layout.slice(name)].double() for name in names[-2:])
    way = end - start
    return torch.atan2(way[:, 1], way[:, 0])
