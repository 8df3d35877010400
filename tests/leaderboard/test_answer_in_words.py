"""The answer in words: the numbers that a person wrote are those that the records give."""

from __future__ import annotations

import re

import pytest

from symsteer.leaderboard.paths import PAGE_FOLDER, STUDY
from symsteer.leaderboard.study import read_study

INTERVAL = re.compile(r"[+\u2212]?\d\.\d+ \[[+\u2212]?\d\.\d+, [+\u2212]?\d\.\d+\]")
SHARE = re.compile(r"\b\d+/\d+\b")


def plain(text: str) -> str:
    """Text on one line, without marks."""
    return " ".join(re.sub("[\u25b2\u25bc>*]|<br>", " ", text).split())


def of_readme() -> str:
    """README.md's section on the leaderboard."""
    text = (PAGE_FOLDER.parent / "README.md").read_text()
    return text.split("## The leaderboard", 1)[1].split("\n## ", 1)[0]


@pytest.mark.parametrize("where", ["the page", "README.md"])
def test_every_number_of_the_answer_is_on_the_page(where: str) -> None:
    study = read_study(STUDY)
    page = (PAGE_FOLDER / "LEADERBOARD.md").read_text()
    assert (page.count(study.notice), page.count(study.details)) == (1, 1)
    results = plain(page.replace(study.notice, "").replace(study.details, ""))
    text = plain(of_readme() if where == "README.md" else f"{study.notice} {study.details}")
    for pattern in (INTERVAL, SHARE):
        stated = pattern.findall(text)
        assert stated
        assert [one for one in stated if one not in pattern.findall(results)] == []
