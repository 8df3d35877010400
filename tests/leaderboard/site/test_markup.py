"""Markdown and templates: nothing but our own text becomes markup."""

from __future__ import annotations

from symsteer.leaderboard.site.markup import environment, html
from tests.marks import need

need("site")


def test_html_in_markdown_is_text() -> None:
    # What is not in a code span is the page's own text: it breaks lines in cells of tables.
    shown = html(["| a |\n| :-- |\n| 1<br>`<br><i>` <i>x</i> |"])
    assert '<td style="text-align:left">1<br><code>&lt;br&gt;&lt;i&gt;</code> &lt;i&gt;' in shown
    assert "<b>" not in html(["<b>x</b>\n\n<script>1</script>"])
    assert html(["<script>1</script>"]) == "<p>&lt;script&gt;1&lt;/script&gt;</p>\n"


def test_links_lead_where_they_may() -> None:
    text = ["[a](b.md) ![c](d.png) [e](javascript:alert(1)) [f](https://g.org)"]
    assert "href" not in html(text)
    assert "<img" not in html(text)
    shown = html(text, lambda href: f"docs/{href}\"'" if href.endswith(".md") else None)
    assert '<a href="docs/b.md&quot;\'">a</a>' in shown
    assert shown.count("href") == 1


def test_folded_blocks_keep_their_table_and_figures_become_charts() -> None:
    block = "<details>\n<summary>More & more</summary>\n\n| a |\n| --: |\n| <b> |"
    shown = html([block, "![x](0)", "![x](1)", "</details>"], charts={"0": []})
    assert shown.startswith("<details><summary>More &amp; more</summary>")
    assert shown.endswith("</details>")
    assert "<table>" in shown
    assert "&lt;b&gt;" in shown
    assert "<img" not in shown


def test_templates_escape_and_clean() -> None:
    template = environment().from_string("{{ text }}|{{ nothing }}|{{ data | tojson }}")
    shown = template.render(
        text="<b>\x00\x1b\u202e\u00a0\"'", nothing=None, data={"a": "</script>"}
    )
    assert shown == '&lt;b&gt;   \u00a0&#34;&#39;||{"a":"\\u003c/script\\u003e"}'
