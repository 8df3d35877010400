"""The generated page: determinism, escaping, what it shows, and the command line."""

from __future__ import annotations

import csv
import math
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from symsteer.files import csv_text
from symsteer.leaderboard import command, paths
from symsteer.leaderboard.figures import q_values
from symsteer.leaderboard.paths import RECORDS
from symsteer.leaderboard.records import read_record, write_record
from symsteer.leaderboard.report import generate, slug
from symsteer.leaderboard.summary import Run, summarize
from symsteer.leaderboard.text import code, compact, count, number, relative_link
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import LEARNING, make_curve, make_evaluation, make_record


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


def snapshot(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    write_runs(folder / "runs")
    generate([folder / "runs"], folder / "board")
    return folder


def test_the_page_shows_every_run(page: Path) -> None:
    text = (page / "board" / "LEADERBOARD.md").read_text()
    assert "5 finished seeds that a ranking needs" in text
    assert "Rank |" not in text
    assert "1\u00a0finished, 1\u00a0failed" in text
    assert "the simulator stopped" in text
    for agent in ("base", "zero", "standard", "equivariant", "approximate"):
        assert text.count(f"| `{agent}` |") >= 3
    for path in (page / "runs").iterdir():
        target = f"../runs/{path.name.replace('=', '%3D')}/record.json"
        assert f"({target})" in text
    second = text[text.index("Q-values, symmetry and cost") :]
    diverged = re.search(r"^\| `standard` \| (\S+) \|", second, re.M)
    assert diverged
    assert diverged[1] == "2/2"
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


def test_figures_are_shown_and_are_svg_without_dates(page: Path) -> None:
    text = (page / "board" / "LEADERBOARD.md").read_text()
    shown = re.findall(r"!\[[^]]+\]\((figures/[^)]+\.svg)\)", text)
    files = sorted(f"figures/{p.name}" for p in (page / "board" / "figures").iterdir())
    assert sorted(shown) == files
    assert len(files) == 6
    for name in files:
        data = (page / "board" / name).read_bytes()
        assert ElementTree.fromstring(data).tag.endswith("svg")
        assert b"dc:date" not in data
        assert b"Matplotlib v" not in data


def test_csv_holds_the_numbers_of_the_page(page: Path) -> None:
    with open(page / "board" / "leaderboard.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    failed = [r for r in rows if r["failed"] == "1"]
    assert [(r["agent"], r["variant"], r["finished"]) for r in failed] == [
        ("approximate", "none", "1")
    ]
    standard = next(r for r in rows if r["agent"] == "standard" and r["variant"] == "none")
    records = [
        read_record(page / "runs" / f"standard-none-{seed}" / "record.json") for seed in (0, 1)
    ]
    finals = [record.final.success_once for record in records if record.final]
    windows = [np.mean([e.success_once for e in r.evaluations[-2:]]) for r in records]
    assert float(standard["success_iqm"]) == pytest.approx(np.mean(windows), abs=1e-5)
    assert float(standard["last_checkpoint"]) == pytest.approx(np.mean(finals), abs=1e-5)
    assert windows != finals
    assert standard["diverged"] == "2"
    assert float(standard["feasible_low"]) == -20


def test_the_same_records_give_the_same_bytes(page: Path, tmp_path: Path) -> None:
    """In another order, and over an older output; test_verify.py has another process."""
    folders = sorted((page / "runs").iterdir(), reverse=True)
    again = page / "again"
    again.mkdir()
    (again / "LEADERBOARD.md").write_text("older")
    assert main([*map(str, folders), "--out", str(again)]) == 0
    assert snapshot(again) == snapshot(page / "board")


def test_changed_records_give_other_bytes(page: Path, tmp_path: Path) -> None:
    write_runs(tmp_path / "runs", seeds=1)
    generate([tmp_path / "runs"], tmp_path / "board")
    new, old = snapshot(tmp_path / "board"), snapshot(page / "board")
    assert new.keys() == old.keys()
    assert all(new[name] != old[name] for name in new)


def test_stale_figures_go_and_foreign_files_stay(page: Path, tmp_path: Path) -> None:
    out = tmp_path / "board"
    shutil.copytree(page / "board", out)
    stale = out / "figures" / f"q-{slug('OldTask-v1', 'floating')}.svg"
    foreign = out / "figures" / "mine.svg"
    stale.write_text("")
    foreign.write_text("")
    paper = out / "PAPER.md"
    assert paper.exists()
    # A study without statements has no such page; another file of this name is not ours.
    generate([page / "runs"], out, study="first")
    assert not stale.exists()
    assert foreign.exists()
    assert not paper.exists()
    paper.write_text("# The paper")
    generate([page / "runs"], out, study="first")
    assert paper.read_text() == "# The paper"


@pytest.mark.long
@pytest.mark.parametrize("seeds", [1, 5])
def test_any_number_of_seeds_is_shown(tmp_path: Path, seeds: int) -> None:
    write_runs(tmp_path / "runs", seeds)
    generate([tmp_path / "runs"], tmp_path / "board")
    text = (tmp_path / "board" / "LEADERBOARD.md").read_text()
    assert ("Rank |" in text) == (seeds == 5)


def test_a_lone_unfinished_run_is_shown(tmp_path: Path) -> None:
    record = make_record([], status="running")
    write_record(record, tmp_path / "run" / "record.json")
    generate([tmp_path / "run"], tmp_path / "board")
    text = (tmp_path / "board" / "LEADERBOARD.md").read_text()
    assert "1\u00a0running" in text


# Hostile records

SUMMARIES = (
    "How to read it",
    "Claims, effects and p-values",
    "Success in every cell",
    "The advantage of symmetry against the defect",
    "The map's numbers",
    "All cells together",
    "Are the learners sound",
    "How much is the base policy's",
    "PickCube-v1, floating",
    "Other cells",
    "Provenance",
)
HEADINGS = ("Leaderboard", "What symmetry gains", "Verdicts", "Details", "Unbroken symmetry")
HOSTILE = [
    "<script>alert(1)</script>",
    "`</td><img src=x onerror=alert(1)>`",
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


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_stays_text(tmp_path: Path, text: str) -> None:
    markdown = pytest.importorskip("markdown_it")
    record = make_record(
        [make_evaluation([1, 0], q_mean=-1.0)],
        task=text,
        embodiment=text,
        variant=text,
        agent=text,
        demonstrations={"mode": text, "count": 3, "seed": 0},
    )
    data = record.model_dump(by_alias=True) | {"run_id": "run"}
    data["base_policy"] |= {"name": text, "group": text, "warning": text}
    data["provenance"] |= {"device": text, "platform": text, "packages": {text: text}}
    data |= {"status": "failed", "failure": text}
    data["evaluations"][0]["final"] = False
    hostile = type(record).model_validate(data)
    write_record(hostile, tmp_path / "hostile" / "record.json")
    write_record(make_record(agent="base"), tmp_path / "good" / "record.json")
    files = generate([tmp_path / "hostile", tmp_path / "good"], tmp_path / "board")

    names = {str(path.relative_to(tmp_path / "board")) for path in files}
    allowed = re.compile(
        r"(LEADERBOARD|PAPER)\.md|(leaderboard|records)\.csv|figures/((q|success)-[a-z0-9-]+|profiles)\.svg"
    )
    assert all(allowed.fullmatch(name) for name in names)
    for path in files:
        if path.suffix == ".svg":
            ElementTree.fromstring(path.read_bytes())
        if path.suffix == ".csv":
            assert not any(
                cell.startswith(("=", "@"))
                for line in csv.reader(path.read_text().splitlines())
                for cell in line
            )
    parser = markdown.MarkdownIt("commonmark").enable(["table", "strikethrough"])
    tokens = [
        token
        for block in parser.parse((tmp_path / "board" / "LEADERBOARD.md").read_text())
        for token in [block, *(block.children or [])]
    ]
    raw = {t.content.strip() for t in tokens if t.type in ("html_block", "html_inline")}
    details = {f"<details>\n<summary>{text}</summary>" for text in SUMMARIES}
    assert raw <= {"<br>", "</details>"} | details
    links = {str(t.attrs.get("href") or t.attrs.get("src")) for t in tokens if t.attrs}
    links -= {"None"}
    assert all(
        re.fullmatch(r"records.csv|PAPER.md|(figures|\.\./(hostile|good))/[\w.%-]+", link)
        for link in links
    )
    headings = [tokens[i + 1].content for i, t in enumerate(tokens) if t.type == "heading_open"]
    assert all(
        h in HEADINGS or h.startswith(("Broken by `", "Broken by arm kinematics and `", "`"))
        for h in headings
    )
    plain = " ".join(t.content for t in tokens if t.type == "text")
    assert "evil" not in plain
    assert "alert" not in plain
    assert "passwd" not in plain


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
    assert [count(v) for v in (0, 950, 1_200, 50_000, 2_500_000)] == [
        "0",
        "950",
        "1.2\u00a0k",
        "50\u00a0k",
        "2.5\u00a0M",
    ]


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
        (["runs"], "runs"),
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


def test_bad_records_leave_the_output_as_it_was(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, out = tmp_path / "runs", tmp_path / "board"
    write_runs(runs, seeds=1)
    generate([runs], out)
    before = snapshot(out)
    victim = next(iter(sorted(runs.rglob("record.json"))))
    victim.write_bytes(victim.read_bytes()[:-200])
    assert main([str(runs), "--out", str(out)]) == 2
    shown = capsys.readouterr()
    assert not shown.out
    assert shown.err.count("\n") == 1
    assert str(victim) in shown.err
    assert "run the cell again" in shown.err
    assert snapshot(out) == before
    fresh = tmp_path / "fresh"
    assert main([str(runs), "--out", str(fresh)]) == 2
    assert not fresh.exists()


def test_bad_arguments_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    write_record(make_record(), tmp_path / "good" / "record.json")
    for arguments in (
        [tmp_path / "nowhere"],
        [tmp_path / "empty"],
        [tmp_path / "file"],
        [tmp_path / "good", "--out", tmp_path / "file"],
        [tmp_path / "good", "--out", tmp_path / "file" / "below"],
    ):
        assert main([str(argument) for argument in arguments]) == 2
        message = capsys.readouterr().err
        assert message.startswith("error: ")
        assert message.count("\n") == 1


# What is committed


def test_committed_records_are_valid_and_name_no_machine() -> None:
    paths = sorted(RECORDS.rglob("*.json"))
    assert paths
    for path in paths:
        read_record(path)
        found = re.search(r"/(home|root|tmp|work|Users|mnt)/", path.read_text())
        assert found is None, f"{path.name} names a folder of a machine"


def test_the_largest_numbers_are_drawn(tmp_path: Path) -> None:
    """The largest numbers that a record may contain; the page can still be generated."""
    extremes = {"q_mean": 3.4e38, "q_min": -1e39, "q_max": 1e39, "q_abs_max": 1e39}
    for seed in range(2):
        curve = [
            make_evaluation([1, 0], steps, steps == 2**53, q_bias=-1e39, **extremes)
            for steps in (0, 2**52, 2**53)
        ]
        record = make_record(curve, seed=seed, env_steps=2**53)
        record.parameters.actor = record.parameters.total = 2**53
        record.wall_clock.total = float(2**53)
        write_record(record, tmp_path / "runs" / str(seed) / "record.json")
    assert main([str(tmp_path / "runs"), "--out", str(tmp_path / "board")]) == 0


@pytest.mark.filterwarnings("error")
def test_points_far_beyond_the_budget_do_not_spoil_the_figures(tmp_path: Path) -> None:
    curve = [make_evaluation([1, 0], q_mean=math.inf), make_evaluation([1, 0], 2**31, q_mean=-1.0)]
    curve[0].final = False
    for record in (make_record(curve), make_record(curve, "failed", seed=1)):
        write_record(record, tmp_path / "runs" / record.run_id / "record.json")
    assert main([str(tmp_path / "runs"), "--out", str(tmp_path / "board")]) == 0


def test_a_cross_marks_a_q_that_is_not_finite_and_no_missing_bias() -> None:
    def crosses(**diagnostics: float) -> int:
        curve = [make_evaluation([1, 0], 25_000, False, q_mean=-5.0, q_max=-4.0)]
        curve.append(make_evaluation([1, 0], 50_000, q_mean=-5.0, **diagnostics))
        summary = summarize([Run(Path("a.json"), make_record(curve))])
        (plot,) = q_values(summary.tables).plots
        return sum(trace.cross > 0 for trace in plot.traces)

    assert crosses(q_max=math.inf) == 1
    assert crosses(q_max=-4.0, q_bias=math.nan) == 0


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


def test_a_formula_stays_text_in_the_csv(tmp_path: Path) -> None:
    for index, agent in enumerate(FORMULAS):
        write_record(make_record(agent=agent), tmp_path / "runs" / str(index) / "record.json")
    generate([tmp_path / "runs"], tmp_path / "board")
    for name in ("leaderboard.csv", "records.csv"):
        with open(tmp_path / "board" / name, newline="") as file:
            agents = [row["agent"] for row in csv.DictReader(file)]
        assert sorted(agents) == sorted(FORMULAS.values())
    numbers = csv_text([(-1, -0.25, np.float64(-1e-9), None, True)])
    assert numbers == "-1,-0.25,-1e-09,,True\n"
