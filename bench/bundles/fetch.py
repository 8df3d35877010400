"""The manifest of a bundle; checking and unpacking one that someone else may have written.

It imports neither torch nor ManiSkill.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import re
import stat
import struct
import zipfile
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from symsteer.errors import UserError, first_problem
from symsteer.files import write_together
from symsteer.leaderboard.records import Provenance
from symsteer.terminal import to_paste

FORMAT: Final = "symsteer-bundle"
VERSION: Final = 1
MANIFEST, CARD = "manifest.json", "CARD.md"

_WORD = r"[A-Za-z0-9_][A-Za-z0-9_.:=+-]*"
Word = Annotated[str, Field(pattern=rf"^{_WORD}$", max_length=200)]
Role = Literal["card", "demonstrations", "policy"]
PATHS: dict[Role, str] = {
    "card": r"CARD\.md",
    "demonstrations": rf"{_WORD}\.(h5|json)",
    "policy": rf"{_WORD}/policy\.safetensors",
}
"""The form of paths: none is absolute, leaves its folder, or begins with a dot."""

LARGEST_MANIFEST = 2**20
"""Bytes; a manifest has a few thousand."""

DAMAGE = (
    EOFError,
    NotImplementedError,
    OSError,
    OverflowError,
    RuntimeError,
    ValueError,
    struct.error,
    zipfile.BadZipFile,
)
"""What ``zipfile`` raises for a damaged archive."""

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class BundledFile(_Strict):
    """A file of a bundle; what it is decides the form of its path."""

    path: Annotated[str, Field(max_length=400)]
    role: Role
    size: Annotated[int, Field(ge=0)]
    sha256: Digest

    @model_validator(mode="after")
    def _named_as_its_role(self) -> BundledFile:
        if not re.fullmatch(PATHS[self.role], self.path):
            raise ValueError(f"no {self.role} may have this path")
        return self


class Code(_Strict):
    """The SymSteer that wrote a bundle, as in a record's provenance."""

    version: str | None
    commit: str | None
    dirty: bool | None
    sha256: str | None

    @classmethod
    @functools.cache
    def here(cls) -> Code:
        """The one that runs."""
        provenance = Provenance.collect("cpu", 1).model_dump()
        return cls(**{key: provenance[key] for key in cls.model_fields})

    def __str__(self) -> str:
        which = f"commit `{self.commit}`" if self.commit else f"code with SHA-256 `{self.sha256}`"
        return f"SymSteer {self.version} ({which}{', changed' if self.dirty else ''})"


class BundledDemonstrations(_Strict):
    """Settings of the demonstrations that are in a bundle, or that its policy was trained on."""

    mode: Literal["clean", "diverse"]
    count: Annotated[int, Field(ge=1)]
    seed: int


class BundleManifest(_Strict):
    """``manifest.json``: what a bundle holds, and where it came from.

    ``measured`` is null without a policy; ``origin`` has the hashes of files of the user that the
    run began with.
    """

    format: Literal["symsteer-bundle"]
    version: Literal[1]
    name: Word
    task: Word
    embodiment: Word
    code: Code
    licence: str
    observation_layout: list[dict[str, Any]]
    action_layout: list[dict[str, Any]]
    demonstrations: BundledDemonstrations
    policy: dict[str, Any]
    policy_seed: int
    origin: dict[str, str]
    measured: dict[str, Any] | None
    files: list[BundledFile]

    def path(self, role: str, suffix: str = "") -> str | None:
        """The first file with a role whose name ends so; None if there is none."""
        paths = (f.path for f in self.files if f.role == role and f.path.endswith(suffix))
        return next(paths, None)

    def commands(self, base: Path) -> list[str]:
        """Commands that use what was unpacked to a folder."""
        run = ("symsteer", "run", "--task", self.task, "--embodiment", self.embodiment)
        commands = []
        if policy := self.path("policy"):
            commands.append(to_paste(*run, "--base-policy", base / policy))
        if demos := self.path("demonstrations", ".h5"):
            count = ("--demonstrations.count", self.demonstrations.count)
            commands.append(to_paste(*run, "--demos", base / demos, *count))
        return commands


def fetch_bundle(path: Path, base: Path) -> tuple[BundleManifest, dict[str, Path]]:
    """Check a bundle as a whole, then write its files below ``base``, all or none.

    Card and manifest go to ``base/bundles/NAME``. Files that are there already with the same
    content stay.

    Args:
        path: of the bundle.
        base: folder for its files; RUNS/base, if runs shall find them.

    Returns:
        The manifest, and where each of its files is, by its path in the bundle.

    Raises:
        UserError: if the file is no bundle, of another version, or damaged, or other files have
            the names of its files; nothing is written then.
    """
    manifest, contents = read_bundle(path)
    about = base / "bundles" / manifest.name
    roles = {file.path: file.role for file in manifest.files}
    places = {n: (about if roles.get(n, "card") == "card" else base) / n for n in contents}
    missing = {}
    for name, place in places.items():
        inside = place.resolve().is_relative_to(base.resolve())
        if not inside or any(p.is_symlink() for p in (place, *place.parents) if base in p.parents):
            raise UserError(
                f"{place} is a link, or in a folder that is one, so the file would go elsewhere; "
                "remove the link, or choose another folder with --runs"
            )
        if not place.exists():
            missing[place] = contents[name]
        elif not place.is_file() or place.read_bytes() != contents[name]:
            raise UserError(
                f"{place} is there already, with other content than in {path}; choose another "
                "folder with --runs, or remove it"
            )
    write_together(missing)
    return manifest, {file.path: places[file.path] for file in manifest.files}


def read_bundle(path: Path) -> tuple[BundleManifest, dict[str, bytes]]:
    """The manifest and all files of a bundle, by name, checked against their hashes.

    Raises:
        UserError: one sentence on why the file cannot be used.
    """
    if re.match(r"\w{2,}:/", str(path)):
        raise UserError(f"{path} is an address; download it and give the path of the file")
    if not path.is_file():
        raise UserError(f"there is no file {path}; name a bundle that `symsteer export` wrote")
    try:
        with zipfile.ZipFile(path) as archive:
            manifest = _manifest(path, archive)
            return manifest, _contents(path, archive, manifest)
    except UserError:
        raise
    except DAMAGE as error:
        raise UserError(
            f"{path} is truncated, damaged or no zip file; copy or export it again"
        ) from error


def _manifest(path: Path, archive: zipfile.ZipFile) -> BundleManifest:
    data, text = None, b""
    if MANIFEST in archive.namelist():
        _check_member(path, archive.getinfo(MANIFEST), LARGEST_MANIFEST)
        text = archive.read(MANIFEST)
        with contextlib.suppress(ValueError, RecursionError):
            data = json.loads(text)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise UserError(
            f"{path} is a zip file, but its {MANIFEST} is missing or not that of a bundle of "
            "SymSteer; name a file that `symsteer export` wrote"
        )
    if data.get("version") != VERSION:
        raise UserError(
            f"{path} has version {str(data.get('version'))[:20]} of the format, and this SymSteer "
            f"reads version {VERSION}; use the SymSteer that wrote it, or export it again"
        )
    try:
        return BundleManifest.model_validate_json(text)
    except ValidationError as error:
        raise UserError(
            f"the {MANIFEST} of {path} is wrong in {first_problem(error)}; copy it again"
        ) from error


def _contents(path: Path, archive: zipfile.ZipFile, manifest: BundleManifest) -> dict[str, bytes]:
    members = archive.infolist()
    listed = [MANIFEST, *(file.path for file in manifest.files)]
    if sorted(member.filename for member in members) != sorted(listed):
        raise UserError(
            f"{path} does not hold exactly the files that its {MANIFEST} lists; do not use it"
        )
    # Members may overlap, so that few bytes unpack to many.
    if sum(file.size for file in manifest.files) > path.stat().st_size:
        raise UserError(f"{path} lists more bytes than it has; do not use it")
    contents = {MANIFEST: archive.read(MANIFEST)}
    for file in manifest.files:
        _check_member(path, archive.getinfo(file.path), file.size)
        data = archive.read(file.path)
        if len(data) != file.size or hashlib.sha256(data).hexdigest() != file.sha256:
            raise UserError(
                f"{file.path} in {path} does not have the hash in its {MANIFEST}: it is damaged or "
                "was changed; copy it again"
            )
        contents[file.path] = data
    return contents


def _check_member(path: Path, member: zipfile.ZipInfo, largest: int) -> None:
    """Refuse members that ``symsteer export`` does not write: compressed, or not plain files."""
    kind = stat.S_IFMT(member.external_attr >> 16)
    plain = kind in (0, stat.S_IFREG) and member.compress_type == zipfile.ZIP_STORED
    if not plain or member.file_size > largest:
        raise UserError(
            f"{member.filename!r} in {path} is compressed, a link, or larger than listed, which "
            "`symsteer export` never writes; do not use it"
        )
