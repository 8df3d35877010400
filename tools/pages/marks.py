"""Documentation pages of a checkout with generated tables between two marks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.terminal import complain

CHECKOUT = Path(__file__).resolve().parents[2]
BEGIN, END = "<!-- tables: begin -->\n", "<!-- tables: end -->\n"


def with_tables(page: str, tables: str, name: str) -> str:
    """Replace what stands between the marks of a page.

    Args:
        page: its text.
        tables: markdown.
        name: of the page, for messages.

    Raises:
        UserError: the page lacks the marks.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise UserError(
            f"{name} lacks the marks {BEGIN.strip()} and {END.strip()}; restore the page"
        )
    return f"{before}{BEGIN}\n{tables.strip()}\n\n{END}{after}"


def check_checkout(page: Path) -> None:
    """Refuse to write a page that is not there: SymSteer was installed without its documentation.

    Raises:
        UserError: there is no such page.
    """
    if not page.is_file():
        raise UserError(f"there is no {page}: pages can be written in a checkout of SymSteer only")


def write_tables(page: Path, render: Callable[[], str]) -> int:
    """Write what ``render`` gives between the marks of a page of ``docs``.

    Args:
        page: its file.
        render: gives markdown, or raises a UserError.

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
