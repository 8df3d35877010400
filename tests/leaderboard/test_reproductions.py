"""Reproductions: what is compared, the files, and the marks of rows and runs."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import shutil
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard import study
from symsteer.leaderboard.page import other_files, render_page
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.records import (
    REPEATED,
    Reproduction,
    RunRecord,
    compare_records,
    dump_reproduction,
    file_hash,
    read_record,
    read_reproductions,
    reproduction_of,
    write_record,
)
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.sections import Findings, View
from symsteer.leaderboard.site.build import generate as generate_site
from symsteer.leaderboard.statistics import ShareDifference
from symsteer.leaderboard.study import read_study
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import (
    GONE,
    edited,
    make_cell,
    make_evaluation,
    make_record,
    put,
)
from tests.marks import need

STEPS = (0, 25_000, 50_000)


def record_of(**diagnostics: float | None) -> RunRecord:
    return make_record(
        [make_evaluation([1, 0, 1, 0], step, step == 50_000, **diagnostics) for step in STEPS],
        agent="equivariant",
    )


def test_equal_runs_agree_whatever_the_clock_and_the_machine() -> None:
    record = record_of(q_mean=-3.0)
    other = {"wall_clock/total": 500, "evaluations/1/wall_clock": 500}
    other |= {"base_policy/training_seconds": 1.0, "provenance/platform": "elsewhere"}
    differences, success, area = compare_records(record, edited(record, other))
    assert differences == []
    assert (success.recorded, success.repeated) == (0.5, 0.5)
    assert success.low == pytest.approx(-0.495, abs=1e-3)
    assert success.high == pytest.approx(0.495, abs=1e-3)
    assert area.recorded == area.repeated == pytest.approx(0.5)


@pytest.mark.parametrize(("count", "verdict"), [(0, "alike"), (7, "alike"), (20, "different")])
def test_both_runs_are_samples(count: int, verdict: str, tmp_path: Path) -> None:
    """.80 and .87 in 100 episodes are no clear difference; .87 is outside of .80's own interval."""
    paths = []
    for name, successes in (("record", 80), ("again", 80 + count)):
        final = make_evaluation([1] * successes + [0] * (100 - successes), q_mean=-len(name))
        paths.append(tmp_path / f"{name}.json")
        write_record(make_record([final]), paths[-1])
    found = reproduction_of(*paths, [])
    assert found.verdict == verdict
    wanted = ShareDifference((80 + count, 100), (80, 100)).interval()
    assert found.success.low == pytest.approx(wanted.low)
    assert found.success.high == pytest.approx(wanted.high)


MORE = make_evaluation([1, 0, 1, 0, 1]).episodes.model_dump(by_alias=True)


@pytest.mark.parametrize(
    ("place", "value", "part", "first", "differ"),
    [
        ("evaluations/1/episodes/success_once", [True] * 3 + [False], "episodes", 25_000, 1),
        ("evaluations/2/diagnostics/q_mean", -2.5, "diagnostics", 50_000, 1),
        ("evaluations/0/diagnostics/q_mean", GONE, "diagnostics", 0, 1),
        ("evaluations/1/diagnostics/td_error", math.nan, "diagnostics", 25_000, 1),
        # What the record has as not measured.
        ("evaluations/2/diagnostics/q_correlation", 0.5, "diagnostics", 50_000, 1),
        ("evaluations/1/episodes", MORE, "episodes", 25_000, None),
        ("evaluations/1", GONE, "episodes", 25_000, None),
        ("parameters/actor", 1, "parameters", None, 1),
        ("base_policy/content_hash", "f" * 64, "base policy", None, 1),
        ("budget/updates", 1, "budget", None, 1),
    ],
)
def test_every_difference_is_found(
    place: str, value: Any, part: str, first: int | None, differ: int | None
) -> None:
    record = record_of(q_mean=-3.0, q_correlation=None)
    parts = {one.part: one for one in compare_records(record, edited(record, {place: value}))[0]}
    assert parts[part].first == first
    assert differ is None or parts[part].differ == differ
    assert parts[part].example


def test_what_the_record_lacks_is_not_compared() -> None:
    """Directions, and diagnostics that are newer than the record; but later evaluations are."""
    record, newer = record_of(q_mean=-3.0), {"base_policy/parameters": 10}
    newer |= {
        "evaluations/*/episodes/direction": [0.1] * 4,
        "evaluations/*/diagnostics/td_error": 1.0,
    }
    again = edited(record, newer)
    assert compare_records(record, again)[0] == []
    assert compare_records(again, record)[0] != []
    again.evaluations.append(make_evaluation([1, 0], 60_000))
    assert [one.first for one in compare_records(record, again)[0]] == [60_000]


# Files and marks


@pytest.fixture(scope="module")
def two_of_five(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five runs of each agent, and reproductions of two of one: an exact one and one alike."""
    folder = tmp_path_factory.mktemp("results")
    (folder / "marks").mkdir()
    for record in make_cell({"base": 0.4, "standard": 0.5, "equivariant": 0.8}):
        write_record(record, folder / "records" / f"{record.run_id}.json")
        if record.settings.agent == "equivariant" and record.settings.seed < 2:
            other = {"evaluations/1/diagnostics/q_mean": -1.0} if record.settings.seed else {}
            reproduce(folder, record, edited(record, {"wall_clock/total": 251, **other}))
    return folder


@pytest.fixture
def results(two_of_five: Path, tmp_path: Path) -> Path:
    """The same, to be changed."""
    shutil.copytree(two_of_five, tmp_path, dirs_exist_ok=True)
    return tmp_path


def reproduce(folder: Path, record: RunRecord, again: RunRecord) -> Path:
    """The file that says how a record agrees with another one, which is put beside it."""
    path = folder / "records" / f"{record.run_id}.json"
    mark = folder / "marks" / f"{file_hash(path)}.json"
    write_record(again, mark.with_suffix(REPEATED))
    mark.write_bytes(
        dump_reproduction(reproduction_of(path, mark.with_suffix(REPEATED), ["a note"]))
    )
    return mark


def marks_of(folder: Path) -> dict[str, Path]:
    """The files of the reproductions by their verdict."""
    marks = read_reproductions(folder / "marks")
    return {one.verdict: folder / "marks" / f"{name}.json" for name, one in marks.items()}


def load(folder: Path) -> list[Run]:
    return load_runs([folder / "records"], folder / "marks")


def test_rows_and_runs_are_marked(two_of_five: Path, tmp_path: Path) -> None:
    records, marks = two_of_five / "records", two_of_five / "marks"
    (alike,) = (one for one in read_reproductions(marks).values() if one.differences)
    assert alike.conditions == ["a note"]
    (difference,) = alike.differences
    assert (difference.part, difference.largest) == ("diagnostics", 4.0)
    assert "q_mean" in difference.example
    files = files_of(load_runs([records], marks), tmp_path)
    page = files["LEADERBOARD.md"].replace("\u00a0", " ")
    assert page.count("5 finished, 1 reproduced exactly, 1 reproduced alike") == 1
    assert "made again from their records" in page
    listed = csv.DictReader(io.StringIO(files["records.csv"]))
    assert sorted(filter(None, (run["reproduced"] for run in listed))) == ["alike", "exact"]
    names = ("reproduced_exactly", "reproduced_alike", "not_reproduced")
    rows = csv.DictReader(io.StringIO(files["leaderboard.csv"]))
    counted = {row["agent"]: [row[name] for name in names] for row in rows}
    assert counted["equivariant"] == ["1", "1", "0"]
    assert counted["standard"] == ["0", "0", "0"]
    # Without reproductions nothing changes: neither words nor columns.
    plain = files_of(load_runs([records]), tmp_path)
    assert "eproduced" not in plain["LEADERBOARD.md"] + plain["leaderboard.csv"]


def files_of(runs: Sequence[Run], folder: Path, study: str = "paper") -> dict[str, str]:
    """The page and the tables of runs."""
    files = other_files(view := View(Findings(summarize(runs), {}, read_study(study))))
    return {"LEADERBOARD.md": render_page(view), **files}


def test_the_site_marks_rows_and_runs(two_of_five: Path, tmp_path: Path) -> None:
    need("site")
    marks = two_of_five / "marks"
    generate_site([two_of_five / "records"], tmp_path, "paper", docs=False, reproductions=marks)
    assert "1\u00a0reproduced" in (tmp_path / "index.html").read_text()
    (page,) = (tmp_path / "runs").glob("*.html")
    assert page.read_text().count("reproduced exactly on 2026-01-31") == 1
    assert page.read_text().count('"made again"') == 2
    assert "made again from their records" in (tmp_path / "findings.html").read_text()


def test_a_stale_reproduction_is_named(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = results / "records" / "run-none-equivariant-0.json"
    old = file_hash(record)
    record.write_text(record.read_text().replace('"alpha":0.01', '"alpha":0.02') + "\n")
    marks = ["--reproductions", str(results / "marks")]
    assert main([str(results / "records"), "--verify", *marks]) == 2
    error = capsys.readouterr().err
    assert f"{old}.json is about a record of run-none-equivariant-0" in error
    assert error.count("\n") == 1
    # One of a record that is not among these is of another leaderboard.
    record.unlink()
    assert len(load(results)) == 14
    assert main([str(results / "records"), "--reproductions", str(results / "nowhere")]) == 2
    assert "is no folder" in capsys.readouterr().err


def test_a_bad_reproduction_is_one_sentence(results: Path) -> None:
    good = marks_of(results)["exact"]
    text = good.read_text()
    for damaged in (
        text[:-9],
        text.replace('"schema_version": 1', '"schema_version": 2'),
        # A copy of the record is no second run.
        text.replace(Reproduction.model_validate_json(text).repeated.sha256, good.stem),
    ):
        good.write_text(damaged)
        with pytest.raises(UserError, match=r"is no valid reproduction") as error:
            read_reproductions(results / "marks")
        assert "\n" not in str(error.value)
    good.write_text(text)
    good.rename(good.with_name(f"{'0' * 64}.json"))
    with pytest.raises(UserError, match=r"about a record with another hash"):
        read_reproductions(results / "marks")


OTHER_NUMBERS: list[dict[str, Any]] = [
    {"verdict": "different"},
    {"verdict": "exact", "differences": []},
    {"success/repeated": 1.0, "success/low": -0.1, "success/high": 0.4},
    {"success/recorded": 0.9},
    {"area/recorded": 0.9},
    {"record/run_id": "run-none-equivariant-4"},
    {"repeated/sha256": "ab" * 32},
    {"repeated/started": "2020-01-01T00:00:00+00:00"},
]


def test_numbers_that_the_records_do_not_give_are_refused(results: Path) -> None:
    """Also of a repeated run that had another configuration, or has not finished."""
    mark = marks_of(results)["alike"]
    good = mark.read_bytes()
    for changes in OTHER_NUMBERS:
        data = json.dumps(put(json.loads(good), changes))
        mark.write_bytes(dump_reproduction(Reproduction.model_validate_json(data)))
        with pytest.raises(UserError, match=rf"{mark.name} says something else than the records"):
            load(results)
    mark.write_bytes(good)
    assert len(load(results)) == 15
    record = read_record(results / "records" / "run-none-equivariant-2.json")
    other = reproduce(results, record, edited(record, {"config/learning_rate": 1.0}))
    with pytest.raises(UserError, match="says something else"):
        load(results)
    other.unlink()
    data = json.loads(mark.with_suffix(REPEATED).read_text())
    put(data, {"evaluations/-1/final": False, "status": "failed", "failure": "stopped"})
    mark.with_suffix(REPEATED).write_text(json.dumps(data))
    with pytest.raises(UserError, match="says something else"):
        load(results)


def test_without_the_repeated_record_the_list_decides(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest reproductions lack it."""
    for path in (results / "marks").glob(f"*{REPEATED}"):
        path.unlink()
    with pytest.raises(UserError, match=r"the repeated record .* is not beside it"):
        load(results)
    listed = read_study(lists(results, *own_files(results))).listed
    counted = load_runs([results / "records"], results / "marks", listed)
    assert sorted(r.reproduction.verdict for r in counted if r.reproduction) == ["alike", "exact"]
    monkeypatch.setattr(study, "FOLDER", results)
    assert len(load(results)) == 15


def lists(results: Path, *files: Path) -> str:
    """A study with a list of these files."""
    lines = (f"{file_hash(path)}  {path.name}\n" for path in files)
    (results / "own.sha256").write_text("".join(lines))
    (results / "own.toml").touch()
    return str(results / "own.toml")


def own_files(results: Path) -> list[Path]:
    return [*sorted((results / "records").glob("run-*")), *marks_of(results).values()]


# Marks of submitted runs


@pytest.fixture
def submitted(results: Path) -> Path:
    """Runs of a wonderful agent and bad ones of a known agent are handed in."""
    for record in make_cell({"wonder": 1.0, "equivariant": 0.1, "base": 0.9}, seeds=6):
        record.started += timedelta(days=9)
        record.ended = record.started + timedelta(seconds=1)
        record.run_id = f"new-{record.run_id}"
        write_record(record, results / "records" / f"{record.run_id}.json")
    return results


def listed_runs(results: Path, *listed: Path) -> list[Run]:
    return load_runs(
        [results / "records"], results / "marks", read_study(lists(results, *listed)).listed
    )


def table_of(results: Path, *listed: Path) -> Table:
    (table,) = summarize(listed_runs(results, *listed)).tables
    return table


@pytest.mark.long
def test_submitted_rows_are_marked_last_and_change_nothing(submitted: Path) -> None:
    assert not any(row.marked for row in summarize(load(submitted)).tables[0].rows)  # no list
    own = own_files(submitted)
    files = files_of(listed_runs(submitted, *own), submitted, lists(submitted, *own))
    table = table_of(submitted, *own)
    assert [row.label for row in table.rows] == [
        *("base", "standard", "equivariant"),
        *(f"{agent} (not reproduced)" for agent in ("base", "equivariant", "wonder")),
    ]
    assert table.best_reference is table.row_of("base") is table.rows[0]
    assert (table.row_of("wonder"), table.rows[5].rank) == (None, None)
    assert table.rows[5].difference is not None
    page = files["LEADERBOARD.md"].replace("\u00a0", " ")
    assert "submitted runs that no maintainer has made again" in page
    assert "| 0.40 | 0.50 \u25b2 | 0.80 \u25b2 | 1.00 \u25b2 not reproduced |" in page
    ranks = re.findall(r"^\| `[^`]+` \| (\S+) \| [\d.]+<br>", page, re.M)
    assert ranks[:6] == ["\u2013", "1", "2", "\u2013", "\u2013", "\u2013"]
    rows = list(csv.DictReader(io.StringIO(files["leaderboard.csv"])))
    assert [(row["agent"], row["marked"], row["rank"]) for row in rows][3:] == [
        (agent, "1", "") for agent in ("base", "equivariant", "wonder")
    ]
    # The rows of the maintainers' own runs are what they are without the others.
    for path in (submitted / "records").glob("new-*"):
        path.unlink()
    alone = table_of(submitted, *own)
    names = ("label", "rank", "success", "difference", "against_best", "missing", "area")
    for row, other in zip(alone.rows, table.rows, strict=False):
        assert [getattr(row, n) for n in names] == [getattr(other, n) for n in names]
    assert (alone.threshold, alone.feasible) == (table.threshold, table.feasible)


def test_a_maintainers_reproduction_of_one_run_takes_the_mark_of_its_row(submitted: Path) -> None:
    own = own_files(submitted)
    record = read_record(submitted / "records" / "new-run-none-wonder-3.json")
    again = edited(record, {"wall_clock/total": 251})
    mark = reproduce(submitted, record, again)
    with pytest.raises(UserError, match=rf"{mark.name} does not count, because the list"):
        table_of(submitted, *own)
    table = table_of(submitted, *own, mark)
    assert {row.agent for row in table.rows if row.marked} == {"base", "equivariant"}
    row = table.row_of("wonder")
    assert row is not None
    assert (row.rank, len(row.runs), row.label) == (1, 6, "wonder")
    # One that does not agree takes no mark.
    mark.with_suffix(REPEATED).unlink()
    again.evaluations[-1].episodes = make_evaluation([0] * 40).episodes
    assert reproduce(submitted, record, again) == marks_of(submitted)["different"]
    assert table_of(submitted, *own, mark).row_of("wonder") is None


@pytest.mark.parametrize("line", ["", "x" * 64 + "  name.json"])
def test_a_bad_list_is_one_sentence(line: str, tmp_path: Path) -> None:
    path = lists(tmp_path)
    (tmp_path / "own.sha256").write_text(f"{'0' * 64}  name\n{line}\n")
    with pytest.raises(UserError, match=r"own\.sha256, line 2 is none of `sha256sum`"):
        read_study(path)


@pytest.mark.long
def test_the_lists_name_what_is_committed() -> None:
    folders = {"answer": "records", "field": "zoo", "divergence": "stress"}
    folders |= {name: name for name in ("learners", "first")}
    for name, folder in folders.items():
        lines = (study.FOLDER / f"{name}.sha256").read_text().splitlines()
        files = [RESULTS / line[66:] for line in lines]
        assert [file_hash(file) for file in files] == [line[:64] for line in lines]
        assert {*(RESULTS / folder).rglob("*.json")} == {
            file for file in files if file.parent.name != "reproductions"
        }
