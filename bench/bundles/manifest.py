"""The manifest of a bundle; imports neither torch nor ManiSkill."""

from __future__ import annotations

import functools
import re
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

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
