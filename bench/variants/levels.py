"""Strengths by the defect that the audit measured: ``wind:hard`` breaks every task alike.

A dial of 0.5 means different things in different tasks. A level is a defect of a decision
(docs/audit.md), and its strength is found in the committed audit of the task.
"""

from __future__ import annotations

import functools
import importlib.resources
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from symsteer.errors import UserError
from symsteer.variant import UNBROKEN, parts_of

LEVELS = {"easy": 0.1, "medium": 0.25, "hard": 0.5}
"""The defect of a decision, for the group C8."""

GROUP = "C8"

_WORD = re.compile(rf"\b({'|'.join(LEVELS)})\b")


def with_numbers(text: str, task: str, embodiment: str) -> str:
    """The text of a variant with each level replaced by its strength in a task.

    Args:
        text: such as ``action_gain:medium+wind:0.5`` or ``wind:easy..hard``; texts without a level
            stay as they are.
        task: its name.
        embodiment: ``floating`` or ``panda``.

    Raises:
        UserError: if the task was not audited with a variant, or no strength has such a defect.
    """
    texts = []
    for part in parts_of(text):
        name, colon, number = part.rpartition(":")

        def strength_of(match: re.Match[str], name: str = name) -> str:
            return f"{strength(name, match[0], task, embodiment):g}"

        texts.append(f"{name}:{_WORD.sub(strength_of, number)}" if colon else part)
    return "+".join(texts)


Points = dict[tuple[str, str], dict[str, dict[float, float]]]
"""Task and embodiment -> name of a variant -> strength -> defect of a decision."""


def strength(
    name: str, level: str, task: str, embodiment: str, audited: Points | None = None
) -> float:
    """The least strength at which a variant has the defect of a level, to two decimals.

    Between the audited strengths the defect is interpolated linearly.

    Args:
        name: of the variant.
        level: a name of :data:`LEVELS`.
        task: its name.
        embodiment: ``floating`` or ``panda``.
        audited: another audit than the committed one.

    Raises:
        UserError: as :func:`with_numbers`.
    """
    if audited is None:
        audited = _committed()
    points = audited.get((task, embodiment), {}).get(name)
    if points is None:
        raise UserError(
            f"{name}:{level} needs an audit of {name!r} for {task!r} ({embodiment}), and there is "
            f"none in this version of SymSteer; give a number, e.g. {name}:0.5"
        )
    wanted = LEVELS[level]
    where = (
        f"{name!r} in {task!r} ({embodiment}) has no strength for {level!r}, a defect of {wanted:g}"
    )
    largest = max(points.values())
    if points[0.0] >= wanted:
        raise UserError(
            f"{where}: unbroken it is {points[0.0]:.2f}; take a higher level, or give a number"
        )
    if largest < wanted:
        raise UserError(
            f"{where}: the largest that was audited is {largest:.2f}; take a lower level or "
            "another variant, or give a number"
        )
    (low, below), (high, above) = next(
        pair for pair in itertools.pairwise(sorted(points.items())) if pair[1][1] >= wanted
    )
    return round(low + (high - low) * (wanted - below) / (above - below), 2)


def points_of(rows: Sequence[Mapping[str, Any]]) -> Points:
    """Defects by strength, from the rows of an audit's summary."""
    rows = [row for row in rows if row["group"] == GROUP]
    unbroken = {
        (row["task"], row["embodiment"]): row["decision"][0]
        for row in rows
        if row["variant"] == UNBROKEN
    }
    audited: Points = {}
    for row in rows:
        name, _, number = row["variant"].partition(":")
        place = row["task"], row["embodiment"]
        if number and "+" not in number and place in unbroken:
            points = audited.setdefault(place, {}).setdefault(name, {0.0: unbroken[place]})
            points[float(number)] = row["decision"][0]
    return audited


@functools.cache
def _committed() -> Points:
    file = importlib.resources.files("symsteer.leaderboard") / "results/audit/summary.json"
    return points_of(json.loads(file.read_text()))
