"""ManiSkill tasks with their geometry.

- `make(task, num_envs=...)`: N parallel environments of a task.
- `gym.make("SymSteer/PickCube-v1", num_envs=...)`: the same for users of gymnasium.
- `gym.make("SymSteer/PickCube-single-v1")`: one environment on NumPy arrays.
- `task_class(task)`: layouts, limits and feasible returns without making an environment.
- `task_names()`, `embodiments()`: what there is.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

import mani_skill.envs  # noqa: F401  (fills ManiSkill's own registry first)
import torch

from symsteer.bench.sim import create
from symsteer.bench.sim.environment import Simulator
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.embodiments import EMBODIMENTS
from symsteer.bench.tasks.lift_peg_upright import LiftPegUpright
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.bench.tasks.place_sphere import PlaceSphere
from symsteer.bench.tasks.poke_cube import PokeCube
from symsteer.bench.tasks.pull_cube import PullCube
from symsteer.bench.tasks.push_cube import PushCube
from symsteer.bench.tasks.push_t import PushT
from symsteer.bench.tasks.registration import make_batched, make_single, register
from symsteer.bench.tasks.stack_cube import StackCube
from symsteer.bench.variants import Strength, parse
from symsteer.errors import UserError

__all__ = [
    "SymmetricTask",
    "check_embodiment",
    "embodiments",
    "make",
    "make_batched",
    "make_single",
    "task_class",
    "task_names",
]

_TASKS: dict[str, type[SymmetricTask]] = {
    task.task_id: task
    for task in (
        PushCube,
        PullCube,
        PickCube,
        StackCube,
        PlaceSphere,
        LiftPegUpright,
        PokeCube,
        PushT,
    )
}


def task_names() -> list[str]:
    """Names of all tasks, easiest first."""
    return list(_TASKS)


def embodiments() -> list[str]:
    """Names of all embodiments."""
    return list(EMBODIMENTS)


def check_embodiment(embodiment: str) -> None:
    """Raise `UserError` if there is no such embodiment."""
    if embodiment not in EMBODIMENTS:
        raise UserError(unknown_name("embodiment", embodiment, embodiments()))


def task_class(task: str) -> type[SymmetricTask]:
    """The class of a task, which knows its layouts without a simulation.

    Raises:
        UserError: if there is no such task.
    """
    task = task.removeprefix("SymSteer/")
    if task not in _TASKS:
        raise UserError(unknown_name("task", task, task_names()))
    return _TASKS[task]


def make(
    task: str,
    *,
    num_envs: int,
    embodiment: str = "floating",
    variant: str = "none",
    strength: Strength | None = None,
    sim: Simulator = "cpu",
    obs_mode: str = "state",
    reward_mode: str = "sparse",
    render: bool = False,
    workers: int = 1,
    **kwargs: Any,
) -> SymmetricTask:
    """Make N parallel environments of a task.

    Args:
        task: one of :func:`task_names`.
        num_envs: how many.
        embodiment: ``floating`` (near-exact symmetry) or ``panda`` (the stock arm).
        variant: symmetry-breaking variants, e.g. ``action_gain:0.5+...``; ``none`` for none.
        strength: of a single variant named without one; one number or one per environment.
        sim: ``cpu`` (batched CPU physics) or ``cuda``.
        obs_mode: ManiSkill's; ``state`` is what ``observation_layout`` describes.
        reward_mode: ManiSkill's.
        render: whether ``env.render()`` must work.
        workers: processes that share the environments, at most ``num_envs``. More than one give
            the same numbers from more cores; what lives in the simulation (``env.agent``,
            ``env.scene``, a task's actors) is then out of reach.
        kwargs: further arguments of ManiSkill's task class.

    Raises:
        UserError: unknown task, embodiment, variant or simulator, a strength or the number of
            workers out of range.
    """
    env_class = task_class(task)
    check_embodiment(embodiment)
    kwargs.update(
        sim=sim,
        render=render,
        embodiment=embodiment,
        variant=variant,
        strength=strength,
        obs_mode=obs_mode,
        reward_mode=reward_mode,
    )
    if workers == 1:
        return create(env_class, num_envs, **kwargs)
    variants = parse(variant, strength)
    if strength is not None and torch.as_tensor(strength).ndim:
        kwargs.update(strength=None, per_env={"strength": torch.as_tensor(strength)})
    env = create(env_class, num_envs, workers=workers, attributes={"variants": variants}, **kwargs)
    for part in variants:
        part.bind(env)
    return env


def unknown_name(kind: str, name: str, valid: Sequence[str]) -> str:
    """The sentence for a name that is none of the valid ones, with the nearest of them."""
    near = difflib.get_close_matches(name, valid, n=1, cutoff=0.4)
    hint = f", did you mean {near[0]!r}?" if near else "."
    return f"there is no {kind} {name!r}{hint} Valid: {', '.join(valid)}"


register(_TASKS)
