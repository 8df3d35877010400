"""What SymSteer comes with, by name: records are judged by it without importing tasks or agents."""

from __future__ import annotations

from symsteer.leaderboard.records import Role

EMBODIMENTS = ("floating", "panda")

TASKS = {
    **dict.fromkeys(("PushCube-v1", "PullCube-v1", "PickCube-v1", "PlaceSphere-v1"), 50),
    **dict.fromkeys(("LiftPegUpright-v1", "TiltedPushCube-v1", "TiltedPickCube-v1"), 50),
    **dict.fromkeys(("SeenPushCube-v1", "SeenPickCube-v1"), 50),
    **dict.fromkeys(("HeightPushCube-v1", "HeightPickCube-v1"), 50),
    **dict.fromkeys(("HandPushCube-v1", "HandPickCube-v1"), 50),
    **{"StackCube-v1": 60, "PokeCube-v1": 60, "ClutterPick-v1": 80, "PushT-v1": 100},
}
"""The time limit of each task, in control steps."""

VARIANTS = {
    **dict.fromkeys(("gravity_tilt", "wind", "action_gain", "actuator_offset", "obstacle"), 0.0),
    **dict.fromkeys(("friction_patch", "perception_bias", "frame_offset", "frame_rotation"), 0.0),
    "camera_rotation": 0.0,
    **{"directional_reward": 1.0, "spawn_sector": 0.0, "observation_noise": 0.0},
}
"""What a step before success may cost besides 1, at full strength."""

IN_WORDS = {
    "gravity_tilt": "gravity leans to a side",
    "wind": "wind on the object",
    "action_gain": "weak motor along one axis",
    "actuator_offset": "motions end displaced",
    "friction_patch": "rough patch on the table",
    "obstacle": "post on one side",
    "perception_bias": "objects are seen displaced",
    "camera_rotation": "objects are seen turned",
    "frame_offset": "wrong centre",
    "frame_rotation": "turned axes",
    "directional_reward": "motion to a side costs more",
    "spawn_sector": "objects start on one side",
    "observation_noise": "noise along one axis",
}
"""What each variant is for somebody who does not know its name."""

BIAS, BIAS_CENTIMETRES = "perception_bias", 2.0
"""The variant that displaces what is seen, and by how much at strength 1."""

TRAINING_ONLY = frozenset({"spawn_sector"})
"""Variants in which agents are not evaluated."""

POLICIES = (
    *("edp", "escnn", "frame-averaged", "so2", "spherical", "canonical", "plain"),
    *("plain-augmented", "edp-joint", "plain-joint", "edp-told"),
)

REFERENCES = ("base", "zero", "golden-ticket")

RETIRED_AGENTS: dict[str, Role] = {
    **dict.fromkeys(("approximate", "best-of-n-kernel"), "learner"),
    **dict.fromkeys(("resilient", "chooser", "balanced", "screened"), "learner"),
}
"""Agents whose records stay when SymSteer has them no more; `approximate` is of version 0.1."""

AGENTS: dict[str, Role] = {
    **dict.fromkeys(REFERENCES, "reference"),
    **dict.fromkeys(("standard", "standard-matched", "augmented", "equivariant"), "learner"),
    **dict.fromkeys(("residual-pathway", "relaxed", "projected", "constrained"), "learner"),
    **dict.fromkeys(("slow", "free-bias"), "learner"),
    **dict.fromkeys(("partial", "ensemble", "displaced"), "learner"),
    **dict.fromkeys(("residual", "best-of-n"), "learner"),
    **{"wrong-group": "control"},
    **RETIRED_AGENTS,
}
"""The role of each agent."""
