"""Templates, and markdown as HTML: nothing that a record or a file name brings becomes markup.

Templates escape every value. Markdown comes from the leaderboard's own page, where text of records
stands in code spans alone, from a study's notice and from the documentation; HTML in it is escaped.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symsteer.leaderboard.site.charts import numbers

if TYPE_CHECKING:
    from jinja2 import Environment
    from markdown_it import MarkdownIt
    from markdown_it.token import Token
    from markupsafe import Markup

Link = Callable[[str], str | None]
"""Address of what a link in markdown points to; None shows its text without a link."""

TEMPLATES = Path(__file__).resolve().parent / "templates"

SPACES = "\n\t\u00a0\u202f"
"""Characters that are not printable in Python's sense, and do no harm."""

FOLDED = re.compile(r"<details>\n<summary>(.*?)</summary>\n\n(.*)\n\n</details>", re.DOTALL)
"""A block of the leaderboard's page that is folded."""


def shown(value: Any) -> Any:
    """A value for a page: control characters of texts become spaces, None is nothing."""
    if value is None:
        return ""
    if isinstance(value, str) and not hasattr(value, "__html__"):
        return "".join(c if c.isprintable() or c in SPACES else " " for c in value)
    return value


@functools.cache
def environment() -> Environment:
    """The templates of the pages."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    found = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        finalize=shown,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    found.globals["numbers_of"] = numbers
    found.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return found


def html(blocks: str | Sequence[str], link: Link = lambda href: None) -> Markup:
    """Blocks of markdown as HTML; tables scroll within their box.

    Args:
        blocks: as the leaderboard's page has them.
        link: where relative links lead; by default they are shown as text.
    """
    from markupsafe import Markup, escape

    parts = []
    for block in [blocks] if isinstance(blocks, str) else blocks:
        if folded := FOLDED.fullmatch(block):
            inside = html(folded[2], link)
            parts.append(f"<details><summary>{escape(folded[1])}</summary>{inside}</details>")
        else:
            tokens = _parser().parse(block)
            for token in tokens:
                if token.children:
                    token.children = _linked(token.children, link)
            parts.append(_parser().renderer.render(tokens, _parser().options, {}))
    return Markup("\n".join(parts))


def inline(text: str, link: Link = lambda href: None) -> Markup:
    """One line of markdown, such as a cell of a table."""
    from markupsafe import Markup

    (token,) = _parser().parseInline(text)
    token.children = _linked(token.children or [], link)
    return Markup(_parser().renderer.render([token], _parser().options, {}))


@functools.cache
def _parser() -> MarkdownIt:
    from markdown_it import MarkdownIt
    from markdown_it.common.utils import escapeHtml

    parser = MarkdownIt("commonmark", {"html": False}).enable("table")

    def text(tokens: Sequence[Token], index: int, *_: Any) -> str:
        # The page's tables break lines within cells. Text of records is in code spans, not here.
        return escapeHtml(tokens[index].content).replace("&lt;br&gt;", "<br>")

    def table(tokens: Sequence[Token], index: int, *_: Any) -> str:
        return '<div class="scroll" tabindex="0" role="region" aria-label="Table"><table>'

    rules: dict[str, Any] = parser.renderer.rules  # type: ignore[attr-defined, assignment]
    rules["text"] = text
    rules["table_open"] = table
    rules["table_close"] = lambda *_: "</table></div>"
    return parser


def _linked(tokens: Sequence[Token], link: Link) -> list[Token]:
    """Tokens with the addresses of their links; those without one lose their link."""
    found, open_links = [], []
    for token in tokens:
        if token.type == "link_open":
            target = link(str(token.attrs["href"]))
            open_links.append(target)
            if target is None:
                continue
            token.attrs["href"] = target
        elif (token.type == "link_close" and open_links.pop() is None) or token.type == "image":
            continue
        found.append(token)
    return found
