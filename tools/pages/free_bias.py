"""Writes the table of docs/agents/asymmetry.md: what free biases say of a displaced camera.

python -m tools.pages.free_bias          # from the committed records
python -m tools.pages.free_bias RUNS     # copies the finished records of the suite free-bias first

Records are in leaderboard/results/free-bias. RUNS may also be one record.
"""

from __future__ import annotations

import statistics
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from scipy.stats import spearmanr

from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.leaderboard.catalogue import BIAS_CENTIMETRES
from symsteer.leaderboard.records import RunRecord, read_record
from symsteer.tables import markdown
from symsteer.variant import UNBROKEN, parse_variant
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "agents" / "asymmetry.md"
RECORDS = CHECKOUT / "leaderboard" / "results" / "free-bias"

MEASURES = {
    "asymmetry_actor": "asymmetry of the actor",
    "asymmetry_critic": "of the critics",
    "equivariance_actor": "equivariance error of the actor",
}


def displacement(record: RunRecord) -> float:
    """Centimetres along x by which what is seen is displaced."""
    variant = record.settings.variant
    strengths = [spec.strength for spec in parse_variant(variant)] if variant != UNBROKEN else []
    return BIAS_CENTIMETRES * sum(each for each in strengths if isinstance(each, float))


def render(records: Sequence[RunRecord]) -> str:
    """Mean and standard deviation over base policies, and rank correlations over all runs."""
    found: dict[str, dict[float, list[dict[str, float]]]] = defaultdict(lambda: defaultdict(list))
    for record in records:
        last = record.evaluations[-1].diagnostics
        values = {name: x for name in MEASURES if (x := last.get(name)) is not None}
        if len(values) < len(MEASURES):
            raise UserError(f"{record.run_id} has no asymmetry: it is no run of free-bias")
        found[record.settings.task][displacement(record)].append(values)
    if not found:
        raise UserError("no finished run of free-bias; run the suite free-bias")
    rows = []
    for task, of_task in sorted(found.items()):
        for shift, runs in sorted(of_task.items()):
            cells = [_spread([run[name] for run in runs]) for name in MEASURES]
            rows.append([f"`{task}`", f"{shift:g} cm", str(len(runs)), *cells])
        pairs = [(shift, run) for shift, runs in of_task.items() for run in runs]
        shifts = [shift for shift, _ in pairs]
        ranks = [spearmanr(shifts, [run[name] for _, run in pairs]).statistic for name in MEASURES]
        rows.append([f"`{task}`", "rank correlation", "", *(f"{rank:+.2f}" for rank in ranks)])
    return markdown(["task", "displaced by", "runs", *MEASURES.values()], rows, left=2)


def _spread(values: Sequence[float]) -> str:
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{statistics.mean(values):.3f} ({deviation:.3f})"


def _collected(arguments: Sequence[str]) -> list[RunRecord]:
    for folder in map(Path, arguments):
        paths = [folder] if folder.is_file() else sorted(folder.glob("*/record.json"))
        for path in paths:
            if read_record(path).status == "finished":
                RECORDS.mkdir(parents=True, exist_ok=True)
                write_atomically(RECORDS / f"{path.parent.name}.json", path.read_bytes())
    return [read_record(path) for path in sorted(RECORDS.glob("*.json"))]


def main(arguments: Sequence[str]) -> int:
    """Write the table."""
    return write_tables(PAGE, lambda: render(_collected(arguments)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
