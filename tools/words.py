"""Does a policy that is told in words do as well as one that is told the task by a one-hot vector?

python -m tools.words RUNS > leaderboard/results/words/words.json

For each seed, `edp-joint` and `edp-told` are trained on the same demonstrations of all tasks, with
the same number of gradient steps. RUNS/base keeps them, where the suite `words` finds them. Both
are played in the same held-out episodes with noise from N(0, I): `edp-told` with sentences of the
training, with held-out wordings that name the things alike, and with the sentences of another task.
Each time, the episodes are dealt out to several sentences. The result goes to stdout as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.config import DemonstrationConfig, Execution, RunConfig
from symsteer.bench.steering.evaluation import random_noise, rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.words import wordings
from symsteer.terminal import complain

TASKS = ("PickCube-v1", "PushCube-v1", "PlaceSphere-v1", "PullCube-v1", "StackCube-v1")
"""Each is told the sentences of the next one, too. A push solves PullCube, so they are apart."""

SENTENCES = 6
"""Of each kind that are said."""


def some(task: str, held_out: bool = False) -> tuple[str, ...]:
    """Sentences of a task: its wordings in turn, with the same fillings whether held out or not."""
    known, numbers = wordings(task, held_out), range(SENTENCES)
    turns = [(number, known[number % len(known)]) for number in numbers]
    return tuple(filled[number * len(filled) // SENTENCES] for number, filled in turns)


@torch.no_grad()
def success(env: Any, policy: ChunkPolicy, said: Sequence[str], episodes: int) -> float:
    """Share of the held-out episodes that are solved.

    Args:
        env: parallel environments of the task.
        policy: with noise from N(0, I).
        said: the sentences in turn; none: as the policy is.
        episodes: how many.
    """
    seeds, solved = held_out_seeds(episodes), 0
    told = [dataclasses.replace(policy.options, instruction=s) for s in said]  # type: ignore[call-arg]
    for number, options in enumerate(told or [policy.options]):
        used = policy.used_with(options)
        latent = LatentNoiseEnv(env, used, ignore_terminations=True)
        own = seeds[number :: max(1, len(told))]
        played = rollout(latent, random_noise(used, number), own)
        solved += int(played.episodes["success_once"].sum())
    return solved / episodes


def measure(seed: int, given: argparse.Namespace) -> list[dict[str, Any]]:
    """A row for each task.

    Args:
        seed: of training and demonstrations.
        given: the arguments of the command.
    """
    rows, tasks = [], given.tasks
    for task, other in zip(tasks, [*tasks[1:], tasks[0]], strict=True):
        one_hot, told = (_prepared(name, task, seed, given) for name in ("edp-joint", "edp-told"))
        # No more than play at once: the others would stand still.
        env = make(task, num_envs=-(-given.episodes // SENTENCES))
        with contextlib.closing(env):
            reached = {
                "one_hot": success(env, one_hot, (), given.episodes),
                "training": success(env, told, some(task), given.episodes),
                "held_out": success(env, told, some(task, held_out=True), given.episodes),
                "another_task": success(env, told, some(other), given.episodes),
            }
        hashes = {"edp_joint": one_hot.content_hash(), "edp_told": told.content_hash()}
        rows.append({"seed": seed, "task": task, **reached, **hashes})
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def _prepared(name: str, task: str, seed: int, given: argparse.Namespace) -> ChunkPolicy:
    options: Any = POLICIES.get(name).Options
    config = RunConfig(
        task=task,
        seed=seed,
        policy_name=name,
        policy=options(tasks=tuple(given.tasks), steps=given.steps, zero_output=True),
        demonstrations=DemonstrationConfig(count=given.demonstrations),
    )
    return prepare_base(config, Execution(given.runs, quiet=True))


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """The arguments of the command."""
    parser = argparse.ArgumentParser(
        description="Are words as good as a one-hot vector of the task?",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("runs", type=Path, help="folder of runs; its base has the policies")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help="two or more")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(30, 40)))
    parser.add_argument("--episodes", type=int, default=96, help="held-out episodes")
    parser.add_argument("--demonstrations", type=int, default=50, help="of each task")
    parser.add_argument("--steps", type=int, default=1500, help="gradient steps for each task")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> int:
    """Measure and print; returns the exit code."""
    given = parsed(arguments)
    # As in a sweep: other threads sum in another order, and train another policy.
    torch.set_num_threads(1)
    try:
        if given.episodes < 1:
            raise UserError(f"--episodes must be at least 1, not {given.episodes}")
        if len(set(given.tasks)) < max(2, len(given.tasks)):
            raise UserError("--tasks needs two or more tasks, each once")
        rows = [row for seed in given.seeds for row in measure(seed, given)]
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    settings = {"demonstrations": given.demonstrations, "steps": given.steps}
    print(json.dumps({"episodes": given.episodes, **settings, "rows": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
