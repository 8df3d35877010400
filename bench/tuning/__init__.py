"""Tuning: the same number of trials for every agent, on cells that no leaderboard uses."""

from __future__ import annotations

from pathlib import Path

from symsteer.files import read_toml

FOLDER = Path(__file__).parent / "plans"


def plan_summaries() -> dict[str, str]:
    """The tuning plans that come with SymSteer, and their descriptions. Light to import."""
    return {
        path.stem: read_toml(path.stem, "tuning plan", FOLDER)[0]["description"]
        for path in sorted(FOLDER.glob("*.toml"))
    }
