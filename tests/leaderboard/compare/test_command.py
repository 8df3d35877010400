"""`symsteer compare` as a user calls it: exit codes, text, JSON, picture."""

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from PIL import Image

from symsteer.cli import main
from symsteer.leaderboard.compare.figure import described
from symsteer.leaderboard.compare.sides import read_sides
from tests.leaderboard.compare.runs import at_commit, changed, runs_of, save
from tests.leaderboard.record_factory import make_cell

AGENTS = {"base": 0.4, "standard": 0.5, "equivariant": 0.75}
WORLDS = ("none", "action_gain:0.5")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder `runs` with three agents in two worlds; the present folder is the one above."""
    monkeypatch.chdir(tmp_path)
    for world in WORLDS:
        save(tmp_path / "runs" / world, make_cell(AGENTS, variant=world))
    return tmp_path


@pytest.fixture
def symsteer(monkeypatch, capsys):
    """Calls `symsteer compare`: exit code, stdout, stderr."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["symsteer", "compare", *map(str, arguments)])
        code = main()
        return (code, *capsys.readouterr())

    return call


def test_better_and_worse(place, symsteer):
    code, out, _ = symsteer("standard", "equivariant")
    assert code == 0
    assert "A: the agent standard in runs: 10 runs" in out
    assert "10 pairs in 2 cells, on 1 base policy" in out
    assert "verdict: B is clearly better: success +0.250" in out
    code, out, _ = symsteer("equivariant", "standard")
    assert code == 1
    assert "verdict: B is clearly worse: success \N{MINUS SIGN}0.250" in out
    assert symsteer("equivariant", "standard", "--margin", 0.5)[0] == 0


def test_what_is_identical_is_counted_and_not_listed(place, symsteer):
    records = [record for world in WORLDS for record in make_cell(AGENTS, variant=world)]
    save(place / "after", at_commit(records, "f" * 40))
    code, out, _ = symsteer("runs", "after")
    assert code == 0
    assert out.split("\n\n")[1].startswith("IDENTICAL: all pairs agree bit for bit")
    assert "30 pairs in 6 cells" in out
    assert out.endswith("verdict: identical\n")
    records[-1].evaluations[0].diagnostics = {"q_bias": 2.0}
    save(place / "changed", records)
    _, out, _ = symsteer("runs", "changed")
    assert "but not in all diagnostics" in " ".join(out.split())
    others = make_cell({"equivariant": 0.5}, variant="none")
    save(
        place / "other",
        [*others, *(r for r in records if r.run_id != others[r.config["seed"]].run_id)],
    )
    _, out, _ = symsteer("runs", "other")
    assert "not listed: 5 identical cells" in out
    assert "Identical bit for bit: 25 of 30" in out
    assert "none equivariant" in out
    assert "none standard" not in out


def test_runs_without_a_partner_are_counted(place, symsteer):
    save(place / "runs" / "more", runs_of([[1, 0]], first_seed=9, agent="standard"))
    _, out, _ = symsteer("standard", "equivariant")
    assert "Without a partner: 1 run of A, 0 of B." in out
    assert "1 of A: the nearest run of B differs in seed, such as run-none-standard-9" in out


def test_too_few_pairs(place, symsteer):
    save(place / "a", runs_of([[0, 0]]))
    save(place / "b", runs_of([[1, 1]]))
    code, out, _ = symsteer("b", "a")
    assert code == 0
    assert "verdict: none. A verdict needs 5 pairs" in out
    # All episodes are worse, but where there is no verdict nothing is marked as clear.
    assert "\N{MINUS SIGN}1.000 [\N{MINUS SIGN}1.000, \N{MINUS SIGN}1.000]" in out
    assert "▼" not in out


def test_the_verdict_names_what_is_worse(place, symsteer):
    a, b = make_cell({"standard": 0.5}), make_cell({"zero": 0, "standard": [0, 0, 0.5]})[5:]
    save(place / "a", a), save(place / "b", b)
    code, out, _ = symsteer("a", "b")
    assert code == 1
    assert "success" in out
    verdict = out.split("verdict: ")[1]
    assert verdict.startswith("B is clearly worse: AUC \N{MINUS SIGN}0.375")
    assert "success" not in verdict


def test_json_is_all_that_is_printed(place, symsteer):
    code, out, err = symsteer("equivariant", "standard", "--json")
    assert (code, err) == (1, "")
    data = json.loads(out)
    assert out.count("\n") == 1
    assert data["verdict"] == "worse"
    assert (data["a"]["read_as"], data["a"]["runs"]) == ("agent", 10)
    assert [(cell["variant"], cell["agent"]) for cell in data["cells"]] == [
        ("none", None),
        ("action_gain:0.5", None),
    ]
    overall = data["overall"]["success"]
    assert overall["difference"] == pytest.approx(overall["b"] - overall["a"]) == -0.25
    assert overall["low"] < overall["difference"] < overall["high"] < 0
    assert data["overall"]["wall_clock"] == {"a": 250, "b": 250}
    pairs = [pair for cell in data["cells"] for pair in cell["pairs"]]
    assert len(pairs) == data["pairs"] == 10
    assert Path(pairs[0]["a"]).is_file()


def test_the_picture_has_a_row_for_each_cell(place):
    a, b = read_sides("equivariant", "standard", Path("runs"))
    figure = described(a, b, found := changed("equivariant", "standard"))
    for plot, measure in zip(figure.plots, ("success", "auc"), strict=True):
        assert plot.y.labels == [
            "PickCube-v1 floating none",
            "PickCube-v1 floating action_gain:0.5",
            "mean over cells",
        ]
        changes = [cell.measures[measure] for cell in found.cells] + [found.overall[measure]]
        assert [(dot.y, dot.x) for dot in plot.dots] == [
            (height, change.difference) for height, change in enumerate(changes)
        ]


def test_a_picture_is_written(place, symsteer):
    _, out, _ = symsteer("standard", "equivariant", "--picture", "folder/C.PNG")
    assert out.endswith("wrote folder/C.PNG\n")
    with Image.open("folder/C.PNG") as picture:
        assert picture.format == "PNG"
        # White behind the labels: on a dark page, too.
        assert picture.convert("RGBA").getpixel((2, 2)) == (255, 255, 255, 255)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("standard", "equivariant", "--margin", "-0.1"), "--margin is -0.1"),
        (("standard", "equivariant", "--picture", "a.pdf"), "must end with .png or .svg"),
        (("standard", "equivariant", "--picture", "runs/x.svg/y.svg"), "x.svg"),
        (("standard", "ppo"), "no folder, agent or commit 'ppo'"),
        (("standard", "equivariant", "--runs", "nowhere"), "no folder nowhere"),
        (("runs/none", "runs/action_gain:0.5"), "differ in variant (none, action_gain:0.5)"),
        (("runs", "standard"), "belong to A (runs) and to B (standard)"),
    ],
)
def test_mistakes(place, symsteer, arguments, words):
    (place / "runs/x.svg").write_text("")
    code, out, err = symsteer(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert words in err


HOSTILE = "\x1b[31m<script>--> $x_1$ [bold]\u202ered\nverdict: fine"


def test_text_of_records_is_harmless(place, symsteer):
    config = {"variant": HOSTILE, "task": "a\tb\x9b2J" * 9, "embodiment": "\x07" * 60}
    before, after = (
        [r for agent in (HOSTILE, "other") for r in runs_of(*[curve] * 5, agent=agent, **config)]
        for curve in ([[1, 0]], [[0, 1]])
    )
    a = save(place / "a\x1b[2J", before)
    b = save(place / "b\nverdict: better", after[:9])
    code, out, _ = symsteer(a, b, "--picture", "x.svg")
    assert code == 0
    lines = out.split("\n")
    assert all(c.isprintable() for line in lines for c in line)
    assert sum(line.startswith("verdict:") for line in lines) == 1
    assert "<script>" not in Path("x.svg").read_text()
    assert ET.parse("x.svg").getroot() is not None
    _, out, _ = symsteer(a, b, "--json")
    assert out.isascii()
    assert json.loads(out)["cells"][0]["variant"] == HOSTILE
