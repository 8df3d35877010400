"""LEADERBOARD.md: how to read it, the overview, claims, map and comparisons, tables, provenance."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

from symsteer.leaderboard.answer_page import answer_section
from symsteer.leaderboard.claims_page import CLAIMS, claims_section
from symsteer.leaderboard.comparisons import AGAINST, MANY_PAIRS, Comparisons
from symsteer.leaderboard.factors import MEASURES as EFFECT_MEASURES
from symsteer.leaderboard.factors import MainEffect, main_effects
from symsteer.leaderboard.figures import MANY
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.map_page import Figures, map_section
from symsteer.leaderboard.records import MAX_GROWTH, MAX_OVERSHOOT, Provenance
from symsteer.leaderboard.soundness import MAX_BIAS, MAX_FALL, MIN_CORRELATION, soundness
from symsteer.leaderboard.statistics import Spread
from symsteer.leaderboard.study import Study
from symsteer.leaderboard.summary import MIN_SEEDS, THRESHOLD, Row, Run, Summary, Table
from symsteer.leaderboard.tables import Links, cell_name, heading, section, status
from symsteer.leaderboard.text import (
    MARKS,
    NOTHING,
    SPACE,
    code,
    compact,
    folded,
    image,
    interval,
    number,
    stacked,
    without_empty,
)
from symsteer.tables import markdown

READING = f"""\
Each agent steers a frozen diffusion policy by choosing the noise that it starts from. References
are what learners are compared with, and are never ranked: `base` draws the noise at random, `zero`
sets it to 0, `golden-ticket` is the best constant noise that a search found. Learning is worth its
steps where a learner beats the best reference. All agents of a table share the task, the
demonstrations, the budget and the held-out episodes.

- **Success** is `success_once` in the final window: all held-out evaluations in the last fifth of
  the budget, their episodes pooled (a reference is evaluated once). Shown are the interquartile
  mean (IQM) over base policies and its 95 % interval. The interval draws base policies, each with
  all its runs, or the runs of a cell with one base policy; and it draws episodes, each for all runs
  at once, because all are scored on the same initial states. Of fewer than 4 the IQM is the plain
  mean. **Last** is the same for the final evaluation alone. No number is the best of
  several evaluations. Below each table is the change of success *from the fourth to the last fifth
  of the budget*: an agent with ▲ there was still improving, and more steps may change its place.
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
- **Q diverged** (†) counts the seeds whose largest |Q| exceeded the largest feasible
  one after learning had begun, whose Q-values grew out of the feasible interval (|Q| {MAX_GROWTH:g}
  times as large at the end as in the middle, and {MAX_OVERSHOOT:g} of the interval outside), or
  were not finite.
- In **learning curves**, thick lines are the IQM (success) or the mean (Q), bands the 95 % interval
  of the IQM, thin lines single runs, dotted lines with a cross unfinished runs. References are
  horizontal lines that start where their search ended. The green area shows the returns that the
  reward allows; a cross there ends a run whose Q was not finite. With {MANY} learners or more,
  bands of learners and single runs are left out.
- Statistics use finished runs. Failed, interrupted, running and missing ones are counted under
  **Status**. The seeds below the number of seeds and episodes are links to the records.
"""

MADE_AGAIN = """\
Some runs were made again from their records (`symsteer reproduce`); **Status** counts them.
*Reproduced exactly*: every episode and every measured number agrees. *Reproduced alike*: the 95 %
interval of the difference in final success includes 0.
"""
"""Shown only where it is so."""

SUBMITTED = """\
Rows that are marked *not reproduced* hold submitted runs that no maintainer has made again. They
have no rank, come last in their tables, and nothing is concluded from them.
"""
"""Shown only where it is so."""

EFFECTS = f"""\
Some agents were run in a balanced grid of options. Shown are the means with both values of an
option, over all settings of the others, on the same base policies, and the main effect, the second
mean minus the first: of final success, of the largest |Q| as a multiple of the largest feasible
one, and of the share of diverged runs. Marks need {MIN_SEEDS} base policies.
"""

SOUND = f"""\
A comparison of agents needs learners that work: success must not collapse on the way, and Q must
agree with the returns of the same decisions. *Fall* is how far success falls below the better of
the untrained agent and the base policy, at most, on the same episodes; *correlation* and *bias* are
those of Q and the return at the end, over all decisions. Medians over runs; sound means a fall of
at most {MAX_FALL:g}, a correlation of at least {MIN_CORRELATION:g}, and a bias of at most
{100 * MAX_BIAS:g} % of the feasible interval.
"""

PROFILES = (
    "Performance profiles: the share of runs that close at least the given share of the gap "
    "between the frozen base (0, on the same episodes) and certain success (1), in the final "
    "window. Higher is better; left of 0 steering does harm. Bands are 95 %."
)
IMPROVEMENT = (
    "Probability of improvement: how likely a run of X beats a run of Y on the same base policy of "
    "the same cell (ties count half), mean over cells, with 95 % intervals. Of more than "
    f"{MANY_PAIRS} pairs, only those with {' or '.join(map(code, AGAINST))} are shown."
)


def render_page(summary: Summary, findings: Findings, figures: Figures, links: Links) -> str:
    """The whole page as markdown."""
    overall = figures.get((), {})
    parts = [
        "# Leaderboard",
        "This page is generated from run records by `symsteer report`; do not edit it.",
    ]
    parts += notices(findings.study)
    if notice := seed_notice(summary):
        parts.append(notice)
    parts += answer_section(summary, findings, overall)
    parts += ["## Details", *folded("How to read it", reading(summary))]
    parts += folded("Claims, effects and p-values", [CLAIMS.strip(), *claims_section(findings)])
    parts += folded("Success in every cell", [_overview(summary)])
    against = map_section(summary, findings, figures)
    parts += folded("The advantage of symmetry against the defect", against)
    if findings.comparisons.cells:
        parts += folded("All cells together", comparisons_section(findings.comparisons, overall))
    if effects := effects_section(summary):
        parts += folded("Effects of options", effects)
    if sound := soundness_table(summary):
        parts += folded("Are the learners sound", [SOUND.strip(), sound])
    if findings.spreads:
        parts += folded("How much is the base policy's", spreads_section(summary, findings.spreads))
    places: dict[tuple[str, str], list[Table]] = {}
    for table in summary.tables:
        places.setdefault((table.key.task, table.key.embodiment), []).append(table)
    for place, tables in places.items():
        drawn = [image(*figure) for figure in figures.get(place, {}).values()]
        keys = [table.key for table in tables]
        blocks = [
            block
            for table in tables
            for block in (f"### {heading(table.key, keys)}", *section(table, links))
        ]
        simple = all(re.fullmatch(r"[A-Za-z0-9][\w.-]{,60}", word, re.ASCII) for word in place)
        # A name that a record may have, and no task, is shown as code below the title.
        title = ", ".join(place) if simple else "Other cells"
        names = [] if simple else [f"### {', '.join(map(code, place))}"]
        parts += folded(title, [*names, *drawn, *blocks])
    parts += folded("Provenance", _provenance(summary, findings.audit, links))
    return "\n\n".join(parts) + "\n"


def reading(summary: Summary) -> list[str]:
    """How to read the page, as blocks of markdown."""
    texts = READING, MADE_AGAIN * summary.has_reproductions, SUBMITTED * summary.has_marks
    return [text.strip() for text in texts if text]


def notices(study: Study) -> list[str]:
    """What a study says above all results, as blocks of markdown."""
    details = "\n\n".join(folded("In numbers, and within which limits", [study.details]))
    return [*([study.notice] if study.notice else []), *([details] if study.details else [])]


def effects_section(summary: Summary) -> list[str]:
    """Main effects of options in balanced grids, as blocks of markdown; empty without a grid."""
    found = main_effects(summary)
    return [EFFECTS.strip(), _effects_table(found)] if found else []


def _effects_table(found: Sequence[MainEffect]) -> str:
    rows: dict[tuple[str, ...], dict[str, str]] = {}
    for one in found:
        change = f"{code(one.option)} {code(one.levels[0])} to {code(one.levels[1])}"
        own = rows.setdefault((code(one.agent), change), {})
        mark = MARKS[one.effect.sign] if one.policies >= MIN_SEEDS else ""
        difference = stacked(one.effect, sign=True, marks=mark)
        means = f"{number(one.means[0])} to {number(one.means[1])}".replace(" ", SPACE)
        own[one.measure] = f"{means}<br>{difference}"
        own["counts"] = f"{one.runs}, {one.policies}"
    names = [*EFFECT_MEASURES, "counts"]
    header = ["Agent", "Change", "Success", "Largest \\|Q\\|", "Diverged", "Runs, policies"]
    body = [[*place, *(own.get(name, NOTHING) for name in names)] for place, own in rows.items()]
    return markdown(header, body, left=2)


def seed_notice(summary: Summary) -> str:
    """A quotation in markdown that says who is not ranked; empty where all are."""
    rows = [row for table in summary.tables for row in table.trusted if row.runs]
    ranked = [row for row in rows if row.role == "learner"]
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
        shown = (at_a_glance(table, agent) for agent in summary.agents)
        cells = ("<br>".join(map(_glance, own)) or NOTHING for own in shown)
        rows.append([cell_name(table, summary), *cells])
    return markdown(header, rows, left=1)


def at_a_glance(table: Table, agent: str) -> list[Row]:
    """The rows that stand for an agent in a table: those with its usual settings, or all.

    Marked ones only where there is no other.
    """
    rows = [row for row in table.rows if row.agent == agent]
    rows = [row for row in rows if not row.marked and row.runs] or rows
    return [row for row in rows if row.usual] or rows


def _glance(row: Row) -> str:
    if row.success is None:
        return status(row) if row.runs else NOTHING
    return f"{number(row.success.value)}{marks(row)}".replace(" ", SPACE)


def marks(row: Row) -> str:
    """Beside its success: a clear difference from the base, no reproduction, diverged Q."""
    mark = MARKS[row.difference.sign] if row.difference else ""
    return mark + " not reproduced" * row.marked + " \u2020" * any(row.diverged)


def spreads_section(summary: Summary, found: Mapping[str, Spread]) -> list[str]:
    """How results vary between base policies, runs and episodes, as blocks of markdown."""
    parts = [
        "Standard deviations of a run's success in the final window, pooled over cells, due to "
        "base policy, run, and the sample of episodes."
    ]
    alone = sum(len({run.policy for run in table.runs}) == 1 for table in summary.tables)
    if alone:
        which = "Each cell steers" if alone == len(summary.tables) else f"{alone} cells steer"
        parts[0] += (
            f" {which} one base policy: intervals are about this policy alone, and how much others "
            "differ is unknown."
        )
    if any(spread.together is not None for spread in found.values()):
        parts[0] += " Where each policy has one run, only the sum of both is known."
    columns = {
        "Base policies": [number(spread.policies, 3) for spread in found.values()],
        "Runs on one": [number(spread.runs, 3) for spread in found.values()],
        "Both together": [number(spread.together, 3) for spread in found.values()],
        "Episodes": [number(spread.episodes, 3) for spread in found.values()],
        "Base policies' share of the variance": [_share(spread) for spread in found.values()],
    }
    header, body = without_empty(columns)
    rows = [[code(agent), *texts] for agent, texts in zip(found, body, strict=True)]
    return [*parts, markdown(["Agent", *header], rows, left=1)]


def _share(spread: Spread) -> str:
    if spread.policies is None or spread.runs is None:
        return NOTHING
    total = spread.policies**2 + spread.runs**2 + spread.episodes**2
    return f"{100 * spread.policies**2 / total:.0f}{SPACE}%" if total else NOTHING


def soundness_table(summary: Summary) -> str:
    """Whether each learner is sound in each cell, as a table in markdown."""
    rows = []
    for table in summary.tables:
        for row in table.learners:
            found = soundness(row, table)
            if found.fall is None:
                continue
            verdict = ", ".join(found.faults) or ("sound" if found.is_complete else NOTHING)
            rows.append(
                [
                    cell_name(table, summary),
                    code(row.label),
                    str(len(row.finished)),
                    f"{number(found.fall)} (worst {number(found.worst_fall)})",
                    number(found.correlation),
                    compact(found.bias),
                    verdict,
                ]
            )
    header = ["Task", "Agent", "Runs", "Fall", "Correlation", "Bias (reward)", "Verdict"]
    return markdown(header, rows, left=2) if rows else ""


def comparisons_section(found: Comparisons, figures: Mapping[str, tuple[str, str]]) -> list[str]:
    """Profiles and probabilities of improvement, as blocks of markdown."""
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
        parts.append(markdown(header, rows, left=1))
    return parts


def provenance_facts(summary: Summary, audit: str) -> str:
    """Where the runs were made, as a list in markdown."""
    runs = summary.runs
    records = [run.record for run in runs]
    places = [place for run in runs for place in run.provenances]
    started = min(record.started for record in records)
    ended = max(record.ended or record.started for record in records)
    hours = sum(record.wall_clock.total for record in records) / 3600
    resumed = sum(record.wall_clock.resumed > 0 for record in records)
    packages = (f"{name} {version}" for p in places for name, version in p.packages.items())
    processors = _values(p.processor for p in places if p.processor)
    facts = [
        f"Runs: {len(records)}, {number(hours, 1)} hours in all, {started:%Y-%m-%d} to "
        f"{ended:%Y-%m-%d} (UTC)"
        + (f"; {resumed} of them continued after an interruption" if resumed else ""),
        f"Commits: {_values(_commit(place) for place in places)}",
        f"Devices: {_values(p.device for p in places)}; platforms: "
        f"{_values(p.platform for p in places)}; Python: {_values(p.python for p in places)}; "
        f"torch threads: {_values(str(p.torch_threads) for p in places)}",
        *([f"Processors: {processors}"] if processors != NOTHING else []),
        f"Packages: {_values(packages)}",
        f"Audit of the defects: {code(audit)}",
    ]
    return "\n".join(f"- {fact}" for fact in facts)


def _provenance(summary: Summary, audit: str, links: Links) -> list[str]:
    parts = [
        "Regenerate with `symsteer report`, or `symsteer report RECORDS --out FOLDER`: the same "
        "records and audit give the same bytes. Each record holds the whole configuration and "
        "every evaluation episode with its seed.",
        provenance_facts(summary, audit),
        "[records.csv](records.csv) names all records, with seed, status, commit and hash.",
    ]
    if summary.set_aside:
        aside = ", ".join(_link(run, links) for run in summary.set_aside)
        parts.append(
            "Set aside, because a finished or newer record of the same configuration, seed and "
            f"base policy exists: {aside}."
        )
    return parts


def _commit(place: Provenance) -> str:
    if place.commit is None:
        return f"version {place.version}" if place.version else "outside git"
    return place.commit[:12] + (" with local changes" if place.dirty else "")


def _values(texts: Iterable[str]) -> str:
    return ", ".join(code(text) for text in sorted(set(texts))) or NOTHING


def _link(run: Run, links: Links) -> str:
    # run_id is validated to letters, digits and ._+=:,@- so that it is safe as a link's text.
    target = links.get(run.path)
    name = code(run.record.run_id)
    return f"[{name}]({target})" if target else name
