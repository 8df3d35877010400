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

Facts = Mapping[str, str]


def pair_runs(a: Side, b: Side, margin: float = 0.0) -> Changes:
    """Pair the runs of two sides; each run is in one pair at most, and B may lose the margin.

    Raises:
        UserError: if no run of A has a partner in B.
    """
    agents_differ = _has_one_agent(a) and _has_one_agent(b)
    facts = {
        run.path: {
            key: text
            for key, text in _facts_of(run).items()
            if not (agents_differ and _is_of_agent(key))
        }
        for run in (*a.runs, *b.runs)
    }

    # Settings count that records of both sides have, for each agent.
    known: list[dict[str, set[str]]] = [{}, {}]
    for side, keys in zip((a, b), known, strict=True):
        for run in side.runs:
            keys.setdefault("" if agents_differ else run.agent, set()).update(facts[run.path])
    both = known[0].keys() & known[1].keys()
    shared = {agent: known[0][agent] & known[1][agent] for agent in both}

    def identity(run: Run) -> dict[str, str]:
        keys = {*shared.get("" if agents_differ else run.agent, ()), "agent"}
        return {key: text for key, text in facts[run.path].items() if key in keys}

    identities = {run.path: identity(run) for run in (*a.runs, *b.runs)}
    partners: dict[frozenset[tuple[str, str]], list[Run]] = defaultdict(list)
    for run in sorted(b.runs, key=lambda run: (run.record.started, run.record.run_id)):
        partners[frozenset(identities[run.path].items())].append(run)
    cells, paired = [], set()
    for key, row in a.rows:
        pairs = []
        for run in row.finished:
            if others := partners[frozenset(identities[run.path].items())]:
                pairs.append(RunPair(run, others.pop()))
                paired |= {pairs[-1].a.path, pairs[-1].b.path}
        if pairs:
            usual = agents_differ and row.label == row.agent
            cells.append(PairedCell(key, "" if usual else row.label, tuple(pairs)))
    if not cells:
        raise _without_pairs(a, b, identities)

    def alone(side: Side, other: Side, name: str) -> tuple[Leftover, ...]:
        rest = [run for run in side.runs if run.path not in paired]
        reasons = (_why(run, other, identities, name) for run in rest)
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
    """What tells a run from others: settings, base policy, held-out episodes."""
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
        for key in _differing(mine, theirs)
    ]


def _differing(mine: Facts, theirs: Facts) -> list[str]:
    """The facts in which two runs differ."""
    return sorted(key for key in mine.keys() | theirs.keys() if mine.get(key) != theirs.get(key))


def _named(mine: Facts, theirs: Facts, values: bool) -> list[str]:
    """The facts that are named where two runs differ: the telling ones alone if there are any."""
    keys = _differing(mine, theirs)
    keys = [key for key in TELLING if key in keys] or keys
    more = len(keys) - MOST_NAMED
    texts = [
        key.removeprefix(OPTIONS)
        + f" ({mine.get(key, 'unset')[:40]}, {theirs.get(key, 'unset')[:40]})" * values
        for key in keys[:MOST_NAMED]
    ]
    return texts + [f"{more} more"] * (more > 0)


def _nearest(run: Run, side: Side, identities: Mapping[Path, Facts]) -> tuple[int, Run]:
    """The run of the other side that differs in the fewest facts, and in how many."""
    own = identities[run.path]
    counts = [len(own.items() ^ identities[other.path].items()) for other in side.runs]
    return min(counts), side.runs[counts.index(min(counts))]


def _why(run: Run, other: Side, identities: Mapping[Path, Facts], name: str) -> str:
    """Why a run has no partner."""
    _, near = _nearest(run, other, identities)
    texts = _named(identities[run.path], identities[near.path], values=False)
    if not texts:
        return f"its run of {name} has another partner"
    return f"the nearest run of {name} differs in {', '.join(texts)}"


def _without_pairs(a: Side, b: Side, identities: Mapping[Path, Facts]) -> UserError:
    mine = min(a.runs, key=lambda run: _nearest(run, b, identities)[0])
    _, theirs = _nearest(mine, b, identities)
    texts = _named(identities[mine.path], identities[theirs.path], values=True)
    return UserError(
        f"no run of A ({a.name}, {len(a.runs)} finished) has a partner in B ({b.name}, "
        f"{len(b.runs)} finished): the nearest, {mine.record.run_id} and {theirs.record.run_id}, "
        f"differ in {' and '.join(texts)}; compare runs that agree in task, variant, base policy, "
        "seed, budget and evaluation"
    )
