"""Equivariant weights and free biases (ours), which easily undo a constant shift of the world.

The bias of an equivariant layer is the same for all group elements. Here the biases may differ,

    y = W x + b + c,   W and b equivariant, c any vector, 0 at the start.

A first layer then sees a shifted input, W (x + s) + b = W x + b + W s, and a last layer adds a
constant vector, exactly and with the numbers of one bias. With free biases in the hidden layers,
too, other maps are in reach. This is the networks' form of a learned symmetry-breaking input (Smidt
et al., arXiv 2007.02005).

Their asymmetry in the record (``asymmetry_actor``) says how much of it was used, and
`FreeBiasAgent.shifts` which shift it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import torch
from torch import nn

from symsteer.agents.asymmetry import AsymmetricLayer, PenaltyAgent, PenaltyOptions
from symsteer.agents.episodes import Played
from symsteer.agents.networks import Parameters, dense, dense_of, within
from symsteer.agents.presets import defaults_of
from symsteer.policies.geometry import Layout
from symsteer.policies.networks.equivariant import EquivariantLayer

EXACT = ("tcp", "goal", "bin")
"""Names in fields of what is told exactly: the tool, and goals."""

SMALL = 1e-3
"""Metres by which bodies are moved to see how normalised observations move."""


@dataclass(frozen=True)
class FreeBiasOptions(PenaltyOptions):
    """Options of the agent with free biases."""

    penalty: float = 0.0


class FreeBias(AsymmetricLayer):
    """An equivariant layer plus a bias without symmetry."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__()
        self.strict = strict
        self.free_bias = nn.Parameter(torch.zeros_like(dense(strict)[1]))

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = dense_of(self.strict, within("strict", parameters))
        return weight, bias + parameters["free_bias"]

    def pull(self, parameters: Parameters, factor: torch.Tensor) -> None:
        parameters["free_bias"].mul_(factor)


@defaults_of("minimax")
class FreeBiasAgent(PenaltyAgent):
    """The equivariant agent with free biases."""

    name = "free-bias"
    in_teams = True
    Options = FreeBiasOptions
    Layer = FreeBias

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Also the `shifts`."""
        return {**super().diagnostics(played), **self.shifts()}

    @torch.no_grad()
    def shifts(self) -> dict[str, float]:
        """Which constant shifts of the world the critics undo, mean over the critics.

        Q of a world in which bodies are seen displaced by d, and motions end displaced by a, is
        that of the symmetric world at other inputs: Q'(s, u) = Q(s - P d, u + R a), where P and R
        say which inputs move along. So a first layer W x + b + c that is symmetric but for d and a
        has c = W (R a - P d). Least squares gives both.

        Returns:
            ``displacement_x``, ``displacement_y`` (metres) and ``motion_x``, ``motion_y`` (full
            steps); empty if no body's place is told, or the critics see noise in place of actions.
        """
        bodies = displaced(self.obs_layout).to(self.device, self.dtype)
        if self.options.critic_kind == "noise" or not bodies.any():
            return {}
        # Normalised observations are bounded, so a small displacement is measured.
        rows = torch.stack([SMALL * bodies.mT, torch.zeros_like(bodies.mT)])
        near, there = self.context.normalize_obs(rows.flatten(0, 1)).chunk(2)
        moved = (near - there).mT / SMALL
        steps = torch.eye(self.act_layout.dim)[:, self.act_layout.slice("xy")]
        steps = steps.repeat(self.context.execute, 1).to(moved)
        layer, parameters = next(self.critic.layers())
        weight, bias = dense_of(layer, parameters)
        free = bias - cast(FreeBias, layer).strict.nearest(weight, bias)[1]
        to_bodies, to_steps = weight.split([len(moved), len(steps)], dim=-1)
        causes = torch.cat([-to_bodies @ moved, to_steps @ steps], dim=-1)
        found = torch.linalg.lstsq(causes, free.unsqueeze(-1)).solution.squeeze(-1).mean(0)
        names = ("displacement_x", "displacement_y", "motion_x", "motion_y")
        return dict(zip(names, found.tolist(), strict=True))


def displaced(layout: Layout) -> torch.Tensor:
    """How an observation moves with all bodies that are seen, ``[dim, 2]``.

    Tool and goal stay where they are. Fields are known by their names: ``cube_xy`` is where a cube
    is, ``tcp_to_cube_xy`` the way there.
    """
    moves = torch.zeros(layout.dim, 2)
    for field in layout.fields:
        if field.frequency == 1 and field.multiplicity == 1 and field.name.endswith("_xy"):
            begin, _, end = field.name.removesuffix("_xy").rpartition("_to_")
            times = (end not in EXACT) - bool(begin and begin not in EXACT)
            moves[layout.slice(field.name)] = times * torch.eye(2)
    return moves
