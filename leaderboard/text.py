"""How the page writes texts, numbers, intervals, links and tables.

Text from a record is shown only inside code spans, without the characters that could end one
(`code`), so that no record can inject markup. It is never used as a path or a link.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from symsteer.leaderboard.statistics import Interval
from symsteer.tables import markdown

NOTHING = "\u2013"
MINUS = "\u2212"
SPACE = "\u00a0"
"""A space at which no line is broken."""
MARKS = {1: " \u25b2", 0: "", -1: " \u25bc"}


def code(text: str, limit: int = 300) -> str:
    """Text from a record as a code span on one line, safe inside a table."""
    allowed = "".join(c if c.isprintable() else " " for c in text)
    for bad, good in (("`", "'"), ("|", "¦"), ("\\", "/")):
        allowed = allowed.replace(bad, good)
    allowed = " ".join(allowed.split())
    if len(allowed) > limit:
        allowed = allowed[: limit - 1] + "…"
    return f"`{allowed}`" if allowed else NOTHING


def number(value: float | None, digits: int = 2, sign: bool = False) -> str:
    """A number for reading: fixed digits, a true minus sign, a dash where there is none."""
    if value is None:
        return NOTHING
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    if float(text) == 0:
        text = f"{0:.{digits}f}"
    return text.replace("-", MINUS)


def compact(value: float | None) -> str:
    """Two or three significant digits for quantities of any size, such as Q-values and errors."""
    if value is None:
        return NOTHING
    if value == 0:
        text = "0"
    elif 1e3 <= abs(value) < 1e5:
        text = f"{value:.0f}"
    elif 1e-3 <= abs(value) < 1e3:
        text = f"{value:.3g}"
    else:
        mantissa, exponent = f"{value:.1e}".split("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", MINUS)


def count(value: float | None) -> str:
    """A count in thousands or millions."""
    if value is None:
        return NOTHING
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}".replace(" ", SPACE)
    return f"{value:.0f}"


def interval(value: Interval | None, sign: bool = False, digits: int = 2) -> str:
    """`0.71 [0.66, 0.77]` on one line."""
    if value is None:
        return NOTHING
    middle, low, high = (number(v, digits, sign) for v in (value.value, value.low, value.high))
    return f"{middle} [{low}, {high}]".replace(" ", SPACE)


def difference(value: Interval | None) -> str:
    """`+0.12 [+0.05, +0.20] ▲`: the mark says that the interval excludes 0, and on which side."""
    return interval(value, sign=True) + mark_of(value).replace(" ", SPACE)


def mark_of(value: Interval | None) -> str:
    """▲ or ▼ where an interval lies on one side of 0."""
    return MARKS[value.sign] if value else ""


def stacked(value: Interval | None, sign: bool = False, marks: str = "", digits: int = 2) -> str:
    """An interval on two lines, for tables with many columns: value and marks above its ends."""
    if value is None:
        return NOTHING
    middle, ends = interval(value, sign, digits).split(SPACE, 1)
    return f"{middle}{marks}".replace(" ", SPACE) + f"<br>{ends}"


def share(part: int, whole: int) -> str:
    """As in 3/5; a dash of none."""
    return f"{part}/{whole}" if whole else NOTHING


def ends(values: Sequence[float] | None, write: Callable[[float], str] = number) -> str:
    """`0.25 to 0.79`, the smallest and the largest, or the one number that both are; a dash without
    any."""
    return (
        " to ".join(dict.fromkeys((write(min(values)), write(max(values))))) if values else NOTHING
    )


def relative_link(path: Path, folder: Path) -> str | None:
    """URL of `path` relative to `folder`; None where it would name folders of this machine."""
    relative = Path(os.path.relpath(path, folder))
    if relative.is_absolute() or relative.parts[:3] == ("..", "..", ".."):
        return None
    return quote(relative.as_posix())


def image(text: str, path: str) -> str:
    """A figure of the page; `text` and `path` are our own."""
    return f"![{text}]({quote(path)})"


def table_text(rows: Sequence[Mapping[str, str]], left: int = 1, sparse: bool = False) -> str:
    """A markdown table of rows, each with its texts by column; a dash where a row has none.

    The first `left` columns are left-aligned. A `sparse` table is without the columns in which no
    row has anything.
    """
    names = dict.fromkeys(name for row in rows for name in row)
    texts = {name: [row.get(name, NOTHING) for row in rows] for name in names}
    if sparse:
        texts = {name: column for name, column in texts.items() if set(column) != {NOTHING}}
    return markdown(list(texts), list(zip(*texts.values(), strict=True)), left)


def folded(title: str, blocks: Sequence[str]) -> list[str]:
    """Blocks of markdown that a reader opens; the title is our own."""
    return [f"<details>\n<summary>{title}</summary>", *blocks, "</details>"]


def slug(*texts: str, digits: int = 6) -> str:
    """A file name of lower-case letters, digits and dashes; it ends with a hash of the texts."""
    words = "-".join(re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") for text in texts)
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return f"{words[:60].strip('-') or 'run'}-{digest[:digits]}"
