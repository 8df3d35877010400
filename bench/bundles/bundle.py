"""One file with a base policy and demonstrations: a zip archive with a manifest of hashes.

Members are stored without compression, in a fixed order and without times: the same contents give
the same bytes. Paths in the archive are those below RUNS/base, where ``symsteer run`` looks for
demonstrations and policies of the same settings.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from pathlib import Path

from symsteer.bench.bundles.card import LICENCE, bundle_card
from symsteer.bench.bundles.contents import Contents
from symsteer.bench.bundles.manifest import (
    CARD,
    FORMAT,
    MANIFEST,
    VERSION,
    BundledDemonstrations,
    BundledFile,
    Code,
    Manifest,
    Role,
)
from symsteer.bench.bundles.measure import measure
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.files import write_atomically


def write_bundle(contents: Contents, path: Path) -> Manifest:
    """Measure the policy, if there is one, and write everything to one file.

    Args:
        contents: what goes in.
        path: ends in ``.zip``; an earlier file is replaced.

    Raises:
        UserError: for another suffix, or if the file cannot be written.
    """
    check_path(path)
    config = contents.config
    files: list[tuple[str, Role, bytes]] = []
    if contents.demonstrations is not None:
        for file in (contents.demonstrations, contents.demonstrations.with_suffix(".json")):
            files.append((file.name, "demonstrations", file.read_bytes()))
    measured = None
    if contents.policy is not None and contents.policy_file is not None:
        measured = measure(config, contents.policy)
        name = f"{contents.name}/{contents.policy_file.name}"
        files.append((name, "policy", contents.policy_file.read_bytes()))
    card = bundle_card(contents, measured, [_listed(*file) for file in files])
    files.insert(0, (CARD, "card", card.encode()))
    task = task_class(config.task)
    manifest = Manifest(
        format=FORMAT,
        version=VERSION,
        name=contents.name,
        task=config.task,
        embodiment=config.embodiment,
        code=Code.here(),
        licence=LICENCE,
        observation_layout=task.observation_layout.to_json(),
        action_layout=task.action_layout.to_json(),
        demonstrations=BundledDemonstrations(**vars(config.demonstrations)),
        policy=config.to_json()["policy"],
        policy_seed=config.policy_seed,
        origin=dict(contents.origin),
        measured=measured.to_json() if measured else None,
        files=[_listed(*file) for file in files],
    )
    text = json.dumps(manifest.model_dump(), indent=2) + "\n"
    write_atomically(path, _zipped([(MANIFEST, text.encode()), *((n, d) for n, _, d in files)]))
    return manifest


def check_path(path: Path) -> None:
    """Check the name of a bundle's file, before anything is computed.

    Raises:
        UserError: if it does not end in ``.zip``, or is a folder.
    """
    if path.suffix != ".zip":
        raise UserError(f"a bundle is a zip file: give --out a name that ends in .zip, not {path}")
    if path.is_dir():
        raise UserError(f"{path} is a folder; name a file for the bundle")


def _listed(name: str, role: Role, data: bytes) -> BundledFile:
    digest = hashlib.sha256(data).hexdigest()
    return BundledFile(path=name, role=role, size=len(data), sha256=digest)


def _zipped(files: list[tuple[str, bytes]]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files:
            member = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            member.create_system, member.external_attr = 3, 0o644 << 16
            archive.writestr(member, data)
    return buffer.getvalue()
