"""The list of sections, and LEADERBOARD.md made of it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

from symsteer.leaderboard.plots import Figure
from symsteer.leaderboard.rows import MIN_SEEDS, Summary
from symsteer.leaderboard.sections import (
    Findings,
    Section,
    View,
    cells,
    claims,
    defect_map,
    how_to_read,
    in_which_world,
    main_effects,
    other_success,
    performance_profiles,
    probability_of_improvement,
    provenance,
    regret,
    soundness,
    spread_of_results,
    success_in_every_cell,
    unknown_task,
    verdicts,
    what_symmetry_gains,
    wins_and_losses,
)
from symsteer.leaderboard.study import Study
from symsteer.leaderboard.text import folded, slug

LARGEST = 60_000
"""Bytes of the largest page that stays one; of a larger one, sections have pages of their own."""

SECTIONS: tuple[Section[Any], ...] = (
    regret.SECTION,
    in_which_world.SECTION,
    verdicts.SECTION,
    what_symmetry_gains.SECTION,
    wins_and_losses.SECTION,
    verdicts.TESTS,
    how_to_read.SECTION,
    claims.SECTION,
    success_in_every_cell.SECTION,
    other_success.SECTION,
    unknown_task.SECTION,
    defect_map.SECTION,
    performance_profiles.SECTION,
    probability_of_improvement.SECTION,
    main_effects.SECTION,
    soundness.SECTION,
    spread_of_results.SECTION,
    cells.SECTION,
    provenance.SECTION,
)
"""In the order of the page: first what a reader sees, then what a reader opens."""


def render_pages(view: View) -> dict[str, str]:
    """LEADERBOARD.md and, if it would be too large, the pages beside it, by their files' names."""
    whole = render_page(view)
    if len(whole.encode()) <= LARGEST:
        return {"LEADERBOARD.md": whole}
    there = view.below()
    pages = {
        f"pages/{slug(*page.words)}.md": page
        for section in SECTIONS
        if section.apart
        for page in section.apart(view.findings.of(section), there)
    }
    links = [f"- [{page.title}]({name})" for name, page in pages.items()]
    first = f"Part of [the leaderboard](../LEADERBOARD.md), version `{view.summary.version}`."
    return {
        "LEADERBOARD.md": render_page(view, links),
        **{
            name: "\n\n".join([f"# {page.title}", first, *page.blocks]) + "\n"
            for name, page in pages.items()
        },
    }


def render_page(view: View, links: Sequence[str] = ()) -> str:
    """LEADERBOARD.md as markdown; with links to pages, their sections are left out."""
    parts = [
        "# Leaderboard",
        "This page is generated from run records by `symsteer report`; do not edit it. Version: "
        f"`{view.summary.version}`.",
        *notices(view.findings.study),
    ]
    if notice := seed_notice(view.summary):
        parts.append(notice)
    for title, blocks in by_title(view, [s for s in SECTIONS if s.where == "first"]):
        parts += [f"## {title}", *blocks]
    parts.append("## Details")
    if links:
        parts += ["Pages of their own:", "\n".join(links)]
    shown = [s for s in SECTIONS if s.where in ("folded", "page") and not (links and s.apart)]
    for title, blocks in by_title(view, shown):
        parts += folded(title, blocks) if title else blocks
    return "\n\n".join(parts) + "\n"


def by_title(view: View, sections: Iterable[Section[Any]]) -> Iterator[tuple[str, list[str]]]:
    """The blocks of neighbours with the same title; those without any are left out."""
    for title, members in groupby(sections, key=lambda section: section.title):
        if blocks := [block for section in members for block in view.blocks(section)]:
            yield title, blocks


def figures_of(findings: Findings, sections: Iterable[Section[Any]] = SECTIONS) -> list[Figure]:
    """The figures of sections, in their order; those without data are left out."""
    return [
        figure
        for section in sections
        for figure in section.figures(findings.of(section), findings.summary)
    ]


def other_files(view: View) -> Mapping[str, str]:
    """The other files of the leaderboard by name, those that have a content."""
    texts = {
        name: write(view.findings.of(section), view)
        for section in SECTIONS
        for name, write in section.files.items()
    }
    return {name: text for name, text in texts.items() if text}


def notices(study: Study) -> list[str]:
    """What a study says above all results, as blocks of markdown."""
    details = "\n\n".join(folded("In numbers, and within which limits", [study.details]))
    return [*([study.notice] if study.notice else []), *([details] if study.details else [])]


def seed_notice(summary: Summary) -> str:
    """A quotation in markdown that says who is not ranked; empty where all are."""
    rows = [row for table in summary.tables for row in table.trusted if row.runs]
    ranked = [row for row in rows if row.role == "learner"]
    few = [row for row in ranked if len(row.finished) < MIN_SEEDS]
    if not few:
        return ""
    none = len(few) == len(ranked)
    return (
        f"> **{'Not' if none else 'Not all'} ranked.** {'No' if none else 'Not every'} agent here "
        f"has the {MIN_SEEDS} finished seeds that a ranking needs. Agents with fewer are shown in "
        "a fixed order. Read the intervals: differences between agents are hints, not results."
    )
