"""The pages in headless Chromium, from disk: sort, filter, hover, dark, narrow, no errors."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.leaderboard.site.conftest import EVIL
from tests.marks import need

need("site")

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM = next((path for name in NAMES if (path := shutil.which(name))), None)
"""The installed browser, if there is one; none is downloaded."""

OPTIONS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
)

pytestmark = [
    pytest.mark.long,
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on the PATH"),
]

Visit = Callable[..., Any]
"""Opens a page from disk, after which nothing may go wrong in it."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(OPTIONS))
        yield browser
        browser.close()


@pytest.fixture
def visit(browser: Any, request: pytest.FixtureRequest) -> Iterator[Visit]:
    """Fails for errors and warnings of the console, exceptions and requests to other hosts."""
    width = getattr(request, "param", 1280)
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme="light")
    context.set_default_timeout(120_000)  # Playwright's 30 s are short on a busy machine
    troubles: list[str] = []

    def said(message: Any) -> None:
        if message.type in ("error", "warning"):
            troubles.append(message.text)

    def asked(request: Any) -> None:
        if not request.url.startswith(("file:", "data:", "blob:")):
            troubles.append(request.url)

    def opened(path: Path, anchor: str = "", ready: str = "html.ready") -> Any:
        page = context.new_page()
        page.on("console", said)
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", asked)
        page.goto(path.resolve().as_uri() + anchor)
        page.wait_for_selector(ready, state="attached")
        return page

    yield opened
    context.close()
    assert not troubles


def draw_charts(page: Any) -> None:
    """Scroll through the page, so that every chart is drawn."""
    for figure in page.query_selector_all("figure.chart"):
        figure.scroll_into_view_if_needed()
        figure.wait_for_selector(".plot .main-svg", state="attached")


def cell(folder: Path, name: str) -> Path:
    return sorted((folder / "cells").glob(f"{name}*"))[0]


def column(page: Any, number: int) -> list[str]:
    """Texts of a column of the page's table of data."""
    return page.locator(f"table.data tbody td:nth-child({number})").all_inner_texts()


def sort(table: Any, name: str, direction: str) -> None:
    """Click on a column's header and wait for the order."""
    table.locator("th", has_text=name).click()
    table.locator(f"th.dt-ordering-{direction}", has_text=name).wait_for()


def test_columns_sort_by_their_numbers(site: Path, visit: Visit) -> None:
    page = visit(site / "index.html")
    table = page.locator("table.data")

    def values() -> list[float]:
        return [float(text.split()[0]) for text in column(page, 3) if text[0].isdigit()]

    before = values()
    sort(table, "Success", "desc")
    assert len(before) == 14
    assert values() == sorted(before, reverse=True) != before
    # With the keyboard, too.
    table.locator("th", has_text="Success").get_by_role("button").focus()
    page.keyboard.press("Enter")
    table.locator("th.dt-ordering-asc").wait_for()
    assert values() == sorted(before)
    # What is not known stands last, or first, never between numbers.
    sort(table, "Against base", "desc")
    known = [text != "\u2013" for text in column(page, 5)]
    assert known == sorted(known, reverse=True)
    assert set(known) == {True, False}


def test_tables_of_the_leaderboard_sort_and_lines_can_be_left_out(site: Path, visit: Visit) -> None:
    page = visit(cell(site, "pickcube-v1-floating-none"))
    table = page.locator(".sortable table").first
    sort(table, "Success", "asc")
    texts = table.locator("tbody td:nth-child(3)").all_inner_texts()
    values = [float(text.split()[0]) for text in texts]
    assert values == sorted(values)
    assert len(set(values)) > 2
    draw_charts(page)
    figure = page.locator("figure.chart").first
    lines = figure.locator(".plot .scatterlayer .trace")
    before = lines.count()
    button = figure.get_by_role("button", name="equivariant")
    button.click()
    assert lines.count() < before
    assert button.get_attribute("aria-pressed") == "false"
    button.click()
    assert lines.count() == before
    figure.get_by_role("button", name="single runs").click()
    assert lines.count() != before


def test_rows_are_filtered_and_the_address_keeps_it(site: Path, visit: Visit) -> None:
    page = visit(site / "runs.html")
    every = page.inner_text(".dt-info")
    for name, value, number in (("Agent", "equivariant", 2), ("Broken by", "action_gain", 13)):
        page.select_option(f"select[name='{name}']", value)
        assert set(column(page, number)) == {value}
    assert len(column(page, 1)) == 5
    assert "5 entries" in page.inner_text(".dt-info")
    again = visit(site / "runs.html", page.evaluate("location.hash"))
    assert column(again, 1) == column(page, 1)
    again.get_by_role("button", name="Show all").click()
    assert again.inner_text(".dt-info") == every
    # A cell with several values.
    again.select_option("select[name='Broken by']", "arm kinematics")
    assert set(column(again, 12)) == {"panda"}
    again.get_by_role("button", name="Show all").click()
    again.fill("input[type=search]", "wind")
    assert set(column(again, 13)) == {"wind"}


def hover_text(page: Any, figure: Any, marker: int = 0) -> str:
    """What appears beside a point of a chart."""
    figure.scroll_into_view_if_needed()
    point = figure.locator(".plot .points path").nth(marker)
    point.wait_for(state="attached")
    box = point.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    figure.locator(".hovertext").first.wait_for(state="attached")
    return figure.locator(".hovertext").first.text_content()


def test_points_tell_what_they_are(site: Path, visit: Visit) -> None:
    page = visit(cell(site, "pickcube-v1-floating-wind"))
    success, q, equivariance, directions = page.locator("figure.chart").all()
    assert "steps: " in hover_text(page, success)
    success.get_by_role("button", name="single runs").click()
    assert "[" in hover_text(page, success, success.locator(".plot .points path").count() - 1)
    assert "steps: \u2212" in hover_text(page, q)
    assert "0.31" in hover_text(page, equivariance)
    assert "\u2212180" in hover_text(page, directions)


def test_plotly_shows_names_as_they_are(hostile: Path, visit: Visit) -> None:
    """It reads markup, entities and %{...} in texts."""
    for address, name in (("img-src", EVIL[:12]), ("7-7-y", "{{ 7 * 7 }}%{y}&lt;b&gt;")):
        page = visit(cell(hostile, address))
        figure = page.locator("figure.chart").first
        assert name in figure.locator(".legend").inner_text()
        assert name in hover_text(page, figure)


def test_colours_follow_the_system_and_the_reader(whole: Path, visit: Visit) -> None:
    def background(page: Any) -> str:
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    white, dark = "rgb(255, 255, 255)", "rgb(20, 24, 31)"
    page = visit(sorted((whole / "cells").iterdir())[0])
    draw_charts(page)
    ink = "getComputedStyle(document.querySelector('.plot .xtick text')).fill"
    assert background(page) == white
    light_ink = page.evaluate(ink)
    page.emulate_media(color_scheme="dark")
    page.wait_for_selector("html[data-theme=dark]", state="attached")
    assert background(page) == dark
    assert page.evaluate(ink) != light_ink
    page.get_by_role("button", name="Use light colours").click()
    assert background(page) == white
    # Remembered on the next page, and in the documentation.
    for address in ("index.html", "docs/index.html"):
        page = visit(whole / address, ready="html")
        page.emulate_media(color_scheme="dark")
        assert page.evaluate("document.documentElement.dataset.theme") == "light"
        assert background(page) == white
        page.locator("[data-switch-theme]").click()
        assert background(page) == dark
        page.locator("[data-switch-theme]").click()


@pytest.mark.parametrize("visit", [390], indirect=True)
@pytest.mark.parametrize("kind", ["site", "hostile"])
def test_no_page_is_wider_than_a_phone_or_has_errors(
    kind: str, visit: Visit, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(kind)
    names = ("index", "findings") if kind == "site" else ("agents", "variants", "runs")
    folders = ("cells", "agents", "variants", "runs")
    firsts = [sorted((folder / name).glob("*.html"))[0] for name in folders]
    for path in [*(folder / f"{name}.html" for name in names), *firsts]:
        page = visit(path)
        draw_charts(page)
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= 390, (path, width)
        # Nor is the menu cut.
        boxes = [link.bounding_box() for link in page.locator(".site-header a").all()]
        assert max(box["x"] + box["width"] for box in boxes) <= 390
        assert page.evaluate("window.evil") is None
        # Plotly reads markup in texts.
        evil = "a[href^='javascript'], a[href*='evil.example'], img[src=x]"
        assert page.locator(evil).count() == 0
        page.close()


@pytest.mark.parametrize("visit", [390], indirect=True)
def test_first_columns_stay_and_results_are_beside_them(site: Path, visit: Visit) -> None:
    page = visit(site / "index.html")
    table = page.locator("table.data")
    first, success = (table.locator(f"tbody tr:first-child td:nth-child({n})") for n in (1, 3))
    assert success.bounding_box()["x"] < 300
    left = first.bounding_box()["x"]
    page.evaluate(
        "document.querySelector('table.data').closest('.dt-layout-cell').scrollLeft = 200"
    )
    assert first.bounding_box()["x"] == left
    assert success.bounding_box()["x"] < 150


def test_the_address_chooses_a_run(site: Path, visit: Visit) -> None:
    page = visit(site / "runs.html")
    link = page.locator("table.data tbody a[href*='wind']").last
    name = link.get_attribute("href").split("#")[1]
    link.click()
    page.wait_for_selector("#run h2")
    draw_charts(page)
    shown = page.inner_text("#run")
    assert "Repeat it" in shown
    chosen = page.locator(".runs-of a[aria-current]")
    assert chosen.get_attribute("id") == name
    assert chosen.get_attribute("title") == page.inner_text("#run h2")
    assert page.locator("#run figure.chart").count() == 3
    # Another run of the same cell, without a new page.
    other = page.locator(".runs-of a:not([aria-current])").first
    other_name = other.get_attribute("id")
    other.click()
    page.wait_for_selector(f"a[id='{other_name}'][aria-current]")
    assert page.inner_text("#run") != shown
    draw_charts(page)
    page.go_back()
    page.wait_for_selector(f"a[id='{name}'][aria-current]")
    assert page.inner_text("#run").split("\n")[0] == shown.split("\n")[0]


def test_the_documentation_is_searched_offline(whole: Path, visit: Visit) -> None:
    page = visit(whole / "docs" / "agents" / "partial.html", ready="html")
    page.click(".md-search__input")
    page.keyboard.type("divergence")
    page.wait_for_selector(".md-search-result__item")
    page.locator(".md-search-result__link").first.click()
    page.wait_for_url("**/metrics.html**")
