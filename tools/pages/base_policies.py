"""Writes the tables of docs/base-policies.md from the committed records of the suite `policies`.

python -m tools.pages.base_policies                # from the committed records
python -m tools.pages.base_policies RUNS           # copies the finished records first
python -m tools.pages.base_policies --decode FILE  # replaces the times of decoding first

Records are in leaderboard/results/policies. FILE holds what `python -m tools.speed decode --json`
prints. leaderboard/results/base-policies/gradient.json holds what `python -m
tools.gradient_variance` prints.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from scipy.stats import spearmanr

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.leaderboard.known_agents import ROW_ORDER
from symsteer.leaderboard.records import RunRecord, read_record
from symsteer.leaderboard.statistics import (
    Interval,
    Sample,
    cell_estimates,
    combined,
    success_interval,
)
from symsteer.leaderboard.text import difference, number
from symsteer.policies import POLICIES
from symsteer.tables import markdown
from symsteer.terminal import complain
from tools.pages.marks import CHECKOUT, check_checkout, with_tables

PAGE = CHECKOUT / "docs" / "base-policies.md"
RESULTS = CHECKOUT / "leaderboard" / "results"
RECORDS = RESULTS / "policies"
DECODE = RESULTS / "base-policies" / "decode.json"
GRADIENT = RESULTS / "base-policies" / "gradient.json"

MEASURES = {"equivariance_error": "{:.1g}", "jump": "{:.2g}", "action_std": "{:.2f}"}
MEASURES |= {"solvable": "{:.2f}"}
"""Of the base policy, as the record has them, and how they are written."""

DEFAULT = "`edp`"
"""Label of the policy that the others are compared with."""

BEST = "`edp` zero_output"
"""Label of the policy that the page advises to train: those with several numbers of demonstrations
are compared with it, too."""

TILTED = "Tilted"
"""Tasks whose names begin so are on a tilted table; their tables are their own."""

STEERED = 50
"""Demonstrations of the policies that agents steer."""

MANY = 100
"""Demonstrations with which policies are described on tilted tables, where none is steered."""

BEFORE = {"zero_output": False}
"""Options that the first records lack, and what they were."""

PAIRS = (
    ("`edp` steps 6000", "`edp`"),
    ("`edp` steps 6000", "`plain-augmented`"),
    ("`plain-augmented` steps 6000", "`plain-augmented`"),
    ("`plain-augmented` steps 6000", "`edp` steps 6000"),
    ("`canonical`", "`canonical` match_compute False"),
    ("`plain`", "`plain` match_compute False"),
    (BEST, DEFAULT),
    (BEST, "`plain-augmented`"),
    (BEST, "`plain-augmented` zero_output"),
    ("`plain-augmented` zero_output", "`plain-augmented`"),
    ("`so2`", "`so2` zero_output False"),
    ("`so2`", BEST),
    ("`spherical`", BEST),
    ("`spherical` channels 64 depth 3 width 64", BEST),
)
"""Pairs of labels that tell the effect of the training from that of the policy. By themselves
plain networks take four gradient steps for each of `steps`; see `match_compute`."""

STARTS = ((BEST, DEFAULT), ("`so2`", "`so2` zero_output False"))
"""The same policies whose output layer starts at 0, and with random weights."""


def label(name: str, options: Mapping[str, Any]) -> str:
    """The policy's name and those of its options that are not the default.

    The other tasks of a joint policy are left out: it is one policy for all of them.
    """
    own = [
        value if isinstance(value := options[key], str) else f"{key} {value}".removesuffix(" True")
        for key, default in sorted(_defaults(name).items())
        if key != "tasks" and options.get(key, default) != default
    ]
    return " ".join([f"`{name}`", *own])


@functools.cache
def _defaults(name: str) -> dict[str, Any]:
    return POLICIES.get(name).Options().to_json()


def label_of(record: RunRecord) -> str:
    """The label of a run's base policy."""
    options: Mapping[str, Any] = record.config["policy"]  # type: ignore[assignment]
    return label(str(options["name"]), BEFORE | dict(options))


def success(records: Sequence[RunRecord]) -> Interval:
    """Success of runs in their final episodes, with an interval over policies and episodes."""
    samples = [
        Sample.pooled(
            zip(run.final.episodes.seed, map(float, run.final.episodes.success_once), strict=True),
            run.base_policy.content_hash,
        )
        for run in records
        if run.final
    ]
    return success_interval(samples)


def gain(runs: Sequence[RunRecord], others: Sequence[RunRecord]) -> Interval | None:
    """Success of runs minus that of others, by task, training and episode; the mean over tasks.

    None if no run has the task and the seed of another.
    """
    rivals = {(run.settings.task, run.settings.seed): run for run in others}
    cells: dict[str, list[Sample]] = defaultdict(list)
    for run in runs:
        task, seed = run.settings.task, run.settings.seed
        rival = rivals.get((task, seed))
        if rival and rival.final and run.final:
            both = (rival.final.episodes, run.final.episodes)
            theirs, own = (
                dict(zip(found.seed, map(float, found.success_once), strict=True)) for found in both
            )
            pairs = ((episode, own[episode] - theirs[episode]) for episode in own)
            cells[task].append(Sample.pooled(pairs, f"{task} {seed}"))
    return combined(cell_estimates(list(cells.values()))).interval() if cells else None


def render(
    records: Sequence[RunRecord],
    decode: Sequence[Mapping[str, Any]],
    gradient: Sequence[Mapping[str, Any]],
) -> str:
    """All tables, in markdown.

    Args:
        records: finished runs of the suite.
        decode: rows of `python -m tools.speed decode`.
        gradient: rows of `python -m tools.gradient_variance`.
    """
    records = sorted(records, key=_place)
    tilted = [record for record in records if record.settings.task.startswith(TILTED)]
    records = [record for record in records if not record.settings.task.startswith(TILTED)]
    base = [record for record in records if record.settings.agent == "base"]
    parts = [
        *successes(base),
        (f"Against {DEFAULT}", gains(base)),
        (f"Against {BEST}", gains(base, BEST)),
        ("Started at 0, against random first weights", starts(base)),
        (f"What they are ({STEERED} demonstrations)", properties(base)),
        (f"What they cost ({STEERED} demonstrations)", costs(base, decode)),
        ("What agents make of them", steered(records)),
        (f"Agents against the same ones on {DEFAULT}", steered_gains(records)),
        (f"Trained in another way ({STEERED} demonstrations)", pairs(records)),
        ("What tells how far agents get", foretold(records)),
        ("Success with orbit targets", orbit_gains(base)),
        ("Variance of the gradient with orbit targets", variances(gradient)),
        *successes(tilted),
        (f"Against {DEFAULT}, on a tilted table", gains(tilted)),
        (f"Against {BEST}, on a tilted table", gains(tilted, BEST)),
        (f"What they are, on a tilted table ({MANY} demonstrations)", properties(tilted, MANY)),
    ]
    return "\n\n".join(f"### {title}\n\n{text}" for title, text in parts if text)


def _place(record: RunRecord) -> tuple[int, str, str]:
    """Where a run stands: policies as they are listed, then tasks."""
    name = str(record.config["policy"]["name"])  # type: ignore[index,call-overload]
    place = list(POLICIES.builtin).index(name)
    return place, label_of(record), record.settings.task


Column = TypeVar("Column", bound=int | str)
"""Numbers of demonstrations, or agents."""

Cells = Mapping[str, Mapping[Column, list[RunRecord]]]
"""Runs by label of the policy and column."""


def _cells(
    records: Sequence[RunRecord], column: Callable[[RunRecord], Column]
) -> dict[str, dict[Column, list[RunRecord]]]:
    cells: dict[str, dict[Column, list[RunRecord]]] = {}
    for record in records:
        cells.setdefault(label_of(record), {}).setdefault(column(record), []).append(record)
    return cells


def successes(base: Sequence[RunRecord]) -> list[tuple[str, str]]:
    """Title and table of each task."""
    tasks = dict.fromkeys(record.settings.task for record in base)
    return [(f"{task}: success", demonstrations(base, task)) for task in tasks]


def demonstrations(base: Sequence[RunRecord], task: str) -> str:
    """Success of each policy on a task by number of demonstrations."""
    cells = _cells([record for record in base if record.settings.task == task], _count)
    counts = sorted({count for found in cells.values() for count in found})
    rows = [
        [name, *(_interval(success(found[n])) if n in found else "-" for n in counts)]
        for name, found in cells.items()
    ]
    return markdown(["policy", *map(str, counts)], rows)


def gains(base: Sequence[RunRecord], rival: str = DEFAULT) -> str:
    """Success of each policy minus that of the rival, by number of demonstrations.

    Beside another rival than the default only policies with several numbers are shown.
    """
    cells = _cells(base, _count)
    if rival != DEFAULT:
        cells = {name: found for name, found in cells.items() if len(found) > 1}
    counts = sorted({count for found in cells.values() for count in found})
    return _against(rival, cells, {count: str(count) for count in counts})


def steered_gains(records: Sequence[RunRecord]) -> str:
    """Success of each agent on a policy beside that of the same agent on the default policy."""
    steered = [record for record in records if _count(record) == STEERED]
    cells = _cells(steered, lambda record: record.settings.agent)
    several = {name: found for name, found in cells.items() if len(found) > 1}
    return _against(DEFAULT, several, {agent: f"`{agent}`" for agent in _agents(records)})


def _against(rival: str, cells: Cells[Column], columns: Mapping[Column, str]) -> str:
    """Differences to the runs of the rival in the same column, whose heads are given."""
    rivals = cells.get(rival, {})
    rows = []
    for name, own in cells.items():
        if name != rival:
            gained = [gain(own.get(c, ()), rivals.get(c, ())) for c in columns]
            rows.append([name, *map(difference, gained)])
    return markdown(["policy", *columns.values()], rows) if rows and rivals else ""


def starts(base: Sequence[RunRecord]) -> str:
    """What the start at 0 gains, by number of demonstrations."""
    cells = _cells(base, _count)
    counts = sorted({_count(record) for record in base})
    rows = [
        [name, *(difference(gain(cells[name].get(n, ()), cells[rival].get(n, ()))) for n in counts)]
        for name, rival in STARTS
        if {name, rival} <= cells.keys()
    ]
    return markdown(["policy", *map(str, counts)], rows) if rows else ""


def _count(record: RunRecord) -> int:
    return record.settings.demonstrations.count


def properties(base: Sequence[RunRecord], count: int = STEERED) -> str:
    """Size, symmetry and steerability of each policy, over tasks and trainings."""
    rows = []
    for name, found in _trained(base, count).items():
        row = [name, str(len(found)), _median(found, "parameters")]
        row.append(_median(found, "training_seconds"))
        for measure, form in MEASURES.items():
            row.append(_range([form.format(value) for value in _known(found, measure)]))
        rows.append(row)
    head = ["policy", "trainings", "parameters", "training, s"]
    head += ["equivariance error", "jump", "spread", "solvable"]
    return markdown(head, rows) if rows else ""


def costs(base: Sequence[RunRecord], decode: Sequence[Mapping[str, Any]]) -> str:
    """Success of each policy on each task beside the time in which it decodes, cheapest first."""
    decode = [row for row in decode if row.get("device", "cpu") == "cpu"]
    largest = max((row["chunks"] for row in decode), default=0)
    times = {label(r["policy"], r["options"]): r for r in decode if r["chunks"] == largest}
    tasks = list(dict.fromkeys(record.settings.task for record in base))
    groups = _trained(base)
    rows = []
    timed = [name for name in groups if name in times]
    for name in sorted(timed, key=lambda name: times[name]["median"]):
        time = times[name]
        row = [name, f"{time['median']:.1f}", f"{time['products'] / time['median']:.0%}"]
        for task in tasks:
            found = [record for record in groups[name] if record.settings.task == task]
            row.append(_interval(success(found)) if found else "-")
        gained = gain(groups[name], groups.get(DEFAULT, ()))
        row.append("" if name == DEFAULT else difference(gained))
        rows.append(row)
    head = ["policy", "decode, ms", "its products", *(task.removesuffix("-v1") for task in tasks)]
    return markdown([*head, f"against {DEFAULT}"], rows) if rows else ""


def pairs(records: Sequence[RunRecord]) -> str:
    """Success of each pair's first policy, alone and steered, minus that of its second one."""
    trained = [record for record in records if _count(record) == STEERED]
    cells = _cells(trained, lambda record: record.settings.agent)
    agents = _agents(trained)
    rows = []
    for name, other in PAIRS:
        if name in cells and other in cells:
            own, theirs = cells[name], cells[other]
            first, second = (_median(runs["base"], "training_seconds") for runs in (own, theirs))
            row = [name, first, other, second]
            gained = [gain(own.get(agent, ()), theirs.get(agent, ())) for agent in agents]
            rows.append([*row, *map(difference, gained)])
    head = ["policy", "training, s", "minus", "training, s", *(f"`{agent}`" for agent in agents)]
    return markdown(head, rows) if rows else ""


def _median(found: Sequence[RunRecord], measure: str) -> str:
    values = _known(found, measure)
    return f"{statistics.median(values):,.0f}" if values else "-"


def _trained(base: Sequence[RunRecord], count: int = STEERED) -> Mapping[str, list[RunRecord]]:
    """The runs whose policies have so many demonstrations, by label."""
    cells = _cells(base, _count)
    return {name: found[count] for name, found in cells.items() if count in found}


def steered(records: Sequence[RunRecord]) -> str:
    """Success of the policy, of w = 0 and of agents, on the trainings that all of them have."""
    cells: dict[tuple[str, str], dict[str, list[RunRecord]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for record in records:
        if _count(record) == STEERED:
            cells[label_of(record), record.settings.task][record.settings.agent].append(record)
    agents = _agents(records)
    rows = []
    for (name, task), found in cells.items():
        if len(found) < 2:
            continue
        hashes = [{run.base_policy.content_hash for run in runs} for runs in found.values()]
        shared = set.intersection(*hashes)
        row = [name, task.removesuffix("-v1"), str(len(shared))]
        for agent in agents:
            runs = [r for r in found.get(agent, ()) if r.base_policy.content_hash in shared]
            row.append(_interval(success(runs)) if runs else "-")
        rows.append(row)
    return (
        markdown(["policy", "task", "trainings", *(f"`{a}`" for a in agents)], rows) if rows else ""
    )


FORETELL: Mapping[str, Callable[[RunRecord], float | None]] = {
    "its own success": lambda run: run.final.success_once if run.final else None,
    "spread": lambda run: run.base_policy.action_std,
    "solvable": lambda run: run.base_policy.solvable,
}
"""What is known of a policy before it is steered, from its own run."""


def foretold(records: Sequence[RunRecord]) -> str:
    """Rank correlation of what is known of a policy and an agent's success on it, by task."""
    runs: dict[str, dict[tuple[str, str], RunRecord]] = defaultdict(dict)
    for run in records:
        if _count(run) == STEERED and run.final:
            runs[run.settings.agent][run.settings.task, run.base_policy.content_hash] = run
    base = runs.pop("base", {})
    rows = []
    for agent in _agents([run for found in runs.values() for run in found.values()]):
        for task in sorted({task for task, _ in runs[agent]}):
            both = [place for place in runs[agent] if place[0] == task and place in base]
            success = [FORETELL["its own success"](runs[agent][place]) for place in both]
            cells = []
            for known in FORETELL.values():
                values = [known(base[place]) for place in both]
                varies = None not in values and min(len(set(values)), len(set(success))) > 1
                cells.append(number(spearmanr(values, success).statistic) if varies else "-")
            name = f"`{agent}`, {task.removesuffix('-v1')} ({len(both)})"
            rows.append([name, *cells])
    return markdown(["agent, task (trainings)", *FORETELL], rows) if base and rows else ""


def _agents(records: Sequence[RunRecord]) -> list[str]:
    """Agents in the order of the leaderboard's rows."""
    found = {record.settings.agent for record in records}
    return [a for a in ROW_ORDER if a in found] + sorted(found - {*ROW_ORDER})


def orbit_gains(base: Sequence[RunRecord]) -> str:
    """Success of each policy with orbit targets and without, after equally many steps."""
    cells = _trained(base)
    rows = []
    for found in cells.values():
        options: Mapping[str, Any] = found[0].config["policy"]  # type: ignore[assignment]
        if options.get("orbit_targets"):
            rival = label(str(options["name"]), {**options, "orbit_targets": False})
            others = cells.get(rival, [])
            row = [rival, _interval(success(found)), _interval(success(others)) if others else "-"]
            rows.append([*row, difference(gain(found, others))])
    return markdown(["policy", "with", "without", "difference"], rows) if rows else ""


def variances(gradient: Sequence[Mapping[str, Any]]) -> str:
    """Variance with orbit targets as a share of that without: mean [lowest, highest]."""
    cells: dict[tuple[str, float], dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in gradient:
        cell = cells[row["policy"], row["observation_noise"]]
        cell[row["steps"]].append(row["orbit"] / row["own"])
    steps = sorted({step for cell in cells.values() for step in cell})
    rows = [
        [f"`{policy}`", f"{deviation:g}", *(_spread(cell[step]) for step in steps)]
        for (policy, deviation), cell in cells.items()
    ]
    head = [f"`steps` {step:,}" for step in steps]
    return markdown(["policy", "observation noise", *head], rows) if rows else ""


def _spread(values: Sequence[float]) -> str:
    return f"{statistics.mean(values):.4f} [{min(values):.4f}, {max(values):.4f}]"


def _interval(found: Interval) -> str:
    return f"{found.value:.2f} [{found.low:.2f}, {found.high:.2f}]"


def _known(found: Sequence[RunRecord], measure: str) -> list[float]:
    return sorted(v for run in found if (v := getattr(run.base_policy, measure)) is not None)


def _range(values: Sequence[str]) -> str:
    return " to ".join(dict.fromkeys((values[0], values[-1]))) if values else "-"


def finished(folder: Path) -> dict[str, Path]:
    """Paths of the finished runs' records below a folder, by run."""
    records = {path: read_record(path) for path in sorted(folder.glob("*/record.json"))}
    return {run.run_id: path for path, run in records.items() if run.status == "finished"}


def _rows(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text("utf-8-sig"))["rows"] if path.is_file() else []


def main(arguments: Sequence[str]) -> int:
    """Write docs/base-policies.md; returns the exit code."""
    parser = argparse.ArgumentParser(description="Write the tables of docs/base-policies.md.")
    parser.add_argument("runs", nargs="?", type=Path, help="runs whose records are copied")
    parser.add_argument("--decode", type=Path, help="output of python -m tools.speed decode --json")
    given = parser.parse_args(arguments)
    files: dict[Path, bytes] = {}
    try:
        check_checkout(PAGE)
        if given.runs:
            new = finished(given.runs)
            files = {RECORDS / f"{name}.json": path.read_bytes() for name, path in new.items()}
            if not files:
                raise UserError(f"{given.runs} holds no finished run; name the folder of the sweep")
            write_together(files)
        if given.decode:
            write_together({DECODE: given.decode.read_bytes()})
        records = [read_record(path) for path in sorted(RECORDS.glob("*.json"))]
        try:
            tables = render(records, _rows(DECODE), _rows(GRADIENT))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{DECODE} or {GRADIENT} cannot be read ({error}); write them again with "
                "`python -m tools.speed decode --json` and `python -m "
                "tools.gradient_variance`"
            ) from None
        text = with_tables(PAGE.read_text(), tables, "docs/base-policies.md")
        write_together({PAGE: text.encode()})
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(f"wrote the tables of {len(records)} records to {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
