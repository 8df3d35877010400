"""Which code a run used: commit or hash, packages, and extensions of other distributions."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import re
import subprocess
import tempfile
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from symsteer import registry
from symsteer.leaderboard.records.values import Count, Name, RecordBlock, Sha256

CODE = ("agents", "bench", "leaderboard", "policies", "symsteer")
"""Folders of a checkout that hold code; those in `symsteer/` are links to the others."""

PACKAGES = ("torch", "mani-skill", "mani-skill-nightly", "sapien", "escnn", "gymnasium", "numpy")
"""Packages whose versions a record names, where they are installed."""

NUMBERED = {"family": "cpu family", "model": "model"}
"""What a processor's kind is numbered by: a name such as "AMD EPYC" may stand for many."""


class RecordedExtension(RecordBlock):
    """Code from outside SymSteer that a run used (`symsteer.registry.Extension`).

    `distribution` and `version` are null for code that was not installed.
    """

    kind: Literal["agent", "policy", "variant", "task"]
    name: Name
    target: Name
    distribution: Name | None
    version: Name | None
    sha256: Sha256


class Provenance(RecordBlock):
    """The code and the machine that the numbers come from.

    `version` is SymSteer's (null in records before schema version 4). In a git checkout of the
    project `commit` names the code, and `dirty` says whether tracked files differ from it or git
    does not track some of the code. Elsewhere both are null and `sha256` names the code: the hash
    of all Python files of the installed package. `together` counts the runs in the same process:
    agents that are trained together learn the same as alone but for rounding. `processor` is null
    in older records and where the system does not tell it; another kind rounds otherwise.
    """

    commit: Annotated[str, Field(pattern=r"^[0-9a-f]{40}$")] | None
    dirty: bool | None
    version: Name | None
    sha256: Sha256 | None
    extensions: list[RecordedExtension]
    packages: dict[Name, Name]
    python: Name
    platform: Name
    processor: Name | None = None
    device: Name
    torch_threads: Annotated[Count, Field(ge=1)]
    together: Annotated[Count, Field(ge=1)] = 1

    @classmethod
    def collect(
        cls,
        device: str,
        torch_threads: int,
        extensions: Iterable[registry.Extension] = (),
        together: int = 1,
    ) -> Provenance:
        """Describe this machine and the code that runs on it."""
        root = checkout()
        commit, dirty = commit_of(root) if root else (None, None)
        return cls(
            commit=commit,
            dirty=dirty,
            version=_version("symsteer"),
            sha256=None if commit else registry.code_hash("symsteer"),
            extensions=[RecordedExtension(**extension.to_json()) for extension in extensions],
            packages={name: version for name in PACKAGES if (version := _version(name))},
            python=platform.python_version(),
            platform=f"{platform.system()} {platform.machine()}",
            processor=processor_name(),
            device=device,
            torch_threads=torch_threads,
            together=together,
        )


@functools.cache
def checkout() -> Path | None:
    """The top folder of the git checkout that this code runs from; None for an installed copy."""
    return _checkout_of(Path(str(registry.__file__)).resolve())


def _checkout_of(code: Path) -> Path | None:
    # An installed copy may lie inside of a checkout, in its virtual environment, but git does not
    # track it there.
    root = code.parent.parent
    if not (root / ".git").exists():
        return None
    top = git(code.parent, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != root:
        return None
    return root if git(code.parent, "ls-files", "--error-unmatch", code.name) else None


def commit_of(root: Path) -> tuple[str | None, bool | None]:
    """Commit of a checkout, and whether its code differs; (None, None) if git cannot say."""
    commit = git(root, "rev-parse", "HEAD")
    changes = git(root, "status", "--porcelain", "--untracked-files=no")
    # A file that git does not track runs as well, such as a new agent.
    code = (f"{folder}/*.py" for folder in CODE)
    untracked = git(root, "ls-files", "--others", "--exclude-standard", *code)
    if commit is None or changes is None or untracked is None:
        return None, None
    return commit, bool(changes or untracked)


def git(folder: Path, *arguments: str, **variables: str) -> str | None:
    """What a git command prints; None if it fails or takes longer than 20 s.

    A repository's configuration can name programs that git then runs. So this is for the checkout
    that our own code is in, or with variables that keep the repository's configuration out.
    """
    own = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    try:
        result = subprocess.run(
            ["git", "-C", str(folder), *arguments],
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
            env={**own, "GIT_NO_LAZY_FETCH": "1", "GIT_ALLOW_PROTOCOL": "", **variables},
        )
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return result.stdout.strip()


def is_committed(file: Path, commit: str) -> bool | None:
    """Whether a commit has a file as it is; None if the repository around it cannot be asked.

    The repository may be anyone's: git reads its objects from an empty repository of ours, so that
    none of its configuration is in force.
    """
    file = file.resolve()
    top = next((folder for folder in file.parents if (folder / ".git").exists()), file)
    if not (top / ".git/objects").is_dir() or (top / ".git/shallow").exists():
        return None
    with tempfile.TemporaryDirectory() as name:
        empty = Path(name)
        for part in ("objects", "refs"):
            (empty / part).mkdir()
        (empty / "HEAD").write_text("ref: refs/heads/none\n")
        places = {"GIT_DIR": name, "GIT_ALTERNATE_OBJECT_DIRECTORIES": str(top / ".git/objects")}
        if git(empty, "version") is None:
            return None
        place, data = f"{commit}:{file.relative_to(top).as_posix()}", file.read_bytes()
        own = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        return own == git(empty, "rev-parse", "--verify", "--quiet", place, **places)


@functools.cache
def processor_name() -> str | None:
    """Name, family and model of the first processor, as Linux tells them."""
    try:
        first, *_ = Path("/proc/cpuinfo").read_text().split("\n\n")
    except OSError:
        return None
    facts = dict(re.findall(r"^(\S[^\t:]*?)\s*: *(.+)$", first, re.MULTILINE))
    if "model name" not in facts:
        return None
    places = (f"{word} {facts[key]}" for word, key in NUMBERED.items() if key in facts)
    return f"{facts['model name']} ({', '.join(places)})"


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
