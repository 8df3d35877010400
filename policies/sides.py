"""Do decisions look the same on all sides? An exact test (ours), without a model or training.

In a symmetric world, with a symmetric policy, a whole episode and the episode turned by a quarter
are equally likely. So the mean of any vector over episodes is 0, but for chance: of what is seen,
of how it changes, of what is done. A mean that is not 0 has a *direction*: one side is unlike the
opposite one, as behind a displaced camera. The same holds for products of two vectors (frequency
2), whose mean has an *axis*: x is unlike y, as with a weak motor along x.

Whether a mean is too large for chance is asked by a randomisation test: every episode is turned by
a random quarter, 999 times over (Lehmann and Romano, Testing Statistical Hypotheses, chapter 15).
Its level is exact for any number of episodes: no distribution is assumed.

If every motion is shifted alike, the size of the shift is estimated, too. The change of the tool in
a decision is fitted by the executed actions times a complex factor, which symmetry allows, plus a
constant, which it forbids. The constant is the *drift*.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.policies.geometry import Layout

DRAWS = 999

RESTING = 1e-4
"""Vectors at rest: those with less than this share of the largest one's root mean square."""


@dataclass(frozen=True)
class Sides:
    """How unlike the sides are.

    Attributes:
        direction: p-value: how likely means of vectors as large as these are in a symmetric world.
        axis: the same of products of two vectors.
        drift: what the tool moves in each decision without being told to, x + iy, in units of the
            observation (metres). The tool is the vector whose changes the actions explain best; if
            it moves against the actions, its opposite.
    """

    direction: float
    axis: float
    drift: complex


def vectors(layout: Layout, x: torch.Tensor) -> torch.Tensor:
    """The horizontal vectors in ``x [..., dim]`` as complex numbers ``[..., fields]``.

    Of a field with several blocks, such as a cloud of points, the mean.
    """
    parts = [
        x[..., layout.slice(field.name)].unflatten(-1, (-1, 2)).mean(-2)
        for field in layout.fields
        if field.frequency == 1
    ]
    stacked = torch.stack(parts, -2) if parts else x.new_zeros((*x.shape[:-1], 0, 2))
    return torch.view_as_complex(stacked.double().contiguous())


def sides(
    obs_layout: Layout,
    act_layout: Layout,
    obs: torch.Tensor,
    actions: torch.Tensor,
    next_obs: torch.Tensor,
    episodes: torch.Tensor,
    generator: torch.Generator,
) -> Sides:
    """The test on n decisions.

    Args:
        obs_layout, act_layout: of observations and actions.
        obs, next_obs: before and after each decision, ``[n, obs_dim]``.
        actions: executed, ``[n, steps, act_dim]``.
        episodes: number of the episode of each decision, ``[n]`` int64.
        generator: of the random quarters.
    """
    # On the processor: least squares of dependent columns are not for a GPU.
    obs, actions, next_obs, episodes = (x.cpu() for x in (obs, actions, next_obs, episodes))
    before = vectors(obs_layout, obs)
    change = vectors(obs_layout, next_obs) - before
    done = vectors(act_layout, actions.sum(1))
    # Least squares without a constant turn as the episodes do: the level stays exact.
    unexplained = change - done @ torch.linalg.lstsq(done, change).solution
    seen = torch.cat([before, change, done, unexplained], dim=-1)
    first, second = torch.triu_indices(seen.shape[-1], seen.shape[-1])
    _, numbers, counts = episodes.unique(return_inverse=True, return_counts=True)

    def means(values: torch.Tensor) -> torch.Tensor:
        sums = values.new_zeros(len(counts), values.shape[1]).index_add_(0, numbers, values)
        return sums / counts.unsqueeze(1)

    directed, axial = means(seen), means(seen[:, first] * seen[:, second])
    shape, device = (DRAWS, len(counts)), generator.device
    quarters = torch.randint(4, shape, generator=generator, device=device).cpu()
    turns = torch.tensor([1, 1j, -1, -1j], dtype=torch.complex128)[quarters]
    return Sides(_p_value(directed, turns), _p_value(axial, turns**2), _drift(done, change))


def _drift(actions: torch.Tensor, changes: torch.Tensor) -> complex:
    """The constant of the least squares of ``changes [n, k]`` on ``actions [n, l]``.

    Of the change whose squares are explained to the largest share; 0 without vectors.
    """
    if not changes.shape[1]:
        return 0j
    known = torch.cat([actions, torch.ones_like(changes[:, :1])], 1)
    factors = torch.linalg.lstsq(known, changes).solution
    left = (changes - known @ factors).abs().square().mean(0)
    spread = changes.var(0)
    moves = spread.sqrt() > RESTING * spread.max().sqrt()
    explained = torch.where(moves, 1 - left / spread, -torch.inf)
    found = factors[:, explained.argmax()]
    drift, effects = found[-1], found[:-1] * actions.abs().square().mean(0).sqrt()
    # The way from the tool to an object is explained as well as the tool, but moves the other way.
    along = not len(effects) or effects[effects.abs().argmax()].real >= 0
    return complex(drift if along else -drift)


def _p_value(values: torch.Tensor, turns: torch.Tensor) -> float:
    """Of means over episodes ``values [N, features]``, under ``turns [draws, N]``."""
    spread = values.abs().square().mean(0).sqrt()
    # What moves less than this is an error of rounding, which has a direction of its own.
    moves = spread > RESTING * spread.max() if values.shape[1] else spread > 0
    if not moves.any():
        return 1.0
    values = values[:, moves] / spread[moves]
    drawn = torch.cat([torch.ones_like(turns[:1]), turns])
    sizes = (drawn @ values).abs() ** 2
    # In the same units, so that the largest of them is not that of the most variable one.
    largest = ((sizes - sizes.mean(0)) / sizes.std(0).clamp(min=1e-12)).amax(1)
    return float((largest >= largest[0]).double().mean())
