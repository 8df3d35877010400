"""Whether a record may join the leaderboard: every rule of docs/submit.md, one function each.

A problem keeps a record out; a note does not. Both are one sentence.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from symsteer.errors import UserError
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import (
    HELD_OUT_SEED,
    Provenance,
    RunRecord,
    canonical_json,
    portable,
    read_record,
)
from symsteer.leaderboard.records.provenance import checkout, git
from symsteer.leaderboard.summary import MIN_SEEDS, Key, recipe_of, row_place, seeds_of
from symsteer.variant import file_name

MIN_EPISODES = 100
"""Held-out episodes of an admissible record's final evaluation."""

RELEASE = re.compile(r"\d+(\.\d+)*((a|b|rc)\d+)?(\.post\d+)?")
"""Versions that a package index accepts and that are not of a development state."""

RowKey = tuple[Key, str, str]
"""Table, agent, recipe: what the runs of one row have in common."""


@dataclass
class Verdict:
    """Problems and notes of one record file."""

    path: Path
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def is_admissible(self) -> bool:
        return not self.problems


def check(paths: Iterable[Path], committed: Path) -> list[Verdict]:
    """Judge the records that `paths` name, among those in the folder `committed`.

    Args:
        paths: files or folders, as in `record_files`; they may lie in `committed` themselves.
        committed: the folder of the committed records; none are known if it does not exist.

    Raises:
        UserError: for a path that cannot be read, or a damaged record among the committed ones.
    """
    files = record_files(paths)
    known = _Known()
    if committed.is_dir() and any(committed.rglob("*.json")):
        for file in record_files([committed]):
            if file not in files:
                known.add(file, read_record(file), committed=True)
    verdicts, records = [], {}
    for file in files:
        verdicts.append(verdict := Verdict(file))
        try:
            records[file] = record = read_record(file)
        except UserError as error:
            verdict.problems.append(str(error))
            continue
        for rule in RULES:
            verdict.problems += rule(file, record)
        verdict.problems += known.duplicates(record)
        known.add(file, record)
    for verdict in verdicts:
        if judged := records.get(verdict.path):
            verdict.notes += [*known.notes(judged), *_code_from_elsewhere(judged)]
    return verdicts


# The rules that look at one record alone: (file, record) -> problems.


def named_after_its_run(file: Path, record: RunRecord) -> Iterator[str]:
    """The file is called RUN_ID.json."""
    if file.name != f"{record.run_id}.json":
        yield f"the file must be named after its run: rename it to {record.run_id}.json"


def finished(file: Path, record: RunRecord) -> Iterator[str]:
    """The run came to its end."""
    if record.status != "finished":
        yield (
            f"the run is {record.status}, not finished: continue it with `symsteer resume "
            "RUN_FOLDER` and take the record from there"
        )


def reproducible(file: Path, record: RunRecord) -> Iterator[str]:
    """Others can look up all code that the parts of the run used.

    That is a commit without local changes or a released version of SymSteer, and extensions from
    installed distributions.
    """
    parts = [("", record.provenance)]
    parts += [(f"part {n} of ", p) for n, p in enumerate(record.continued, 2)]
    for part, provenance in parts:
        if provenance.commit is None:
            if not _is_released(provenance):
                yield (
                    f"{part}the run names neither a commit nor a released version, so nobody knows "
                    "its code: run it again in a git clone of the repository"
                )
        elif provenance.dirty is not False:
            yield (
                f"{part}the run used code that is not in commit {provenance.commit[:12]}: "
                "commit all changes and new files, then run it again"
            )
        for extension in provenance.extensions:
            if extension.distribution is None or extension.version is None:
                yield (
                    f"{part}the run used the {extension.kind} {extension.target}, which belongs to "
                    "no installed distribution: install it as a package with an entry point, or "
                    "add it to the repository, then run it again"
                )


def scored_on_held_out_episodes(file: Path, record: RunRecord) -> Iterator[str]:
    """Evaluations use the first of the held-out seeds, the final one at least 100."""
    for evaluation in record.evaluations:
        seeds = evaluation.episodes.seed
        if seeds != list(range(HELD_OUT_SEED, HELD_OUT_SEED + len(seeds))):
            yield (
                f"the evaluation at step {evaluation.env_steps} is not on the held-out seeds "
                f"{HELD_OUT_SEED}, {HELD_OUT_SEED + 1}, ... in order: evaluate with `symsteer run`"
            )
            break
    if record.final and len(record.final.episodes.seed) < MIN_EPISODES:
        yield (
            f"the final evaluation has {len(record.final.episodes.seed)} episodes, fewer than "
            f"{MIN_EPISODES}: run it again with --evaluation.final-episodes {MIN_EPISODES}"
        )


def consistent(file: Path, record: RunRecord) -> Iterator[str]:
    """Name and seeds of the run are those of its configuration."""
    settings, seed = record.settings, record.settings.seed
    keys = (settings.task, settings.embodiment, settings.variant, settings.agent, f"s{seed}")
    named = file_name("-".join(keys))
    if not file_name(record.run_id).startswith(f"{named}-"):
        yield (
            f"the run is named {record.run_id}, but its configuration is that of {named}: take the "
            "record as `symsteer run` wrote it"
        )
    elif record.seeds.get("run") != seed:
        yield (
            f"the run drew from seed {record.seeds.get('run')}, but its configuration says "
            f"{seed}: take the record as `symsteer run` wrote it"
        )


def budget_used_up(file: Path, record: RunRecord) -> Iterator[str]:
    """A learner was scored at the end of its budget, a reference after what it searched."""
    final, budget = record.final, record.settings.env_steps
    if final is None:
        return
    if final.env_steps != record.budget.env_steps:
        yield (
            f"the final evaluation stands at step {final.env_steps}, but the run used "
            f"{record.budget.env_steps}: run it again"
        )
    elif final.env_steps >= budget + _steps_of_a_decision(record):
        yield (
            f"the run used {final.env_steps} environment steps, more than the {budget} of its "
            "budget: run it again"
        )
    elif _learns(record) and final.env_steps < budget:
        yield (
            f"the run ended after {final.env_steps} of the {budget} environment steps of its "
            "budget: run it again to the end, or with --env-steps as large as what it uses"
        )


def names_no_machine(file: Path, record: RunRecord) -> Iterator[str]:
    """No text of the file holds an absolute path."""
    for text in _texts(json.loads(file.read_bytes())):
        if portable(text) != text:
            yield (
                f"the text {text[:60]!r} holds a path of the machine: leave it out where the run "
                "is configured, and run it again"
            )
            return


RULES: tuple[Callable[[Path, RunRecord], Iterator[str]], ...] = (
    named_after_its_run,
    finished,
    reproducible,
    consistent,
    scored_on_held_out_episodes,
    budget_used_up,
    names_no_machine,
)


class _Known:
    """The records that one record is compared with: the committed ones and those before it."""

    def __init__(self) -> None:
        self._runs: dict[tuple[RowKey, str, str], tuple[Path, RunRecord]] = {}
        self._outcomes: dict[str, Path] = {}
        self._seeds: dict[RowKey, set[int]] = defaultdict(set)
        self._committed: dict[Key, set[str]] = defaultdict(set)
        self._committed_seeds: dict[Key, set[int]] = defaultdict(set)
        self._references: dict[Key, set[str]] = defaultdict(set)
        self._agents: dict[tuple[Key, str], set[str]] = defaultdict(set)

    def add(self, file: Path, record: RunRecord, committed: bool = False) -> None:
        row = _row(record)
        self._runs.setdefault(_identity(record), (file, record))
        if outcome := _outcome(record):
            self._outcomes.setdefault(outcome, file)
        if committed:
            if record.role == "reference":
                self._references[row[0]].add(record.settings.agent)
            self._committed[row[0]].add(record.base_policy.content_hash)
            self._committed_seeds[row[0]].add(record.settings.seed)
        if record.status == "finished":
            self._seeds[row].add(record.settings.seed)
            policy = record.base_policy.content_hash
            self._agents[row[0], policy].add(record.settings.agent)

    def duplicates(self, record: RunRecord) -> Iterator[str]:
        twin = self._runs.get(_identity(record))
        outcome = _outcome(record)
        if twin and twin[1] == record:
            yield f"it is a copy of {twin[0]}: remove one of the two"
        elif twin:
            yield (
                f"{twin[0]} holds the same configuration, seeds and base policy already: remove "
                "one of the two (to replace a committed record, say why in the pull request)"
            )
        elif outcome in self._outcomes:
            yield (
                f"its evaluations equal those of {self._outcomes[outcome]} to the last digit: a "
                "copy, or a setting that changes nothing; keep one of the two"
            )

    def notes(self, record: RunRecord) -> Iterator[str]:
        row = _row(record)
        number = len(self._seeds[row])
        if record.role == "learner" and number < MIN_SEEDS:
            yield (
                f"shown, not ranked: its row has {number} of the {MIN_SEEDS} finished seeds that a "
                "ranking needs"
            )
        usual, seed = self._committed_seeds[row[0]], record.settings.seed
        if usual and seed not in usual:
            yield (
                f"its seed {seed} is none of those of the committed runs of its table "
                f"({', '.join(map(str, sorted(usual)))}): agents are compared on equal seeds"
            )
        policy, committed = record.base_policy.content_hash, self._committed[row[0]]
        if committed and policy not in committed:
            lacking = self._references[row[0]] - self._agents[row[0], policy]
            names = sorted(lacking, key=lambda name: row_place(name, "reference"))
            wanted = f"; submit {', '.join(names)} on it as well" if names else ""
            yield (
                f"its base policy {policy[:12]} is not that of the committed runs of its table: it "
                f"is compared only with runs on the same policy{wanted}"
            )
        commit = record.provenance.commit
        if commit is not None and _is_missing(commit):
            yield (
                f"its commit {commit[:12]} is not in this clone: push it with the pull request, so "
                "that others can run the same code"
            )


def _identity(record: RunRecord) -> tuple[RowKey, str, str]:
    """What two runs may not share. A base policy trained elsewhere is another one."""
    return _row(record), seeds_of(record.config), record.base_policy.content_hash


def _row(record: RunRecord) -> RowKey:
    return Key.of(record), record.settings.agent, recipe_of(record.config)


def _code_from_elsewhere(record: RunRecord) -> Iterator[str]:
    """Notes on code that is not in the repository."""
    parts = [record.provenance, *record.continued]
    for version, sha256 in dict.fromkeys((p.version, p.sha256) for p in parts if not p.commit):
        if sha256:
            yield f"it ran symsteer {version} as installed, not a checkout; sha256 {sha256[:12]}"
    extensions = [e for p in parts for e in p.extensions if e.distribution]
    used = {(e.kind, e.name, e.distribution, e.version, e.sha256[:12]) for e in extensions}
    for kind, name, distribution, version, sha256 in sorted(used, key=str):
        yield f"it uses the {kind} {name} of {distribution} {version}; sha256 {sha256}"


def _is_released(provenance: Provenance) -> bool:
    version, sha256 = provenance.version, provenance.sha256
    return sha256 is not None and version is not None and RELEASE.fullmatch(version) is not None


def _learns(record: RunRecord) -> bool:
    evidence = record.parameters.total > 0 or record.budget.updates > 0 or record.has_critic
    return record.role == "learner" or evidence


def _steps_of_a_decision(record: RunRecord) -> int:
    """Environment steps of one decision in all environments; a run ends with a complete one."""
    policy = record.config.get("policy")
    factors = (
        record.config.get("num_envs"),
        policy.get("execute") if isinstance(policy, dict) else None,
    )
    return math.prod(factor for factor in factors if type(factor) is int and factor > 0)


def _outcome(record: RunRecord) -> str | None:
    """A hash of all that a learner's evaluations measured; None where chance alone could agree."""
    if not record.has_critic:
        return None
    data = [evaluation.model_dump(mode="json") for evaluation in record.evaluations]
    measured = [[evaluation["episodes"], evaluation["diagnostics"]] for evaluation in data]
    return hashlib.sha256(canonical_json(measured).encode()).hexdigest()


def _texts(data: Any) -> Iterator[str]:
    """Every text in plain data, keys included."""
    if isinstance(data, str):
        yield data
    elif isinstance(data, dict):
        for key, value in data.items():
            yield key
            yield from _texts(value)
    elif isinstance(data, list):
        for value in data:
            yield from _texts(value)


@functools.cache
def _is_missing(commit: str) -> bool:
    """Whether this code runs from a whole git clone that does not have the commit."""
    root = checkout()
    if root is None or git(root, "rev-parse", "--is-shallow-repository") != "false":
        return False
    return git(root, "cat-file", "-e", f"{commit}^{{commit}}") is None
