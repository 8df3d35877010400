"""Tables as text: markdown for pages, aligned columns for a terminal."""

from __future__ import annotations

from collections.abc import Sequence


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """A markdown table; the first ``left`` columns are left-aligned, the others right-aligned."""
    rule = [":--" if index < left else "--:" for index in range(len(header))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows))


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """A table for a terminal, with two spaces between columns; alignment as in `markdown`.

    With an empty ``header`` there are only rows.
    """
    lines = [list(row) for row in ([header] if header else []) + list(rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]

    def place(index: int, text: str) -> str:
        return text.ljust(widths[index]) if index < left else text.rjust(widths[index])

    return "\n".join(
        "  ".join(place(index, text) for index, text in enumerate(line)).rstrip() for line in lines
    )
