"""The run record: round trip, strictness, damage, and the rule for divergence."""

from __future__ import annotations

import json
import math
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from symsteer.errors import UserError
from symsteer.leaderboard.keys import recipe_of
from symsteer.leaderboard.records import (
    Episodes,
    Evaluation,
    RunRecord,
    config_hash,
    dump_record,
    portable,
    read_record,
    with_retired,
    without_retired,
    write_record,
)
from symsteer.leaderboard.records.retired import RETIRED
from tests.leaderboard.record_factory import (
    GONE,
    START,
    edited,
    make_config,
    make_evaluation,
    make_record,
    put,
)


def refuse_constant(name: str) -> Any:
    raise AssertionError(f"{name} in a record")


def test_round_trip_keeps_everything(tmp_path: Path) -> None:
    record = make_record([make_evaluation([1, 0, 1, 1], q_mean=-3.25, q_violation=0.0)])
    path = tmp_path / "run" / "record.json"
    write_record(record, path)
    assert read_record(path) == record
    assert dump_record(read_record(path)) == path.read_text()
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert read_record(path) == record
    assert sorted(p.name for p in path.parent.iterdir()) == ["record.json"]


ADDED = {
    6: ("base_policy/equivariance_error", "base_policy/jump"),
    5: ("wall_clock/diagnose",),
    4: ("role", *(f"provenance/{name}" for name in ("version", "sha256", "extensions"))),
    2: ("continued", "wall_clock/resumed"),
}
"""What the versions of a record added."""


def older(tmp_path: Path, version: int) -> tuple[RunRecord, Path, dict[str, Any]]:
    """A record and its file as a program of an older schema version would have written it."""
    record = make_record([make_evaluation([1, 0, 1, 1], q_mean=-3.25)])
    added = [place for newer, places in ADDED.items() for place in places if version < newer]
    changes = dict.fromkeys(added, GONE) | {"schema_version": version}
    if version < 3:
        changes |= {"training": None, "feasible_q/entropy_allowance": 0.0}
    data = put(json.loads(dump_record(record)), changes)
    path = tmp_path / "record.json"
    path.write_text(json.dumps(data))
    measured = ("equivariance_error", "jump", "diagnose", "provenance/version")
    return edited(record, {p: None for p in added if p.endswith(measured)}), path, data


@pytest.mark.parametrize("version", range(1, 6))
def test_older_records_are_read_as_new_ones(tmp_path: Path, version: int) -> None:
    record, path, data = older(tmp_path, version)
    assert read_record(path) == record
    if version > 3:
        return
    if version == 3:
        data["continued"] = [data["provenance"] | {"device": "another"}]
    for agent, role in (("zero", "reference"), ("golden-ticket", "reference"), ("my", "learner")):
        data["config"]["agent"] = agent
        data["config_hash"] = config_hash(data["config"])
        path.write_text(json.dumps(data))
        assert read_record(path).role == role
        assert all(part.extensions == [] for part in read_record(path).continued)


def test_conditional_biases_of_version_4_are_never_read_as_those_of_version_5(
    tmp_path: Path,
) -> None:
    _, path, data = older(tmp_path, 4)
    old = {
        **{"q_mean": -5.0, "q_min": -24.0, "q_max": 1.0, "q_abs_max": 25.0, "q_allowance": 1.0},
        **{"q_bias": 3.0, "q_bias_std": None, "q_bias_hard": 2.0, "q_bias_covered": 0.25},
        **{"q_bias_low": -2.0, "return_mean": -9.0},
    }
    data["evaluations"][0] |= {"diagnostics": old, "nonfinite": {"diagnostics/q_bias_std": "nan"}}
    path.write_text(json.dumps(data))
    [evaluation] = (record := read_record(path)).evaluations
    assert evaluation.diagnostics == {
        **{name: old[name] for name in ("q_mean", "q_min", "q_max", "q_abs_max", "q_allowance")},
        "q_bias_successful": 3.0,
        "q_bias_successful_std": None,
        "q_bias_successful_hard": 2.0,
        "q_bias_successful_share": 0.25,
        "q_bias_low": -2.0,
        "return_mean_within_limit": -9.0,
        # The feasible interval is [-20, 0], extended by the allowance.
        "q_magnitude": pytest.approx(25 / 21),
        "q_overshoot": pytest.approx(4 / 22),
    }
    assert evaluation.nonfinite == {"diagnostics/q_bias_successful_std": "nan"}
    assert record.diverged is True
    assert json.loads(dump_record(record))["schema_version"] == 6


@pytest.mark.parametrize("value", [None, "5", 10**400])
def test_what_is_no_number_of_a_measurement_is_not_divided(tmp_path: Path, value: Any) -> None:
    _, path, data = older(tmp_path, 4)
    values = {"q_mean": -5.0, "q_min": -24.0, "q_max": 1.0, "q_abs_max": value}
    data["evaluations"][0]["diagnostics"] = values
    path.write_text(json.dumps(data))
    if value is None:
        assert "q_magnitude" not in read_record(path).evaluations[0].diagnostics
        return
    with pytest.raises(UserError, match=r"q_abs_max|nonfinite"):
        read_record(path)


def test_arrays_and_tensors_are_stored_as_numbers() -> None:
    torch = pytest.importorskip("torch", exc_type=ImportError)
    evaluation = make_evaluation([1, 0], q_mean=np.float32(0.5), alpha=torch.tensor(0.25))
    assert evaluation.diagnostics == {"q_mean": 0.5, "alpha": 0.25}
    columns = {
        "seed": torch.arange(3),
        "success_once": torch.tensor([True, False, True]),
        "success_at_end": [torch.tensor(True), False, np.bool_(False)],
        "return": torch.tensor([0.0, -1.0, -2.0]),
        "episode_len": np.array([5, 6, 7]),
        "direction": torch.tensor([0.5, -3.0, math.nan]),
    }
    episodes = Episodes.model_validate(columns)
    assert episodes.success_once == [True, False, True]
    assert episodes.success_at_end == [True, False, False]
    assert episodes.return_ == [0.0, -1.0, -2.0]
    assert episodes.direction == [0.5, -3.0, None]


def test_numbers_that_are_not_finite_become_flagged_nulls(tmp_path: Path) -> None:
    evaluation = make_evaluation([1, 0], q_mean=math.nan, q_abs_max=1e300, alpha=None)
    data = evaluation.model_dump(by_alias=True)
    data["episodes"]["return"] = [-math.inf, 1.0]
    record = make_record([Evaluation.model_validate(data)])
    path = tmp_path / "record.json"
    write_record(record, path)
    text = json.loads(path.read_text(), parse_constant=refuse_constant)
    stored = text["evaluations"][0]
    assert stored["diagnostics"] == {"q_mean": None, "q_abs_max": None, "alpha": None}
    assert stored["nonfinite"] == {"diagnostics/q_mean": "nan", "diagnostics/q_abs_max": "inf"}
    assert stored["episodes"]["return"] == [None, 1.0]
    assert stored["episodes"]["nonfinite"] == {"return/0": "-inf"}
    assert read_record(path) == record


def test_a_flag_without_its_null_is_refused() -> None:
    data = make_evaluation([1], q_mean=1.0).model_dump(by_alias=True)
    for path in ("diagnostics/q_mean", "diagnostics/nothing", "episodes/return/9"):
        with pytest.raises(ValidationError, match="nonfinite"):
            Evaluation.model_validate(data | {"nonfinite": {path: "nan"}})


def test_only_an_unfinished_record_of_the_same_run_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    record = make_record(status="running")
    record.evaluations[0].diagnostics["q_mean"] = math.inf
    write_record(record, path)
    assert read_record(path).diverged
    with pytest.raises(ValidationError):
        record.status = "done"  # type: ignore[assignment]
    record.status = "failed"
    with pytest.raises(UserError, match="ended"):
        write_record(record, path)
    with pytest.raises(UserError, match="another run"):
        write_record(make_record(seed=1), path)
    write_record(make_record(status="interrupted"), path)
    write_record(make_record(), path)
    with pytest.raises(UserError, match="finished"):
        write_record(make_record(), path)
    path.write_text("{")
    with pytest.raises(UserError, match="strict JSON"):
        write_record(make_record(), path)


def test_configurations_are_checked() -> None:
    for key in ("task", "embodiment", "variant", "agent", "seed", "env_steps", "demonstrations"):
        config = make_config()
        del config[key]
        data = make_record().model_dump(by_alias=True) | {"config": config}
        del data["config_hash"]
        with pytest.raises(ValidationError, match=key):
            RunRecord.model_validate(data)
    assert config_hash(make_config()) == config_hash(dict(reversed(make_config().items())))
    for change in ({"seed": "0"}, {"seed": -1}, {"env_steps": 0}, {"lr": math.nan}, {"lr": {1}}):
        with pytest.raises(ValidationError):
            make_record(**change)


def test_times_become_utc() -> None:
    local = datetime(2026, 1, 31, 14, 0, 0, 5, tzinfo=timezone(timedelta(hours=2)))
    record = make_record()
    record.ended = local
    assert record.ended == START
    assert record.ended.utcoffset() == timedelta(0)
    with pytest.raises(ValidationError, match="zone"):
        record.ended = datetime(2026, 1, 31, 14, 0, 0)


def test_failures_name_no_folder_of_the_machine() -> None:
    text = 'File "/home/me/x/run.py", line 3: C:\\Users\\me\\a.h5 and/or see https://a.org/b/c'
    assert portable(text) == 'File "run.py", line 3: a.h5 and/or see https://a.org/b/c'
    record = make_record(status="failed")
    record.failure = "cannot read /data/private/demo.h5 " + "x" * 5000
    assert record.failure.startswith("cannot read demo.h5 x")
    assert len(record.failure) == 2000


def q_curve(*points: tuple[float, float]) -> list[Evaluation]:
    """Evaluations at even distances with (largest |Q|, overshoot) in the interval [-20, 0]."""
    return [
        make_evaluation(
            [1],
            10_000 * i,
            i == len(points) - 1,
            **{"q_mean": -1.0, "q_abs_max": size, "q_magnitude": size / 20, "q_overshoot": outside},
        )
        for i, (size, outside) in enumerate(points)
    ]


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        # Soft divergence: beyond the largest feasible magnitude, once is enough.
        ([(5, 0.0), (21, 0.05), (5, 0.0)], True),
        ([(5, 0.0), (20, 0.0), (5, 0.0)], False),
        # Growth out of the feasible interval.
        ([(4, 0.0), (4, 0.05), (8, 0.4)], True),
        ([(4, 0.0), (4, 0.4), (8, 0.4)], False),
        ([(4, 0.0), (4, 0.05), (8, 0.1)], False),
        ([(4, 0.0), (4.1, 0.05), (8, 0.4)], False),
        # A failing agent's critic that learns what failure costs.
        ([(1, 0.0), (6, 0.0), (19, 0.0)], False),
        # A good agent whose values approach the upper end.
        ([(15, 0.0), (8, 0.1), (4, 0.2)], False),
        ([(5, 0.0)], False),
    ],
)
def test_divergence(points: list[tuple[float, float]], expected: bool) -> None:
    record = make_record(q_curve(*points))
    assert record.diverged is expected
    found = record.divergence
    assert found is not None
    # At step 0 there was no update.
    sizes, outside = zip(*points[1:], strict=True) if points[1:] else ((), ())
    assert found.magnitude == (max(sizes) / 20 if sizes else None)
    assert found.overshoot == max(outside, default=None)
    assert found.growth == (points[-1][0] / points[1][0] if len(points) == 3 else None)


def test_growth_is_from_the_middle_of_the_run_to_its_end() -> None:
    record = make_record(q_curve((9, 0), (1, 0), (3, 0), (7, 0), (12, 0)))
    assert record.divergence.growth == 4
    record.evaluations[-1].diagnostics["td_error"] = 0.5
    assert record.divergence.td_error == 0.5
    assert make_record(q_curve((0, 0), (0, 0), (1, 0))).divergence.growth is None
    # Untrained critics have not diverged.
    evaluations = q_curve((90, 4.0), (30, 0.5), (10, 0.0))
    evaluations[1].updates = 0
    assert make_record(evaluations).diverged is False


@pytest.mark.parametrize(
    ("diagnostics", "diverged"),
    [
        ({"q_mean": math.nan}, True),
        ({"q_mean": -1.0, "q_abs_max": math.inf}, True),
        ({"q_mean": -1.0, "q_bias": math.nan}, False),
        ({}, None),
    ],
)
def test_q_values_that_are_not_finite_are_divergence_and_a_missing_bias_is_not(
    diagnostics: dict[str, float], diverged: bool | None
) -> None:
    assert make_record([make_evaluation([1], **diagnostics)]).diverged is diverged


# Damage


EDITS: list[tuple[str, Any, str]] = [
    ("schema_version", 7, "schema_version"),
    ("schema_version", True, "schema_version"),
    ("run_id", "../../etc/passwd", "run_id"),
    ("extra", 1, "extra"),
    ("config/env_steps", 60_000, "config_hash"),
    ("config_hash", "0" * 64, "config_hash"),
    ("status", "running", "ended"),
    ("started", "yesterday", "started"),
    ("started", "2026-01-31T12:00:00", "zone"),
    ("ended", "2020-01-01T00:00:00+00:00", "before"),
    ("budget/env_steps", 2**53 + 1, "env_steps"),
    ("wall_clock/total", 1e300, "total"),
    ("base_policy/content_hash", "abc", "content_hash"),
    ("feasible_q/low", 1.0, "low"),
    ("evaluations", [], "final evaluation"),
    ("evaluations/0/episodes/success_once", [1, 0, 2], "0 and 1"),
    ("evaluations/0/episodes/success_once", [1, 0], "equally long"),
    ("evaluations/0/episodes/success_once", [0, 0, 1], "without having had success"),
    ("evaluations/0/episodes/seed", [1, 1, 2], "twice"),
    ("evaluations/0/diagnostics", {"<b>": 1.0}, "diagnostics"),
    ("evaluations/0/diagnostics/q_mean", "-2", "q_mean"),
    ("evaluations/0/nonfinite", {"diagnostics/q_mean": "nan"}, "nonfinite"),
]


@pytest.mark.parametrize(("where", "value", "word"), EDITS)
def test_edited_records_are_refused(tmp_path: Path, where: str, value: Any, word: str) -> None:
    path = tmp_path / "record.json"
    record = make_record([make_evaluation([1, 0, 1], q_mean=-2.0)])
    data = json.loads(dump_record(record))
    path.write_text(json.dumps(put(data, {where: value})))
    with pytest.raises(UserError) as caught:
        read_record(path)
    message = str(caught.value)
    assert word in message
    assert str(path) in message
    assert "\n" not in message


TEXTS: list[tuple[bytes, str]] = [
    (b"", "strict JSON"),
    (b"{}", "not a run record"),
    (b'{"schema_version": 1e999}', "too large"),
    (b'{"schema_version": 1, "schema_version": 1}', "twice"),
    (b'{"schema_version": 1}', "config_hash"),
    (b"\xff\xfe\x00", "UTF-8"),
    (b"[" * 200_000, "strict JSON"),
]


@pytest.mark.parametrize(("text", "word"), TEXTS)
def test_foreign_files_are_refused(tmp_path: Path, text: bytes, word: str) -> None:
    path = tmp_path / "record.json"
    path.write_bytes(text)
    with pytest.raises(UserError, match=word):
        read_record(path)


def test_of_an_option_that_is_no_more_one_value_means_the_same() -> None:
    old = make_config(agent_options={"target_entropy": 0.5, **RETIRED})
    new = make_config(agent_options={"target_entropy": 0.5})
    assert with_retired(new) == with_retired(old) == old
    older, newer = ({**new["agent_options"], name: "noise"} for name in ("critic", "critic_kind"))
    both = [make_config(agent_options=options) for options in (older, newer)]
    assert with_retired(both[0]) == with_retired(both[1])
    assert recipe_of(both[0]) == recipe_of(both[1])
    assert without_retired(both[0], newer)["agent_options"] == newer
    assert without_retired(both[0], older)["agent_options"] == older  # of another package
    policy = {"name": "edp", "process": "diffusion"}
    later = [make_config(policy=policy), make_config(policy=policy, keep_replay=False)]
    assert with_retired(later[0]) == with_retired(later[1]) == later[1]
    assert with_retired(make_config(agent_options={"candidates": 64}))["agent_options"] == {
        "candidates": 64
    }
    config = {"keep_replay": False, "agent_options": {**old["agent_options"], "n_step": 3}}
    options = {"target_entropy": 0.5, "n_step": 3}
    assert without_retired(config, ["target_entropy"]) == {"agent_options": options}
    config = {"keep_replay": True, "agent_options": old["agent_options"]}
    options = {"target_entropy": 0.5, "subset": 2}
    assert without_retired(config, ["subset"]) == {"keep_replay": True, "agent_options": options}
