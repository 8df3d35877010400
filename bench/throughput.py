"""How fast this machine steers: the steps of a real run, by part, for several numbers of
environments."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import Agent, AgentContext
from symsteer.bench.sim.environment import MAX_SCENES
from symsteer.bench.steering.latent_env import Clock, LatentNoiseEnv
from symsteer.bench.tasks import make, task_class
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.tables import aligned

PARTS = ("simulate", "decode", "learn")


def measure(
    task: str,
    agent: str,
    num_envs: Sequence[int],
    workers: Sequence[int],
    seconds: float,
    report: Callable[[str], None] = lambda line: None,
) -> list[dict[str, Any]]:
    """Steer an untrained base policy of the default size, as a run does after its warm-up.

    Args:
        task, agent: names; the agent has its default options.
        num_envs: numbers of environments.
        workers: numbers of processes that share the simulation.
        seconds: length of each measurement.
        report: receives a line for each measurement.

    Returns:
        A row for each combination: ``num_envs``, ``workers``, ``rate`` (control steps per second,
        summed over the environments), and milliseconds of a control step of all environments by
        part: ``simulate``, ``decode``, ``learn`` (choosing noise, and updates).

    Raises:
        UserError: an unknown name, or a number out of range.
    """
    most = max(num_envs, default=0)
    if not 0 < seconds < math.inf or min(*num_envs, *workers, most) < 1:
        raise UserError("--seconds, --num-envs and --workers must be positive")
    cores = len(os.sched_getaffinity(0))
    if max(workers, default=1) > cores:
        raise UserError(
            f"--workers is {max(workers)}; this machine has {cores} cores, so name at most {cores}"
        )
    if any(most > MAX_SCENES * processes for processes in workers):
        raise UserError(
            f"one process simulates at most {MAX_SCENES} environments, and --num-envs has {most}; "
            "lower it"
        )
    task_class(task)
    AGENTS.get(agent)
    rows = []
    for processes in workers:
        for count in (count for count in num_envs if count >= processes):
            report(f"{count} environments, {processes} processes")
            row = {"num_envs": count, "workers": processes}
            rows.append(row | _steer(task, agent, count, processes, seconds))
    return rows


def _steer(task: str, agent: str, num_envs: int, workers: int, seconds: float) -> dict[str, float]:
    learner = new_agent(task, agent, warmup=num_envs)
    simulated = make(task, num_envs=num_envs, workers=workers)
    env = LatentNoiseEnv(simulated, new_policy(task), decode=learner.decode)
    try:
        obs = env.reset(env.training_seeds(0, num_envs))
        for _ in range(3):
            obs = _decide(env, learner, obs)
        env.clock, env.control_steps = Clock(), 0
        begin = time.perf_counter()
        while (elapsed := time.perf_counter() - begin) < seconds:
            obs = _decide(env, learner, obs)
        steps, clock = env.control_steps, env.clock
    finally:
        env.close()
    spent = (clock.simulate, clock.decode, elapsed - clock.simulate - clock.decode)
    each = {part: 1e3 * s * num_envs / steps for part, s in zip(PARTS, spent, strict=True)}
    return {"rate": steps / elapsed, **each}


def _decide(env: LatentNoiseEnv, agent: Agent, obs: torch.Tensor) -> torch.Tensor:
    """One decision of a run, with the updates that are due."""
    step = env.step(agent.act(obs))
    agent.observe(step)
    for batch in agent.batches():
        agent.update(batch)
    return step.obs_after


def new_policy(task: str, name: str = "edp", **options: Any) -> Any:
    """An untrained base policy; its weights do not change what it costs."""
    kind, policy_class = task_class(task), POLICIES.get(name)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = policy_class(
            policy_class.Options(**options), kind.observation_layout, kind.action_layout
        )
    policy.freeze()
    return policy


def new_agent(
    task: str, name: str, device: str = "cpu", seed: int = 0, warmup: int = 1, **options: Any
) -> Agent:
    """An agent on an untrained base policy; learners begin after ``warmup`` decisions."""
    agent_class = AGENTS.get(name)
    if "warmup" in {field.name for field in dataclasses.fields(agent_class.Options)}:
        options["warmup"] = warmup
    context = AgentContext.of(new_policy(task).to(device), device, seed)
    return agent_class(context, agent_class.Options(**options))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of :func:`measure` for a terminal."""
    header = ["environments", "processes", "steps/s", *(f"{part}, ms" for part in PARTS)]
    lines = [
        [
            str(row["num_envs"]),
            str(row["workers"]),
            f"{row['rate']:,.0f}",
            *(f"{row[part]:.1f}" for part in PARTS),
        ]
        for row in rows
    ]
    return aligned(header, lines, left=0)
