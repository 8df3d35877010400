"""Studies as files: what is read, and each mistake in one sentence."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.study import FOLDER, read_study
from tests.leaderboard.command_line import git

CLAIM = """
[[claim]]
name = "faster"
family = "speed"
measure = "auc"
agents = ["equivariant", "standard"]
cells = { broken = false, defect = [0, 0.1] }
predicted = 1
smallest = 0.05
"""


def write(folder: Path, text: str, name: str = "mine.toml") -> str:
    (folder / name).write_text(text)
    return str(folder / name)


def test_a_study_declares_claims_or_names_a_file_that_does(tmp_path: Path) -> None:
    assert {"first", "paper"} <= {path.stem for path in FOLDER.glob("*.toml")}
    study = read_study(write(tmp_path, f'notice = "mind this"\n{CLAIM}'))
    (claim,) = study.claims
    assert (claim.agents, claim.cells.broken) == (("equivariant", "standard"), False)
    other = read_study(write(tmp_path, 'claims = "mine.toml"\ndeclared = "abcdef0"', "other.toml"))
    assert (other.claims, other.source) == (study.claims, "mine.toml")
    assert (other.notice, other.declared) == ("", "abcdef0")
    content = (tmp_path / "mine.toml").read_bytes()
    assert other.sha256 == study.sha256 == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (CLAIM.replace("measure", "mesure"), "claim 1: there is no key 'mesure'; did you mean 'me"),
        (CLAIM.replace('"auc"', '"acu"'), "claim 1: there is no measure 'acu'; did you mean 'auc'"),
        ("notce = 'x'", "there is no key 'notce'; did you mean 'notice'"),
        (CLAIM.replace("smallest = 0.05", "smallest = 0"), "claim 1 smallest: .*greater than 0"),
        (CLAIM.replace(', "standard"', ""), "claim 1 agents 2: Field required"),
        (CLAIM.replace('"faster"', '"<b>"'), "claim 1 name: "),
        (CLAIM + "minus = { broken = true }\neffect = 'slope'", "claim 1: minus belongs to"),
        (CLAIM.replace('"auc"', '"diverged"') + "effect = 'slope'", "no slope of diverged"),
        (CLAIM + "[[statement]]\nsays = 'x'\nclaims = ['fster']", "'fster'; did you mean 'faster'"),
        (CLAIM + CLAIM, "two claims have the name 'faster'; rename one"),
        ("declared = 'yesterday'", "declared: "),
        ("claims = 'none.toml'", r"there is no study '.*none\.toml'"),
        ("claims = 'mine.toml'", "must name a file that declares claims itself"),
        ("not toml", "cannot be read as TOML"),
    ],
)
def test_mistakes_in_a_study(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=words) as refused:
        read_study(write(tmp_path, text))
    assert "\n" not in str(refused.value)


def test_a_commit_that_has_not_declared_the_claims_is_refused(tmp_path: Path) -> None:
    write(tmp_path, CLAIM)
    study = write(tmp_path, 'claims = "mine.toml"\ndeclared = "0123456"', "study.toml")
    assert read_study(study).declared == "0123456"  # nothing to compare with
    git(tmp_path, "init")
    git(tmp_path, "add", "study.toml")
    git(tmp_path, "commit", "-m", "no claims yet")
    before = git(tmp_path, "rev-parse", "HEAD")
    git(tmp_path, "add", "mine.toml")
    git(tmp_path, "commit", "-m", "claims")
    commit = git(tmp_path, "rev-parse", "--short", "HEAD")
    for wrong in ("0123456", before):
        write(tmp_path, f'claims = "mine.toml"\ndeclared = "{wrong}"', "study.toml")
        with pytest.raises(UserError, match=f"mine.toml is not as the commit {wrong} has it"):
            read_study(study)
    write(tmp_path, f'claims = "mine.toml"\ndeclared = "{commit}"', "study.toml")
    assert read_study(study).declared == commit
    write(tmp_path, CLAIM.replace("smallest = 0.05", "smallest = 0.01"))
    with pytest.raises(UserError, match="has not declared these claims"):
        read_study(study)


def test_an_unknown_study_names_the_nearest() -> None:
    with pytest.raises(UserError, match="there is no study 'papr'; did you mean 'paper'"):
        read_study("papr")
