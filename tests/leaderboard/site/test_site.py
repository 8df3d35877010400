"""The pages of results: what they show, where they lead, what they refuse and escape."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.command import site as verb
from symsteer.leaderboard.defects import read_audit
from symsteer.leaderboard.page import render_page
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.sections import Findings, View, claims
from symsteer.leaderboard.site import build, libraries
from symsteer.leaderboard.site.build import generate
from symsteer.leaderboard.site.docs import Documentation
from symsteer.leaderboard.site.libraries import as_script
from symsteer.leaderboard.site.pages import options_of
from symsteer.leaderboard.site.results import Results
from symsteer.leaderboard.study import PAPER, read_study
from symsteer.leaderboard.text import SPACE, compact, interval, number
from tests.leaderboard.record_factory import make_evaluation, make_record
from tests.leaderboard.site.conftest import EVIL, SIDE_BY_SIDE, picture, write_all
from tests.leaderboard.site.pages import Page, dead_links, read_pages
from tests.marks import need

need("site")

TAGS = frozenset(
    {
        *("html", "head", "meta", "title", "link", "script", "body", "header", "nav", "main"),
        *("section", "footer", "h1", "h2", "h3", "p", "a", "span", "strong", "em", "small", "i"),
        *("br", "code", "pre", "blockquote", "ul", "ol", "li", "dl", "dt", "dd", "div", "details"),
        *("summary", "table", "caption", "thead", "tbody", "tr", "th", "td", "figure", "video"),
        *("figcaption", "img", "svg", "path", "circle", "button", "label", "select", "option"),
    }
)
STYLES = re.compile(r"text-align:(left|right)")


def page_of(folder: Path, kind: str, text: str) -> Page:
    """The page of a kind whose heading has a text."""
    for path in sorted((folder / kind).glob("*.html")):
        found = re.search(r"<h1>(.*?)</h1>\s*(<p class=\"lede\">.*?</p>)?", path.read_text(), re.S)
        if found and text in found[0]:
            return Page(path)
    raise AssertionError(f"no page of {text!r}")


def runs_of(folder: Path) -> list[dict[str, Any]]:
    """What the script can show of every run."""
    found = []
    for page in read_pages(folder / "runs").values():
        (data,) = page.data
        for address, run in data["runs"].items():
            assert address in page.anchors
            found.append(run | {"record": data["shared"] | run["record"], "page": page})
    return found


@pytest.mark.parametrize("kind", ["site", "hostile"])
def test_nothing_of_a_record_becomes_markup(kind: str, request: pytest.FixtureRequest) -> None:
    pages = read_pages(request.getfixturevalue(kind))
    assert not dead_links(pages)
    for path, page in pages.items():
        assert {tag for tag, _ in page.elements} <= TAGS, path
        for tag, attrs in page.elements:
            assert not [name for name in attrs if name.startswith("on")], (path, tag, attrs)
            assert STYLES.fullmatch(attrs.get("style", "text-align:left")), (path, tag, attrs)
            # Scripts are files or data; nothing runs that stands in a page.
            assert tag != "script" or attrs.get("src") or attrs["type"] == "application/json"
        policy = next(a for t, a in page.elements if "http-equiv" in a)["content"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in re.search(r"script-src ([^;]*)", policy)[1]  # type: ignore[index]
        assert not set(path.read_text()) & set(map(chr, [*range(9), *range(11, 32), 0x202E]))


def test_hostile_texts_are_shown_as_they_are(hostile: Path) -> None:
    index = Page(hostile / "index.html")
    for text in (EVIL, "../../../../etc/passwd", "x" * 120, "{{ 7 * 7 }}%{y}&lt;b&gt;", "a-b"):
        assert text in index.text
    run = next(run for run in runs_of(hostile) if run["agent"] == EVIL)
    assert sum(EVIL in text for text in run["record"].values()) >= 12
    assert not run["command"]
    (failed,) = [run for run in runs_of(hostile) if run["name"].endswith("standard-99")]
    for part in ("facts", "record"):
        assert failed[part]["failure"].count('<img src=x onerror="window.evil=1">') == 3


def test_names_stay_in_their_folders_and_do_not_collide(hostile: Path) -> None:
    folders = {path.name for path in hostile.iterdir() if path.is_dir()}
    assert folders == {"assets", *build.FOLDERS} - {"media"}
    assert {path.name for path in hostile.parent.iterdir()} == {"runs", "site"}
    for kind in ("agents", "cells", "variants", "runs"):
        for path in (hostile / kind).iterdir():
            assert build.OWN.fullmatch(path.name), path
            assert len(path.name) < 90
    alike = [path.name for path in (hostile / "agents").glob("a-b-*.html")]
    assert len(alike) == 2
    headings = {Page(hostile / "agents" / name).text.split("agent")[1][:40] for name in alike}
    assert len(headings) == 2


def test_numbers_are_those_of_the_leaderboard(site: Path) -> None:
    summary = summarize(load_runs([site.parent / "runs"]))
    results = Results(Findings(summary, {}, read_study(PAPER)), PAPER, Documentation(False))
    index = Page(site / "index.html").text
    rows = [(table, row) for table in summary.tables for row in table.rows if row.success]
    assert len(rows) == 14
    for table, row in rows:
        cell = Page(site / results.cell(table.key))
        assert interval(row.success) in index
        assert number(row.success.value) in cell.text
        # Charts hold the same curve as the table's last checkpoint.
        traces = cell.data[0]["traces"]
        (curve,) = [t for t in traces if t["name"] == row.agent and not t["single"]]
        assert curve["y"][-1] == pytest.approx(row.last.value, rel=1e-3)


def test_unfinished_runs_are_drawn_apart_and_directions_where_they_are_known(site: Path) -> None:
    cell = page_of(site, "cells", "wind:0.2..0.8")
    for chart in cell.data[:2]:
        runs = {one["label"]: one["cross"] > 0 for one in chart["traces"] if one["single"]}
        assert runs == {"seed 7": False, "seed 8, failed": True}
    directions = cell.data[-1]
    assert [one["name"] for one in directions["legend"]] == ["standard", "equivariant"]
    assert directions["traces"][0]["x"] == list(range(-180, 181, 45))
    assert "before records held the directions" in page_of(site, "cells", "action_gain:0.5").text


def test_the_findings_are_those_of_the_page(site: Path) -> None:
    summary = summarize(load_runs([site.parent / "runs"]))
    found = Findings(summary, read_audit(), read_study(PAPER))
    text = Page(site / "findings.html").text
    for outcome in found.of(claims.SECTION):
        assert outcome.claim.name in text
        if outcome.effect:
            shown = interval(outcome.effect.interval(), sign=True, digits=3)
            assert all(part in text for part in shown.split(SPACE, 1))
    for cell in re.findall(r"\d\.\d\d \(worst \d\.\d\d\)", render_page(View(found))):
        assert cell in text


def test_a_run_page_has_all_of_its_record(site: Path) -> None:
    run = next(r for r in load_runs([site.parent / "runs"]) if r.record.status == "failed")
    record = run.record
    (shown,) = [one for one in runs_of(site) if one["facts"]["status"] == "failed"]
    every = record.model_dump(mode="json", by_alias=True, exclude={"evaluations"})
    texts = {key: value for key, value in options_of(every) if value != "null"}
    assert shown["record"] == texts
    assert texts.keys() >= {"failure", "config_hash", "config.demonstrations.count"}
    episodes = shown["episodes"]
    seeds = record.evaluations[0].episodes.seed
    assert episodes["seeds"] == seeds
    assert len(episodes["rows"]) == len(record.evaluations) == 3
    for row, evaluation in zip(episodes["rows"], record.evaluations, strict=True):
        assert [bool(cell[0]) for cell in row["cells"]] == evaluation.episodes.success_once
        assert [cell[1] for cell in row["cells"]] == evaluation.episodes.return_
    header, *_, last = shown["evaluations"]
    measured = record.evaluations[-1].diagnostics
    assert {name: compact(measured[name]) for name in measured}.items() <= {
        *zip(header, last, strict=True)
    }


def test_a_record_that_is_set_aside_says_so(site: Path) -> None:
    aside = summarize(load_runs([site.parent / "runs"])).set_aside
    assert len(aside) == 1
    pages = {run["page"].path for run in runs_of(site)}
    assert len(pages) == len(summarize(load_runs([site.parent / "runs"])).tables) + 1
    (page,) = [path for path in pages if path.name.startswith("set-aside")]
    (shown,) = [run for run in runs_of(site) if run["page"].path == page]
    assert shown["name"] == aside[0].record.run_id
    assert "These records are set aside" in Page(page).text
    assert "set aside" in Page(site / "runs.html").text
    assert aside[0].record.run_id in Page(site / "findings.html").text


def test_films_and_paths_are_copied_to_their_run_or_cell(site: Path) -> None:
    # Neither what only is called a film, nor a link, which may lead anywhere.
    assert sorted(path.suffix for path in (site / "media").iterdir()) == [".mp4", ".png"]
    films = [film for run in runs_of(site) for film in run["films"]]
    assert [(Path(address).suffix, is_film) for address, _, is_film in films] == [
        (".mp4", True),
        (".png", False),
    ]
    assert all((site / address).is_file() for address, *_ in films)
    (cell,) = [
        page
        for page in read_pages(site / "cells").values()
        if any(tag == "video" for tag, _ in page.elements)
    ]
    assert f"film-{SIDE_BY_SIDE[0]}" in cell.text


def test_the_same_records_give_the_same_bytes_and_stale_pages_go(
    site: Path, tmp_path: Path
) -> None:
    def files_of(folder: Path) -> dict[Path, bytes]:
        files = (path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder): path.read_bytes() for path in files}

    out = tmp_path / "site"
    generate([site.parent / "runs"], out, PAPER, docs=False)
    assert files_of(out) == files_of(site)
    (out / "runs" / "mine.txt").write_text("kept")
    (out / "docs").mkdir()
    (out / "docs" / "index.html").write_text("of an earlier site")
    generate([site.parent / "runs" / str(index) for index in range(3)], out, PAPER, docs=False)
    assert len(runs_of(out)) == 3
    assert len(list((out / "runs").glob("*.html"))) == 1
    assert (out / "runs" / "mine.txt").read_text() == "kept"
    assert not (out / "docs").exists()
    assert not dead_links(read_pages(out))


def test_runs_that_have_not_ended_have_pages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begun = make_evaluation([1, 0], env_steps=0)
    write_all(
        [make_record([], "running"), make_record([begun], "interrupted", agent="base", seed=2)],
        tmp_path / "runs",
    )
    assert verb((tmp_path / "runs",), tmp_path / "site", docs=False) == 0
    said = f"wrote {tmp_path / 'site' / 'index.html'}: the pages of 2 records"
    assert said in capsys.readouterr().out
    assert not dead_links(read_pages(tmp_path / "site"))
    (running,) = [run for run in runs_of(tmp_path / "site") if run["facts"]["status"] == "running"]
    assert not running["charts"]
    assert not running["episodes"]
    assert "1\u00a0running" in Page(tmp_path / "site" / "index.html").text


def test_mistakes_are_named(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = (site.parent / "runs",)
    full = tmp_path / "full"
    full.mkdir()
    (full / "index.html").write_text("<h1>My page</h1>")
    (tmp_path / "empty").mkdir()
    for arguments, text in (
        ({"records": (tmp_path / "nothing",)}, "does not exist"),
        ({"records": runs, "out": full}, "holds something else than a site"),
        ({"records": runs, "out": full / "index.html"}, "holds something else than a site"),
        ({"records": runs, "study": "papers"}, "did you mean 'paper'"),
        ({"records": runs, "audit": tmp_path / "empty"}, "holds no map.png"),
    ):
        with pytest.raises(UserError, match=re.escape(text)):
            verb(**{"out": tmp_path / "site", "docs": False} | arguments)  # type: ignore[arg-type]
    assert (full / "index.html").read_text() == "<h1>My page</h1>"
    assert not (tmp_path / "site").exists()
    monkeypatch.setattr(libraries.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=re.escape('pip install "symsteer[site]"')):
        verb(runs, tmp_path / "site", docs=False)


def test_maps_of_an_audit_folder(site: Path, tmp_path: Path) -> None:
    for strength in ("0.5", "1"):
        folder = tmp_path / "audit" / strength
        folder.mkdir(parents=True)
        settings = {"task": "PushCube-v1", "embodiment": "floating", "variant": f"wind:{strength}"}
        (folder / "audit.json").write_text(json.dumps({"settings": settings}))
        (folder / "map.png").write_bytes(picture())
    runs, out = [site.parent / "runs" / "0"], tmp_path / "site"
    generate(runs, out, PAPER, tmp_path / "audit", docs=False)
    page = page_of(out, "variants", "wind")
    pictures = [attrs["alt"] for tag, attrs in page.elements if tag == "img"]
    assert pictures == [
        "PushCube-v1, floating, wind:1, seen from above",
        "PushCube-v1, floating, wind:0.5, seen from above",
    ]
    assert not dead_links(read_pages(out))
    # The committed audit's numbers, with the unbroken control at strength 0.
    traces = page.data[0]["traces"]
    assert {one["name"].split(",")[0] for one in traces} >= {"PushCube-v1", "StackCube-v1"}
    assert all(one["x"][0] == 0 and one["x"][-1] == 1 for one in traces)
    (tmp_path / "audit" / "1" / "audit.json").write_text("[]")
    with pytest.raises(UserError, match="no result of an audit"):
        generate(runs, out, PAPER, tmp_path / "audit", docs=False)


def test_a_module_becomes_a_script() -> None:
    module = "var a=1;export{a as default,b};\n/* licence */"
    assert as_script(module) == (
        '(()=>{"use strict";var a=1;globalThis.SymSteerTables={"default":a,"b":b};\n'
        "/* licence */\n})();\n"
    )
    for damaged in ("var a=1;", module * 2):
        with pytest.raises(UserError, match="another form"):
            as_script(damaged)
