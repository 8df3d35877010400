"""Folders of records for the tests of `symsteer compare`."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from symsteer.leaderboard.compare.changes import Changes
from symsteer.leaderboard.compare.pairing import pair_runs
from symsteer.leaderboard.compare.sides import read_sides
from symsteer.leaderboard.records import RunRecord, write_record
from tests.leaderboard.record_factory import edited, make_evaluation, make_record


def save(folder: Path, records: Iterable[RunRecord]) -> Path:
    """Write each record into a run folder of its own; the folder."""
    for index, record in enumerate(records):
        write_record(record, folder / f"run-{index}" / "record.json")
    return folder


def runs_of(
    *curves: list[list[int]], policies: bool = False, first_seed: int = 0, **config: Any
) -> list[RunRecord]:
    """A run for each curve, with the next seed: for each evaluation its episodes, 0 or 1.

    Args:
        policies: whether each seed has a base policy of its own.
    """
    records = []
    for seed, curve in enumerate(curves, first_seed):
        steps = [50_000 * i // max(1, len(curve) - 1) for i in range(len(curve))]
        evaluations = [
            make_evaluation(episodes, step, final=index == len(curve) - 1, q_bias=float(-seed - 1))
            for index, (episodes, step) in enumerate(zip(curve, steps, strict=True))
        ]
        record = make_record(evaluations, seed=seed, **config)
        if policies:
            record.base_policy.content_hash = hashlib.sha256(f"policy {seed}".encode()).hexdigest()
        records.append(record)
    return records


def at_commit(records: Iterable[RunRecord], commit: str) -> list[RunRecord]:
    """The records as if code of another commit had made them."""
    return [edited(record, {"provenance/commit": commit}) for record in records]


def changed(a: Path | str, b: Path | str, place: Path | str = "runs", margin: float = 0) -> Changes:
    return pair_runs(*read_sides(str(a), str(b), Path(place)), margin)
