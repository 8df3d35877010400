"""Runs that were made again from their records: what agrees, and the files that say so.

A reproduction belongs to the bytes of one record file. On one kind of machine, with the same code
and packages, a run on the CPU repeats to the last digit; elsewhere its final success may be alike.
"""

from __future__ import annotations

import hashlib
import json
import math
from codecs import BOM_UTF8
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Self, get_args

from pydantic import ValidationError, model_validator

from symsteer.errors import UserError, first_problem
from symsteer.leaderboard.records.files import read_record
from symsteer.leaderboard.records.measures import area_under_curve, newcombe
from symsteer.leaderboard.records.provenance import Provenance
from symsteer.leaderboard.records.retired import with_retired
from symsteer.leaderboard.records.schema import RunRecord
from symsteer.leaderboard.records.values import (
    Count,
    Finite,
    Moment,
    Name,
    RecordBlock,
    RunId,
    Sha256,
    Share,
    Text,
    flat,
    json_lines,
    leaves,
)

Verdict = Literal["exact", "alike", "different"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)

REPRODUCED: dict[Verdict, str] = {
    "exact": "reproduced exactly",
    "alike": "reproduced alike",
    "different": "NOT reproduced",
}
"""How pages say it of a run."""

Part = Literal[
    "seeds", "parameters", "base policy", "feasible Q", "budget", "episodes", "diagnostics"
]
PARTS: tuple[Part, ...] = get_args(Part)
"""What is compared. Times, provenance and the name of the machine are not."""

REPEATED = ".record.json"
"""What the name of the repeated record ends with, beside the file of a reproduction."""

OF_EVALUATIONS: tuple[Part, ...] = ("episodes", "diagnostics")

IGNORED = {"base_policy": {"training_seconds"}}


class Original(RecordBlock):
    """The record that was repeated: `sha256` is that of its file."""

    run_id: RunId
    sha256: Sha256
    config_hash: Sha256
    commit: Name | None


class Repeated(RecordBlock):
    """The run that repeated it: when, with which code, on what machine."""

    sha256: Sha256
    started: Moment
    ended: Moment
    provenance: Provenance


class Difference(RecordBlock):
    """Values of one part that differ.

    `first` is the step of the first evaluation with one (null outside of evaluations), `largest`
    the largest absolute difference of two numbers (null where none are comparable), `example` the
    first value that differs.
    """

    part: Part
    differ: Count
    of: Count
    first: Count | None
    largest: Finite | None
    example: Text


class Success(RecordBlock):
    """Share of the final episodes with success, and the 95 % interval of `repeated - recorded`.

    Both are samples: it combines their two Wilson intervals (Newcombe 1998, method 10).
    """

    recorded: Share
    repeated: Share
    low: Finite
    high: Finite


class Area(RecordBlock):
    """Area under the success curve as a share of the budget's maximum."""

    recorded: Finite
    repeated: Finite


class Reproduction(RecordBlock):
    """What a repeated run says about a record. `conditions` are what differed beforehand."""

    schema_version: Literal[1] = 1
    verdict: Verdict
    record: Original
    repeated: Repeated
    conditions: list[Text]
    success: Success
    area: Area
    differences: list[Difference]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.record.sha256 == self.repeated.sha256:
            raise ValueError("the record was compared with itself")
        return self


def file_hash(path: Path) -> str:
    """sha256 of a record's file, in hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def compare_records(record: RunRecord, again: RunRecord) -> tuple[list[Difference], Success, Area]:
    """What differs between a finished record and that of the same run made again.

    What the record does not have, such as a diagnostic that is newer, is not compared. Raises
    ValueError for a run that is not finished.
    """
    differences = [_difference(part, record, again) for part in PARTS]
    shares, areas = [], []
    for run in (record, again):
        if run.final is None:
            raise ValueError("only finished runs are compared")
        shares.append(run.final.success_once)
        steps, values = zip(*((e.env_steps, e.success_once) for e in run.evaluations), strict=True)
        areas.append(area_under_curve(steps, values, record.settings.env_steps))
        trials = len(record.evaluations[-1].episodes.seed)
    low, high = newcombe((shares[1] * trials, trials), (shares[0] * trials, trials))
    success = Success(recorded=shares[0], repeated=shares[1], low=low, high=high)
    differing = [difference for difference in differences if difference.differ]
    return differing, success, Area(recorded=areas[0], repeated=areas[1])


def reproduction_of(path: Path, again: Path, conditions: Sequence[str]) -> Reproduction:
    """Compare the record at `path` with that of the repeated run at `again`."""
    record, repeated = read_record(path), read_record(again)
    differences, success, area = compare_records(record, repeated)
    alike: Verdict = "alike" if success.low <= 0 <= success.high else "different"
    return Reproduction(
        verdict=alike if differences else "exact",
        record=Original(
            run_id=record.run_id,
            sha256=file_hash(path),
            config_hash=record.config_hash,
            commit=record.provenance.commit,
        ),
        repeated=Repeated(
            sha256=file_hash(again),
            started=repeated.started,
            ended=repeated.ended or repeated.started,
            provenance=repeated.provenance,
        ),
        conditions=list(conditions),
        success=success,
        area=area,
        differences=differences,
    )


def dump_reproduction(reproduction: Reproduction) -> bytes:
    """The file of a reproduction: strict JSON, a line for each key."""
    return json_lines(reproduction.model_dump(mode="json")).encode()


def read_reproductions(folder: Path) -> dict[str, Reproduction]:
    """The reproductions in a folder by the hash of their record's file; none without the folder.

    Raises:
        UserError: for a file that is damaged, or is not named after the hash of its record.
    """
    reproductions = {}
    for path in sorted(set(folder.glob("*.json")) - set(folder.glob(f"*{REPEATED}"))):
        try:
            data = path.read_bytes().removeprefix(BOM_UTF8)
            reproduction = Reproduction.model_validate_json(data)
        except OSError as error:
            raise UserError(f"{path} cannot be read: {error.strerror}") from error
        except ValidationError as error:
            raise UserError(
                f"{path} is no valid reproduction: {first_problem(error)}; write it again with "
                "`symsteer reproduce`, or remove it"
            ) from error
        if path.stem != reproduction.record.sha256:
            raise UserError(
                f"{path} is about a record with another hash; name it "
                f"{reproduction.record.sha256}.json, or remove it"
            )
        reproductions[path.stem] = reproduction
    return reproductions


def check_reproduction(
    reproduction: Reproduction, path: Path, record: Path, vouched: bool, alone: bool
) -> None:
    """Compute a reproduction again from its record and the repeated one, which lies beside it.

    Args:
        reproduction: the reproduction.
        path: of its file.
        record: of the record that it names.
        vouched: whether a maintainers' list has the hash of this file: then it may be without the
            repeated record.
        alone: whether one that no list has counts as well.

    Raises:
        UserError: if the records give another one, or it does not count.
    """
    again = path.with_suffix(REPEATED)
    if not vouched and not alone:
        raise UserError(
            f"{path} does not count, because the list of the study, which maintainers keep, lacks "
            "it: add its line to the list (docs/submit.md), or remove it"
        )
    if vouched and not again.is_file():
        return
    cure = "make it again with `symsteer reproduce RECORD --into`, or remove it"
    if not again.is_file():
        raise UserError(
            f"{path} cannot be computed again, because the repeated record {again.name} is not "
            f"beside it: {cure}"
        )
    wanted, made = (flat(with_retired(read_record(file).config)) for file in (record, again))
    try:
        agrees = wanted.items() <= made.items() and _rounded(
            reproduction_of(record, again, reproduction.conditions)
        ) == _rounded(reproduction)
    except ValueError:  # one of them is not finished, or they are the same file
        agrees = False
    if not agrees:
        raise UserError(f"{path} says something else than the records that it is about: {cure}")


def _rounded(reproduction: Reproduction) -> Any:
    """Plain data without the last digits, which differ between versions of libraries."""
    text = dump_reproduction(reproduction)
    return json.loads(text, parse_float=lambda number: f"{float(number):.9f}")


_MISSING = object()

Place = tuple[int | None, str]
"""Number of the evaluation if it is in one, and name of a value."""


def _values(run: RunRecord, part: Part) -> dict[Place, Any]:
    """The values of a part."""
    if part not in OF_EVALUATIONS:
        key = part.lower().replace(" ", "_")
        data = run.model_dump(include={key}, exclude=IGNORED)[key]
        return {(None, name): value for name, value in leaves(data)}
    values: dict[Place, Any] = {}
    for number, evaluation in enumerate(run.evaluations):
        if part == "diagnostics":
            data = {"diagnostics": evaluation.diagnostics, "nonfinite": evaluation.nonfinite}
        else:
            data = evaluation.model_dump(include={"env_steps", "decisions", "updates"})
            data |= evaluation.episodes.model_dump(by_alias=True)
        values |= {(number, name): value for name, value in leaves(data)}
    return values


def _difference(part: Part, record: RunRecord, again: RunRecord) -> Difference:
    recorded, repeated = _values(record, part), _values(again, part)
    columns = {name.partition(".")[0] for (_, name), value in recorded.items() if value is not None}

    def is_compared(place: Place) -> bool:
        """Not what the record lacks, but for items of its columns and numbers that are none."""
        if recorded.get(place) is not None:
            return True
        column = place[1].partition(".")[0]
        if part == "diagnostics":
            known = place in recorded or column == "nonfinite"
            return known and repeated.get(place) is not None
        return part == "episodes" and column in columns

    places = [place for place in dict.fromkeys((*recorded, *repeated)) if is_compared(place)]
    values = [(p, recorded.get(p, _MISSING), repeated.get(p, _MISSING)) for p in places]
    differing = [value for value in values if value[1] != value[2]]
    sizes = [
        abs(float(one - other))
        for _, one, other in differing
        if isinstance(one, int | float) and isinstance(other, int | float)
    ]
    first: int | None = None
    example = ""
    if differing:
        (number, name), one, other = differing[0]
        if number is not None:
            run = record if number < len(record.evaluations) else again
            first = run.evaluations[number].env_steps
        example = f"{name.removeprefix('diagnostics.')}: {_shown(one)} -> {_shown(other)}"
    return Difference(
        part=part,
        differ=len(differing),
        of=len(values),
        first=first,
        largest=max(filter(math.isfinite, sizes), default=None),
        example=example[:300],
    )


def _shown(value: Any) -> str:
    if value is _MISSING:
        return "missing"
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, str):
        return " ".join(value.split())[:12]
    return f"{value:.6g}" if isinstance(value, float) else str(value)
