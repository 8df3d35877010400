"""The answer in words: the numbers that a person wrote are those that the records give."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from statistics import mean, median

import pytest

from symsteer.leaderboard.paths import PAGE_FOLDER, RESULTS, STUDY
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.study import read_study

INTERVAL = re.compile(r"[+\u2212]?\d\.\d+ \[[+\u2212]?\d\.\d+, [+\u2212]?\d\.\d+\]")
SHARE = re.compile(r"\b\d+/\d+\b")

ROWS = {
    "learns faster than `standard`, {}": "Symmetric agents learn faster in unbroken worlds",
    "at equal size (`standard-matched`), too, {}": "Symmetric agents learn faster, at equal size",
    "rotated data (`augmented`), {}": "Symmetric networks learn faster than symmetry from data",
    "no difference is seen, {}": "unbroken, 120 k steps",
    "that of `equivariant` is {}": "Strictness loses to the plain agent there",
    "(two tasks) {}": "With five times the budget the strict agent loses, broken",
    "That of `residual-pathway` is {}": "Approximate equivariance beats the plain agent there",
    "and then {}. At 24,000 steps": "objects are seen displaced, 120 k steps",
    "`standard` {}. With the most": "Symmetry helps with the fewest demonstrations",
    "two gains differ by {}": "Symmetry helps most with the fewest demonstrations",
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


def test_other_numbers_of_that_page_are_those_of_the_records(stress: list[Run]) -> None:
    text = plain((PAGE_FOLDER.parent / "docs" / "divergence.md").read_text())
    bonuses, success, soft, large = defaultdict(list), defaultdict(list), defaultdict(list), []
    for run in stress:
        config, divergence = run.record.config, run.record.divergence
        options, last = config["agent_options"], run.record.evaluations[-1].diagnostics
        setting = tuple(options[name] for name in ("utd", "layer_norm", "tau", "soft_backup"))
        if options["soft_backup"]:
            bonus = last["alpha"] * last["entropy"] / options["reward_scale"]
            bonuses[setting].append(bonus)
            soft[setting, config["variant"], config["agent"]].append(run.success)
        elif config["agent"] in ("standard", "standard-matched"):
            success[setting].append(run.success)
        if divergence.magnitude > 1:
            large.append((setting, divergence.magnitude))
    worst = (4, False, 0.05, True)
    medians = [median(values) for setting, values in bonuses.items() if setting != worst]
    assert f"{min(medians):.0f} to {max(medians):.0f} units of reward" in text
    assert f"at most .{max(map(mean, soft.values())) * 100:02.0f} of the episodes" in text
    assert f"succeed in .{mean(success[4, False, 0.005, False]) * 100:.0f} of their" in text
    assert f"which succeed in .{mean(success[1, True, 0.005, False]) * 100:.0f}." in text
    near = max(size for setting, size in large if setting[1:3] != (True, 0.05) and setting != worst)
    far = [size for setting, size in large if setting == worst]
    assert f"at most {near:.2f} times" in text
    assert f"{min(far):.1f} to {max(far):.0f} times" in text


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


@pytest.mark.parametrize("where", ["the page", "README.md"])
def test_where_the_advantage_ends_is_said_for_each_task_as_the_page_has_it(where: str) -> None:
    text = plain(of_readme() if where == "README.md" else read_study(STUDY).details)
    (page,) = (PAGE_FOLDER / "pages").glob("defects-*.md")
    rows = [plain(line) for line in page.read_text().splitlines()]
    ends = {}
    for task in ("PickCube-v1", "PushCube-v1", "PlaceSphere-v1"):
        name = f"| `equivariant` | success | all, `{task}` |"
        # Of both embodiments the gripper, which comes first.
        ends[task] = next(row for row in rows if row.startswith(name)).split(" | ")[5]
    assert ends["PlaceSphere-v1"] == "undecided"
    value, low = re.fullmatch(r"(\d\.\d+) \[(\d\.\d+), \u2013\]", ends["PickCube-v1"]).groups()
    assert re.search(
        rf"on PickCube at (a defect of )?{value} \(95 % interval: {low} or more\)", text
    )
    value, high = re.fullmatch(r"(\d\.\d+) \[\u2013, (\d\.\d+)\]", ends["PushCube-v1"]).groups()
    assert f"on PushCube at {value} ({high} or less)" in text
    assert "on PlaceSphere it is undecided" in text
