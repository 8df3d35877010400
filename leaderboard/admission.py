"""Whether a record may join the leaderboard: the rules of docs/submit.md, an entry each.

A problem keeps a record out; a note does not. Both are one sentence. The rules find what cannot be
true. Numbers that are invented and agree with each other are found by making a run again.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from symsteer.errors import UserError, first_problem
from symsteer.leaderboard import catalogue
from symsteer.leaderboard.keys import Key, RowKey, row_key, seeds_of
from symsteer.leaderboard.known_agents import row_place
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import (
    DERIVED,
    HELD_OUT_SEED,
    Evaluation,
    RunRecord,
    canonical_json,
    file_hash,
    flat,
    portable,
    read_record,
    run_id_of,
    with_retired,
)
from symsteer.leaderboard.records.provenance import checkout, git
from symsteer.leaderboard.records.repeat import KEYS
from symsteer.leaderboard.records.retired import RETIRED_OF_RUNS
from symsteer.leaderboard.records.schema import Q_VALUES
from symsteer.leaderboard.records.values import Count, Sha256
from symsteer.leaderboard.rows import MIN_SEEDS
from symsteer.leaderboard.study import all_listed
from symsteer.variant import parse_variant, specs_at, variant_text

MIN_EPISODES = 100
"""Held-out episodes of a submitted record's final evaluation."""

SURPRISE, COPIED = 64, 0.9
"""Final returns that take so many bits to guess are copied, if another run has more of them."""

DRIFT = {"initial states": 1e-3, "successes of the base policy": 0.15}
"""By how much two records may differ, because processors round differently."""

MEND = "take the record as `symsteer run` wrote it, or run it again"

NEEDED = (*Q_VALUES, "q_magnitude", "q_overshoot")
"""Diagnostics that say whether Q diverged."""

RELEASE = re.compile(r"\d+(\.\d+)*((a|b|rc)\d+)?(\.post\d+)?")
"""Versions that a package index accepts and that are not of a development state."""

Positive = Annotated[Count, Field(gt=0, le=10**12)]


class Configuration(BaseModel):
    """What a record's configuration must have, so that the rest can be judged by it."""

    model_config = ConfigDict(strict=True, frozen=True)
    seed: Annotated[Count, Field(lt=2**32)]
    policy_seed: Annotated[Count, Field(lt=2**32)]
    env_steps: Positive
    num_envs: Annotated[Positive, Field(le=100_000)]
    device: Literal["cpu", "cuda"]
    sim: Literal["cpu", "cuda"]
    mode: str = Field(alias="demonstrations.mode", pattern="^(clean|diverse)$")
    evaluation_variant: str
    policy: str = Field(alias="policy.name")
    horizon: Positive = Field(alias="policy.horizon")
    execute: Positive = Field(alias="policy.execute")
    every: Positive = Field(alias="evaluation.every")
    episodes: Positive = Field(alias="evaluation.episodes")
    final_episodes: Positive = Field(alias="evaluation.final_episodes")
    states: Positive = Field(alias="evaluation.steerability_states")
    demonstrations: Sha256 = Field("", alias="files.demonstrations")
    weights: Sha256 = Field("", alias="files.policy")
    utd: float = Field(0.0, alias="agent_options.utd", ge=0)
    warmup: Count = Field(0, alias="agent_options.warmup")
    learning_starts: Count | None = Field(None, alias="agent_options.learning_starts")
    gamma: float = Field(0.0, alias="agent_options.gamma", ge=0, le=1)
    timeouts_terminal: bool = Field(False, alias="agent_options.timeouts_terminal")


class Judged:
    """A record, and what follows from its configuration; UserError or ValueError if it is none.

    `is_ours`: the agent is one of SymSteer's, and if it `learns`, has a critic. `limit`: steps of
    an episode. `step`: environment steps of a decision. `cost`: the most that a step may cost.
    """

    def __init__(self, file: Path, record: RunRecord, least: int):
        self.file, self.record, self.settings = file, record, record.settings
        self.least = least
        # Version 0.1 called the agent's options `sac`.
        options = "agent_options" if "agent_options" in record.config else "sac"
        if strange := record.config.keys() - KEYS - {*DERIVED, *RETIRED_OF_RUNS, options}:
            raise UserError(f"it has a key {min(strange)!r}")
        values = {re.sub("^sac", "agent_options", k): v for k, v in flat(record.config).items()}
        self.config = c = Configuration.model_validate(values)
        self.specs = parse_variant(self.settings.variant)
        self.processes = [record.provenance, *record.continued]
        self.extensions = [extension for part in self.processes for extension in part.extensions]
        self.is_ours = self.settings.agent in catalogue.AGENTS
        self.learns = self.is_ours and self.settings.agent not in catalogue.REFERENCES
        lengths = [n for evaluation in record.evaluations for n in evaluation.episodes.episode_len]
        self.limit = catalogue.TASKS.get(self.settings.task, max(lengths, default=1))
        self.step = c.num_envs * c.execute
        present = specs_at(self.specs, 1)
        costs = (catalogue.VARIANTS.get(s.name, 1e6) * float(np.max(s.strength)) for s in present)
        self.cost = 1 + sum(costs)
        self.known_world = all(spec.name in catalogue.VARIANTS for spec in self.specs)
        kept = [spec for spec in present if spec.name not in catalogue.TRAINING_ONLY]
        self.evaluated_in = variant_text(kept)
        self.seeds = {"run": c.seed, "policy": c.policy_seed, "first_held_out": HELD_OUT_SEED}
        self.seeds["demonstrations"] = self.settings.demonstrations.seed


@dataclass
class Admission:
    """Problems and notes of one record file."""

    path: Path
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def is_admissible(self) -> bool:
        return not self.problems


def check(paths: Iterable[Path], committed: Path) -> list[Admission]:
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
    verdicts, records, listed = [], {}, all_listed()
    for file in files:
        verdicts.append(verdict := Admission(file))
        try:
            records[file] = record = read_record(file)
        except UserError as error:
            verdict.problems.append(str(error))
            continue
        problems = *_problems(file, record, file_hash(file) in listed), *known.duplicates(record)
        verdict.problems += [*problems, *known.contradictions(record)]
        known.add(file, record)
    for verdict in verdicts:
        if judged := records.get(verdict.path):
            verdict.notes += [*known.notes(judged), *_code_from_elsewhere(judged)]
    return verdicts


def _problems(file: Path, record: RunRecord, is_listed: bool) -> Iterator[str]:
    """What breaks the rules about one record alone; those that a study lists may be shorter."""
    if file.name != f"{record.run_id}.json":
        yield f"the file must be named after its run: rename it to {record.run_id}.json"
    if record.status != "finished":
        yield (
            f"the run is {record.status}, not finished: continue it with `symsteer resume "
            "RUN_FOLDER` and take the record from there"
        )
        return
    try:
        judged = Judged(file, record, 0 if is_listed else MIN_EPISODES)
    except (ValidationError, ValueError, UserError) as error:
        yield (
            f"its configuration is none of `symsteer run` ({first_problem(error)}): take the "
            "record as it was written"
        )
        return
    broken = [("the run", rule, why) for rule, breaks in RULES.items() if (why := breaks(judged))]
    for rule, breaks in EVALUATION_RULES.items():
        whys = ((e.env_steps, breaks(judged, e)) for e in record.evaluations)
        broken += [(f"the evaluation at step {step}", rule, why) for step, why in whys if why][:1]
    for where, rule, why in broken:
        detail = "" if why is True else f" ({why})"
        yield f"{where}{detail} breaks the rule that {rule.partition(' | ')[0]}: {MEND}"


def _unknown_code(j: Judged) -> str:
    problems = []
    for number, process in enumerate(j.processes, 1):
        of = f"part {number}: " * (number > 1)
        released = process.sha256 is not None and RELEASE.fullmatch(process.version or "")
        if process.commit is None and not released:
            problems.append(
                f"{of}it names neither a commit nor a released version; use a git clone"
            )
        if process.commit is not None and process.dirty is not False:
            problems.append(
                f"{of}its code is not in commit {process.commit[:12]}; commit all files first"
            )
        problems += [
            f"{of}its {extension.kind} {extension.target} belongs to no installed distribution; "
            "install it as a package with an entry point"
            for extension in process.extensions
            if extension.distribution is None or extension.version is None
        ]
    return ", and ".join(problems)


def _unknown_name(j: Judged) -> str | None:
    names: list[tuple[str, str, Iterable[str]]] = [
        ("task", j.settings.task, catalogue.TASKS),
        ("embodiment", j.settings.embodiment, catalogue.EMBODIMENTS),
        ("agent", j.settings.agent, catalogue.AGENTS),
        ("policy", j.config.policy, catalogue.POLICIES),
        *(("variant", spec.name, catalogue.VARIANTS) for spec in j.specs),
    ]
    outside = {(extension.kind, extension.name) for extension in j.extensions}
    for kind, name, known in names:
        if (name in known) == ((kind, name) in outside):
            return f"the {kind} {name!r}"
    unused = outside - {(kind, name) for kind, name, _ in names}
    return f"no setting names the extension {min(unused)[1]!r}" if unused else None


def _role(j: Judged) -> bool:
    world = j.config.evaluation_variant, variant_text(j.specs)
    wanted = j.evaluated_in if j.known_world else world[0], j.settings.variant
    role = catalogue.AGENTS.get(j.settings.agent, j.record.role)
    return (role, *wanted) != (j.record.role, *world)


def _hash_of_nothing(j: Judged) -> str | None:
    hashes = [j.record.base_policy.content_hash, j.config.demonstrations, j.config.weights]
    hashes += [text or "" for part in j.processes for text in (part.commit, part.sha256)]
    hashes += [extension.sha256 for extension in j.extensions]
    return next((text for text in hashes if text and len(set(text)) < 9), None)


def _machine(j: Judged) -> bool:
    cpu = j.config.device == "cpu"
    return any(part.together > 100 or (part.device == "cpu") != cpu for part in j.processes)


def _machine_path(j: Judged) -> str | None:
    texts = _texts(json.loads(j.file.read_bytes()))
    return next((f"{text[:60]!r}" for text in texts if portable(text) != text), None)


def _budget(j: Judged) -> str | None:
    used, budget, record = j.record.budget.env_steps, j.config.env_steps, j.record
    evidence = not j.is_ours and (record.parameters.total > 0 or record.has_critic)
    learns = j.learns or record.role != "reference" or evidence
    needless = j.settings.agent in ("base", "zero") and used > 0
    wrong = (learns and used < budget) or used >= budget + j.step or needless
    return f"{used} environment steps of {budget}" if wrong else None


def _decision(j: Judged) -> bool:
    return 10 * j.step > j.config.env_steps or j.config.execute > min(j.config.horizon, j.limit)


def _sizes(j: Judged) -> bool:
    sizes, reference = j.record.parameters, j.is_ours and not j.learns
    return sizes.total != sizes.actor + sizes.critic or (reference and sizes.total > 0)


def _schedule(j: Judged) -> str | None:
    before = [evaluation.env_steps for evaluation in j.record.evaluations][:-1]
    if j.record.role == "reference":
        return "a reference has one" if j.is_ours and before else None
    if not before or (j.is_ours and before[0]):
        return "none before the first decision"
    for number, (was, at) in enumerate([*pairwise(before), (before[-1], None)], 1):
        # At the first whole decision that reaches the planned step, one evaluation a decision.
        due = max(number * j.config.every, was + 1)
        if at is not None and not due <= at < min(due + j.step, j.config.env_steps):
            return f"one at step {at} where {due} was due"
        if at is None and due + j.step <= j.config.env_steps:
            return f"none at step {due}"
    return None


def _bounds(j: Judged) -> bool:
    bounds, c = j.record.feasible_q, j.config
    if bounds is None or not (j.is_ours and j.known_world):
        return (bounds is None) == j.record.has_critic
    number = math.ceil(j.limit / c.execute) if c.timeouts_terminal else 10_000
    lowest = -j.cost * c.execute * sum(c.gamma**i for i in range(number))
    return bounds.high != 0 or not math.isclose(bounds.low, lowest, rel_tol=1e-4)


def _base(j: Judged) -> bool:
    base, states = j.record.base_policy, j.config.states
    if base.base_success is None or base.solvable is None or base.episodes != states * base.draws:
        return True
    successes, solved = base.base_success * base.episodes, base.solvable * states
    whole = all(abs(count - round(count)) < 1e-3 for count in (successes, solved))
    # A state that is solved has one success or more, at most one of each draw.
    possible = solved - 1e-3 <= successes <= solved * base.draws + 1e-3
    return base.name != j.config.policy or not (whole and possible)


def _clock(j: Judged) -> bool:
    clock, record = j.record.wall_clock, j.record
    parts = clock.simulate + clock.decode + clock.update + clock.evaluate + (clock.diagnose or 0)
    times = [evaluation.wall_clock for evaluation in record.evaluations]
    lasted = ((record.ended or record.started) - record.started).total_seconds()
    ordered = times == sorted(times) and max(parts, *times) <= clock.total + 1
    fast = record.budget.env_steps > 100_000 * clock.total or record.started > datetime.now(UTC)
    resumed = clock.resumed >= len(record.continued)
    return fast or not (ordered and resumed and (lasted + 2 >= clock.total or clock.resumed))


def _number(j: Judged, e: Evaluation) -> str | None:
    number, wanted = len(e.episodes.seed), j.config.final_episodes if e.final else j.config.episodes
    return f"{number} of them" if number != wanted or number < j.least * e.final else None


def _counts(j: Judged, e: Evaluation) -> bool:
    # A chunk is cut short where all environments end their episodes in it. Eight or more do so at
    # the time limit alone.
    number, execute = j.config.num_envs, j.config.execute
    shortest = j.limit / math.ceil(j.limit / execute) if number >= 8 else 1
    fits = shortest * e.decisions - 1e-6 <= e.env_steps <= execute * e.decisions
    return bool(e.decisions % number or e.env_steps % number or not fits)


def _updates(j: Judged, e: Evaluation) -> bool:
    c = j.config
    first = c.warmup if c.learning_starts is None else c.learning_starts
    # Whole updates are made, of a sum that is rounded.
    owed = max(0, e.decisions - first) * c.utd * j.learns
    return j.is_ours and not -1e-6 <= owed - e.updates < 2


def _returns(j: Judged, e: Evaluation) -> bool:
    once, end = np.array(e.episodes.success_once), np.array(e.episodes.success_at_end)
    value, length = np.array(e.episodes.return_, float), np.array(e.episodes.episode_len)
    least = np.where(once, 1 - length, -length) * j.cost
    fits = (value >= least - 0.01) & (value <= np.where(once, 0, -length))
    if j.cost == 1:
        # Whole steps; and a success in the very last one is a success at the end.
        fits &= (value % 1 == 0) & (end | ~once | (value > least))
    return not fits.all()


def _unmeasured(j: Judged, e: Evaluation) -> str | None:
    wanted = {*j.record.evaluations[0].diagnostics, *(NEEDED if j.learns else ())}
    there = {k for k, v in e.diagnostics.items() if v is not None or k not in NEEDED}
    there |= {flag.removeprefix("diagnostics/") for flag in e.nonfinite}
    return min(wanted - there, default=None)


def _q(j: Judged, e: Evaluation) -> str | None:
    values = {name: value for name, value in e.diagnostics.items() if value is not None}
    fits = {name: abs(v) < 1 + 1e-6 for name, v in values.items() if name.endswith("correlation")}
    fits |= {name: v >= 0 for name, v in values.items() if name.endswith(("_std", "td_error"))}
    shares = "overestimated", "violation", "saturated"
    fits |= {name: 0 <= v <= 1 for name, v in values.items() if name.endswith(shares)}
    if (bounds := j.record.feasible_q) and values.keys() >= set(NEEDED):
        mean, low, high, most, magnitude, overshoot = (values[name] for name in NEEDED)
        allowance, slack = values.get("q_allowance", 0.0), 1e-3 * max(1.0, most)
        bottom, top = bounds.low - allowance, bounds.high + allowance
        size, outside = max(-bottom, top) or 1, max(bottom - low, high - top)
        fits["q_mean"] = low - slack <= mean <= high + slack
        fits["q_abs_max"] = most >= max(-low, high) - slack
        fits["q_magnitude"] = math.isclose(magnitude, most / size, rel_tol=1e-3)
        fits["q_overshoot"] = outside - slack <= overshoot * (top - bottom) <= most + size
        means = [name for name in values if "bias" in name or name.startswith("return_")]
        fits |= {name: abs(values[name]) <= most + size + slack for name in means}
    return next((name for name, fit in fits.items() if not fit), None)


Check = Callable[..., object]

RULES: dict[str, Check] = {
    "its code can be looked up | everybody can read and run it": _unknown_code,
    "names are SymSteer's, or extensions' | a row is of its agent's code": _unknown_name,
    "its name is its configuration's | a record describes the run that it names": lambda j: (
        (wanted := run_id_of(j.record.config)) != j.record.run_id and f"it is that of {wanted}"
    ),
    "seeds are the configuration's | agents are compared on equal seeds": lambda j: (
        j.record.seeds != j.seeds
    ),
    "role and variant are its agent's and its evaluations' | all of a table do the same": _role,
    "hashes have many different digits | no file has a hash of zeros": _hash_of_nothing,
    "the device is the configuration's, runs in a process at most 100 | machines differ": _machine,
    "the whole budget is used, and not exceeded | all agents get the same": _budget,
    "a decision takes at most a tenth of the budget | long ones would hide steps": _decision,
    "evaluations are the configuration's | none is left out or chosen": _schedule,
    "feasible Q-values are the reward's | divergence is measured by them": _bounds,
    "the base policy's shares are its draws' | learners are compared with it": _base,
    "numbers of parameters add up | sizes are compared": _sizes,
    "times are in order and within the run | a run takes time": _clock,
    "no text holds a path of a machine | records are public": _machine_path,
}
"""What must be so of a record, why, and what is wrong: words, or True; else it is so."""

EVALUATION_RULES: dict[str, Check] = {
    "seeds are the held-out ones in order | the same initial states for everybody": lambda j, e: (
        e.episodes.seed != [HELD_OUT_SEED + i for i in range(len(e.episodes.seed))]
    ),
    "episodes are as many as configured, 100 at the end | none is left out": _number,
    "the final one counts what the run used | the last checkpoint counts": lambda j, e: (
        e.final and any(getattr(e, name) != used for name, used in j.record.budget)
    ),
    "so many decisions take so many steps | steps are counted as simulated": _counts,
    "so many decisions lead to so many updates | settings say how many": _updates,
    "episodes last to the time limit | success at the end is measured there": lambda j, e: (
        set(e.episodes.episode_len) != {j.limit}
    ),
    "returns are the reward's | a step costs 1, or what the variant says": _returns,
    "no diagnostic is left out | diverged runs must not hide": _unmeasured,
    "diagnostics agree with each other | they were measured": _q,
}
"""The same of each evaluation."""


class _Known:
    """The records that one record is compared with: the committed ones and those before it."""

    def __init__(self) -> None:
        self._runs: dict[tuple[RowKey, str, str], tuple[Path, RunRecord]] = {}
        self._finished: dict[Key, list[RunRecord]] = defaultdict(list)
        self._committed: dict[Key, list[RunRecord]] = defaultdict(list)
        self._facts: dict[tuple[str, ...], tuple[Path, list[float]]] = {}
        self._finals: dict[tuple[str, ...], dict[Path, list[float]]] = defaultdict(dict)

    def add(self, file: Path, record: RunRecord, committed: bool = False) -> None:
        table = Key.of(record)
        self._runs.setdefault(_identity(record), (file, record))
        self._committed[table] += [record] * committed
        if record.status != "finished":
            return
        self._finished[table].append(record)
        for fact, values in _facts(record).items():
            if values:
                self._facts.setdefault(fact, (file, values))
        if record.role != "reference":
            place, returns = _final_returns(record)
            self._finals[place][file] = returns

    def duplicates(self, record: RunRecord) -> Iterator[str]:
        twin = self._runs.get(_identity(record))
        if twin and twin[1] == record:
            yield f"it is a copy of {twin[0]}: remove one of the two"
        elif twin:
            yield (
                f"{twin[0]} holds the same configuration, seeds and base policy already: remove "
                "one of the two (to replace a committed record, say why in the pull request)"
            )
        elif file := self._copied(record):
            yield (
                f"its final episodes are nearly all those of {file}, more than chance explains: a "
                "copy, or a setting that changes nothing; keep one of the two"
            )

    def _copied(self, record: RunRecord) -> Path | None:
        """The learner's record whose final returns are the same in nearly all episodes."""
        place, mine = _final_returns(record)
        counts, others = Counter(mine), self._finals[place]
        bits = np.array([math.log2(len(mine) / counts[value]) for value in mine])
        if not others or bits.sum() < SURPRISE:
            return None
        shared = (np.array(list(others.values())) == np.array(mine)) @ bits / bits.sum()
        return next((f for f, s in zip(others, shared, strict=True) if s > COPIED), None)

    def contradictions(self, record: RunRecord) -> Iterator[str]:
        """What another record says differently, though it must be the same in both."""
        for fact, mine in _facts(record).items():
            file, theirs = self._facts.get(fact, (None, mine))
            largest = max((abs(a - b) for a, b in zip(mine, theirs, strict=False)), default=9)
            if theirs and largest > DRIFT.get(fact[0], 0):
                yield f"its {fact[0]} are not those of {file}: {MEND}"

    def notes(self, record: RunRecord) -> Iterator[str]:
        table, row = Key.of(record), row_key(record)
        finished, committed = self._finished[table], self._committed[table]
        seeds = {other.settings.seed for other in finished if row_key(other) == row}
        if record.role == "learner" and len(seeds) < MIN_SEEDS:
            yield (
                f"shown, not ranked: its row has {len(seeds)} of the {MIN_SEEDS} finished seeds "
                "that a ranking needs"
            )
        usual = sorted({other.settings.seed for other in committed})
        if usual and record.settings.seed not in usual:
            yield (
                f"its seed {record.settings.seed} is none of those of the committed runs of its "
                f"table ({', '.join(map(str, usual))}): agents are compared on equal seeds"
            )
        policy = record.base_policy.content_hash
        if committed and all(other.base_policy.content_hash != policy for other in committed):
            there = {r.settings.agent for r in finished if r.base_policy.content_hash == policy}
            references = {r.settings.agent for r in committed if r.role == "reference"}
            names = sorted(references - there, key=lambda name: row_place(name, "reference"))
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
    return row_key(record), seeds_of(record.config), record.base_policy.content_hash


def _facts(record: RunRecord) -> dict[tuple[str, ...], list[float]]:
    """Numbers of a finished record that others with the same settings must have as well."""
    s, base, sizes = record.settings, record.base_policy, record.parameters
    place = s.task, s.embodiment
    config = with_retired(record.config)
    options = config.get("agent_options", config.get("sac"))
    settings = canonical_json([options, config.get("policy")])
    directions = record.final.episodes.direction if record.final else None
    world = str(record.config.get("evaluation_variant"))
    networks: list[float] = [sizes.actor, sizes.critic, sizes.width or 0]
    return {
        ("sizes of networks", *place, s.agent, settings): networks,
        ("parameters of the base policy", base.content_hash): [base.parameters or 0],
        ("successes of the base policy", *place, base.content_hash): [base.base_success or 0],
        ("initial states", *place, world): [abs(angle or 0.0) for angle in directions or ()],
    }


def _final_returns(record: RunRecord) -> tuple[tuple[str, ...], list[float]]:
    """Where the final episodes were played, and their returns."""
    returns = record.final.episodes.return_ if record.final else []
    place = record.settings.task, record.settings.embodiment, str(len(returns))
    return place, [value or 0.0 for value in returns]


def _code_from_elsewhere(record: RunRecord) -> Iterator[str]:
    """Notes on code that is not in the repository."""
    parts = [record.provenance, *record.continued]
    for version, sha256 in dict.fromkeys((p.version, p.sha256) for p in parts if not p.commit):
        if sha256:
            yield f"it ran symsteer {version} as installed, not a checkout; sha256 {sha256[:12]}"
    extensions = [e for p in parts for e in p.extensions if e.distribution]
    used = {(e.kind, e.name, e.distribution, e.version, e.sha256[:12]) for e in extensions}
    here = {one.name: one.version for one in metadata.distributions()} if used else {}
    for kind, name, distribution, version, sha256 in sorted(used, key=str):
        known = "" if here.get(str(distribution)) == version else ", unresolved: not installed here"
        yield f"it uses the {kind} {name} of {distribution} {version}; sha256 {sha256}{known}"


def _texts(data: Any) -> Iterator[str]:
    """Every text in plain data, keys included."""
    if isinstance(data, str):
        yield data
    elif isinstance(data, dict | list):
        for value in [*data, *data.values()] if isinstance(data, dict) else data:
            yield from _texts(value)


@functools.cache
def _is_missing(commit: str) -> bool:
    """Whether this code runs from a whole git clone that does not have the commit."""
    root = checkout()
    if root is None or git(root, "rev-parse", "--is-shallow-repository") != "false":
        return False
    return git(root, "cat-file", "-e", f"{commit}^{{commit}}") is None
