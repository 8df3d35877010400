"""Pairs of runs that agree in everything but what the two sides differ in.

The two runs of a pair have the same task, embodiment, variant, demonstrations, base policy (content
hash), seeds, budget and evaluation, and all other settings in common. Their agents and the agents'
options are the same, too, unless each side has one agent with one set of options: then these are
what is compared.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

from symsteer.errors import UserError
from symsteer.leaderboard.compare.changes import Changes, PairedCell, RunPair
from symsteer.leaderboard.compare.sides import Leftover, Side
from symsteer.leaderboard.keys import OPTIONS, setting_texts
from symsteer.leaderboard.runs import Run

TELLING = ("task", "embodiment", "variant", "agent", "seed", "env_steps")
"""Where one of these differs, others that differ need not be named: they may follow from it."""

MOST_NAMED = 3

Facts = frozenset[tuple[str, str]]
"""What tells a run from others: settings, base policy, held-out episodes, with their texts."""


def pair_runs(a: Side, b: Side, margin: float = 0.0) -> Changes:
    """Pair the runs of two sides; each run is in one pair at most, and B may lose the margin.

    Raises:
        UserError: if no run of A has a partner in B.
    """
    agents_differ = _has_one_agent(a) and _has_one_agent(b)

    def counted(run: Run) -> dict[str, str]:
        facts = _facts_of(run).items()
        return {key: text for key, text in facts if not (agents_differ and _is_of_agent(key))}

    # Settings count that records of both sides have, for each agent.
    known: list[dict[str, set[str]]] = [defaultdict(set), defaultdict(set)]
    for side, keys in zip((a, b), known, strict=True):
        for run in side.runs:
            keys["" if agents_differ else run.agent] |= counted(run).keys()
    both = known[0].keys() & known[1].keys()
    shared = {agent: known[0][agent] & known[1][agent] for agent in both}

    facts: dict[Path, Facts] = {}
    for run in (*a.runs, *b.runs):
        common = {*shared.get("" if agents_differ else run.agent, ()), "agent"}
        facts[run.path] = frozenset(item for item in counted(run).items() if item[0] in common)
    partners: dict[Facts, list[Run]] = defaultdict(list)
    for run in sorted(b.runs, key=lambda run: (run.record.started, run.record.run_id)):
        partners[facts[run.path]].append(run)
    cells, paired = [], set()
    for key, row in a.rows:
        pairs = []
        for run in row.finished:
            if others := partners[facts[run.path]]:
                pairs.append(RunPair(run, others.pop()))
                paired |= {pairs[-1].a.path, pairs[-1].b.path}
        if pairs:
            usual = agents_differ and row.label == row.agent
            cells.append(PairedCell(key, "" if usual else row.label, tuple(pairs)))
    if not cells:
        raise _without_pairs(a, b, facts)

    def alone(side: Side, other: Side, name: str) -> tuple[Leftover, ...]:
        rest = [run for run in side.runs if run.path not in paired]
        reasons = (_why(run, other, facts, name) for run in rest)
        return *map(Leftover, rest, reasons), *side.leftovers

    def only(mine: dict[str, set[str]]) -> tuple[str, ...]:
        return tuple(sorted({key for agent in both for key in mine[agent] - shared[agent]}))

    return Changes(
        cells=tuple(cells),
        alone=(alone(a, b, "B"), alone(b, a, "A")),
        one_sided=(only(known[0]), only(known[1])),
        changed=tuple(sorted({t for cell in cells for pair in cell.pairs for t in _changes(pair)})),
        margin=margin,
    )


def _facts_of(run: Run) -> dict[str, str]:
    more = {"base policy": run.policy, "held-out episodes": str(list(run.final_success))}
    return setting_texts(run.record.config) | more


def _is_of_agent(key: str) -> bool:
    return key == "agent" or key.startswith(OPTIONS)


def _agent_of(run: Run) -> dict[str, str]:
    """The agent with its options."""
    return {key: text for key, text in _facts_of(run).items() if _is_of_agent(key)}


def _has_one_agent(side: Side) -> bool:
    """Whether it is about one agent; of an agent, a side has one set of options for each cell."""
    return side.kind == "agent" or all(_agent_of(r) == _agent_of(side.runs[0]) for r in side.runs)


def _changes(pair: RunPair) -> list[str]:
    """Options of one agent that differ between two runs."""
    mine, theirs = _agent_of(pair.a), _agent_of(pair.b)
    if mine["agent"] != theirs["agent"]:
        return []
    return [
        f"{key.removeprefix(OPTIONS)} {mine.get(key, 'unset')} -> {theirs.get(key, 'unset')}"
        for key in sorted({key for key, _ in mine.items() ^ theirs.items()})
    ]


def _named(mine: Facts, theirs: Facts) -> tuple[list[str], list[str]]:
    """The facts that are named where two runs differ: the telling ones alone if there are any.

    Returns:
        Their names, and the same with both values.
    """
    keys = sorted({key for key, _ in mine ^ theirs})
    keys = [key for key in TELLING if key in keys] or keys
    more = [f"{len(keys) - MOST_NAMED} more"] * (len(keys) > MOST_NAMED)
    names = [key.removeprefix(OPTIONS) for key in keys[:MOST_NAMED]]
    values = [
        ", ".join(dict(facts).get(key, "unset")[:40] for facts in (mine, theirs)) for key in keys
    ]
    both = [f"{name} ({texts})" for name, texts in zip(names, values, strict=False)]
    return names + more, both + more


def _nearest(run: Run, side: Side, facts: Mapping[Path, Facts]) -> tuple[int, Run]:
    """In how many facts the nearest run of the other side differs, and that run."""
    counts = [len(facts[run.path] ^ facts[other.path]) for other in side.runs]
    return min(counts), side.runs[counts.index(min(counts))]


def _why(run: Run, other: Side, facts: Mapping[Path, Facts], name: str) -> str:
    """Why a run has no partner."""
    _, near = _nearest(run, other, facts)
    names, _ = _named(facts[run.path], facts[near.path])
    if not names:
        return f"its run of {name} has another partner"
    return f"the nearest run of {name} differs in {', '.join(names)}"


def _without_pairs(a: Side, b: Side, facts: Mapping[Path, Facts]) -> UserError:
    mine = min(a.runs, key=lambda run: _nearest(run, b, facts)[0])
    _, theirs = _nearest(mine, b, facts)
    _, texts = _named(facts[mine.path], facts[theirs.path])
    return UserError(
        f"no run of A ({a.name}, {len(a.runs)} finished) has a partner in B ({b.name}, "
        f"{len(b.runs)} finished): the nearest, {mine.record.run_id} and {theirs.record.run_id}, "
        f"differ in {' and '.join(texts)}; compare runs that agree in task, variant, base policy, "
        "seed, budget and evaluation"
    )
