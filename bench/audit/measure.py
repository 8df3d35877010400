"""Simulate all turned copies of visited states in a broken environment.

Copy g of state s starts in g s and executes g a. All copies of a batch start in new scenes that
were reset with the same seed and stepped equally often, so PhysX's memory of earlier contacts is
the same for all. One more copy is the state itself, turned by one radian and back: it differs by
rounding only and shows how small a defect can be measured.
"""

from __future__ import annotations

import gc
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from symsteer.bench.audit.states import Element, Turner, Visited, seen_from, task_state
from symsteer.bench.sim.environment import Simulator
from symsteer.bench.sim.rotations import planar_matrix, transform_quaternion
from symsteer.bench.sim.trees import join_trees, map_trees, rows_of
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.variants.base import overriding
from symsteer.policies.geometry import Group

SCENES = 320
"""Scenes of the broken environment. Twice as many exist during a reconfiguration, and a process can
hold at most ``symsteer.bench.sim.environment.MAX_SCENES``."""

DRAWS = 24
"""Observations of each state if observations are random."""

Tensors = dict[str, torch.Tensor]


@dataclass(frozen=True)
class Copies:
    """Results of S states and their G copies; the first copy is the state itself.

    Lengths are in metres, angles in radians. "Turned back" means transformed by the inverse
    element.

    Attributes:
        moving, policy: attributes of the states, ``[S]`` bool; see
            :class:`~symsteer.bench.audit.states.Visited`.
        reached: which copies exist, ``[S, G]`` bool (an arm cannot reach every turned state).
        place: initial position of each copy's tool and object, relative to the policy's origin,
            ``[S, G, 2]`` each.
        positions, quaternions: turned-back positions ``[S, G + 1, 2, 3]`` and quaternions
            ``[S, G + 1, 2, 4]`` of tool and object at the start and the end of the decision; the
            last of the G + 1 is the copy that differs by rounding.
        cost: cost of a step (1 plus the extra cost of the variants until success, then 0), mean
            over the decision's steps, ``[S, G]``.
        dense: ManiSkill's normalised dense reward minus the extra cost of the variants, likewise.
        function_cost, function_dense: the same where every step starts and ends in the turned
            states of the unbroken task, ``[S, G]``.
        observations: turned-back observations of the copies, K draws each,
            ``[S, G, K, obs_dim]``.
        observations_again: a second set of draws for the state itself, ``[S, K, obs_dim]``.
    """

    moving: torch.Tensor
    policy: torch.Tensor
    reached: torch.Tensor
    place: Tensors
    positions: Tensors
    quaternions: Tensors
    cost: torch.Tensor
    dense: torch.Tensor
    function_cost: torch.Tensor
    function_dense: torch.Tensor
    observations: torch.Tensor
    observations_again: torch.Tensor


@dataclass(frozen=True)
class Resets:
    """Features of R resets, and of R other resets turned at random, ``[R, obs_dim]`` each."""

    original: torch.Tensor
    turned: torch.Tensor


class Experiment:
    """The broken environments of one audit, and the unbroken ones in which states are observed.

    Args:
        reference: the unbroken task.
        variant: variant of the broken environments.
        group: a finite group.
        visited: the states; their number determines the number of scenes.
        seed: of resets and draws.
        sim: ``cpu`` or ``cuda``.
    """

    def __init__(
        self,
        reference: SymmetricTask,
        variant: str,
        group: Group,
        visited: Visited,
        seed: int,
        sim: Simulator = "cpu",
    ) -> None:
        self.reference, self.visited, self.seed = reference, visited, seed
        self.elements: tuple[Element, ...] = group.elements
        # Batches of equal size leave few scenes of the last batch unused.
        batches = math.ceil(len(visited) * (group.order + 1) / SCENES)
        self.batch = math.ceil(len(visited) / batches)
        self.turner = Turner(reference)
        self.env = make(
            reference.task_id,
            num_envs=self.batch * (group.order + 1),
            embodiment=reference.embodiment,
            variant=variant,
            sim=sim,
            reward_mode="normalized_dense",
        )
        self.fresh = True
        self.centre = self.env.policy_origin[0].cpu()
        mesh = self.env.manipulated.get_first_collision_mesh(to_world_frame=False)
        self.corners = torch.tensor(list(itertools.product(*mesh.bounds.T)), dtype=torch.float64)
        """Corners of the manipulated object's bounding box in its own frame, ``[8, 3]``."""

    def close(self) -> None:
        """Free the scenes at once: the number that a process can hold is limited."""
        self.env.close()
        del self.env
        gc.collect()

    # ------------------------------------------------------------------ copies

    def copies(self) -> Copies:
        """Simulate all copies of all states."""
        random = self._observation_is_random()
        parts = []
        for start in range(0, len(self.visited), self.batch):
            # A short last batch is filled with copies of the last state, which are dropped.
            rows = torch.arange(start, start + self.batch).clamp(max=len(self.visited) - 1)
            keep = min(self.batch, len(self.visited) - start)
            parts.append(rows_of(self._batch(rows, random), torch.arange(keep)))
        return join_trees(parts)

    def _batch(self, rows: torch.Tensor, random: bool) -> Copies:
        env, visited, elements = self.env, self.visited, self.elements
        order, count = len(elements), len(rows)
        state, path = rows_of(visited.state, rows), rows_of(visited.path, rows)
        turned = [self.turner.turn(state, g, self.centre) for g in elements]
        starts = [copy for copy, _ in turned]
        reached = torch.stack([mask for _, mask in turned], dim=1)
        floor = self._rounded(state)
        actions = visited.actions[rows]
        layout = env.action_layout
        plan = torch.cat([layout.transform(actions, *g) for g in elements] + [actions])

        # New scenes, so that all copies have the same history.
        options = {} if self.fresh else {"reconfigure": True}
        env.reset(seed=[self.seed] * env.num_envs, options=options)
        self.fresh = False
        scenes = join_trees([*starts, floor])
        self._put(scenes)
        observations, again = self._observe(scenes, count, random)
        if random:
            env.reset(seed=[self.seed] * env.num_envs)
            self._put(scenes)

        poses = [self._poses()]
        place = {
            body: self._split(p[:, :2] - self.centre, count)[:, :order]
            for body, (p, _) in poses[0].items()
        }
        cost, dense = torch.zeros(env.num_envs), torch.zeros(env.num_envs)
        alive = torch.ones(env.num_envs)
        steps = plan.shape[1]
        for step in range(steps):
            before = env.agent.tcp_pose.p.clone()
            _, reward, _, _, info = env.step(plan[:, step].to(env.device))
            alive = alive * (~info["success"].cpu()).float()
            cost = cost + alive * (1 + self._extra_cost(before, info)).cpu() / steps
            dense = dense + reward.cpu() / steps
        poses.append(self._poses())

        function_cost, function_dense, both = self._reward_function(scenes, path, plan, count)
        positions, quaternions = self._turned_back(poses, count)
        return Copies(
            moving=visited.moving[rows],
            policy=visited.policy[rows],
            reached=reached & both,
            place=place,
            positions=positions,
            quaternions=quaternions,
            cost=self._split(cost, count)[:, :order],
            dense=self._split(dense, count)[:, :order],
            function_cost=function_cost,
            function_dense=function_dense,
            observations=observations,
            observations_again=again,
        )

    def _rounded(self, state: dict[str, Any]) -> dict[str, Any]:
        """The state turned by one radian and back: equal up to rounding."""
        if self.turner.arm is None:
            there, _ = self.turner.turn(state, (1.0, False), self.centre)
            return self.turner.turn(there, (-1.0, False), self.centre)[0]
        # Only the objects: inverse kinematics would return other joint angles of the arm.
        there = self.reference.transform_state({**state, "articulations": {}}, 1.0)
        back = self.reference.transform_state(there, -1.0)
        return {**back, "articulations": state["articulations"]}

    def _put(self, state: dict[str, Any]) -> None:
        """Set the state of all scenes; objects that a variant has added stay in place."""
        whole = self.env.get_state_dict()
        bodies = {kind: {**whole[kind], **state[kind]} for kind in ("actors", "articulations")}
        self.env.set_state_dict({**whole, **state, **bodies})

    def _poses(self) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Positions and quaternions of tool and object in every scene."""
        tool, thing = self.env.agent.tcp_pose, self.env.manipulated.pose
        return {
            "tool": (tool.p.cpu().clone(), tool.q.cpu().clone()),
            "object": (thing.p.cpu().clone(), thing.q.cpu().clone()),
        }

    def _split(self, values: torch.Tensor, count: int) -> torch.Tensor:
        """Reshape ``[(G + 1) * S, ...]``, ordered by copy, to ``[S, G + 1, ...]``."""
        return values.unflatten(0, (-1, count)).transpose(0, 1)

    def _turned_back(
        self, poses: list[dict[str, tuple[torch.Tensor, torch.Tensor]]], count: int
    ) -> tuple[Tensors, Tensors]:
        positions, quaternions = {}, {}
        inverses = [_inverse(g) for g in self.elements] + [(0.0, False)]
        mirrored = self.env.manipulated.name in self.env.mirrored_across_yz
        for body in ("tool", "object"):
            p = self._split(torch.stack([w[body][0] for w in poses], dim=1), count).double()
            q = self._split(torch.stack([w[body][1] for w in poses], dim=1), count).double()
            centre = torch.cat([self.centre.double(), torch.zeros(1, dtype=torch.float64)])
            back_p, back_q = [], []
            for g, inverse in enumerate(inverses):
                matrix = planar_matrix(*inverse, p)
                back_p.append((p[:, g] - centre) @ matrix.T + centre)
                across_yz = body == "object" and mirrored
                back_q.append(transform_quaternion(q[:, g], *inverse, across_yz))
            positions[body] = torch.stack(back_p, dim=1)
            quaternions[body] = torch.stack(back_q, dim=1)
        return positions, quaternions

    # ------------------------------------------------------------------ reward

    def _extra_cost(self, before: torch.Tensor, info: dict[str, Any]) -> torch.Tensor:
        """Extra cost of the variants for a step whose tool started at ``before``, ``[N]``."""
        moved = self.env.agent.tcp_pose.p - before
        cost = torch.zeros(self.env.num_envs, device=self.env.device)
        for variant in overriding(self.env.variants, "extra_cost"):
            cost = cost + variant.extra_cost(moved)
        return torch.where(info["success"], torch.zeros_like(cost), cost)

    def _reward_function(
        self, scenes: dict[str, Any], path: dict[str, Any], plan: torch.Tensor, count: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Cost and dense reward of turned transitions of the unbroken task, and which copies exist.

        All are ``[S, G]``. The outcomes are set, not simulated: neither the broken dynamics nor
        contact forces enter.

        Args:
            scenes: the states in which all scenes start.
            path: the states after each step, ``[S, T, ...]``.
            plan: the actions of all scenes, ``[(G + 1) * S, T, 7]``.
            count: number S of states.
        """
        env, steps = self.env, plan.shape[1]
        self._put(scenes)
        before = env.agent.tcp_pose.p.clone()
        reached = torch.ones(count, len(self.elements), dtype=torch.bool)
        cost, dense = torch.zeros(env.num_envs), torch.zeros(env.num_envs)
        alive = torch.ones(env.num_envs)
        for step in range(steps):
            after = map_trees(lambda later, k=step: later[:, k], path)
            turned = [self.turner.turn(after, g, self.centre) for g in self.elements]
            reached &= torch.stack([mask for _, mask in turned], dim=1)
            self._put(join_trees([*[copy for copy, _ in turned], after]))
            info = env.get_info()
            extra = self._extra_cost(before, info)
            before = env.agent.tcp_pose.p.clone()
            reward = env.compute_normalized_dense_reward(
                env.get_obs(info), action=plan[:, step].to(env.device), info=info
            )
            alive = alive * (~info["success"].cpu()).float()
            cost = cost + alive * (1 + extra).cpu() / steps
            dense = dense + (reward - extra).cpu() / steps
        order = len(self.elements)
        return self._split(cost, count)[:, :order], self._split(dense, count)[:, :order], reached

    # ------------------------------------------------------------- observation

    def _observation_is_random(self) -> bool:
        """Whether the observation of the same state depends on the seed of the reset."""
        rows = torch.zeros(self.env.num_envs, dtype=torch.long)
        state = rows_of(self.visited.state, rows)
        seen = []
        for seed in (self.seed, self.seed + 1):
            self.env.reset(seed=[seed] * self.env.num_envs)
            self._put(state)
            seen.append(self.env.get_obs().cpu().clone())
        return not torch.equal(seen[0], seen[1])

    def _observe(
        self, states: dict[str, Any], count: int, random: bool
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Turned-back observations ``[S, G, K, dim]`` and of the states again ``[S, K, dim]``.

        Every scene and every draw of random observations has its own seed.
        """
        env, layout = self.env, self.env.observation_layout
        draws = []
        if random:
            rng = np.random.default_rng([self.seed, 5])
            for _ in range(DRAWS):
                env.reset(seed=np.asarray(rng.integers(2**31, size=env.num_envs)).tolist())
                self._put(states)
                draws.append(env.get_obs().cpu().clone())
        else:
            draws.append(env.get_obs().cpu().clone())
        seen = self._split(torch.stack(draws, dim=1), count).double()
        order = len(self.elements)
        back = [layout.transform(seen[:, g], *_inverse(self.elements[g])) for g in range(order)]
        return torch.stack(back, dim=1), seen[:, order]

    # ------------------------------------------------------------------ resets

    def resets(self, count: int) -> Resets:
        """Features of ``count`` resets, and of as many other resets turned at random.

        Features are the unbroken task's observation of the state, relative to the policy's
        origin.
        """
        rng = np.random.default_rng([self.seed, 6])
        features = self._features(rng, 2 * count)
        original, turned = features[:count], features[count:].clone()
        layout = self.env.observation_layout
        choice = rng.integers(1, len(self.elements), size=count)
        for g, element in enumerate(self.elements):
            rows = torch.as_tensor(choice == g)
            turned[rows] = layout.transform(turned[rows], *element)
        return Resets(original, turned)

    def _features(self, rng: np.random.Generator, count: int) -> torch.Tensor:
        found: list[torch.Tensor] = []
        known = self.visited.state
        while sum(map(len, found)) < count:
            seeds = np.asarray(rng.integers(2**31, size=self.env.num_envs)).tolist()
            self.env.reset(seed=seeds)
            state = task_state(self.env)
            state |= {k: {n: state[k][n] for n in known[k]} for k in ("actors", "articulations")}
            state.pop("controller", None)
            found.append(self._observe_unbroken(seen_from(state, self.centre)))
        return torch.cat(found)[:count].double()

    def _observe_unbroken(self, state: dict[str, Any]) -> torch.Tensor:
        env = self.reference
        total = len(next(iter(state["actors"].values())))
        seen = []
        for start in range(0, total, env.num_envs):
            rows = torch.arange(start, start + env.num_envs).clamp(max=total - 1)
            env.set_state_dict(rows_of(state, rows))
            seen.append(env.get_obs().cpu().clone())
        # Move the robot's base back.
        env.reset(seed=0)
        return torch.cat(seen)[:total]


def _inverse(element: Element) -> Element:
    angle, reflect = element
    return element if reflect else (-angle, False)
