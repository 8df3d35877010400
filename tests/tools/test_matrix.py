"""The table of the versions, with cells that are not really tried."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from tools import matrix
from tools.pages.marks import BEGIN, CHECKOUT, END


@pytest.fixture
def page(monkeypatch, tmp_path) -> Path:
    """A page without a row; what a cell gives is in the words of the command."""
    path = tmp_path / "install.md"
    path.write_text(f"before\n{BEGIN}{END}after\n")
    monkeypatch.setattr(matrix, "PAGE", path)
    monkeypatch.setattr(matrix, "LOGS", tmp_path / "logs")
    monkeypatch.setattr(matrix, "build", lambda folder: folder / "a.whl")
    return path


def row(name, tests):
    return [name, *["x"] * (len(matrix.HEADER) - 3), tests, "2026-01-01"]


def test_rows_of_cells_that_are_not_tried_stay(page, monkeypatch):
    for name, tests, code in (("3.13", "9 passed", 0), ("pinned", "1 failed", 1)):
        monkeypatch.setattr(matrix, "try_cell", lambda name, *rest, tests=tests: row(name, tests))
        assert matrix.main([name]) == code
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert list(matrix.rows_of(text).values()) == [
        row("pinned", "1 failed"),
        row("3.13", "9 passed"),
    ]


def test_a_cell_that_is_not_there(page, capsys):
    assert matrix.main(["3.10"]) == 2
    assert "there is no cell '3.10'" in capsys.readouterr().err


def test_every_version_that_is_promised_has_a_cell():
    classifiers = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["classifiers"]
    promised = {text.rpartition(" ")[2] for text in classifiers if "Python :: 3." in text}
    assert promised == {cell.python for cell in matrix.CELLS.values()}
