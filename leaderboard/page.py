"""LEADERBOARD.md: how to read it, the overview, claims, map and comparisons, tables, provenance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from symsteer.leaderboard.claims import NEARLY_SYMMETRIC, STRONGLY_BROKEN, Claim
from symsteer.leaderboard.comparisons import Comparisons
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.map_page import Figures, map_section
from symsteer.leaderboard.records import DIVERGED_EVALUATIONS, DIVERGED_SHARE, Provenance
from symsteer.leaderboard.summary import MIN_SEEDS, THRESHOLD, Row, Run, Summary
from symsteer.leaderboard.tables import Links, cell_name, section, status
from symsteer.leaderboard.text import (
    MARKS,
    NOTHING,
    code,
    grid,
    image,
    interval,
    number,
    stacked,
)

READING = f"""\
Each agent steers a frozen diffusion policy by choosing the noise that it starts from. References
are what learners are compared with, and are never ranked: `base` draws the noise at random, `zero`
sets it to 0, `golden-ticket` is the best constant noise that a search found. Learning is worth its
steps where a learner beats the best reference. All agents of a table share the task, the
demonstrations, the budget and the held-out episodes.

- **Success** is `success_once` in the final window: all held-out evaluations in the last fifth of
  the budget, their episodes pooled (a reference is evaluated once). Shown are the interquartile
  mean (IQM) over seeds and its 95 % interval, from a bootstrap over seeds and over episodes: all
  runs are scored on the same initial states, so an episode is drawn for all of them at once. With
  fewer than 4 seeds the IQM is the plain mean; with one seed the interval covers its episodes
  only. No interval covers the training of other base policies. **Last checkpoint** is the same for
  the final evaluation alone. No number is the best of several evaluations. Below each table is the
  change of success *from the fourth to the last fifth of the budget*: an agent with ▲ there was
  still improving, and more steps may change its place.
- **Against base** is the mean difference (not the IQM's) to the base policy on the same episodes
  and seeds, with its 95 % interval. ▲ or ▼ marks an interval that excludes 0; without a mark the
  data do not decide.
- **Rank** is 1 + the number of learners that are clearly better, by the same paired differences;
  "=" marks a tie. It needs {MIN_SEEDS} finished seeds in common; agents with fewer,
  references and controls have no rank.
- **AUC** is the area under the success curve as a share of the budget's maximum: how good the
  agent was on average while it learned. **Steps** is the median number of environment steps after
  which success stays at or above {100 * THRESHOLD:.0f} % of the best learner's, and how many seeds
  reached that; `>` means that the median seed did not reach it within the budget. **Dip** is the
  lowest value below the base policy at any evaluation of any seed.
- **Q diverged** († at a glance) counts the seeds whose Q-values left the range of returns that the
  reward allows (more than {100 * DIVERGED_SHARE:.0f} % of the states at {DIVERGED_EVALUATIONS}
  evaluations in a row, once learning has begun) or were not finite.
- Statistics use finished runs. Failed, interrupted, running and missing ones are counted under
  **Status**. The seeds below the number of seeds and episodes are links to the records.
"""

CURVES = (
    "Thick lines are the IQM (success) or the mean (Q) over seeds, bands the 95 % interval of the "
    "IQM, thin lines single seeds, dotted lines with a cross unfinished runs. References are "
    "horizontal lines that start where their search ended. The green area shows the returns that "
    "the reward allows; a cross there ends a run whose Q was not finite."
)

CLAIMS = f"""\
The paper is arXiv 2512.11345. A claim is *supported* where the 95 % interval of the effect lies on
the side of 0 that the claim predicts, *contradicted* where it lies on the other side, and
otherwise *undecided*. Differences are paired by seed (success and its area by episode, too) and
averaged over cells; shares of diverged runs are pooled over cells, with Newcombe's interval. Only
cells with {MIN_SEEDS} paired seeds count, and at least one is needed. There is no correction for
the number of tests: where there is no effect, up to one interval in twenty still excludes 0.
*Defect* is the audited defect (next section): cells up to {NEARLY_SYMMETRIC:g} count as symmetric,
from {STRONGLY_BROKEN:g} on as strongly broken.
"""

PROFILES = (
    "Performance profiles: the share of runs that close at least the given share of the gap "
    "between the frozen base (0, on the same episodes) and certain success (1), in the final "
    "window. Higher is better; left of 0 steering does harm. Bands are 95 %, from drawing runs "
    "within each cell."
)
IMPROVEMENT = (
    "Probability of improvement: how likely a run of X beats a run of Y in the same cell (ties "
    "count half), mean over cells, with 95 % intervals from drawing runs within each cell; runs on "
    "base policies that only one of the two steered are left out. "
    "Where every run of one beats every run of the other, the interval has no width, which is too "
    "narrow for few runs."
)


def render_page(summary: Summary, findings: Findings, figures: Figures, links: Links) -> str:
    """The whole page as markdown."""
    overall = figures.get((), {})
    parts = [
        "# Leaderboard",
        "This page is generated from run records by `symsteer report`; do not edit it.",
        "## How to read it",
        READING.strip(),
    ]
    if notice := _seed_notice(summary):
        parts.append(notice)
    parts += ["## At a glance", _overview(summary)]
    if beaten := _beaten(summary):
        parts.append(beaten)
    parts += ["## The paper's claims", CLAIMS.strip(), _claims(findings.claims)]
    heading = "## The advantage of symmetry against the defect"
    parts += [heading, *map_section(summary, findings.map, figures)]
    if findings.comparisons.cells:
        parts += ["## All cells together", *_comparisons(findings.comparisons, overall)]
    place = None
    for table in summary.tables:
        key = table.key
        if (key.task, key.embodiment) != place:
            place = key.task, key.embodiment
            parts.append(f"## {code(key.task)}, {code(key.embodiment)}")
            if drawn := figures.get(place):
                parts += [image(*figure) for figure in drawn.values()]
                parts.append(CURVES)
        parts += section(table, links)
    parts += ["## Provenance", *_provenance(summary, findings.audit, links)]
    return "\n\n".join(parts) + "\n"


def _seed_notice(summary: Summary) -> str:
    ranked = [row for table in summary.tables for row in table.rows if row.role == "learner"]
    few = [row for row in ranked if len(row.finished) < MIN_SEEDS]
    if not few:
        return ""
    which = "No agent here has" if len(few) == len(ranked) else "Not every agent here has"
    return (
        f"> **Not ranked.** {which} the {MIN_SEEDS} finished seeds that a ranking needs. Agents "
        "with fewer are shown in a fixed order. Read the intervals: differences between agents are "
        "hints, not results."
    )


def _overview(summary: Summary) -> str:
    header = ["Task", *(code(agent) for agent in summary.agents)]
    rows = []
    for table in summary.tables:
        cells = []
        for agent in summary.agents:
            rows_of = [row for row in table.rows if row.agent == agent]
            cells.append("<br>".join(_glance(row) for row in rows_of) or NOTHING)
        rows.append([cell_name(table, summary), *cells])
    return grid(header, rows, left=1)


def _glance(row: Row) -> str:
    if row.success is None:
        return status(row)
    mark = MARKS[row.difference.sign] if row.difference else ""
    dagger = " \u2020" if any(row.diverged) else ""
    return stacked(row.success, marks=f"{mark}{dagger}")


def _beaten(summary: Summary) -> str:
    """In how many cells with enough pairs each learner clearly beats the best reference."""
    texts = []
    for agent in summary.agents:
        rows = [t.row_of(agent) for t in summary.tables if t.best_reference]
        enough = [row for row in rows if row and row.pairs_with_best >= MIN_SEEDS]
        signs = [row.against_best.sign for row in enough if row.against_best]
        if signs:
            above, below = signs.count(1), signs.count(-1)
            text = f"{code(agent)} clearly above in {above}, clearly below in {below}"
            texts.append(f"{text} of {len(signs)}")
    if not texts:
        return ""
    return f"Against the best reference of each cell, the frozen policy alone: {'; '.join(texts)}."


def _claims(found: Sequence[Claim]) -> str:
    rows = []
    for claim in found:
        effect = interval(claim.effect, sign=True, digits=3)
        if claim.beside:
            effect += f"<br>{claim.beside}"
        verdict = f"**{claim.verdict}**"
        if claim.reason:
            verdict += f": {claim.reason}"
        elif claim.verdict == "undecided":
            verdict += ": the interval contains 0"
        seeds = f"{claim.cells}, {claim.seeds}" if claim.cells else NOTHING
        rows.append([claim.name, claim.test, effect, seeds, verdict])
    header = ["Claim", "Test", "Effect, 95 % interval", "Cells, paired seeds", "Verdict"]
    return grid(header, rows, left=5)


def _comparisons(found: Comparisons, figures: Mapping[str, tuple[str, str]]) -> list[str]:
    parts = []
    if "profiles" in figures:
        parts += [image(*figures["profiles"]), PROFILES]
    if "improvement" in figures:
        parts += [image(*figures["improvement"]), IMPROVEMENT]
    groups = [group for group, pairs in found.improvements.items() if pairs]
    pairs: dict[tuple[str, str], dict[str, str]] = {}
    for group in groups:
        for pair in found.improvements[group]:
            text = f"{interval(pair.probability)} ({pair.cells}; {pair.runs[0]}, {pair.runs[1]})"
            pairs.setdefault((pair.first, pair.second), {})[group] = text
    if pairs:
        rows = [
            [f"{code(first)} > {code(second)}", *(texts.get(group, NOTHING) for group in groups)]
            for (first, second), texts in pairs.items()
        ]
        header = ["P(X > Y)", *(f"{group} (cells; runs of X, of Y)" for group in groups)]
        parts.append(grid(header, rows, left=1))
    return parts


def _provenance(summary: Summary, audit: str, links: Links) -> list[str]:
    runs = summary.runs
    records = [run.record for run in runs]
    places = [place for run in runs for place in run.provenances]
    started = min(record.started for record in records)
    ended = max(record.ended or record.started for record in records)
    hours = sum(record.wall_clock.total for record in records) / 3600
    resumed = sum(record.wall_clock.resumed > 0 for record in records)
    packages = (f"{name} {version}" for p in places for name, version in p.packages.items())
    facts = [
        f"Runs: {len(records)}, {number(hours, 1)} hours in all, {started:%Y-%m-%d} to "
        f"{ended:%Y-%m-%d} (UTC)"
        + (f"; {resumed} of them continued after an interruption" if resumed else ""),
        f"Commits: {_values(_commit(place) for place in places)}",
        f"Devices: {_values(p.device for p in places)}; platforms: "
        f"{_values(p.platform for p in places)}; Python: {_values(p.python for p in places)}; "
        f"torch threads: {_values(str(p.torch_threads) for p in places)}",
        f"Packages: {_values(packages)}",
        f"Audit of the defects: {code(audit)}",
    ]
    parts = [
        "Regenerate with `symsteer report`, or `symsteer report RECORDS --out FOLDER`: the same "
        "records and audit give the same bytes. Each record holds the whole configuration and "
        "every evaluation episode with its seed.",
        "\n".join(f"- {fact}" for fact in facts),
    ]
    rows = [
        [
            cell_name(table, summary),
            code(row.label),
            str(run.seed),
            run.record.status,
            _values(_commit(place, short=True) for place in run.provenances),
            code(run.record.config_hash[:12]),
            _link(run, links),
        ]
        for table in summary.tables
        for row in table.rows
        for run in row.runs
    ]
    header = ["Task", "Agent", "Seed", "Status", "Commit", "Config", "Record"]
    every = grid(header, rows, left=2)
    parts.append(f"<details>\n<summary>All records</summary>\n\n{every}\n\n</details>")
    if summary.set_aside:
        aside = ", ".join(_link(run, links) for run in summary.set_aside)
        parts.append(
            "Set aside, because a finished or newer record of the same configuration and seed "
            f"exists: {aside}."
        )
    return parts


def _commit(place: Provenance, short: bool = False) -> str:
    if place.commit is None:
        return f"version {place.version}" if place.version else "outside git"
    dirty = "+" if short else " with local changes"
    return place.commit[:12] + (dirty if place.dirty else "")


def _values(texts: Iterable[str]) -> str:
    return ", ".join(code(text) for text in sorted(set(texts))) or NOTHING


def _link(run: Run, links: Links) -> str:
    # run_id is validated to letters, digits and ._+=:,@- so that it is safe as a link's text.
    target = links.get(run.path)
    name = code(run.record.run_id)
    return f"[{name}]({target})" if target else name
