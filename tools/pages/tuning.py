"""Writes the tables of docs/tuning.md from the committed trials.

python -m tools.pages.tuning                            # from the committed trials
python -m tools.pages.tuning RUNS/tuning/PLAN.json      # adds or replaces those of a plan

The committed trials are leaderboard/results/tuning/PLAN.json.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.stats import ttest_1samp

from symsteer.bench.tuning.trials import (
    START,
    Chosen,
    Score,
    Setting,
    TrialResult,
    from_json,
    mean_auc,
)
from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.tables import markdown
from symsteer.terminal import complain
from tools.pages.marks import CHECKOUT, check_checkout, with_tables

PAGE = CHECKOUT / "docs" / "tuning.md"
TRIALS = CHECKOUT / "leaderboard" / "results" / "tuning"
MANY = 4
"""Numbers of a range are shown in thirds if there are more of them."""


def generate(page: str, plans: Mapping[str, Mapping[str, Any]]) -> str:
    """Replace the tables of docs/tuning.md.

    Args:
        page: its text.
        plans: by name, the data of ``PLAN.json``.

    Raises:
        UserError: the page lacks the marks around the tables.
    """
    tables = [render(name, *from_json(data), data["data"]["probe"]) for name, data in plans.items()]
    return with_tables(page, "\n\n".join(tables), "docs/tuning.md")


def render(name: str, trials: Sequence[TrialResult], chosen: Sequence[Chosen], probe: int) -> str:
    """All tables of a plan, in markdown.

    Args:
        name: of the plan.
        trials: of all agents.
        chosen: their settings; empty before all trials have ended.
        probe: cells that every trial has.
    """
    parts = [
        ("what was tried", effort(trials)),
        ("what was chosen", choices(trials, chosen)),
        ("on fresh cells", comparison(chosen)),
        ("one option alone", singles(trials, chosen)),
        ("response to each option", response(trials, probe)),
    ]
    return "\n\n".join(f"### `{name}`: {title}\n\n{text}" for title, text in parts if text)


def effort(trials: Sequence[TrialResult]) -> str:
    """Trials, runs and hours of each agent."""
    rows = []
    for agent in _agents(trials):
        own = [trial for trial in trials if trial.agent == agent]
        states = [trial.state for trial in own]
        scores = [score for trial in own for score in trial.scores]
        hours = sum(score.seconds for score in scores) / 3600
        counts = [len(own), *(states.count(s) for s in ("complete", "pruned", "failed"))]
        known = [score.finite for score in scores if score.finite is not None]
        lost = str(known.count(False)) if known else "-"
        rows.append([f"`{agent}`", *map(str, counts), str(len(scores)), lost, f"{hours:.1f}"])
    head = ["agent", "trials", "complete", "given up", "failed", "runs", "Q not finite"]
    return markdown([*head, "hours of one core"], rows)


def choices(trials: Sequence[TrialResult], chosen: Sequence[Chosen]) -> str:
    """The options that were chosen; those that differ from the first trial's are bold."""
    names = dict.fromkeys(name for choice in chosen for name in choice.options)
    start = {t.agent: t.options for t in trials if t.number == START}

    def cell(choice: Chosen, name: str) -> str:
        if name not in choice.options:
            return ""
        text = _value(choice.options[name])
        return text if choice.options[name] == start[choice.agent][name] else f"**{text}**"

    rows = [[f"`{name}`", *(cell(choice, name) for choice in chosen)] for name in names]
    rows.append(["mean rank", *(f"{choice.rank:.1f}" for choice in chosen)])
    rows.append(["of the start", *(f"{choice.start_rank:.1f}" for choice in chosen)])
    return markdown(["option", *(f"`{choice.agent}`" for choice in chosen)], rows) if chosen else ""


def comparison(chosen: Sequence[Chosen]) -> str:
    """Mean area on fresh cells, and the difference to the start, paired by cell."""
    rows = []
    for choice in chosen:
        if not choice.fresh:
            continue
        start = {score.cell: score.auc for score in choice.fresh.get("start", ())}
        row = [f"`{choice.agent}`"]
        for setting in get_args(Setting):
            scores = choice.fresh.get(setting, ())
            if not scores:
                row.append("-")
            elif setting == "start":
                row.append(f"{mean_auc(scores):.3f}")
            else:
                gaps = {s: s.auc - start[s.cell] for s in scores if s.cell in start}
                better = sum(gap > 0 for gap in gaps.values())
                row.append(
                    f"{mean_auc(scores):.3f} ({_difference(gaps)}, better in {better} of "
                    f"{len(gaps)})"
                )
        rows.append(row)
    head = ["agent", "start", "one option", "chosen", "chosen for each task"]
    return markdown(head, rows) if rows else ""


def _difference(gaps: Mapping[Score, float]) -> str:
    """Mean of the gaps and its 95 % t-interval over base policies."""
    policies: dict[str, list[float]] = {}
    for score, gap in gaps.items():
        policies.setdefault(score.policy, []).append(gap)
    means = [np.mean(own) for own in policies.values()]
    text = f"{np.mean(list(gaps.values())):+.3f}"
    if len(means) < 2:
        return text
    interval = ttest_1samp(means, 0).confidence_interval()
    return f"{text} [{interval.low:+.2f}, {interval.high:+.2f}]"


def singles(trials: Sequence[TrialResult], chosen: Sequence[Chosen]) -> str:
    """Mean area of the start with one option of the choice, on the cells of the trials."""
    rows = []
    for choice in chosen:
        if not choice.singles:
            continue
        own = {t.number: mean_auc(t.scores) for t in trials if t.agent == choice.agent and t.scores}
        each = {
            f"`{name}` {_value(choice.options[name])}": mean_auc(scores)
            for name, scores in choice.singles.items()
        }
        each = dict(sorted(each.items(), key=lambda item: -item[1]))
        texts = ", ".join(f"{name}: {area:.3f}" for name, area in each.items())
        rows.append([f"`{choice.agent}`", f"{own[START]:.3f}", f"{own[choice.trial]:.3f}", texts])
    head = ["agent", "start", "chosen", "start with one option of the choice"]
    return markdown(head, rows) if rows else ""


def response(trials: Sequence[TrialResult], probe: int) -> str:
    """Standing of the trials with each value of an option, and their number.

    The standing of a trial is the share of the agent's other trials that it beats in mean area over
    the first cells, which all trials have; ties count half.
    """
    standings: dict[str, list[tuple[TrialResult, float]]] = {}
    for agent in _agents(trials):
        own = [t for t in trials if t.agent == agent and len(t.scores) >= probe]
        areas = np.array([mean_auc(t.scores[:probe]) for t in own])
        beaten = (areas[:, None] > areas).mean(1) + ((areas[:, None] == areas).mean(1)) / 2
        # Without the trial itself, which is a tie.
        others = (beaten * len(own) - 0.5) / max(1, len(own) - 1)
        standings[agent] = list(zip(own, 100 * others, strict=True))
    every = [pair for own in standings.values() for pair in own]
    rows = []
    for name in dict.fromkeys(name for trial, _ in every for name in trial.options):
        values = [trial.options[name] for trial, _ in every if name in trial.options]
        for label, low, high in _groups(values):
            row = [f"`{name}` {label}"]
            for pairs in (*standings.values(), every):
                inside = [
                    standing
                    for trial, standing in pairs
                    if name in trial.options and low <= trial.options[name] <= high
                ]
                row.append(f"{np.mean(inside):.0f} ({len(inside)})" if inside else "-")
            rows.append(row)
    return markdown(["option", *(f"`{agent}`" for agent in standings), "all"], rows)


def _groups(values: Sequence[Any]) -> list[tuple[str, Any, Any]]:
    """The values of an option, or thirds of them: text, first and last value."""
    distinct = sorted(set(values))
    if len(distinct) <= MANY:
        return [(_value(value), value, value) for value in distinct]
    thirds = np.array_split(np.sort(values), 3)
    return [(f"{_value(t[0])} to {_value(t[-1])}", t[0], t[-1]) for t in thirds]


def _agents(trials: Sequence[TrialResult]) -> list[str]:
    return list(dict.fromkeys(trial.agent for trial in trials))


def _value(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def main(arguments: Sequence[str]) -> int:
    """Write docs/tuning.md, with a plan's new trials if a path is given; returns the exit code."""
    try:
        check_checkout(PAGE)
        paths = {p.stem: p for p in TRIALS.glob("*.json") if not p.stem.endswith("-scores")}
        new = [Path(argument) for argument in arguments[:1]]
        paths |= {path.stem: path for path in new}
        plans = {name: _read(path) for name, path in sorted(paths.items())}
        page = generate(PAGE.read_text(), plans)
        copies = {TRIALS / path.name: path.read_bytes() for path in new}
        write_together({**copies, PAGE: page.encode()})
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(f"wrote the tables of {', '.join(plans)} to {PAGE}")
    return 0


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text("utf-8-sig"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as trials: {error}") from None


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
