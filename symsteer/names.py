"""What to say about a name that does not exist: one "did you mean" for everything."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from symsteer.errors import UserError


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name that looks most like ``name``, if any is close."""
    return next(iter(difflib.get_close_matches(name, list(valid), n=1, cutoff=0.5)), None)


def unknown(kind: str, name: str, valid: Iterable[str], where: str = "") -> UserError:
    """The error for a name that is none of the valid ones.

    Args:
        kind: what the name should be, such as ``task``.
        name: what was given.
        valid: all names, in the order in which they are listed.
        where: the file or command that holds the name, to begin the sentence with.
    """
    valid = list(valid)
    close = nearest(name, valid)
    hint = f"did you mean {close!r}? " if close else ""
    start = f"{where}: " if where else ""
    return UserError(f"{start}there is no {kind} {name!r}; {hint}valid: {', '.join(valid)}")
