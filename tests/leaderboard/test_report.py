"""The generated files: determinism, escaping, figures; `--verify`; the command line."""

from __future__ import annotations

import csv
import math
import os
import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import numpy as np
import pytest

from symsteer.files import csv_text
from symsteer.leaderboard import command, paths
from symsteer.leaderboard import page as page_module
from symsteer.leaderboard.defects import AuditedDefect
from symsteer.leaderboard.page import figures_of, other_files, render_page
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.report import differences, generate, other_versions, render
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.study import PAPER, read_study
from symsteer.leaderboard.text import code, compact, count, number, relative_link, slug
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import (
    LEARNING,
    audit_of,
    make_cell,
    make_curve,
    make_evaluation,
    make_record,
    snapshot,
    summary_of,
    view_of,
)

REPOSITORY = Path(__file__).parents[2]


def write_runs(folder: Path, seeds: int = 2) -> None:
    """A grid like the demo's: two variants, references and three agents, with one failure."""
    generator = np.random.default_rng(0)
    for variant in ("none", "action_gain:0.5"):
        for seed in range(seeds):
            for agent in ("base", "zero", "standard", "equivariant", "approximate"):
                status = "finished"
                if agent in LEARNING:
                    shift = 6.0 if (agent, variant) == ("standard", "none") else 0.0
                    curve = make_curve(generator, np.linspace(0.35, 0.7, 6), q_shift=shift)
                    if (agent, variant, seed) == ("approximate", "none", 1):
                        status, curve = "failed", curve[:3]
                else:
                    curve = [make_evaluation(generator.random(100) < 0.35)]
                record = make_record(curve, status, agent=agent, seed=seed, variant=variant)
                name = f"{agent}-{variant.replace(':', '=')}-{seed}"
                write_record(record, folder / name / "record.json")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of `runs` and of their `board`."""
    folder = tmp_path_factory.mktemp("page")
    write_runs(folder / "runs")
    generate([folder / "runs"], folder / "board")
    return folder


def test_the_page_shows_every_run(page: Path) -> None:
    text = (page / "board" / "LEADERBOARD.md").read_text()
    for path in (page / "runs").iterdir():
        assert f"(../runs/{path.name.replace('=', '%3D')}/record.json)" in text
    second = text[text.index("Q-values, symmetry and cost") :]
    assert re.search(r"^\| `standard` \| 2/2 \|", second, re.M)
    assert "\u2020" in text
    assert str(page) not in text


def test_tables_are_well_formed(page: Path) -> None:
    lines = (page / "board" / "LEADERBOARD.md").read_text().splitlines()
    widths: list[int] = []
    for line in lines:
        if line.startswith("|"):
            widths.append(len(re.split(r"(?<!\\)\|", line)) - 2)
        elif widths:
            assert len(set(widths)) == 1
            assert 2 < widths[0] <= 10
            assert len(widths) > 2
            widths = []


def test_figures_are_shown_and_are_svg_without_dates_and_texts(page: Path) -> None:
    text = (page / "board" / "LEADERBOARD.md").read_text()
    shown = re.findall(r"!\[[^]]+\]\((figures/[^)]+\.svg)\)", text)
    files = sorted(f"figures/{p.name}" for p in (page / "board" / "figures").iterdir())
    assert sorted(shown) == files
    kinds = ["answer", "improvement", "map-floating", "profiles", "q-pickcube", "success-pickcube"]
    assert [name.startswith(f"figures/{kind}") for name, kind in zip(files, kinds, strict=True)]
    for name in files:
        data = (page / "board" / name).read_bytes()
        root = ElementTree.fromstring(data)
        assert root.tag.endswith("svg")
        # No text elements: outlines look the same everywhere.
        assert not root.findall(".//{http://www.w3.org/2000/svg}text")
        assert b"dc:date" not in data
        assert b"Matplotlib v" not in data


def test_the_audit_changes_the_page() -> None:
    records = make_cell({"standard": 0.5, "equivariant": 0.7})
    audits = ({}, audit_of({"none": 0.1}), audit_of({"none": 0.2}))
    assert len({render_page(view_of(records, audit=audit)) for audit in audits}) == 3


def test_a_study_says_where_areas_begin(tmp_path: Path) -> None:
    """A success that is there from the first update on: half of the curve is warm-up."""
    options = {"agent_options": {"warmup": 6_250}, "policy": {"execute": 4}}
    steps = {0: 0, 24_999: 0, 25_000: 1, 50_000: 1}
    curve = [make_evaluation([x] * 4, step, step == 50_000) for step, x in steps.items()]
    write_record(make_record(curve, **options), tmp_path / "record.json")
    areas, told = {}, {}
    for begin in ("start", "first update"):
        (tmp_path / "mine.toml").write_text(f'area_from = "{begin}"\n')
        out = tmp_path / begin
        generate([tmp_path / "record.json"], out, study=str(tmp_path / "mine.toml"))
        (row,) = csv.DictReader((out / "leaderboard.csv").open())
        areas[begin] = float(row["auc"])
        told[begin] = any("begin with the first update" in x.read_text() for x in out.rglob("*.md"))
    assert areas == pytest.approx({"start": 0.5, "first update": 1.0}, abs=1e-3)
    assert told == {"start": False, "first update": True}


def test_stale_files_go_and_foreign_ones_stay(tmp_path: Path) -> None:
    """A study without statements has no PAPER.md; another file of this name is not ours."""
    write_record(make_record(agent="base"), tmp_path / "record.json")
    out = tmp_path / "board"
    generate([tmp_path / "record.json"], out)
    stale = out / "figures" / f"q-{slug('OldTask-v1', 'floating')}.svg"
    foreign, paper = out / "figures" / "mine.svg", out / "PAPER.md"
    for file in (stale, foreign):
        file.write_text("")
    assert paper.exists()
    generate([tmp_path / "record.json"], out, study="first")
    assert (stale.exists(), foreign.exists(), paper.exists()) == (False, True, False)
    paper.write_text("# The paper")
    generate([tmp_path / "record.json"], out, study="first")
    assert paper.read_text() == "# The paper"


def test_a_large_leaderboard_has_pages_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have what the one page has, their links lead to files, and old ones go."""
    records = make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.7})
    for index, record in enumerate(records):
        write_record(record, tmp_path / f"{index}.json")
    out = tmp_path / "board"
    generate([tmp_path], out)
    whole = (out / "LEADERBOARD.md").read_text()
    assert not (out / "pages").exists()
    monkeypatch.setattr(page_module, "LARGEST", 0)
    generate([tmp_path], out)
    pages = sorted((out / "pages").glob("*.md"))
    texts = [path.read_text() for path in (out / "LEADERBOARD.md", *pages)]
    tables = [line for line in whole.splitlines() if line.startswith("|")]
    assert sorted(tables) == sorted(
        line.replace("](../", "](")
        for text in texts
        for line in text.splitlines()
        if line.startswith("|")
    )
    assert len(pages) == 3
    for path in (out / "LEADERBOARD.md", *pages):
        for link in re.findall(r"\]\(([^)#:]+)\)", path.read_text()):
            assert (path.parent / unquote(link)).exists() or link.startswith("../docs"), link
    old, foreign = out / "pages" / f"{slug('OldTask-v1')}.md", out / "pages" / "mine.md"
    for path in (old, foreign):
        path.write_text("")
    generate([tmp_path], out)
    assert (old.exists(), foreign.exists()) == (False, True)


# Hostile records

TITLES = r"[A-Z][\w' ,-]+"
HEADINGS = (
    *("Leaderboard", "What a wrong choice costs", "Which agent, in which world", "Verdicts"),
    "Details",
    *("Unbroken symmetry", "A task that the map does not know"),
)
HOSTILE = [
    "<script>alert(1)</script>",
    "x`</td><img src=x onerror=alert(1)>`|$a$\n# H [l](javascript:alert(1))",
    "a|b|c\\|d",
    "[click](javascript:alert(1))",
    "![x](https://evil.example/x.png)",
    "https://evil.example www.evil.example me@evil.example",
    "line\nbreak\r\n# Heading\n| a | b |",
    "../../../etc/passwd",
    "``` ` `` ",
    "$x^2$ \\frac{1}{0} <!-- --> ]]>",
    "\u202eright to left\u0000\u0007",
    "=HYPERLINK(1)",
    "*bold* _it_ ~~no~~ &lt; &#x3c;",
]


def test_hostile_text_stays_text_in_every_section(tmp_path: Path) -> None:
    """In names and failures of every kind, and of finished runs in a hostile, audited cell."""
    markdown = pytest.importorskip("markdown_it", exc_type=ImportError)
    text = HOSTILE[1]
    rates = {"base": 0.3, "standard": 0.5, "equivariant": 0.6, text: 0.7, f"{text}2": 0.4}
    place = {"task": text, "embodiment": text}
    records = make_cell(rates, variant=text, **place) + make_cell(rates, **place)
    records += make_cell({"standard": 0.5}, task="a; rm -rf b", seeds=1)
    audit = {
        (text, text, code_, "C8"): AuditedDefect(Interval(0.1, 0.1, 0.1), "tool")
        for code_ in (text, "none")
    }
    for text in HOSTILE:
        demonstrations = {"mode": text, "count": 3, "seed": 0}
        names = place | dict.fromkeys(("variant", "agent"), text)
        curve = [make_evaluation([1, 0], q_mean=-1.0)]
        record = make_record(curve, **names, demonstrations=demonstrations)
        data = record.model_dump(by_alias=True)
        data["base_policy"] |= {"name": text, "group": text, "warning": text}
        data["provenance"] |= {"device": text, "platform": text, "packages": {text: text}}
        data |= {"status": "failed", "failure": text}
        data["evaluations"][0]["final"] = False
        records.append(type(record).model_validate(data))
    for index, record in enumerate(records):
        record.run_id = f"run-{index}"
    files = render(summary_of(records).runs, tmp_path, audit, read_study(PAPER))
    allowed = re.compile(
        r"(LEADERBOARD|PAPER)\.md|(leaderboard|records)\.csv|figures/[a-z0-9-]+.svg"
    )
    assert all(allowed.fullmatch(name) for name in files)
    assert sum(name.startswith("figures/map-") for name in files) == 1
    for name, data in files.items():
        if name.endswith(".svg"):
            ElementTree.fromstring(data)
        if name.endswith(".csv"):
            cells = [cell for line in csv.reader(data.decode().splitlines()) for cell in line]
            assert not any(cell.startswith(("=", "@")) for cell in cells)
    page = files["LEADERBOARD.md"].decode()
    parser = markdown.MarkdownIt("commonmark").enable(["table", "strikethrough"])
    tokens = [token for block in parser.parse(page) for token in [block, *(block.children or [])]]
    raw = {t.content.strip() for t in tokens if t.type in ("html_block", "html_inline")}
    assert all(re.fullmatch(rf"<br>|</?details>(\n<summary>{TITLES}</summary>)?", r) for r in raw)
    links = {str(t.attrs.get("href") or t.attrs.get("src")) for t in tokens if t.attrs} - {"None"}
    ours = re.compile(r"records.csv|PAPER.md|figures/[\w.-]+|(\.\./)*[\w/-]*\d+\.json")
    assert all(ours.fullmatch(link) for link in links)
    headings = [tokens[i + 1].content for i, t in enumerate(tokens) if t.type == "heading_open"]
    broken = ("Broken by `", "Broken by arm kinematics", "`")
    assert [h for h in headings if not h.startswith((*HEADINGS, *broken))] == []
    plain = " ".join(t.content for t in tokens if t.type == "text")
    for word in ("evil", "alert", "passwd"):
        assert word not in plain
    assert "symsteer audit --task a" not in page


def test_code_spans_cannot_be_left() -> None:
    assert code("a`b|c\\d\ne") == "`a'b\u00a6c/d e`"
    assert code("  ") == code("") == "\u2013"
    assert len(code("x" * 1000)) == 302


def test_links_do_not_spell_out_this_machine() -> None:
    assert relative_link(Path("/a/b/runs/x y/record.json"), Path("/a/b/board")) == (
        "../runs/x%20y/record.json"
    )
    assert relative_link(Path("/home/me/record.json"), Path("/var/tmp/board/now")) is None


def test_numbers_are_readable() -> None:
    assert number(-0.004) == "0.00"
    assert number(-0.126) == "\u22120.13"
    assert number(None) == "\u2013"
    assert number(0.1, sign=True) == "+0.10"
    assert number(0.0, sign=True) == "0.00"
    texts = {0.0: "0", 3.14159: "3.14", -17.25: "\u221217.2", 22_998: "22998", 9e6: "9.0e6"}
    assert {value: compact(value) for value in texts} == texts
    assert compact(2.3e-7) == "2.3e\u22127"
    counts = {0: "0", 950: "950", 1_200: "1.2\u00a0k", 50_000: "50\u00a0k", 2.5e6: "2.5\u00a0M"}
    assert {value: count(value) for value in counts} == counts


# What is on the disk is what the records give


def test_each_file_that_differs_has_its_line(
    page: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(page, tmp_path / "copy")
    board = tmp_path / "copy" / "board"
    text, table = board / "LEADERBOARD.md", board / "leaderboard.csv"
    text.write_text(text.read_text().replace("## Details", "## Detail", 1))
    # The line ends that a careless checkout makes.
    table.write_bytes(table.read_bytes().replace(b"\n", b"\r\n"))
    first, second, *_ = sorted((board / "figures").iterdir())
    first.unlink()
    second.write_bytes(second.read_bytes() + b"\n")
    stale = board / "figures" / f"q-{slug('OldTask-v1', 'floating')}.svg"
    for file in (stale, board / "figures" / "mine.svg", board / "NOTES.md"):
        file.write_text("")
    before = snapshot(board.parent)
    assert main(["--verify", str(board.parent / "runs"), "--out", str(board)]) == 1
    assert snapshot(board.parent) == before
    shown = capsys.readouterr()
    assert shown.err.startswith("error: 5 files")
    assert shown.err.count("\n") == 1
    lines = dict(line.split(": ", 1) for line in shown.out.splitlines())
    lines.pop("note", None)  # of other versions
    number = text.read_text().splitlines().index("## Detail") + 1
    assert lines.pop(str(second)).startswith("differs from line ")
    assert lines == {
        str(text): f"differs from line {number} on",
        str(table): "differs from line 1 on",
        str(first): "missing",
        str(stale): "no record gives this file",
    }


def test_another_kind_of_machine_gives_the_same_bytes(page: Path, tmp_path: Path) -> None:
    """Another order, folder, home, style, time zone, hash seed, processor, number of threads."""
    (tmp_path / "matplotlibrc").write_text("font.size: 20\nlines.linewidth: 5\npath.sketch: 1,2,3")
    environment = os.environ | {
        "PYTHONHASHSEED": "7",
        "HOME": str(tmp_path),
        "MPLCONFIGDIR": str(tmp_path),
        "LC_ALL": "C",
        "TZ": "Asia/Tokyo",
        "OMP_NUM_THREADS": "2",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
        "PYTHONPATH": str(REPOSITORY),
    }
    runs = map(str, sorted((page / "runs").iterdir(), reverse=True))
    result = subprocess.run(
        [sys.executable, "-m", "symsteer", "report", *runs, "--verify", "--out", page / "board"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    files = sum(path.is_file() for path in (page / "board").rglob("*"))
    assert result.stdout == f"20 records and {files} files of the leaderboard agree\n", result


def test_pinned_versions_are_those_that_run() -> None:
    """In the environment of `make setup`; elsewhere `--verify` names what differs."""
    pinned = re.search(r"^torch==(\S+)$", (REPOSITORY / "requirements.txt").read_text(), re.M)
    if metadata.version("torch").partition("+")[0] != pinned[1]:
        pytest.skip("not the pinned packages")
    assert other_versions() == []


def test_differences_are_short_and_printable(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\x1b[2J" + b"x" * 10**6)
    (tmp_path / "b").mkdir()
    (tmp_path / "c").symlink_to(tmp_path / "c")
    lines = differences(tmp_path, {"a": b"y", "b": b"", "c": b"", "d/e": b""})
    assert [line.split(": ")[0] for line in lines] == [
        str(tmp_path / name) for name in ("a", "b", "c", "d/e")
    ]
    assert all(line.isprintable() and len(line) < len(str(tmp_path)) + 140 for line in lines)
    assert "Is a directory" in lines[1]


# Command line


def test_the_page_goes_beside_the_runs_unless_another_folder_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_record(make_record(), tmp_path / "runs" / "one" / "record.json")
    write_record(make_record(seed=1), tmp_path / "more" / "two" / "record.json")
    monkeypatch.chdir(tmp_path)
    committed = tmp_path / "leaderboard"
    monkeypatch.setattr(command, "PAGE_FOLDER", committed)
    for module in (command, paths):
        monkeypatch.setattr(module, "RECORDS", committed / "results" / "records")
    for arguments, folder in (
        (["more", "runs"], "more"),
        (["runs/one/record.json"], "runs/one"),
    ):
        assert main(arguments) == 0
        assert main([*arguments, "--verify"]) == 0
        assert (tmp_path / folder / "leaderboard" / "LEADERBOARD.md").is_file()
    capsys.readouterr()
    # The committed page changes only when it is asked for.
    assert main(["."]) == 2
    assert "holds the committed leaderboard" in capsys.readouterr().err
    assert main([]) == 2
    assert "name run folders: symsteer report RUNS" in capsys.readouterr().err
    assert not committed.exists()
    assert main([".", "--out", "leaderboard"]) == 0
    shutil.copytree(tmp_path / "runs", committed / "results" / "records")
    assert main([]) == 0
    assert main(["--verify"]) == 0


# Extremes


@pytest.mark.filterwarnings("error")
def test_the_largest_numbers_are_drawn() -> None:
    """Those that a record may contain, and points far beyond the budget."""
    extremes = {"q_mean": 3.4e38, "q_min": -1e39, "q_max": 1e39, "q_abs_max": 1e39}
    large = [
        make_evaluation([1, 0], steps, steps == 2**53, q_bias=-1e39, **extremes)
        for steps in (0, 2**52, 2**53)
    ]
    records = [make_record(large, seed=seed, env_steps=2**53) for seed in range(2)]
    for record in records:
        record.parameters.actor = record.parameters.total = 2**53
        record.wall_clock.total = float(2**53)
    beyond = [make_evaluation([1, 0], q_mean=math.inf), make_evaluation([1, 0], 2**31, q_mean=-1.0)]
    beyond[0].final = False
    records += [make_record(beyond, seed=2), make_record(beyond, "failed", seed=3)]
    runs = summary_of(records).runs
    assert any("success" in name for name in render(runs, Path("."), {}, read_study(PAPER)))


def test_uneven_cells_are_drawn() -> None:
    """An agent in one of two cells, and twins of an agent, neither hide nor break anything."""
    records = make_cell({"base": 0.3, "standard": 0.5, "equivariant": 0.6})
    records += make_cell({"base": 0.3, "standard": 0.5}, variant="wind:1")
    records.append(make_record([make_evaluation([1, 0] * 20)], learning_rate=1e-3, seed=0))
    drawings = figures_of(view_of(records, audit=audit_of({"none": 0.1})).findings)
    kinds = ["answer", "map", "profiles", "improvement", "success", "q"]
    assert [drawing.kind for drawing in drawings] == kinds


FORMULAS = {
    "=1+1": "'=1+1",
    " @SUM(1)": "' @SUM(1)",
    "\t=1+1": "\\t=1+1",
    "-1+1|x": "'-1+1|x",
    "\uff1d1+1": "'\uff1d1+1",
    "\u200b=1": "\\u200b=1",
    "\ufeff=1": "\\ufeff=1",
    "\x00+1": "\\x00+1",
    "a\r\n=1": "a\\r\\n=1",
    "a; =1": "a;' =1",
    "a=1; b-2": "a=1; b-2",
}


def test_a_formula_stays_text_in_the_csv() -> None:
    files = other_files(view_of([make_record(agent=agent) for agent in FORMULAS]))
    for name in ("leaderboard.csv", "records.csv"):
        agents = [row["agent"] for row in csv.DictReader(files[name].splitlines())]
        assert sorted(agents) == sorted(FORMULAS.values())
    numbers = csv_text([(-1, -0.25, np.float64(-1e-9), None, True)])
    assert numbers == "-1,-0.25,-1e-09,,True\n"
