"""The documentation as pages: links, the dialect of GitHub, what results show of it."""

from __future__ import annotations

import re
import shutil
from collections import Counter
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from symsteer.agents import AGENTS
from symsteer.bench.variants import VARIANTS
from symsteer.errors import UserError
from symsteer.leaderboard.site import docs
from symsteer.leaderboard.site.docs import CONFIG, Documentation, build_documentation, named_rows
from tests.leaderboard.site.pages import dead_links, read_pages
from tools.mkdocs_hook import PAGES, relinked

ROOT = CONFIG.parent


@pytest.fixture(scope="module")
def built(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole site, documentation included."""
    out = tmp_path_factory.mktemp("docs") / "site"
    shutil.copytree(site, out)
    build_documentation(out / "docs")
    return out


def test_links_of_the_documentation_lead_to_pages(built: Path) -> None:
    pages = read_pages(built)
    dead = [link for link in dead_links(pages) if "//" not in link and "404" not in link]
    assert not dead
    external = {link for link in dead_links(pages) if "//" in link}
    # What a reader may click; nothing is loaded from there.
    assert {re.sub(r".*: ", "", link) for link in external} <= {
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


def test_both_parts_lead_to_each_other(built: Path) -> None:
    pages = read_pages(built)
    for path in ("docs/index.html", "docs/agents/partial.html"):
        up = "../" * path.count("/")
        assert {f"{up}index.html", f"{up}runs.html"} <= set(pages[built / path].addresses)
    home = pages[built / "docs" / "index.html"]
    assert "../index.html" in home.addresses
    # Elsewhere GitHub's link to a file of code is its name.
    text = pages[built / "docs" / "agents.html"].text
    assert "leashed.py" in text


def test_pages_are_as_github_shows_them(built: Path) -> None:
    """Lists, tables and blocks of code are the same; Python-Markdown has rules of its own."""
    github = MarkdownIt("commonmark").enable("table")
    sources = {path: path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")}
    sources |= {ROOT / name: Path(page) for name, page in PAGES.items()}
    for path, page in sources.items():
        html = (built / "docs" / page.with_suffix(".html")).read_text()
        article = re.search(r"<article[^>]*>(.*?)</article>", html, re.S)
        assert article
        both = [
            Counter(re.findall(r"<(h2|h3|ul|ol|li|tr|td|pre)[ >]", text))
            for text in (github.render(path.read_text()), article[1])
        ]
        assert both[0] == both[1], path


@pytest.mark.long
def test_a_dead_link_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "checkout"
    copy.mkdir()
    linked = ("examples", "leaderboard/site", "leaderboard/LEADERBOARD.md", "CITATION.cff")
    linked += ("leaderboard/learners/LEADERBOARD.md", "leaderboard/results/audit")
    linked += ("leaderboard/zoo/LEADERBOARD.md", "leaderboard/results/base-policies")
    linked += ("leaderboard/first/LEADERBOARD.md", "leaderboard/PAPER.md", "leaderboard/figures")
    linked += ("leaderboard/stress/LEADERBOARD.md",)
    for name in ("docs", "README.md", "CHANGELOG.md", "mkdocs.yml", *linked):
        source = ROOT / name
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, copy / name)
        else:
            shutil.copy(source, copy / name)
    monkeypatch.setattr(docs, "CONFIG", copy / "mkdocs.yml")
    page = copy / "docs" / "api.md"
    text = page.read_text()
    build_documentation(tmp_path / "out")
    for wrong in ("[x](nowhere.md)", "[x](metrics.md#nowhere)", "[x](../bench/nowhere.py)"):
        page.write_text(f"{text}\n{wrong}\n")
        with pytest.raises(UserError, match="documentation cannot be built"):
            build_documentation(tmp_path / "out")


def test_results_show_what_the_documentation_says() -> None:
    reading = Documentation.of_checkout(built=True)
    for name in AGENTS.builtin:
        facts = reading.agent(name, "../")
        assert facts["role"] in ("learner", "control", "reference"), name
    for name in VARIANTS.builtin:
        assert reading.variant(name, "../")["strength 1"], name
    assert "part of the audit" in reading.variant("wind", "")
    assert "relative to" in str(reading.notes("wind", ""))
    text, address = reading.agent_page("partial", "../") or ("", "")
    assert "Partially equivariant SAC" in text
    assert "<h1>" not in text
    assert address == "../docs/agents/partial.html"
    assert 'href="../docs/agents/asymmetry.html"' in reading.agent("relaxed", "../")["actor"]
    assert reading.task_picture("PickCube-v1") == ("tasks/pick-cube.png", "tasks/pick-cube.md")
    for name in ("../../etc/passwd", "no-such-agent"):
        assert not reading.agent(name, "../")
        assert reading.task_picture(name) is None
        assert reading.variant_picture(name) is None
    assert reading.variant_picture("wind") == "variants/wind.png"


def test_without_the_documentation_nothing_is_linked() -> None:
    reading = Documentation.of_checkout(built=False)
    assert "href" not in reading.agent("relaxed", "../")["actor"]
    assert reading.page("agents.md", "") is None
    assert not Documentation(False).agent("relaxed", "")


def test_rows_by_name() -> None:
    table = "text\n\n| name | what [x](y.md) |\n|---|---|\n| `a`, `b` | 1 \\| 2 |\n\n| `c` | 3 |\n"
    assert named_rows(table) == {"a": {"what x": "1 \\| 2"}, "b": {"what x": "1 \\| 2"}}
    assert named_rows("nothing") == {}


def test_links_of_pages() -> None:
    text = "[a](../CHANGELOG.md) [b](metrics.md#x) [c](../examples/leashed.py) [d](https://e.org)"
    assert relinked(text, "docs/api.md", "api.md") == (
        "[a](changelog.md) [b](metrics.md#x) c (`examples/leashed.py`) [d](https://e.org)"
    )
    code = "`[x](gone.md)` and [`a`](../bench/cli.py), `b`"
    assert relinked(code, "docs/api.md", "api.md") == "`[x](gone.md)` and `a`, `b`"
    assert relinked("[`x`](../../bench/cli.py)", "docs/agents/partial.md", "agents/partial.md") == (
        "`x`"
    )
    readme = relinked(
        "[whole](leaderboard/LEADERBOARD.md) [d](docs/api.md)", "README.md", "index.md"
    )
    assert readme == '<a href="../index.html">whole</a> [d](api.md)'
    picture = relinked("![answer](leaderboard/figures/answer.svg)", "README.md", "index.md")
    assert picture == "![answer](assets/answer.svg)"
