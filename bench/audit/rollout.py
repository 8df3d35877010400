"""How symmetric whole episodes of a task are, measured in simulation.

Copies of an initial state, turned by each element of a planar group, are put into an environment
each. Every copy executes the same actions, or decodes the same latent noise, turned by its
element. The paths are turned back and compared: with the symmetry they coincide.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from symsteer.bench.audit.result import check_group
from symsteer.bench.audit.states import MOVED, Element
from symsteer.bench.sim.environment import MAX_SCENES
from symsteer.bench.sim.rotations import planar_matrix
from symsteer.bench.sim.trees import join_trees, rows_of
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy

Actor = Literal["random", "expert"] | ChunkPolicy
"""Who acts. Open loop: the actions of the original, which are correlated noise at a height without
contacts or those of the scripted expert, are turned for the copies. Closed loop: every copy decodes
its own observation with the original's latent noise, turned."""

BATCH = 25
"""Largest number of episodes in parallel, with one environment per group element each."""


@dataclass(frozen=True)
class RolloutError:
    """Comparison of E episodes with their turned copies; every attribute is a tensor ``[E]``.

    Attributes:
        path: length of the path of the original's tool centre point until success or the time
            limit, metres.
        tcp: largest distance between a copy's turned-back tool centre point and the original's,
            over time and group elements, metres.
        objects: the same for the task's objects.
        contact_free_path, contact_free_tcp: the same until any copy first moves an object.
        steps: number of steps before that contact.
        contact: whether an object was moved.
        success: whether the original succeeded.
        same_outcome: whether success is the same for all copies.
    """

    path: torch.Tensor
    tcp: torch.Tensor
    objects: torch.Tensor
    contact_free_path: torch.Tensor
    contact_free_tcp: torch.Tensor
    steps: torch.Tensor
    contact: torch.Tensor
    success: torch.Tensor
    same_outcome: torch.Tensor

    def share_close(self, contacts: bool = False) -> float:
        """Share of episodes whose error is at most 1 % of the path.

        Args:
            contacts: compare whole episodes, not only the part before contact.
        """
        error, path = (
            (self.tcp, self.path) if contacts else (self.contact_free_tcp, self.contact_free_path)
        )
        return float((error / path.clamp(min=1e-9) <= 0.01).double().mean())

    def summary(self) -> str:
        """Text of three lines."""

        def mm(values: torch.Tensor) -> str:
            median, high = np.quantile(1e3 * values.numpy(), [0.5, 0.95])
            return f"median {median:.4f}, 95th percentile {high:.4f}, max {1e3 * values.max():.4f}"

        mean = {name: float(values.double().mean()) for name, values in vars(self).items()}
        return (
            f"{len(self.path)} episodes, {mean['contact']:.0%} with contact\n"
            f"before contact: within 1 % of the path {self.share_close():.1%}; error mm "
            f"{mm(self.contact_free_tcp)}; path mean {mean['contact_free_path']:.3f} m over "
            f"{mean['steps']:.1f} steps\n"
            f"whole episode:  within 1 % of the path {self.share_close(contacts=True):.1%}; "
            f"error mm {mm(self.tcp)}; objects mm {mm(self.objects)}; "
            f"success {mean['success']:.1%}, all copies agree {mean['same_outcome']:.1%}"
        )


def rotated_rollout_error(
    task: str,
    *,
    episodes: int,
    actor: Actor = "random",
    group: str = "C8",
    steps: int | None = None,
    seed: int = 0,
    variant: str = "none",
) -> RolloutError:
    """Compare episodes of the floating gripper with their turned copies.

    Args:
        task: name of a task.
        episodes: number of episodes, with seeds ``seed``, ``seed + 1``, ...
        actor: who acts.
        group: a finite planar group, e.g. ``C8`` or ``D4``.
        steps: steps per episode; by default the task's limit.
        seed: of the first episode.
        variant: symmetry-breaking variant of all environments.

    Raises:
        UserError: unknown task, group or variant, or no episodes.
    """
    if episodes < 1:
        raise UserError(f"the number of episodes must be at least 1; it is {episodes}")
    elements = check_group(group).elements
    batch = min(episodes, BATCH, MAX_SCENES // len(elements))
    env = make(task, num_envs=batch * len(elements), variant=variant)
    steps = env.max_episode_steps if steps is None else steps
    played = [
        _rollout(env, range(start, start + batch), elements, steps, actor)
        for start in range(seed, seed + episodes, batch)
    ]
    env.close()
    return rows_of(join_trees(played), slice(episodes))


def _rollout(
    env: SymmetricTask,
    seeds: Sequence[int],
    elements: tuple[Element, ...],
    steps: int,
    actor: Actor,
) -> RolloutError:
    """An episode for each of the seeds; environment g * count + i is copy g of episode i."""
    count, order = len(seeds), len(elements)
    env.reset(seed=[*seeds] * order)
    state = env.get_state_dict()
    copies = [
        rows_of(env.transform_state(state, *element), slice(g * count, (g + 1) * count))
        for g, element in enumerate(elements)
    ]
    env.set_state_dict(join_trees(copies))
    tcp, objects, success = [], [], []

    def look() -> None:
        tcp.append(env.agent.tcp_pose.p.clone())
        objects.append(torch.stack([body.pose.p.clone() for body in env.moving_bodies], dim=1))

    look()
    for action in _actions(env, seeds, elements, steps, actor):
        success.append(env.step(action)[-1]["success"].clone())
        look()

    def turned_back(points: list[torch.Tensor]) -> torch.Tensor:
        """``[order * count, ..., 3]`` of every step to ``[steps, order, count, ..., 3]``."""
        split = torch.stack(points).unflatten(1, (order, count))
        matrices = [planar_matrix(*element, split) for element in elements]
        return torch.stack([split[:, g] @ matrix for g, matrix in enumerate(matrices)], dim=1)

    paths, bodies = turned_back(tcp), turned_back(objects)
    error = (paths - paths[:, :1]).norm(dim=-1).amax(dim=1)
    body_error = (bodies - bodies[:, :1]).norm(dim=-1).amax(dim=(1, 3))
    travelled = torch.cat(
        [torch.zeros(1, count), (paths[1:, 0] - paths[:-1, 0]).norm(dim=-1).cumsum(dim=0)]
    )
    touched = ((bodies - bodies[:1]).norm(dim=-1) > MOVED).any(dim=1).any(dim=-1)
    won = torch.stack(success).unflatten(1, (order, count))
    # An episode ends with its first success; later steps do not count.
    end = 1 + (won[:, 0].cumsum(dim=0) == 0).sum(dim=0).clamp(max=steps - 1)
    free = ((touched.cumsum(dim=0) == 0).sum(dim=0) - 1).minimum(end)
    every, time = torch.arange(count), torch.arange(steps + 1)[:, None]
    before, during = time <= free, time <= end
    won = won.any(dim=0)
    return RolloutError(
        path=travelled[end, every],
        tcp=(error * during).amax(dim=0),
        objects=(body_error * during).amax(dim=0),
        contact_free_path=travelled[free, every],
        contact_free_tcp=(error * before).amax(dim=0),
        steps=free,
        contact=(touched & during).any(dim=0),
        success=won[0],
        same_outcome=(won == won[:1]).all(dim=0),
    )


def _actions(
    env: SymmetricTask,
    seeds: Sequence[int],
    elements: tuple[Element, ...],
    steps: int,
    actor: Actor,
) -> Iterator[torch.Tensor]:
    """The actions of all copies, ``[order * count, 7]``, of one step after the other."""
    layout, count = env.action_layout, len(seeds)

    def turned(originals: torch.Tensor) -> torch.Tensor:
        return torch.cat([layout.transform(originals, *element) for element in elements])

    if isinstance(actor, ChunkPolicy):
        streams = [np.random.default_rng([seed, 3]) for seed in seeds]
        for step in range(steps):
            if step % actor.execute == 0:
                draws = [stream.standard_normal((actor.horizon, layout.dim)) for stream in streams]
                noise = torch.as_tensor(np.stack(draws), dtype=torch.float32)
                chunk = actor.decode(actor.see(env.get_obs()), turned(noise))
            yield chunk[:, step % actor.execute]
    elif actor == "expert":
        expert = Expert(env)
        for _ in range(steps):
            yield turned(expert.act()[:count])
    else:
        rngs = [np.random.default_rng([seed, 2]) for seed in seeds]
        draws = np.stack([rng.standard_normal((steps, layout.dim)) for rng in rngs], axis=1)
        for step in range(1, steps):
            draws[step] = 0.8 * draws[step - 1] + 0.6 * draws[step]
        height = layout.slice("z")
        for noise in torch.as_tensor(draws, dtype=torch.float32):
            # Towards a random height above the objects, so that the gripper touches nothing.
            action = noise.clone()
            clear = 0.18 + 0.04 * noise[:, height]
            action[:, height] = (clear - env.agent.tcp_pose.p[:count, 2:]) / 0.03
            yield turned(env.commanded(env.body.bound(action).repeat(len(elements), 1))[:count])
