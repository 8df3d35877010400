"""Code from outside SymSteer that a run uses, for its record."""

from __future__ import annotations

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.tasks import TASKS
from symsteer.bench.variants import VARIANTS
from symsteer.policies import POLICIES
from symsteer.registry import Extension


def extensions_of(config: RunConfig) -> list[Extension]:
    """The agent, policy, task and variants that are not SymSteer's own."""
    found = [
        AGENTS.extension(config.agent),
        POLICIES.extension(config.policy_name),
        TASKS.extension(config.task),
        *(VARIANTS.extension(spec.name) for spec in config.variants),
    ]
    return [extension for extension in found if extension is not None]
