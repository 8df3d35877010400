"""Declared claims: each verdict on records whose answer is known, and every way to be untested."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.defects import Audit
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.sections.claims import (
    SECTION,
    ClaimOutcome,
    claims,
    size_text,
    verdict_text,
)
from symsteer.leaderboard.statistics import ShareDifference
from symsteer.leaderboard.study import PAPER, Claim, Kind, Safe, Study, read_study
from tests.leaderboard.record_factory import (
    audit_of,
    diverging,
    make_cell,
    make_evaluation,
    make_record,
    page_of,
    summary_of,
    table_after,
    view_of,
    with_policies,
)

DEFECTS = {"none": 0.01, "wind:0.1": 0.04, "wind:0.5": 0.1, "wind:0.8": 0.26, "wind:1": 0.4}


def claim_of(measure: str = "success", **changes: Any) -> Claim:
    plain = {
        "name": "a claim",
        "family": "one",
        "measure": measure,
        "agents": ["equivariant", "standard"],
        "predicted": 1,
        "smallest": 0.05,
    }
    return Claim.model_validate(plain | changes)


DIVERGED = claim_of("diverged", agents=["standard", "equivariant"])


def outcomes(
    records: Sequence[RunRecord], *claimed: Claim, audit: Audit | None = None
) -> list[ClaimOutcome]:
    study = Study("", "", "", claimed, (), "study.toml", "")
    return claims(study, summary_of(records), audit_of(DEFECTS) if audit is None else audit)


def cells(rates: dict[str, dict[str, float]], seeds: int = 5) -> list[RunRecord]:
    return [r for variant, cell in rates.items() for r in make_cell(cell, seeds, variant=variant)]


def value(outcome: ClaimOutcome) -> float:
    assert outcome.effect is not None
    return outcome.effect.value


def policies(records: Sequence[RunRecord], of: Callable[[RunRecord], str]) -> list[RunRecord]:
    """The same records, with a base policy named by a function of each."""
    for record in records:
        record.base_policy.content_hash = of(record).encode().hex().ljust(64, "0")
    return list(records)


def test_differences_are_means_over_the_selected_cells() -> None:
    rates = {
        "none": {"standard": 0.5, "standard-matched": 0.9, "equivariant": 0.75},
        "wind:0.1": {"standard": 0.5, "standard-matched": 0.9, "equivariant": 0.85},
        "wind:1": {"standard": 0.9, "standard-matched": 0.1, "equivariant": 0.1},
    }
    near = {"cells": {"defect": [0, 0.05]}}
    matched = {"agents": ["equivariant", "standard-matched"]}
    up, down = outcomes(
        cells(rates), claim_of("auc", **near), claim_of("auc", family="two", **near, **matched)
    )
    assert value(up) == pytest.approx(0.3)
    assert (up.verdict, up.cells, up.pairs, up.policies) == ("supported", 2, 10, 1)
    assert value(down) == pytest.approx(-0.1)
    assert down.verdict == "contradicted"
    selections: list[tuple[float, dict[str, Any]]] = [
        (-0.8, {"variant": ["wind:1"]}),
        (-0.225, {"variant": ["wind"]}),
        (0.25, {"broken": False}),
        (-0.225, {"defect": [0.04, 0.4], "task": ["PickCube-v1"], "broken": True}),
    ]
    found = outcomes(cells(rates), *(claim_of(cells=chosen) for _, chosen in selections))
    assert [value(one) for one in found] == pytest.approx([expected for expected, _ in selections])


def test_a_verdict_names_the_task_without_which_it_does_not_hold() -> None:
    """A gains .6, B and C gain nothing; then all gain .3."""
    rates = {"A-v1": 0.9, "B-v1": 0.3, "C-v1": 0.3}
    for gains, rests_on in ((rates, ("A-v1",)), (dict.fromkeys(rates, 0.6), ())):
        records = [
            record
            for task, rate in gains.items()
            for record in make_cell({"standard": 0.3, "equivariant": rate}, task=task)
        ]
        (one,) = outcomes(with_policies(records), claim_of())
        assert (one.verdict, one.rests_on) == ("supported", rests_on)
        assert {task: each.value for task, each in one.by_task.items()} == pytest.approx(
            {task: rate - 0.3 for task, rate in gains.items()}
        )
        assert one.behind_by_task["A-v1"] == f"{gains['A-v1']:.2f} against 0.30"
        words = ", rests on `A-v1`" if rests_on else ""
        assert verdict_text(one) == f"**supported**{words}"


def test_an_effect_is_shown_without_the_tasks_on_which_designs_were_chosen() -> None:
    """A and B gain .6, C nothing: no task alone decides, these two do."""
    records = [
        record
        for task, rate in {"A-v1": 0.9, "B-v1": 0.9, "C-v1": 0.3}.items()
        for record in make_cell({"standard": 0.3, "equivariant": rate}, task=task)
    ]
    summary = summary_of(with_policies(records))
    for chosen, rests_on, left in (
        ((), (), None),
        (("A-v1", "B-v1"), ("A-v1 and B-v1",), 0.0),
        (("D-v1",), (), None),
    ):
        study = Study("", "", "", (claim_of(),), (), "", "", chosen_on=chosen)
        (one,) = claims(study, summary, {})
        assert (one.verdict, one.rests_on) == ("supported", rests_on)
        assert left == (one.without_chosen.value if one.without_chosen else None)
        assert ("in new tasks:" in size_text(one)) == (left is not None)


def test_what_is_equal_on_average_names_the_tasks_where_it_is_not() -> None:
    """A gains .3, B loses .3."""
    records = [
        record
        for task, rates in (("A-v1", (0.3, 0.6)), ("B-v1", (0.6, 0.3)))
        for record in make_cell(
            dict(zip(("standard", "equivariant"), rates, strict=True)), task=task
        )
    ]
    claim = claim_of(predicted=0, smallest=0.2)
    (one,) = outcomes(with_policies(records), claim)
    assert (one.verdict, one.apart) == ("equivalent", ("A-v1", "B-v1"))
    assert verdict_text(one) == "**equivalent** on average, but not in `A-v1` or `B-v1`"
    (one,) = outcomes(with_policies(records), claim.model_copy(update={"smallest": 0.35}))
    assert verdict_text(one) == "**equivalent**"


def test_an_undecided_claim_needs_no_task() -> None:
    """The interval excludes 0, but not after correction: without A it holds 0."""
    one = ClaimOutcome(claim_of(), ShareDifference((9, 10), (1, 10)), p=0.2, rests_on=("A-v1",))
    assert (one.verdict, one.needs) == ("undecided", ())


def test_one_task_is_not_left_out() -> None:
    rates = {"none": {"standard": 0.3, "equivariant": 0.9}}
    (one,) = outcomes(cells(rates), claim_of())
    assert (one.rests_on, one.by_task) == ((), {})


def test_no_difference_is_undecided_until_it_is_shown_to_be_small() -> None:
    records = cells({"none": {"standard": 0.6, "equivariant": 0.6}})
    undecided, equal = outcomes(
        records, claim_of(), claim_of(family="two", smallest=0.3, predicted=0)
    )
    assert value(undecided) == pytest.approx(0)
    assert (undecided.verdict, undecided.reason, equal.verdict) == ("undecided", "", "equivalent")
    # A difference that is there, and smaller than what is of interest.
    small = cells({"none": {"standard": 0.6, "equivariant": 0.625}})
    for record in small:
        for evaluation in record.evaluations:
            evaluation.episodes.success_once.sort()
    found = outcomes(small, claim_of(smallest=0.01), claim_of(smallest=0.3))
    assert [one.verdict for one in found] == ["supported", "equivalent"]
    # One that claims to be equal is contradicted by a difference.
    large = cells({"none": {"standard": 0.1, "equivariant": 0.9}})
    assert outcomes(large, claim_of(predicted=0))[0].verdict == "contradicted"


def test_each_setting_of_a_grid_is_a_cell() -> None:
    records = []
    for tau, utd in product((0.005, 0.05), (1.0, 4.0)):
        rates = {"standard": 0.5, "equivariant": 0.7 if tau < 0.01 else 0.9}
        records += make_cell(rates, agent_options={"tau": tau, "utd": utd})
    (found,) = outcomes(records, claim_of())
    assert (found.cells, found.pairs, found.verdict) == (4, 20, "supported")
    assert value(found) == pytest.approx(0.3)


def test_of_several_settings_the_usual_ones_stand_for_an_agent() -> None:
    """Also where they have fewer runs; of equally usual ones, those with most runs in the cell."""
    unusual = diverging("standard", range(5), learning_rate=1e-3) + diverging("equivariant", [])
    usual = diverging("standard", [])[:3]
    here = claim_of("diverged", agents=DIVERGED.agents, cells={"variant": ["none"]})
    for elsewhere, counts in ((2, "5/5 against 0/5"), (5, "0/3 against 0/3")):
        others = diverging("standard", [], variant="wind:1")[:elsewhere]
        (found,) = outcomes(unusual + usual + others, here)
        assert found.behind == f"{counts} diverged"


def test_verdicts_are_corrected_within_a_family() -> None:
    """A p-value that is just below 0.05 alone is not among others."""
    records = cells({"none": {"standard": 0.5, "equivariant": 0.625, "approximate": 0.5}})
    first = claim_of(name="first")
    other = claim_of(name="other", agents=["approximate", "standard"])
    alone = outcomes(records, first)[0]
    found = outcomes(records, first, *[other] * 3)
    assert 0.0125 < alone.p < 0.05
    assert found[0].p == pytest.approx(4 * alone.p)
    assert (alone.verdict, found[0].verdict) == ("supported", "undecided")
    # Claims of another family, and those that cannot be tested, are no tests of this one.
    for change in ({"family": "two"}, {"agents": ("augmented", "standard")}):
        others = [other.model_copy(update=change)] * 3
        assert outcomes(records, first, *others)[0].p == alone.p


def test_an_interaction_is_tested_as_one() -> None:
    """A gain that is there in all cells alike is none."""
    gain = {"standard": 0.4, "equivariant": 0.8}
    broken = {"cells": {"broken": True}, "minus": {"broken": False}}
    alike, alone = outcomes(
        cells({"none": gain, "wind:1": gain}), claim_of(**broken), claim_of(cells=broken["cells"])
    )
    assert (value(alike), alike.verdict) == (pytest.approx(0), "equivalent")
    assert (value(alone), alone.verdict) == (pytest.approx(0.4), "supported")
    assert alone.behind == alike.behind == "0.80 against 0.40"
    rates = {"none": {"standard": 0.6, "equivariant": 0.6}, "wind:1": gain}
    (found,) = outcomes(cells(rates), claim_of(**broken))
    assert value(found) == pytest.approx(0.4)
    assert (found.verdict, found.cells, found.pairs) == ("supported", 2, 10)
    assert found.behind == "0.80 against 0.40"  # in the broken cell
    (found,) = outcomes(cells({"wind:1": gain}), claim_of(**broken))
    assert found.reason == "there are no unbroken cells"


def test_without_enough_pairs_the_effect_is_shown_and_nothing_decided() -> None:
    rates = {"none": {"standard": 0.1, "equivariant": 0.9}}
    (found,) = outcomes(cells(rates, seeds=4), claim_of())
    assert value(found) == pytest.approx(0.8)
    assert found.verdict == "not tested"
    assert found.reason == "fewer than 5 pairs of runs in every cell"
    few = {"wind:0.1": {"standard": 0.9, "equivariant": 0.1}}
    (found,) = outcomes(cells(rates) + cells(few, seeds=3), claim_of())
    assert value(found) == pytest.approx(0.8)
    assert (found.cells, found.pairs) == (1, 5)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"cells": {"broken": True}}, "there are no broken cells"),
        ({"cells": {"defect": [0.2, 0.3]}}, "there are no cells with a defect of 0.2 to 0.3"),
        ({"cells": {"demonstrations": [5]}}, "there are no cells with 5 demonstrations"),
        ({"cells": {"env_steps": [1000, 2000]}}, "there are no cells with 1,000 or 2,000 steps"),
        ({"agents": ["augmented", "standard"]}, "no runs of `augmented`"),
        ({"measure": "bias"}, "not measured over all decisions"),
        ({"measure": "diverged"}, "nobody diverged"),
        ({"effect": "slope"}, "no base policy was steered at two defects"),
        ({"cells": {"demonstrations": "most"}}, "no cell was run with more than one number"),
        # A study can be reported before its runs that break in the middle exist.
        ({"cells": {"variant": ["wind:1@0.5", "wind:1@0.3..0.7"]}}, "there are no cells with "),
    ],
)
def test_what_is_not_tested_says_why(changes: dict[str, Any], reason: str) -> None:
    records = cells({"none": {"standard": 0.4, "equivariant": 0.6}})
    (found,) = outcomes(records, claim_of(**changes))
    assert (found.verdict, found.effect) == ("not tested", None)
    assert found.reason.startswith(reason)


@pytest.mark.parametrize("status", ["finished", "failed"])
def test_divergence_counts_runs(status: str) -> None:
    """Also those that broke off after diverging; one that goes on can still diverge."""
    standard = diverging("standard", range(5), status)
    (found,) = outcomes(standard + diverging("equivariant", []), DIVERGED)
    assert (found.pairs, found.verdict) == (5, "supported")
    assert found.behind == "5/5 against 0/5 diverged"
    assert found.effect is not None
    interval = found.effect.interval()
    assert (interval.value, interval.high) == (1.0, 1.0)
    assert 0.3 < interval.low < 0.6
    (found,) = outcomes(diverging("standard", [0]) + diverging("equivariant", [1]), DIVERGED)
    assert (value(found), found.verdict) == (0.0, "undecided")
    running = [
        make_record(r.evaluations, "running", seed=r.settings.seed)
        for r in diverging("standard", [])
    ]
    (found,) = outcomes(running + diverging("equivariant", range(5)), DIVERGED)
    assert found.reason.startswith("no runs of both agents")


def test_a_policy_in_two_worlds_is_one_trial() -> None:
    """A policy that makes both agents diverge, or none, does so in every world."""

    def worlds(seeds: Sequence[int]) -> list[RunRecord]:
        return [
            record
            for variant in ("none", "wind:1")
            for agent, broken in (("standard", seeds), ("equivariant", []))
            for record in diverging(agent, broken, variant=variant)
        ]

    (runs,) = outcomes(worlds(range(4)), DIVERGED)
    assert (runs.behind, runs.verdict) == ("8/10 against 0/10 diverged", "supported")
    (drawn,) = outcomes(policies(worlds(range(3)), lambda r: str(r.settings.seed)), DIVERGED)
    assert (drawn.policies, drawn.verdict) == (5, "undecided")
    assert value(drawn) == pytest.approx(0.6)
    # Where all agree, too.
    (drawn,) = outcomes(policies(worlds(range(5)), lambda r: str(r.settings.seed)), DIVERGED)
    assert drawn.effect == ShareDifference((5, 5), (0, 5))


def test_the_size_of_q_and_of_its_bias() -> None:
    def biased(agent: str, biases: Sequence[float]) -> list[RunRecord]:
        records = []
        for seed, bias in enumerate(biases):
            curve = [
                make_evaluation(
                    [1, 0], steps, steps == 50_000, q_mean=0.0, q_bias=b, q_magnitude=abs(bias) / 10
                )
                for steps, b in ((0, 99.0), (45_000, bias - 1), (50_000, bias + 1))
            ]
            records.append(make_record(curve, agent=agent, seed=seed))
        return records

    far, near = [-6.0, 6.0, 7.0, -7.0, 6.0], [2.0, -2.0, 3.0, -3.0, 2.0]
    claimed = [
        claim_of(measure, agents=["standard", "equivariant"], family=measure)
        for measure in ("bias", "magnitude")
    ]
    bias, magnitude = outcomes(biased("standard", far) + biased("equivariant", near), *claimed)
    assert value(bias) == pytest.approx(4.0)
    assert (bias.verdict, bias.pairs) == ("supported", 5)
    assert value(magnitude) == pytest.approx(0.4)


def test_runs_are_compared_on_the_same_base_policy() -> None:
    others = policies(diverging("equivariant", []), lambda r: "other")
    found = outcomes(diverging("standard", range(5)) + others, DIVERGED, claim_of())
    assert all(t.reason.startswith("no runs of both agents with the same seed") for t in found)


def test_demonstrations_and_budgets_select_cells() -> None:
    """Of demonstrations, the fewest and the most, too."""
    records = [
        record
        for count, steps, advantage in ((10, 50, 0.4), (50, 50, 0.2), (100, 50, 0.1), (9, 60, -0.3))
        for record in make_cell(
            {"standard": 0.4, "equivariant": 0.4 + advantage},
            demonstrations={"mode": "diverse", "count": count, "seed": 0},
            env_steps=1000 * steps,
        )
    ]
    found = outcomes(
        records,
        claim_of(cells={"demonstrations": "fewest"}),
        claim_of(cells={"demonstrations": "fewest"}, minus={"demonstrations": "most"}),
        claim_of(cells={"demonstrations": [50, 100]}, family="some"),
        claim_of(cells={"env_steps": [60_000]}, predicted=-1, family="steps"),
    )
    assert [value(one) for one in found] == pytest.approx([0.4, 0.3, 0.15, -0.3])
    assert {one.verdict for one in found} == {"supported"}
    assert [one.cells for one in found] == [1, 2, 2, 1]


def test_the_slope_is_that_within_base_policies() -> None:
    """Between two bodies the advantage rises with the defect, within each it falls."""
    records, audit = [], {}
    for embodiment, level in (("floating", 0.0), ("panda", 0.3)):
        defects = {v: d + level for v, d in DEFECTS.items()}
        audit |= audit_of(defects, embodiment=embodiment)
        for variant, defect in DEFECTS.items():
            rates = {"standard": 0.3, "equivariant": 0.5 - 0.5 * defect + level}
            cell = make_cell(rates, 5, 200, variant=variant, embodiment=embodiment)
            records += policies(cell, lambda r, e=embodiment: f"{e} {r.settings.seed}")
    slope = {"effect": "slope", "predicted": -1, "smallest": 0.01}
    every, floating = outcomes(
        records,
        claim_of(**slope),
        claim_of(**slope, cells={"embodiment": ["floating"]}),
        audit=audit,
    )
    assert value(every) == pytest.approx(-0.05, abs=0.003)
    assert (every.verdict, every.cells, every.policies) == ("supported", 10, 10)
    assert (floating.cells, floating.policies) == (5, 5)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"agents": ["equivarant", "standard"]}, "no agent 'equivarant'; did you mean 'equivaria"),
        ({"cells": {"task": ["PikCube-v1"]}}, "no task 'PikCube-v1'; did you mean 'PickCube-v1'"),
        ({"cells": {"embodiment": ["float"]}}, "did you mean 'floating'"),
        ({"minus": {"variant": ["win"]}}, "no variant 'win'; did you mean 'wind'"),
        ({"cells": {"variant": ["win:1@0.5"]}}, "no variant 'win:1@0.5'; did you mean 'wind:"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words) as refused:
        outcomes(cells({"none": {"standard": 0.5}}), claim_of(**changes))
    assert str(refused.value).startswith("study.toml, 'a claim': there is no ")


def test_the_page_has_every_claim_of_the_paper_tested_or_not() -> None:
    defects = {"none": 0.002, "wind:0.25": 0.1, "wind:0.5": 0.2, "wind:1": 0.4}
    made = [
        record
        for variant, defect in defects.items()
        for record in make_cell(
            {"standard": 0.5, "equivariant": 0.8 - defect, "residual-pathway": 0.7},
            variant=variant,
            episodes=100,
        )
    ]
    _, origin, *blocks = view_of(made, audit=audit_of(defects)).blocks(SECTION)
    assert "declared in `paper.toml` (sha256 `" in origin
    text = "\n".join(["", *blocks]).replace("\u00a0", " ")
    _, _, *rows = table_after(text, "|")
    few = "**not tested**: base policies at several defects: 1, 5 are needed"
    supported = "**supported**, for one base policy alone"
    assert [row[1] for row in rows] == [supported, few, few, supported]
    _, _, effect, size, smallest, p_values, counts = rows[-1]
    assert effect == (
        "success, `residual-pathway` minus `equivariant`, broken cells with `floating` minus the "
        "same in unbroken cells"
    )
    # -0.1 in the unbroken cell; -0.1 + the defect in the broken ones, 0.233 on average.
    assert size.startswith("+0.233<br>[+0.")
    assert (smallest, p_values[-9:], counts) == ("0.05", "<br>1.000", "4, 20, 1")
    untested = text.split("Not tested:\n\n")[1].splitlines()
    assert (
        "- no runs of `wrong-group` in unbroken cells: Control: a wrong group does not help"
        in untested
    )
    named = sum(line.split(": ", 1)[1].count("; ") + 1 for line in untested)
    assert len(rows) + named == len(read_study(PAPER).claims)


def test_a_claim_of_no_effect_says_so_wherever_it_is_named() -> None:
    """Its name alone would say the opposite of its verdict."""
    text = page_of(diverging("standard", range(5)) + diverging("augmented", []), "stress")
    name = "Rotated data prevent value divergence (predicted: no effect)"
    assert f"- **Contradicted** (1): {name}." in text
    assert f"| {name} (divergence under stress) |" in text
    assert "Symmetry prevents value divergence (predicted" not in text


@pytest.mark.parametrize(
    ("declared", "words"),
    [
        (
            {"safe": Safe(agent="standrd", success=1, area=1)},
            "study.toml, safe: there is no agent 'standrd'; did you mean 'standard'",
        ),
        (
            {"kind": Kind(standard=("win",))},
            "study.toml, kind: there is no variant 'win'; did you mean 'wind'",
        ),
    ],
)
def test_the_safe_agent_and_the_kinds_of_a_rule_must_exist(
    declared: dict[str, Any], words: str
) -> None:
    study = Study("", "", "", (), (), "study.toml", "", **declared)
    worlds = {name: {"standard": 0.5, "equivariant": 0.6} for name in ("none", "wind:1")}
    with pytest.raises(UserError, match=words):
        claims(study, summary_of(cells(worlds)), {})
