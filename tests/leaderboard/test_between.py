"""docs/between.md says of the suite dial what its page and its records say."""

import csv
import re
from statistics import mean

import pytest

from symsteer.leaderboard.paths import PAGE_FOLDER

FOLDER = PAGE_FOLDER / "dial"
NUMBER = r"[+-]?\d?\.\d+"
INTERVAL = re.compile(rf"({NUMBER}) \[({NUMBER}),\s+({NUMBER})\]")


@pytest.fixture(scope="module")
def text() -> str:
    """The page up to the next designs."""
    page = (PAGE_FOLDER.parent / "docs" / "between.md").read_text()
    return page.split("\n## The next designs", 1)[0]


def as_on_the_page(number: str) -> str:
    sign, digits = re.fullmatch(r"([+-]?)0?(\.\d+)", number).groups()
    return sign.replace("-", "\u2212") + "0" + digits


def test_intervals_are_those_of_the_page(text):
    page = " ".join(re.sub(r"<br>", " ", (FOLDER / "LEADERBOARD.md").read_text()).split())
    found = INTERVAL.findall(text)
    assert len(found) == 22
    for value, low, high in found:
        wanted = "{} [{}, {}]".format(*map(as_on_the_page, (value, low, high)))
        assert wanted in page, wanted


def test_regrets_are_in_the_row_of_their_learner(text):
    page = (FOLDER / "LEADERBOARD.md").read_text().split("## What a wrong choice costs", 1)[1]
    rows = [line for line in text.splitlines() if line.startswith("| `") and "[" in line]
    assert len(rows) == 4
    for row in rows:
        (learner,) = re.findall("`.*`", row)
        whole = next(line for line in page.splitlines() if line.startswith(f"| {learner} |"))
        shown = re.findall(r"(\S+)\s\[(\S+),\s(\S+)\]", whole)[:4]
        assert [tuple(map(as_on_the_page, each)) for each in INTERVAL.findall(row)] == shown


def test_the_verdicts_are_those_of_the_page(text):
    page = " ".join((FOLDER / "LEADERBOARD.md").read_text().split())
    text = " ".join(text.split())
    above = r"\+0(\.\d+) of (\w+) \(`[a-z-]+`, the best of the others: \+0(\.\d+)\)"
    found = re.findall(above, page)
    assert len(found) == 2
    for ours, measure, others in found:
        wanted = rf"{re.escape(ours)} of {measure} \(declared: [^;]*; the others {others} and more"
        assert re.search(wanted, text), measure
    assert "right in 6/6 by AUC and in 5/6 by success" in page
    assert "by success, 5 of 6 worlds; by area 6 of 6" in text


def test_what_is_counted_is_in_the_records(text):
    with (FOLDER / "records.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert f"{len(rows)} runs" in text

    def of(agent, measure, task, variant):
        cell = {"task": task, "variant": variant, "env_steps": "24000", "agent": agent}
        return {r["seed"]: float(r[measure]) for r in rows if cell.items() <= r.items()}

    world = ("PickCube-v1", "actuator_offset:0.5")
    ours, best = (of(agent, "auc", *world) for agent in ("residual-pathway", "standard"))
    below = sorted(best[seed] - ours[seed] for seed in best)
    assert f"its area is {mean(below):.2f} below".replace("0.", ".") in text
    assert f"by {below[-3]:.2f} to {below[-1]:.2f}".replace("0.", ".") in text
    assert abs(mean(below[:-3])) < 0.005
    assert "was .07 of success below it there, on both tasks" in text
    for task in ("PickCube-v1", "PushCube-v1"):
        world = (task, "action_gain:1")
        ours, best = (of(x, "success", *world) for x in ("residual-pathway", "equivariant"))
        assert mean(best.values()) - mean(ours.values()) == pytest.approx(0.07, abs=0.006)
