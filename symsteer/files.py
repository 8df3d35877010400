"""TOML, CSV, and atomic writing: a file has its complete old or new content, never a part."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import os
import re
import shutil
import sysconfig
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar, get_args

from symsteer.errors import UserError
from symsteer.names import unknown

if TYPE_CHECKING:  # slow to import
    from pydantic import BaseModel, ValidationError

Model = TypeVar("Model", bound="BaseModel")


def read_toml(name_or_path: str, kind: str, folder: Path) -> tuple[dict[str, Any], Path]:
    """The content of a TOML file, and its path; a byte order mark is skipped.

    Args:
        name_or_path: name of a file in ``folder``, or the path of a ``.toml`` file.
        kind: what the file is, for messages.
        folder: of the files that come with SymSteer.

    Raises:
        UserError: if there is no such file, or it cannot be read.
    """
    path = Path(name_or_path)
    path = path if path.suffix == ".toml" else folder / f"{name_or_path}.toml"
    try:
        return shallow(tomllib.loads(path.read_text("utf-8-sig"))), path
    except FileNotFoundError as error:
        names = sorted(path.stem for path in folder.glob("*.toml"))
        raise unknown(kind, name_or_path, [*names, "or the path of a .toml file"]) from error
    except OSError as error:
        raise UserError(
            f"the {kind} {path} cannot be read: {error.strerror}; name another file"
        ) from error
    except (ValueError, RecursionError) as error:
        problem = f"the {kind} {path} cannot be read as TOML: {error}"
        raise UserError(f"{problem}; correct it there") from error


def read_model(
    name_or_path: str, kind: str, folder: Path, model: type[Model]
) -> tuple[Model, Path]:
    """The content of a TOML file as its pydantic model, and its path.

    Args:
        name_or_path, kind, folder: as for :func:`read_toml`.
        model: of the content; its validators may raise `UserError`.

    Raises:
        UserError: if there is no such file, or its content does not fit. The sentence names the
            first mistake and, for an unknown key or choice, the nearest valid one.
    """
    data, path = read_toml(name_or_path, kind, folder)
    try:
        return model.model_validate(data), path
    except UserError as error:
        raise UserError(f"the {kind} {path}: {error}") from error
    except ValueError as error:
        if not hasattr(error, "error_count"):
            raise
        mistake = _first_mistake(error, model)  # type: ignore[arg-type]
        raise UserError(f"the {kind} {path}: {mistake}; correct it there") from error


def _first_mistake(error: ValidationError, model: type[BaseModel]) -> str:
    """The place of the first mistake in words, with list items counted from 1, and what it is."""
    mistakes = error.errors(include_url=False)
    # A key that is misspelt is missing, too.
    first = next((one for one in mistakes if one["type"] == "extra_forbidden"), mistakes[0])
    words = [str(step + 1) if isinstance(step, int) else step for step in first["loc"]]
    where, last = " ".join(words[:-1])[:120], words[-1] if words else ""
    if first["type"] == "extra_forbidden":
        for step in first["loc"][:-1]:
            if step in model.model_fields:
                model = next(_models_in(model.model_fields[str(step)].annotation))
        return str(unknown("key", last, model.model_fields, where))
    if first["type"] == "literal_error" and isinstance(first["input"], str):
        choices = re.findall("'(.*?)'", first["ctx"]["expected"])
        return str(unknown(last, first["input"], choices, where))
    place = " ".join(words)[:120]
    return ": ".join(filter(None, [place, first["msg"].removeprefix("Value error, ")]))


def _models_in(kind: Any) -> Iterator[type[BaseModel]]:
    """The models that an annotation such as ``tuple[Claim, ...]`` names."""
    if hasattr(kind, "model_fields"):
        yield kind
    for inner in get_args(kind):
        yield from _models_in(inner)


def away() -> contextlib.AbstractContextManager[None]:
    """Work in a folder that no stranger has written to: for packages that read settings, or look
    for modules, in the current folder."""
    return contextlib.chdir(sysconfig.get_path("stdlib"))


def open_log(path: str | Path) -> TextIO:
    """A log to append to; not through a link, which somebody may have put there."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW
    return os.fdopen(os.open(path, flags, 0o666), "a")


FORMULA = re.compile("(^|;)(?= *[-=+@\uff0d\uff1d\uff0b\uff20])")
"""What a spreadsheet runs, in half or full width, also where it takes ``;`` for a separator."""


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows of a CSV file: numbers with six significant digits, no formulas, no raw line breaks."""

    def cell(value: object) -> object:
        if not isinstance(value, str):
            return f"{value:.6g}" if isinstance(value, float) else value
        # Also what a spreadsheet skips before a formula: spaces without width, controls.
        shown = (c if c.isprintable() else c.encode("unicode_escape").decode() for c in value)
        return FORMULA.sub(r"\1'", "".join(shown))

    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(map(cell, row) for row in rows)
    return out.getvalue()


def write_atomically(path: Path, data: bytes, durable: bool = True) -> None:
    """Write one file; see :func:`write_together`."""
    write_together({path: data}, durable=durable)


def write_together(
    files: Mapping[Path, bytes], stale: Iterable[Path] = (), durable: bool = True
) -> None:
    """Write all files under temporary names, rename them, then remove the files in ``stale``.

    Args:
        files: contents by path; missing folders are made.
        stale: files to remove after all others are written.
        durable: wait until the data are on the disk.

    Raises:
        UserError: if a folder cannot be written, a path is a folder, or the disk is full. The
            files then keep their old content. One exception: if a rename fails, some files are
            old and some are new.
    """
    with contextlib.ExitStack() as stack:
        # The stack ends with what it began with: files get their names in the order given.
        for path, data in reversed(list(files.items())):
            if path.is_dir():
                raise UserError(f"{path} is a folder; remove it or choose another path")
            with open(stack.enter_context(staged(path)), "wb") as file:
                file.write(data)
                if durable:
                    file.flush()
                    os.fsync(file.fileno())
    for path in stale:
        with _explained(path):
            path.unlink()
    for folder in {path.parent for path in files} if durable else ():
        with _explained(folder):
            _sync_folder(folder)


@contextlib.contextmanager
def staged(path: Path) -> Iterator[Path]:
    """A temporary name beside a file or folder, also for libraries that write by themselves.

    It becomes the right name at the end of the block; after an error what is there is removed, an
    earlier file stays as it was, and a `UserError` says why.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with _explained(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with contextlib.suppress(OSError):
            temporary.unlink()


@contextlib.contextmanager
def built_once(path: Path) -> Iterator[None]:
    """One process at a time builds what others need, too; they wait, and then look whether it is
    there."""
    from filelock import FileLock  # slow to import

    lock = FileLock(path.with_name(f".{path.name}.lock"))
    with _explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def prepare_folder(folder: Path) -> None:
    """Make a folder before the work whose results go there; a `UserError` if it is not possible."""
    with _explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise OSError(errno.EACCES, os.strerror(errno.EACCES))


@contextlib.contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Say in one sentence why a path cannot be written."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error).partition("\n")[0]
        raise UserError(
            f"{path} cannot be written: {reason}; free space or choose another folder"
        ) from error


def shallow(data: Any, levels: int = 32) -> Any:
    """The same plain data; a ValueError if they are nested deeper than recursive code can go."""
    if not levels:
        raise ValueError("it is nested more than 32 levels deep")
    inner = data.values() if isinstance(data, dict) else data if isinstance(data, list) else ()
    for value in inner:
        shallow(value, levels - 1)
    return data


def _sync_folder(folder: Path) -> None:
    """Write a folder's list of files to disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
