"""Pairs of runs that agree in everything but what the two sides differ in.

The two runs of a pair have the same task, embodiment, variant, demonstrations, base policy (content
hash), seeds, budget and evaluation, and all other settings in common. Their agents and the agents'
options are the same, too, unless each side has one agent with one set of options: then these are
what is compared.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from symsteer.errors import UserError
from symsteer.leaderboard.compare.sides import Leftover, Side
from symsteer.leaderboard.summary import Key, Run, setting_texts

OPTIONS = "agent_options."
BASE_POLICY = "base policy"
TELLING = ("task", "embodiment", "variant", "agent", "seed", "env_steps")
"""Where one of these differs, others that differ need not be named: they may follow from it."""
MOST_NAMED = 3

Facts: TypeAlias = frozenset[tuple[str, str]]


@dataclass(frozen=True)
class RunPair:
    a: Run
    b: Run

    @property
    def same_episodes(self) -> bool:
        """Whether all episodes of all evaluations agree bit for bit."""
        mine, theirs = self.a.record.evaluations, self.b.record.evaluations
        return [e.episodes for e in mine] == [e.episodes for e in theirs]

    @property
    def same_diagnostics(self) -> bool:
        """Whether all diagnostics of all evaluations agree bit for bit."""
        mine, theirs = self.a.record.evaluations, self.b.record.evaluations
        return [(e.diagnostics, e.nonfinite) for e in mine] == [
            (e.diagnostics, e.nonfinite) for e in theirs
        ]


@dataclass(frozen=True)
class Cell:
    """The pairs of one cell and agent.

    Attributes:
        key: the cell.
        label: agent and settings of A; empty where they are the same in all cells.
        pairs: at least one.
    """

    key: Key
    label: str
    pairs: tuple[RunPair, ...]

    @property
    def is_identical(self) -> bool:
        return all(pair.same_episodes for pair in self.pairs)


@dataclass(frozen=True)
class Pairing:
    """The pairs of two sides.

    Attributes:
        cells: at least one.
        alone: runs of A, and runs of B, that are in no pair.
        one_sided: settings that only the records of A have, and those that only B's have; they do
            not count.
        changed: options of the agent that differ within pairs, as texts.
    """

    cells: tuple[Cell, ...]
    alone: tuple[tuple[Leftover, ...], tuple[Leftover, ...]]
    one_sided: tuple[tuple[str, ...], tuple[str, ...]]
    changed: tuple[str, ...]

    @property
    def pairs(self) -> list[RunPair]:
        return [pair for cell in self.cells for pair in cell.pairs]


def pair_runs(a: Side, b: Side) -> Pairing:
    """Pair the runs of two sides; each run is in one pair at most.

    Raises:
        UserError: if no run of A has a partner in B.
    """
    agents_differ = _has_one_agent(a) and _has_one_agent(b)
    facts = {run.path: facts_of(run, not agents_differ) for run in (*a.runs, *b.runs)}
    known = [_known(side.runs, facts, agents_differ) for side in (a, b)]
    shared = known[0] & known[1]

    def identity(run: Run) -> Facts:
        agent = "" if agents_differ else run.agent
        return frozenset(
            (key, value)
            for key, value in facts[run.path].items()
            if (agent, key) in shared or key == "agent"
        )

    identities = {run.path: identity(run) for run in (*a.runs, *b.runs)}
    partners: dict[Facts, list[Run]] = defaultdict(list)
    for run in sorted(b.runs, key=lambda run: (run.record.started, run.record.run_id)):
        partners[identities[run.path]].append(run)
    cells, paired = [], set()
    for key, row in a.rows:
        pairs = []
        for run in row.finished:
            if others := partners[identities[run.path]]:
                pairs.append(RunPair(run, others.pop()))
                paired |= {pairs[-1].a.path, pairs[-1].b.path}
        if pairs:
            usual = agents_differ and row.label == row.agent
            cells.append(Cell(key, "" if usual else row.label, tuple(pairs)))
    if not cells:
        raise _without_pairs(a, b, identities)

    def alone(side: Side, other: Side, name: str) -> tuple[Leftover, ...]:
        rest = [run for run in side.runs if run.path not in paired]
        reasons = (_why(run, other.runs, identities, name) for run in rest)
        return *map(Leftover, rest, reasons), *side.leftovers

    return Pairing(
        tuple(cells),
        (alone(a, b, "B"), alone(b, a, "A")),
        (_only(known[0], known[1]), _only(known[1], known[0])),
        tuple(sorted({text for cell in cells for pair in cell.pairs for text in _changes(pair)})),
    )


def facts_of(run: Run, with_agent: bool = True) -> dict[str, str]:
    """What tells a run from others: settings, base policy, held-out episodes."""
    settings = {
        key: value
        for key, value in setting_texts(run.record.config).items()
        if with_agent or not (key == "agent" or key.startswith(OPTIONS))
    }
    return settings | {BASE_POLICY: run.policy, "held-out episodes": str(list(run.final_success))}


def _has_one_agent(side: Side) -> bool:
    """Whether it is about one agent; of an agent, a side has one set of options for each cell."""
    if side.kind == "agent":
        return True
    return len({_with_options(run) for run in side.runs}) == 1


def _with_options(run: Run) -> Facts:
    return frozenset(
        (k, v) for k, v in facts_of(run).items() if k == "agent" or k.startswith(OPTIONS)
    )


def _known(
    runs: Iterable[Run], facts: Mapping[Path, Mapping[str, str]], agents_differ: bool
) -> set[tuple[str, str]]:
    """The settings that records of a side have, for each agent."""
    return {("" if agents_differ else r.agent, key) for r in runs for key in facts[r.path]}


def _only(mine: set[tuple[str, str]], theirs: set[tuple[str, str]]) -> tuple[str, ...]:
    """Settings that one side alone has, of agents that both have."""
    agents = {agent for agent, _ in theirs}
    return tuple(sorted({key for agent, key in mine - theirs if agent in agents}))


def _changes(pair: RunPair) -> list[str]:
    """Options of one agent that differ between two runs."""
    mine, theirs = (dict(_with_options(run)) for run in (pair.a, pair.b))
    if mine["agent"] != theirs["agent"]:
        return []
    return [
        f"{key.removeprefix(OPTIONS)} {mine.get(key, 'unset')} -> {theirs.get(key, 'unset')}"
        for key in mine.keys() | theirs.keys()
        if mine.get(key) != theirs.get(key)
    ]


def _nearest(run: Run, others: Sequence[Run], identities: Mapping[Path, Facts]) -> Run:
    """The run of the other side that differs in the fewest facts."""
    own = identities[run.path]
    return min(others, key=lambda other: len(own ^ identities[other.path]))


def _differing(first: Facts, second: Facts) -> list[str]:
    """The facts in which two runs differ, the telling ones alone where there are any."""
    keys = {key for key, _ in first ^ second}
    return [key for key in TELLING if key in keys] or sorted(keys)


def _why(run: Run, others: Sequence[Run], identities: Mapping[Path, Facts], other: str) -> str:
    """Why a run has no partner."""
    near = _nearest(run, others, identities)
    keys = _differing(identities[run.path], identities[near.path])
    if not keys:
        return f"its run of {other} has another partner"
    more = len(keys) - MOST_NAMED
    names = ", ".join(key.removeprefix(OPTIONS) for key in keys[:MOST_NAMED])
    return f"the nearest run of {other} differs in {names}" + f" and {more} more" * (more > 0)


def _without_pairs(a: Side, b: Side, identities: Mapping[Path, Facts]) -> UserError:
    near = [(run, _nearest(run, b.runs, identities)) for run in a.runs]
    mine, theirs = min(near, key=lambda two: len(identities[two[0].path] ^ identities[two[1].path]))
    first, second = (dict(identities[run.path]) for run in (mine, theirs))
    keys = _differing(identities[mine.path], identities[theirs.path])
    texts = [
        f"{key.removeprefix(OPTIONS)} ({first.get(key, 'unset')[:40]}, "
        f"{second.get(key, 'unset')[:40]})"
        for key in keys[:MOST_NAMED]
    ]
    more = len(keys) - MOST_NAMED
    if more > 0:
        texts.append(f"{more} more")
    return UserError(
        f"no run of A ({a.name}, {len(a.runs)} finished) has a partner in B ({b.name}, "
        f"{len(b.runs)} finished): the nearest, {mine.record.run_id} and {theirs.record.run_id}, "
        f"differ in {' and '.join(texts)}; compare runs that agree in task, variant, base policy, "
        "seed, budget and evaluation"
    )
