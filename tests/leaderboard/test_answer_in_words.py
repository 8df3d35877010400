"""The answer in words: the numbers that a person wrote are those that the records give."""

from __future__ import annotations

import json
import re

import pytest

from symsteer.leaderboard.paths import PAGE_FOLDER, RESULTS, STUDY
from symsteer.leaderboard.study import read_study
from symsteer.leaderboard.summary import Run, load_runs

INTERVAL = re.compile(r"[+\u2212]?\d\.\d+ \[[+\u2212]?\d\.\d+, [+\u2212]?\d\.\d+\]")
SHARE = re.compile(r"\b\d+/\d+\b")

ROWS = {
    "learns faster than plain (`standard`), {}": "Symmetric agents learn faster in unbroken worlds",
    "at equal size, {}": "Symmetric agents learn faster, at equal size",
    "rotated data (`augmented`), {}": "Symmetric networks learn faster than symmetry from data",
    "no difference is seen, {}": "unbroken, 120 k steps",
    "strict ends {}": "Strictness loses to the plain agent there",
    "(two tasks) {}": "With five times the budget the strict agent loses, broken",
    "approximate (`residual-pathway`) {}": "Approximate equivariance beats the plain agent there",
    "and {}. As tuned": "`perception_bias`, 120 k steps",
    "at a defect of {}": "`equivariant` | success | all",
    "at {} with `actuator_offset`": "`equivariant` | success | `actuator_offset`",
    "at {} with `perception_bias`": "`equivariant` | success | `perception_bias`",
}
"""Words of the answer around each interval, and the beginning of the page's row that has it."""


def plain(text: str) -> str:
    """Text on one line, without marks."""
    return " ".join(re.sub("[\u25b2\u25bc>*]|<br>", " ", text).split())


def of_readme() -> str:
    """README.md's section on the leaderboard."""
    text = (PAGE_FOLDER.parent / "README.md").read_text()
    return text.split("## The leaderboard", 1)[1].split("\n## ", 1)[0]


@pytest.fixture(scope="module")
def stress() -> list[Run]:
    return load_runs([RESULTS / "stress"])


def share(runs: list[Run], *agents: str, large: bool = False, **options: float) -> str:
    """In how many runs of these agents, all by default, with these options Q diverged."""
    flags = [
        found.magnitude > 1 if large else found.diverged
        for run in runs
        if (not agents or run.record.config["agent"] in agents)
        and options.items() <= run.record.config["agent_options"].items()
        and (found := run.record.divergence)
    ]
    return f"{sum(flags)}/{len(flags)}"


def test_what_is_said_of_divergence_is_on_its_page_and_in_the_records(stress: list[Run]) -> None:
    study = read_study("divergence")
    page = (PAGE_FOLDER / "stress" / "LEADERBOARD.md").read_text()
    assert (page.count(study.notice), page.count(study.details)) == (1, 1)
    results = plain(page.replace(study.notice, "").replace(study.details, ""))
    text = plain(f"{study.notice} {study.details}")
    assert set(INTERVAL.findall(text)) <= set(INTERVAL.findall(results))
    agents = ("standard", "equivariant", "augmented")
    hasty = {"utd": 4, "layer_norm": False, "soft_backup": False}
    assert SHARE.findall(text) == [
        *(share(stress, layer_norm=norm) for norm in (True, False)),
        *(share(stress, agent) for agent in agents),
        *(share(stress, agent, large=True) for agent in agents),
        share(stress, "standard", "standard-matched", **hasty),
    ]
    assert share(stress, **hasty | {"tau": 0.05, "soft_backup": True}) == "40/40"


def test_the_documentation_counts_diverged_runs_as_the_records_do(stress: list[Run]) -> None:
    text = (PAGE_FOLDER.parent / "docs" / "divergence.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    settings = [(row[0].split(", "), row[1:]) for row in rows if row and row[0].count(", ") == 3]
    (names, agents), *found = settings
    assert len(found) == 8
    for values, counts in found:
        options = dict(zip(names, map(json.loads, values), strict=True))
        assert [f"{count}/10" for count in counts] == [share(stress, a, **options) for a in agents]


@pytest.mark.parametrize("where", ["the page", "README.md"])
def test_every_number_of_the_answer_is_on_the_page(where: str) -> None:
    study = read_study(STUDY)
    page = (PAGE_FOLDER / "LEADERBOARD.md").read_text()
    assert (page.count(study.notice), page.count(study.details)) == (1, 1)
    results = plain(page.replace(study.notice, "").replace(study.details, ""))
    text = plain(of_readme() if where == "README.md" else f"{study.notice} {study.details}")
    for pattern in (INTERVAL, SHARE):
        stated = pattern.findall(text)
        assert stated
        assert [one for one in stated if one not in pattern.findall(results)] == []


def test_every_interval_of_the_answer_is_that_of_its_row() -> None:
    study = read_study(STUDY)
    details = plain(study.details)
    rows = [plain(line) for line in (PAGE_FOLDER / "LEADERBOARD.md").read_text().splitlines()]
    found = []
    for words, row in ROWS.items():
        before, after = (re.escape(part) for part in words.split("{}"))
        (stated,) = re.findall(f"{before}({INTERVAL.pattern}){after}", details)
        assert [one for one in rows if one.startswith(f"| {row}") and stated in one], words
        found.append(stated)
    assert sorted(found) == sorted(INTERVAL.findall(details))
    assert set(INTERVAL.findall(plain(study.notice) + plain(of_readme()))) <= set(found)
