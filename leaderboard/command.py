"""The verbs that read records: `symsteer report` writes, verifies and checks the leaderboard,
`symsteer site` writes it as a site, `symsteer compare` compares two sets of runs."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, TextIO

import tyro

from symsteer.errors import UserError
from symsteer.leaderboard.paths import PAGE_FOLDER, RECORDS, STUDY, chosen_records

FEW = 10
"""`--check` lists up to this many records; of more, only those with problems or notes."""


def report(
    records: tyro.conf.Positional[tuple[Path, ...]] = (),
    out: Path | None = None,
    audit: Path | None = None,
    study: str | None = None,
    reproductions: Path | None = None,
    verify: bool = False,
    check: bool = False,
) -> int:
    """Write the leaderboard (markdown, CSV, figures) from run records.

    Args:
        records: Record files, run folders or folders of runs; default: the committed records.
        out: Where to write; default: RECORDS/leaderboard, in the first folder that is named; of
            the committed records: the committed leaderboard.
        audit: What `symsteer audit --out` wrote: its folder or summary.json; default: the committed
            audit.
        study: The claims to test: name of a study in leaderboard/studies or path of a .toml file;
            default: those of the paper, for the committed records those of their study.
        reproductions: The folder that `symsteer reproduce --into` wrote to: its runs are marked;
            default: for committed records the committed one.
        verify: Write nothing; fail if OUT is not, byte for byte, what the records give.
        check: Write nothing; say of each record whether the leaderboard admits it, and why not.

    Returns:
        0: done, or no difference and no problem; 1: --verify found a difference; 2: --check found
        a record that is not admissible.

    Raises:
        UserError: for paths that cannot be read or written, and for records that are not valid.
    """
    if verify and check:
        raise UserError("--verify and --check cannot be given together; give one of them")
    paths = chosen_records(records, "report")
    if check:
        return _show_admissions(paths)
    # Here, so that the help of all commands does not wait for matplotlib and scipy.
    from symsteer.leaderboard import report
    from symsteer.leaderboard.study import PAPER

    out = out or _folder_for(records)
    study = study or (PAPER if records else STUDY)
    if verify:
        folder, wanted, number = report.contents(paths, out, audit, study, reproductions)
        lines = report.differences(folder, wanted)
        if not lines:
            _say(f"{number} records and {len(wanted)} files of the leaderboard agree")
            return 0
        for line in lines:
            _say(line)
        for package in report.other_versions():
            _say(f"note: bytes are equal only with the pinned versions; here is {package}")
        _say(
            f"error: {len(lines)} file{'s'[: len(lines) != 1]} of the leaderboard did not come "
            f"from these {number} records; run `symsteer report` with the same arguments",
            sys.stderr,
        )
        return 1
    files = report.generate(paths, out, audit, study, reproductions)
    page = next(file for file in files if file.name == "LEADERBOARD.md")
    _say(f"wrote {page} and {len(files) - 1} files beside it")
    return 0


def site(
    records: tyro.conf.Positional[tuple[Path, ...]] = (),
    out: Path = Path("site"),
    study: str | None = None,
    audit: Path | None = None,
    reproductions: Path | None = None,
    docs: bool = True,
) -> int:
    """Write results and documentation as a folder of static pages (docs/site.md).

    Args:
        records: Record files, run folders or folders of runs; default: the committed records.
        out: Folder of the site: a new one, or that of an earlier site, which is replaced.
        study: The claims to test: name of a study in leaderboard/studies or path of a .toml file;
            default: those of the paper, for the committed records those of their study.
        audit: What `symsteer audit --out` wrote: its folder (then with its maps) or summary.json;
            default: the committed audit.
        reproductions: The folder that `symsteer reproduce --into` wrote to: its runs are marked;
            default: for committed records the committed one.
        docs: Build the documentation, too, in a checkout of the repository.

    Returns:
        0.

    Raises:
        UserError: for paths that cannot be read or written, records that are not valid, and
            packages that are not installed.
    """
    paths = chosen_records(records, "site")
    from symsteer.leaderboard.site.build import generate
    from symsteer.leaderboard.study import PAPER

    study = study or (PAPER if records else STUDY)
    results = generate(paths, out, study, audit, docs, reproductions)
    index = out.resolve() / "index.html"
    _say(f"wrote {index}: the pages of {len(results.runs)} records")
    if docs and not results.docs.is_built:
        _say("without the documentation, which only a checkout of the repository has")
    return 0


def compare(
    a: Annotated[str, tyro.conf.arg(metavar="A")],
    b: Annotated[str, tyro.conf.arg(metavar="B")],
    /,
    runs: Path = Path("runs"),
    margin: float = 0.0,
    json: bool = False,
    picture: Path | None = None,
) -> int:
    """Compare two sets of finished runs on the same base policies and episodes.

    Differences are B minus A. Exit code 1 if B is clearly worse: a test for changes of code.

    Args:
        a: A run folder, a folder of runs, an agent, or the beginning of a commit.
        b: The same; what is compared with A.
        runs: Folder with the records of agents and commits, at any depth.
        margin: How much success or area under the success curve B may lose.
        json: Print only JSON, with every pair of runs.
        picture: Draw the differences into this file, .png or .svg.

    Returns:
        0: B is not clearly worse, or there are too few runs to say so; 1: it is.

    Raises:
        UserError: for a wrong name, records that are not valid, runs without a partner, a wrong
            margin, or a picture that cannot be written.
    """
    if not (math.isfinite(margin) and margin >= 0):
        raise UserError(f"--margin is {margin}; it must be a number of at least 0, such as 0.05")
    if picture is not None and picture.suffix.lower() not in (".png", ".svg"):
        raise UserError(f"--picture is {picture}; its name must end with .png or .svg")
    from json import dumps

    from symsteer.leaderboard.compare.output import to_data, to_text
    from symsteer.leaderboard.compare.pairing import pair_runs
    from symsteer.leaderboard.compare.sides import read_sides

    first, second = read_sides(a, b, runs)
    changes = pair_runs(first, second, margin)
    if picture is not None:
        from symsteer.files import write_atomically
        from symsteer.leaderboard.compare import figure

        write_atomically(picture, figure.picture(first, second, changes, picture))
    if json:
        print(dumps(to_data(first, second, changes), allow_nan=False))
    else:
        print(to_text(first, second, changes))
        if picture is not None:
            _say(f"wrote {picture}")
    return 1 if changes.verdict == "worse" else 0


def _folder_for(records: Sequence[Path]) -> Path:
    """Where the leaderboard of records goes for which no folder was named."""
    if not records:
        return PAGE_FOLDER
    first = records[0]
    out = (first.parent if os.path.isfile(first) else first) / "leaderboard"
    if Path(os.path.realpath(out)) == PAGE_FOLDER:
        raise UserError(
            f"{out} holds the committed leaderboard; name another folder, or this one, with --out"
        )
    return out


def _show_admissions(paths: Sequence[Path]) -> int:
    from symsteer.leaderboard import admission

    admissions = admission.check(paths, RECORDS)
    for one in admissions:
        if one.is_admissible and not one.notes and len(admissions) > FEW:
            continue
        _say(f"{one.path}: {'admissible' if one.is_admissible else 'NOT ADMISSIBLE'}")
        for problem in one.problems:
            _say(f"  problem: {problem}")
        for note in one.notes:
            _say(f"  note: {note}")
    admitted = sum(one.is_admissible for one in admissions)
    _say(f"{admitted} of {len(admissions)} records are admissible")
    return 0 if admitted == len(admissions) else 2


def _say(text: str, stream: TextIO | None = None) -> None:
    """Print one line; control characters that a record or path brought into it become `?`."""
    line = "".join(c if c.isprintable() or "\udc80" <= c <= "\udcff" else "?" for c in text)
    print(line, file=stream or sys.stdout)
