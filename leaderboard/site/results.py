"""What the pages show, and where each thing has its page."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.defects import Audit, AuditedDefect, parts_of
from symsteer.leaderboard.keys import ARM, SYMMETRIC_EMBODIMENT, Key
from symsteer.leaderboard.rows import AgentRow, Summary, Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import Findings
from symsteer.leaderboard.site.docs import Documentation
from symsteer.leaderboard.site.media import DIGITS, Medium
from symsteer.leaderboard.text import slug
from symsteer.variant import UNBROKEN


def dials(variant: str) -> list[str]:
    """The names of what a variant is made of; a text that is no variant stands for itself."""
    parts = parts_of(variant)
    return [variant] if parts is None else [part.name for part in parts]


def strengths(variant: str) -> list[str]:
    """The strengths of a variant's parts, as they are written."""
    return [part.text.removeprefix(f"{part.name}:") for part in parts_of(variant) or ()]


def breaks(key: Key) -> list[str]:
    """What breaks the symmetry of a cell, without strengths; `unbroken` if nothing does."""
    arm = [] if key.embodiment == SYMMETRIC_EMBODIMENT else [ARM]
    return arm + dials(key.variant) or ["unbroken"]


@dataclass(frozen=True)
class Results:
    """All results of a site. Addresses of pages are relative to its folder.

    Attributes:
        study: name of the study or of its file.
        maps: pictures of an audit's folder.
    """

    findings: Findings
    study: str
    docs: Documentation
    maps: Sequence[Medium] = ()

    @property
    def summary(self) -> Summary:
        return self.findings.summary

    @property
    def audit(self) -> Audit:
        return self.findings.audit

    @cached_property
    def names(self) -> dict[Key, str]:
        """Cells as text: task, embodiment, what breaks the symmetry, and what tells them apart."""
        return {t.key: cell_name(t, self.summary).replace("`", "") for t in self.summary.tables}

    @cached_property
    def runs(self) -> dict[Path, Run]:
        """Runs that count, then those that are set aside, by the path of their record."""
        return {run.path: run for run in (*self.summary.runs, *self.summary.set_aside)}

    @cached_property
    def rows(self) -> list[tuple[Table, AgentRow]]:
        """All rows with runs."""
        return [(table, row) for table in self.summary.tables for row in table.rows if row.runs]

    @cached_property
    def row_of(self) -> Mapping[Path, tuple[Table, AgentRow]]:
        """Table and row of every run that counts, by the path of its record."""
        return {run.path: (table, row) for table, row in self.rows for run in row.runs}

    @cached_property
    def dials(self) -> list[str]:
        """Variants of the audit and of the runs, by name."""
        used = {name for table in self.summary.tables for name in dials(table.key.variant)}
        audited = {name for _, _, variant, _ in self.audit for name in dials(variant)}
        return sorted(used | audited)

    def cell(self, key: Key) -> str:
        """Address of a cell's page."""
        words = (key.task, key.embodiment, key.variant, key.base, key.group, key.mode)
        numbers = (str(key.demonstrations), str(key.env_steps))
        grid = (key.settings,) if key.settings else ()
        return f"cells/{slug(*words, *numbers, *grid, digits=DIGITS)}.html"

    def agent(self, name: str) -> str:
        """Address of an agent's page."""
        return f"agents/{slug(name, digits=DIGITS)}.html"

    def variant(self, name: str) -> str:
        """Address of a variant's page."""
        return f"variants/{slug(name, digits=DIGITS)}.html"

    def run(self, run: Run) -> str:
        """Address of a run on the page of its cell; records with the same bytes share one."""
        return f"{self._page_of_run[run.path]}#{self.run_names[run.path]}"

    @cached_property
    def run_pages(self) -> dict[str, list[Run]]:
        """Runs by the address of their page: one a cell, and one of all that are set aside."""
        pages: dict[str, list[Run]] = {}
        for table, row in self.rows:
            pages.setdefault(self.cell(table.key).replace("cells", "runs", 1), []).extend(row.runs)
        aside = f"runs/{slug('set aside', digits=DIGITS)}.html"
        return pages | ({aside: list(self.summary.set_aside)} if self.summary.set_aside else {})

    @cached_property
    def _page_of_run(self) -> dict[Path, str]:
        return {run.path: page for page, runs in self.run_pages.items() for run in runs}

    @cached_property
    def run_names(self) -> dict[Path, str]:
        """What names a run within its page, by the path of its record."""
        names = {}
        for path, run in self.runs.items():
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            names[path] = slug(run.record.run_id, digits=DIGITS)[:-DIGITS] + digest[:DIGITS]
        return names

    def runs_of(self, table: Table) -> list[tuple[str, list[Run]]]:
        """The runs of a cell by the label of their row."""
        return [(row.label, row.runs) for row in table.rows if row.runs]

    def audited(self, dial: str) -> list[tuple[str, str, str, float, AuditedDefect]]:
        """Task, embodiment, group, strength and defect where a variant acts alone, in this order.

        With the unbroken controls, at strength 0; empty if the variant was not audited.
        """
        alone: list[tuple[str, str, str, float, AuditedDefect]] = []
        for (task, embodiment, variant, group), defect in self.audit.items():
            parts = parts_of(variant) or ()
            if [part.name for part in parts] == [dial] and parts[0].is_constant:
                strength = parts[0].strength
                assert not isinstance(strength, tuple)
                alone.append((task, embodiment, group, strength, defect))
        for task, embodiment, group in {cell[:3] for cell in alone}:
            if control := self.audit.get((task, embodiment, UNBROKEN, group)):
                alone.append((task, embodiment, group, 0.0, control))
        return sorted(alone, key=lambda cell: cell[:4])
