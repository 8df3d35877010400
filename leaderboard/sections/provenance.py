"""Where the runs were made, which were set aside, and records.csv with a line for each."""

from __future__ import annotations

from collections.abc import Iterable

from symsteer.files import csv_text
from symsteer.leaderboard.defects import fingerprint
from symsteer.leaderboard.records import Provenance
from symsteer.leaderboard.rows import Summary
from symsteer.leaderboard.run_table import run_line
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import Findings, Links, Section, View
from symsteer.leaderboard.text import NOTHING, code, number


def render(findings: Findings, view: View) -> list[str]:
    """How to make the page again, where the runs were made, and which were set aside."""
    summary = findings.summary
    parts = [
        "Regenerate with `symsteer report`, or `symsteer report RECORDS --out FOLDER`: the same "
        "records and audit give the same bytes. Each record holds the whole configuration and "
        "every evaluation episode with its seed.",
        f"To cite these results, name their version, `{summary.version}`: the day of the newest "
        "run and the beginning of a hash of all records. In the repository, "
        f"`git log -S {summary.version} --format=%h --reverse` names the commit that has it first.",
        facts(summary, fingerprint(findings.audit)),
        "[records.csv](records.csv) names all records, with seed, status, commit and hash.",
    ]
    if summary.set_aside:
        aside = ", ".join(_link(run, view.links) for run in summary.set_aside)
        parts.append(
            "Set aside, because a finished or newer record of the same configuration, seed and "
            f"base policy exists: {aside}."
        )
    return parts


def facts(summary: Summary, audit: str) -> str:
    """Where the runs were made, as a list in markdown."""
    runs = summary.runs
    records = [run.record for run in runs]
    places = [place for run in runs for place in run.provenances]
    started = min(record.started for record in records)
    ended = max(record.ended or record.started for record in records)
    hours = sum(record.wall_clock.total for record in records) / 3600
    resumed = sum(record.wall_clock.resumed > 0 for record in records)
    packages = (f"{name} {version}" for p in places for name, version in p.packages.items())
    processors = _listed(p.processor for p in places if p.processor)
    lines = [
        f"Runs: {len(records)}, {number(hours, 1)} hours in all, {started:%Y-%m-%d} to "
        f"{ended:%Y-%m-%d} (UTC)"
        + (f"; {resumed} of them continued after an interruption" if resumed else ""),
        f"Commits: {_listed(_commit(place) for place in places)}",
        f"Devices: {_listed(p.device for p in places)}; platforms: "
        f"{_listed(p.platform for p in places)}; Python: {_listed(p.python for p in places)}; "
        f"torch threads: {_listed(str(p.torch_threads) for p in places)}",
        *([f"Processors: {processors}"] if processors != NOTHING else []),
        f"Packages: {_listed(packages)}",
        f"Audit of the defects: {code(audit)}",
    ]
    return "\n".join(f"- {line}" for line in lines)


def _commit(place: Provenance) -> str:
    if place.commit is None:
        return f"version {place.version}" if place.version else "outside git"
    return place.commit[:12] + (" with local changes" if place.dirty else "")


def _listed(texts: Iterable[str]) -> str:
    return ", ".join(code(text) for text in sorted(set(texts))) or NOTHING


def _link(run: Run, links: Links) -> str:
    # run_id is validated to letters, digits and ._+=:,@- so that it is safe as a link's text.
    target = links.get(run.path)
    name = code(run.record.run_id)
    return f"[{name}]({target})" if target else name


def render_records(summary: Summary, links: Links) -> str:
    """The records of all tables; `record` is the file's place relative to the page."""
    lines = [
        run_line(run)
        | {
            "row": row.label,
            "reproduced": run.reproduction and run.reproduction.verdict,
            "record": links.get(run.path),
        }
        for table in summary.tables
        for row in table.rows
        for run in row.runs
    ]
    return csv_text([lines[0], *(line.values() for line in lines)])


SECTION = Section(
    "Provenance",
    lambda findings: findings,
    render,
    files={"records.csv": lambda findings, view: render_records(findings.summary, view.links)},
)
