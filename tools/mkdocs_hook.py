"""What MkDocs does with the documentation's links: GitHub shows the same pages from the same files.

README.md and CHANGELOG.md become pages. Links to other files outside of `docs/` lead to the site's
results, or become plain code text, as no host of the repository is known to a folder of pages.
"""

from __future__ import annotations

import logging
import posixpath
import re
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from markdown import Extension

if TYPE_CHECKING:
    from markdown import Markdown
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

log = logging.getLogger("mkdocs.hooks.symsteer")
"""MkDocs counts what it says: with `strict`, a warning is an error."""

ROOT = Path(__file__).resolve().parents[1]

SHARED = ROOT / "leaderboard" / "site" / "static"
"""Scripts and styles that the documentation has in common with the results."""

PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md"}
"""Files of the repository's root that are pages, too."""

PICTURES = {
    "leaderboard/figures/answer.svg": "assets/answer.svg",
    **{
        f"leaderboard/dial/figures/{name}.svg": f"assets/dial-{name}.svg"
        for name in (
            "regret",
            "success-pickcube-v1-floating-7fa3e0",
            "success-pushcube-v1-floating-5d7ac0",
        )
    },
}
"""Pictures outside of `docs/` that these pages show."""

RESULTS = "leaderboard/LEADERBOARD.md"
"""The committed leaderboard; of the site these are the results."""

LINK = re.compile(
    r"^ *```.*?^ *```|`[^`\n]+`|(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)", re.M | re.S
)
"""A link, or code, in which nothing is a link; a link whose text is code is a link."""

CODE = re.compile(r"((?:^|\n)[^\s\-*\d][^\n]*\n)\n((?: {4}[^\n]*\n(?:\n(?= {4}))*)+)")
"""A paragraph outside of lists, and the block of code that follows it, indented by four spaces."""


class TwoSpaces(Extension):
    """Lists as GitHub reads them: what belongs to an item is indented as its text is."""

    def extendMarkdown(self, md: Markdown) -> None:  # noqa: N802 (markdown's name)
        """Python-Markdown's own lists need four spaces."""
        md.tab_length = 2
        md.build_parser()


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Put `TwoSpaces` before the extensions that add to the parser that it builds anew."""
    config.markdown_extensions.insert(0, TwoSpaces())  # type: ignore[arg-type]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of the repository's root, and what both parts of the site share."""
    from mkdocs.structure.files import File

    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    for name, address in PICTURES.items():
        files.append(File.generated(config, address, abs_src_path=str(ROOT / name)))
    for path in sorted(SHARED.iterdir()):
        if path.name in ("theme.js", "header.css", "icon.svg"):
            files.append(File.generated(config, f"assets/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links lead to pages of the site, outside of code."""
    source = page.file.src_uri
    origins = {page: name for name, page in PAGES.items()}
    return relinked(CODE.sub(_fenced, markdown), origins.get(source, f"docs/{source}"), source)


def _fenced(match: re.Match[str]) -> str:
    """Code between fences: these mean the same at any indentation."""
    return f"{match[1]}\n```text\n{textwrap.dedent(match[2]).rstrip()}\n```\n\n"


def relinked(text: str, place: str, source: str) -> str:
    """Markdown whose links are those of the site.

    Args:
        text: markdown.
        place: path of the file in the repository.
        source: path of the page below `docs/`.
    """

    def replace(match: re.Match[str]) -> str:
        mark, label, href = match.groups()
        if href is None:
            return match[0]
        parts = urlsplit(href)
        if parts.scheme or parts.netloc or not parts.path:
            return match[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(place), parts.path))
        anchor = f"#{parts.fragment}" if parts.fragment else ""
        own = target.removeprefix("docs/") if target.startswith("docs/") else ""
        if found := PAGES.get(target) or PICTURES.get(target) or own:
            address = posixpath.relpath(found, posixpath.dirname(source) or ".")
            return f"{mark}[{label}]({address}{anchor})"
        if target == RESULTS:
            # One folder up from the documentation; MkDocs leaves HTML as it is.
            up = "../" * (source.count("/") + 1)
            return f'<a href="{up}index.html">{label}</a>'
        if not (ROOT / target).exists():
            log.warning("%s links to %s, which does not exist", place, target)
        return label if label.startswith("`") else f"{label} (`{target}`)"

    return LINK.sub(replace, text)
