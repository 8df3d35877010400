"""The error message about an unknown name, with the nearest valid name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from symsteer.errors import UserError
from symsteer.hints import name_hint

LONGEST_NAME = 80
"""Characters of a wrong name that are quoted: its end, which tells paths apart."""


def check(kind: str, names: Iterable[str], valid: Iterable[str], where: str = "") -> None:
    """Raise the error of :func:`unknown` for the first of the names that is not valid."""
    valid = list(valid)
    for name in names:
        if name not in valid:
            raise unknown(kind, name, valid, where)


def unknown(kind: str, name: str, valid: Iterable[str], where: str = "") -> UserError:
    """The error for a name that does not exist.

    Args:
        kind: what the name should be, such as ``task``.
        name: the unknown name.
        valid: all valid names, in the order of the list in the message.
        where: the file or command with the name; the message begins with it.
    """
    valid = list(valid)
    name = name if len(name) <= LONGEST_NAME else f"...{name[-LONGEST_NAME:]}"
    close = difflib.get_close_matches(name, valid, n=1)
    hint = name_hint(kind, name) or (f"did you mean {close[0]!r}? " if close else "")
    start = f"{where}: " if where else ""
    return UserError(f"{start}there is no {kind} {name!r}; {hint}valid: {', '.join(valid)}")
