"""Where the symmetry of a world is broken: turned copies of visited states, simulated.

As in the audit, every copy of a state executes its turned decision. A copy is *broken* if it ends
elsewhere than the majority of its orbit, and further away than copies in the unbroken world do.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer.bench.audit.defects import departures, reference_task, visit_all
from symsteer.bench.audit.measure import Copies, Experiment
from symsteer.bench.audit.result import AuditSettings, check_group
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy

BODIES = ("tool", "object")
LEAST_DEPARTURE = 1e-3
"""A copy that ends closer to the majority (metres) is never broken."""
QUANTILE = 0.99
"""Of the departures in the unbroken world; a broken copy is beyond it."""


@dataclass(frozen=True)
class Truth:
    """Decisions of S orbits with G copies each, and what became of them.

    Attributes:
        obs, actions: of each copy, ``[S, G, obs_dim]`` in environment units and ``[S, G, Ta, Da]``.
        departure: distance from the majority, metres, of tool or object, ``[S, G]``.
        limit: copies beyond it are broken, metres.
        reached: which copies exist, ``[S, G]`` bool.
        place: initial positions of tool and object from the policy's origin, ``[S, G, 2]`` each.
    """

    obs: torch.Tensor
    actions: torch.Tensor
    departure: torch.Tensor
    limit: float
    reached: torch.Tensor
    place: dict[str, torch.Tensor]

    @property
    def broken(self) -> torch.Tensor:
        """Which copies are broken, ``[S, G]`` bool."""
        return (self.departure > self.limit) & self.reached


def measure_truth(settings: AuditSettings, policy: ChunkPolicy) -> Truth:
    """Simulate the copies in the broken and in the unbroken world.

    Args:
        settings: task, embodiment, variant, group and states.
        policy: visits states beside the scripted expert.

    Raises:
        UserError: if the world is not broken, or the settings are wrong.
    """
    settings.check()
    if settings.variant == "none":
        raise UserError(
            "the run's world is unbroken, so there is nothing to detect; name a run in a broken one"
        )
    group = check_group(settings.group)
    reference = reference_task(settings)
    visited = visit_all(reference, settings, policy)
    found = {}
    for variant in ("none", settings.variant):
        experiment = Experiment(reference, variant, group, visited, settings.seed, settings.sim)
        try:
            found[variant] = experiment.copies()
        finally:
            experiment.close()
    reference.close()
    unbroken, broken = found.values()
    usual = _departure(unbroken)[unbroken.reached].quantile(QUANTILE).item()
    elements = group.elements
    obs_layout, act_layout = reference.observation_layout, reference.action_layout
    # Observations were turned back.
    obs = torch.stack(
        [obs_layout.transform(broken.observations[:, g, 0], *e) for g, e in enumerate(elements)], 1
    )
    actions = torch.stack([act_layout.transform(visited.actions, *e) for e in elements], 1)
    return Truth(
        obs=obs.float(),
        actions=actions.float(),
        departure=_departure(broken),
        limit=max(usual, LEAST_DEPARTURE),
        reached=broken.reached,
        place=broken.place,
    )


def _departure(copies: Copies) -> torch.Tensor:
    return torch.stack([departures(copies, body) for body in BODIES]).amax(0)
