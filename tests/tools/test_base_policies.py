"""Known numbers in the tables of docs/base-policies.md; `test_pages` compares the whole page."""

from __future__ import annotations

import hashlib

import pytest

from symsteer.policies import POLICIES
from tests.leaderboard.record_factory import make_evaluation, make_record
from tools.pages import base_policies as page


def run(successes, name="edp", agent="base", seed=0, count=50, task="PickCube-v1", **options):
    """A record of ten episodes, of which the first ones are solved."""
    policy = {"name": name, **POLICIES.get(name).Options().to_json(), **options}
    record = make_record(
        [make_evaluation([1] * successes + [0] * (10 - successes))],
        task=task,
        agent=agent,
        seed=seed,
        policy=policy,
        demonstrations={"mode": "diverse", "count": count, "seed": seed},
    )
    record.run_id = f"{name}-{agent}-{count}-{seed}"
    record.base_policy.content_hash = hashlib.sha256(f"{name}{seed}{count}".encode()).hexdigest()
    record.base_policy.parameters = 1000
    return record


def rows(text):
    lines = [line.strip("| ").split(" | ") for line in text.splitlines()]
    return {line[0]: line[1:] for line in lines}


def test_a_policy_is_named_by_the_options_that_are_not_the_default():
    assert page.label_of(run(1)) == "`edp`"
    assert page.label_of(run(1, group="D4")) == "`edp` D4"
    flow = run(1, process="flow", prediction="velocity", sampling_steps=4)
    assert page.label_of(flow) == "`edp` velocity flow sampling_steps 4"
    assert page.label_of(run(1, name="edp-joint", tasks=["PushCube-v1"])) == "`edp-joint`"
    # Records that lack the option are of networks with random first weights.
    old = run(1, name="so2")
    assert page.label_of(old) == "`so2`"
    del old.config["policy"]["zero_output"]
    assert page.label_of(old) == "`so2` zero_output False"
    old = run(1)
    del old.config["policy"]["zero_output"]
    assert page.label_of(old) == "`edp`"


def test_differences_are_paired_by_task_training_and_episode():
    pick, push = (
        [run(s, seed=s, task=t) for s in (2, 4, 6)] for t in ("PickCube-v1", "PushCube-v1")
    )
    better = [run(s + 3, "plain", seed=s) for s in (2, 4, 6)]
    gained = page.gain(better, pick)
    # The trainings differ among each other, but not in what is gained.
    assert gained.value == pytest.approx(0.3)
    assert gained.low < 0.3 < gained.high
    worse = [run(s - 1, "plain", seed=s, task="PushCube-v1") for s in (2, 4, 6)]
    assert page.gain([*better, *worse], [*pick, *push]).value == pytest.approx(0.1)
    # Neither another training nor another task is a pair.
    assert page.gain([run(9, "plain", seed=3)], pick) is None
    assert page.gain(worse, pick) is None


def test_agents_are_compared_on_the_trainings_that_all_have():
    records = [run(2, seed=s) for s in range(3)]
    records += [run(8, agent="standard", seed=s) for s in (0, 1)]
    records += [run(10, agent="standard", seed=2, count=5)]
    # The same seed, trained again on another machine.
    records.append(run(10, agent="standard", seed=2))
    records[-1].base_policy.content_hash = "f" * 64
    text = page.steered(records)
    assert "| policy | task | trainings | `base` | `standard` |" in text
    (row,) = [line for line in text.splitlines() if line.startswith("| `edp`")]
    cells = row.strip("| ").split(" | ")
    assert cells[:3] == ["`edp`", "PickCube", "2"]
    assert cells[3].startswith("0.20 [")
    assert cells[4].startswith("0.80 [")
    # Policies that no agent steers have no row.
    assert page.steered([run(2)]) == ""


def test_what_is_known_of_a_policy_is_compared_with_how_far_agents_get():
    base, steered = [run(s, seed=s) for s in range(4)], []
    for record, spread in zip(base, (0.4, 0.3, 0.2, 0.1), strict=True):
        record.base_policy.action_std = spread
        steered.append(run(record.settings.seed + 5, agent="standard", seed=record.settings.seed))
    # Neither a training without its own run, nor another number of demonstrations.
    others = [run(0, agent="standard", seed=9), run(9, count=10), run(9, agent="zero", count=10)]
    table = rows(page.foretold([*base, *steered, *others]))
    assert list(table)[2:] == ["`standard`, PickCube (4)"]
    assert table["`standard`, PickCube (4)"] == ["1.00", "\N{MINUS SIGN}1.00", "-"]
    assert page.foretold(base) == page.foretold(steered) == ""
