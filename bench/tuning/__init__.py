"""Tuning: the same number of trials for every agent, on cells that no leaderboard uses."""

from __future__ import annotations

import tomllib
from pathlib import Path

FOLDER = Path(__file__).parent / "plans"


def plan_summaries() -> dict[str, str]:
    """The tuning plans that come with SymSteer, and their descriptions. Light to import."""
    return {
        path.stem: tomllib.loads(path.read_text())["description"]
        for path in sorted(FOLDER.glob("*.toml"))
    }
