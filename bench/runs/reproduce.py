"""``symsteer reproduce``: a run made again from its record, and what agrees."""

from __future__ import annotations

import hashlib
import secrets
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.runs.base_policy import take_base
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.folder import CONFIG, RECORD, is_finished, run_id
from symsteer.bench.runs.run import check, execute
from symsteer.bench.runs.stored import extensions_of, newer_options, read_back
from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.leaderboard.records import (
    FILES,
    PARTS,
    REPEATED,
    Provenance,
    Reproduction,
    RunRecord,
    dump_reproduction,
    file_hash,
    read_record,
    reproduction_of,
)
from symsteer.tables import aligned

RESULT = "reproduction.json"

SENTENCES = {
    "exact": "Everything agrees exactly.",
    "alike": "It does not agree exactly; the final success does not differ clearly (the interval "
    "of the difference includes 0).",
    "different": "It does not agree: the final success differs (the interval of the difference "
    "excludes 0).",
}
"""The verdicts in words."""

TAKEN = "demonstrations and base policy are those of other runs, not made anew"

DIGITS = 12
"""Of a record's hash, in the name of the folder of its reproduction."""


@dataclass(frozen=True)
class Reproduced:
    """A run made again: its folder, the files with the comparison, their content, and its cause."""

    run: Path
    results: tuple[Path, ...]
    reproduction: Reproduction
    cause: str


def reproduce(
    path: Path,
    out: Path | None,
    how: Execution,
    into: Path | None = None,
    base_from: Path | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Reproduced:
    """What `symsteer reproduce` does; its help explains the options.

    Args:
        path: of a record, of a run's folder, or of a folder of submitted records.
        out: where to put a folder with the new run and the comparison; None: a temporary one.
        how: it is executed, with the files that the run began from, if it did.
        into, base_from: as in the help.
        report: receives lines on where the new run is, and why it may differ.

    Raises:
        UserError: if the record is not that of a finished run, this version of SymSteer cannot
            repeat it, or the files or the base policy are not those that the run began from.
    """
    path = path / RECORD if (path / RECORD).is_file() else path
    if path.is_dir() and not (path / CONFIG).is_file():
        records = sorted(set(path.glob("*.json")) - set(path.glob(f"*{REPEATED}")))
        path = secrets.choice(records or [path])
        if records:
            report(f"drawn at random from {len(records)} records: {path.name}")
    path = path / RECORD if path.is_dir() else path
    if not path.is_file():
        raise UserError(f"there is no record {path}; name a record.json, or the folder of a run")
    record = read_record(path)
    if record.status != "finished":
        raise UserError(
            f"the run of {path} is {record.status}, not finished, so there is nothing to compare "
            "with; name the record of a finished run"
        )
    config, files = _configuration(path, record)
    _check_files(record, files, how.files)
    # One with a base policy that was taken does not continue one that trains it.
    name = f"reproduction-{file_hash(path)[:DIGITS]}{'-taken' if base_from else ''}"
    run = run_id(config, files)
    finished = out is not None and is_finished(out / name / run)
    if not finished:
        check(config, how.sim_workers, begun=f"the run of {path}")
    place = out / name if out else Path(tempfile.mkdtemp(prefix="symsteer-reproduction-"))
    folder = place / run
    report(f"repeating {record.run_id} in {place}")
    report(f"the recorded run took {record.wall_clock.total / 60:.1f} minutes")
    here = Provenance.collect(config.device, torch.get_num_threads(), extensions_of(config))
    taken = []
    if base_from is not None:
        if files:
            raise UserError(
                f"{record.run_id} began from files, which have to be given; leave --base-from out"
            )
        take_base(config, record.base_policy.content_hash, base_from, place)
        taken = [TAKEN]
    for line in [*taken, *conditions(record, config, here)]:
        report(f"note: {line}")
    if finished:
        report("the run is there and finished: it is compared without making it again")
    else:
        execute(config, replace(how, runs=place))
    made = read_record(folder / RECORD).provenance
    compared = reproduction_of(path, folder / RECORD, taken + conditions(record, config, made))
    content = dump_reproduction(compared)
    written = {place / RESULT: content}
    if into is not None:
        stem = into / compared.record.sha256
        line = f"{hashlib.sha256(content).hexdigest()}  {into.resolve().name}/{stem.name}.json\n"
        written |= {
            stem.with_suffix(".json"): content,
            stem.with_suffix(REPEATED): (folder / RECORD).read_bytes(),
            stem.with_suffix(".sha256"): line.encode(),
        }
    write_together(written)
    cause = "" if compared.verdict == "exact" else _cause(record.provenance, made, compared)
    return Reproduced(folder, tuple(written), compared, cause)


def conditions(record: RunRecord, config: RunConfig, now: Provenance) -> list[str]:
    """Why a run with the code and on the machine of `now` may differ; one line for each reason."""
    then = record.provenance
    lines = []
    if (now.commit or now.sha256) != (then.commit or then.sha256):
        lines.append(f"the record is of {_code(then)}, and this is {_code(now)}")
    if then.dirty:
        lines.append("the record's code had local changes, which nobody else has")
    if now.dirty:
        lines.append("the code here has local changes")
    if record.continued:
        lines.append("the recorded run was continued with other code or on another machine")
    if then.extensions != now.extensions:
        lines.append("code from outside SymSteer has changed since the record")
    for name, (was, here) in _versions(then, now).items():
        lines.append(f"{name} was {was or 'missing'}, and is {here or 'missing'} here")
    for what, was, here in (
        ("Python", then.python, now.python),
        ("the platform", then.platform, now.platform),
        ("the processor", then.processor, now.processor),
        ("the device", then.device, now.device),
    ):
        if was and was != here:
            lines.append(f"{what} was {was}, and is {here or 'unknown'} here")
    if then.torch_threads != now.torch_threads:
        lines.append(
            f"torch had {then.torch_threads} threads, and has {now.torch_threads} here; set "
            f"OMP_NUM_THREADS={then.torch_threads} for the same"
        )
    if then.together > 1:
        lines.append(
            f"the run was trained together with {then.together - 1} others, so it agrees but for "
            "rounding at best"
        )
    if "cuda" in (config.sim, config.device):
        lines.append("on CUDA sums are not repeatable")
    if newer := newer_options(config, record.config):
        lines.append(f"options that are newer than the record have defaults: {', '.join(newer)}")
    return lines


def text(done: Reproduced) -> str:
    """What the terminal shows of a reproduction."""
    shown = done.reproduction
    success, area = shown.success, shown.area
    lines = [
        f"record         {shown.record.run_id}, sha256 {shown.record.sha256[:DIGITS]}",
        f"new run        {done.run}",
        *(f"note           {line}" for line in shown.conditions),
    ]
    rows = [
        (
            one.part,
            f"{one.differ} of {one.of}",
            "" if one.first is None else f"{one.first} steps",
            "" if one.largest is None else f"{one.largest:.3g}",
            one.example,
        )
        for one in shown.differences
    ]
    if rows:
        header = ("part", "values that differ", "first at", "largest", "first of them")
        lines += ["", aligned(header, rows)]
    alike = [part for part in PARTS if part not in {one.part for one in shown.differences}]
    lines += [
        "",
        f"agree exactly  {', '.join(alike) or 'nothing'}",
        f"final success  {success.recorded:.3f} in the record, {success.repeated:.3f} here "
        f"({success.repeated - success.recorded:+.3f} [{success.low:+.3f}, {success.high:+.3f}])",
        f"area           {area.recorded:.3f} in the record, {area.repeated:.3f} here "
        f"({area.repeated - area.recorded:+.3f})",
        "",
        " ".join(filter(None, (SENTENCES[shown.verdict], done.cause))),
        *(f"wrote {path}" for path in done.results),
    ]
    return "\n".join(lines)


def _versions(then: Provenance, now: Provenance) -> dict[str, tuple[str | None, str | None]]:
    """The packages whose versions differ, each with both; None where it is missing."""
    names = sorted(then.packages.keys() | now.packages.keys())
    both = {name: (then.packages.get(name), now.packages.get(name)) for name in names}
    return {name: versions for name, versions in both.items() if versions[0] != versions[1]}


def _cause(then: Provenance, now: Provenance, shown: Reproduction) -> str:
    """What may explain that a run does not agree, in words: versions first, they can be changed."""
    if fixed := [one.part for one in shown.differences if one.part in ("seeds", "parameters")]:
        return f"No version of a package explains that {' and '.join(fixed)} differ: the code does."
    versions = _versions(then, now)
    if versions:
        names = ", ".join(f"{name} {was} -> {here}" for name, (was, here) in versions.items())
        # "2.13.0+cpu" is a build of 2.13.0.
        pins = (f"{name}=={was.partition('+')[0]}" for name, (was, _) in versions.items() if was)
        return (
            f"Versions may explain it: {names}. Those of the record: pip install {' '.join(pins)}"
        )
    if shown.conditions:
        return "All versions are those of the record; what the notes name may explain it."
    return "Nothing that a record knows explains it: code, versions and machine are the same."


def _configuration(path: Path, record: RunRecord) -> tuple[RunConfig, dict[str, str]]:
    """Configuration of a record, and the hashes of the files that its run began from."""
    try:
        config = read_back(record.config, path, path)
        files: Any = record.config.get("files", {})
        if not isinstance(files, dict) or not files.keys() <= FILES.keys():
            raise UserError("it began from files of a kind that this version does not know")
        check(replace(config, sim="cpu", device="cpu"))
    except UserError as error:
        raise UserError(
            f"this version of SymSteer cannot repeat {path} ({error}); the record is of "
            f"{_code(record.provenance)}: use that"
        ) from error
    return config, files


def _check_files(record: RunRecord, recorded: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Compare the files that were given with those that the run began from, by their hashes."""
    for kind, (option, placeholder) in FILES.items():
        if kind in given and kind not in recorded:
            raise UserError(f"{record.run_id} began from no {kind} file; leave {option} out")
        if kind in recorded and kind not in given:
            raise UserError(
                f"{record.run_id} began from a {kind} file of which the record has the hash alone, "
                f"{recorded[kind][:DIGITS]}; give the file with {option} {placeholder}"
            )
        if given.get(kind) != recorded.get(kind):
            raise UserError(
                f"the {kind} file has the hash {given[kind][:DIGITS]}, but {record.run_id} began "
                f"from one with {recorded[kind][:DIGITS]}; give that one with {option}"
            )


def _code(provenance: Provenance) -> str:
    """Which code, in words."""
    if provenance.commit:
        return f"commit {provenance.commit[:DIGITS]}"
    digest = f", sha256 {provenance.sha256[:DIGITS]}" if provenance.sha256 else ""
    return f"version {provenance.version or 'unknown'}{digest}"
