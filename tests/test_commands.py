"""The commands of documentation and public files: each can be parsed as it stands."""

from __future__ import annotations

import contextlib
import functools
import importlib
import re
import shlex
from pathlib import Path

import pytest
import tyro

from symsteer.bench.runs.arguments import parse_run
from symsteer.cli import REMOVED, VERBS
from symsteer.errors import UserError

ROOT = Path(__file__).resolve().parents[1]

TEXTS = sorted(
    [
        *(path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "examples").rglob("*.md"),
        *(ROOT / ".github").rglob("*.*"),
    ]
)

BLOCK = re.compile(r"^ *```(?:sh|console)\n(.*?)^ *```", re.M | re.S)
CODE = re.compile(r"`symsteer ([a-z][^`]*)`")

OURS = {
    "my_agent:MyAgent": "equivariant",
    "leashed": "leashed:LeashedAgent",
    "smooth": "symsteer_lab.smooth:SmoothAgent",
    "flow-mlp": "symsteer_lab.flow:FlowPolicy",
}
"""Names that only exist where a reader has made them, and what has the same options here."""


def lines(text: str) -> list[str]:
    """What follows `symsteer` in the lines of blocks for the shell, comments left out."""
    joined = re.sub(r"\\\n\s*", "", "\n".join(BLOCK.findall(text)))
    return re.findall(r"(?:^|&& |\$ |\S=\S+ |bin/)symsteer ([a-z][^#&|>\n]*)", joined, re.M)


def parse(name: str, *words: str) -> None:
    """Read the arguments of a verb, and do nothing.

    Raises:
        SystemExit: if they cannot be read.
    """
    end = words.index("--help") if "--help" in words else None
    verb, words = VERBS[name], tuple(OURS.get(word, word) for word in words[:end])
    if verb.parses:
        parse_run(words)
        return
    module, _, attribute = verb.target.partition(":")
    function = getattr(importlib.import_module(module), attribute)
    tyro.cli(functools.wraps(function)(lambda *args, **options: 0), args=words)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_commands_can_be_parsed(path, monkeypatch):
    for folder in (ROOT / "examples", ROOT / "examples" / "symsteer-lab"):
        monkeypatch.syspath_prepend(folder)
    text = re.sub(r"\$\(\(.*?\)\)", "1", path.read_text())  # what the shell computes
    # In a sentence a command may end with an option that has no value, or name what is not there.
    cut = [line for line in CODE.findall(text) if not re.search(r"^\S+$| --\S+$", line)]
    assert {line.split()[0] for line in CODE.findall(text)} <= VERBS.keys() | REMOVED.keys()
    for line in (*lines(text), *cut):
        try:
            with contextlib.suppress(*[UserError] * (line in cut)):
                parse(*shlex.split(line))
        except SystemExit:
            pytest.fail(f"{path.name}: symsteer {line}")


def test_an_unknown_option_would_be_seen():
    (line,) = lines("```sh\ncd x && A=b symsteer sweep smoke \\\n  --warkers 2  # no\n```\n")
    assert line.split() == ["sweep", "smoke", "--warkers", "2"]
    with pytest.raises(SystemExit):
        parse(*line.split())
