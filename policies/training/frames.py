"""Chunks as they are seen from a frame that the observation has (relative actions)."""

from __future__ import annotations

import torch

from symsteer.errors import UserError
from symsteer.names import check
from symsteer.policies.geometry import Field, Layout


class Frame:
    """The frame whose x axis is a vector of the observation.

    Seen from there, chunk and noise do not change when the scene turns (arXiv 2505.13431). Where
    the vector is short, its direction is uncertain; where it vanishes, the frame jumps.

    Args:
        name: of an observation field of one planar vector; empty: the world's frame.
        obs_layout: geometry of an observation.
        act_layout: geometry of an action in the world's frame.

    Attributes:
        layout: geometry of an action as it is seen from the frame.

    Raises:
        UserError: if the field is no such vector.
    """

    def __init__(self, name: str, obs_layout: Layout, act_layout: Layout):
        self.name, self.act_layout, self.layout = name, act_layout, act_layout
        if not name:
            return
        vectors = {field.name: field for field in planar_vectors(obs_layout)}
        check("planar vector", [name], vectors, "frame of a base policy")
        field = vectors[name]
        self.slice = obs_layout.slice(name)
        self.layout = Layout(
            [part for f in act_layout.fields for part in _components(f, field.odd)]
        )

    def angle(self, obs: torch.Tensor) -> torch.Tensor | None:
        """Direction of the frame in normalised observations ``[B, obs_dim]``, radians ``[B]``."""
        if not self.name:
            return None
        x, y = obs[..., self.slice].unbind(-1)
        return torch.atan2(y, x)

    def enter(self, chunk: torch.Tensor, angle: torch.Tensor | None) -> torch.Tensor:
        """A chunk ``[B, Tp, Da]`` as it is seen from the frame."""
        return chunk if angle is None else self.act_layout.rotate(chunk, -angle)

    def leave(self, chunk: torch.Tensor, angle: torch.Tensor | None) -> torch.Tensor:
        """The inverse of :meth:`enter`."""
        return chunk if angle is None else self.act_layout.rotate(chunk, angle)


def planar_vectors(layout: Layout) -> list[Field]:
    """The fields of a layout that are one planar vector each.

    Raises:
        UserError: if there are none.
    """
    vectors = [f for f in layout.fields if f.frequency == 1 and f.multiplicity == 1]
    if not vectors:
        raise UserError("a frame needs a planar vector, and this observation has none")
    return vectors


def _components(field: Field, odd_axis: bool) -> list[Field]:
    """An action's field in the frame: invariant, but for signs under reflections."""
    if field.frequency == 0:
        return [field]
    # A reflection turns the frame's angle round; if the axis is odd, it also adds half a turn.
    flipped = field.odd != (odd_axis and field.frequency % 2 == 1)
    return [
        Field(f"{field.name}.{i}.{axis}", 0, 1, flipped != (axis == "y"))
        for i in range(field.multiplicity)
        for axis in ("x", "y")
    ]
