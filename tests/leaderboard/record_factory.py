"""Builds run records for the tests of the leaderboard, from numbers that the tests choose."""

from __future__ import annotations

import copy
import hashlib
import itertools
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from symsteer.leaderboard.defects import Audit, AuditedDefect
from symsteer.leaderboard.records import (
    BasePolicy,
    Episodes,
    Evaluation,
    FeasibleQ,
    Parameters,
    Provenance,
    RunRecord,
    UsedBudget,
    WallClock,
)
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Summary
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import Findings, View
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.study import PAPER, read_study

START = datetime(2026, 1, 31, 12, 0, tzinfo=UTC)
LEARNING = ("standard", "standard-matched", "equivariant", "residual-pathway", "approximate")
REFERENCES = ("base", "zero", "golden-ticket")


GONE = object()


def put(data: Any, values: Mapping[str, Any]) -> Any:
    """Give what is at the places of plain data other values.

    Args:
        data: lists and dictionaries, which are changed.
        values: by place, such as ``evaluations/-1/final``, where ``*`` stands for every item;
            `GONE` removes what is there.
    """
    for place, value in values.items():
        *keys, last = (int(k) if k.lstrip("-").isdigit() else k for k in place.split("/"))
        inner = [data]
        for key in keys:
            inner = [each for one in inner for each in (one if key == "*" else [one[key]])]
        for one in inner:
            if value is GONE:
                del one[last]
                continue
            for key in range(len(one)) if last == "*" else [last]:
                one[key] = copy.deepcopy(value)
    return data


def edited(record: RunRecord, values: Mapping[str, Any] | None = None) -> RunRecord:
    """A copy of a record with other values at some places (`put`)."""
    data = record.model_dump(by_alias=True, exclude={"config_hash"})
    return RunRecord.model_validate(put(data, values or {}))


def make_config(**changes: Any) -> dict[str, Any]:
    config: dict[str, Any] = {
        "task": "PickCube-v1",
        "embodiment": "floating",
        "variant": "none",
        "agent": "standard",
        "seed": 0,
        "env_steps": 50_000,
        "demonstrations": {"mode": "diverse", "count": 50, "seed": 0},
        "learning_rate": 3e-4,
    }
    return config | changes


def make_evaluation(
    successes: Sequence[int],
    env_steps: int = 50_000,
    final: bool = True,
    first_seed: int = 10_000,
    **diagnostics: float | None,
) -> Evaluation:
    """An evaluation whose episode `first_seed + i` has success_once `successes[i]`."""
    number = len(successes)
    return Evaluation(
        env_steps=env_steps,
        decisions=env_steps // 8,
        updates=env_steps // 8,
        wall_clock=env_steps / 200,
        final=final,
        episodes=Episodes(
            **{
                "seed": np.arange(first_seed, first_seed + number),
                "success_once": np.asarray(successes, dtype=bool),
                "success_at_end": np.asarray(successes, dtype=bool),
                "return": -50.0 + 30.0 * np.asarray(successes, dtype=np.float32),
                "episode_len": np.full(number, 100),
            }
        ),
        diagnostics=diagnostics,
    )


def make_record(
    evaluations: Sequence[Evaluation] | None = None, status: str = "finished", **config: Any
) -> RunRecord:
    """A valid record; `config` overrides the configuration's keys."""
    config = make_config(**config)
    agent, seed = config["agent"], config["seed"]
    learns = agent in LEARNING
    if evaluations is None:
        evaluations = [make_evaluation([1, 0, 1, 0, 1])]
    if status != "finished":
        evaluations = [e.model_copy(update={"final": False}) for e in evaluations]
    budget = UsedBudget(env_steps=config["env_steps"], decisions=6_250, updates=6_250 * learns)
    if agent in ("base", "zero"):
        budget = UsedBudget(env_steps=0, decisions=0, updates=0)
    return RunRecord(
        run_id=re.sub(r"[^\w.=-]", "=", f"run-{config['variant']}-{agent}-{seed}", flags=re.ASCII),
        config=config,
        role="reference" if agent in REFERENCES else "learner",
        provenance=Provenance(
            commit="0123456789abcdef0123456789abcdef01234567",
            dirty=False,
            version="0.1.0",
            sha256=None,
            extensions=[],
            packages={"torch": "2.13.0", "mani-skill": "3.0.1"},
            python="3.11.7",
            platform="Linux x86_64",
            device="cpu",
            torch_threads=1,
        ),
        seeds={"run": seed, "evaluation": 10_000},
        started=START,
        ended=None if status == "running" else START + timedelta(seconds=250),
        status=status,
        failure="the simulator stopped" if status == "failed" else None,
        parameters=Parameters(
            actor=60_000 * learns, critic=90_000 * learns, total=150_000 * learns, width=128
        ),
        wall_clock=WallClock(
            simulate=100, decode=5, update=90, evaluate=30, diagnose=15, total=250
        ),
        budget=budget,
        base_policy=BasePolicy(
            name="edp",
            group="C8",
            content_hash=hashlib.sha256(b"base").hexdigest(),
            base_success=0.36,
            episodes=200,
            action_std=0.42,
            solvable=0.97,
            equivariance_error=2e-7,
            jump=0.03,
            training_seconds=61.0,
        ),
        feasible_q=FeasibleQ(low=-20.0, high=0.0),
        evaluations=list(evaluations),
    )


def make_curve(
    generator: np.random.Generator, rates: Sequence[float], q_shift: float = 0.0
) -> list[Evaluation]:
    """Evaluations at equal distances over the budget with the given success rates."""
    known = {"q_violation": 0.01, "td_error": 1.5, "return_std": 5.0, "alpha": 0.01}
    known |= {"orbit_variance": 0.04, "equivariance_actor": 0.31, "equivariance_critic": 0.12}
    for prefix in ("q_", "q_off_"):
        known |= {f"{prefix}bias": 0.6 + q_shift, f"{prefix}bias_std": 2.5}
        known |= {f"{prefix}correlation": 0.9, f"{prefix}rank_correlation": 0.8}
        known |= {f"{prefix}overestimated": 0.55}
    curve = []
    steps = np.linspace(0, 50_000, len(rates)).astype(int).tolist()
    for index, (step, rate) in enumerate(zip(steps, rates, strict=True)):
        q = -16 + 10 * rate + q_shift * index
        measured = {"q_mean": q, "q_min": q - 3, "q_max": q + 2, "q_abs_max": abs(q) + 4}
        measured |= {"q_magnitude": (abs(q) + 4) / 20, "return_mean": -16 + 10 * rate}
        measured["q_overshoot"] = max(0.0, q + 2, -20 - (q - 3)) / 20
        outcomes, final = generator.random(100) < rate, index == len(rates) - 1
        curve.append(make_evaluation(outcomes, step, final, **(known | measured)))
    return curve


def make_cell(
    rates: Mapping[str, float | Sequence[float]], seeds: int = 5, episodes: int = 40, **config: Any
) -> list[RunRecord]:
    """Runs of several agents in one cell, evaluated at even distances with the given success rates.

    Exactly `round(rate * episodes)` episodes succeed, other ones for every run, so that sums are
    known while pairs differ. References (base, zero, golden-ticket) are evaluated once.
    """
    records = []
    for index, (agent, rate) in enumerate(rates.items()):
        curve = [rate] * 3 if isinstance(rate, float | int) else list(rate)
        for seed in range(seeds):
            generator = np.random.default_rng((index, seed))
            steps = np.linspace(0, config.get("env_steps", 50_000), len(curve)).astype(int).tolist()
            points, q = list(zip(curve, steps, strict=True)), {"q_mean": -5.0, "q_magnitude": 0.5}
            if agent in REFERENCES:
                points, q = [(curve[-1], 0)], {}
            evaluations = []
            for share, step in points:
                outcomes = (generator.permutation(episodes) < round(share * episodes)).astype(int)
                final = step == points[-1][1]
                evaluations.append(make_evaluation(outcomes.tolist(), step, final, **q))
            records.append(make_record(evaluations, agent=agent, seed=seed, **config))
    return records


def diverging(
    agent: str, seeds: Sequence[int], status: str = "finished", **config: Any
) -> list[RunRecord]:
    """Five runs of which `seeds` diverge."""
    records = []
    for seed in range(5):
        q = {"q_mean": -5.0, "q_magnitude": 1.5 if seed in seeds else 0.5}
        curve = [make_evaluation([1, 0], 10_000 * (i + 1), i == 4, **q) for i in range(5)]
        broke = seed in seeds and status != "finished"
        run_status = status if broke else "finished"
        records.append(make_record(curve, run_status, agent=agent, seed=seed, **config))
    return records


def steered(
    rates: Mapping[str, tuple[float, float, float]], policies: int = 5, **config: Any
) -> list[RunRecord]:
    """One cell for each variant, from (standard, equivariant, approximate); a policy per seed."""
    agents = ("standard", "equivariant", "approximate")
    records = [
        record
        for variant, values in rates.items()
        for record in make_cell(dict(zip(agents, values, strict=True)), variant=variant, **config)
    ]
    return with_policies(records, policies)


def with_policies(records: list[RunRecord], policies: int = 5) -> list[RunRecord]:
    """The same records, with a base policy of the task's for each seed."""
    for record in records:
        which = f"{record.settings.task} {record.settings.seed % policies}"
        record.base_policy.content_hash = hashlib.sha256(which.encode()).hexdigest()
    return records


def audit_of(
    defects: Mapping[str, float],
    width: float = 0.0,
    task: str = "PickCube-v1",
    embodiment: str = "floating",
) -> Audit:
    """Audited defects by variant, with intervals of a width to each side."""
    return {
        (task, embodiment, variant, "C8"): AuditedDefect(
            Interval(value, value - width, value + width), "tool"
        )
        for variant, value in defects.items()
    }


def summary_of(*groups: Sequence[RunRecord]) -> Summary:
    records = [record for group in groups for record in group]
    return summarize([Run(Path(f"{i}.json"), record) for i, record in enumerate(records)])


def view_of(*groups: Sequence[RunRecord], audit: Audit | None = None, study: str = PAPER) -> View:
    """What the page shows of records, without figures and links."""
    return View(Findings(summary_of(*groups), audit or {}, read_study(study)))


def page_of(records: Sequence[RunRecord], study: str = PAPER) -> str:
    """The page without figures and links, with ordinary spaces."""
    from symsteer.leaderboard.page import render_page  # slow: it imports matplotlib

    return render_page(view_of(records, study=study)).replace("\u00a0", " ")


def table_after(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table after a line that starts with `heading`."""
    lines = text[text.index(f"\n{heading}") :].splitlines()
    start = next(i for i, line in enumerate(lines) if line.startswith("|"))
    rows = itertools.takewhile(lambda line: line.startswith("|"), lines[start:])
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """The content of every file of a folder; None for folders."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
