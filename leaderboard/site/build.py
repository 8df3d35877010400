"""From records to the folder of a site."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from symsteer.errors import UserError
from symsteer.files import staged, write_atomically, write_together
from symsteer.leaderboard.defects import read_audit
from symsteer.leaderboard.paths import reproductions_for
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.sections import Findings
from symsteer.leaderboard.site import markup
from symsteer.leaderboard.site.docs import FOLDER, Documentation, build_documentation
from symsteer.leaderboard.site.libraries import assets, needs
from symsteer.leaderboard.site.media import DIGITS, films_of, films_of_cell, maps_of
from symsteer.leaderboard.site.pages import pages
from symsteer.leaderboard.site.results import Results
from symsteer.leaderboard.site.run_page import run_pages
from symsteer.leaderboard.study import read_study

GENERATOR = '<meta name="generator" content="symsteer site'
"""What says of an index.html that it is ours."""

OWN = re.compile(rf"[a-z0-9-]+-[0-9a-f]{{{DIGITS}}}\.(html|png|mp4)")
"""Names of the files in these folders:"""

FOLDERS = ("agents", "cells", "media", "runs", "variants")

SUMMARY = "summary.json"
"""The numbers of an audit, in its folder."""


def generate(
    records: Sequence[Path],
    out: Path,
    study: str,
    audit: Path | None = None,
    docs: bool = True,
    reproductions: Path | None = None,
) -> Results:
    """Write the site; files of an earlier one that no longer belong to it are removed.

    Arguments are those of `symsteer site` (`symsteer.leaderboard.command`), which names the study.

    Returns:
        What the site shows.

    Raises:
        UserError: for bad records, a missing package, a folder that holds something else or
            cannot be written, or documentation with an error.
    """
    out = Path(os.path.realpath(out))
    documentation = Documentation.of_checkout(docs)
    needs("jinja2", "markdown_it", *(["mkdocs", "material"] if documentation.is_built else []))
    _check_folder(out)
    claims = read_study(study)
    marks = reproductions_for(records, reproductions)
    summary = summarize(load_runs(records, marks, claims.listed, claims.area_from))
    folder = audit if audit and audit.is_dir() else None
    # A folder without a summary has maps alone, and the committed numbers are used.
    file = folder / SUMMARY if folder else audit
    defects = read_audit(file if file and (file.is_file() or not folder) else None)
    maps = list(maps_of(folder)) if folder else []
    findings = Findings(summary, defects, claims)
    results = Results(findings, Path(study).stem, documentation, maps)
    files = {out / name: data for name, data in render(results).items()}
    media = [*maps, *(film for run in results.runs.values() for film in films_of(run))]
    media += [film for table in summary.tables for film in films_of_cell(table)]
    copies = {out / medium.address: medium.path for medium in media}
    write_together(files, _stale(out, {*files, *copies}), durable=False)
    for target, source in copies.items():
        write_atomically(target, source.read_bytes(), durable=False)
    if not documentation.is_built:
        # That of an earlier site, which no page links any more.
        shutil.rmtree(out / FOLDER, ignore_errors=True)
    else:
        with staged(out / FOLDER) as folder:
            build_documentation(folder)
            shutil.rmtree(out / FOLDER, ignore_errors=True)
    return results


def render(results: Results) -> dict[str, bytes]:
    """Every page and asset by its address; depends on the records, audit, study and docs alone."""
    files = assets()
    common = {
        "study": results.study,
        "docs": results.docs.is_built,
        "version": metadata.version("symsteer"),
        "address_of": results.run,
    }
    for address, template, values in (*pages(results), *run_pages(results)):
        values |= {"root": "../" * address.count("/"), "address": address, **common}
        page = markup.environment().get_template(template).render(values)
        files[address] = page.encode()
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


def _stale(out: Path, wanted: set[Path]) -> list[Path]:
    """Files of an earlier site in `out` that this one does not have."""
    files = (path for folder in FOLDERS for path in sorted((out / folder).glob("*")))
    return [path for path in files if OWN.fullmatch(path.name) and path not in wanted]
