"""The documentation of a checkout: what its pages say of agents and variants, and its own pages.

An installed package has no documentation: pages then show what records hold, and nothing is built.
"""

from __future__ import annotations

import posixpath
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from symsteer.errors import UserError
from symsteer.leaderboard.paths import PAGE_FOLDER
from symsteer.leaderboard.site import markup

if TYPE_CHECKING:
    from markupsafe import Markup

CONFIG = PAGE_FOLDER.parent / "mkdocs.yml"
"""Configuration of the documentation, in a checkout of the repository."""

FOLDER = "docs"
"""Folder of the documentation's pages, in the checkout and in the site."""


@dataclass(frozen=True)
class Documentation:
    """Texts of the documentation.

    Attributes:
        built: whether the site has its pages, so that they can be linked.
        folder: where the pages lie as markdown; None where there is no documentation.
    """

    built: bool
    folder: Path | None = None

    @classmethod
    def of_checkout(cls, built: bool) -> Documentation:
        """That of the checkout that this code is part of, if it is one."""
        there = CONFIG.is_file()
        return cls(built and there, CONFIG.parent / FOLDER if there else None)

    def agent(self, name: str, root: str) -> dict[str, Markup]:
        """What the table of docs/agents.md says of an agent, by column; empty if it is not there.

        Args:
            name: of the agent.
            root: from the page that shows it to the site's folder, such as `../`.
        """
        return self._facts("agents.md", name, root)

    def variant(self, name: str, root: str) -> dict[str, Markup]:
        """What the table of docs/variants.md says of a variant, by column."""
        return self._facts("variants.md", name, root)

    def notes(self, name: str, root: str) -> Markup | None:
        """The notes of docs/variants.md that name a variant."""
        bullets = re.findall(r"^- \*\*.*?(?=^- |^$)", self._text("variants.md"), re.M | re.S)
        found = [bullet for bullet in bullets if f"`{name}`" in bullet]
        return markup.html("".join(found), self._links("variants.md", root)) if found else None

    def agent_page(self, name: str, root: str) -> tuple[Markup, str | None] | None:
        """The page that docs/agents.md names for an agent, without its heading, and its address."""
        row = self._rows("agents.md").get(name, {})
        pages = re.findall(r"\]\((agents/[\w-]+\.md)\)", " ".join(row.values()))
        if not pages:
            return None
        text = re.sub(r"\A# .*\n", "", self._text(pages[0]))
        return markup.html(text, self._links(pages[0], root)), self.page(pages[0], root)

    def task_picture(self, task: str) -> tuple[str, str] | None:
        """Names of the picture and the page of a task, below the documentation's folder."""
        stem = re.sub(r"(?<!^)(?=[A-Z])", "-", task.removesuffix("-v1")).lower()
        if self.folder is None or not re.fullmatch(r"[a-z0-9-]+", stem):
            return None
        picture = f"tasks/{stem}.png"
        return (picture, f"tasks/{stem}.md") if (self.folder / picture).is_file() else None

    def variant_picture(self, name: str) -> str | None:
        """Name of a variant's picture, below the documentation's folder."""
        if self.folder is None or not re.fullmatch(r"[a-z0-9_]+", name):
            return None
        picture = f"variants/{name}.png"
        return picture if (self.folder / picture).is_file() else None

    def page(self, name: str, root: str) -> str | None:
        """Address of a page of the documentation, given as `agents.md`; None if it is not built."""
        path, hash_sign, anchor = name.partition("#")
        if not self.built or self.folder is None or not (self.folder / path).is_file():
            return None
        return f"{root}{FOLDER}/{path.removesuffix('.md')}.html{hash_sign}{anchor}"

    def _links(self, page: str, root: str) -> markup.Link:
        def link(href: str) -> str | None:
            parts = urlsplit(href)
            if parts.scheme or parts.netloc:
                return None
            target = posixpath.normpath(posixpath.join(posixpath.dirname(page), parts.path))
            anchor = f"#{parts.fragment}" if parts.fragment else ""
            return self.page((target if parts.path else page) + anchor, root)

        return link

    def _facts(self, page: str, name: str, root: str) -> dict[str, Markup]:
        row = self._rows(page).get(name, {})
        link = self._links(page, root)
        return {column: markup.inline(text, link) for column, text in row.items() if text}

    def _text(self, page: str) -> str:
        if self.folder is None:
            return ""
        try:
            return (self.folder / page).read_text()
        except OSError as error:
            raise UserError(f"{page} of the documentation cannot be read: restore it") from error

    def _rows(self, page: str) -> dict[str, dict[str, str]]:
        return named_rows(self._text(page))


def named_rows(text: str) -> dict[str, dict[str, str]]:
    """Rows of the first markdown table whose first column is `name`, by the names in it.

    Each row is a dictionary by column, without the first one.
    """
    lines = iter(text.splitlines())
    columns: list[str] = []
    for line in lines:
        cells = _cells(line)
        if cells[:1] == ["name"]:
            columns = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", cell) for cell in cells]
            break
    next(lines, None)  # the rule below the header
    found: dict[str, dict[str, str]] = {}
    for line in lines:
        if not line.startswith("|"):
            break
        cells = _cells(line)
        for name in re.findall(r"`([^`]+)`", cells[0]):
            found[name] = dict(zip(columns[1:], cells[1:], strict=False))
    return found


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip().strip("|"))]


def build_documentation(out: Path) -> None:
    """Build the documentation's pages into a folder, strictly: a dead link is an error.

    Raises:
        UserError: for a page that MkDocs refuses.
    """
    import logging
    import os

    # An advertisement of the theme's successor.
    os.environ.setdefault("NO_MKDOCS_2_WARNING", "1")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config
    from mkdocs.exceptions import Abort, ConfigurationError

    handler = logging.StreamHandler()
    handler.setLevel(logging.WARNING)
    logging.getLogger("mkdocs").addHandler(handler)
    try:
        config = load_config(str(CONFIG), site_dir=str(out), strict=True)
        config.plugins.on_startup(command="build", dirty=False)
        build(config)
    except (Abort, ConfigurationError) as error:
        raise UserError(
            f"the documentation cannot be built: {error}; correct the page, or leave the "
            "documentation out with --no-docs"
        ) from error
    finally:
        logging.getLogger("mkdocs").removeHandler(handler)
