"""How cells are called: what breaks their symmetry, and what tells them from others."""

from __future__ import annotations

from collections.abc import Sequence

from symsteer.leaderboard.keys import ARM, Key
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
    """Task, embodiment and variant, and of the rest of the key what tells the tables apart."""
    key = table.key
    words = [code(key.task), code(key.embodiment), broken_by(key) or "unbroken"]
    apart = told_apart(key, [other.key for other in summary.tables])
    words += [text if name == "steps" else code(text) for name, text in apart.items()]
    return " ".join([*words, *([code(key.settings)] if key.settings else [])])


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
