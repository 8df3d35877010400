"""Reproductions: what is compared, the files, and the marks of rows and runs."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard import study
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
from symsteer.leaderboard.report import generate
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.sections.cells import status
from symsteer.leaderboard.site.build import generate as generate_site
from symsteer.leaderboard.statistics import ShareDifference
from symsteer.leaderboard.study import read_study
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import make_cell, make_evaluation, make_record

STEPS = (0, 25_000, 50_000)


def record_of(**diagnostics: float | None) -> RunRecord:
    return make_record(
        [make_evaluation([1, 0, 1, 0], step, step == 50_000, **diagnostics) for step in STEPS],
        agent="equivariant",
    )


def copy_of(record: RunRecord) -> RunRecord:
    return RunRecord.model_validate(record.model_dump(by_alias=True))


def test_equal_runs_agree_whatever_the_clock_and_the_machine() -> None:
    record, again = record_of(q_mean=-3.0), record_of(q_mean=-3.0)
    again.wall_clock.total *= 2
    again.evaluations[1].wall_clock += 5
    again.base_policy.training_seconds = 1.0
    again.provenance.platform = "elsewhere"
    differences, success, area = compare_records(record, again)
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


def diverge(record: RunRecord) -> None:
    evaluation = record.evaluations[1]
    evaluation.diagnostics["td_error"] = None
    evaluation.nonfinite["diagnostics/td_error"] = "nan"


def play_more(record: RunRecord) -> None:
    record.evaluations[1].episodes = make_evaluation([1, 0, 1, 0, 1]).episodes


def put(name: str, value: Any, *place: Any) -> Callable[[RunRecord], None]:
    """Give what is at a place in the record another value."""

    def change(record: Any) -> None:
        for key in place:
            record = record[key] if isinstance(key, int) else getattr(record, key)
        record.__setitem__(name, value) if isinstance(record, dict) else setattr(
            record, name, value
        )

    return change


FLIPPED = [True, True, True, False]
DIAGNOSTICS = ("evaluations", 2, "diagnostics")


@pytest.mark.parametrize(
    ("change", "part", "first", "differ"),
    [
        (put("success_once", FLIPPED, "evaluations", 1, "episodes"), "episodes", 25_000, 1),
        (put("q_mean", -2.5, *DIAGNOSTICS), "diagnostics", 50_000, 1),
        (lambda record: record.evaluations[0].diagnostics.pop("q_mean"), "diagnostics", 0, 1),
        (diverge, "diagnostics", 25_000, 1),
        # What the record has as not measured.
        (put("q_correlation", 0.5, *DIAGNOSTICS), "diagnostics", 50_000, 1),
        (
            lambda record: record.evaluations.append(make_evaluation([1, 0], 60_000)),
            *("episodes", 60_000, None),
        ),
        (play_more, "episodes", 25_000, None),
        (lambda record: record.evaluations.pop(1), "episodes", 25_000, None),
        (put("actor", 1, "parameters"), "parameters", None, 1),
        (put("content_hash", "f" * 64, "base_policy"), "base policy", None, 1),
        (put("updates", 1, "budget"), "budget", None, 1),
    ],
)
def test_every_difference_is_found(
    change: Callable[[RunRecord], None], part: str, first: int | None, differ: int | None
) -> None:
    record = record_of(q_mean=-3.0, q_correlation=None)
    change(again := copy_of(record))
    parts = {one.part: one for one in compare_records(record, again)[0]}
    assert parts[part].first == first
    assert differ is None or parts[part].differ == differ
    assert parts[part].example


def test_what_the_record_lacks_is_not_compared() -> None:
    """Directions, and diagnostics that are newer than the record."""
    record, again = record_of(q_mean=-3.0), record_of(q_mean=-3.0, td_error=1.0)
    for evaluation in again.evaluations:
        evaluation.episodes.direction = [0.1] * 4
    again.base_policy.parameters = 10
    assert compare_records(record, again)[0] == []
    assert compare_records(again, record)[0] != []


# Files and marks


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Five runs of two agents, and a reproduction of two of those of one."""
    records = make_cell({"base": 0.4, "standard": 0.5, "equivariant": 0.8})
    for record in records:
        write_record(record, tmp_path / "records" / f"{record.run_id}.json")
    marks = tmp_path / "marks"
    marks.mkdir()
    for seed, record in enumerate(r for r in records if r.settings.agent == "equivariant"):
        if seed < 2:
            again = copy_of(record)
            again.wall_clock.total += 1
            if seed == 1:
                again.evaluations[1].diagnostics["q_mean"] = -1.0
            reproduce(tmp_path, record, again)
    return tmp_path


def reproduce(folder: Path, record: RunRecord, again: RunRecord) -> Path:
    """The file that says how a record agrees with another one, which is put beside it."""
    path = folder / "records" / f"{record.run_id}.json"
    mark = folder / "marks" / f"{file_hash(path)}.json"
    write_record(again, mark.with_suffix(REPEATED))
    found = reproduction_of(path, mark.with_suffix(REPEATED), ["a note"])
    mark.write_bytes(dump_reproduction(found))
    return mark


def test_the_verdicts_and_the_round_trip_of_a_file(results: Path) -> None:
    found = sorted(read_reproductions(results / "marks").values(), key=lambda r: len(r.differences))
    assert [one.verdict for one in found] == ["exact", "alike"]
    assert found[1].conditions == ["a note"]
    (difference,) = found[1].differences
    assert (difference.part, difference.largest) == ("diagnostics", 4.0)
    assert "q_mean" in difference.example


def test_rows_and_runs_are_marked(results: Path) -> None:
    records, marks = results / "records", results / "marks"
    plain = {path.name: path.read_bytes() for path in generate([records], results / "plain")}
    written = {
        path.name: path.read_text()
        for path in generate([records], results / "board", reproductions=marks)
        if path.suffix in (".md", ".csv")
    }
    page = written["LEADERBOARD.md"].replace("\u00a0", " ")
    assert page.count("5 finished, 1 reproduced exactly, 1 reproduced alike") == 1
    assert "made again from their records" in page
    listed = csv.DictReader(io.StringIO(written["records.csv"]))
    assert sorted(filter(None, (run["reproduced"] for run in listed))) == ["alike", "exact"]
    counted = {
        row["agent"]: (row["reproduced_exactly"], row["reproduced_alike"], row["not_reproduced"])
        for row in csv.DictReader(io.StringIO(written["leaderboard.csv"]))
    }
    assert counted["equivariant"] == ("1", "1", "0")
    assert counted["standard"] == ("0", "0", "0")
    # Without reproductions nothing changes: neither words nor columns.
    assert b"eproduced" not in plain["LEADERBOARD.md"] + plain["leaderboard.csv"]
    unmarked = summarize(load_runs([records])).tables[0]
    assert status(unmarked.row_of("equivariant")).replace("\u00a0", " ") == "5 finished"


def test_the_site_marks_rows_and_runs(results: Path) -> None:
    pytest.importorskip("jinja2")
    site = results / "site"
    generate_site([results / "records"], site, "paper", docs=False, reproductions=results / "marks")
    assert "1\u00a0reproduced" in (site / "index.html").read_text()
    pages = [path.read_text() for path in sorted((site / "runs").glob("*equivariant*.html"))]
    assert sum("reproduced exactly on 2026-01-31" in text for text in pages) == 1
    assert sum("made again" in text for text in pages) == 2
    assert "made again from their records" in (site / "findings.html").read_text()


def repeated_of(results: Path) -> set[Path]:
    return set((results / "marks").glob(f"*{REPEATED}"))


def lists(results: Path, *files: Path) -> Path:
    """A study with a list of these files."""
    lines = (f"{file_hash(path)}  {path.name}\n" for path in files)
    (results / "own.sha256").write_text("".join(lines))
    (results / "own.toml").touch()
    return results / "own.toml"


def report(results: Path, *more: str) -> int:
    out = str(results / "board")
    marks = ("--reproductions", str(results / "marks"))
    return main([str(results / "records"), "--out", out, *marks, *more])


def test_a_stale_reproduction_is_named(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(results) == 0
    assert report(results, "--verify") == 0
    capsys.readouterr()
    record = next((results / "records").glob("*equivariant-0.json"))
    old = file_hash(record)
    record.write_text(record.read_text().replace('"alpha":0.01', '"alpha":0.02') + "\n")
    for more in ([], ["--verify"]):
        assert report(results, *more) == 2
        error = capsys.readouterr().err
        assert f"{old}.json is about a record of run-none-equivariant-0" in error
        assert error.count("\n") == 1
    # One of a record that is not among these is of another leaderboard.
    record.unlink()
    assert report(results) == 0


def test_a_bad_reproduction_is_one_sentence(results: Path) -> None:
    good = next(iter(sorted({*(results / "marks").glob("*.json")} - repeated_of(results))))
    text = good.read_text()
    for damaged in (
        "",
        text[:-9],
        "3",
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
    with pytest.raises(UserError, match=r"is no folder"):
        generate([results / "records"], results / "board", reproductions=results / "nowhere")


def edited(mark: Path, **changes: Any) -> None:
    """A reproduction that says something else, in the form that it should have."""
    data = json.loads(mark.read_text())
    for key, value in changes.items():
        data[key] = value if isinstance(value, str | list) else data[key] | value
    mark.write_bytes(dump_reproduction(Reproduction.model_validate_json(json.dumps(data))))


OTHER_NUMBERS: list[dict[str, Any]] = [
    {"verdict": "different"},
    {"verdict": "exact", "differences": []},
    {"success": {"repeated": 1.0, "low": -0.1, "high": 0.4}},
    {"success": {"recorded": 0.9}},
    {"area": {"recorded": 0.9}},
    {"record": {"run_id": "run-none-equivariant-4"}},
    {"repeated": {"sha256": "ab" * 32}},
    {"repeated": {"started": "2020-01-01T00:00:00+00:00"}},
]


@pytest.mark.parametrize("changes", OTHER_NUMBERS)
def test_numbers_that_the_records_do_not_give_are_refused(
    changes: dict[str, Any], results: Path
) -> None:
    mark = {one.verdict: p for p, one in marks_of(results).items()}["alike"]
    assert len(load_runs([results / "records"], results / "marks")) == 15
    edited(mark, **changes)
    with pytest.raises(UserError, match=rf"{mark.name} says something else than the records"):
        load_runs([results / "records"], results / "marks")


def marks_of(results: Path) -> dict[Path, Reproduction]:
    found = read_reproductions(results / "marks")
    return {results / "marks" / f"{digest}.json": one for digest, one in found.items()}


def test_the_repeated_run_has_the_configuration_of_the_record(results: Path) -> None:
    record = read_record(results / "records" / "run-none-equivariant-2.json")
    config = record.config | {"learning_rate": 1.0}
    again = copy_of(record).model_dump(by_alias=True) | {"config": config}
    del again["config_hash"]
    reproduce(results, record, RunRecord.model_validate(again))
    with pytest.raises(UserError, match="says something else"):
        load_runs([results / "records"], results / "marks")


def test_an_unfinished_repeated_run_is_one_sentence(results: Path) -> None:
    mark = next(iter(marks_of(results)))
    data = json.loads(mark.with_suffix(REPEATED).read_text())
    data["evaluations"][-1]["final"] = False
    data.update(status="failed", failure="stopped")
    mark.with_suffix(REPEATED).write_text(json.dumps(data))
    with pytest.raises(UserError, match="says something else"):
        load_runs([results / "records"], results / "marks")


def test_without_the_repeated_record_the_list_decides(
    results: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest reproductions lack it."""
    for path in repeated_of(results):
        path.unlink()
    own = sorted((results / "records").iterdir())
    with pytest.raises(UserError, match=r"the repeated record .* is not beside it"):
        load_runs([results / "records"], results / "marks")
    listed = read_study(str(lists(results, *own, *marks_of(results)))).listed
    counted = load_runs([results / "records"], results / "marks", listed)
    assert sorted(r.reproduction.verdict for r in counted if r.reproduction) == ["alike", "exact"]
    monkeypatch.setattr(study, "FOLDER", results)
    assert len(load_runs([results / "records"], results / "marks")) == 15


# Marks of submitted runs


@pytest.fixture
def submitted(results: Path) -> Path:
    """Runs of a wonderful agent and bad ones of a known agent are handed in."""
    others = make_cell({"wonder": 1.0, "equivariant": 0.1, "base": 0.9}, seeds=6)
    for record in others:
        record.started += timedelta(days=9)
        record.ended = record.started + timedelta(seconds=1)
        record.run_id = f"new-{record.run_id}"
        write_record(record, results / "records" / f"{record.run_id}.json")
    return results


def own_files(results: Path) -> list[Path]:
    return [*sorted((results / "records").glob("run-*")), *marks_of(results)]


def tables_of(results: Path, *listed: Path) -> Table:
    found = read_study(str(lists(results, *listed))).listed
    runs = load_runs([results / "records"], results / "marks", found)
    (table,) = summarize(runs).tables
    return table


@pytest.mark.long
def test_submitted_rows_are_marked_last_and_change_nothing(submitted: Path) -> None:
    runs = load_runs([submitted / "records"], submitted / "marks")
    assert not any(row.marked for row in summarize(runs).tables[0].rows)  # without a list
    own = own_files(submitted)
    study_file = str(lists(submitted, *own))
    both = {
        path.name: path.read_text()
        for path in generate(
            [submitted / "records"], submitted / "board", None, study_file, submitted / "marks"
        )
        if path.suffix in (".md", ".csv")
    }
    table = tables_of(submitted, *own)
    assert [row.label for row in table.rows if row.marked] == [
        "base (not reproduced)",
        "equivariant (not reproduced)",
        "wonder (not reproduced)",
    ]
    assert [row.marked for row in table.rows] == [False] * 3 + [True] * 3
    assert table.best_reference is table.row_of("base") is table.rows[0]
    assert (table.row_of("wonder"), table.rows[5].rank) == (None, None)
    assert table.rows[5].difference is not None
    page = both["LEADERBOARD.md"].replace("\u00a0", " ")
    assert "submitted runs that no maintainer has made again" in page
    assert "| 0.40 | 0.50 | 0.80 \u25b2 | 1.00 \u25b2 not reproduced |" in page
    ranks = re.findall(r"^\| (\S+) \| `[^`]+` \| [\d.]+<br>", page, re.M)
    assert ranks == ["\u2013", "1", "2", "\u2013", "\u2013", "\u2013"]
    rows = list(csv.DictReader(io.StringIO(both["leaderboard.csv"])))
    assert [(row["agent"], row["marked"], row["rank"]) for row in rows][3:] == [
        (agent, "1", "") for agent in ("base", "equivariant", "wonder")
    ]
    # The rows of the maintainers' own runs are what they are without the others.
    for path in (submitted / "records").glob("new-*"):
        path.unlink()
    alone = tables_of(submitted, *own)
    for row, other in zip(alone.rows, table.rows, strict=False):
        names = ("label", "rank", "success", "difference", "against_best", "missing", "area")
        assert [getattr(row, n) for n in names] == [getattr(other, n) for n in names]
    assert (alone.threshold, alone.feasible) == (table.threshold, table.feasible)
    generate([submitted / "records"], submitted / "alone", None, study_file, submitted / "marks")
    files = [submitted / "alone" / name for name in ("LEADERBOARD.md", "leaderboard.csv")]
    assert not any(re.search("marked|not reproduced", file.read_text()) for file in files)


def test_a_maintainers_reproduction_of_one_run_takes_the_mark_of_its_row(submitted: Path) -> None:
    own = own_files(submitted)
    record = read_record(submitted / "records" / "new-run-none-wonder-3.json")
    again = copy_of(record)
    again.wall_clock.total += 1
    mark = reproduce(submitted, record, again)
    with pytest.raises(UserError, match=rf"{mark.name} does not count, because the list"):
        tables_of(submitted, *own)
    table = tables_of(submitted, *own, mark)
    assert {row.agent for row in table.rows if row.marked} == {"base", "equivariant"}
    row = table.row_of("wonder")
    assert row is not None
    assert (row.rank, len(row.runs), row.label) == (1, 6, "wonder")
    # One that does not agree takes no mark.
    (mark.with_suffix(REPEATED)).unlink()
    again.evaluations[-1].episodes = make_evaluation([0] * 40).episodes
    mark = reproduce(submitted, record, again)
    assert marks_of(submitted)[mark].verdict == "different"
    assert tables_of(submitted, *own, mark).row_of("wonder") is None


@pytest.mark.parametrize("line", ["", "x" * 64 + "  name.json"])
def test_a_bad_list_is_one_sentence(line: str, results: Path) -> None:
    path = lists(results)
    path.with_suffix(".sha256").write_text(f"{'0' * 64}  name\n{line}\n")
    with pytest.raises(UserError, match=r"own\.sha256, line 2 is none of `sha256sum`"):
        read_study(str(path))


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
