"""Run the command line in this process, and check how it ended.

Bad input must end with one sentence and exit code 2. ``Reached`` is raised instead of the work that
follows after all input has been read. It shows that the input was accepted, and no run starts.
"""

from __future__ import annotations

import contextlib
import io
import re
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

from symsteer import cli

CURE = re.compile(
    r"\b(must|should|needs?|wanted|valid|did you mean|use|choose|name|give|free|restore|delete|"
    r"remove|train|copy|collect|download|record|run|raise|lower|ask|write|put|wait|convert|start|correct|shorten|undo|mend|change)\b",
    re.IGNORECASE,
)
"""A sentence must contain one of these to say how to correct the input."""

LONGEST = 950


class Reached(BaseException):
    """All input was read and accepted; ``found`` are the arguments of the work."""

    def __init__(self, found: Any = None):
        super().__init__()
        self.found = found


@dataclass
class Ending:
    """How a command line ended.

    Attributes:
        kind: "refused" (one sentence), "usage" (the parser's own message), "accepted", "done".
        sentence: on stderr, if refused.
        notes: the lines on stderr that follow it.
        found: what ``Reached`` brought, or the output.
    """

    kind: str
    sentence: str = ""
    notes: list[str] = field(default_factory=list)
    found: Any = None


class BadEndingError(AssertionError):
    """A traceback, or a message that is not one clear sentence."""


@contextlib.contextmanager
def stopped_at(*places: tuple[Any, str]) -> Iterator[None]:
    """Raise ``Reached`` with the arguments where one of the places would be called."""

    def stop(*args: Any, **kwargs: Any) -> None:
        raise Reached(args)

    with contextlib.ExitStack() as stack:
        for owner, name in places:
            stack.enter_context(patch.object(owner, name, stop))
        yield


def end_of(arguments: Sequence[Any], mentions: Sequence[str] = (), notes: bool = False) -> Ending:
    """Run ``symsteer ARGUMENTS`` in this process.

    Args:
        arguments: of the command line.
        mentions: one of these has to occur in the sentence (the names of the files at fault).
        notes: whether lines may follow the sentence.

    Raises:
        BadEndingError: if it ended in anything else than the endings of :class:`Ending`.
    """
    out, err = io.StringIO(), io.StringIO()
    command = ["symsteer", *map(str, arguments)]
    with (
        patch.object(sys, "argv", command),
        warnings.catch_warnings(record=True) as told,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        warnings.simplefilter("default")
        for kind in (DeprecationWarning, PendingDeprecationWarning, ResourceWarning):
            warnings.simplefilter("ignore", kind)
        try:
            code = cli.main()
        except Reached as reached:
            return Ending("accepted", found=reached.found)
        except SystemExit as stop:
            if stop.code == 2 and "For full helptext" in err.getvalue():
                return Ending("usage")
            raise BadEndingError(f"left with {stop.code!r}: {err.getvalue()[-500:]}") from stop
        except BaseException as error:
            raise BadEndingError("".join(traceback.format_exception(error)[-3:])) from error
    if told:
        # Python would print it between the lines.
        raise BadEndingError(f"a warning: {told[0].category.__name__}: {told[0].message}")
    if code == 0:
        return Ending("done", found=out.getvalue())
    text = err.getvalue()
    if code != 2:
        raise BadEndingError(f"exit code {code}: {text[-500:]}")
    if not text and "NOT ADMISSIBLE" in out.getvalue():  # `report --check` says it on stdout
        return Ending("refused", found=out.getvalue())
    return Ending("refused", one_sentence(text, mentions, notes), text.splitlines()[1:])


def one_sentence(text: str, mentions: Sequence[str] = (), notes: bool = False) -> str:
    """The sentence of an error, without "error: ".

    Raises:
        BadEndingError: if it is not one clear line that names its subject and a cure.
    """
    lines = text.removesuffix("\n").split("\n")
    problems = [
        f"{len(lines)} lines" * (len(lines) != 1 and not notes),
        "no 'error: '" * (not text.startswith("error: ")),
        "unprintable characters" * (not lines[0].isprintable()),
        f"{len(lines[0])} characters" * (not 25 <= len(lines[0]) <= LONGEST),
        "no cure" * (CURE.search(lines[0]) is None),
        f"names none of {mentions}" * bool(mentions and not any(m in text for m in mentions)),
    ]
    if any(problems):
        raise BadEndingError(f"{', '.join(filter(None, problems))}: {text[:900]!r}")
    return lines[0].removeprefix("error: ")
