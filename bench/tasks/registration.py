"""SymSteer's tasks in gymnasium's registry.

Every task has two ids: ``SymSteer/PickCube-v1`` is ManiSkill-like, N environments on torch
tensors; ``SymSteer/PickCube-single-v1`` is one environment on NumPy arrays, for software that
calls ``gym.make`` with an id and nothing else.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from numbers import Integral
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from mani_skill import logger
from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from symsteer.bench.sim import rendering_works
from symsteer.bench.tasks.embodiments import EMBODIMENTS
from symsteer.errors import UserError

if TYPE_CHECKING:
    from symsteer.bench.tasks.base import SymmetricTask


_SIMULATORS = {
    "auto": "",
    **dict.fromkeys(("cpu", "physx_cpu", "physx_cpu_batched"), "cpu"),
    **dict.fromkeys(("cuda", "gpu", "physx_cuda"), "cuda"),
}
"""What ManiSkill's ``sim_backend`` names, as our ``sim``."""

_OBS_MODES = (
    *("state", "state_dict", "none", "sensor_data", "pointcloud", "rgbd"),
    *ALL_VISUAL_TEXTURES,
)


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
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
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

    Takes the options of :func:`symsteer.make`, where ``None`` means that an option is not
    given, and ManiSkill's ways of naming simulator and robot. As in ManiSkill, whose tools always
    name one, a render mode on a machine that cannot render is no error until something is
    rendered.

    Raises:
        UserError: as :func:`symsteer.make`, and for an option that neither it nor the task
            has, or whose value they do not know.
    """
    from symsteer.bench.tasks import make

    options = {name: value for name, value in kwargs.items() if value is not None}
    _check(task, num_envs, options)
    backend = str(options.pop("sim_backend", "auto")).partition(":")[0]
    if (
        backend != "auto"
        and options.setdefault("sim", _SIMULATORS[backend]) != _SIMULATORS[backend]
    ):
        raise UserError(
            f"sim={options['sim']!r} contradicts sim_backend={backend!r}; leave one of them out"
        )
    if "render_mode" in options and not rendering_works():
        mode = options.pop("render_mode")
        logger.warning("render_mode=%r is left out: nothing renders here", mode)
    return make(task, num_envs=int(num_envs), **options)


def make_single(task: str, **kwargs: Any) -> gym.Env:
    """Entry point of ``gym.make("SymSteer/PickCube-single-v1", ...)``: one environment in NumPy.

    Also serves ids of your own, which fix a variant for software that knows no options::

        gym.register("Lab/WeakPick-v1", "symsteer.bench.tasks:make_single", max_episode_steps=50,
                     kwargs={"task": "PickCube-v1", "variant": "action_gain:0.5"})

    Args:
        task: one of :func:`symsteer.bench.tasks.task_names`.
        kwargs: options of :func:`symsteer.bench.tasks.make` but for ``num_envs``.

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
            entry_point="symsteer.bench.tasks:make_batched",
            # Makes gym.make_vec refuse, which would else put batches of one into a batch.
            vector_entry_point="symsteer.bench.tasks:make_batched",
            max_episode_steps=task.max_episode_steps,
            # Batched torch observations and rewards are not what gymnasium's checker expects.
            disable_env_checker=True,
            order_enforce=False,
            kwargs={"task": name},
            additional_wrappers=(
                WrapperSpec("EpisodeLimit", "symsteer.bench.tasks.registration:EpisodeLimit", {}),
            ),
        )
        gym.register(
            f"SymSteer/{stem}-single-v{version}",
            entry_point="symsteer.bench.tasks:make_single",
            max_episode_steps=task.max_episode_steps,
            kwargs={"task": name},
        )


def _check(task: str, num_envs: Any, options: dict[str, Any]) -> None:
    """Refuse options that would fail far from their cause, or be ignored."""
    from symsteer.bench.tasks import make, task_class, unknown_name

    env_class = task_class(task)
    constructors = [vars(c)["__init__"] for c in env_class.__mro__ if "__init__" in vars(c)]
    names = _keywords(make, *constructors) - {"self", "task"}
    for name in options:
        if name not in names:
            raise UserError(unknown_name("option", name, sorted(names)))
    if not isinstance(num_envs, Integral):
        raise UserError(f"num_envs must be a whole number; it is {num_envs!r}")
    for name, valid in {
        "sim_backend": list(_SIMULATORS),
        "reward_mode": env_class.SUPPORTED_REWARD_MODES,
        "render_mode": env_class.SUPPORTED_RENDER_MODES,
        "obs_mode": _OBS_MODES,
    }.items():
        # Several kinds of observation are joined by "+", a device follows a simulator after ":".
        for part in str(options.get(name, valid[0])).partition(":")[0].split("+"):
            if part not in valid:
                raise UserError(unknown_name(name, part, valid))
    variant = options.get("variant", "none")
    if not isinstance(variant, str):
        raise UserError(
            f"variant is a text such as 'action_gain:0.5', several joined by '+'; it is {variant!r}"
        )
    body = EMBODIMENTS.get(options.get("embodiment", "floating"))
    if body and options.get("robot_uids", body.robot_uid) != body.robot_uid:
        raise UserError(
            f"robot_uids={options['robot_uids']!r} is not the robot of embodiment {body.name!r}; "
            f"leave robot_uids out and choose an embodiment: {', '.join(EMBODIMENTS)}"
        )
    if (
        body
        and variant != "none"
        and options.get("control_mode", body.control_mode) != (body.control_mode)
    ):
        raise UserError(
            f"variants act on control mode {body.control_mode!r}, not on "
            f"{options['control_mode']!r}; leave control_mode out"
        )


def _keywords(*functions: Any) -> set[str]:
    """Names of the arguments that may be given by keyword to any of the functions."""
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    parameters = (p for f in functions for p in inspect.signature(f).parameters.values())
    return {p.name for p in parameters if p.kind in kinds}
