"""Simulate all turned copies of visited states in a broken environment.

Copy g of state s starts in g s and executes g a. All copies of a batch start in new scenes that
were reset with the same seed and stepped equally often, so PhysX's memory of earlier contacts is
the same for all. One more copy is the state itself, turned by one radian and back: it differs by
rounding only and shows how small a defect can be measured.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from symsteer.bench.audit.states import Element, Turner, Visited, seen_from, task_state
from symsteer.bench.sim.rotations import planar_matrix, quaternion_to_matrix, transform_quaternion
from symsteer.bench.sim.trees import join_trees, map_trees, rows_of
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.variants.base import overriding
from symsteer.policies.contract import ChunkPolicy
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
        poses: turned-back positions and quaternions of tool and object at the start and the end of
            the decision, ``[S, G + 1, 2, 7]`` each; the last of the G + 1 is the copy that differs
            by rounding.
        rewards: mean over the decision's steps, ``[S, G]`` each: ``cost`` of a step (1 plus the
            extra cost of the variants until success, then 0) and ``dense`` (ManiSkill's normalised
            dense reward minus the extra cost) where every step starts and ends in the turned states
            of the unbroken task; ``outcome_cost`` and ``outcome_dense`` of what was simulated.
        observations: turned-back observations of the copies, K draws each,
            ``[S, G, K, obs_dim]``.
        observations_again: a second set of draws for the state itself, ``[S, K, obs_dim]``.
    """

    moving: torch.Tensor
    policy: torch.Tensor
    reached: torch.Tensor
    place: Tensors
    poses: Tensors
    rewards: Tensors
    observations: torch.Tensor
    observations_again: torch.Tensor

    @property
    def compared(self) -> np.ndarray:
        """States that have at least one turned copy, ``[S]`` bool."""
        return self.reached[:, 1:].any(dim=1).numpy()

    def mean(self, values: torch.Tensor, first: int = 1) -> np.ndarray:
        """Mean over the copies that exist, from ``first`` on: ``[S, G]`` or ``[S, G + 1]`` to
        ``[S]``; nan if there is none."""
        mask = self.reached[:, first:].double()
        total = (values[:, first : self.reached.shape[1]].double() * mask).sum(dim=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return total.numpy() / mask.sum(dim=1).numpy()

    def lengths(self, body: str, corners: torch.Tensor) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Mean distance of the copies from the state's own, and mean motion of all: ``[S]`` each.

        Horizontally and vertically: of the tool's centre point, or of the object's corners (mean
        over these).
        """
        points = self.poses[body][..., None, :3]
        if body == "object":
            points = points + corners @ quaternion_to_matrix(self.poses[body][..., 3:]).mT
        start, end = points.unbind(dim=2)
        apart, moved = end - end[:, :1], end - start
        return {
            "horizontal": (
                self.mean(apart[..., :2].norm(dim=-1).mean(dim=-1)),
                self.mean(moved[..., :2].norm(dim=-1).mean(dim=-1), first=0),
            ),
            "vertical": (
                self.mean(apart[..., 2].abs().mean(dim=-1)),
                self.mean(moved[..., 2].abs().mean(dim=-1), first=0),
            ),
        }


class Experiment:
    """The broken environments of one audit, and the unbroken ones in which states are observed.

    Args:
        reference: the unbroken task.
        variant: variant of the broken environments.
        group: a finite group.
        visited: the states; their number determines the number of scenes.
        seed: of resets and draws.
        policy: makes of an observation what agents see; None: they see all of it.
    """

    def __init__(
        self,
        reference: SymmetricTask,
        variant: str,
        group: Group,
        visited: Visited,
        seed: int,
        policy: ChunkPolicy | None = None,
    ) -> None:
        self.reference, self.visited, self.seed = reference, visited, seed
        self.see = policy.see if policy else lambda obs: obs
        self.layout = policy.obs_layout if policy else reference.observation_layout
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
            reward_mode="normalized_dense",
        )
        self.fresh = True
        self.centre = self.env.policy_origin[0].cpu()
        mesh = self.env.manipulated.get_first_collision_mesh(to_world_frame=False)
        self.corners = torch.tensor(list(itertools.product(*mesh.bounds.T)), dtype=torch.float64)
        """Corners of the manipulated object's bounding box in its own frame, ``[8, 3]``."""

    def __enter__(self) -> Experiment:
        return self

    def __exit__(self, *error: object) -> None:
        self.env.close()

    # ------------------------------------------------------------------ copies

    def copies(self) -> Copies:
        """Simulate all copies of all states."""
        random = self._observation_is_random()
        batches = []
        for start in range(0, len(self.visited), self.batch):
            # A short last batch is filled with copies of the last state, which are dropped.
            rows = torch.arange(start, start + self.batch).clamp(max=len(self.visited) - 1)
            keep = min(self.batch, len(self.visited) - start)
            batches.append(rows_of(self._batch(rows, random), torch.arange(keep)))
        return join_trees(batches)

    def _batch(self, rows: torch.Tensor, random: bool) -> Copies:
        env, elements = self.env, self.elements
        visited = rows_of(self.visited, rows)
        starts, reached = self._turned(visited.state)
        scenes = join_trees([*starts, self._rounded(visited.state)])
        turned_actions = [env.action_layout.transform(visited.actions, *g) for g in elements]
        plan = torch.cat([*turned_actions, visited.actions])

        # New scenes, so that all copies have the same history.
        env.reset(
            seed=[self.seed] * env.num_envs, options={} if self.fresh else {"reconfigure": True}
        )
        self.fresh = False
        self._put(scenes)
        observations, again = self._observe(scenes, random)
        if random:
            env.reset(seed=[self.seed] * env.num_envs)
            self._put(scenes)

        before = self._poses()
        place = {
            body: self._split(pose[:, :2] - self.centre)[:, : len(elements)]
            for body, pose in before.items()
        }
        simulated = self._rewards(plan)
        after = self._poses()
        poses = {body: self._turned_back(body, before[body], after[body]) for body in before}
        outcomes = []
        for step in range(plan.shape[1]):
            later = map_trees(lambda states, k=step: states[:, k], visited.path)
            copies, possible = self._turned(later)
            outcomes.append(join_trees([*copies, later]))
            reached &= possible
        self._put(scenes)
        return Copies(
            moving=visited.moving,
            policy=visited.policy,
            reached=reached,
            place=place,
            poses=poses,
            rewards=self._rewards(plan, outcomes)
            | {f"outcome_{name}": value for name, value in simulated.items()},
            observations=observations,
            observations_again=again,
        )

    def _turned(self, state: dict[str, Any]) -> tuple[list[dict[str, Any]], torch.Tensor]:
        """The G copies of states, and which of them can be reached, ``[S, G]`` bool."""
        turned = [self.turner.turn(state, g, self.centre) for g in self.elements]
        return [copy for copy, _ in turned], torch.stack([mask for _, mask in turned], dim=1)

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

    def _poses(self) -> Tensors:
        """Position and quaternion of tool and object in every scene, ``[N, 7]`` each."""
        bodies = {"tool": self.env.agent.tcp_pose, "object": self.env.manipulated.pose}
        return {name: torch.cat([pose.p, pose.q], dim=1).cpu() for name, pose in bodies.items()}

    def _split(self, values: torch.Tensor) -> torch.Tensor:
        """Reshape ``[(G + 1) * S, ...]``, ordered by copy, to ``[S, G + 1, ...]``."""
        return values.unflatten(0, (-1, self.batch)).transpose(0, 1)

    def _turned_back(self, body: str, *poses: torch.Tensor) -> torch.Tensor:
        """Poses of a body at several times, each copy turned back, ``[S, G + 1, times, 7]``."""
        name = self.env.manipulated.name
        across_yz = body == "object" and name in self.env.mirrored_across_yz
        centre = torch.cat([self.centre.double(), torch.zeros(1, dtype=torch.float64)])
        copies = self._split(torch.stack(poses, dim=1)).double()
        turned = []
        for g, element in enumerate([*self.elements, (0.0, False)]):
            p, q = copies[:, g, :, :3], copies[:, g, :, 3:]
            p = (p - centre) @ planar_matrix(*_inverse(element), p).T + centre
            turned.append(
                torch.cat([p, transform_quaternion(q, *_inverse(element), across_yz)], dim=-1)
            )
        return torch.stack(turned, dim=1)

    # ------------------------------------------------------------------ reward

    def _rewards(self, plan: torch.Tensor, outcomes: list[dict[str, Any]] | None = None) -> Tensors:
        """`cost` and `dense` reward of a step, mean over the decision, ``[S, G]`` each.

        Args:
            plan: the actions of all scenes, ``[(G + 1) * S, T, 7]``.
            outcomes: the states of all scenes after each step. Without them the actions are
                simulated; with them neither dynamics nor contact forces enter.
        """
        env, steps = self.env, plan.shape[1]
        cost, dense = torch.zeros(env.num_envs), torch.zeros(env.num_envs)
        alive = torch.ones(env.num_envs)
        for step in range(steps):
            action, before = plan[:, step].to(env.device), env.agent.tcp_pose.p.clone()
            if outcomes is None:
                _, reward, _, _, info = env.step(action)
                extra = self._extra_cost(before, info)
            else:
                self._put(outcomes[step])
                info = env.get_info()
                extra = self._extra_cost(before, info)
                obs = env.get_obs(info)
                reward = env.compute_normalized_dense_reward(obs, action=action, info=info) - extra
            alive = alive * (~info["success"].cpu()).float()
            cost = cost + alive * (1 + extra).cpu() / steps
            dense = dense + reward.cpu() / steps
        means = {"cost": cost, "dense": dense}
        return {name: self._split(mean)[:, : len(self.elements)] for name, mean in means.items()}

    def _extra_cost(self, before: torch.Tensor, info: dict[str, Any]) -> torch.Tensor:
        """Extra cost of the variants for a step whose tool started at ``before``, ``[N]``."""
        moved = self.env.agent.tcp_pose.p - before
        cost = torch.zeros(self.env.num_envs, device=self.env.device)
        for variant in overriding(self.env.variants, "extra_cost"):
            cost = cost + variant.extra_cost(moved)
        return torch.where(info["success"], torch.zeros_like(cost), cost)

    # ------------------------------------------------------------- observation

    def _draw(self, seeds: list[int], state: dict[str, Any]) -> torch.Tensor:
        """Observations of states in scenes that were reset with seeds of their own."""
        self.env.reset(seed=seeds)
        self._put(state)
        return self.see(self.env.get_obs().cpu()).clone()

    def _observation_is_random(self) -> bool:
        """Whether the observation of the same state depends on the seed of the reset."""
        rows = torch.zeros(self.env.num_envs, dtype=torch.long)
        state = rows_of(self.visited.state, rows)
        one, other = (
            self._draw([seed] * self.env.num_envs, state) for seed in (self.seed, self.seed + 1)
        )
        return not torch.equal(one, other)

    def _observe(self, states: dict[str, Any], random: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Turned-back observations ``[S, G, K, dim]`` and of the states again ``[S, K, dim]``.

        Every scene and every draw of random observations has its own seed.
        """
        layout = self.layout
        if random:
            rng = np.random.default_rng([self.seed, 5])
            draws = [self._draw(self._seeds(rng), states) for _ in range(DRAWS)]
        else:
            draws = [self.see(self.env.get_obs().cpu()).clone()]
        seen = self._split(torch.stack(draws, dim=1)).double()
        back = [layout.transform(seen[:, g], *_inverse(e)) for g, e in enumerate(self.elements)]
        return torch.stack(back, dim=1), seen[:, -1]

    def _seeds(self, rng: np.random.Generator) -> list[int]:
        """A seed for each scene."""
        return np.asarray(rng.integers(2**31, size=self.env.num_envs)).tolist()

    # ------------------------------------------------------------------ resets

    def resets(self, count: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Features of ``count`` resets, and of as many others turned at random, ``[R, dim]`` each.

        Features are the unbroken task's observation of the state, relative to the policy's
        origin.
        """
        rng = np.random.default_rng([self.seed, 6])
        features = self._features(rng, 2 * count)
        original, turned = features[:count], features[count:].clone()
        choice = rng.integers(1, len(self.elements), size=count)
        for g, element in enumerate(self.elements):
            rows = torch.as_tensor(choice == g)
            turned[rows] = self.layout.transform(turned[rows], *element)
        return original, turned

    def _features(self, rng: np.random.Generator, count: int) -> torch.Tensor:
        features: list[torch.Tensor] = []
        known = self.visited.state
        while sum(map(len, features)) < count:
            self.env.reset(seed=self._seeds(rng))
            state = task_state(self.env)
            state |= {k: {n: state[k][n] for n in known[k]} for k in ("actors", "articulations")}
            state.pop("controller", None)
            features.append(self._observe_unbroken(seen_from(state, self.centre)))
        return torch.cat(features)[:count].double()

    def _observe_unbroken(self, state: dict[str, Any]) -> torch.Tensor:
        env = self.reference
        total = len(next(iter(state["actors"].values())))
        seen = []
        for start in range(0, total, env.num_envs):
            rows = torch.arange(start, start + env.num_envs).clamp(max=total - 1)
            env.set_state_dict(rows_of(state, rows))
            seen.append(self.see(env.get_obs().cpu()).clone())
        # Move the robot's base back.
        env.reset(seed=0)
        return torch.cat(seen)[:total]


def _inverse(element: Element) -> Element:
    angle, reflect = element
    return element if reflect else (-angle, False)
