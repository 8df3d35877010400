"""Templates, and markdown as HTML: nothing that a record or a file name brings becomes markup.

Templates escape every value. Markdown comes from the leaderboard's own page, where text of records
stands in code spans alone, and from a study's notice; HTML in it is escaped.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from symsteer.leaderboard.site.charts import Chart, numbers

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

FOLDED = re.compile(r"<details>\n<summary>(.*?)</summary>")
"""The beginning of what a reader of the leaderboard's page unfolds."""

IMAGE = re.compile(r"!\[[^\]]*\]\(([^)]+)\)")
"""A figure of the leaderboard's page."""


def shown(value: Any) -> Any:
    """A value for a page: control characters of texts become spaces, None is nothing."""
    if value is None:
        return ""
    if isinstance(value, str) and not value.isprintable() and not hasattr(value, "__html__"):
        return "".join(c if c.isprintable() or c in SPACES else " " for c in value)
    return value


@functools.cache
def environment() -> Environment:
    """The templates of the pages."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        finalize=shown,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.globals["numbers_of"] = numbers
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    return environment


def html(
    blocks: Sequence[str],
    link: Link = lambda href: None,
    charts: Mapping[str, Sequence[Chart]] | None = None,
) -> Markup:
    """Blocks of the leaderboard's page as HTML; tables scroll within their box.

    Args:
        blocks: markdown.
        link: where links lead; by default they are shown as text.
        charts: what stands in the place of figures, by their address.
    """
    from markupsafe import Markup, escape

    pieces: list[str] = []
    for block in "\n\n".join(blocks).split("\n\n"):
        image = IMAGE.fullmatch(block)
        if begun := FOLDED.fullmatch(block):
            pieces.append(f"<details><summary>{escape(begun[1])}</summary>")
        elif block == "</details>":
            pieces.append(block)
        elif image and charts and image[1] in charts:
            template: Any = environment().get_template("macros.html").module
            pieces.append(template.charts(charts[image[1]]))
        else:
            pieces.append(_parser().render(block, {"link": link, "open": []}))
    return Markup("\n".join(pieces))


@functools.cache
def _parser() -> MarkdownIt:
    from markdown_it import MarkdownIt
    from markdown_it.common.utils import escapeHtml

    parser = MarkdownIt("commonmark", {"html": False}).enable("table")

    def text(tokens: Sequence[Token], index: int, *_: Any) -> str:
        # The page's tables break lines within cells. Text of records is in code spans, not here.
        return escapeHtml(tokens[index].content).replace("&lt;br&gt;", "<br>")

    def link_open(tokens: Sequence[Token], index: int, _: Any, state: dict[str, Any]) -> str:
        target = state["link"](str(tokens[index].attrs["href"]))
        state["open"].append(target)
        return f'<a href="{escapeHtml(target)}">' if target else ""

    rules: dict[str, Any] = parser.renderer.rules  # type: ignore[attr-defined, assignment]
    box = '<div class="scroll" tabindex="0" role="region" aria-label="Table"><table>'
    rules |= {"text": text, "link_open": link_open, "image": lambda *_: ""}
    rules |= {"table_open": lambda *_: box, "table_close": lambda *_: "</table></div>"}
    rules["link_close"] = lambda *given: "</a>" if given[3]["open"].pop() else ""
    return parser
