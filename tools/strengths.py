"""Strengths of breaks that harm the base policy equally in all tasks, from runs of ``base``.

symsteer sweep strengths --runs runs/strengths
python -m tools.strengths runs/strengths                 # of these runs
python -m tools.strengths leaderboard/results/strengths  # of the committed ones

A strength of 1 means little in one task and everything in another. So the strength of a break is
chosen for each task: the one at which the base policy keeps half of its unbroken success, between
the strengths that were tried (linear), rounded to .05. *Kept* is the mean over base policies, each
against its own unbroken success.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from symsteer.errors import UserError
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import read_record
from symsteer.tables import markdown
from symsteer.terminal import complain
from symsteer.variant import UNBROKEN, parse_variant

HALF = 0.5
"""Share of the unbroken success that a base policy shall keep."""

ROOM = 0.2, 0.8
"""Unbroken success outside of this leaves no room below or above."""

Successes = Mapping[str, Mapping[str, Mapping[int, float]]]
"""Final success by task, embodiment and number of demonstrations, variant and seed."""


def read(folders: Sequence[Path]) -> Successes:
    """Final success of the finished runs of ``base``."""
    found: dict[str, dict[str, dict[int, float]]] = defaultdict(lambda: defaultdict(dict))
    for path in record_files(folders):
        record = read_record(path)
        config = record.settings
        if config.agent == "base" and record.status == "finished" and record.final:
            count = config.demonstrations.count
            place = f"{config.task} {config.embodiment}, {count} demonstrations"
            found[place][config.variant][config.seed] = record.final.success_once
    if not found:
        names = ", ".join(map(str, folders))
        raise UserError(f"{names}: no finished run of base; run the suite strengths first")
    return found


def kept(successes: Mapping[str, Mapping[int, float]], variant: str) -> float:
    """Mean over base policies of their success as a share of the unbroken one."""
    unbroken, broken = successes.get(UNBROKEN, {}), successes[variant]
    if missing := sorted(broken.keys() - unbroken.keys()):
        raise UserError(f"base policy {missing[0]} has a run in {variant}, but no unbroken one")
    shares = [broken[seed] / unbroken[seed] for seed in sorted(broken) if unbroken[seed]]
    if not shares:
        raise UserError(f"no base policy of the runs in {variant} solves an unbroken episode")
    return float(np.mean(shares))


def chosen(strengths: Sequence[float], shares: Sequence[float]) -> float | None:
    """The strength at which half is kept, rounded to .05; None if more is kept everywhere.

    Args:
        strengths: rising.
        shares: kept at each.
    """
    # What a stronger break leaves is no more than what a weaker one leaves, but for chance.
    falling = np.minimum.accumulate([1.0, *shares])
    if falling[-1] > HALF:
        return None
    strength = np.interp(HALF, falling[::-1], [*strengths[::-1], 0.0])
    return max(0.05, round(float(strength) * 20) / 20)


def render(found: Successes) -> str:
    """A row for each place and break: what is kept at each strength, and which one is chosen."""
    rows = []
    for place, successes in sorted(found.items()):
        usual = float(np.mean(list(successes.get(UNBROKEN, {}).values()) or [0.0]))
        room = "" if ROOM[0] <= usual <= ROOM[1] else ", no room"
        dials: dict[str, dict[float, str]] = defaultdict(dict)
        for variant in successes:
            for spec in parse_variant(variant) if variant != UNBROKEN else ():
                if isinstance(spec.strength, float):
                    dials[spec.name][spec.strength] = variant
        for dial, variants in sorted(dials.items()):
            strengths = sorted(variants)
            shares = [kept(successes, variants[strength]) for strength in strengths]
            tried = ", ".join(
                f"{share:.2f} at {strength:g}"
                for strength, share in zip(strengths, shares, strict=True)
            )
            strength = chosen(strengths, shares)
            answer = "too weak" if strength is None else f"`{dial}:{strength:g}`"
            rows.append([place, f"{usual:.2f}{room}", f"`{dial}`", tried, answer])
    return markdown(["world", "unbroken success", "break", "kept", "chosen"], rows, left=5)


def main(arguments: Sequence[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs of the agent base")
    print(render(read(parser.parse_args(arguments).runs)))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(complain(error, f"error: {error}", 2))
