"""SymSteer's tasks in gymnasium's registry.

Every task has two ids: ``SymSteer/PickCube-v1`` is ManiSkill-like, N environments on torch
tensors; ``SymSteer/PickCube-single-v1`` is one environment on NumPy arrays, for software that
calls ``gym.make`` with an id and nothing else.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from mani_skill import logger
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from bench.sim import rendering_works
from policies.errors import UserError

if TYPE_CHECKING:
    from bench.tasks.base import SymmetricTask


class EpisodeLimit(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """gymnasium's ``TimeLimit`` for batched environments: each counts its own steps.

    Takes the place, and the limit, of the ``TimeLimit`` that ``gym.make`` put around the
    environment, so that ``gym.make(..., max_episode_steps=100)`` holds; without one (gymnasium's
    ``max_episode_steps=-1``) nothing is ever truncated.
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        self.max_episode_steps: int | None = None
        if isinstance(env, gym.wrappers.TimeLimit):
            self.max_episode_steps = env._max_episode_steps
            env = env.env
        gym.Wrapper.__init__(self, env)

    @property
    def spec(self) -> EnvSpec | None:
        """How ``gym.make`` makes this environment again, limit included."""
        spec = super().spec
        if spec is not None:
            spec.max_episode_steps = self.max_episode_steps
        return spec

    def step(self, action: Any) -> tuple:
        """As the environment's; ``truncated`` ``[N]`` is ruled by the limit alone."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self.max_episode_steps is None:
            truncated = truncated & False
        else:
            truncated = self.get_wrapper_attr("elapsed_steps") >= self.max_episode_steps
        return obs, reward, terminated, truncated, info


def make_batched(task: str, num_envs: int = 1, **kwargs: Any) -> SymmetricTask:
    """Entry point of ``gym.make("SymSteer/PickCube-v1", num_envs=N, ...)``.

    Takes the options of :func:`bench.tasks.make`, and ManiSkill's way of naming a simulator. As
    in ManiSkill, whose tools always name one, a render mode on a machine that cannot render is
    no error until something is rendered.

    Raises:
        UserError: as :func:`bench.tasks.make`, and for an option that neither it nor the task has.
    """
    from bench.tasks import make, task_class, unknown_name

    backend = str(kwargs.pop("sim_backend", "auto"))
    if kwargs.get("render_mode") is not None and not rendering_works():
        logger.warning("render_mode=%r is left out: nothing renders here", kwargs["render_mode"])
        kwargs["render_mode"] = None
    if "cuda" in backend or "gpu" in backend:
        kwargs.setdefault("sim", "cuda")
    valid = _options(make, *(c.__init__ for c in task_class(task).__mro__))
    for name in kwargs:
        if name not in valid:
            raise UserError(unknown_name("option", name, sorted(valid)))
    return make(task, num_envs=num_envs, **kwargs)


def make_single(task: str, **kwargs: Any) -> gym.Env:
    """Entry point of ``gym.make("SymSteer/PickCube-single-v1", ...)``: one environment in NumPy.

    Also serves ids of your own, which fix a variant for software that knows no options::

        gym.register("Lab/WeakPick-v1", "bench.tasks:make_single", max_episode_steps=50,
                     kwargs={"task": "PickCube-v1", "variant": "action_gain:0.5"})

    Args:
        task: one of :func:`bench.tasks.task_names`.
        kwargs: options of :func:`bench.tasks.make` but for ``num_envs``.

    Returns:
        The environment in ManiSkill's ``CPUGymWrapper``; whoever makes it limits its episodes.

    Raises:
        UserError: as :func:`make_batched`, and for several environments.
    """
    if kwargs.pop("num_envs", 1) != 1:
        raise UserError(
            "an id with -single is one environment: leave num_envs out, or use the id without "
            "-single for N environments on torch tensors"
        )
    return CPUGymWrapper(EpisodeLimit(make_batched(task, num_envs=1, **kwargs)))


def register(tasks: Mapping[str, type[SymmetricTask]]) -> None:
    """Register both ids of every task.

    Args:
        tasks: classes by name, e.g. ``PickCube-v1``.
    """
    for name, task in tasks.items():
        stem, _, version = name.rpartition("-v")
        gym.register(
            f"SymSteer/{name}",
            entry_point="bench.tasks:make_batched",
            # Makes gym.make_vec refuse, which would else put batches of one into a batch.
            vector_entry_point="bench.tasks:make_batched",
            max_episode_steps=task.max_episode_steps,
            # Batched torch observations and rewards are not what gymnasium's checker expects.
            disable_env_checker=True,
            order_enforce=False,
            kwargs={"task": name},
            additional_wrappers=(
                WrapperSpec("EpisodeLimit", "bench.tasks.registration:EpisodeLimit", {}),
            ),
        )
        gym.register(
            f"SymSteer/{stem}-single-v{version}",
            entry_point="bench.tasks:make_single",
            max_episode_steps=task.max_episode_steps,
            kwargs={"task": name},
        )


def _options(*functions: Any) -> set[str]:
    """Names of the arguments that may be given by keyword to any of the functions."""
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    parameters = (p for f in functions for p in inspect.signature(f).parameters.values())
    return {p.name for p in parameters if p.kind in kinds} - {"self", "task"}
