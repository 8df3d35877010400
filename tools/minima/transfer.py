"""Does an actor that was trained for one base policy steer another one?

python -m tools.minima.transfer RUNS > leaderboard/results/minima/transfer.json

RUNS holds finished runs of one task without a variant: the same agents for each of several base
policies. By seed, the first and the second policy are a pair, the third and the fourth, and so on.
The actors of each policy are played on the other one, in the held-out episodes of the run's final
evaluation.

An actor sees the observation and chooses noise. Of the policy it knows only the function
decode(s, w), which no symmetry of the parameters changes: aligning parameters cannot change what
an actor reaches. What can be aligned is the noise: a matrix M with

    decode_other(s, M w) ~ decode_own(s, w)

for the states s that the other policy visits and w ~ N(0, I), by gradient descent from the
identity. The actor is played with it, too. The result goes to stdout as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from symsteer.agents.agent import Agent
from symsteer.agents.episodes import Rollout
from symsteer.bench.runs.trained import load
from symsteer.bench.steering.evaluation import random_noise, rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import held_out_seeds, steerability_seeds
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from symsteer.policies.contract import ChunkPolicy
from symsteer.terminal import complain

STATES = 64
"""Episodes of the other policy whose states are used to compare and to align the noise."""

FIT_STEPS, FIT_BATCH, FIT_RATE = 300, 64, 3e-3
MOST_ENVS = 100
COMPARED = 512
"""States at which actions are compared; four noise sequences each."""

Noise = Callable[[torch.Tensor], torch.Tensor]
"""Changes noise ``[B, Tp, Da]``."""


def agreement(own: ChunkPolicy, other: ChunkPolicy, obs: torch.Tensor, change: Noise) -> float:
    """Correlation, over the noise, of two policies' actions at the same states.

    The mean over the noise is taken out at every state: it is the same without any noise.

    Args:
        own, other: the policies; the noise of the second one is changed first.
        obs: ``[B, obs_dim]``.
        change: identity before aligning.
    """
    draws = 4
    noise = _noise(own, len(obs) * draws, torch.Generator().manual_seed(1))
    seen = obs.repeat_interleave(draws, 0)
    moved = []
    for policy, drawn in ((own, noise), (other, change(noise))):
        actions = policy.decode(seen, drawn).unflatten(0, (-1, draws))
        moved.append((actions - actions.mean(1, keepdim=True)).flatten())
    return round(float(torch.corrcoef(torch.stack(moved))[0, 1]), 4)


def align_noise(own: ChunkPolicy, other: ChunkPolicy, obs: torch.Tensor) -> torch.Tensor:
    """The matrix ``[Tp * Da, Tp * Da]`` with which ``other`` acts most like ``own``.

    Args:
        own, other: the policies.
        obs: states ``[M, obs_dim]`` at which they are compared.
    """
    size = own.noise_layout.dim
    matrix = torch.eye(size, device=obs.device).requires_grad_(True)
    optimizer = torch.optim.Adam([matrix], lr=FIT_RATE)
    generator = torch.Generator().manual_seed(0)
    for step in range(FIT_STEPS):
        optimizer.param_groups[0]["lr"] = FIT_RATE * (1 - step / FIT_STEPS)
        seen = obs[torch.randint(len(obs), (FIT_BATCH,), generator=generator)]
        noise = _noise(own, FIT_BATCH, generator)
        with torch.no_grad():
            wanted = own.decode(seen, noise)
        changed = (noise.flatten(1) @ matrix.mT).view_as(noise)
        error = (other.decode(seen, changed) - wanted).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
    return matrix.detach()


def _noise(policy: ChunkPolicy, count: int, generator: torch.Generator) -> torch.Tensor:
    return torch.randn(count, policy.horizon, policy.act_layout.dim, generator=generator)


@dataclass(frozen=True)
class Steered:
    """A base policy, and the actors that were trained for it.

    Attributes:
        seed: of the runs.
        actors: by the agent's name.
        home: success of each actor in its run's final evaluation.
        world: task, embodiment and variant.
    """

    seed: int
    policy: ChunkPolicy
    actors: dict[str, Agent]
    home: dict[str, float]
    world: Mapping[str, str]


@torch.no_grad()
def play(env: Any, policy: ChunkPolicy, act: Any, seeds: Sequence[int]) -> Rollout:
    """Episodes from these seeds; ``act(obs, rows) -> noise``."""
    return rollout(LatentNoiseEnv(env, policy, ignore_terminations=True), act, seeds)


def measure(own: Steered, other: Steered, env: Any, episodes: int) -> list[dict[str, Any]]:
    """A row for each actor of ``own``, played on the policy of ``other``.

    Args:
        own, other: on the same task.
        env: parallel environments of it.
        episodes: held-out episodes.
    """
    policy = other.policy
    met = play(env, policy, random_noise(policy, 0), steerability_seeds(0, STATES))
    # What the policy sees before its first success.
    states = met.obs[met.running]
    matrix = align_noise(own.policy, policy, states)
    some = states[torch.randperm(len(states), generator=torch.Generator().manual_seed(2))]

    def change(noise: torch.Tensor) -> torch.Tensor:
        return (noise.flatten(1) @ matrix.mT).view_as(noise)

    def success(act: Any) -> float:
        played = play(env, policy, act, held_out_seeds(episodes))
        return float(played.episodes["success_once"].double().mean())

    policies = {
        "alone": success(random_noise(policy, 0)),
        "agreement": agreement(own.policy, policy, some[:COMPARED], lambda noise: noise),
        "agreement_aligned": agreement(own.policy, policy, some[:COMPARED], change),
    }
    rows = []
    for name, agent in own.actors.items():
        actors = {
            "home": own.home[name],
            "own_actor": other.home[name],
            "moved": success(steer(agent, lambda noise: noise)),
            "aligned": success(steer(agent, change)),
        }
        rows.append({"agent": name, "actor": own.seed, "policy": other.seed, **actors, **policies})
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def steer(agent: Agent, change: Noise) -> Any:
    """The actor's noise, changed before the policy decodes it."""
    return lambda obs, rows: change(agent.act(obs, deterministic=True))


def read(folder: Path, episodes: int) -> list[Steered]:
    """The policies of a folder with their actors, in the order of the seeds.

    Raises:
        UserError: if their number is odd, they are of several tasks or have other agents, an
            agent's action is not noise, or a run evaluated fewer episodes.
    """
    found: dict[int, Steered] = {}
    for path in sorted(folder.glob("*/checkpoint.pt")):
        run, record = load(path.parent), read_record(path.with_name("record.json"))
        if type(run.agent).decode is not Agent.decode:
            raise UserError(
                f"the actions of {run.agent.name} are not noise; name runs of standard or "
                "equivariant"
            )
        if record.final is None or len(record.final.episodes.success_once) < episodes:
            raise UserError(
                f"{path.parent} has no final evaluation of {episodes} episodes; finish the run, or "
                "choose fewer --episodes"
            )
        seed = record.settings.seed
        own = found.setdefault(seed, Steered(seed, run.policy, {}, {}, run.world))
        if own.policy.content_hash() != run.policy.content_hash():
            raise UserError(
                f"the runs of seed {seed} have several base policies; leave all but one"
            )
        solved = record.final.episodes.success_once[:episodes]
        own.actors[run.agent.name] = run.agent
        own.home[run.agent.name] = sum(solved) / episodes
    if len({(*run.world.values(), *sorted(run.actors)) for run in found.values()}) != 1:
        raise UserError(
            f"{folder} has no runs, or they differ in more than their seed; name a folder in which "
            "every base policy has the same agents, task, embodiment and variant"
        )
    if len(found) % 2:
        raise UserError(f"{folder} has {len(found)} base policies; pairs need an even number")
    return [found[seed] for seed in sorted(found)]


def main(arguments: Sequence[str]) -> int:
    """Measure and print; returns the exit code."""
    parser = argparse.ArgumentParser(
        description="Does an actor that was trained for one base policy steer another one?",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("runs", type=Path, help="folder of finished runs")
    parser.add_argument("--episodes", type=int, default=100, help="held-out episodes")
    given = parser.parse_args(arguments)
    try:
        if given.episodes < 1:
            raise UserError(f"--episodes must be at least 1, not {given.episodes}")
        steered, rows = read(given.runs, given.episodes), []
        world = steered[0].world
        num_envs = min(given.episodes, MOST_ENVS)
        env = make(
            world["task"],
            num_envs=num_envs,
            embodiment=world["embodiment"],
            variant=world["variant"],
        )
        with contextlib.closing(env):
            for first, second in zip(steered[::2], steered[1::2], strict=True):
                rows += measure(first, second, env, given.episodes)
                rows += measure(second, first, env, given.episodes)
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(json.dumps({**world, "episodes": given.episodes, "rows": rows}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
