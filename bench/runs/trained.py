"""A trained run or a saved base policy as an object that acts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from symsteer.agents.agent import Agent, AgentContext
from symsteer.agents.references import BaseAgent
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import CONFIG
from symsteer.bench.runs.stored import restored
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy, policy_path
from symsteer.registry import allow


@dataclass(frozen=True)
class Trained:
    """A frozen base policy and the agent that steers it.

    Attributes:
        policy: the base policy.
        agent: chooses its noise; N(0, I) for a policy file.
        config: of the run; None for a policy file.
        world: ``task``, ``embodiment`` and ``variant`` of the training; empty if a policy file does
            not contain them.
    """

    policy: ChunkPolicy
    agent: Agent
    config: RunConfig | None
    world: dict[str, str]

    @torch.no_grad()
    def act(self, obs: Any, deterministic: bool = True) -> torch.Tensor:
        """The next actions, with the noise that the agent chooses.

        Args:
            obs: ``[N, obs_dim]``, tensor or array, from environments with ``obs_mode="state"``.
            deterministic: True as in evaluations; False draws from the agent's distribution.

        Returns:
            ``[N, Ta, act_dim]`` on the device of ``obs``. Execute them in order, then call again.

        Raises:
            UserError: if the observations have another width.
        """
        given = torch.as_tensor(obs)
        if given.ndim != 2 or given.shape[1] != self.policy.task_layout.dim:
            raise UserError(
                f"observations have the shape [N, {self.policy.task_layout.dim}], not "
                f"{list(given.shape)}; make the environments with make_env()"
            )
        seen = self.policy.see(given.to(self.agent.device, torch.float32))
        chunk = self.agent.decode(seen, self.agent.act(seen, deterministic))
        return chunk[:, : self.policy.execute].to(given.device)

    def make_env(self, num_envs: int = 1, variant: str | None = None, **options: Any) -> Any:
        """Environments of the task that it was trained for.

        Args:
            num_envs: how many in parallel.
            variant: e.g. ``action_gain:0.5`` or ``none``; default: the variant of the training.
            options: other options of :func:`symsteer.make`.

        Raises:
            UserError: for an unknown variant, or if a policy file does not name its task.
        """
        if not self.world:
            raise UserError(
                "this policy file does not name its task; make the environments with symsteer.make"
            )
        return make(
            self.world["task"],
            num_envs=num_envs,
            embodiment=self.world["embodiment"],
            variant=self.world["variant"] if variant is None else variant,
            **options,
        )


def load(path: str | Path, device: str = "cpu", trust: Sequence[str] = ()) -> Trained:
    """Load a run's folder at its last checkpoint, or a saved base policy.

    Args:
        path: folder of a run, or a policy file (``policy.safetensors``).
        device: for a policy file; a run comes back on its own device, or on the CPU without a GPU.
        trust: code of other authors that the files may name, as ``module:Class``; it is executed.

    Raises:
        UserError: if the path is neither of them, a file is damaged, or it names other code.
    """
    allow(*trust)
    path = Path(path)
    if (path / CONFIG).is_file() or (path.is_dir() and not policy_path(path).is_file()):
        run = restored(path)
        world = {key: getattr(run.config, key) for key in ("task", "embodiment", "variant")}
        return Trained(run.policy, run.agent, run.config, world)
    policy = load_policy(path, device=device)
    context = AgentContext.of(policy, device)
    known = policy.report.get("world") or {}
    world = {key: known[key] for key in ("task", "embodiment") if key in known}
    return Trained(policy, BaseAgent(context), None, {**world, "variant": "none"} if world else {})
