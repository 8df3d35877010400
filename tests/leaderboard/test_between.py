"""docs/between.md says of the suite dial what its page and its records say."""

import csv
import re
from statistics import mean

import numpy as np
import pytest
from scipy import stats

from symsteer.leaderboard.paths import PAGE_FOLDER, RESULTS
from symsteer.leaderboard.runs import load_runs

FOLDER = PAGE_FOLDER / "dial"
NUMBER = r"[+-]?\d?\.\d+"
INTERVAL = re.compile(rf"({NUMBER}) \[({NUMBER}),\s+({NUMBER})\]")


NEXT = "\n## The next designs"


@pytest.fixture(scope="module")
def page() -> str:
    return (PAGE_FOLDER.parent / "docs" / "between.md").read_text()


@pytest.fixture
def text(page) -> str:
    """The page up to the next designs."""
    return page.split(NEXT, 1)[0]


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


def test_the_next_designs_where_the_first_one_failed(page):
    """Means over base policies; paired differences from `standard` with Student's intervals."""
    cell = {"task": "PickCube-v1", "variant": "actuator_offset:0.5", "env_steps": "24000"}
    with (FOLDER / "records.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if cell.items() <= row.items()]
    values = {
        (row["agent"], measure, int(row["seed"])): float(row[measure])
        for row in rows
        for measure in ("auc", "success")
    }
    records = RESULTS.glob("dial-next/PickCube-v1-floating-actuator_offset=0.5-*.json")
    for run in load_runs(records, area_from="first update"):
        for measure, value in (("auc", run.area), ("success", run.success)):
            values[run.agent, measure, run.seed] = value

    def of(agent, measure):
        return np.array([values[agent, measure, seed] for seed in range(150, 162)])

    table = re.findall(r"^\| `([a-z-]+)` \|( \..*)\|$", page.split(NEXT, 1)[1], re.MULTILINE)
    assert len(table) == 6
    for agent, cells in table:
        found = []
        for measure in ("auc", "success"):
            minus = of(agent, measure) - of("standard", measure)
            half = stats.t.ppf(0.975, 11) * minus.std(ddof=1) / np.sqrt(12)
            low, high = minus.mean() - half, minus.mean() + half
            found += [of(agent, measure).mean(), minus.mean(), low, high]
        shown = re.findall(r"[+-]?\.\d+", cells)
        if agent == "standard":
            found = found[::4]
        assert [float(number) for number in shown] == pytest.approx(found, abs=0.00501), agent
