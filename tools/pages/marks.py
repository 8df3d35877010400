"""Documentation pages of a checkout with generated tables between two marks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.terminal import complain

CHECKOUT = Path(__file__).resolve().parents[2]
BEGIN, END = "<!-- tables: begin -->\n", "<!-- tables: end -->\n"


def with_tables(page: str, tables: str | Sequence[str], name: str) -> str:
    """Replace what stands between the marks of a page.

    Args:
        page: its text.
        tables: markdown; a text for each pair of marks, where there are several.
        name: of the page, for messages.

    Raises:
        UserError: the page lacks the marks.
    """
    texts = [tables] if isinstance(tables, str) else tables
    new, *parts = page.split(BEGIN)
    if len(parts) != len(texts) or not all(END in part for part in parts):
        raise UserError(
            f"{name} lacks the marks {BEGIN.strip()} and {END.strip()}; restore the page"
        )
    for text, part in zip(texts, parts, strict=True):
        new += f"{BEGIN}\n{text.strip()}\n\n{END}{part.partition(END)[2]}"
    return new


def check_checkout(page: Path) -> None:
    """Refuse to write a page that is not there: SymSteer was installed without its documentation.

    Raises:
        UserError: there is no such page.
    """
    if not page.is_file():
        raise UserError(f"there is no {page}: pages can be written in a checkout of SymSteer only")


def write_tables(page: Path, render: Callable[[], str | Sequence[str]]) -> int:
    """Write what ``render`` gives between the marks of a page of ``docs``.

    Args:
        page: its file.
        render: gives markdown, a text for each pair of marks, or raises a UserError.

    Returns:
        The exit code.
    """
    try:
        check_checkout(page)
        text = with_tables(page.read_text(), render(), f"docs/{page.name}")
        write_together({page: text.encode()})
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(f"wrote the tables of {page}")
    return 0
