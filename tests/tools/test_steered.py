"""How agents steer the base policies of a task: success, and differences in pairs."""

from __future__ import annotations

import statistics

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import MINUS, SPACE
from tests.leaderboard.record_factory import make_cell, make_record, with_policies
from tools.pages.steered import PAIRS, steering

RATES = {"base": 0.5, "zero": 0.1, "standard": 0.2, "equivariant": 0.8, "residual-pathway": 0.6}
"""At the end; learners begin at 0, so that their areas are others."""


def records(**config):
    """With the seed, every rate rises by 1/40, twice as much that of `equivariant`."""
    made = []
    for seed in range(3):
        for agent, rate in RATES.items():
            end = rate + seed * (1 + (agent == "equivariant")) / 40
            curve = end if agent in ("base", "zero") else [0.0, 0.0, end]
            (record,) = make_cell({agent: curve}, seeds=1, task="PickCube-v1", **config)
            again = {"agent": agent, "seed": seed, "task": "PickCube-v1", **config}
            made.append(make_record(record.evaluations, **again))
    return with_policies(made)


def steered(folder, written):
    folder.mkdir(exist_ok=True)
    for number, record in enumerate(written):
        write_record(record, folder / f"{number}.json")
    return steering(load_runs([folder])).replace(SPACE, " ")


def cells(table):
    return [[c.strip() for c in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


def test_each_agent_and_each_difference(tmp_path):
    reached, gaps = map(cells, steered(tmp_path, records()).split("\n\n"))
    rates = {
        agent: [rate + seed * (1 + (agent == "equivariant")) / 40 for seed in range(3)]
        for agent, rate in RATES.items()
    }
    assert [row[0].strip("`") for row in reached] == list(RATES)
    for row, values in zip(reached, rates.values(), strict=True):
        assert row[1] == f"{values[1]:.2f} [{values[0]:.2f}, {values[2]:.2f}]"
        assert row[2] == "3"
    assert len(gaps) == len(PAIRS)
    for (first, second), (title, value, pairs) in zip(PAIRS, gaps, strict=True):
        assert title == f"`{first}` minus `{second}`"
        apart = [a - b for a, b in zip(rates[first], rates[second], strict=True)]
        # The t of two degrees of freedom is 4.30.
        half = 4.303 * statistics.stdev(apart) / 3**0.5
        middle = statistics.mean(apart)
        ends = [f"{end:+.2f}".replace("-", MINUS) for end in (middle - half, middle + half)]
        assert value.split(" ", 1)[1].startswith(f"[{ends[0]}, {ends[1]}]")
        assert pairs == "3"


@pytest.mark.parametrize("what", ["a run", "an agent", "another world", "a run that goes on"])
def test_what_is_not_whole_is_refused(what, tmp_path):
    written = records()
    if what == "another world":
        written += records(variant="wind:1")
    elif what == "a run that goes on":
        written[-1] = make_record(status="running", **written[-1].config)
        with_policies(written)
    else:
        gone = {
            "a run": written[-1:],
            "an agent": [r for r in written if r.config["agent"] == "zero"],
        }
        written = [record for record in written if record not in gone[what]]
    with pytest.raises(UserError, match="are needed"):
        steered(tmp_path, written)
