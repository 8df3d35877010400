"""What a contributor looks for: workflows, forms, the environment, the citation, the data card.

`tests/test_commands.py` reads the commands of `symsteer` in them.
"""

from __future__ import annotations

import datetime
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import yaml
from packaging.specifiers import SpecifierSet

from symsteer.bench.sweep.slurm import SlurmFile
from symsteer.bench.sweep.suite import load_suite
from symsteer.extras import command
from tools.matrix import CELLS

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"))
RECORDS = Path("leaderboard") / "results" / "records"

RUN_HERE = {
    "make setup": "`make lint`, with which .ci/run begins, does it first",
    ".ci/run": "is CI here",
    "pip install uv": "`make setup` does it",
    'python -m tools.matrix "$CELL"': "its table in docs/install.md has a date",
    "tail -n 200 build/matrix/*.log": "only shows",
    '.ci/submission "origin/$BASE"': "test_a_submission_is_checked_and_made_again",
}
"""The lines of the workflows, and where they are run without GitHub."""


def read(path: Path) -> dict:
    return yaml.safe_load(path.read_text())


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_every_line_of_a_workflow_is_run_here_and_sees_the_whole_history(path):
    workflow = read(path)
    assert workflow["permissions"] == {"contents": "read"}
    for job in workflow["jobs"].values():
        assert job["timeout-minutes"]
        assert job["steps"][0]["with"]["fetch-depth"] == 0
        assert {step["run"] for step in job["steps"] if "run" in step} <= RUN_HERE.keys()
        # Texts of a pull request reach the shell in variables only.
        assert "${{" not in " ".join(step.get("run", "") for step in job["steps"])


def test_the_workflow_tries_the_other_cells_of_the_matrix():
    jobs = read(ROOT / ".github" / "workflows" / "ci.yml")["jobs"]
    assert {"pinned", *jobs["versions"]["strategy"]["matrix"]["cell"]} == set(CELLS)


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_a_form_has_what_github_asks_for(path):
    form = read(path)
    assert form.keys() <= {"name", "description", "labels", "title", "body"}
    assert form["name"]
    assert form["description"]
    fields = [item for item in form["body"] if item["type"] != "markdown"]
    assert {item["type"] for item in fields} <= {"input", "textarea", "dropdown", "checkboxes"}
    assert len({item["id"] for item in fields}) == len(fields)
    assert all(item["attributes"]["label"] for item in fields)


def test_contributors_are_told_targets_that_there_are():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M)
    for target in re.findall(r"`?make ([\w-]+)", text):
        assert target in targets
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


def test_the_environment_installs_this_folder_with_a_python_that_it_supports():
    *packages, pip = read(ROOT / "environment.yml")["dependencies"]
    python = packages[0].partition("=")[2]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"{python}.0" in SpecifierSet(project["requires-python"])
    # As docs/install.md does with pip alone.
    assert pip == {"pip": ["."]}
    assert re.search(r"^pip install \. ", (ROOT / "docs" / "install.md").read_text(), re.M)


def test_the_citation_has_the_date_of_its_version():
    citation = read(ROOT / "CITATION.cff")
    assert isinstance(citation["date-released"], datetime.date)
    changes = (ROOT / "CHANGELOG.md").read_text()
    said = re.search(rf"^## \[{citation['version']}\] - (.*)$", changes, re.M)
    assert said[1] in ("unreleased", str(citation["date-released"]))


def test_the_data_card_counts_the_records():
    page = (ROOT / "docs" / "data.md").read_text()
    results = ROOT / "leaderboard" / "results"
    said = {name: int(n) for name, n in re.findall(r"^\| `([\w-]+)` \| (\d+) \|", page, re.M)}
    folders = {path.name for path in results.iterdir() if path.is_dir()}
    assert folders == {name for name in folders if f"`{name}`" in page}
    for name, number in said.items():
        assert len(list((results / name).rglob("*.json"))) == number, name
    assert len(list((results / "base").glob("*/policy.safetensors"))) == 10


def test_the_files_of_the_first_result(tmp_path):
    page = (ROOT / "docs" / "first-result.md").read_text()
    suite, cluster = re.findall(r"^```toml\n(.*?)^```", page, re.M | re.S)
    assert SlurmFile.model_validate(tomllib.loads(cluster)).cpus == 4
    (tmp_path / "mine.toml").write_text(suite)
    runs = load_suite(str(tmp_path / "mine.toml")).runs
    assert len(runs) == 20
    assert {run.policy_seed for run in runs} == {0}


def git(*words: str, cwd: Path) -> None:
    identity = ("-c", "user.name=Someone", "-c", "user.email=someone@example.org")
    subprocess.run(["git", *identity, *words], cwd=cwd, check=True, capture_output=True)


@pytest.fixture
def clone(tmp_path):
    """A clone of the checkout, whose branch `base` lacks one record of `zero`."""
    git("clone", "--quiet", str(ROOT), str(tmp_path), cwd=ROOT)
    shutil.copy(ROOT / ".ci" / "submission", tmp_path / ".ci")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    # Of those, one steers a base policy that is committed.
    for record in (tmp_path / RECORDS / "second").glob("PickCube-v1-floating-none-zero-s25-*"):
        data = record.read_bytes()
        if json.loads(data)["config"]["demonstrations"]["count"] == 50:
            break
    record.unlink()
    git("commit", "--all", "--quiet", "--message", "without it", cwd=tmp_path)
    git("branch", "base", cwd=tmp_path)
    place = tmp_path / RECORDS / "mine" / record.name
    place.parent.mkdir()
    place.write_bytes(data)
    git("add", str(place), cwd=tmp_path)
    return tmp_path, place


def submitted(folder: Path) -> tuple[int, str]:
    git("commit", "--all", "--quiet", "--message", "a submission", cwd=folder)
    done = subprocess.run(
        [".ci/submission", "base"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.slow
def test_a_submission_is_checked_and_made_again(clone):
    code, said = submitted(clone[0])
    assert code == 0, said
    assert f"drawn at random from {RECORDS / 'mine'}" in said
    assert "1 records are admissible, and one of each folder was reproduced" in said


@pytest.mark.long
def test_a_forged_record_and_a_list_of_the_maintainers_are_refused(clone):
    folder, record = clone
    data = json.loads(record.read_text())
    data["evaluations"][-1]["episodes"]["return"][0] = 1.0
    record.write_text(json.dumps(data))
    code, said = submitted(folder)
    assert (code, "NOT ADMISSIBLE" in said) == (2, True), said
    (folder / "leaderboard" / "studies" / "answer.sha256").write_text("")
    code, said = submitted(folder)
    assert (code, "only maintainers change these files" in said) == (1, True), said


def test_pages_install_escnn_as_messages_do():
    pages = {page.name: page.read_text() for page in (ROOT / "docs").rglob("*.md")}
    assert not [name for name, text in pages.items() if "symsteer[escnn]" in text]
    with_command = [name for name, text in pages.items() if command("escnn") in text]
    assert sorted(with_command) == ["hand-push-cube.md", "height-push-cube.md", "install.md"]
