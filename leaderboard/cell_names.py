"""How cells are called: what breaks their symmetry, and what tells them from others."""

from __future__ import annotations

from collections.abc import Sequence

from symsteer.leaderboard.keys import ARM, Key
from symsteer.leaderboard.rows import Summary, Table
from symsteer.leaderboard.text import code, count


def broken_by(key: Key) -> str:
    return " and ".join(part if part == ARM else code(part) for part in key.broken_by)


def cell_name(table: Table, summary: Summary) -> str:
    """Task, embodiment and variant, and of the rest of the key what tells the tables apart."""
    key = table.key
    name = f"{code(key.task)} {code(key.embodiment)} {broken_by(key) or 'unbroken'}"
    keys = [other.key for other in summary.tables]
    if len({other.base + other.group for other in keys}) > 1:
        name += f" {code((key.base + ' ' + key.group).strip())}"
    if len({(other.mode, other.demonstrations) for other in keys}) > 1:
        name += f" {code(f'{key.demonstrations} {key.mode}')}"
    if len({other.env_steps for other in keys}) > 1:
        name += f" {count(key.env_steps)}"
    if key.settings:
        name += f" {code(key.settings)}"
    return name


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
