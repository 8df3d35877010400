"""The exception for mistakes that the user can correct, and what its sentence says."""

from __future__ import annotations

from typing import Any


class UserError(Exception):
    """A mistake in the input: one sentence that says what is wrong and how to correct it.

    The command line prints the sentence and exits with code 2. Any other exception is a bug in
    SymSteer.
    """


def first_problem(error: Any) -> str:
    """The first validation error as a phrase: where, what, how many more."""
    if not hasattr(error, "error_count"):  # not pydantic's, which is slow to import
        return str(error)
    first = error.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in first["loc"])[:120]
    what = first["msg"].removeprefix("Value error, ")
    more = error.error_count() - 1
    return (
        f"{where}: {what}" * bool(where) + what * (not where) + f" (and {more} more)" * bool(more)
    )
