"""The committed pages hold the tables that the committed results give."""

from __future__ import annotations

import pytest

from symsteer.errors import UserError
from symsteer.files import write_together
from tools.pages import (
    audit,
    base_policies,
    free_bias,
    marks,
    minima,
    next_designs,
    seen,
    sides,
    steered,
    tuning,
    words,
)
from tools.pages.marks import BEGIN, END, with_tables

TOOLS = (
    audit,
    base_policies,
    free_bias,
    minima,
    next_designs,
    seen,
    sides,
    steered,
    tuning,
    words,
)


@pytest.fixture
def written(monkeypatch):
    """What a tool writes, by path, in place of writing it."""
    files = {}
    for module in (audit, base_policies, tuning, marks):
        monkeypatch.setattr(module, "write_together", files.update)
    return files


@pytest.mark.parametrize("tool", TOOLS)
def test_the_committed_pages_are_what_the_results_give(tool, written, capsys):
    assert tool.main([]) == 0
    assert written
    for path, content in written.items():
        assert path.read_bytes() == content, f"{path.name} is old: run python -m {tool.__name__}"


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.parametrize("content", ["{", '{"rows": [{}]}'])
def test_files_that_are_no_results(tool, content, tmp_path, written, capsys):
    path = tmp_path / "other.json"
    write_together({path: content.encode()})
    assert tool.main([str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert not written


def test_tables_are_written_between_the_marks():
    page = f"before\n{BEGIN}old\n{END}after\n"
    assert with_tables(page, "new", "page.md") == f"before\n{BEGIN}\nnew\n\n{END}after\n"
    assert with_tables(page * 2, ["a", "b"], "page.md") == "".join(
        f"before\n{BEGIN}\n{new}\n\n{END}after\n" for new in "ab"
    )


@pytest.mark.parametrize("page", ["no mark", f"one pair\n{BEGIN}{END}", f"{BEGIN}{END}{BEGIN}"])
def test_pages_without_all_marks_are_refused(page):
    with pytest.raises(UserError, match=r"^page\.md lacks the marks .* restore the page$"):
        with_tables(page, ["a", "b"], "page.md")


def test_of_an_audited_cell_the_last_summary_counts():
    def row(variant, task="B", embodiment="floating", defect=0.0):
        fields = {"task": task, "embodiment": embodiment, "group": "C8", "variant": variant}
        return fields | {"decision": defect}

    others = [row("none", task="A"), row("none", embodiment="panda")]
    rows = [row("none"), row("wind:1"), *others]
    rows += [row("wind:0.75"), row("wind:1", defect=0.3), row("gain:10"), row("gain:9")]
    own = [row("none"), row("gain:9"), row("gain:10"), row("wind:0.75"), row("wind:1", defect=0.3)]
    more = [row("wind:1.5..2.5"), row("wind:2+gain:1")]
    assert audit.in_order([*more, *rows]) == [*own, *more, *others]
