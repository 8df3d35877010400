"""The documentation of a checkout as a part of the site; an installed package has none."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symsteer.errors import UserError
from symsteer.leaderboard.paths import PAGE_FOLDER

CONFIG = PAGE_FOLDER.parent / "mkdocs.yml"
"""Configuration of the documentation, in a checkout of the repository."""

FOLDER = "docs"
"""Folder of the documentation's pages, in the checkout and in the site."""


@dataclass(frozen=True)
class Documentation:
    """The pages of the documentation that the site's other pages link.

    Attributes:
        is_built: whether the site has them.
    """

    is_built: bool

    @classmethod
    def of_checkout(cls, is_wanted: bool) -> Documentation:
        """Those of the checkout that this code is part of, if it is one."""
        return cls(is_wanted and CONFIG.is_file())

    def page(self, *names: str) -> str | None:
        """Address of the first page that there is, of names such as `agents.md`; else None."""
        return next(filter(None, map(self._file, names)), "").replace(".md", ".html") or None

    def picture(self, folder: str, name: str) -> str | None:
        """Address of the picture of a task or a variant; None if there is none."""
        words = re.sub(r"(?<!^)(?=[A-Z])", "-", name.removesuffix("-v1")).lower()
        return self._file(f"{folder}/{words}.png")

    def _file(self, name: str) -> str | None:
        """Names in records may be anything: those that a file of the documentation may have."""
        safe = self.is_built and re.fullmatch(r"([a-z-]+/)?[a-z0-9_-]+\.(md|png)", name)
        return f"{FOLDER}/{name}" if safe and (CONFIG.parent / FOLDER / name).is_file() else None


def build_documentation(out: Path) -> None:
    """Build the documentation's pages into a folder, strictly: a dead link is an error.

    Raises:
        UserError: for a page that MkDocs refuses.
    """
    # Without --quiet, because MkDocs counts the warnings that it logs; with -P, because the current
    # folder may have modules of strangers.
    command = [sys.executable, "-P", "-m", "mkdocs", "build", "--strict"]
    # The variable stops an advertisement of the theme's successor.
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    options: dict[str, Any] = {"env": environment, "capture_output": True, "text": True}
    paths = ["--config-file", str(CONFIG), "--site-dir", str(out)]
    built = subprocess.run([*command, *paths], check=False, **options)
    if built.returncode:
        said = [line for line in built.stderr.splitlines() if not line.startswith("INFO")]
        raise UserError(
            "the documentation cannot be built; correct the page, or leave the documentation out "
            "with --no-docs: " + "; ".join(said)
        )
