"""Grouping, pairing, ranking: from records to rows."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from symsteer.leaderboard.keys import recipe_of
from symsteer.leaderboard.pairs import area_difference, area_pairs, reference_success, success_pairs
from symsteer.leaderboard.records import Evaluation, RunRecord, config_hash
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import AgentRow, Summary
from symsteer.leaderboard.runs import Pair, Run
from symsteer.leaderboard.sections.cells import render_csv
from symsteer.leaderboard.statistics import Sample
from tests.leaderboard.record_factory import (
    edited,
    make_cell,
    make_curve,
    make_evaluation,
    make_record,
    summary_of,
)


def run(record: RunRecord, name: str = "") -> Run:
    return Run(Path(name or f"{record.run_id}.json"), record)


def outcomes(rate: float, seed: int, number: int = 100) -> list[int]:
    return (np.random.default_rng(seed).random(number) < rate).astype(int).tolist()


def of(rate: float, **config: Any) -> Run:
    """A finished run with one evaluation at the given success rate."""
    seed = 1000 * config.get("seed", 0) + int(1000 * rate)
    return run(make_record([make_evaluation(outcomes(rate, seed))], **config))


def row(summary: Summary, agent: str, table: int = 0) -> AgentRow:
    return next(r for r in summary.tables[table].rows if r.agent == agent)


def test_rows_come_in_the_fixed_order() -> None:
    agents = ["mine", "approximate", "zero", "equivariant", "standard", "base", "standard-matched"]
    agents.append("golden-ticket")
    summary = summarize([of(0.5, agent=agent) for agent in agents])
    learners = ["standard", "standard-matched", "equivariant", "approximate", "mine"]
    assert summary.agents == ["base", "zero", "golden-ticket", *learners]
    assert [r.agent for r in summary.tables[0].rows] == summary.agents


def test_what_cannot_be_compared_is_in_different_tables() -> None:
    """The unbroken control comes first; an arm breaks the symmetry by itself."""
    few = {"mode": "diverse", "count": 20, "seed": 0}
    variant = {"variant": "action_gain:0.5"}
    places: list[dict[str, Any]] = [{}, variant, {"embodiment": "panda"}]
    places += [variant | {"embodiment": "panda"}, {"task": "PushCube-v1"}, {"env_steps": 10_000}]
    keys = [
        t.key for t in summarize([of(0.5, **p) for p in (*places, {"demonstrations": few})]).tables
    ]
    assert len(keys) == 7
    broken_by = [k.broken_by for k in keys if k.env_steps == 50_000 and k.demonstrations == 50]
    arm, gain = "arm kinematics", "action_gain:0.5"
    assert broken_by == [(), (gain,), (arm,), (arm, gain), ()]


def test_seeds_and_machine_settings_do_not_split_a_row_but_hyperparameters_do() -> None:
    config = make_record().config
    nested = {"demonstrations": {"mode": "diverse", "count": 50, "seed": 9}}
    for same in ({"seed": 5, "device": "cuda", "policy_seed": 2}, nested):
        assert recipe_of(config) == recipe_of(config | same)
    assert recipe_of(config) != config_hash(config)
    usual = {"lr": 3e-4, "critic": "aliased", "batch_size": 64, "utd": 1, "tau": 0.01}
    changes = [{}, {"critic": "noise"}, {"lr": 1e-3, "utd": 2}, dict.fromkeys(usual, 0)]
    runs = [of(0.5, agent_options=usual | change) for change in changes]
    labels = {
        r.label for r in summarize([*runs, of(0.5, seed=1, agent_options=usual)]).tables[0].rows
    }
    many = next(label for label in labels if "other" in label)
    assert re.fullmatch(r"standard \(5 other settings, [0-9a-f]{6}\)", many)
    assert labels - {many} == {"standard", "standard (critic noise)", "standard (lr 0.001, utd 2)"}


def test_the_settings_of_most_runs_in_all_tables_stand_for_the_agent() -> None:
    """An ablation with as many runs as the rest of its table is an ablation all the same."""
    usual, other = {"lr": 3e-4, "critic": "aliased"}, {"lr": 3e-4, "critic": "noise"}
    runs = [
        *(of(0.9, seed=seed, agent_options=usual) for seed in range(2)),
        *(of(0.2, seed=seed, agent_options=other) for seed in range(3)),
        *(of(0.9, seed=seed, agent_options=usual, variant="wind:1") for seed in range(2)),
    ]
    first, second = sorted(summarize(runs).tables, key=lambda table: table.key.variant)
    labels = [(r.label, r.usual) for r in first.rows]
    assert labels == [("standard", True), ("standard (critic noise)", False)]
    assert first.row_of("standard").label == "standard"
    assert [(r.label, r.usual) for r in second.rows] == labels[:1]


def test_the_difference_to_base_is_paired_by_policy_seed_and_episode() -> None:
    base0, base1 = outcomes(0.4, 1), outcomes(0.2, 2)
    runs = [
        run(make_record([make_evaluation(base0)], agent="base", seed=0)),
        run(make_record([make_evaluation(base1)], agent="base", seed=1)),
        run(make_record([make_evaluation(base0)], agent="zero", seed=0)),
        run(make_record([make_evaluation(base1)], agent="zero", seed=1)),
        # Its base run has another seed, so it is compared with the mean of both base runs.
        run(make_record([make_evaluation([1] * 100)], agent="equivariant", seed=7)),
    ]
    summary = summarize(runs)
    zero = row(summary, "zero").difference
    assert zero is not None
    assert (zero.value, zero.low, zero.high) == (0.0, 0.0, 0.0)
    assert zero.sign == 0
    difference = row(summary, "equivariant").difference
    expected = 1 - (np.mean(base0) + np.mean(base1)) / 2
    assert difference is not None
    assert difference.value == pytest.approx(expected)
    assert row(summary, "base").difference is None


def test_runs_on_another_base_policy_or_other_episodes_are_not_compared() -> None:
    other = edited(make_record(agent="base"), {"base_policy/content_hash": "f" * 64})
    assert reference_success(of(0.5), [run(other)]) == {}
    episodes = make_record([make_evaluation([1, 0], first_seed=1)], agent="base")
    for base in (other, episodes):
        assert row(summarize([run(base), of(0.5)]), "standard").difference is None


def test_unfinished_and_missing_runs_are_kept_and_not_counted() -> None:
    runs = [
        of(0.4, agent="base", seed=0),
        of(0.4, agent="base", seed=1),
        of(0.6, seed=0),
        run(make_record(status="failed", seed=1)),
        run(make_record(status="interrupted", seed=2)),
        of(0.7, agent="equivariant", variant="action_gain:0.5"),
    ]
    summary = summarize(runs)
    standard = row(summary, "standard")
    assert (len(standard.runs), len(standard.finished), standard.missing) == (3, 1, 0)
    assert row(summary, "base").missing == 1
    absent = row(summary, "equivariant")
    assert absent.runs == []
    assert absent.missing == 3
    assert absent.success is None
    assert row(summary, "standard", 1).missing == 1


def test_curves_give_area_threshold_and_dip() -> None:
    generator = np.random.default_rng(0)
    base = [run(make_record([make_evaluation(outcomes(0.5, 3))], agent="base"))]
    rates = [0.5, 0.05, 0.95, 0.95, 0.95, 0.95]
    curve = make_curve(generator, rates)
    summary = summarize([*base, run(make_record(curve))])
    standard, table = row(summary, "standard"), summary.tables[0]
    heights = [evaluation.success_once for evaluation in curve]
    assert table.threshold == pytest.approx(0.8 * np.mean(heights[-2:]))
    assert standard.threshold_steps == [20_000]
    expected = heights[1] - np.mean(outcomes(0.5, 3))
    assert standard.dip == pytest.approx(expected)
    assert expected < -0.3
    assert standard.area == pytest.approx((sum(heights) - (heights[0] + heights[-1]) / 2) / 5)
    assert row(summary, "base").threshold_steps == []
    assert row(summary, "base").dip is None


@pytest.mark.parametrize(("warmup", "first"), [(0, 0), (2_500, 10_000), (12_500, 0), ("?", 0)])
def test_the_area_counts_from_the_first_update_on(warmup: object, first: int) -> None:
    """A warm-up of 2,500 decisions of four steps; one beyond the budget, or of no number, is none.

    The curve rises from 0 to 1 over 50,000 steps.
    """
    options = {"agent_options": {"warmup": warmup}, "policy": {"execute": 4}}
    curve = points((0, [0, 0]), (50_000, [1, 1]))
    assert run(make_record(curve, **options)).area == pytest.approx(0.5)
    found = replace(run(make_record(curve, **options)), area_from="first update")
    assert found.area_begin == first
    assert found.area == pytest.approx((1 + first / 50_000) / 2)
    other = make_record(points((0, [0, 0]), (50_000, [0, 0])), agent="equivariant", **options)
    difference = area_difference(found, run(other), 50_000)
    assert difference
    assert difference.value == pytest.approx(found.area)


def points(*points: tuple[int, list[int]]) -> list[Evaluation]:
    """A curve from (steps, outcomes of the episodes)."""
    return [
        make_evaluation(episodes, steps, steps == points[-1][0], first_seed=100)
        for steps, episodes in points
    ]


def test_the_final_window_pools_the_last_fifth_of_the_budget() -> None:
    curve = points((0, [0, 0]), (39_999, [0, 0]), (40_000, [1, 0]), (50_000, [1, 1, 0, 1]))
    learner = run(make_record(curve))
    last = {(50_000, 100 + i): float(success) for i, success in enumerate([1, 1, 0, 1])}
    assert learner.window == {(40_000, 100): 1.0, (40_000, 101): 0.0} | last
    standard = row(summarize([learner]), "standard")
    assert standard.success.value == learner.success == pytest.approx(4 / 6)
    assert standard.last.value == pytest.approx(3 / 4)
    assert standard.episodes == [6]
    assert run(make_record(curve, "interrupted")).window == {}


def test_the_rise_compares_the_last_two_fifths_on_the_same_episodes() -> None:
    curve = points(
        (29_999, [1, 1, 1]), (30_000, [0, 0]), (39_999, [1, 0]), (40_000, [1, 1]), (50_000, [1] * 4)
    )
    learner = run(make_record(curve))
    assert learner.rise == {100: 0.5, 101: 1.0}
    standard = row(summarize([learner]), "standard")
    assert standard.rise is not None
    assert standard.rise.value == pytest.approx(0.75)
    assert not run(make_record(curve, "interrupted")).rise
    without = points((0, [0, 0]), (50_000, [1, 1]))
    assert row(summarize([run(make_record(without))]), "standard").rise is None
    assert row(summarize([run(make_record(curve, agent="zero"))]), "zero").rise is None


def test_a_reference_is_measured_where_its_search_ended() -> None:
    ticket = make_record(points((12_800, [1, 1, 0])), agent="golden-ticket")
    ticket.budget.env_steps = 12_800
    found = row(summarize([run(ticket)]), "golden-ticket")
    assert found.success
    assert found.success.value == pytest.approx(2 / 3)
    assert (found.search_steps, found.area, found.rank) == (12_800, None, None)
    zero = make_record(points((0, [1, 0, 0])), agent="zero")
    zero.budget.env_steps = 0
    found = row(summarize([run(zero)]), "zero")
    assert found.search_steps is None
    assert found.area == pytest.approx(1 / 3)


def test_learners_are_paired_by_step_and_episode_references_by_episode() -> None:
    first = make_record(points((40_000, [1, 0]), (50_000, [1, 1])), agent="equivariant")
    second = make_record(points((40_000, [0, 0]), (50_000, [0, 1, 1])), agent="standard")
    base = make_record(points((0, [1, 0, 0])), agent="base")
    rows = {r.agent: r for r in summarize(list(map(run, (first, second, base)))).tables[0].rows}

    def differences(pairs: dict[Pair, Sample]) -> dict[int, tuple[float, float]]:
        """By episode seed, their sum and how many evaluations it is over."""
        (sample,) = pairs.values()
        (block,) = sample.blocks
        sums = sample.weights[0] * block.totals
        return dict(zip(block.seeds, zip(sums, block.counts, strict=True), strict=True))

    learners = success_pairs(rows["equivariant"], rows["standard"])
    assert differences(learners) == {100: (2, 2), 101: (0, 2)}
    against = success_pairs(rows["equivariant"], rows["base"])
    assert differences(against) == {100: (0, 2), 101: (1, 2)}
    reverse = success_pairs(rows["base"], rows["equivariant"])
    assert differences(reverse) == {100: (0, 2), 101: (-1, 2)}
    (area,) = area_pairs(rows["equivariant"], rows["standard"], 50_000).values()
    # The first value is held back to 0: 0.5 for 40,000 steps, then to 0.5 (the last one counts the
    # two common episodes alone).
    assert area.value == pytest.approx(0.5)
    assert [block.seeds for block in area.blocks] == [(100, 101), (100, 101)]
    near = make_record(points((39_600, [1, 0]), (50_400, [1, 1])), agent="approximate")
    approximate = row(summarize([run(near), run(second)]), "approximate")
    # Up to 1 % of the budget apart, evaluations belong together.
    (sample,) = success_pairs(approximate, rows["standard"]).values()
    assert sample.value == pytest.approx(0.5)
    (sample,) = area_pairs(approximate, rows["standard"], 50_000).values()
    assert len(sample.blocks) == 2
    other = make_record(points((30_000, [1, 0]), (49_000, [1, 1])), agent="approximate")
    approximate = row(summarize([run(other), run(second)]), "approximate")
    assert success_pairs(approximate, rows["standard"]) == {}


@pytest.mark.parametrize(
    ("allowances", "expected"),
    [((), (-20.0, 0.0)), ((0.5, 2.0, 1.0), (-22.0, 2.0)), ((-3.0,), (-20.0, 0.0))],
)
def test_the_feasible_band_is_widened_by_the_largest_allowance(
    allowances: tuple[float, ...], expected: tuple[float, float]
) -> None:
    curve = [
        make_evaluation([1, 0], 10_000 * i, i == len(allowances) - 1, q_allowance=value)
        for i, value in enumerate(allowances)
    ]
    records = [make_record(agent="standard"), make_record(curve or None, agent="equivariant")]
    assert summarize([run(record) for record in records]).tables[0].feasible == expected


def test_learners_are_compared_with_the_best_reference() -> None:
    runs = [of(rate, agent=agent) for agent, rate in (("base", 0.3), ("zero", 0.6))]
    (table,) = summarize([*runs, of(0.95), of(0.61, agent="equivariant")]).tables
    assert table.best_reference
    assert table.best_reference.agent == "zero"
    signs = {r.agent: r.against_best.sign for r in table.rows if r.against_best}
    assert signs == {"standard": 1, "equivariant": 0}


def five(agent: str, rate: float, seeds: int = 5) -> list[Run]:
    return [of(rate, agent=agent, seed=seed) for seed in range(seeds)]


def test_ranks_have_ties_and_need_five_seeds() -> None:
    runs = five("standard", 0.5) + five("equivariant", 0.52) + five("approximate", 0.9)
    summary = summarize(runs + five("standard-matched", 0.95, seeds=4) + five("base", 0.99))
    ranks = {r.agent: r.rank for r in summary.tables[0].rows if r.rank}
    assert ranks == {"approximate": 1, "standard": 2, "equivariant": 2}
    # Five seeds each, of which they share four.
    apart = five("standard", 0.5) + [of(0.9, agent="approximate", seed=s) for s in range(1, 6)]
    assert not summarize(apart).tables[0].is_ranked


def test_learners_on_different_base_policies_are_not_compared() -> None:
    others = five("approximate", 0.9)
    for other in others:
        other.record.base_policy.content_hash = "f" * 64
    summary = summarize(five("standard", 0.5) + five("equivariant", 0.8) + others)
    first, second = row(summary, "standard"), row(summary, "approximate")
    assert success_pairs(first, second) == {}
    assert area_pairs(first, second, 50_000) == {}
    # The best agent is not clearly better than any other, and no other is clearly better.
    assert {r.agent: r.rank for r in summary.tables[0].rows} == {
        "equivariant": 1,
        "standard": 2,
        "approximate": None,
    }
    # If only some seeds share the policy, these pairs count.
    others[3].record.base_policy.content_hash = first.runs[3].record.base_policy.content_hash
    assert [seed for _, seed in success_pairs(first, second)] == [3]


def test_a_second_attempt_replaces_the_first_in_plain_sight() -> None:
    def later(record: RunRecord, hour: int, **other: str) -> RunRecord:
        times = {"started": f"2026-02-01T{hour}:00:00Z", "ended": f"2026-02-01T{hour}:30:00Z"}
        return edited(record, times | other)

    new = later(make_record([make_evaluation([1] * 10)]), 13, run_id="again")
    failed = [run(make_record(status="failed"), "a.json")]
    failed.append(run(later(make_record(status="failed"), 15), "f.json"))
    copies = [*failed, of(0.5), run(new, "n.json"), run(new, "copy.json")]
    for seed in range(3):
        random.Random(seed).shuffle(copies)
        summary = summarize(copies)
        chosen = row(summary, "standard").runs
        assert [r.record.run_id for r in chosen] == ["again"]
        assert len(summary.set_aside) == 3


def test_runs_on_several_base_policies_are_runs_of_one_row() -> None:
    """Of other seeds, or trained again on another machine: none replaces another."""
    elsewhere = edited(make_record(), {"base_policy/content_hash": "ab" * 32})
    runs = [of(0.5, policy_seed=policy) for policy in (0, 1, 1)]
    summary = summarize([*runs, of(0.5, seed=2, policy_seed=0), run(elsewhere, "elsewhere.json")])
    configs = [r.record.config for r in row(summary, "standard").runs]
    found = [(c["seed"], c.get("policy_seed")) for c in configs]
    assert sorted(found, key=str) == [(0, 0), (0, 1), (0, None), (2, 0)]
    assert summary.set_aside == []


def test_each_setting_of_a_grid_that_learners_share_is_a_table() -> None:
    both = ["standard", "equivariant"]

    def grid(*settings: tuple[float, float], agents: Sequence[str] = both) -> list[Any]:
        records = [
            record
            for tau, utd in settings
            for record in make_cell(
                dict.fromkeys(agents, 0.5), 1, agent_options={"tau": tau, "utd": utd, "width": 8}
            )
        ]
        found = summary_of(records, make_cell({"base": 0.3}, 1))
        columns = render_csv(found).splitlines()[0].split(",")
        assert ("settings" in columns) == (len(found.tables) > 1)
        return [(t.key.settings, [r.label for r in t.rows if r.runs]) for t in found.tables]

    full = list(product((0.005, 0.05), (1.0, 4.0)))
    assert grid(*full) == [
        ("", ["base"]),
        ("tau 0.005, utd 1.0", both),
        ("tau 0.005, utd 4.0", both),
        ("tau 0.05, utd 1.0", both),
        ("tau 0.05, utd 4.0", both),
    ]
    # One learner, one option at a time, one option alone: rows of one table.
    assert len(grid(*full, agents=["standard"])) == 1
    assert len(grid(*full[:3])) == 1
    assert len(grid(*full[:2])) == 1
    # Learners that do not share it.
    records = make_cell({"standard": 0.5}, 1, agent_options={"tau": 0.1, "utd": 1.0})
    for tau, utd in full:
        options = {"tau": tau, "utd": utd}
        records += make_cell({"equivariant": 0.5}, 1, agent_options=options)
    assert len(summary_of(records).tables) == 1
