"""Writes the tables of docs/agents/asymmetry.md: what free biases say of a displaced camera.

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
from symsteer.leaderboard.text import SPACE, number
from symsteer.tables import markdown
from symsteer.variant import UNBROKEN, VariantSpec, parse_variant
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "agents" / "asymmetry.md"
RECORDS = CHECKOUT / "leaderboard" / "results" / "free-bias"

MEASURES = {
    "displacement_x": ("displacement x (cm)", 100, 2),
    "displacement_y": ("y (cm)", 100, 2),
    "motion_x": ("motion x (steps)", 1, 2),
    "motion_y": ("y (steps)", 1, 2),
    "asymmetry_critic": ("norm", 1, 2),
}
"""Heading, factor and digits of each diagnostic."""


def render(records: Sequence[RunRecord]) -> str:
    """A table a task: mean and standard deviation over base policies, and rank correlations.

    Raises:
        UserError: for a record of another agent, or none.
    """
    found: dict[str, dict[str, list[dict[str, float]]]] = defaultdict(lambda: defaultdict(list))
    for record in records:
        last = record.evaluations[-1].diagnostics
        values = {name: x for name in MEASURES if (x := last.get(name)) is not None}
        if record.settings.agent != "free-bias" or len(values) < len(MEASURES):
            raise UserError(f"{record.run_id} is no run of free-bias that has its shifts")
        found[record.settings.task][record.settings.variant].append(values)
    if not found:
        raise UserError("no finished run of free-bias; run the suite free-bias")
    heads = ["world", "displaced by", *(heading for heading, _, _ in MEASURES.values())]
    parts = []
    for task, of_task in sorted(found.items()):
        rows = []
        shifts = {variant: displacement(variant) for variant in of_task}
        known = sorted((shift, variant) for variant, shift in shifts.items() if shift is not None)
        others = sorted(variant for variant, shift in shifts.items() if shift is None)
        truths = {v: f"{shift:g}{SPACE}cm" for shift, v in known} | dict.fromkeys(others, "")
        for variant, truth in truths.items():
            runs = of_task[variant]
            cells = [_spread([run[name] for run in runs], name) for name in MEASURES]
            rows.append([f"`{variant}`", truth, *cells])
        pairs = [(shift, run) for shift, variant in known for run in of_task[variant]]
        true = [shift for shift, _ in pairs]
        ranks = [spearmanr(true, [run[name] for _, run in pairs]).statistic for name in MEASURES]
        rows.append(["rank correlation", "", *(number(rank, sign=True) for rank in ranks)])
        count = sum(map(len, of_task.values()))
        parts.append(f"`{task}`, {count} runs:\n\n{markdown(heads, rows)}")
    return "\n\n".join(parts)


def displacement(variant: str) -> float | None:
    """Centimetres along x by which what is seen is displaced; None in worlds with other breaks."""
    if variant == UNBROKEN:
        return 0.0
    match parse_variant(variant):
        case (VariantSpec("perception_bias", float() as strength),):
            return BIAS_CENTIMETRES * strength
    return None


def _spread(values: Sequence[float], name: str) -> str:
    _, factor, digits = MEASURES[name]
    values = [factor * value for value in values]
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{number(statistics.mean(values), digits)} ({number(deviation, digits)})".replace(
        " ", SPACE
    )


def _collected(arguments: Sequence[str]) -> list[RunRecord]:
    places = [Path(argument) for argument in arguments]
    new = [f for p in places for f in ([p] if p.is_file() else sorted(p.glob("*/record.json")))]
    finished = {path: record for path in new if (record := read_record(path)).status == "finished"}
    if finished:
        render([*finished.values()])  # refuses other runs before any is copied
    for path in finished:
        RECORDS.mkdir(parents=True, exist_ok=True)
        write_atomically(RECORDS / f"{path.parent.name}.json", path.read_bytes())
    return [read_record(path) for path in sorted(RECORDS.glob("*.json"))]


def main(arguments: Sequence[str]) -> int:
    """Write the tables."""
    return write_tables(PAGE, lambda: render(_collected(arguments)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
