"""Checking and unpacking a bundle that someone else may have written."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import stat
import struct
import zipfile
from pathlib import Path

from pydantic import ValidationError

from symsteer.bench.bundles.manifest import FORMAT, MANIFEST, VERSION, BundleManifest
from symsteer.errors import UserError, first_problem
from symsteer.files import write_together

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


def fetch_bundle(path: Path, out: Path) -> tuple[BundleManifest, dict[str, Path]]:
    """Check a bundle as a whole, then write its files below ``out``, all or none.

    Card and manifest go to ``out/bundles/NAME``. Files that are there already with the same
    content stay.

    Args:
        path: of the bundle.
        out: folder for its files; RUNS/base, if runs shall find them.

    Returns:
        The manifest, and where each of its files is, by its path in the bundle.

    Raises:
        UserError: if the file is no bundle, of another version, or damaged, or other files have
            the names of its files; nothing is written then.
    """
    manifest, contents = read_bundle(path)
    about = out / "bundles" / manifest.name
    roles = {file.path: file.role for file in manifest.files}
    places = {n: (about if roles.get(n, "card") == "card" else out) / n for n in contents}
    missing = {}
    for name, place in places.items():
        inside = place.resolve().is_relative_to(out.resolve())
        if not inside or any(p.is_symlink() for p in (place, *place.parents) if out in p.parents):
            raise UserError(
                f"{place} is a link, or in a folder that is one, so the file would go elsewhere; "
                "remove the link, or choose another folder with --out"
            )
        if not place.exists():
            missing[place] = contents[name]
        elif not place.is_file() or place.read_bytes() != contents[name]:
            raise UserError(
                f"{place} is there already, with other content than in {path}; choose another "
                "folder with --out, or remove it"
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
