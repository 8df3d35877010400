"""How environments are made: by a function call, and by gymnasium's ids."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from numbers import Integral
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401  (fills ManiSkill's own registry first)
import torch
from gymnasium.envs.registration import EnvSpec
from mani_skill import logger
from mani_skill.envs.utils.observations import ALL_VISUAL_TEXTURES
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

from symsteer.bench.sim.environment import Simulator
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.sim.parallel import create
from symsteer.bench.tasks import check_embodiment, task_class, task_name
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.embodiments import BODIES
from symsteer.bench.variants import build, read
from symsteer.errors import UserError
from symsteer.names import check as check_names
from symsteer.variant import UNBROKEN, VariantSpec

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


def make(
    task: str,
    *,
    num_envs: int,
    embodiment: str = "floating",
    variant: str | Sequence[VariantSpec] = UNBROKEN,
    strength: Any = None,
    sim: Simulator = "cpu",
    obs_mode: str = "state",
    reward_mode: str = "sparse",
    render: bool = False,
    workers: int = 1,
    **kwargs: Any,
) -> SymmetricTask:
    """Make N parallel environments of a task.

    Args:
        task: a name of :data:`symsteer.bench.tasks.TASKS`, or ``package.module:Class``.
        num_envs: how many.
        embodiment: ``floating`` (near-exact symmetry) or ``panda`` (the stock arm).
        variant: symmetry-breaking variants, e.g. ``action_gain:0.5+wind:1``, as text or as data;
            ``none`` for none.
        strength: of a single variant that is named without one; one number or one per
            environment.
        sim: ``cpu`` (batched CPU physics) or ``cuda``.
        obs_mode: ManiSkill's; ``state`` is what ``observation_layout`` describes.
        reward_mode: ManiSkill's.
        render: whether ``env.render()`` must work.
        workers: processes that share the environments, at most ``num_envs``. More than one give
            the same numbers from more cores; objects of the simulation (``env.agent``,
            ``env.scene``, a task's actors) cannot be read then.
        kwargs: further arguments of ManiSkill's task class.

    Raises:
        UserError: unknown task, embodiment, variant or simulator, a strength or the number of
            workers out of range.
    """
    env_class = task_class(task)
    check_embodiment(embodiment)
    specs = read(variant, strength, (task_name(task), embodiment))
    for spec in specs:
        if isinstance(spec.strength, tuple) and len(spec.strength) != num_envs:
            raise UserError(
                f"{len(spec.strength)} strengths of {spec.name!r} were given for {num_envs} "
                "environments; give one number, or one for each environment"
            )
    kwargs.update(
        sim=sim,
        render=render,
        task_id=task_name(task),
        embodiment=embodiment,
        variant=specs,
        obs_mode=obs_mode,
        reward_mode=reward_mode,
    )
    if workers > 1 and len(specs) == 1 and isinstance(specs[0].strength, tuple):
        kwargs.update(variant=specs[0].name, strength=torch.as_tensor(specs[0].strength))
    env = create(env_class, num_envs, workers=workers, **kwargs)
    if workers > 1:
        env.variants = build(specs)
        for acting in env.variants:
            acting.env = env
    return env


def make_batched(task: str, num_envs: int = 1, **kwargs: Any) -> SymmetricTask:
    """Entry point of ``gym.make("SymSteer/PickCube-v1", num_envs=N, ...)``.

    Takes the options of :func:`make`, where ``None`` means that an option is not given, and
    ManiSkill's names of simulator and robot. ManiSkill's tools always give a render mode; on a
    machine that cannot render it is left out with a warning.

    Raises:
        UserError: as :func:`make`, and for an option that neither it nor the task
            has, or whose value they do not know.
    """
    options = {name: value for name, value in kwargs.items() if value is not None}
    _check(task, num_envs, options)
    backend = str(options.pop("sim_backend", "auto")).partition(":")[0]
    sim = _SIMULATORS[backend]
    if sim and options.setdefault("sim", sim) != sim:
        raise UserError(
            f"sim={options['sim']!r} contradicts sim_backend={backend!r}; leave one of them out"
        )
    if "render_mode" in options and not rendering_works():
        mode = options.pop("render_mode")
        logger.warning("render_mode=%r is left out: nothing renders here", mode)
    return make(task, num_envs=int(num_envs), **options)


def make_single(task: str, **kwargs: Any) -> gym.Env:
    """Entry point of ``gym.make("SymSteer/PickCube-single-v1", ...)``: one environment in NumPy.

    Use it for ids of your own that fix a variant, for software that takes an id only::

        gym.register("Lab/WeakPick-v1", "symsteer.bench.tasks:make_single", max_episode_steps=50,
                     kwargs={"task": "PickCube-v1", "variant": "action_gain:0.5"})

    Args:
        task: a name of :data:`symsteer.bench.tasks.TASKS`.
        kwargs: options of :func:`make` except ``num_envs``.

    Returns:
        The environment in ManiSkill's ``CPUGymWrapper``; ``gym.make`` limits its episodes.

    Raises:
        UserError: as :func:`make_batched`, and for several environments.
    """
    if kwargs.pop("num_envs", 1) != 1:
        raise UserError(
            "an id with -single is one environment: leave num_envs out, or use the id without "
            "-single for N environments on torch tensors"
        )
    return CPUGymWrapper(EpisodeLimit(make_batched(task, num_envs=1, **kwargs)))


def _check(task: str, num_envs: Any, options: dict[str, Any]) -> None:
    """Refuse options that would fail later with an unclear message, or be ignored."""
    env_class = task_class(task)
    constructors = [vars(c)["__init__"] for c in env_class.__mro__ if "__init__" in vars(c)]
    names = _keywords(make, *constructors) - {"self", "task", "task_id"}
    check_names("option", options, sorted(names))
    if not isinstance(num_envs, Integral):
        raise UserError(f"num_envs must be a whole number; it is {num_envs!r}")
    for name, valid in {
        "sim_backend": list(_SIMULATORS),
        "reward_mode": env_class.SUPPORTED_REWARD_MODES,
        "render_mode": env_class.SUPPORTED_RENDER_MODES,
        "obs_mode": _OBS_MODES,
    }.items():
        # Several kinds of observation are joined by "+", a device follows a simulator after ":".
        given = str(options.get(name, valid[0])).partition(":")[0]
        check_names(name, given.split("+"), valid)
    variant = options.get("variant", UNBROKEN)
    if not isinstance(variant, str) and not all(isinstance(v, VariantSpec) for v in variant):
        raise UserError(
            f"variant is a text such as 'action_gain:0.5', several joined by '+'; it is {variant!r}"
        )
    embodiment = options.get("embodiment", "floating")
    check_embodiment(embodiment)
    body = BODIES[embodiment]
    if options.get("robot_uids", body.robot_uid) != body.robot_uid:
        raise UserError(
            f"robot_uids={options['robot_uids']!r} is not the robot of embodiment {body.name!r}; "
            f"leave robot_uids out and choose an embodiment: {', '.join(BODIES)}"
        )
    broken = variant not in (UNBROKEN, ())
    if broken and options.get("control_mode", body.control_mode) != body.control_mode:
        raise UserError(
            f"variants act on control mode {body.control_mode!r}, not on "
            f"{options['control_mode']!r}; leave control_mode out"
        )


def _keywords(*functions: Any) -> set[str]:
    """Names of the keyword arguments of all functions together."""
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    parameters = (p for f in functions for p in inspect.signature(f).parameters.values())
    return {p.name for p in parameters if p.kind in kinds}


class EpisodeLimit(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """gymnasium's ``TimeLimit`` for batched environments: each counts its own steps.

    Replaces the ``TimeLimit`` that ``gym.make`` put around the environment and takes over its
    limit, so that ``gym.make(..., max_episode_steps=100)`` works. Without one (gymnasium's
    ``max_episode_steps=-1``) nothing is truncated.
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
        """What ``gym.make`` needs to make this environment again, limit included."""
        spec = super().spec
        if spec is not None:
            spec.max_episode_steps = self.max_episode_steps
            strength: Any = spec.kwargs.get("strength")
            if hasattr(strength, "tolist"):
                spec.kwargs["strength"] = strength.tolist()  # JSON has no tensors
        return spec

    def __getattr__(self, name: str) -> Any:
        """What ManiSkill's wrapper for Stable-Baselines3 reads of the environment."""
        if name in ("num_envs", "single_observation_space", "single_action_space"):
            return getattr(self.env, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def step(self, action: Any) -> tuple:
        """As the environment's; ``truncated`` ``[N]`` depends on the limit only."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self.max_episode_steps is None:
            truncated = truncated & False
        else:
            truncated = self.get_wrapper_attr("elapsed_steps") >= self.max_episode_steps
        return obs, reward, terminated, truncated, info
