"""Code from outside SymSteer that a run uses: for its record, and when the run is read back."""

from __future__ import annotations

from pathlib import Path

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.tasks import TASKS
from symsteer.bench.variants import VARIANTS
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from symsteer.policies import POLICIES
from symsteer.registry import Extension

REGISTRIES = {registry.kind: registry for registry in (AGENTS, POLICIES, TASKS, VARIANTS)}


def extensions_of(config: RunConfig) -> list[Extension]:
    """The agent, policy, task and variants that are not SymSteer's own."""
    found = [
        AGENTS.extension(config.agent),
        POLICIES.extension(config.policy_name),
        TASKS.extension(config.task),
        *(VARIANTS.extension(spec.name) for spec in config.variants),
    ]
    return [extension for extension in found if extension is not None]


def require_extensions(record: Path) -> None:
    """Check that all code from outside SymSteer that a run's record names can be found here.

    A record that is missing or damaged names none.

    Raises:
        NotInstalledError: naming the distribution to install.
    """
    try:
        extensions = read_record(record).provenance.extensions
    except UserError:
        return
    for found in extensions:
        REGISTRIES[found.kind].require(found.name, found.target, found.distribution, record)
