"""From record files to the leaderboard's files: load, summarise, render, then write."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from leaderboard.errors import RecordError
from leaderboard.figures import render_figures, to_svg
from leaderboard.records import write_atomically
from leaderboard.summary import load_runs, summarize
from leaderboard.tables import relative_link, render_csv, render_page

DEFAULT_RECORDS = Path("leaderboard/results")
DEFAULT_OUT = Path("leaderboard")
FIGURE_NAME = re.compile(r"(success|q)-[a-z0-9-]+-[0-9a-f]{6}\.svg")


def generate(records: Sequence[Path] = (DEFAULT_RECORDS,), out: Path = DEFAULT_OUT) -> list[Path]:
    """Write LEADERBOARD.md, leaderboard.csv and figures/ into `out`; returns the files written.

    Everything is rendered before the first file is written, so bad records leave `out` as it was.
    Figures of an earlier call that no longer belong to a table are removed. Raises RecordError.
    """
    out = out.resolve()
    if out.exists() and not out.is_dir():
        raise RecordError(f"{out} is a file: name a folder for the leaderboard.")
    runs = load_runs(records)
    summary = summarize(runs)
    files: dict[Path, bytes] = {}
    shown: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for place, figures in render_figures(summary).items():
        for text, kind, figure in figures:
            name = f"figures/{kind}-{slug(*place)}.svg"
            files[out / name] = to_svg(figure)
            shown.setdefault(place, []).append((text, name))
    links = {run.path: relative_link(run.path, out) for run in runs}
    files[out / "leaderboard.csv"] = render_csv(summary).encode()
    files[out / "LEADERBOARD.md"] = render_page(summary, shown, links).encode()
    for path, data in files.items():
        write_atomically(path, data)
    for path in (out / "figures").glob("*.svg"):
        if path not in files and FIGURE_NAME.fullmatch(path.name):
            path.unlink()
    return list(files)


def slug(*texts: str) -> str:
    """A file name of lower-case letters, digits and dashes, told apart by a hash of the texts."""
    words = "-".join(re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") for text in texts)
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return f"{words[:60].strip('-') or 'run'}-{digest[:6]}"
