"""Success of base policies trained from few demonstrations."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import signal
import statistics
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pebble import ProcessPool
from tqdm import tqdm

from symsteer.agents.episodes import Rollout
from symsteer.bench.demos import load
from symsteer.bench.runs.base_policy import demonstration_file
from symsteer.bench.runs.config import DemonstrationConfig, RunConfig, content_key
from symsteer.bench.runs.folder import write_json
from symsteer.bench.sim.shards.processes import signals_wait
from symsteer.bench.steering.evaluation import VISITED, rollout, steerability
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy, PolicyOptions
from symsteer.policies.steerability import evenly, jumps
from symsteer.variant import file_name

EVALUATION_ENVS = 100
STATES = 32
"""Initial states that are tried with 16 draws of the noise each."""


@dataclass(frozen=True)
class BaseCell:
    """One base policy: its name, number of demonstrations and seed."""

    name: str
    count: int
    seed: int


def study(
    configs: Sequence[RunConfig],
    out: Path,
    policies: Mapping[str, PolicyOptions],
    counts: Sequence[int],
    seeds: int,
    episodes: int,
    workers: int,
) -> list[dict[str, Any]]:
    """Train every policy at every number of demonstrations and play held-out episodes.

    Seed s has its own demonstrations, initialisation and noise. The policies of one seed share the
    demonstrations; n demonstrations are the first n of the largest number.

    Args:
        configs: embodiment and kind of demonstrations; they differ in the task alone. Policies for
            several tasks are trained on all of them together, the others on each.
        out: folder that keeps demonstrations in ``out/base`` and what was measured of each policy
            in ``out/base/study``: a study that was stopped goes on there.
        policies: names of the policies and their options.
        counts: numbers of demonstrations.
        seeds: number of seeds, from 0.
        episodes: held-out episodes of each policy, with noise from N(0, I).
        workers: number of processes.

    Returns:
        A plain dictionary for each policy and task: its cell, ``task``, ``success``, ``successes``,
        ``episodes``, ``zero`` (success with zero noise), ``parameters``, ``training_seconds``; of
        its visited states ``equivariance_error`` (under C8), ``action_std`` and ``jumps``; and
        ``solvable``, the share of ``STATES`` initial states that 16 draws of the noise solve.

    Raises:
        UserError: if a number is not positive or there is no such policy.
    """
    if not counts or not policies or not configs:
        raise UserError("a study needs at least one task, number of demonstrations and policy")
    if min(*counts, seeds, episodes, workers) < 1:
        raise UserError("numbers of demonstrations, seeds, episodes and workers must be positive")
    files: dict[int, dict[str, Path]] = {}
    for seed in range(seeds):
        wanted = DemonstrationConfig(configs[0].demonstrations.mode, max(counts), seed)
        mine = [dataclasses.replace(config, demonstrations=wanted) for config in configs]
        files[seed] = {config.task: demonstration_file(config, out) for config in mine}
    cells = [BaseCell(n, c, s) for c in counts for n in policies for s in range(seeds)]
    context = multiprocessing.get_context("spawn")
    with ProcessPool(workers, context=context) as pool:
        try:
            jobs = []
            with signals_wait(signal.SIGINT):
                for cell in cells:
                    args = (configs[0], cell, policies[cell.name], files[cell.seed], episodes, out)
                    jobs.append(pool.schedule(_play_once, args))
            parts = [job.result() for job in tqdm(jobs, desc="base policies", disable=None)]
        except BaseException:
            pool.stop()
            raise
    return [row for rows in parts for row in rows]


def write_study(
    path: Path,
    config: RunConfig,
    policies: Mapping[str, PolicyOptions],
    rows: Sequence[dict[str, Any]],
) -> None:
    """Write the rows, the policies' options and the demonstrations as JSON."""
    write_json(
        path,
        {
            "tasks": list(dict.fromkeys(row["task"] for row in rows)),
            "embodiment": config.embodiment,
            "demonstrations": config.demonstrations.mode,
            "policies": {name: options.to_json() for name, options in policies.items()},
            "rows": list(rows),
        },
    )


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A markdown table of success: mean over seeds [lowest, highest seed]."""
    names = list(dict.fromkeys(row["name"] for row in rows))
    cells = sorted({(row["task"], row["count"]) for row in rows})
    lines = [
        "| task | demonstrations | " + " | ".join(f"`{name}`" for name in names) + " |",
        "| :-- | --: |" + " --: |" * len(names),
    ]
    for task, count in cells:
        texts = []
        for name in names:
            wanted = (task, count, name)
            found = [r["success"] for r in rows if (r["task"], r["count"], r["name"]) == wanted]
            texts.append(f"{statistics.mean(found):.2f} [{min(found):.2f}, {max(found):.2f}]")
        lines.append(f"| `{task}` | {count} | " + " | ".join(texts) + " |")
    return "\n".join(lines)


@contextmanager
def unbroken(
    config: RunConfig, policy: ChunkPolicy, episodes: int
) -> Generator[LatentNoiseEnv, None, None]:
    """The unbroken task of a run, for at most ``episodes`` held-out episodes at a time."""
    env = make(config.task, num_envs=min(EVALUATION_ENVS, episodes), embodiment=config.embodiment)
    with closing(LatentNoiseEnv(env, policy, ignore_terminations=True)) as latent:
        yield latent


def visited_states(played: Rollout) -> torch.Tensor:
    """At most ``VISITED`` observations before success, evenly over episodes and their steps."""
    return evenly(played.obs[played.running], VISITED)


def held_out_episodes(
    env: LatentNoiseEnv, policy: ChunkPolicy, seed: int, episodes: int, scale: float = 1.0
) -> Rollout:
    """Held-out episodes of a base policy with noise from N(0, scale^2 I).

    Args:
        env: the policy's task.
        policy: the base policy, on the CPU.
        seed: of the noise.
        episodes: how many.
        scale: of the noise.
    """
    generator = torch.Generator().manual_seed(seed)

    def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        shape = (len(obs), policy.horizon, policy.act_layout.dim)
        return scale * torch.randn(shape, generator=generator)

    return rollout(env, act, held_out_seeds(episodes))


def _play_once(
    config: RunConfig,
    cell: BaseCell,
    options: PolicyOptions,
    demos: Mapping[str, Path],
    episodes: int,
    out: Path,
) -> list[dict[str, Any]]:
    files = {task: path.name for task, path in demos.items()}
    settings = {**config.to_json(), "policy": options.to_json()}
    key = content_key(settings, dataclasses.asdict(cell), files, episodes)
    name = f"{file_name(cell.name)}-{cell.count}-s{cell.seed}-{key}.json"
    path = out / "base" / "study" / name
    if path.is_file():
        found: list[dict[str, Any]] = json.loads(path.read_text("utf-8-sig"))
        return found
    rows = _play(config, cell, options, demos, episodes)
    write_json(path, rows)
    return rows


def _play(
    config: RunConfig,
    cell: BaseCell,
    options: PolicyOptions,
    demos: Mapping[str, Path],
    episodes: int,
) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    data = {task: load(path, task, config.embodiment, cell.count) for task, path in demos.items()}
    kind: Any = POLICIES.get(cell.name)
    policies: dict[str, ChunkPolicy]
    if len(data) > 1 and hasattr(options, "tasks"):
        together = {task: (d.episodes, d.observation_layout) for task, d in data.items()}
        layout = next(iter(data.values())).action_layout
        policies = kind.fit_tasks(options, together, layout, cell.seed)
    else:
        policies = {
            task: kind.fit(options, d.episodes, d.observation_layout, d.action_layout, cell.seed)
            for task, d in data.items()
        }
    return [_row(config, cell, task, policy, episodes) for task, policy in policies.items()]


def _row(
    config: RunConfig, cell: BaseCell, task: str, policy: ChunkPolicy, episodes: int
) -> dict[str, Any]:
    with unbroken(dataclasses.replace(config, task=task), policy, episodes) as env:
        result = held_out_episodes(env, policy, cell.seed, episodes)
        zero = held_out_episodes(env, policy, cell.seed, episodes, scale=0.0)
        report = steerability(env, policy, cell.seed, STATES)
    successes = int(result.episodes["success_once"].sum())
    visited = visited_states(result)
    return {
        **dataclasses.asdict(cell),
        "task": task,
        "success": successes / episodes,
        "successes": successes,
        "episodes": episodes,
        "zero": float(zero.episodes["success_once"].float().mean()),
        "solvable": report.solvable,
        "action_std": report.action_std,
        "equivariance_error": report.equivariance_error,
        "jumps": jumps(policy, visited, cell.seed),
        "parameters": policy.parameter_count(),
        "training_seconds": round(policy.training_record["seconds"], 1),
    }
