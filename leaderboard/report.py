"""From record files to the leaderboard's files: load, summarise, render, then write."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from leaderboard.defects import Audit, read_audit
from leaderboard.errors import RecordError
from leaderboard.figures import render_figures, to_svg
from leaderboard.findings import analyse
from leaderboard.page import render_page
from leaderboard.summary import Run, load_runs, summarize
from leaderboard.tables import render_csv
from leaderboard.text import relative_link

DEFAULT_RECORDS = Path("leaderboard/results")
DEFAULT_OUT = Path("leaderboard")
FIGURE_NAME = re.compile(r"(map|profiles|improvement|(success|q)-[a-z0-9-]+-[0-9a-f]{6})\.svg")


def generate(
    records: Sequence[Path] = (DEFAULT_RECORDS,),
    out: Path = DEFAULT_OUT,
    audit: Path | None = None,
) -> list[Path]:
    """Write LEADERBOARD.md, leaderboard.csv and figures/ into `out`; returns the files written.

    `audit` is the summary of an audit, the committed one by default (`read_audit`).

    Everything is rendered, then everything is written under temporary names, before the first file
    is replaced: bad records, a full disk or a read-only folder leave `out` as it was. Figures of an
    earlier call that no longer belong to a table are removed. Raises RecordError.
    """
    out = _folder(out)
    files = render(load_runs(records), out, read_audit(audit))
    _write_together({out / name: data for name, data in files.items()})
    for name in _stale(out, files):
        (out / name).unlink()
    return [out / name for name in files]


def render(runs: Sequence[Run], out: Path, audit: Audit) -> dict[str, bytes]:
    """Every file of the leaderboard, by its path relative to `out` (with `/`); nothing is written.

    Depends on the records, the audit, and where the records lie relative to `out`, nothing else.
    """
    summary = summarize(runs)
    findings = analyse(summary, audit)
    files: dict[str, bytes] = {}
    shown: dict[tuple[str, ...], dict[str, tuple[str, str]]] = {}
    for drawing in render_figures(summary, findings):
        stem = "-".join([drawing.kind, *([slug(*drawing.place)] if drawing.place else [])])
        name = f"figures/{stem}.svg"
        files[name] = to_svg(drawing.figure)
        shown.setdefault(drawing.place, {})[drawing.kind] = (drawing.text, name)
    links = {run.path: relative_link(run.path, out.resolve()) for run in runs}
    files["leaderboard.csv"] = render_csv(summary).encode()
    files["LEADERBOARD.md"] = render_page(summary, findings, shown, links).encode()
    return files


def slug(*texts: str) -> str:
    """A file name of lower-case letters, digits and dashes, told apart by a hash of the texts."""
    words = "-".join(re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") for text in texts)
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return f"{words[:60].strip('-') or 'run'}-{digest[:6]}"


def _folder(out: Path) -> Path:
    out = out.resolve()
    if out.exists() and not out.is_dir():
        raise RecordError(f"{out} is a file: name a folder for the leaderboard.")
    return out


def _stale(out: Path, files: Mapping[str, bytes]) -> list[str]:
    """Figures in `out` that carry a name of ours but belong to no table of `files`."""
    names = (f"figures/{path.name}" for path in (out / "figures").glob("*.svg"))
    return sorted(n for n in names if n not in files and FIGURE_NAME.fullmatch(Path(n).name))


def _write_together(files: Mapping[Path, bytes]) -> None:
    """Write all files or, as far as a file system can promise it, none.

    Raises:
        RecordError: when a folder cannot be written or the disk is full; nothing has changed then
            (only a failing rename, after all data have reached the disk, can leave a mixture).
    """
    staged: list[tuple[Path, Path]] = []
    path = Path()
    try:
        for path, data in files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
            staged.append((temporary, path))
            with open(temporary, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        for temporary, path in staged:
            os.replace(temporary, path)
    except OSError as error:
        for temporary, _ in staged:
            with contextlib.suppress(OSError):
                temporary.unlink()
        raise RecordError(
            f"{path} cannot be written: {error.strerror}; free space or choose another folder."
        ) from error
