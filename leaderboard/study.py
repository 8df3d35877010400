"""Studies: the claims that are declared before runs are made, and what a reader must know of them.

A study is a TOML file of `leaderboard/studies`, or any other one. docs/metrics.md describes its
keys.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from symsteer.errors import UserError
from symsteer.files import read_model
from symsteer.leaderboard.records.provenance import is_committed
from symsteer.names import unknown

PAPER = "paper"
"""The study with the claims of the paper: for runs that belong to no other one."""

FOLDER = Path(__file__).resolve().parent / "studies"

Measure = Literal["auc", "success", "diverged", "magnitude", "bias"]

AreaFrom = Literal["start", "first update"]
"""Where the area under a success curve begins. In the warm-up before the first update nothing is
learned."""

Words = Annotated[str, Field(pattern=r"^[\w ,;:.()'=%-]{1,120}$")]
"""Text that the page shows as it is."""

Names = Annotated[tuple[str, ...], Field(min_length=1)]

Numbers = Annotated[tuple[Annotated[int, Field(gt=0)], ...], Field(min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Cells(_Table):
    """Which cells a claim is about; a key that is left out selects all."""

    broken: bool | None = None
    """Whether anything breaks the symmetry, the arm included."""
    defect: tuple[float, float] | None = None
    """Smallest and largest audited defect."""
    task: Names | None = None
    embodiment: Names | None = None
    variant: Names | None = None
    """Variants with or without strength; a cell is selected if it has one of them."""
    demonstrations: Literal["fewest", "most"] | Numbers | None = None
    """Numbers of them, or: of cells that differ in this number alone, those at one end."""
    env_steps: Numbers | None = None
    """Budgets."""


class Claim(_Table):
    """One declared claim: an effect, the cells it is about, and what counts as an effect."""

    name: Words
    family: Words
    """Claims of a family are corrected together for their number."""
    measure: Measure
    agents: tuple[str, str]
    """The effect is the first one's measure minus the second one's."""
    effect: Literal["difference", "slope"] = "difference"
    """`slope`: change of the difference with the defect, per 0.1, within each base policy."""
    cells: Cells = Cells()
    minus: Cells | None = None
    """Of an interaction: the effect in `cells` minus that in these cells."""
    predicted: Literal[-1, 0, 1]
    """Sign of the effect that the claim expects; 0: no effect of interest."""
    smallest: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    """The smallest effect of interest: the margin of the test for equivalence."""

    @model_validator(mode="after")
    def _can_be_tested(self) -> Claim:
        if self.minus is not None and (self.effect == "slope" or self.measure == "diverged"):
            raise ValueError("minus belongs to differences of a measure other than diverged")
        if self.effect == "slope" and self.measure == "diverged":
            raise ValueError("there is no slope of diverged")
        return self


class Statement(_Table):
    """What the paper says, and the claims that test it."""

    says: Words
    claims: Names
    """Names of claims of the same file."""


class Safe(_Table):
    """The agent that is declared safe to take in an unknown world.

    Its largest regret over cells may exceed that of an agent without regret by so much, and is
    below that of every other learner.
    """

    agent: str
    success: Annotated[float, Field(gt=0)]
    area: Annotated[float, Field(gt=0)]
    tested_on: tuple[str, ...] = ()
    """Tasks on which it was tested before. The verdict is that of the others."""


class _Rule(_Table):
    """A declared rule: where `standard` wins; elsewhere `equivariant` does."""

    right: Annotated[float, Field(gt=0, le=1)] = 0.9
    """Share of the decided worlds in which the rule is right."""
    least: Annotated[int, Field(gt=0)] = 1
    """Decided worlds without which it is not tested, by each measure."""
    found_on: tuple[str, ...] = ()
    """Tasks on whose earlier records the rule was found. They do not count."""


class Probe(_Rule):
    """`standard` wins where the best constant noise gains at least so much."""

    gain: float
    """Of final success, above the better of base policy and zero noise."""


class Kind(_Rule):
    """`standard` wins in the worlds that are broken in one of these ways."""

    standard: Names
    """Variants without strength."""


class _File(_Table):
    description: str = ""
    notice: str = ""
    details: str = ""
    declared: Annotated[str, Field(pattern=r"^([0-9a-f]{7,40})?$")] = ""
    claims: Annotated[str, Field(pattern=r"^([\w-][\w.-]*)?$")] = ""
    """Another file of the same folder, which holds the claims."""
    claim: tuple[Claim, ...] = ()
    statement: tuple[Statement, ...] = ()
    safe: Safe | None = None
    probe: Probe | None = None
    kind: Kind | None = None
    area_from: AreaFrom = "start"
    chosen_on: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _names_fit(self) -> _File:
        names = [claim.name for claim in self.claim]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"two claims have the name {twice[0]!r}; rename one")
        for statement in self.statement:
            for name in statement.claims:
                if name not in names:
                    raise unknown("claim", name, names, repr(statement.says))
        return self


@dataclass(frozen=True)
class Study:
    """Declared claims, and what a reader must know of the runs.

    Attributes:
        notice: markdown that the page shows above all results.
        details: markdown that the page shows below it, folded.
        declared: the commit that declared the claims, if the study names one.
        claims: in the order of the file.
        statements: of the paper, each with the claims that test it.
        source: name of the file that declares the claims.
        sha256: of its content.
        listed: hashes of the records and reproductions of the study's own (`read_list`); None if
            the study has no list.
        safe: the agent that is declared safe, if there is one.
        probe, kind: the rules that are declared.
        area_from: where areas under success curves begin.
        chosen_on: tasks on which the designs of agents were chosen: each effect is shown without
            them, too.
    """

    notice: str
    details: str
    declared: str
    claims: tuple[Claim, ...]
    statements: tuple[Statement, ...]
    source: str
    sha256: str
    listed: frozenset[str] | None = None
    safe: Safe | None = None
    probe: Probe | None = None
    kind: Kind | None = None
    area_from: AreaFrom = "start"
    chosen_on: tuple[str, ...] = ()


def read_study(name_or_path: str) -> Study:
    """Read a study by name or from a TOML file.

    Raises:
        UserError: if there is no such study, or the file is not one; for an unknown key or
            measure, the message has the nearest valid one. Where git is there, also if the commit
            that the study names does not hold the claims as they are.
    """
    file, path = read_model(name_or_path, "study", FOLDER, _File)
    source = path
    if file.claims:
        declaring, source = read_model(str(path.parent / file.claims), "study", FOLDER, _File)
        if file.claim or declaring.claims:
            raise UserError(
                f"{path.name}: claims must name a file that declares claims itself, in place of own"
            )
        own = {"notice": file.notice, "details": file.details, "declared": file.declared}
        file = declaring.model_copy(update=own)
    if file.declared and is_committed(source, file.declared) is False:
        raise UserError(
            f"{source} is not as the commit {file.declared} has it, so this commit has not "
            "declared these claims; name the one that has, or restore the file"
        )
    return Study(
        notice=file.notice.strip(),
        details=file.details.strip(),
        declared=file.declared,
        claims=file.claim,
        statements=file.statement,
        safe=file.safe,
        probe=file.probe,
        kind=file.kind,
        area_from=file.area_from,
        chosen_on=file.chosen_on,
        source=source.name,
        sha256=hashlib.sha256(source.read_bytes()).hexdigest(),
        listed=read_list(path),
    )


def read_list(study: Path) -> frozenset[str] | None:
    """The hashes in the list beside a study, as `sha256sum` writes it; None if there is no list.

    Raises:
        UserError: if it cannot be read, or is no such list.
    """
    path = study.with_suffix(".sha256")
    try:
        lines = path.read_text().splitlines() if path.exists() else None
    except (OSError, ValueError) as error:
        raise UserError(f"the list {path} cannot be read ({error}); restore it") from error
    for number, line in enumerate(lines or (), 1):
        if not re.fullmatch(r"[0-9a-f]{64} [ *]\S.*", line):
            raise UserError(f"{path}, line {number} is none of `sha256sum`; correct it")
    return None if lines is None else frozenset(line[:64] for line in lines)


def all_listed() -> frozenset[str]:
    """The hashes in the lists of all studies that come with SymSteer."""
    return frozenset().union(*(read_list(path) or () for path in FOLDER.glob("*.toml")))
