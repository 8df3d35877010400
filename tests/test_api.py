"""The public names: docs/api.md lists them, docs and examples import nothing else."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

PACKAGES = ("symsteer", "symsteer.agents", "symsteer.policies", "symsteer.bench")

MODULES = {"symsteer.bench": {"demos", "tasks"}}
"""Public modules below a package."""

IMPORT = re.compile(
    r"^\s*(?:>>> )?(?:from (symsteer[\w.]*) import (.+)|import (symsteer[\w.]*))", re.M
)

TEXTS = [
    *(ROOT / "docs").glob("*.md"),
    *(ROOT / "examples").rglob("*.py"),
    *(ROOT / "agents" / "templates").glob("*.txt"),
    ROOT / "README.md",
]


def public(package: str) -> set[str]:
    return set(importlib.import_module(package).__all__) | MODULES.get(package, set())


@pytest.mark.parametrize("package", PACKAGES[1:])
def test_the_page_lists_the_names_that_there_are(package):
    section = (ROOT / "docs" / "api.md").read_text().partition(f"### `{package}`")[2]
    table = section.partition("\n#")[0]
    cells = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert {name for cell in cells for name in re.findall(r"`(\w+)`", cell)} == public(package)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_name_has_a_docstring(package):
    module = importlib.import_module(package)
    for name in module.__all__:
        value = getattr(module, name)
        assert not callable(value) or value.__doc__, f"{package}.{name}"


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_documents_and_examples_import_public_names_alone(path):
    for package, names, module in IMPORT.findall(path.read_text()):
        if module:
            parent, _, last = module.rpartition(".")
            assert module in PACKAGES or last in MODULES.get(parent, ()), module
        else:
            imported = re.sub(r"\$\{?\w+\}?", "", names)  # what a template fills in
            unknown = set(filter(None, imported.split(", "))) - public(package)
            assert not unknown, f"from {package} import {unknown}"


def test_packages_are_quick_to_import():
    code = f"import sys, {', '.join(PACKAGES)}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
