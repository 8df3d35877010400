"""Detectors of broken symmetry: where a replay buffer says that the world is not symmetric.

``DETECTORS`` maps names to classes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symsteer.registry import Registry

if TYPE_CHECKING:
    from symsteer.agents.detectors.detector import Detector

DETECTORS: Registry[type[Detector]] = Registry(
    "detector",
    "symsteer.detectors",
    {
        "neighbours": "symsteer.agents.detectors.neighbours:Neighbours",
        "gate": "symsteer.agents.detectors.gate:GateDetector",
        "ensemble": "symsteer.agents.detectors.ensemble:EnsembleDetector",
        "evidential": "symsteer.agents.detectors.evidential:EvidentialDetector",
        "atlas": "symsteer.agents.detectors.atlas:AtlasDetector",
    },
    "symsteer.agents.detectors.detector:Detector",
)
