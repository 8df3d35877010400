"""The documentation as pages: links, the dialect of GitHub, what results link."""

from __future__ import annotations

import logging
import re
from collections import Counter
from pathlib import Path

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.site import docs
from symsteer.leaderboard.site.docs import CONFIG, Documentation, build_documentation
from tests.leaderboard.site.pages import dead_links, read_pages
from tests.marks import need
from tools.mkdocs_hook import PAGES, relinked

need("site")

markdown_it = pytest.importorskip("markdown_it", exc_type=ImportError)

ROOT = CONFIG.parent


def test_links_of_the_documentation_lead_to_pages(whole: Path) -> None:
    pages = read_pages(whole)
    links = dead_links(pages)
    assert not [link for link in links if "//" not in link and "404" not in link]
    # What a reader may click; nothing is loaded from there.
    assert {re.sub(r".*: ", "", link) for link in links if "//" in link} <= {
        "https://github.com/QUVA-Lab/escnn",
        "https://keepachangelog.com/en/1.1.0/",
        "https://semver.org/",
        "https://squidfunk.github.io/mkdocs-material/",
    }
    loaded = [
        attrs.get("src") or attrs["href"]
        for page in pages.values()
        for tag, attrs in page.elements
        if tag in ("script", "img", "link", "iframe") and (attrs.get("src") or attrs.get("href"))
    ]
    assert not [address for address in loaded if "//" in address]
    # Both parts lead to each other.
    for path in ("docs/index.html", "docs/agents/partial.html"):
        up = "../" * path.count("/")
        assert {f"{up}index.html", f"{up}runs.html"} <= set(pages[whole / path].addresses)
    # Elsewhere GitHub's link to a file of code is its name.
    assert "leashed.py" in pages[whole / "docs" / "agents.html"].text


def test_pages_are_as_github_shows_them(whole: Path) -> None:
    """Lists, tables and blocks of code are the same; Python-Markdown has rules of its own."""
    github = markdown_it.MarkdownIt("commonmark").enable("table")
    sources = {path: path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")}
    sources |= {ROOT / name: Path(page) for name, page in PAGES.items()}
    for path, page in sources.items():
        html = (whole / "docs" / page.with_suffix(".html")).read_text()
        article = re.search(r"<article[^>]*>(.*?)</article>", html, re.S)
        assert article
        both = [
            Counter(re.findall(r"<(h2|h3|ul|ol|li|tr|td|pre)[ >]", text))
            for text in (github.render(path.read_text()), article[1])
        ]
        assert both[0] == both[1], path


def test_a_dead_link_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[x](nowhere.md)\n")
    (tmp_path / "mkdocs.yml").write_text("site_name: x\ntheme: {name: mkdocs}\n")
    monkeypatch.setattr(docs, "CONFIG", tmp_path / "mkdocs.yml")
    with pytest.raises(UserError, match=r"cannot be built.*nowhere\.md"):
        build_documentation(tmp_path / "out")


def test_results_link_the_documentation_where_it_is_built() -> None:
    reading = Documentation.of_checkout(is_wanted=True)
    assert reading.page("agents/partial.md", "agents.md") == "docs/agents/partial.html"
    assert reading.page("agents/standard.md", "agents.md") == "docs/agents.html"
    assert reading.picture("tasks", "PickCube-v1") == "docs/tasks/pick-cube.png"
    assert reading.picture("variants", "wind") == "docs/variants/wind.png"
    for name in ("../../etc/passwd", "no-such-agent"):
        assert reading.page(f"agents/{name}.md") is None
        assert reading.picture("tasks", name) is None
    without = Documentation.of_checkout(is_wanted=False)
    assert without.page("agents.md") is None
    assert without.picture("variants", "wind") is None


LINKS = {
    "docs/api.md": {
        "[a](../CHANGELOG.md) [b](metrics.md#x)": "[a](changelog.md) [b](metrics.md#x)",
        "[c](../examples/leashed.py)": "c (`examples/leashed.py`)",
        "[d](https://e.org)": "[d](https://e.org)",
        "`[x](gone.md)` and [`a`](../bench/cli.py), `b`": "`[x](gone.md)` and `a`, `b`",
    },
    "docs/agents/partial.md": {"[`x`](../../bench/cli.py)": "`x`"},
    "README.md": {
        "[whole](leaderboard/LEADERBOARD.md)": '<a href="../index.html">whole</a>',
        "[d](docs/api.md)": "[d](api.md)",
        "![answer](leaderboard/figures/answer.svg)": "![answer](assets/answer.svg)",
    },
}


def test_links_of_pages(caplog: pytest.LogCaptureFixture) -> None:
    for place, links in LINKS.items():
        source = PAGES.get(place) or place.removeprefix("docs/")
        for text, expected in links.items():
            assert relinked(text, place, source) == expected
    with caplog.at_level(logging.WARNING):
        relinked("[x](../bench/nowhere.py)", "docs/api.md", "api.md")
    assert "bench/nowhere.py, which does not exist" in caplog.text
