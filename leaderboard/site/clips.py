"""Films, and pictures of paths, that `symsteer film` wrote beside records."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from symsteer.leaderboard.paths import RECORD
from symsteer.leaderboard.site.board import DIGITS
from symsteer.leaderboard.summary import Run, Table
from symsteer.variant import file_name

Clip = tuple[str, str, str, Path]
"""Address, type, name and path."""

KINDS = {"film-{}.mp4": "video/mp4", "paths-{}.png": "image/png"}
"""Names of the files, and their types."""

BEGINNINGS = {"video/mp4": (4, b"ftyp"), "image/png": (0, b"\x89PNG\r\n\x1a\n")}
"""Where such a file says what it is. Others are not copied into the site."""


def media(run: Run) -> Iterator[Clip]:
    """Those in a run's folder."""
    if run.path.name == RECORD:
        for name, kind in KINDS.items():
            yield from _clips(sorted(run.path.parent.glob(name.format("*"))), kind)


def shared_media(table: Table) -> Iterator[Clip]:
    """Those of a cell's runs side by side, beside the folders of the runs."""
    key = table.key
    text = file_name(f"{key.task}-{key.embodiment}-{key.variant}")
    folders = sorted({run.path.parent.parent for run in table.runs if run.path.name == RECORD})
    # Names in records may be anything, so they are compared and not joined to a path.
    files = [path for folder in folders for path in sorted(folder.iterdir())]
    for name, kind in KINDS.items():
        yield from _clips([path for path in files if path.name == name.format(text)], kind)


def _clips(paths: Iterable[Path], kind: str) -> Iterator[Clip]:
    start, mark = BEGINNINGS[kind]
    for path in paths:
        if path.is_symlink() or not path.is_file():
            continue
        with open(path, "rb") as file:
            if file.read(32)[start : start + len(mark)] != mark:
                continue
            file.seek(0)
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        stem, suffix = path.name.split("-")[0], path.suffix
        yield f"media/{stem}-{digest[:DIGITS]}{suffix}", kind, path.stem, path
