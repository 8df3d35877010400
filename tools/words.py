"""Does a policy that is told in words do as well as one that is told the task by a one-hot vector?

python -m tools.words RUNS

For each seed, `edp-joint` and `edp-told` are trained on the same demonstrations of all tasks, with
the same batches and number of gradient steps. RUNS/base keeps them, where the suite `words` finds
them. Both are played in the same held-out episodes with the same noise from N(0, I): `edp-told`
with sentences of the training, with held-out wordings that name the things alike, and with the
sentences of another task. The episodes are dealt out to several sentences. Each row goes to --out
as it is measured, and the same command goes on with the rows that are missing.
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
from symsteer.files import write_atomically
from symsteer.leaderboard.paths import RESULTS
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.words import wordings
from symsteer.terminal import complain

TASKS = ("PickCube-v1", "PushCube-v1", "PlaceSphere-v1", "PokeCube-v1", "StackCube-v1")
"""Each is told the sentences of the next one, too. None solves another one by chance."""

SENTENCES = 6
"""Of each kind that are said."""


def some(task: str, held_out: bool = False) -> tuple[str, ...]:
    """Sentences of a task: its wordings in turn, with the same fillings whether held out or not."""
    known, numbers = wordings(task, held_out), range(SENTENCES)
    turns = [(number, known[number % len(known)]) for number in numbers]
    return tuple(filled[number * len(filled) // SENTENCES] for number, filled in turns)


@torch.no_grad()
def success(env: Any, policy: ChunkPolicy, said: Sequence[str], episodes: int) -> list[float]:
    """Share of the held-out episodes that are solved, for each sentence.

    Args:
        env: parallel environments of the task.
        policy: with noise from N(0, I).
        said: the sentences, each for a part of the episodes; none: for each part as the policy is.
        episodes: how many, a multiple of the number of sentences.
    """
    seeds, solved = held_out_seeds(episodes), []
    told = [dataclasses.replace(policy.options, instruction=s) for s in said]  # type: ignore[call-arg]
    for number, options in enumerate(told or [policy.options] * SENTENCES):
        used = policy.used_with(options)
        latent = LatentNoiseEnv(env, used, ignore_terminations=True)
        played = rollout(latent, random_noise(used, number), seeds[number::SENTENCES])
        solved.append(float(played.episodes["success_once"].float().mean()))
    return solved


def measure(seed: int, task: str, other: str, given: argparse.Namespace) -> dict[str, Any]:
    """A row.

    Args:
        seed: of training and demonstrations.
        task: that is played.
        other: whose sentences it is told, too.
        given: the arguments of the command.
    """
    one_hot, told = (_prepared(name, task, seed, given) for name in ("edp-joint", "edp-told"))
    # No more than play at once: the others would stand still.
    env = make(task, num_envs=given.episodes // SENTENCES)
    with contextlib.closing(env):
        reached = {
            "one_hot": success(env, one_hot, (), given.episodes),
            "training": success(env, told, some(task), given.episodes),
            "held_out": success(env, told, some(task, held_out=True), given.episodes),
            "another_task": success(env, told, some(other), given.episodes),
        }
    hashes = {"edp_joint": one_hot.content_hash(), "edp_told": told.content_hash()}
    return {"seed": seed, "task": task, **reached, **hashes}


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
    parser.add_argument("--out", type=Path, default=RESULTS / "words" / "words.json")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), help="two or more")
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(30, 40)))
    parser.add_argument("--episodes", type=int, default=384, help=f"a multiple of {SENTENCES}")
    parser.add_argument("--demonstrations", type=int, default=50, help="of each task")
    parser.add_argument("--steps", type=int, default=1500, help="gradient steps for each task")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str]) -> int:
    """Measure what --out lacks; returns the exit code."""
    given = parsed(arguments)
    # As in a sweep: other threads sum in another order, and train another policy.
    torch.set_num_threads(1)
    try:
        if given.episodes < 1 or given.episodes % SENTENCES:
            raise UserError(f"--episodes must be a multiple of {SENTENCES}, not {given.episodes}")
        if len(set(given.tasks)) < max(2, len(given.tasks)):
            raise UserError("--tasks needs two or more tasks, each once")
        if len(set(given.seeds)) < len(given.seeds):
            raise UserError("--seeds needs each seed once")
        for task in given.tasks:
            wordings(task)
        _measure_all(given)
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    return 0


def _measure_all(given: argparse.Namespace) -> None:
    names = ("tasks", "episodes", "demonstrations", "steps")
    settings = {name: getattr(given, name) for name in names}
    rows, seeds = [], set(given.seeds)
    if given.out.exists():
        try:
            found = json.loads(given.out.read_text("utf-8-sig"))
            rows = found.pop("rows")
            seeds |= set(found.pop("seeds"))
            there = {(row["seed"], row["task"]) for row in rows}
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{given.out} cannot be read ({error}); name another --out") from None
        if found != settings:
            raise UserError(f"{given.out} has other settings ({found}); name another --out")
    else:
        there = set()
    next_task = dict(zip(given.tasks, [*given.tasks[1:], given.tasks[0]], strict=True))
    for seed in given.seeds:
        for task, other in next_task.items():
            if (seed, task) in there:
                continue
            rows.append(measure(seed, task, other, given))
            text = json.dumps({**settings, "seeds": sorted(seeds), "rows": rows}, indent=1)
            write_atomically(given.out, f"{text}\n".encode())
            print(f"seed {seed}, {task}: measured", flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
