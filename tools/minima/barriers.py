"""The loss barrier between two base policies, before and after aligning their parameters.

python -m tools.minima.barriers runs/minima > leaderboard/results/minima/barriers.json

On the straight line between two networks, barrier = max over t of loss(t) - (1 - t) loss(0) -
t loss(1). The loss is that of the training, on held-out demonstrations, with the same noise
levels and noise at all points. Policy number i has the demonstrations of seed FIRST + i, and is
compared with three others:

- ``batches``: the same first weights, other batches; a control, whose barrier should be small;
- ``start``: other first weights and other batches;
- ``demonstrations``: other first weights, and the demonstrations of the next number.

All have the normalisers of all demonstrations together. The middle of the line is also played in
simulation. Trained policies stay in the folder, so that the same command continues after a stop.
The result goes to stdout as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.demos import Demonstrations, load
from symsteer.bench.runs.base_policy import demonstration_file
from symsteer.bench.runs.config import DemonstrationConfig, RunConfig, content_key
from symsteer.bench.steering.evaluation import held_out_episodes
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import load_policy, policy_path, save_policy
from symsteer.policies.normalizer import Normalizer
from symsteer.policies.training.denoising import DiffusionPolicy
from symsteer.policies.training.gradient import optimize
from symsteer.terminal import complain
from tools.minima.symmetries import (
    Geometry,
    align,
    balanced,
    blend,
    moved,
    parts_of,
    product,
    put,
)

NAMES = ("edp", "plain", "plain-augmented")
APART = ("batches", "start", "demonstrations")
"""In what the two policies of a comparison differ."""

WAYS = ("trained", "permuted", "aligned", "balanced")
"""As they are; permuted; with shifts and turns, too; this after both were balanced."""

POINTS = 11
EPISODES = 50
OTHER = 100
"""Added to a seed of first weights or of batches, it gives the other one."""


def train(
    name: str,
    steps: int,
    demos: Demonstrations,
    normalised_by: Sequence[Demonstrations],
    start: int,
    batches: int,
) -> DiffusionPolicy:
    """Train as :meth:`GradientPolicy.fit`, with two seeds and with the normalisers of other data.

    Args:
        name: of a diffusion policy.
        steps: of the gradient.
        demos: what it is trained on.
        normalised_by: what the normalisers are fitted to.
        start: seed of the first weights.
        batches: seed of the batches.
    """
    kind: Any = POLICIES.get(name)
    layouts = (demos.observation_layout, demos.action_layout)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(start)
        policy: DiffusionPolicy = kind(_options(kind, steps), *layouts)
    obs, chunks = (
        torch.cat(x) for x in zip(*(pairs(policy, d) for d in normalised_by), strict=True)
    )
    policy.obs_normalizer = Normalizer.fit(policy.obs_layout, obs)
    policy.act_normalizer = Normalizer.fit(policy.act_layout, chunks)
    obs, chunks = pairs(policy, demos)
    chunks = policy.act_normalizer.normalize(chunks)
    generator = torch.Generator().manual_seed(batches)

    def batch_loss() -> torch.Tensor:
        rows = torch.randint(len(obs), (policy.options.batch_size,), generator=generator)
        return policy.loss(obs[rows], chunks[rows], generator)

    optimize(policy, batch_loss, policy.options)
    return policy.freeze()


def _options(kind: Any, steps: int) -> Any:
    """Plain networks take as many steps as equivariant ones: a longer training moves further."""
    equal = {"match_compute": False} if hasattr(kind.Options, "match_compute") else {}
    return kind.Options(steps=steps, **equal)


def pairs(policy: DiffusionPolicy, demos: Demonstrations) -> tuple[torch.Tensor, torch.Tensor]:
    return policy.pairs(policy.options, demos.episodes, demos.action_layout)


@torch.no_grad()
def loss(policy: DiffusionPolicy, demos: Demonstrations) -> float:
    """The training loss on demonstrations, always with the same noise levels and noise."""
    obs, chunks = pairs(policy, demos)
    chunks = policy.act_normalizer.normalize(chunks)
    return float(policy.loss(obs, chunks, torch.Generator().manual_seed(0)))


def barrier(losses: Sequence[float]) -> float:
    """Largest height above the straight line between the ends; 0 at least."""
    last = len(losses) - 1
    ends = [losses[0] + (losses[-1] - losses[0]) * i / last for i in range(last + 1)]
    return max(found - end for found, end in zip(losses, ends, strict=True))


class Study:
    """Demonstrations and trained policies of the comparisons, kept in a folder.

    Args:
        folder: for demonstrations and policies.
        config: of the task and the first demonstrations.
        count: number of policies that are compared with others; the demonstrations of the seed
            after theirs are held out.
        steps: of the gradient, of every policy.
    """

    def __init__(self, folder: Path, config: RunConfig, count: int, steps: int):
        self.steps, self.first = steps, config.demonstrations.seed
        # All that decides what is trained, but for what `policy` is given.
        demonstrated = asdict(config.demonstrations)
        key = content_key(config.task, config.embodiment, demonstrated, count, steps)
        self.policies = folder / "policies" / key
        files = []
        for seed in range(self.first, self.first + count + 1):
            wanted = replace(config.demonstrations, seed=seed)
            path = demonstration_file(replace(config, demonstrations=wanted), folder)
            files.append(load(path, config.task, config.embodiment))
        *self.demos, self.held_out = files

    def policy(self, name: str, number: int, start: int, batches: int) -> DiffusionPolicy:
        """A policy on the demonstrations of this number; trained once."""
        path = self.policies / f"{name}-{self.first + number}-{start}-{batches}"
        if not policy_path(path).is_file():
            demos = self.demos[number]
            save_policy(train(name, self.steps, demos, self.demos, start, batches), path)
        policy = load_policy(path)
        assert isinstance(policy, DiffusionPolicy)
        return policy

    def own(self, name: str, number: int) -> DiffusionPolicy:
        """The policy that is compared with others."""
        return self.policy(name, number, number, number)

    def other(self, name: str, number: int, apart: str) -> DiffusionPolicy:
        """The policy that differs from it in this."""
        if apart == "demonstrations":
            return self.own(name, (number + 1) % len(self.demos))
        return self.policy(name, number, number + OTHER * (apart == "start"), number + OTHER)


def compare(
    first: DiffusionPolicy, second: DiffusionPolicy, held_out: Demonstrations, env: Any
) -> dict[str, Any]:
    """Two policies, joined by straight lines after each way of aligning them.

    Args:
        first, second: policies with the same normalisers.
        held_out: demonstrations on which the loss is taken.
        env: parallel environments, in which the middle of a line is played.

    Returns:
        For each of :data:`WAYS`: ``losses`` at the points, ``distance`` of the ends as a share of
        the first one's norm, and ``success`` in the middle.
    """
    geometry = Geometry.of(first)
    found: dict[str, dict[str, Any]] = {"losses": {}, "distance": {}, "success": {}}
    between = copy.deepcopy(first)
    for way in WAYS:
        start, end = (parts_of(policy, geometry) for policy in (first, second))
        if way == "balanced":
            start, end = balanced(start, geometry), balanced(end, geometry)
        if way != "trained":
            end = moved(end, align(start, end, geometry, way != "permuted"), geometry)
        found["losses"][way] = []
        for point in range(POINTS):
            put(between, blend(start, end, point / (POINTS - 1)), geometry)
            found["losses"][way].append(round(loss(between, held_out), 7))
        put(between, blend(start, end, 0.5), geometry)
        found["success"][way] = success(env, between)
        gap = {part: start[part] - end[part] for part in start}
        found["distance"][way] = round((product(gap, gap) / product(start, start)) ** 0.5, 5)
    return found


def success(env: Any, policy: DiffusionPolicy) -> float:
    """Share of the held-out episodes that a policy solves without an agent."""
    latent = LatentNoiseEnv(env, policy, ignore_terminations=True)
    with torch.no_grad():
        played = held_out_episodes(latent, policy, 0, EPISODES)
    return float(played.episodes["success_once"].double().mean())


def main(arguments: Sequence[str]) -> int:
    """Train, measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="The loss barrier between two base policies.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("folder", type=Path, help="keeps demonstrations and trained policies")
    parser.add_argument("--task", default="PickCube-v1", help="whose demonstrations are used")
    parser.add_argument("--policies", nargs="+", default=list(NAMES), help="lifted networks")
    parser.add_argument("--count", type=int, default=5, help="comparisons of each kind")
    parser.add_argument("--first", type=int, default=60, help="seed of the first demonstrations")
    parser.add_argument("--demonstrations", type=int, default=50, help="number for each policy")
    parser.add_argument("--steps", type=int, default=1500, help="of the gradient, of every policy")
    given = parser.parse_args(arguments)
    rows = []
    try:
        if given.count < 2:
            raise UserError(f"--count must be at least 2, not {given.count}")
        wanted = DemonstrationConfig("diverse", given.demonstrations, given.first)
        config = RunConfig(task=given.task, embodiment="floating", demonstrations=wanted)
        study = Study(given.folder, config, given.count, given.steps)
        env = make(config.task, num_envs=EPISODES, embodiment=config.embodiment)
        with contextlib.closing(env):
            for name, number in itertools.product(given.policies, range(given.count)):
                own = study.own(name, number)
                alone = success(env, own)
                for apart in APART:
                    found = compare(own, study.other(name, number, apart), study.held_out, env)
                    found["success"]["own"] = alone
                    rows.append({"policy": name, "number": number, "apart": apart, **found})
                    print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    settings = {key: value for key, value in vars(given).items() if key != "folder"}
    print(json.dumps({**settings, "episodes": EPISODES, "rows": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
