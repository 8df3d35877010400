"""One line a run, for tables: the same names in Python, in records.csv and in the documentation."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import pytest

import symsteer
from symsteer.leaderboard.paths import PAGE_FOLDER
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.report import generate
from tests.leaderboard.record_factory import make_record


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished run and one that is not, beside JSON that is no record."""
    write_record(make_record(), tmp_path / "runs" / "finished.json")
    write_record(make_record(status="running", seed=7), tmp_path / "runs" / "deeper" / "begun.json")
    (tmp_path / "runs" / "audit.json").write_text(json.dumps([{"task": "PickCube-v1"}]))
    return tmp_path / "runs"


def test_a_run_is_one_flat_dict(folder: Path) -> None:
    runs = {run["status"]: run for run in symsteer.read_records(folder)}
    finished, begun = runs["finished"], runs["running"]
    record = make_record()
    assert finished["run"] == record.run_id
    assert finished["last_checkpoint"] == record.final.success_once
    assert finished["base_policy"] == record.base_policy.name
    assert (begun["seed"], begun["success"], begun["auc"]) == (7, None, None)
    assert not any(isinstance(value, dict | list) for value in finished.values())
    (folder / "finished.json").unlink()
    (folder / "deeper" / "begun.json").unlink()
    with pytest.raises(symsteer.UserError, match="holds no record"):
        symsteer.read_records(folder)


def test_python_the_csv_and_the_page_have_the_same_names(folder: Path, tmp_path: Path) -> None:
    keys = set(symsteer.read_records(folder)[0])
    generate([folder / "finished.json"], tmp_path / "board")
    with open(tmp_path / "board" / "records.csv") as file:
        assert set(csv.DictReader(file).fieldnames or ()) == keys | {"row", "reproduced"}
    page = (PAGE_FOLDER.parent / "docs" / "api.md").read_text()
    table = page.partition("## `read_records`")[2].partition("\n## ")[0].partition("| key |")[2]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == keys


def test_the_version_of_a_leaderboard_is_that_of_its_records(tmp_path: Path) -> None:
    versions = []
    for seeds in ([2, 3], [2, 4], [2, 3]):
        place = tmp_path / str(len(versions))
        for seed in seeds:
            write_record(make_record(seed=seed), place / f"{seed}.json")
        generate([place], tmp_path / "board")
        text = (tmp_path / "board" / "LEADERBOARD.md").read_text()
        versions += re.findall(
            r"^.*Version: `(\d{4}-\d\d-\d\d\.[0-9a-f]{8})`\.$", text, re.MULTILINE
        )
        assert text.count(versions[-1]) == 3
    assert versions[0] == versions[2] != versions[1]
    assert versions[0][:10] == f"{make_record().ended:%Y-%m-%d}"
