"""Reading and writing of records: strict, atomic, and a finished record is never overwritten."""

from __future__ import annotations

import json
import math
import stat
from pathlib import Path
from typing import Any

from symsteer.errors import UserError, first_problem
from symsteer.files import write_atomically
from symsteer.leaderboard.records.migrations import migrated
from symsteer.leaderboard.records.schema import SCHEMA_VERSION, RunRecord
from symsteer.leaderboard.records.values import json_lines

MAX_BYTES = 64 * 2**20
"""A record has some ten to a few hundred kilobytes; a larger file is something else."""


def dump_record(record: RunRecord) -> str:
    """The text of a record: strict JSON, sorted keys, one line per block and per evaluation."""
    return json_lines(record.model_dump(mode="json", by_alias=True))


def write_record(record: RunRecord, path: Path | str) -> None:
    """Validate `record` and write it atomically (temporary file, fsync, rename).

    A file that exists is replaced only while it holds the same run, not finished yet. Raises
    UserError otherwise, and when the record is invalid or the folder cannot be written.
    """
    path = Path(path)
    try:
        text = dump_record(_validated(record.model_dump(by_alias=True)))
    except ValueError as error:
        raise UserError(f"{path}: the record is not written: {first_problem(error)}") from error
    if path.exists():
        old = read_record(path)
        if old.status == "finished":
            raise UserError(f"{path} holds a finished run: choose another folder or delete it")
        if old.run_id != record.run_id:
            raise UserError(
                f"{path} holds another run ({old.run_id}): choose another folder or delete it"
            )
    write_atomically(path, text.encode())


def read_record(path: Path | str) -> RunRecord:
    """Read and validate the record at `path`; raises UserError with one sentence if it is bad."""
    path = Path(path)
    again = "restore it or run the cell again"
    name = "not a run record; name records or run folders only"
    try:
        about = path.stat()
        if about.st_size > MAX_BYTES or stat.S_ISFIFO(about.st_mode):
            raise UserError(f"{path} is a pipe or larger than {MAX_BYTES >> 20} MiB: not a record")
        text = path.read_bytes().decode("utf-8-sig")
        data = json.loads(
            text, parse_constant=_refuse, parse_float=_finite, object_pairs_hook=_unique_keys
        )
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not UTF-8 text: {name}") from error
    except (ValueError, RecursionError) as error:
        problem = error.msg if isinstance(error, json.JSONDecodeError) else str(error)
        raise UserError(
            f"{path} is not strict JSON ({problem[:120]}): truncated or edited; {again}"
        ) from error
    if not isinstance(data, dict) or "schema_version" not in data:
        raise UserError(f"{path} is JSON but has no schema_version: {name}")
    version = data["schema_version"]
    if type(version) is not int or not 1 <= version <= SCHEMA_VERSION:
        raise UserError(
            f"{path} has schema_version {str(version)[:20]!r}, "
            f"this program reads 1 to {SCHEMA_VERSION}: "
            "use the version of symsteer that wrote it or run the cell again"
        )
    try:
        if "config_hash" not in data:
            raise ValueError("config_hash is missing")
        return _validated({**migrated(data), "schema_version": SCHEMA_VERSION})
    except ValueError as error:
        raise UserError(f"{path} is not a valid record: {first_problem(error)}; {again}") from error


def _validated(data: dict[str, Any]) -> RunRecord:
    record = RunRecord.model_validate(data)
    record.check()
    return record


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text[:20]} is too large")
    return value


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) != len(pairs):
        raise ValueError("a key occurs twice")
    return data
