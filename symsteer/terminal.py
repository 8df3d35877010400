"""Printing plain lines without control characters."""

from __future__ import annotations

import shlex
import sys
from typing import Any

BOARD = "http://localhost:6006/#custom_scalars&_smoothingWeight=0"
"""Where `tensorboard` shows the charts of runs, without smoothing."""

LONGEST_LINE = 900
"""Characters of an error message; the middle of a longer one is left out."""


def printable(text: str) -> str:
    """The text with control characters replaced by ``?``, except line breaks.

    Files and arguments can bring such characters into a message.
    """
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


def option_words(name: str, value: Any) -> list[str]:
    """An option as the words that one types: flags have no value, lists have several.

    Args:
        name: as in a configuration, e.g. ``policy.batch_size``.
    """
    *tables, last = name.replace("_", "-").split(".")
    if isinstance(value, bool):
        return ["--" + ".".join([*tables, last if value else f"no-{last}"])]
    values = value if isinstance(value, list) else [value]
    return ["--" + ".".join([*tables, last]), *map(str, values)]


def to_paste(*words: object) -> str:
    """Words as a command that can be pasted into a shell."""
    return shlex.join(map(str, words))


def complain(error: BaseException, text: str, code: int) -> int:
    """Print one line on stderr, then the notes of the error, each on its own line.

    Returns:
        ``code``, the exit code.
    """
    line = printable(" ".join(text.split()))
    if len(line) > LONGEST_LINE:
        half = LONGEST_LINE // 2
        line = f"{line[:half]} ... {line[-half:]}"
    print(line, *getattr(error, "__notes__", ()), sep="\n", file=sys.stderr)
    return code
