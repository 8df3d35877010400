"""How cells are called: what breaks their symmetry, and what tells them from others."""

from __future__ import annotations

import re
from collections.abc import Sequence

from symsteer.leaderboard.defects import parts_of
from symsteer.leaderboard.keys import ARM, SYMMETRIC_EMBODIMENT, Key
from symsteer.leaderboard.rows import Summary, Table
from symsteer.leaderboard.text import code, count


def broken_by(key: Key) -> str:
    return " and ".join(part if part == ARM else code(part) for part in key.broken_by)


def told_apart(key: Key, keys: Sequence[Key]) -> dict[str, str]:
    """Base policy, demonstrations and steps, where they tell a key from others."""

    def texts(key: Key) -> dict[str, str]:
        return {
            "base policy": f"{key.base} {key.group}".strip(),
            "demonstrations": f"{key.demonstrations} {key.mode}",
            "steps": count(key.env_steps),
        }

    others = [texts(other) for other in keys]
    own = texts(key).items()
    return {name: text for name, text in own if any(other[name] != text for other in others)}


def cell_name(table: Table, summary: Summary) -> str:
    """In words: the task, what breaks its symmetry, and what else tells the table from others."""
    key, keys = table.key, [other.key for other in summary.tables]
    arm = [] if key.embodiment == SYMMETRIC_EMBODIMENT else [f"{_plain(key.embodiment)} arm"]
    broken = _variant(key.variant) if key.breaking[0] else []
    words = [_plain(key.task.removesuffix("-v1")), *((arm + broken) or ["unbroken"])]
    world = (key.task, key.embodiment, key.variant)
    same = [other for other in keys if (other.task, other.embodiment, other.variant) == world]
    if len({(other.base, other.group, other.mode) for other in same}) > 1:
        words.append(code(" ".join(filter(None, (key.base, key.group, key.mode)))))
    return ", ".join(
        [*words, *beside_variant(key, keys), *([code(key.settings)] * bool(key.settings))]
    )


def _variant(text: str) -> list[str]:
    """`wind:0.2..0.8` as `wind 0.2 to 0.8`; a text that is no variant as it is."""
    parts = parts_of(text)
    if parts is None:
        return [code(text)]
    words = []
    for part in parts:
        strength, _, begins = part.text.removeprefix(f"{part.name}:").partition("@")
        begun = f" from {begins} of the budget" if begins else ""
        words.append(f"{_plain(part.name)} {strength}{begun}".replace("..", " to "))
    return words


def _plain(name: str) -> str:
    """A name without underscores; as code if it is none that markdown could be given."""
    safe = re.fullmatch(r"[A-Za-z][\w-]{,40}", name, re.ASCII)
    return name.replace("_", " ") if safe else code(name)


def beside_variant(key: Key, others: Sequence[Key]) -> list[str]:
    """Demonstrations and steps, where other tables of the same place and variant differ in them."""
    same = [other for other in others if (other.place, other.variant) == (key.place, key.variant)]
    words = []
    if len({other.demonstrations for other in same}) > 1:
        words.append(f"{key.demonstrations} demonstrations")
    if len({other.env_steps for other in same if other.demonstrations == key.demonstrations}) > 1:
        words.append(f"{count(key.env_steps)} steps")
    return words


def heading(key: Key, others: Sequence[Key]) -> str:
    """What breaks the symmetry, and how the table differs from others of its place and break."""
    broken = broken_by(key)
    words = [f"Broken by {broken}" if broken else "Unbroken symmetry"]
    words += beside_variant(key, others)
    if key.settings:
        words.append(code(key.settings))
    return ", ".join(words)
