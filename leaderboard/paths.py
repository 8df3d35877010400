"""Where the committed leaderboard is, and which record files the paths of a command line mean."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from symsteer.errors import UserError
from symsteer.leaderboard.records import REPEATED

PAGE_FOLDER = Path(__file__).resolve().parent
"""The folder of the committed leaderboard, in a checkout of the repository."""

RESULTS = PAGE_FOLDER / "results"

RECORDS = RESULTS / "records"
"""The committed records; an installed package has none."""

REPRODUCTIONS = RESULTS / "reproductions"
"""What `symsteer reproduce --into` wrote about committed records."""

STUDY = "answer"
"""The study that the committed records belong to."""

RECORD = "record.json"
"""The record's name in a run folder; committed records are called by their run_id."""

_BEGINNING = re.compile(rb'\s*\{\s*"schema_version"\s*:\s*\d+\s*,\s*"run_id"')


def chosen_records(records: Sequence[Path], verb: str, argument: str = "RUNS") -> Sequence[Path]:
    """The records that a verb was given, in ``argument``; else the committed ones.

    Raises:
        UserError: none were given, and there are no committed ones.
    """
    if not records and not RECORDS.is_dir():
        raise UserError(
            "the committed records exist only in a checkout of the repository; name run folders: "
            f"symsteer {verb} {argument}"
        )
    return records or (RECORDS,)


def reproductions_for(records: Iterable[Path], folder: Path | None) -> Path | None:
    """The folder with the reproductions of records; None for none.

    Args:
        records: paths of the records.
        folder: the one that was named; else the committed one counts, for committed records.

    Raises:
        UserError: if the folder that was named is none.
    """
    if folder is None:
        committed = all(Path(os.path.realpath(p)).is_relative_to(RESULTS) for p in records)
        return REPRODUCTIONS if committed else None
    if not folder.is_dir():
        raise UserError(
            f"{folder} is no folder: name the one that `symsteer reproduce --into` wrote to"
        )
    return folder


def record_files(paths: Iterable[Path], mixed: bool = False) -> list[Path]:
    """The files that `paths` name (files, run folders, folders of either), resolved, each once.

    In a folder every `record.json` at any depth counts, and beside these every `*.json` that begins
    like a record; run folders hold other JSON as well. A folder without any `record.json` must hold
    nothing but records as `*.json`. Links to files are followed, links to folders are not.

    Args:
        paths: of files and folders.
        mixed: in any folder, other `*.json` are left out.

    Raises:
        UserError: for a path that does not exist or is neither a file nor a folder, a folder
            that cannot be listed, a name that is not UTF-8, or when there is no file at all.
    """
    paths = list(paths)
    files: dict[Path, None] = {}
    for path in paths:
        for file in _in_folder(path, mixed) if stat.S_ISDIR(_mode(path)) else [path]:
            if not stat.S_ISREG(_mode(file)):
                raise UserError(f"{file} is no ordinary file: name a record or a folder")
            resolved = file.resolve()
            try:
                os.fspath(resolved).encode()
            except UnicodeEncodeError as error:
                name = ascii(os.fspath(resolved))
                raise UserError(f"{name} has a name that is not UTF-8: rename it") from error
            files[resolved] = None
    if not files:
        names = ", ".join(str(path) for path in paths)
        raise UserError(f"{names} holds no record: run `symsteer run` first or name its folder")
    return list(files)


def _mode(path: Path) -> int:
    try:
        return path.stat().st_mode
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist: name a record or a folder with records") from error
    except OSError as error:
        _refuse(error)


def _refuse(error: OSError) -> NoReturn:
    raise UserError(
        f"{error.filename} cannot be read: {error.strerror}; make it readable or leave it out"
    ) from error


def _in_folder(folder: Path, mixed: bool) -> list[Path]:
    files = sorted(
        Path(parent, name)
        for parent, _, names in os.walk(folder, onerror=_refuse)
        for name in names
        if name.endswith(".json") and not name.endswith(REPEATED)
    )
    named = [file for file in files if file.name == RECORD]
    if not named and not mixed:
        return files
    # A run folder laid among committed records must not hide them.
    return named + [file for file in files if file.name != RECORD and _begins_like_a_record(file)]


def _begins_like_a_record(file: Path) -> bool:
    try:
        if not file.is_file():
            return False
        with open(file, "rb") as opened:
            return _BEGINNING.match(opened.read(128)) is not None
    except OSError as error:
        _refuse(error)
