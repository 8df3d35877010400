"""From records to the folder of a site."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from symsteer.errors import UserError
from symsteer.files import staged, write_atomically, write_together
from symsteer.leaderboard.defects import read_audit
from symsteer.leaderboard.findings import analyse
from symsteer.leaderboard.paths import reproductions_for
from symsteer.leaderboard.site import markup
from symsteer.leaderboard.site.assets import assets, needs
from symsteer.leaderboard.site.board import DIGITS, Board, MapPicture
from symsteer.leaderboard.site.clips import media, shared_media
from symsteer.leaderboard.site.docs import FOLDER, Documentation, build_documentation
from symsteer.leaderboard.site.pages import pages
from symsteer.leaderboard.site.run_page import run_values
from symsteer.leaderboard.study import read_study
from symsteer.leaderboard.summary import load_runs, summarize

GENERATOR = '<meta name="generator" content="symsteer site'
"""What says of an index.html that it is ours."""

OWN = re.compile(rf"[a-z0-9-]+-[0-9a-f]{{{DIGITS}}}\.(html|png|mp4)")
"""Names of the files in these folders:"""

FOLDERS = ("agents", "cells", "media", "runs", "variants")

SUMMARY, RESULT, MAP = "summary.json", "audit.json", "map.png"
"""Files of an audit's folder."""


@dataclass(frozen=True)
class Written:
    """What a call wrote.

    Attributes:
        pages: number of pages of results.
        records: number of records.
        docs: whether the documentation is part of the site.
    """

    index: Path
    pages: int
    records: int
    docs: bool


def generate(
    records: Sequence[Path],
    out: Path,
    study: str,
    audit: Path | None = None,
    docs: bool = True,
    reproductions: Path | None = None,
) -> Written:
    """Write the site; files of an earlier one that no longer belong to it are removed.

    Args:
        records: record files, run folders, or folders of these.
        out: a new folder, an empty one, or that of an earlier site.
        study: name or file of the study that declares the claims (`read_study`).
        audit: summary or folder of an audit; the committed one by default.
        docs: whether to build the documentation, if there is one.
        reproductions: folder of the reproductions (`reproductions_for`).

    Raises:
        UserError: for bad records, a missing package, a folder that holds something else or
            cannot be written, or documentation with an error.
    """
    out = Path(os.path.realpath(out))
    reading = Documentation.of_checkout(docs)
    needs("jinja2", "markdown_it", *(["mkdocs", "material"] if reading.built else []))
    _check_folder(out)
    claims = read_study(study)
    marks = reproductions_for(records, reproductions)
    summary = summarize(load_runs(records, marks, claims.listed))
    defects = read_audit(_summary_of(audit))
    found = analyse(summary, defects, claims)
    board = Board(summary, found, defects, Path(study).stem, reading, tuple(_maps(audit)))
    files = {out / name: data for name, data in render(board).items()}
    clips = [clip for run in board.runs for clip in media(run)]
    clips += [clip for table in summary.tables for clip in shared_media(table)]
    copies = {out / address: path for address, _, _, path in clips}
    copies |= {out / picture.address: picture.path for picture in board.maps}
    write_together(files, _stale(out, {*files, *copies}), durable=False)
    for target, source in copies.items():
        write_atomically(target, source.read_bytes(), durable=False)
    if reading.built:
        with staged(out / FOLDER) as folder:
            build_documentation(folder)
            shutil.rmtree(out / FOLDER, ignore_errors=True)
    else:
        # That of an earlier site, which no page links any more.
        shutil.rmtree(out / FOLDER, ignore_errors=True)
    number = sum(path.suffix == ".html" for path in files)
    return Written(out / "index.html", number, len(board.runs), reading.built)


def render(board: Board) -> dict[str, bytes]:
    """Every page and asset by its address; depends on the records, audit, study and docs alone."""
    files = assets()
    templates = markup.environment()

    def add(address: str, template: str, values: dict[str, object]) -> None:
        depth = address.count("/")
        common = {
            "root": "../" * depth,
            "address": address,
            "study": board.study,
            "docs": board.docs.built,
            "version": metadata.version("symsteer"),
        }
        files[address] = templates.get_template(template).render(values | common).encode()

    for address, template, values in pages(board):
        add(address, template, values)
    for run in board.runs:
        add(board.run(run), "run.html", run_values(board, run))
    return files


def _check_folder(out: Path) -> None:
    """Refuse folders with other contents: a site replaces what is in its folder."""
    try:
        if not out.exists() or (out.is_dir() and all(p.is_dir() for p in out.rglob("*"))):
            return
        index = out / "index.html"
        if out.is_dir() and index.is_file() and GENERATOR in index.read_text(errors="replace"):
            return
    except OSError as error:
        raise UserError(f"{out} cannot be read: {error.strerror}; name another folder") from error
    raise UserError(f"{out} holds something else than a site: name a new folder with --out")


def _summary_of(audit: Path | None) -> Path | None:
    """The summary of an audit; None for the committed one, which folders without one use."""
    if audit is None or not audit.is_dir():
        return audit
    return audit / SUMMARY if (audit / SUMMARY).is_file() else None


def _maps(audit: Path | None) -> Iterator[MapPicture]:
    """The maps in an audit's folder, each beside what it shows."""
    if audit is None or not audit.is_dir():
        return
    found = [path.parent for path in sorted(audit.glob(f"*/{MAP}")) + sorted(audit.glob(MAP))]
    if not found:
        raise UserError(f"{audit} holds no {MAP}: name the folder of `symsteer audit --out`")
    for folder in found:
        path = folder / RESULT
        try:
            settings = json.loads(path.read_text("utf-8-sig"))["settings"]
            words = [settings[key] for key in ("task", "embodiment", "variant")]
            if not all(isinstance(word, str) for word in words):
                raise ValueError("names must be texts")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise UserError(f"{path} is no result of an audit: measure it again") from error
        task, embodiment, variant = words
        yield MapPicture(task, embodiment, variant, folder / MAP)


def _stale(out: Path, wanted: set[Path]) -> list[Path]:
    """Files of an earlier site in `out` that this one does not have."""
    found = (path for folder in FOLDERS for path in sorted((out / folder).glob("*")))
    return [path for path in found if OWN.fullmatch(path.name) and path not in wanted]
