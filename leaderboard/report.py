"""From record files to the leaderboard's files: load, summarise, render, then write or compare."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping, Sequence
from importlib import metadata
from itertools import takewhile
from pathlib import Path

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.leaderboard.defects import Audit, read_audit
from symsteer.leaderboard.page import figures_of, other_files, render_pages
from symsteer.leaderboard.paths import reproductions_for
from symsteer.leaderboard.plots import Figure
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.sections import Findings, View
from symsteer.leaderboard.sections.verdicts import PAPER_TITLE
from symsteer.leaderboard.study import PAPER, Study, read_study
from symsteer.leaderboard.svg import to_image
from symsteer.leaderboard.text import relative_link, slug

DRAWN_WITH = ("matplotlib", "numpy", "scipy")
"""Packages whose version may change a file's bytes."""

REQUIREMENTS = Path(__file__).resolve().parents[1] / "requirements.txt"

FIGURE_NAME = re.compile(
    r"(map|answer|profiles|improvement|regret|(map|success|q)-[a-z0-9-]+-[0-9a-f]{6})\.svg"
)
PAGE_NAME = re.compile(r"[a-z0-9-]+-[0-9a-f]{6}\.md")


def generate(
    records: Sequence[Path],
    out: Path,
    audit: Path | None = None,
    study: str = PAPER,
    reproductions: Path | None = None,
) -> list[Path]:
    """Write LEADERBOARD.md, PAPER.md, leaderboard.csv, records.csv, figures/ and pages/ into `out`.

    Figures and pages of an earlier call that no longer belong to a table are removed; so is
    PAPER.md if the study names no statements of the paper.

    Args:
        records: record files, run folders, or folders of these.
        out: the folder to write into.
        audit: summary of an audit, the committed one by default (`read_audit`).
        study: name or file of the study that declares the claims (`read_study`).
        reproductions: folder of the reproductions (`reproductions_for`).

    Returns:
        The files written.

    Raises:
        UserError: for bad records, a full disk or a folder that cannot be written; `out` is then
            as it was (`write_together`).
    """
    out, files, _ = contents(records, out, audit, study, reproductions)
    for name in ("figures", "pages"):
        if (out / name).is_symlink():
            raise UserError(f"{out / name} is a link: make it a folder, or remove it")
    stale = [out / name for name in _stale(out, files)]
    write_together({out / name: data for name, data in files.items()}, stale)
    return [out / name for name in files]


def differences(out: Path, files: Mapping[str, bytes]) -> list[str]:
    """A line for every file of the leaderboard in the folder `out` that is not as in `files`."""
    lines = []
    for name, wanted in sorted(files.items()):
        try:
            with open(out / name, "rb") as file:
                # One byte more than wanted tells a longer file, however large it is.
                written = file.read(len(wanted) + 1)
        except FileNotFoundError:
            lines.append(f"{out / name}: missing")
        except OSError as error:
            lines.append(f"{out / name}: cannot be read ({error.strerror})")
        else:
            if written != wanted:
                pairs = zip(written, wanted, strict=False)
                same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
                line = wanted[:same].count(b"\n") + 1
                lines.append(f"{out / name}: differs from line {line} on")
    return lines + [f"{out / name}: no record gives this file" for name in _stale(out, files)]


def other_versions() -> list[str]:
    """Packages that are not of the pinned version, as "name version, pinned: version"."""
    try:
        pins = dict(re.findall(r"^([a-z0-9.-]+)==(\S+)$", REQUIREMENTS.read_text(), re.M))
    except OSError:  # an installed package has no list of pinned versions
        return []
    return [
        f"{name} {version}, pinned: {pins[name]}"
        for name in DRAWN_WITH
        if name in pins and (version := metadata.version(name)) != pins[name]
    ]


def contents(
    records: Sequence[Path],
    out: Path,
    audit: Path | None = None,
    study: str = PAPER,
    reproductions: Path | None = None,
) -> tuple[Path, dict[str, bytes], int]:
    """What `generate` writes, with the same arguments and errors: nothing is written.

    Returns:
        The folder, the files by their path in it, and the number of records.
    """
    claims = read_study(study)
    marks = reproductions_for(records, reproductions)
    runs = load_runs(records, marks, claims.listed, claims.area_from)
    out = _folder(out)
    return out, render(runs, out, read_audit(audit), claims), len(runs)


def render(runs: Sequence[Run], out: Path, audit: Audit, study: Study) -> dict[str, bytes]:
    """Every file of the leaderboard, by its path relative to `out` (with `/`); nothing is written.

    Depends on the records, the audit, the study, and where the records lie relative to `out`,
    nothing else.
    """
    findings = Findings(summarize(runs), audit, study)
    figures = [(figure, f"figures/{_stem(figure)}.svg") for figure in figures_of(findings)]
    links = {run.path: relative_link(run.path, out.resolve()) for run in runs}
    view = View(findings, links, figures)
    texts = {**render_pages(view), **other_files(view)}
    files = {name: to_image(figure) for figure, name in figures}
    return files | {name: text.encode() for name, text in texts.items()}


def _stem(figure: Figure) -> str:
    return "-".join([figure.kind, *([slug(*figure.place)] if figure.place else [])])


def _folder(out: Path) -> Path:
    out = Path(os.path.realpath(out))
    try:
        if stat.S_ISDIR(out.stat().st_mode):
            return out
    except FileNotFoundError:
        return out
    except OSError as error:
        raise UserError(f"{out} cannot be used: {error.strerror}; name another folder") from error
    raise UserError(f"{out} is a file: name a folder for the leaderboard")


def _stale(out: Path, files: Mapping[str, bytes]) -> list[str]:
    """Files in `out` that carry a name of ours and are not of `files`."""
    names = [path.name for path in (out / "figures").glob("*.svg")]
    ours = [f"figures/{name}" for name in names if FIGURE_NAME.fullmatch(name)]
    names = [path.name for path in (out / "pages").glob("*.md")]
    ours += [f"pages/{name}" for name in names if PAGE_NAME.fullmatch(name)]
    paper = out / "PAPER.md"
    if paper.is_file() and paper.read_bytes().startswith(PAPER_TITLE.encode()):
        ours.append(paper.name)
    return sorted(name for name in ours if name not in files)
