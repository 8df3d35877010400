"""The one error that the leaderboard raises for bad input."""

from __future__ import annotations


class RecordError(ValueError):
    """A record (or a path to one) cannot be used.

    The message is one sentence for the user: which file, what is wrong, how to mend it. The command
    lines print it on one line of stderr and leave with exit code 2.
    """
