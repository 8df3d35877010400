"""What SymSteer adds to ManiSkill's task classes: geometry, symmetric resets, variants.

Success, reward and assets stay ManiSkill's. The observation is an ordered dictionary of named
geometric fields whose concatenation is ``observation_layout``; it is a function of poses and
finger positions alone (no velocities, contacts or joint angles), so that it can be rebuilt from
stored states. Positions are relative to the workspace centre, the origin of the world's x-y plane.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.utils import common
from mani_skill.utils.structs import Actor, Pose

from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.sim.rotations import quaternion_to_matrix, transform_body
from symsteer.bench.sim.seeds import reset_order
from symsteer.bench.sim.trees import map_trees, rows_of, write_rows
from symsteer.bench.tasks.embodiments import BODIES, Embodiment
from symsteer.bench.tasks.experts import Intent
from symsteer.bench.tasks.features import Thing, told
from symsteer.bench.tasks.floating import ACTION_LAYOUT
from symsteer.bench.variants import parse
from symsteer.bench.variants.base import Role
from symsteer.bench.variants.breaks import Breaks
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout
from symsteer.variant import UNBROKEN, VariantSpec

GRIPPER_FIELDS = (
    Field("tcp_xy", 1),
    Field("tcp_z", 0),
    # Horizontal parts of the tool frame's three axes. The hand is its own mirror image across
    # its x-z plane, so a mirrored hand's y axis is minus the mirrored y axis.
    Field("tcp_x_axis", 1),
    Field("tcp_y_axis", 1, odd=True),
    Field("tcp_z_axis", 1),
    Field("gripper_width", 0),
)

LCG = (6364136223846793005, 1442695040888963407)
"""Knuth's linear congruential generator modulo 2^64: one episode's key to the next one's."""


def _in_batched_branch(method: Callable) -> Callable:
    """A method during which ``gpu_sim_enabled`` says that the batched branch is used."""

    @functools.wraps(method)
    def run(self: Any, *args: Any, **kwargs: Any) -> Any:
        before, self._batched_branch = self._batched_branch, True
        try:
            return method(self, *args, **kwargs)
        finally:
            self._batched_branch = before

    return run


class SymmetricTask(BaseEnv):
    """Mixin; list it before the ManiSkill task class.

    Args:
        task_id: the name under which the task was made, if it is not the class's own.
        embodiment: ``floating`` or ``panda``.
        variant: which symmetry-breaking variants act, e.g. ``action_gain:0.5`` (``none``: none),
            as text or as data.
        strength: of a single variant that is named without one; one number, or one per
            environment.
        kwargs: as for ManiSkill's class.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = [e.robot_uid for e in BODIES.values()]

    task_id: str
    """Name in the registry, from which :func:`symsteer.bench.tasks.make` makes the same task."""
    max_episode_steps: ClassVar[int]
    gripper_fields: ClassVar[tuple[Field, ...]] = GRIPPER_FIELDS
    task_fields: ClassVar[tuple[Field, ...]]
    things: ClassVar[dict[str, Thing]]
    """Bodies by the names that they have in ``task_fields``; the one to be grasped first."""
    action_layout: ClassVar[Layout] = ACTION_LAYOUT
    workspace_center: ClassVar[tuple[float, float]] = (0.0, 0.0)
    manipulated_name: ClassVar[str]
    """Attribute that holds the object which the robot has to move."""
    spawn_extent: ClassVar[float]
    """Radius about the origin, metres, within which all colliding bodies lie at a reset; parts of
    them that are higher than 10 cm do not count."""
    noise_scale: ClassVar[float] = 1.0
    """Factor on the action noise of diverse demonstrations in this task."""
    mirrored_across_yz: ClassVar[frozenset[str]] = frozenset()
    """Names of actors that are their own mirror image across their body y-z plane but not across
    x-z, the plane by which a reflection mirrors all others."""
    needs_cameras: ClassVar[bool] = False
    """Whether the observation is rendered, for which there must be a Vulkan driver."""
    looks: bool
    """Whether a decision follows the next observation. If not, a task that needs cameras may report
    what it saw last, but for episodes at their time limit."""
    brief: bool
    """Whether only success is asked for, between two decisions of a steering agent: ``evaluate``
    may leave out all else."""
    observation_layout: ClassVar[Layout]
    _gripper_layout: ClassVar[Layout]
    _task_layout: ClassVar[Layout]
    _batched_branch = False

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "task_fields" in cls.__dict__:
            cls._gripper_layout = Layout(cls.gripper_fields)
            cls._task_layout = Layout(cls.task_fields)
            cls.observation_layout = Layout([*cls.gripper_fields, *cls.task_fields])

    def __init__(
        self,
        *args: Any,
        task_id: str | None = None,
        embodiment: str = "floating",
        variant: str | Sequence[VariantSpec] = UNBROKEN,
        strength: Any = None,
        **kwargs: Any,
    ):
        if task_id is not None:
            self.task_id = task_id
        self.embodiment = embodiment
        self.body: Embodiment = BODIES[embodiment]
        self.variants = parse(variant, strength, (self.task_id, embodiment))
        self.breaks = Breaks(self, self.variants)
        self._reset_rows: torch.Tensor | None = None
        self._closed = False
        kwargs.setdefault("control_mode", self.body.control_mode)
        kwargs.setdefault("robot_uids", self.body.robot_uid)
        super().__init__(*args, **kwargs)
        # ManiSkill's belongs to the class and lists modes that this machine may lack.
        modes = self.SUPPORTED_RENDER_MODES if rendering_works() else ()
        self.metadata = {
            "render_modes": [m for m in modes if m != "human" or "DISPLAY" in os.environ],
            "render_fps": self.control_freq,
        }

    @property
    def gpu_sim_enabled(self) -> bool:
        """Whether ManiSkill's batched branch is used, as the caller sees it.

        ManiSkill's own methods choose that branch by it, which runs here on any device. Its
        wrappers conclude that tensors live on a GPU, and ``CPUGymWrapper`` refuses such an
        environment. So it is true while ManiSkill's methods run; at other times it is false for
        one environment on the CPU.
        """
        one_on_cpu = self.num_envs == 1 and self.device.type == "cpu"
        return self.scene.gpu_sim_enabled and (self._batched_branch or not one_on_cpu)

    render_human = _in_batched_branch(BaseEnv.render_human)

    @classmethod
    def is_seen(cls) -> bool:
        """Whether points or a picture take the place of the poses of bodies."""
        return cls.observation_layout.is_seen

    # ------------------------------------------------------------------ scene

    def _load_agent(self, options: dict) -> None:
        BaseEnv._load_agent(self, options, sapien.Pose(p=self.body.root_position))

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.breaks.load_scene()

    @property
    def moving_bodies(self) -> list[Actor]:
        """The task's dynamic bodies: everything that is neither robot nor furniture nor goal."""
        return [a for a in self.scene.actors.values() if a.px_body_type == "dynamic"]

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        with torch.device(self.device):
            rng = self._batched_episode_rng[env_idx]
            self.table_scene.table.set_pose(self.table_scene.table.initial_pose)
            qpos = self.body.initial_qpos(rng, len(env_idx))
            self.agent.reset(torch.as_tensor(qpos, device=self.device))
            self.agent.robot.set_pose(sapien.Pose(p=self.body.root_position))
            self._place_objects(rng, len(env_idx))
            self.breaks.reset(env_idx)

    def intent(self, offset: torch.Tensor) -> Intent:
        """The scripted expert's intent in the present state.

        Args:
            offset: moves the point that is grasped or pushed, ``[N, 3]`` metres.
        """
        raise NotImplementedError

    @property
    def manipulated(self) -> Actor:
        """The object that the robot has to move."""
        return getattr(self, self.manipulated_name)

    def _place_objects(self, rng: BatchedRNG, count: int) -> None:
        """Sample objects and goal of ``count`` environments, one generator each."""
        raise NotImplementedError

    # ------------------------------------------------------------- observation

    def _get_obs_agent(self) -> dict[str, torch.Tensor]:
        tcp = self.seen(self.agent.tcp_pose, "tool")
        width = self.agent.robot.get_qpos()[:, -2:].sum(dim=1, keepdim=True)
        fields = self._observe_gripper(tcp.p, quaternion_to_matrix(tcp.q), width)
        return self._reported(fields, self._gripper_layout)

    def _observe_gripper(
        self, position: torch.Tensor, axes: torch.Tensor, width: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The gripper's fields ``[N, dim]``, in the order of ``gripper_fields``.

        Args:
            position: of the tool centre point, ``[N, 3]`` metres.
            axes: of the tool, ``[N, 3, 3]``, one in each column.
            width: between the fingers, ``[N, 1]`` metres.
        """
        return {
            "tcp_xy": position[:, :2],
            "tcp_z": position[:, 2:],
            "tcp_x_axis": axes[:, :2, 0],
            "tcp_y_axis": axes[:, :2, 1],
            "tcp_z_axis": axes[:, :2, 2],
            "gripper_width": width,
        }

    def seen(self, pose: Pose, role: Role) -> Pose:
        """A true pose as the observation reports it: variants of perception distort it.

        Args:
            pose: of N bodies.
            role: what is looked at.
        """
        return self.breaks.perceive(pose, role)

    def _get_obs_extra(self, info: dict) -> dict[str, torch.Tensor]:
        observed, names = self._observe_task(), [field.name for field in self.task_fields]
        unknown = [name for name in names if name not in observed]
        assert not unknown, f"_observe_task does not tell {unknown}, and no name of `things` does"
        return self._reported({name: observed[name] for name in names}, self._task_layout)

    def _reported(self, fields: dict[str, torch.Tensor], layout: Layout) -> dict[str, torch.Tensor]:
        """The fields as variants of observation report them."""
        return self.breaks.observation(fields, layout)

    @property
    def policy_origin(self) -> torch.Tensor:
        """Where the policy takes the workspace's centre to be, ``[N, 2]`` metres in the world."""
        return self.breaks.origin

    def _observe_task(self) -> dict[str, torch.Tensor]:
        """The task's own fields ``[N, dim]``, in any order.

        By default those that their names define (:func:`symsteer.bench.tasks.features.told`).
        """
        poses = {"tcp": self.seen(self.agent.tcp_pose, "tool")}
        for name, thing in self.things.items():
            poses[name] = self.seen(getattr(self, thing.actor).pose, thing.role)
        return told(self.task_fields, poses, self.things)

    # ------------------------------------------------------------------- step

    def commanded(self, action: torch.Tensor) -> torch.Tensor:
        """What :meth:`step` takes to execute ``action [N, 7]``, which is in the bodies' axes."""
        return action

    def step(self, action: Any) -> tuple:
        """As ManiSkill's, also for whole numbers; reward is float32.

        ``truncated`` is set after ``max_episode_steps``.

        Raises:
            UserError: if the environment was closed, or the action is a list.
        """
        self._check_open()
        if isinstance(action, list | tuple):
            raise UserError(
                f"an action is a tensor or array of shape {self.action_space.shape}, not a "
                f"{type(action).__name__}"
            )
        if hasattr(action, "dtype"):
            action = common.to_tensor(action, device=self.device).float()
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward.float(), terminated, self.elapsed_steps >= self.max_episode_steps, info

    def close(self) -> None:
        """Free the simulation; neither `reset` nor `step` works afterwards."""
        self._closed = True
        super().close()

    def _check_open(self) -> None:
        if self._closed:
            raise UserError("this environment was closed and cannot be used any more; make another")

    @_in_batched_branch
    def _step_action(self, action: Any) -> Any:
        if not self.variants:
            return super()._step_action(action)
        if isinstance(action, torch.Tensor):
            action = self.breaks.action(action.reshape(self.num_envs, -1))
        with self.breaks.step():
            return super()._step_action(action)

    @_in_batched_branch
    def get_info(self) -> dict:
        """As ManiSkill's; where a variant makes steps costly, also ``extra_cost [N]``.

        It is the cost of the last control step besides the usual -1. The reward already contains
        it. It is 0 at success.
        """
        info = super().get_info()
        if (cost := self.breaks.cost) is not None:
            free = info["success"] | (self._elapsed_steps == 0)
            info["extra_cost"] = torch.where(free, torch.zeros_like(cost), cost)
        return info

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """As ManiSkill's minus the ``extra_cost`` of ``info`` (not in reward mode ``none``)."""
        reward = super().get_reward(obs=obs, action=action, info=info)
        if "extra_cost" in info and self.reward_mode != "none":
            reward = reward.float() - info["extra_cost"]
        return reward

    # ------------------------------------------------------------------ resets

    @_in_batched_branch
    def reset(self, seed: Any = None, options: dict | None = None) -> tuple:
        """As ManiSkill's, with one seed per environment that is reset.

        Args:
            seed: a list with one seed per environment being reset (each alone determines its
                environment's initial state), one integer (expanded as ManiSkill does), or None.
            options: ``env_idx`` selects the environments to reset; the others are untouched.

        Raises:
            UserError: if the list of seeds has another length, ``env_idx`` names environments
                that are not there, or the environment was closed.
        """
        self._check_open()
        options = dict(options or {})
        partial, seed = reset_order(seed, options.get("env_idx"), self.num_envs)
        if partial is not None:
            options["env_idx"] = partial = partial.to(self.device)
        if seed is not None:
            gym.Env.reset(self, seed=seed[0])  # for its ``np_random``
        kept = None
        if partial is not None and self.agent is not None:
            # ManiSkill resets the controllers of all environments after a partial reset.
            kept = self.agent.get_controller_state()
        self._reset_rows = partial
        try:
            obs, info = super().reset(seed=seed, options=options)
        finally:
            self._reset_rows = None
        if kept and partial is not None:
            fresh = self.agent.get_controller_state()
            write_rows(kept, rows_of(fresh, partial), partial)
            self.agent.set_controller_state(kept)
        return obs, info

    def _set_main_rng(self, seed: list[int] | None) -> None:
        # It only draws the seeds of an unseeded reset that reconfigures all environments.
        if self._reset_rows is None:
            super()._set_main_rng(seed)

    def _set_episode_rng(self, seed: list[int] | None, env_idx: torch.Tensor) -> None:
        if seed is None or self._reset_rows is None:
            super()._set_episode_rng(seed, env_idx)
        else:
            rows = self._reset_rows.numpy(force=True)
            self._episode_seed[rows] = seed
            self._batched_episode_rng[rows] = BatchedRNG.from_seeds(seed)
            self._episode_rng = self._batched_episode_rng[0]
        self._advance_episode_keys(seed is not None)

    def _advance_episode_keys(self, seeded: bool) -> None:
        """A number for each episode that starts now: its seed, or the successor of the last key.

        ManiSkill keeps an environment's seed over resets without one. Variants that draw noise
        need a new key then; drawing from the generators that place objects would change the
        initial states.
        """
        keys = torch.as_tensor(self._episode_seed, dtype=torch.int64, device=self.device)
        if not hasattr(self, "episode_key"):
            self.episode_key = keys.clone()
        rows = slice(None) if self._reset_rows is None else self._reset_rows
        if seeded:
            self.episode_key[rows] = keys[rows]
        else:
            self.episode_key[rows] = self.episode_key[rows] * LCG[0] + LCG[1]

    # ------------------------------------------------------------------- state

    @_in_batched_branch
    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """As ManiSkill's, and restores the controller's targets too.

        States may be tensors or arrays, batched or (for one environment) not. A state without
        controller targets makes the present pose the target.
        """
        state = map_trees(
            lambda x: x[None] if x.ndim == 1 else x, common.to_tensor(state, device=self.device)
        )
        if env_idx is not None:
            # ManiSkill writes rows in the order of the environments.
            env_idx, order = torch.as_tensor(env_idx, dtype=torch.long, device=self.device).sort()
            state = rows_of(state, order)
        super().set_state_dict(
            {key: state[key] for key in ("actors", "articulations") if key in state}, env_idx
        )
        rows = slice(None) if env_idx is None else env_idx
        targets, restored = self.agent.get_controller_state(), state.get("controller")
        if targets and not restored:
            self.agent.set_controller_state({})
            restored = rows_of(self.agent.get_controller_state(), rows)
        if targets:
            write_rows(targets, restored, rows)
            self.agent.set_controller_state(targets)

    def transform_state(self, state: dict, angle: float, reflect: bool = False) -> dict:
        """Turn a whole simulation state about the workspace centre.

        Args:
            state: as returned by ``get_state_dict``, ``[N, ...]`` tensors.
            angle: rotation about the vertical axis, radians.
            reflect: whether (x, y) -> (x, -y) comes first.

        Raises:
            UserError: for an embodiment whose states do not turn with the world (``panda``).
        """
        table, robot = self.table_scene.table.name, self.agent.robot.name
        turned = {
            "actors": {
                name: value
                if name == table
                else transform_body(value, angle, reflect, name in self.mirrored_across_yz)
                for name, value in state["actors"].items()
            },
            "articulations": {
                name: self.body.transform_robot(value, angle, reflect) if name == robot else value
                for name, value in state["articulations"].items()
            },
        }
        if "controller" in state:
            controller = self.body.transform_controller(state["controller"], angle, reflect)
            turned["controller"] = controller
        return turned

    # ------------------------------------------------------------------ returns

    @classmethod
    def feasible_return(
        cls,
        gamma: float,
        steps_per_decision: int = 1,
        bootstrap_truncation: bool = True,
        step_cost: float = 1.0,
    ) -> tuple[float, float]:
        """Bounds of the discounted return of -``step_cost`` a step until success, 0 from then on.

        They are [-c (1 - gamma^N) / (1 - gamma), 0], with cost c a decision and N decisions an
        episode (DSRL, arXiv 2506.15799).

        Args:
            gamma: discount per decision, in [0, 1].
            steps_per_decision: executed steps of an action chunk, whose rewards are summed.
            bootstrap_truncation: values bootstrap through time-outs, so that N is infinite.
            step_cost: the largest cost of a step, see :func:`symsteer.bench.variants.highest_cost`.

        Returns:
            (lowest, highest).

        Raises:
            UserError: if gamma is out of range, or 1 with an infinite horizon.
        """
        if not 0 <= gamma <= 1 or (gamma == 1 and bootstrap_truncation):
            raise UserError(
                f"gamma must lie in [0, 1), or [0, 1] without bootstrapping; it is {gamma}"
            )
        if bootstrap_truncation:
            return -step_cost * steps_per_decision / (1 - gamma), 0.0
        decisions = math.ceil(cls.max_episode_steps / steps_per_decision)
        return -step_cost * steps_per_decision * sum(gamma**i for i in range(decisions)), 0.0
