"""What is printed: plain lines without control characters, to a place that may fail."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator
from typing import Any

from symsteer.errors import UserError

BOARD = "http://localhost:6006/#custom_scalars&_smoothingWeight=0"
"""Where `tensorboard` shows the charts of runs, without smoothing."""

LONGEST_LINE = 900
"""Characters of an error message; the middle of a longer one is left out."""

NARROWEST = 20
"""Columns; in a terminal of fewer the help would never end."""


class _Output(io.FileIO):
    """Standard output or error. After an error nothing is written: Python would try it at exit.

    A terminal that is gone ends no run, nor does stderr on a full disk.
    """

    failed = False

    def write(self, data: Any) -> int:
        try:
            return len(data) if self.failed else super().write(data)
        except OSError as error:
            self.failed = True
            if error.errno == errno.EIO or self.fileno() == 2:
                return len(data)
            if isinstance(error, BrokenPipeError):
                raise
            raise UserError(
                f"the output cannot be written: {error.strerror}; free space or write it elsewhere"
            ) from error


@contextlib.contextmanager
def careful_output() -> Iterator[None]:
    """Inside, output behaves as :class:`_Output`, and at the end it is written."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper) and stream is getattr(sys, f"__{name}__"):
            raw = _Output(stream.fileno(), "wb", closefd=False)
            buffer: Any = raw if stream.write_through else io.BufferedWriter(raw)
            # A path may hold what the encoding of the terminal does not have.
            how = (stream.encoding, "backslashreplace", None, stream.line_buffering)
            setattr(sys, name, io.TextIOWrapper(buffer, *how, stream.write_through))
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)
    try:
        yield
    finally:
        if sys.stdout is not None:
            sys.stdout.flush()


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


def folded(head: str, text: str) -> str:
    """An entry of a list, folded to the width of the terminal."""
    columns = max(60, shutil.get_terminal_size().columns)
    return textwrap.fill(text, columns, initial_indent=head, subsequent_indent=" " * len(head))


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


@contextlib.contextmanager
def progress_bar(
    title: str, total: int | None = None, quiet: bool = False, unit: str = "it"
) -> Iterator[Callable[..., None]]:
    """A progress bar on stderr; none where that is no terminal.

    Yields:
        ``advance(done, total=None, **shown)``: how much is done, of how much if that has become
        known, and what to show beside the bar.
    """
    from tqdm import tqdm

    with tqdm(total=total, desc=title, unit=unit, disable=True if quiet else None) as bar:

        def advance(done: int, total: int | None = None, **shown: str) -> None:
            bar.total = total or bar.total
            bar.update(done - bar.n)
            if shown:
                bar.set_postfix(shown)

        yield advance


def tell(line: str) -> None:
    """Print a line above the progress bar, if there is one."""
    from tqdm import tqdm

    tqdm.write(line)
