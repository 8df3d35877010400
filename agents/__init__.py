"""Steering agents: SAC in the latent noise of a frozen policy, and the references it must beat.

``AGENTS`` maps names to classes. To add an agent to SymSteer, write one file and add one line here.
Another package adds its agent with an entry point (docs/submit.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symsteer.lazy import lazily
from symsteer.registry import Registry

if TYPE_CHECKING:
    from symsteer.agents.agent import Agent, AgentContext, AgentOptions, Budget
    from symsteer.agents.diagnostics import actor_equivariance_error
    from symsteer.agents.equivariant import EquivariantAgent
    from symsteer.agents.options import SacOptions
    from symsteer.agents.replay import Batch, Transition
    from symsteer.agents.sac import SacAgent
    from symsteer.agents.standard import StandardAgent

__all__ = [
    "AGENTS",
    "Agent",
    "AgentContext",
    "AgentOptions",
    "Batch",
    "Budget",
    "EquivariantAgent",
    "SacAgent",
    "SacOptions",
    "StandardAgent",
    "Transition",
    "actor_equivariance_error",
]

__getattr__ = lazily(
    __name__,
    {
        "Agent": "agent",
        "AgentContext": "agent",
        "AgentOptions": "agent",
        "Batch": "replay",
        "Budget": "agent",
        "EquivariantAgent": "equivariant",
        "SacAgent": "sac",
        "SacOptions": "options",
        "StandardAgent": "standard",
        "Transition": "replay",
        "actor_equivariance_error": "diagnostics",
    },
)

AGENTS: Registry[type[Agent]] = Registry(
    "agent",
    "symsteer.agents",
    {
        "standard": "symsteer.agents.standard:StandardAgent",
        "standard-matched": "symsteer.agents.standard:MatchedStandardAgent",
        "augmented": "symsteer.agents.augmented:AugmentedAgent",
        "equivariant": "symsteer.agents.equivariant:EquivariantAgent",
        "residual-pathway": "symsteer.agents.residual_pathway:ResidualPathwayAgent",
        "slow": "symsteer.agents.slow:SlowAgent",
        "free-bias": "symsteer.agents.free_bias:FreeBiasAgent",
        "relaxed": "symsteer.agents.relaxed:RelaxedAgent",
        "projected": "symsteer.agents.projected:ProjectedAgent",
        "constrained": "symsteer.agents.constrained:ConstrainedAgent",
        "partial": "symsteer.agents.partial:PartialAgent",
        "ensemble": "symsteer.agents.ensemble:GroupEnsembleAgent",
        "displaced": "symsteer.agents.displaced:DisplacedAgent",
        "residual": "symsteer.agents.residual:ResidualAgent",
        "best-of-n": "symsteer.agents.best_of_n:BestOfNAgent",
        "wrong-group": "symsteer.agents.wrong_group:WrongGroupAgent",
        "base": "symsteer.agents.references:BaseAgent",
        "zero": "symsteer.agents.references:ZeroAgent",
        "golden-ticket": "symsteer.agents.golden_ticket:GoldenTicketAgent",
    },
    "symsteer.agents.agent:Agent",
)
