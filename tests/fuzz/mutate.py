"""Seeded damage to texts, bytes and nested plain data; tensors may be among them."""

from __future__ import annotations

import copy
import json
import math
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import torch

POISON: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 2, 7, 2**31, 2**40, 2**63, 10**9, 10**30, -(2**40)),
    *(0.5, -0.25, 1.5, 1e308, -1e308, 1e-320, float("nan"), float("inf"), -float("inf")),
    *("", "none", "nan", "1", "PickCube-v1", "a" * 5000, "a\nb", "\x1b[31mred", "\u202eabc", "\0"),
    *("../../etc/passwd", "<script>alert(1)</script>", "|x|[a](b)", "ünïcode", "'\"`", "%s%n{0}"),
    *([], [1], [[]], [None], {}, {"a": 1}, {"": None}),
)
"""Values that are valid nowhere, or only in some places."""

EXTREME: dict[type, tuple[Any, ...]] = {
    int: (0, 1, 2, 2**31, 2**53, 10**18),
    float: (0.0, 1.0, 1e308, -1e308, 1e-308, -0.5, 1e15),
    str: ("<b>|`a`|</b>", "[x](javascript:1)", "a" * 119, "ä" * 60, "a\nb", "../x", "0"),
}
"""Values of the type that they replace."""

Way = Callable[[Path, Random], None]
"""Damages the file at a path."""


def nested(depth: int, kind: int = 0) -> Any:
    """Lists or tables in each other."""
    value: Any = 1
    for _ in range(depth):
        value = [value] if kind else {"a": value}
    return value


def poison_bytes(data: bytes, random: Random) -> bytes:
    """Cut, insert, repeat, overwrite, erase or flip."""
    at, size = random.randrange(len(data) + 1), random.choice((1, 2, 8, 64, 512))
    return random.choice(
        (
            lambda: data[:at],
            lambda: data[at:],
            lambda: data[:at] + random.randbytes(size) + data[at:],
            lambda: data[:at] + data[at + size :],
            lambda: data[:at] + bytes(size) + data[at + size :],
            lambda: random.choice((b"", b"\0", b"\xff\xfe", random.randbytes(size), b"null", b"{")),
            lambda: flip_bits(data, random, random.choice((1, 2, 16))),
        )
    )()


def flip_bits(data: bytes, random: Random, count: int = 1) -> bytes:
    damaged = bytearray(data)
    for _ in range(count):
        damaged[random.randrange(len(damaged))] ^= 1 << random.randrange(8)
    return bytes(damaged)


def places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of nested dicts and lists."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield data, key
        if isinstance(value, dict | list):
            yield from places(value)


def poison_data(data: Any, random: Random) -> Any:
    """A copy with keys dropped, misspelt, added, or values replaced, wherever they stand."""
    data = copy.deepcopy(data)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        if not (everywhere := list(places(data))):
            break
        container, key = random.choice(everywhere)
        value, is_table = container[key], isinstance(container, dict)
        kind = random.randrange(8)
        if kind == 0:
            del container[key]
        elif isinstance(value, torch.Tensor):
            container[key] = poison_tensor(value, random)
        elif kind == 1 and is_table:
            cut = random.randrange(len(str(key)) + 1)
            del container[key]
            container[str(key)[:cut] + random.choice(("x", "", "_")) + str(key)[cut + 1 :]] = value
        elif kind == 2 and is_table:
            container[random.choice(("colour", "", "a\nb", "\x1b[1m", "k" * 3000))] = value
        elif kind == 2:
            container.insert(key, copy.deepcopy(value))
        elif kind == 3 and type(value) in EXTREME:
            container[key] = random.choice((*EXTREME[type(value)], str(value) + "x", [value]))
        elif kind == 4:
            container[key] = nested(random.choice((3, 40, 150)), random.randrange(2))
        else:
            container[key] = copy.deepcopy(random.choice(POISON))
    return data


def extreme(data: Any, random: Random) -> Any:
    """A copy in which some numbers and texts are extreme, but of the type that they were."""
    data = copy.deepcopy(data)
    for container, key in random.choices(list(places(data)), k=random.choice((1, 2, 5))):
        if type(container[key]) in EXTREME:
            container[key] = random.choice(EXTREME[type(container[key])])
    return data


def poison_tensor(value: torch.Tensor, random: Random) -> Any:
    """One element less, another order or type, NaN, or no tensor."""
    line = value.flatten()
    changed = [line[1:], line.flip(0), value.double(), random.choice(POISON)]
    if value.is_floating_point():
        changed.append(torch.full_like(value, float("nan")))
    return random.choice(changed)


# Ways to damage the file at a path.


def as_data(read: Callable[[Path], Any], write: Callable[[Path, Any], Any]) -> Way:
    """Read the file, damage its data, write it."""
    return lambda path, random: write(path, poison_data(read(path), random))


def write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data), "utf-8", "surrogatepass")


def damage_bytes(path: Path, random: Random) -> None:
    path.write_bytes(poison_bytes(path.read_bytes(), random))


def damage_bits(path: Path, random: Random) -> None:
    path.write_bytes(flip_bits(path.read_bytes(), random, random.choice((1, 1, 3))))


damage_json = as_data(lambda path: json.loads(path.read_text()), write_json)

damage_toml = as_data(
    lambda path: tomllib.loads(path.read_text()),
    lambda path, data: path.write_text(to_toml(data), "utf-8", "surrogatepass"),
)


def damage_json_text(path: Path, random: Random) -> None:
    """A key twice, a comment, a deep nest, a lone value."""
    text = path.read_text()
    texts = (
        *(text.replace("{", '{"a": 1, "a": 2,', 1), "// a run\n" + text, "[" * 100_000),
        *('{"a":' * 5000 + "1" + "}" * 5000, "3", '"text"', "[]", "{}", text + text, "9" * 5000),
    )
    path.write_text(random.choice(texts))


def damage_toml_text(path: Path, random: Random) -> None:
    """One table is deep, or none; a value that JSON does not have."""
    table = random.choice(list(tomllib.loads(path.read_text())))
    depth = random.choice((20, 900, 5000))
    texts = (
        *("", f"{table} = 1", f"[[{table}]]\nseed = [0]\n[[{table}]]\nsede = [1]"),
        *(f"[{table}]\nseed = 2026-01-31", f"[{table}]\nlr = 1e400", f"[{table}]\n'.' = [1]"),
        *(f"[{table}]\nvariant = 'wind,obstacle'", f"[{table}]\nseed = {'9' * 26}"),
        f"[{table}.{'.'.join('a' * depth)}]\nb = 1\n",
        f"{table} = {'[' * depth}{']' * depth}\n",
        f"{table}.x = {'{a=' * depth}1{'}' * depth}\n",
        "[grid]\nseed = [" + "0, " * 2000 + "1]\nnum_envs = [" + "1, " * 2000 + "2]",
    )
    path.write_text(random.choice(texts))


def to_toml(data: dict[str, Any]) -> str:
    """A table as TOML; values that TOML does not have are written as in JSON."""
    return "\n".join(f"{json.dumps(str(key))} = {_inline(value)}" for key, value in data.items())


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(k)} = {_inline(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return (
        str(value) if isinstance(value, float) and not math.isfinite(value) else json.dumps(value)
    )
