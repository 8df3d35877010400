"""Reads the pages of a site without a browser."""

from __future__ import annotations

import json
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

VOID = ("br", "hr", "img", "input", "link", "meta")


class Page(HTMLParser):
    """Elements, addresses and texts of a page.

    Attributes:
        elements: tag and attributes of each, in order.
        text: what a reader sees, without scripts.
        data: what the page's blocks of JSON hold.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.data: list[Any] = []
        self._open: list[str] = []
        self.feed(path.read_text())
        self.close()
        assert not self._open, f"{path}: {self._open} are not closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID and not self._in_picture():
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if self._in_picture() and tag != "svg":
            return
        assert self._open.pop() == tag, f"{self.path}: {tag}"

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] == "script":
            if self.elements[-1][1].get("type") == "application/json":
                self.data.append(json.loads(data))
        elif self._open[-1:] != ["style"]:
            self.text += data

    def _in_picture(self) -> bool:
        return "svg" in self._open

    @property
    def addresses(self) -> list[str]:
        """All that the page links or loads."""
        names = ("href", "src", "poster", "data", "action")
        return [attrs[name] for _, attrs in self.elements for name in names if name in attrs]

    @property
    def anchors(self) -> set[str]:
        return {attrs["id"] for _, attrs in self.elements if "id" in attrs}


@cache
def read_pages(folder: Path) -> dict[Path, Page]:
    """Every page of results below a folder; the documentation's pages are not of these."""
    found = {path: Page(path) for path in sorted(folder.rglob("*.html"))}
    assert found
    return found


def dead_links(pages: dict[Path, Page]) -> list[str]:
    """Addresses that lead nowhere, outside of the folder or to another host."""
    found = []
    for path, page in pages.items():
        for address in page.addresses:
            parts = urlsplit(address)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            fragment = unquote(parts.fragment)
            if parts.scheme or parts.netloc or not target.is_file():
                found.append(f"{path.name}: {address}")
            elif fragment and target in pages and fragment not in pages[target].anchors:
                found.append(f"{path.name}: {address} (no such place)")
    return found
