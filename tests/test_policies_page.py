"""The tables of docs/base-policies.md, from records whose numbers are known."""

from __future__ import annotations

import hashlib
import json

import pytest

from symsteer import policies_page as page
from symsteer.bench.pages import BEGIN, END
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.text import difference
from symsteer.policies import POLICIES
from tests.leaderboard.record_factory import make_evaluation, make_record

DECODE = [
    {"policy": "edp", "options": {}, "chunks": 64, "median": 3.0, "products": 2.0},
    {"policy": "edp", "options": {}, "chunks": 192, "median": 8.0, "products": 6.0},
    {"policy": "edp", "options": {"width": 32}, "chunks": 192, "median": 4.0, "products": 2.0},
    {"policy": "plain", "options": {}, "chunks": 192, "median": 1.0, "products": 0.5},
    {"device": "cuda", "policy": "plain", "options": {}, "chunks": 192, "median": 9, "products": 1},
]


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
    noisy = {"observation_noise": 0.1, "orbit_targets": True}
    assert page.label_of(run(1, **noisy)) == "`edp` observation_noise 0.1 orbit_targets"
    assert page.label_of(run(1, name="plain")) == "`plain`"
    assert page.label_of(run(1, steps=6000)) == "`edp` steps 6000"
    assert page.label_of(run(1, name="edp-joint", tasks=["PushCube-v1"])) == "`edp-joint`"
    # Records that lack the option are of networks with random first weights.
    old = run(1, name="so2")
    assert page.label_of(old) == "`so2`"
    del old.config["policy"]["zero_output"]
    assert page.label_of(old) == "`so2` zero_output False"
    old = run(1)
    del old.config["policy"]["zero_output"]
    assert page.label_of(old) == "`edp`"


def test_success_is_over_trainings_and_stands_below_its_number_of_demonstrations():
    base = [run(s, seed=s, count=5) for s in (1, 2, 3)] + [run(9, name="plain", count=100)]
    base += [run(10, count=5, task="PushCube-v1")]
    found = rows(page.demonstrations(base, "PickCube-v1"))
    assert found["policy"] == ["5", "100"]
    few, many = found["`edp`"]
    assert few.startswith("0.20 [0.")
    assert many == "-"
    assert found["`plain`"][1].startswith("0.90 [")


def test_differences_are_paired_by_task_training_and_episode():
    pick, push = (
        [run(s, seed=s, task=t) for s in (2, 4, 6)] for t in ("PickCube-v1", "PushCube-v1")
    )
    better = [run(s + 3, "plain", seed=s) for s in (2, 4, 6)]
    found = page.gain(better, pick)
    # The trainings differ among each other, but not in what is gained.
    assert found.value == pytest.approx(0.3)
    assert found.low < 0.3 < found.high
    worse = [run(s - 1, "plain", seed=s, task="PushCube-v1") for s in (2, 4, 6)]
    assert page.gain([*better, *worse], [*pick, *push]).value == pytest.approx(0.1)
    # Neither another training nor another task is a pair.
    assert page.gain([run(9, "plain", seed=3)], pick) is None
    assert page.gain(worse, pick) is None
    table = rows(page.gains([*pick, *better, run(1, "plain", seed=2, count=5)]))
    assert table["policy"] == ["5", "50"]
    assert table["`plain`"][1].startswith("+0.30\xa0[")
    assert "`edp`" not in table
    assert page.gains(better) == ""


def test_policies_with_several_numbers_of_demonstrations_are_compared_with_the_advised_one():
    best = [run(5, seed=1, count=n, zero_output=True) for n in (20, 50)]
    few = run(3, name="plain", seed=1, count=20)
    many = run(9, name="plain", seed=1, count=50)
    once = run(9, name="canonical", seed=1, count=50)
    found = rows(page.gains([*best, few, many, once], page.BEST))
    assert found["policy"] == ["20", "50"]
    gained = [page.gain([one], [rival]) for one, rival in zip((few, many), best, strict=True)]
    assert [one.value for one in gained] == pytest.approx([-0.2, 0.4])
    assert found["`plain`"] == [difference(one) for one in gained]
    assert list(found)[2:] == ["`plain`"]


def test_the_start_at_0_is_compared_with_random_weights_by_number_of_demonstrations():
    base = [run(n // 10, seed=1, count=n, zero_output=True) for n in (20, 50, 100)]
    base += [run(1, seed=1, count=n) for n in (20, 50)]
    found = rows(page.starts(base))
    assert found["policy"] == ["20", "50", "100"]
    gained = [page.gain([own], [other]) for own, other in zip(base[:2], base[3:], strict=True)]
    assert [one.value for one in gained] == pytest.approx([0.1, 0.4])
    assert found[page.BEST] == [*map(difference, gained), difference(None)]
    assert page.starts(base[:3]) == ""


def test_properties_are_those_of_the_policies_that_are_steered():
    base = [run(5, seed=s) for s in range(3)] + [run(5, count=5)]
    base[1].base_policy.equivariance_error = 4e-7
    base[2].base_policy.solvable = None
    found = rows(page.properties(base))["`edp`"]
    trainings, parameters, seconds, error, jump, spread, solvable = found
    assert (trainings, parameters, seconds) == ("3", "1,000", "61")
    assert (error, jump, spread, solvable) == ("2e-07 to 4e-07", "0.03", "0.42", "0.97")


def test_success_stands_beside_the_time_of_decoding_and_the_cheapest_policy_is_first():
    base = [run(8, seed=s, task=task) for s in (1, 2) for task in ("PickCube-v1", "PushCube-v1")]
    base += [run(3, seed=s, width=32) for s in (1, 2)] + [run(5, count=5), run(5, group="D4")]
    found = rows(page.costs(base, DECODE))
    assert found["policy"] == [
        "decode, ms",
        "its products",
        "PickCube",
        "PushCube",
        "against `edp`",
    ]
    # Neither policies that are not timed nor those that were not trained.
    assert list(found)[2:] == ["`edp` width 32", "`edp`"]
    time, share, pick, push, gain = found["`edp` width 32"]
    assert (time, share, pick[:6], push) == ("4.0", "50%", "0.30 [", "-")
    assert gain.startswith("\N{MINUS SIGN}0.50\xa0[")
    assert found["`edp`"][:2] == ["8.0", "75%"]
    assert found["`edp`"][3].startswith("0.80 [")
    assert page.costs(base, []) == ""


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


def test_orbit_targets_are_compared_with_the_same_policy_without_them():
    noisy = {"observation_noise": 1.0}
    base = [run(s, seed=s, **noisy) for s in (2, 4, 6)]
    base += [run(s + 1, seed=s, orbit_targets=True, **noisy) for s in (2, 4, 6)]
    base += [run(9, seed=s) for s in (2, 4, 6)]  # another observation noise
    base += [run(5, seed=2, name="plain-augmented", orbit_targets=True)]
    found = rows(page.orbit_gains(base))
    with_them, without, gained = found["`edp` observation_noise 1.0"]
    assert with_them.startswith("0.50 [")
    assert without.startswith("0.40 [")
    assert gained.startswith("+0.10\xa0[")
    assert found["`plain-augmented`"][1:] == ["-", difference(None)]
    assert page.orbit_gains([run(2)]) == ""


def test_longer_training_is_told_from_the_policy():
    base = [run(s, seed=s) for s in (2, 4, 6)]
    base += [run(s + 2, seed=s, steps=6000) for s in (2, 4, 6)]
    base += [run(s + 1, "plain-augmented", seed=s) for s in (2, 4, 6)]
    for record in base:
        record.base_policy.training_seconds = record.config["policy"]["steps"] / 100
    steered = [run(9, agent="standard", seed=2), run(6, agent="standard", seed=2, steps=6000)]
    others = [run(9, seed=2, count=10)]
    text = page.pairs(base + steered + others)
    lines = [line.strip("| ").split(" | ") for line in text.splitlines()]
    assert lines[0][-2:] == ["`base`", "`standard`"]
    assert [line[:4] for line in lines[2:]] == [
        ["`edp` steps 6000", "60", "`edp`", "15"],
        ["`edp` steps 6000", "60", "`plain-augmented`", "15"],
    ]
    assert [line[4][:5] for line in lines[2:]] == ["+0.20", "+0.10"]
    assert lines[2][5].startswith("\N{MINUS SIGN}0.30")
    assert lines[3][5] == difference(None)
    assert page.pairs([run(2)]) == ""


def test_the_variance_of_the_gradient_is_a_share_of_that_without_orbit_targets():
    where = {"policy": "edp", "observation_noise": 1.0, "own": 4.0}
    cells = [(0, 1, 4.0), (0, 1500, 3.0), (1, 1, 4.0), (1, 1500, 1.0)]
    gradient = [where | {"seed": s, "steps": n, "orbit": v} for s, n, v in cells]
    found = rows(page.variances(gradient))
    assert found["policy"] == ["observation noise", "`steps` 1", "`steps` 1,500"]
    assert found["`edp`"][0] == "1"
    assert found["`edp`"][1] == "1.0000 [1.0000, 1.0000]"
    assert found["`edp`"][2] == "0.5000 [0.2500, 0.7500]"
    assert page.variances([]) == ""


def test_agents_on_a_policy_are_compared_with_the_same_agents_on_the_default():
    records = [run(2, seed=s) for s in range(3)]
    records += [run(8, agent="standard", seed=s) for s in range(3)]
    records += [run(5, "plain", seed=s) for s in range(3)]
    records += [run(6, "plain", agent="standard", seed=s) for s in range(3)]
    # Agents are compared from one number of demonstrations alone.
    records += [run(10, "plain", agent="standard", seed=s, count=5) for s in range(3)]
    # Without an agent.
    records += [run(1, "canonical", seed=s) for s in range(3)]
    found = rows(page.steered_gains(records))
    assert found["policy"] == ["`base`", "`standard`"]
    assert found["`plain`"][0].startswith("+0.30\xa0[")
    assert found["`plain`"][1].startswith("\N{MINUS SIGN}0.20\xa0[")
    assert list(found)[2:] == ["`plain`"]
    assert page.steered_gains(records[6:]) == ""


def test_what_is_known_of_a_policy_is_compared_with_how_far_agents_get():
    base, steered = [run(s, seed=s) for s in range(4)], []
    for record, spread in zip(base, (0.4, 0.3, 0.2, 0.1), strict=True):
        record.base_policy.action_std = spread
        steered.append(run(record.settings.seed + 5, agent="standard", seed=record.settings.seed))
    # Neither a training without its own run, nor another number of demonstrations.
    others = [run(0, agent="standard", seed=9), run(9, count=10), run(9, agent="zero", count=10)]
    found = rows(page.foretold([*base, *steered, *others]))
    assert list(found)[2:] == ["`standard`, PickCube (4)"]
    assert found["`standard`, PickCube (4)"] == ["1.00", "\N{MINUS SIGN}1.00", "-"]
    assert page.foretold(base) == page.foretold(steered) == ""


def test_rows_stand_in_the_order_of_the_lists_of_policies_and_agents():
    records = [run(3, agent="equivariant"), run(3, "plain"), run(3, agent="standard"), run(3)]
    records += [run(3, width=32), run(3, "plain", agent="zero")]
    text = page.render(records, [], [])
    success = text.partition("### PickCube-v1: success")[2].partition("###")[0]
    assert list(rows(success.strip()))[2:] == ["`edp`", "`edp` width 32", "`plain`"]
    assert "| trainings | `base` | `zero` | `standard` | `equivariant` |" in text


def test_tilted_tasks_have_tables_of_their_own():
    records = [run(3, seed=s) for s in (1, 2)]
    records += [run(4, n, seed=1, task="TiltedPickCube-v1") for n in ("edp", "plain")]
    records += [run(4, "spherical", seed=1, task="TiltedPickCube-v1", count=page.MANY)]
    text = page.render(records, [], [])
    level, _, tilted = text.partition("### TiltedPickCube-v1: success")
    assert "`plain`" not in level
    tilted, _, what = tilted.partition("### What they are, on a tilted table")
    assert list(rows(what.partition("\n\n")[2]))[2:] == ["`spherical`"]
    success, _, against = tilted.partition("### Against `edp`, on a tilted table")
    assert list(rows(success.strip()))[2:] == ["`edp`", "`spherical`", "`plain`"]
    assert rows(against.strip())["`plain`"][0].startswith("0.00\xa0[")


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout with an empty page and no records."""
    (tmp_path / "page.md").write_text(f"before\n{BEGIN}old\n{END}after\n")
    monkeypatch.setattr(page, "PAGE", tmp_path / "page.md")
    monkeypatch.setattr(page, "RECORDS", tmp_path / "records")
    monkeypatch.setattr(page, "DECODE", tmp_path / "decode.json")
    monkeypatch.setattr(page, "GRADIENT", tmp_path / "gradient.json")
    return tmp_path


def test_finished_records_are_copied_and_the_page_is_written(checkout, capsys):
    done, begun = run(4), make_record(status="running", seed=9)
    for record in (done, begun):
        write_record(record, checkout / "runs" / record.run_id / "record.json")
    (checkout / "new.json").write_text(json.dumps({"rows": DECODE}))
    assert page.main([str(checkout / "runs"), "--decode", str(checkout / "new.json")]) == 0
    assert "wrote the tables of 1 records" in capsys.readouterr().out
    assert [p.name for p in (checkout / "records").iterdir()] == [f"{done.run_id}.json"]
    written = (checkout / "page.md").read_text()
    assert written.startswith(f"before\n{BEGIN}\n### PickCube-v1: success\n")
    assert "| 8.0 | 75% |" in written
    assert "old" not in written
    # Again, from what is committed.
    assert page.main([]) == 0
    assert (checkout / "page.md").read_text() == written


def test_mistakes(checkout, capsys):
    (checkout / "runs").mkdir()
    assert page.main([str(checkout / "runs")]) == 2
    assert "holds no finished run; name the folder of the sweep" in capsys.readouterr().err
    for name in ("decode", "gradient"):
        for text in ("{", "[]", '{"rows": [{}]}'):
            (checkout / f"{name}.json").write_text(text)
            assert page.main([]) == 2
            error = capsys.readouterr().err
            assert "gradient.json cannot be read (" in error
            assert "write them again with `symsteer throughput --decode --json`" in error
        (checkout / f"{name}.json").unlink()
