"""Files that runs and audits wrote, which the site shows: films, paths of episodes, maps."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from symsteer.errors import UserError
from symsteer.leaderboard.paths import RECORD
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.text import slug
from symsteer.variant import file_name

DIGITS = 10
"""Hexadecimal digits at the end of a page's name: names that are cut or written alike differ."""

KINDS = {"film": (".mp4", 4, b"ftyp"), "paths": (".png", 0, b"\x89PNG\r\n\x1a\n")}
"""By how their names begin: how these end, and where such a file says what it is."""

RESULT, MAP = "audit.json", "map.png"
"""What `symsteer audit --out` writes for a cell."""


@dataclass(frozen=True)
class Medium:
    """A film or a picture, where the site has it, and what it shows.

    Attributes:
        variant: of a map, that of its cell.
    """

    path: Path
    address: str
    text: str
    variant: str = ""

    @property
    def is_film(self) -> bool:
        return self.path.suffix == ".mp4"


def films_of(run: Run) -> list[Medium]:
    """Films and paths in a run's folder, that `symsteer film` wrote."""
    return list(_films(run.path.parent)) if run.path.name == RECORD else []


def films_of_cell(table: Table) -> list[Medium]:
    """Those of a cell's runs side by side, beside the folders of the runs."""
    key = table.key
    # Names in records may be anything, so they are compared and not joined to a path.
    text = file_name(f"{key.task}-{key.embodiment}-{key.variant}")
    names = {f"{kind}-{text}" for kind in KINDS}
    folders = {run.path.parent.parent for run in table.runs if run.path.name == RECORD}
    return [film for at in sorted(folders) for film in _films(at) if film.path.stem in names]


def _films(folder: Path) -> Iterator[Medium]:
    """Those in a folder; not links, which may lead anywhere, nor what is only called so."""
    for kind, (suffix, start, mark) in KINDS.items():
        for path in sorted(folder.glob(f"{kind}-*{suffix}")):
            if path.is_symlink() or not path.is_file():
                continue
            with open(path, "rb") as file:
                if file.read(32)[start : start + len(mark)] == mark:
                    file.seek(0)
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                    yield Medium(path, f"media/{kind}-{digest[:DIGITS]}{suffix}", path.stem)


def maps_of(folder: Path) -> Iterator[Medium]:
    """The maps of an audit: where in the workspace copies of a decision differ.

    Raises:
        UserError: for a folder without maps, or a map without its result.
    """
    paths = [*sorted(folder.glob(f"*/{MAP}")), *folder.glob(MAP)]
    if not paths:
        raise UserError(f"{folder} holds no {MAP}: name the folder of `symsteer audit --out`")
    for path in paths:
        result = path.with_name(RESULT)
        try:
            settings = json.loads(result.read_text("utf-8-sig"))["settings"]
            words = [settings[key] for key in ("task", "embodiment", "variant")]
            address = f"media/{slug('map', *words, digits=DIGITS)}.png"
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise UserError(f"{result} is no result of an audit: measure it again") from error
        yield Medium(path, address, ", ".join(words), words[-1])
