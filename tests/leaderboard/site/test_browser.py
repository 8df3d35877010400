"""The pages in headless Chromium, from disk: sort, filter, hover, dark, narrow, no errors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.leaderboard.site.browser import Visit, chromium, opened
from tests.leaderboard.site.conftest import EVIL

pytestmark = [
    pytest.mark.long,
    pytest.mark.browser,
    pytest.mark.skipif(chromium() is None, reason="there is no Chromium on the PATH"),
]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with opened() as found:
        yield found


@pytest.fixture
def context(browser: Any) -> Iterator[Any]:
    found = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    found.set_default_timeout(20_000)
    yield found
    found.close()


def some_pages(folder: Path) -> list[Path]:
    """One page of each kind."""
    found = [folder / f"{n}.html" for n in ("index", "findings", "agents", "variants", "runs")]
    for kind in ("cells", "agents", "variants", "runs"):
        pages = sorted((folder / kind).glob("*.html"))
        found.append(pages[0])
    return found


def column(visit: Visit, number: int) -> list[str]:
    """Texts of a column of the page's table of data."""
    return visit.page.eval_on_selector_all(
        f"table.data tbody td:nth-child({number})", "cells => cells.map(cell => cell.innerText)"
    )


def sort(table: Any, name: str, direction: str) -> Any:
    """Click on a column's header and wait for the order; returns the header."""
    header = table.locator("th", has_text=name)
    header.click()
    table.locator(f"th.dt-ordering-{direction}", has_text=name).wait_for()
    return header


def test_columns_sort_by_their_numbers(site: Path, context: Any) -> None:
    visit = Visit(context, site / "index.html")
    table = visit.page.locator("table.data")
    before = column(visit, 7)
    header = sort(table, "Success", "desc")
    falling = [float(text.split()[0]) for text in column(visit, 7) if text[0].isdigit()]
    assert len(falling) == len([text for text in before if text[0].isdigit()]) == 14
    assert falling == sorted(falling, reverse=True) != [float(t.split()[0]) for t in before[:14]]
    # With the keyboard, too.
    header.get_by_role("button").focus()
    visit.page.keyboard.press("Enter")
    table.locator("th.dt-ordering-asc").wait_for()
    rising = [float(text.split()[0]) for text in column(visit, 7) if text[0].isdigit()]
    assert rising == falling[::-1]
    # What is not known stands last, or first, never between numbers.
    sort(table, "Against base", "desc")
    texts = column(visit, 8)
    known = [text != "\u2013" for text in texts]
    assert known == sorted(known, reverse=True)
    assert any(known)
    assert not all(known)
    assert not visit.troubles


def test_tables_of_the_leaderboard_sort_too(site: Path, context: Any) -> None:
    visit = Visit(context, sorted((site / "cells").glob("pickcube*none*"))[0])
    table = visit.page.locator(".sortable table").first
    sort(table, "Success", "asc")
    texts = table.locator("tbody td:nth-child(3)").all_inner_texts()
    values = [float(text.split()[0]) for text in texts]
    assert values == sorted(values)
    assert len(set(values)) > 2


def test_rows_are_filtered_and_the_address_keeps_it(site: Path, context: Any) -> None:
    visit = Visit(context, site / "runs.html")
    page = visit.page
    every = page.inner_text(".dt-info")
    page.select_option("select[name=Agent]", "equivariant")
    assert set(column(visit, 6)) == {"equivariant"}
    page.select_option("select[name='Broken by']", "action_gain")
    assert set(column(visit, 4)) == {"action_gain"}
    assert len(column(visit, 1)) == 5
    assert "5 entries" in page.inner_text(".dt-info")
    anchor = page.evaluate("location.hash")
    again = Visit(context, site / "runs.html", anchor)
    assert column(again, 1) == column(visit, 1)
    again.page.get_by_role("button", name="Show all").click()
    assert again.page.inner_text(".dt-info") == every
    page.select_option("select[name='Broken by']", "arm kinematics")
    assert set(column(visit, 3)) == {"panda"}
    page.select_option("select[name='Broken by']", "")
    page.select_option("select[name=Agent]", "")
    page.select_option("select[name=Status]", "set aside")
    assert len(column(visit, 1)) == 1
    page.select_option("select[name=Status]", "")
    page.fill("input[type=search]", "wind")
    assert set(column(visit, 4)) == {"wind"}
    assert not visit.troubles + again.troubles


def hover_text(visit: Visit, figure: Any, marker: int = 0) -> str:
    """What appears beside a point of a chart."""
    figure.scroll_into_view_if_needed()
    point = figure.locator(".plot .points path").nth(marker)
    point.wait_for(state="attached")
    box = point.bounding_box()
    visit.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    figure.locator(".hovertext").first.wait_for(state="attached")
    return figure.locator(".hovertext").first.text_content()


def test_points_tell_what_they_are(site: Path, context: Any) -> None:
    visit = Visit(context, sorted((site / "cells").glob("pickcube*wind*"))[0])
    success, q, equivariance, directions = visit.page.locator("figure.chart").all()
    assert "steps: " in hover_text(visit, success)
    success.get_by_role("button", name="single runs").click()
    assert "[" in hover_text(visit, success, success.locator(".plot .points path").count() - 1)
    assert "steps: \u2212" in hover_text(visit, q)
    assert "0.31" in hover_text(visit, equivariance)
    assert "\u2212180" in hover_text(visit, directions)
    assert not visit.troubles


def test_plotly_shows_names_as_they_are(hostile: Path, context: Any) -> None:
    """It reads markup, entities and %{...} in texts."""
    for page, name in (("img-src", EVIL[:12]), ("7-7-y", "{{ 7 * 7 }}%{y}&lt;b&gt;")):
        visit = Visit(context, sorted((hostile / "cells").glob(f"{page}*"))[0])
        figure = visit.page.locator("figure.chart").first
        assert name in figure.locator(".legend").inner_text()
        assert name in hover_text(visit, figure)
        assert not visit.troubles


def test_lines_can_be_left_out(site: Path, context: Any) -> None:
    visit = Visit(context, sorted((site / "cells").glob("pickcube*none*"))[0])
    visit.draw_charts()
    figure = visit.page.locator("figure.chart").first
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
    assert not visit.troubles


def test_colours_follow_the_system_and_the_reader(whole: Path, context: Any) -> None:
    def background(page: Any) -> str:
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    white, dark = "rgb(255, 255, 255)", "rgb(20, 24, 31)"
    visit = Visit(context, sorted((whole / "cells").iterdir())[0])
    visit.draw_charts()
    ink = "getComputedStyle(document.querySelector('.plot .xtick text')).fill"
    assert background(visit.page) == white
    light_ink = visit.page.evaluate(ink)
    visit.page.emulate_media(color_scheme="dark")
    visit.page.wait_for_selector("html[data-theme=dark]", state="attached")
    assert background(visit.page) == dark
    assert visit.page.evaluate(ink) != light_ink
    visit.page.get_by_role("button", name="Use light colours").click()
    assert background(visit.page) == white
    # Remembered on the next page, and in the documentation.
    for path in (whole / "index.html", whole / "docs" / "index.html"):
        page = context.new_page()
        page.emulate_media(color_scheme="dark")
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.dataset.theme") == "light"
        assert background(page) == white
        page.locator("[data-switch-theme]").click()
        assert background(page) == dark
        page.locator("[data-switch-theme]").click()
    assert not visit.troubles


@pytest.mark.parametrize("kind", ["site", "hostile"])
def test_no_page_is_wider_than_a_phone_or_has_errors(
    kind: str, browser: Any, request: pytest.FixtureRequest
) -> None:
    context = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme="dark")
    for path in some_pages(request.getfixturevalue(kind)):
        visit = Visit(context, path)
        visit.draw_charts()
        width = visit.page.evaluate("document.documentElement.scrollWidth")
        assert width <= 390, (path, width)
        assert not visit.troubles, path
        assert visit.page.evaluate("window.evil") is None
        # Plotly reads markup in texts.
        assert (
            visit.page.locator("a[href^='javascript'], a[href*='evil.example'], img[src=x]").count()
            == 0
        )
        visit.page.close()
    context.close()


def test_the_documentation_is_searched_offline(whole: Path, context: Any) -> None:
    page = context.new_page()
    troubles: list[str] = []
    page.on("pageerror", lambda error: troubles.append(str(error)))
    page.on("console", lambda m: troubles.append(m.text) if m.type == "error" else None)
    page.on("request", lambda r: None if r.url.startswith("file:") else troubles.append(r.url))
    page.goto((whole / "docs" / "agents" / "partial.html").as_uri())
    page.click(".md-search__input")
    page.keyboard.type("divergence")
    page.wait_for_selector(".md-search-result__item")
    page.locator(".md-search-result__link").first.click()
    page.wait_for_url("**/metrics.html**")
    assert not troubles
