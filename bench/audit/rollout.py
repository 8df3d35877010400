"""How symmetric whole episodes of a task are, measured in simulation.

Copies of an initial state, turned by each element of a planar group, are put into an environment
each. Every copy executes the same actions, or decodes the same latent noise, turned by its
element. The paths are turned back and compared: with the symmetry they coincide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from symsteer.bench.audit.states import MOVED
from symsteer.bench.sim.rotations import planar_matrix
from symsteer.bench.sim.trees import map_trees
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import Expert
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Group

Actions = Literal["random", "expert", "policy"]


@dataclass(frozen=True)
class RolloutError:
    """Comparison of E episodes with their turned copies; every attribute is ``[E]``.

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

    path: np.ndarray
    tcp: np.ndarray
    objects: np.ndarray
    contact_free_path: np.ndarray
    contact_free_tcp: np.ndarray
    steps: np.ndarray
    contact: np.ndarray
    success: np.ndarray
    same_outcome: np.ndarray

    def share_within(self, limit: float = 0.01, contacts: bool = False) -> float:
        """Share of episodes whose error is at most ``limit`` of the path.

        Args:
            limit: relative error.
            contacts: compare whole episodes, not only the part before contact.
        """
        if contacts:
            error, path = self.tcp, self.path
        else:
            error, path = self.contact_free_tcp, self.contact_free_path
        return float(np.mean(error / np.maximum(path, 1e-9) <= limit))

    def summary(self) -> str:
        """Text of three lines."""
        free, full = 1e3 * self.contact_free_tcp, 1e3 * self.tcp
        moved = 1e3 * self.objects
        return (
            f"{len(self.path)} episodes, {np.mean(self.contact):.0%} with contact\n"
            f"before contact: within 1 % of the path {self.share_within():.1%}; error mm "
            f"median {np.median(free):.4f}, 95th percentile {np.quantile(free, 0.95):.4f}, "
            f"max {free.max():.4f}; path mean {np.mean(self.contact_free_path):.3f} m over "
            f"{np.mean(self.steps):.1f} steps\n"
            f"whole episode:  within 1 % of the path {self.share_within(contacts=True):.1%}; "
            f"error mm median {np.median(full):.4f}, 95th percentile "
            f"{np.quantile(full, 0.95):.4f}, max {full.max():.4f}; objects mm median "
            f"{np.median(moved):.4f}, 95th percentile {np.quantile(moved, 0.95):.4f}; "
            f"success {np.mean(self.success):.1%}, "
            f"all copies agree {np.mean(self.same_outcome):.1%}"
        )


def rotated_rollout_error(
    task: str,
    *,
    episodes: int,
    actions: Actions = "random",
    group: str = "C8",
    steps: int | None = None,
    seed: int = 0,
    variant: str = "none",
    batch: int = 25,
    policy: ChunkPolicy | None = None,
) -> RolloutError:
    """Compare episodes of the floating gripper with their turned copies.

    Args:
        task: name of a task.
        episodes: number of episodes, with seeds ``seed``, ``seed + 1``, ...
        actions: ``random`` (open loop: correlated noise, at a height without contacts), ``expert``
            (open loop: the actions of the scripted expert in the original, turned for the copies)
            or ``policy`` (closed loop: every copy decodes its own observation with the original's
            latent noise, turned).
        group: a finite planar group, e.g. ``C8`` or ``D4``.
        steps: steps per episode; by default the task's limit.
        seed: of the first episode.
        variant: symmetry-breaking variant of all environments.
        batch: number of episodes in parallel, with one environment per group element each.
        policy: the policy for ``actions="policy"``.

    Raises:
        UserError: unknown task, group or variant.
        ValueError: ``actions`` and ``policy`` do not fit together.
    """
    if (actions == "policy") != (policy is not None):
        raise ValueError("a policy is needed for actions='policy', and only there")
    elements = Group.parse(group).elements
    env = make(task, num_envs=batch * len(elements), variant=variant)
    steps = env.max_episode_steps if steps is None else steps
    parts = []
    for start in range(seed, seed + episodes, batch):
        parts.append(_rollout(env, start, batch, elements, steps, actions, policy))
    env.close()
    merged = {
        name: np.concatenate([getattr(part, name) for part in parts])[:episodes]
        for name in RolloutError.__dataclass_fields__
    }
    return RolloutError(**merged)


def _rollout(
    env: SymmetricTask,
    start: int,
    count: int,
    elements: tuple[tuple[float, bool], ...],
    steps: int,
    kind: Actions,
    policy: ChunkPolicy | None,
) -> RolloutError:
    """``count`` episodes; environment g * count + i is copy g of episode i."""
    order = len(elements)
    env.reset(seed=[start + i for i in range(count)] * order)
    state = env.get_state_dict()
    copies = [env.transform_state(state, angle, reflect) for angle, reflect in elements]
    # Rows g * count ... of copy g.
    env.set_state_dict(
        map_trees(
            lambda *c: torch.cat([x[g * count : (g + 1) * count] for g, x in enumerate(c)]), *copies
        )
    )
    if policy is not None:
        choose = _policy_actions(env, policy, start, count, elements)
    elif kind == "expert":
        expert = Expert(env)
        choose = _turned(env, lambda step: expert.act()[:count], elements)
    else:
        choose = _turned(env, _noise(env, start, count, steps), elements)
    tcp, objects, success = [_tcp(env)], [_objects(env)], []
    for step in range(steps):
        _, _, _, _, info = env.step(choose(step))
        tcp.append(_tcp(env))
        objects.append(_objects(env))
        success.append(info["success"].clone())

    back = [planar_matrix(angle, reflect, tcp[0]).T for angle, reflect in elements]
    paths = _turn_back(torch.stack(tcp), back, count)
    bodies = _turn_back(torch.stack(objects), back, count)
    error = (paths - paths[:, :1]).norm(dim=-1).amax(dim=1)
    body_error = (bodies - bodies[:, :1]).norm(dim=-1).amax(dim=(1, 3))
    travelled = torch.cat(
        [torch.zeros(1, count), (paths[1:, 0] - paths[:-1, 0]).norm(dim=-1).cumsum(dim=0)]
    )
    touched = ((bodies - bodies[:1]).norm(dim=-1) > MOVED).any(dim=1).any(dim=-1)
    free = (touched.cumsum(dim=0) == 0).sum(dim=0) - 1
    won = torch.stack(success).unflatten(1, (order, count))
    # An episode ends with its first success; later steps do not count.
    end = 1 + (won[:, 0].cumsum(dim=0) == 0).sum(dim=0).clamp(max=steps - 1)
    free = free.minimum(end)
    every = torch.arange(count)
    time = torch.arange(steps + 1)[:, None]
    before, during = time <= free, time <= end
    won = won.any(dim=0)
    return RolloutError(
        path=travelled[end, every].numpy(),
        tcp=(error * during).amax(dim=0).numpy(),
        objects=(body_error * during).amax(dim=0).numpy(),
        contact_free_path=travelled[free, every].numpy(),
        contact_free_tcp=(error * before).amax(dim=0).numpy(),
        steps=free.numpy(),
        contact=(touched & during).any(dim=0).numpy(),
        success=won[0].numpy(),
        same_outcome=(won == won[:1]).all(dim=0).numpy(),
    )


def _turn_back(points: torch.Tensor, back: list[torch.Tensor], count: int) -> torch.Tensor:
    """Turn points back: ``[steps, order * count, ..., 3]`` to ``[steps, order, count, ..., 3]``."""
    split = points.unflatten(1, (len(back), count))
    return torch.stack([split[:, g] @ matrix.T for g, matrix in enumerate(back)], dim=1)


def _turned(
    env: SymmetricTask,
    choose: Callable[[int], torch.Tensor],
    elements: tuple[tuple[float, bool], ...],
) -> Callable[[int], torch.Tensor]:
    """Turn the actions of the originals ``[count, 7]`` for all copies, ``[order * count, 7]``."""

    def chosen(step: int) -> torch.Tensor:
        original = choose(step)
        return torch.cat([env.action_layout.transform(original, *element) for element in elements])

    return chosen


def _policy_actions(
    env: SymmetricTask,
    policy: ChunkPolicy,
    start: int,
    count: int,
    elements: tuple[tuple[float, bool], ...],
) -> Callable[[int], torch.Tensor]:
    """Actions ``[order * count, 7]`` that each copy decodes from the turned noise."""
    layout = policy.act_layout
    streams = [np.random.default_rng([start + i, 3]) for i in range(count)]
    chunk = torch.zeros(0)

    def choose(step: int) -> torch.Tensor:
        nonlocal chunk
        if step % policy.execute == 0:
            draws = [stream.standard_normal((policy.horizon, layout.dim)) for stream in streams]
            noise = torch.as_tensor(np.stack(draws), dtype=torch.float32)
            turned = torch.cat([layout.transform(noise, *element) for element in elements])
            chunk = policy.decode(env.get_obs(), turned)
        return chunk[:, step % policy.execute]

    return choose


def _noise(env: SymmetricTask, start: int, count: int, steps: int) -> Callable[[int], torch.Tensor]:
    """Correlated random actions, one stream per episode.

    The vertical action moves the gripper towards a random height above the objects, so that it
    touches nothing.
    """
    layout = env.action_layout
    draws = np.stack(
        [
            np.random.default_rng([start + i, 2]).standard_normal((steps, layout.dim))
            for i in range(count)
        ],
        axis=1,
    )
    level = np.zeros_like(draws)
    level[0] = draws[0]
    for step in range(1, steps):
        level[step] = 0.8 * level[step - 1] + 0.6 * draws[step]
    noise = torch.as_tensor(level, dtype=torch.float32)

    def choose(step: int) -> torch.Tensor:
        action = noise[step].clone()
        height = env.agent.tcp_pose.p[:count, 2]
        clear = 0.18 + 0.04 * noise[step][:, layout.slice("z")]
        action[:, layout.slice("z")] = (clear - height[:, None]) / 0.03
        copies = env.body.bound(action).repeat(env.num_envs // count, 1)
        return env.commanded(copies)[:count]

    return choose


def _tcp(env: SymmetricTask) -> torch.Tensor:
    return env.agent.tcp_pose.p.clone()


def _objects(env: SymmetricTask) -> torch.Tensor:
    """Positions of the movable bodies, ``[N, bodies, 3]``."""
    bodies = [a for a in env.scene.actors.values() if a.px_body_type == "dynamic"]
    return torch.stack([body.pose.p.clone() for body in bodies], dim=1)
