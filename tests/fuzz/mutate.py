"""Seeded damage to texts, bytes and nested plain data."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from random import Random
from typing import Any

POISON: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 7, 2**31, 2**63, 10**30, -(2**40)),
    *(0.5, -0.25, 1.5, 1e308, -1e308, 1e-320, float("nan"), float("inf"), -float("inf")),
    *("", "none", "nan", "1", "PickCube-v1", "a" * 5000, "a\nb", "\x1b[31mred", "\u202eabc", "\0"),
    *("../../etc/passwd", "<script>alert(1)</script>", "|x|[a](b)", "ünïcode", "'\"`", "%s%n{0}"),
    *([], [1], [[]], [None], {}, {"a": 1}, {"": None}),
)
"""Values that are valid nowhere, or only in some places."""


def poison_bytes(data: bytes, random: Random) -> bytes:
    """Cut, flip, insert, repeat, overwrite or erase."""
    kind = random.randrange(8)
    at, size = random.randrange(len(data) + 1), random.choice((1, 2, 8, 64, 512))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[at:]
    if kind == 2:
        return data + random.randbytes(size)
    if kind == 3:
        return data[:at] + random.randbytes(size) + data[at:]
    if kind == 4:
        return data[:at] + data[at + size :]
    if kind == 5:
        return data[:at] + bytes(size) + data[at + size :]
    if kind == 6:
        return random.choice((b"", b"\0", b"\xff\xfe", random.randbytes(size), b"null", b"{", b"["))
    return flip_bits(data, random, random.choice((1, 1, 1, 2, 16)))


def flip_bits(data: bytes, random: Random, count: int = 1) -> bytes:
    """Flip ``count`` bits."""
    damaged = bytearray(data)
    for _ in range(count):
        damaged[random.randrange(len(damaged))] ^= 1 << random.randrange(8)
    return bytes(damaged)


def poison_lines(text: str, random: Random) -> str:
    """Drop, repeat, swap, shorten or garble lines."""
    lines = text.split("\n")
    i, j = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.randrange(6)
    if kind == 0:
        del lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    elif kind == 2:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 3:
        lines[i] = lines[i][: random.randrange(len(lines[i]) + 1)]
    elif kind == 4:
        lines[i] = "".join(random.sample(lines[i], len(lines[i])))
    else:
        lines[i] += random.choice(("]", "}", "=", "'", '"', "\\", "\t", "[x]", ", ,", "#", "\r"))
    return "\n".join(lines)


def places(data: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of nested dicts and lists."""
    found: list[tuple[Any, Any]] = []
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        found.append((data, key))
        if isinstance(value, dict | list):
            found += places(value)
    return found


def poison_data(data: Any, random: Random, changes: int = 1) -> Any:
    """A copy with keys dropped, misspelt, added, or values replaced, wherever they stand."""
    data = copy.deepcopy(data)
    for _ in range(changes):
        container, key = random.choice(places(data))
        value = container[key]
        kind = random.randrange(7)
        if kind == 0:
            del container[key]
        elif kind == 1 and isinstance(container, dict):
            word = str(key)
            cut = random.randrange(len(word) + 1)
            del container[key]
            container[word[:cut] + random.choice(("x", "", "_")) + word[cut + 1 :]] = value
        elif kind == 2 and isinstance(container, dict):
            container[random.choice(("colour", "", "a\nb", "\x1b[1m", "k" * 3000))] = value
        elif kind == 3 and isinstance(container, list):
            container.insert(key, copy.deepcopy(value))
        elif kind == 4 and type(value) in (int, float):
            container[key] = random.choice(
                (-value, value + 1, value * 1e6, str(value), [value], value + 0.5, -value - 1)
            )
        elif kind == 4 and isinstance(value, str) and value:
            at = random.randrange(len(value))
            container[key] = value[:at] + random.choice("x-/:+\n") + value[at + 1 :]
        else:
            container[key] = copy.deepcopy(random.choice(POISON))
    return data


def extreme(data: Any, random: Random) -> Any:
    """A copy in which some numbers and texts are extreme, but of the type that they were."""
    data = copy.deepcopy(data)
    for _ in range(random.choice((1, 1, 2, 5))):
        container, key = random.choice(places(data))
        kind = type(container[key])
        if kind is int:
            container[key] = random.choice((0, 1, 2, 2**31, 2**53, 10**18))
        elif kind is float:
            container[key] = random.choice((0.0, 1.0, 1e308, -1e308, 1e-308, -0.5, 1e15))
        elif kind is str:
            container[key] = random.choice(
                ("<b>|`a`|</b>", "[x](javascript:1)", "a" * 119, "ä" * 60, "a\nb", "../x", "0")
            )
    return data


def poison_json(text: str, random: Random) -> str:
    """JSON with its content, its text or its bytes damaged."""
    kind = random.randrange(10)
    if kind < 6:
        return json.dumps(poison_data(json.loads(text), random, random.choice((1, 1, 1, 3))))
    if kind == 6:
        return poison_lines(text, random)
    if kind == 7:  # a key twice, a comment, a deep nest, a lone value
        return random.choice(
            (
                text.replace("{", '{"a": 1, "a": 2,', 1),
                "// a run\n" + text,
                "[" * 100_000,
                '{"a":' * 5000 + "1" + "}" * 5000,
                "3",
                '"text"',
                "[]",
                "{}",
                text + text,
                "9" * 5000,
            )
        )
    return poison_bytes(text.encode(), random).decode("latin-1")


def same(a: Any, b: Any) -> bool:
    """Whether nested plain data are equal, types included (1 is not 1.0, NaN is NaN)."""
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b or (a != a and b != b)


Mutator = Callable[[Random], Any]
