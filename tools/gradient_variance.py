"""Variance of the training gradient with orbit targets, beside that with the pairs' own targets.

python -m tools.gradient_variance > leaderboard/results/base-policies/gradient.json

A policy is trained with the pairs' own targets. Its gradient is then taken on the same batches,
noise levels and noise with both kinds of targets, before and after training. The rows go to
stdout as JSON; the command takes about twenty minutes.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from symsteer.bench.demos import load
from symsteer.bench.runs.base_policy import demonstration_file
from symsteer.bench.runs.config import DemonstrationConfig, RunConfig
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.contract import Episode
from symsteer.policies.geometry import Layout
from symsteer.policies.training.denoising import DenoisingOptions, DiffusionPolicy
from symsteer.terminal import complain

NAMES = ("edp", "plain-augmented")
DEVIATIONS = (0.1, 0.5, 1.0, 2.0)
"""Values of ``observation_noise``."""


def measure(
    name: str,
    options: DenoisingOptions,
    episodes: Sequence[Episode],
    layouts: tuple[Layout, Layout],
    seed: int,
    batches: int,
) -> dict[str, float | None]:
    """Variances of one policy's gradient.

    Args:
        name: of a diffusion policy.
        options: of the policy, without ``orbit_targets``; it is trained first.
        episodes, layouts: demonstrations; geometry of observations and of actions.
        seed: of the training and of the batches.
        batches: number of gradients.

    Returns:
        ``own`` and ``orbit``: the trace of the gradient's covariance with either target.
        ``difference``: squared norm of the difference of the mean gradients, as a multiple of what
        is expected if the expected gradients are the same; about 1 then, and None if all gradients
        are the same.

    Raises:
        UserError: if the policy has no group.
    """
    kind: Any = POLICIES.get(name)
    orbit = kind(dataclasses.replace(options, orbit_targets=True), *layouts)
    own: DiffusionPolicy = kind.fit(options, episodes, *layouts, seed)
    orbit.load_state_dict(own.state_dict())
    obs, chunks = own.pairs(own.options, episodes, layouts[1])
    chunks = own.act_normalizer.normalize(chunks)
    picks = torch.Generator().manual_seed(seed)
    sums: dict[str, list[Any]] = {key: [0.0, 0.0] for key in ("own", "orbit", "difference")}
    for number in range(batches):
        rows = torch.randint(len(obs), (own.options.batch_size,), generator=picks)
        found = {
            key: _gradient(policy, obs[rows], chunks[rows], number)
            for key, policy in (("own", own), ("orbit", orbit))
        }
        found["difference"] = found["orbit"] - found["own"]
        for key, gradient in found.items():
            sums[key][0] += gradient
            sums[key][1] += gradient.square().sum()
    trace = {
        key: float(square - total.square().sum() / batches) / (batches - 1)
        for key, (total, square) in sums.items()
    }
    mean = float(sums["difference"][0].square().sum()) / batches
    return {**trace, "difference": mean / trace["difference"] if mean else None}


def _gradient(
    policy: DiffusionPolicy, obs: torch.Tensor, chunks: torch.Tensor, seed: int
) -> torch.Tensor:
    """The gradient on a batch, of all parameters as one vector in float64."""
    policy.requires_grad_(True)
    loss = policy.loss(obs, chunks, torch.Generator().manual_seed(seed))
    parts = torch.autograd.grad(loss, list(policy.parameters()))
    return torch.cat([part.flatten().double() for part in parts])


def main(arguments: Sequence[str]) -> int:
    """Measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Variance of the training gradient with orbit targets.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--task", default="PickCube-v1", help="whose demonstrations are used")
    parser.add_argument("--demonstrations", type=int, default=50, help="number of demonstrations")
    parser.add_argument(
        "--seeds", type=int, default=3, help="trainings, each with demonstrations of its own"
    )
    parser.add_argument(
        "--steps",
        type=int,
        nargs="+",
        default=[1, 1500],
        help="option of the policies: gradient steps before the measurement",
    )
    parser.add_argument("--batches", type=int, default=100, help="gradients of each policy")
    parser.add_argument(
        "--policies", nargs="+", default=list(NAMES), help="policies that have a group"
    )
    parser.add_argument(
        "--deviations", type=float, nargs="+", default=list(DEVIATIONS), help="observation noise"
    )
    given = parser.parse_args(arguments)
    rows = []
    try:
        if min(given.seeds, *given.steps) < 1 or given.batches < 2:
            raise UserError("seeds and steps must be at least 1, and batches at least 2")
        kinds: dict[str, Any] = {name: POLICIES.get(name) for name in given.policies}
        cells = list(itertools.product(kinds, given.deviations, given.steps))
        with TemporaryDirectory() as folder:
            for seed in range(given.seeds):
                wanted = DemonstrationConfig("diverse", given.demonstrations, seed)
                config = RunConfig(task=given.task, embodiment="floating", demonstrations=wanted)
                path = demonstration_file(config, Path(folder))
                demos = load(path, config.task, config.embodiment)
                layouts = (demos.observation_layout, demos.action_layout)
                for name, deviation, steps in cells:
                    asked = {"observation_noise": deviation, "steps": steps}
                    options = kinds[name].Options(**asked)
                    found = measure(name, options, demos.episodes, layouts, seed, given.batches)
                    rows.append({"policy": name, **asked, "seed": seed, **found})
                    print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(json.dumps({"task": given.task, "demonstrations": given.demonstrations, "rows": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
