"""Reproductions: what is compared, the files, and the marks of rows and runs."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from pathlib import Path

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.records import (
    Reproduction,
    RunRecord,
    compare_records,
    dump_reproduction,
    file_hash,
    read_reproductions,
    reproduction_of,
    write_record,
)
from symsteer.leaderboard.report import generate
from symsteer.leaderboard.site.build import generate as generate_site
from symsteer.leaderboard.statistics import ShareDifference
from symsteer.leaderboard.summary import load_runs, summarize
from symsteer.leaderboard.tables import status
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


def flip(record: RunRecord) -> None:
    record.evaluations[1].episodes.success_once[1] = True


def shift(record: RunRecord) -> None:
    record.evaluations[2].diagnostics["q_mean"] = -2.5


def unmeasure(record: RunRecord) -> None:
    del record.evaluations[0].diagnostics["q_mean"]


def diverge(record: RunRecord) -> None:
    evaluation = record.evaluations[1]
    evaluation.diagnostics["td_error"] = None
    evaluation.nonfinite["diagnostics/td_error"] = "nan"


def measure(record: RunRecord) -> None:
    """What the record has as not measured."""
    record.evaluations[2].diagnostics["q_correlation"] = 0.5


def shorten(record: RunRecord) -> None:
    del record.evaluations[1]


def lengthen(record: RunRecord) -> None:
    record.evaluations.append(make_evaluation([1, 0], 60_000))


def play_more(record: RunRecord) -> None:
    record.evaluations[1].episodes = make_evaluation([1, 0, 1, 0, 1]).episodes


def grow(record: RunRecord) -> None:
    record.parameters.actor += 1


def retrain(record: RunRecord) -> None:
    record.base_policy.content_hash = "f" * 64


def update_less(record: RunRecord) -> None:
    record.budget.updates -= 1


@pytest.mark.parametrize(
    ("change", "part", "first", "differ"),
    [
        (flip, "episodes", 25_000, 1),
        (shift, "diagnostics", 50_000, 1),
        (unmeasure, "diagnostics", 0, 1),
        (diverge, "diagnostics", 25_000, 1),
        (measure, "diagnostics", 50_000, 1),
        (lengthen, "episodes", 60_000, 1),
        (play_more, "episodes", 25_000, None),
        (shorten, "episodes", 25_000, None),
        (grow, "parameters", None, 1),
        (retrain, "base policy", None, 1),
        (update_less, "budget", None, 1),
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
            write_record(again, tmp_path / "again" / f"{seed}.json")
            path = tmp_path / "records" / f"{record.run_id}.json"
            found = reproduction_of(path, tmp_path / "again" / f"{seed}.json", ["a note"])
            (marks / f"{file_hash(path)}.json").write_bytes(dump_reproduction(found))
    return tmp_path


def test_the_verdicts_and_the_round_trip_of_a_file(results: Path) -> None:
    found = sorted(read_reproductions(results / "marks").values(), key=lambda r: len(r.differences))
    assert [one.verdict for one in found] == ["exact", "alike"]
    assert found[1].conditions == ["a note"]
    (difference,) = found[1].differences
    assert (difference.part, difference.largest) == ("diagnostics", 4.0)
    assert "q_mean" in difference.example


def test_rows_and_runs_are_marked(results: Path) -> None:
    records, out, marks = results / "records", results / "board", results / "marks"
    plain = {path.name: path.read_bytes() for path in generate([records], results / "plain")}
    written = {path.name: path for path in generate([records], out, reproductions=marks)}
    page = written["LEADERBOARD.md"].read_text()
    row = next(line for line in page.splitlines() if "0.80" in line and "`equivariant`" in line)
    (cell,) = [c for c in page.replace("\u00a0", " ").split(" | ") if "1 reproduced exactly" in c]
    assert "5 finished, 1 reproduced exactly, 1 reproduced alike" in cell
    assert row
    assert "made again from their records" in page
    listed = csv.DictReader(io.StringIO(written["records.csv"].read_text()))
    verdicts = [record["reproduced"] for record in listed if record["reproduced"]]
    assert sorted(verdicts) == ["alike", "exact"]
    rows = list(csv.DictReader(io.StringIO(written["leaderboard.csv"].read_text())))
    counted = {
        r["agent"]: (r["reproduced_exactly"], r["reproduced_alike"], r["not_reproduced"])
        for r in rows
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
    good = next((results / "marks").iterdir())
    text = good.read_text()
    for damaged in (
        "",
        text[:-9],
        "3",
        text.replace('"verdict": "exact"', '"verdict": "alike"').replace(
            '"verdict": "alike",\n "record"', '"verdict": "different",\n "record"', 1
        ),
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
