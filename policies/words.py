"""Sentences that say what to do, and the numbers that a network is told of a sentence.

The sentences of each task are in ``sentences.toml``. Some wordings are held out: no policy is
trained on them. A sentence becomes a vector by hashing the beginnings of its words:

    v = sum over words of h(first 3 letters) + 2 h(first 4 letters)
    e(sentence) = LENGTH v / ||v||_1

Beginnings, so that "pushing" is near to "push". The h are signs, the bits of a BLAKE2b hash, which
is the same on every machine: a fixed random projection, in which different beginnings are nearly
orthogonal. The order of the words is not told.
"""

from __future__ import annotations

import functools
import hashlib
import itertools
import re
import tomllib
from importlib import resources
from typing import Any

import numpy as np
import torch

from symsteer.errors import UserError
from symsteer.names import unknown

SIZE = 128
"""Numbers of an embedding."""

LENGTH = 4
"""Their absolute values add up to this, as those of a normalised one-hot vector of five tasks do: a
step of Adam moves what a network hears as far."""

LONGEST = 200
"""Characters of an instruction."""

TEXT = re.compile(r"[a-z][a-z0-9 ,.-]*", re.ASCII | re.IGNORECASE)


@functools.cache
def _data() -> dict[str, Any]:
    file = resources.files(__package__).joinpath("sentences.toml")
    return tomllib.loads(file.read_text("utf-8"))


@functools.cache
def wordings(task: str, held_out: bool = False) -> tuple[tuple[str, ...], ...]:
    """What the task can be called: for each wording, every way to fill its slots.

    Args:
        task: its name.
        held_out: the wordings that no policy is trained on, instead of those of the training.

    Raises:
        UserError: if there are no sentences for the task.
    """
    data = _data()
    if task not in data["tasks"]:
        raise unknown("task with sentences", task, data["tasks"])
    found = []
    for wording in data["tasks"][task]["held_out" if held_out else "training"]:
        slots = sorted(set(re.findall(r"{(\w+)}", wording)))
        filled = itertools.product(*(data["slots"][slot] for slot in slots))
        found.append(tuple(wording.format(**dict(zip(slots, w, strict=True))) for w in filled))
    return tuple(found)


def sentences(task: str, held_out: bool = False) -> tuple[str, ...]:
    """All that the task can be called, wording after wording; see :func:`wordings`."""
    return tuple(itertools.chain.from_iterable(wordings(task, held_out)))


def words_of(sentence: str) -> list[str]:
    """Its words in small letters, without those that most sentences have."""
    return [w for w in re.findall(r"[a-z]+", sentence.lower()) if w not in _data()["ignored"]]


@functools.cache
def _known() -> frozenset[str]:
    every = (sentence for task in _data()["tasks"] for sentence in sentences(task))
    return frozenset(word[:4] for sentence in every for word in words_of(sentence))


def check_instruction(sentence: str) -> None:
    """Raise a UserError if no policy can follow it.

    Raises:
        UserError: if it is too long, has characters that a sentence has not, names a direction of
            the plane, or no word of it begins like one of the training of any task.
    """
    cure = "say it as in " + repr(sentences("PushCube-v1")[0])
    if len(sentence) > LONGEST or not TEXT.fullmatch(sentence):
        raise UserError(
            f"an instruction is an English sentence of letters, digits, spaces, commas, full stops "
            f"and hyphens, {LONGEST} characters at most, not {sentence[:LONGEST]!r}; {cure}"
        )
    words = words_of(sentence)
    if named := [word for word in words if word.startswith(tuple(_data()["directions"]))]:
        raise UserError(
            f"the instruction names a direction ({named[0]!r}), which turns with the scene while "
            f"the sentence stays; name a thing in the scene instead, {cure}"
        )
    if not _known().intersection(word[:4] for word in words):
        raise UserError(
            f"the instruction {sentence!r} has no word that tells a task in the sentences of the "
            f"training; {cure}"
        )


@functools.lru_cache(maxsize=4096)
def embedding(sentence: str) -> torch.Tensor:
    """The vector of a sentence, ``[SIZE]`` float32; 0 if no word is told."""
    told = [_signs(w[:3]) + 2 * _signs(w[:4]) for w in words_of(sentence)]
    # Whole numbers, so that no order of a sum matters.
    total = sum(told, start=np.zeros(SIZE, np.int64))
    return torch.from_numpy(total * (LENGTH / max(1, int(abs(total).sum())))).float()


def _signs(beginning: str) -> np.ndarray:
    digest = hashlib.blake2b(beginning.encode(), digest_size=SIZE // 8).digest()
    return 2 * np.unpackbits(np.frombuffer(digest, np.uint8)).astype(np.int64) - 1
