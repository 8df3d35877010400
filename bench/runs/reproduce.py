"""``symsteer reproduce``: a run made again from its record, and what agrees."""

from __future__ import annotations

import dataclasses
import hashlib
import secrets
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch

from symsteer.bench.runs.base_policy import origin, take_base
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.extensions import extensions_of
from symsteer.bench.runs.folder import CONFIG, RECORD, is_finished, run_id
from symsteer.bench.runs.run import check, check_all, check_device, execute
from symsteer.bench.runs.stored import newer_options, read_back
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
    """A run made again.

    Attributes:
        record: the record that was repeated.
        run: folder of the repeated run.
        results: the files with the comparison.
        reproduction: its content.
    """

    record: RunRecord
    run: Path
    results: tuple[Path, ...]
    reproduction: Reproduction


def reproduce(
    path: Path,
    out: Path | None = None,
    demonstrations: Path | None = None,
    policy: Path | None = None,
    into: Path | None = None,
    progress: bool = True,
    workers: int = 1,
    base_from: Path | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> Reproduced:
    """Run the configuration of a record again, and compare.

    Nothing of the first run is used but its record: demonstrations and base policy are made anew,
    unless the run began from files or they are taken from other runs. The same call continues a
    reproduction that was stopped.

    Args:
        path: of a record, of a run's folder, or of a folder of submitted records, one of which is
            drawn.
        out: where to put a folder with the new run and the comparison; default: a temporary one.
        demonstrations, policy: the files that the run began from, if it did.
        into: a folder that gets what the leaderboard reads, named after the record's hash: the
            comparison, the repeated record, and the line for the list of the study.
        progress: whether to show progress bars.
        workers: processes that share the environments.
        base_from: a folder of runs whose demonstrations and base policy are taken.
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
    _check_files(record, files, demonstrations, policy)
    name, taking = run_id(config, files), base_from is not None
    if out is None or not is_finished(_place(path, out, taking) / name):
        check_all(config, workers)
    place = _place(path, out, taking)
    folder = place / name
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
    if is_finished(folder):
        report("the run is there and finished: it is compared without making it again")
    else:
        execute(config, place, demonstrations, policy, progress, workers)
    made = read_record(folder / RECORD).provenance
    found = reproduction_of(path, folder / RECORD, taken + conditions(record, config, made))
    written = {place / RESULT: dump_reproduction(found)}
    if into is not None:
        digest = hashlib.sha256(dump_reproduction(found)).hexdigest()
        line = f"{digest}  {into.resolve().name}/{found.record.sha256}.json\n"
        contents = dump_reproduction(found), (folder / RECORD).read_bytes(), line.encode()
        names = (f"{found.record.sha256}{end}" for end in (".json", REPEATED, ".sha256"))
        written |= {into / name: data for name, data in zip(names, contents, strict=True)}
    write_together(written)
    return Reproduced(record, folder, tuple(written), found)


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
    for name in sorted(then.packages.keys() | now.packages.keys()):
        versions = [where.packages.get(name, "missing") for where in (then, now)]
        if versions[0] != versions[1]:
            lines.append(f"{name} was {versions[0]}, and is {versions[1]} here")
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
    found = done.reproduction
    success, area = found.success, found.area
    lines = [
        f"record         {found.record.run_id}, sha256 {found.record.sha256[:DIGITS]}",
        f"new run        {done.run}",
        *(f"note           {line}" for line in found.conditions),
    ]
    differing = [one.part for one in found.differences]
    if differing:
        lines += ["", _row("part", "values that differ", "first at", "largest", "first of them")]
    for one in found.differences:
        first = "" if one.first is None else f"{one.first} steps"
        largest = "" if one.largest is None else f"{one.largest:.3g}"
        lines.append(_row(one.part, f"{one.differ} of {one.of}", first, largest, one.example))
    alike = [part for part in PARTS if part not in differing]
    lines += [
        "",
        f"agree exactly  {', '.join(alike) or 'nothing'}",
        f"final success  {success.recorded:.3f} in the record, {success.repeated:.3f} here "
        f"({success.repeated - success.recorded:+.3f} [{success.low:+.3f}, {success.high:+.3f}])",
        f"area           {area.recorded:.3f} in the record, {area.repeated:.3f} here "
        f"({area.repeated - area.recorded:+.3f})",
        "",
        SENTENCES[found.verdict],
        *(f"wrote {path}" for path in done.results),
    ]
    return "\n".join(lines)


def _row(part: str, count: str, first: str, largest: str, example: str) -> str:
    return f"{part:12s} {count:>18s}  {first:>12s}  {largest:>9s}  {example}".rstrip()


def _configuration(path: Path, record: RunRecord) -> tuple[RunConfig, dict[str, str]]:
    """Configuration of a record, and the hashes of the files that its run began from."""
    try:
        config, files = read_back(record.config, path, path)
        if not isinstance(files, dict) or not files.keys() <= FILES.keys():
            raise UserError("it began from files of a kind that this version does not know")
        check(dataclasses.replace(config, sim="cpu", device="cpu"))
    except UserError as error:
        raise UserError(
            f"this version of SymSteer cannot repeat {path} ({error}); the record is of "
            f"{_code(record.provenance)}: use that"
        ) from error
    check_device(config, f"the run of {path}")
    return config, files


def _check_files(
    record: RunRecord,
    recorded: Mapping[str, str],
    demonstrations: Path | None,
    policy: Path | None,
) -> None:
    """Compare the files that were given with those that the run began from, by their hashes."""
    given = origin(demonstrations, policy)
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


def _place(path: Path, out: Path | None, taken: bool) -> Path:
    """The folder of the reproduction of the record at a path.

    One with a base policy that was `taken` has its own: it does not continue one that trains it.
    """
    if out is None:
        return Path(tempfile.mkdtemp(prefix="symsteer-reproduction-"))
    return out / f"reproduction-{file_hash(path)[:DIGITS]}{'-taken' if taken else ''}"


def _code(provenance: Provenance) -> str:
    """Which code, in words."""
    if provenance.commit:
        return f"commit {provenance.commit[:DIGITS]}"
    digest = f", sha256 {provenance.sha256[:DIGITS]}" if provenance.sha256 else ""
    return f"version {provenance.version or 'unknown'}{digest}"
