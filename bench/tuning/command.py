"""``symsteer tune``: rounds of trials for all agents, then the chosen settings on fresh cells."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from optuna.trial import Trial, TrialState

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import run_id, write_json
from symsteer.bench.sweep.command import run_plan
from symsteer.bench.sweep.plan import make_plan
from symsteer.bench.sweep.suite import Suite
from symsteer.bench.sweep.workforce import THIS_MACHINE, Workforce
from symsteer.bench.tuning.plan import TuningPlan
from symsteer.bench.tuning.search import Search, open_storage
from symsteer.bench.tuning.trials import (
    START,
    Chosen,
    Score,
    Setting,
    TrialResult,
    best_single,
    read_scores,
    score_of,
    to_json,
    to_preset,
)
from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.terminal import to_paste

Key = TypeVar("Key")


class Tuner:
    """Executes a tuning plan, and continues it where it was stopped.

    Args:
        plan: what to tune.
        out: folder of the runs; the trials are in ``out/tuning``.
        workforce: who executes the runs.

    Raises:
        UserError: if ``out`` holds trials of a plan that differs.
    """

    def __init__(self, plan: TuningPlan, out: Path, workforce: Workforce = THIS_MACHINE):
        self.plan, self.out, self.workforce = plan, out, workforce
        storage = open_storage(self.places["journal"])
        self.searches = {agent: Search(plan, agent, storage) for agent in plan.agents}
        # The folders of finished runs may be deleted.
        self._known = read_scores(self.places["scores"])

    def play(self) -> tuple[list[TrialResult], list[Chosen]]:
        """Execute all that is left: trials, single options, comparison on fresh cells."""
        plan = self.plan
        self._rounds(plan.trials)
        for agent, search in self.searches.items():
            search.enqueue(plan.later(agent), plan.trials, len(plan.further))
        self._rounds(plan.listed)
        self._exchange()
        self._rounds(plan.total)
        chosen = [choice for search in self.searches.values() if (choice := search.best)]
        # Fresh cells take long: trials and choice are there if the comparison is stopped.
        self._write(chosen)
        chosen = self._confirm(self._try_singles(chosen))
        self._write(chosen)
        return self.results, chosen

    @property
    def results(self) -> list[TrialResult]:
        """All trials that have ended, by agent and number."""
        return [result for search in self.searches.values() for result in search.results]

    @property
    def places(self) -> dict[str, Path]:
        """The files that tuning writes."""
        folder, name = self.out / "tuning", self.plan.name
        return {
            "trials": folder / f"{name}.json",
            "preset": folder / f"{name}-preset.toml",
            "scores": folder / f"{name}-scores.json",
            "journal": folder / f"{name}.journal",
        }

    def _rounds(self, last: int) -> None:
        """Execute rounds until every agent has so many trials."""
        searches = self.searches.values()
        while batch := [(search, trial) for search in searches for trial in search.batch(last)]:
            self._round(batch)
            self._write([])

    def _exchange(self) -> None:
        """Let every agent try the settings of the others, with its best own options."""
        best = {agent: s.best.options for agent, s in self.searches.items() if s.best}
        for agent, mine in best.items():
            settings = [
                {**mine, **{key: value for key, value in options.items() if key in mine}}
                for other, options in best.items()
                if other != agent
            ]
            self.searches[agent].enqueue(settings, self.plan.listed, self.plan.exchange)

    def _round(self, batch: Sequence[tuple[Search, Trial]]) -> None:
        """Execute trials: first a few cells of each, then the others of those that are good."""
        probe = self.plan.probe
        cells = {one: self.plan.cells(one[0].agent, one[1].params) for one in batch}
        kept = {}
        probed = self._scores({one: configs[:probe] for one, configs in cells.items()})
        for (search, trial), scores in probed.items():
            if len(scores) < probe:
                search.end(trial, TrialState.FAIL, scores)
            elif search.gives_up(trial, scores):
                search.end(trial, TrialState.PRUNED, scores)
            else:
                kept[search, trial] = cells[search, trial]
        for (search, trial), scores in self._scores(kept).items():
            done = len(scores) == len(kept[search, trial])
            search.end(trial, TrialState.COMPLETE if done else TrialState.FAIL, scores)

    def _scores(self, cells: Mapping[Key, Sequence[RunConfig]]) -> dict[Key, list[Score]]:
        """Execute runs that have no score yet; the scores of each group of runs.

        A run that fails is the fault of its options: it is shown, and has no score.

        Raises:
            UserError: if another process works on a run; its trial is not lost.
        """
        configs = dict.fromkeys(config for group in cells.values() for config in group)
        runs = tuple(config for config in configs if not self._score(config))
        if runs:
            suite = Suite(f"tune-{self.plan.name}", self.plan.description, runs)
            plan = make_plan(suite, self.out, self.workforce.ray is not None)
            for end in run_plan(plan, self.workforce):
                if end.status == "elsewhere":
                    raise UserError(
                        f"another process works on {end.run.label}; start the search again when it "
                        "has ended"
                    )
                if end.status == "failed":
                    print(f"failed: {end.run.label}: {end.reason}", file=sys.stderr)
            for config in runs:
                self._score(config)
            scores = {name: vars(score) for name, score in self._known.items()}
            write_json(self.places["scores"], scores)
        return {
            key: [score for one in group if (score := self._score(one))]
            for key, group in cells.items()
        }

    def _score(self, config: RunConfig) -> Score | None:
        name = run_id(config, {})
        if name not in self._known and (score := score_of(config, self.out)):
            self._known[name] = score
        return self._known.get(name)

    def _try_singles(self, chosen: Sequence[Chosen]) -> list[Chosen]:
        """The same choices with scores of the first trial with one of their options."""
        cells = {
            (choice.agent, name): self.plan.cells(choice.agent, {**first, name: value})
            for choice in chosen
            if choice.agent in self.plan.singles
            for first in [self.plan.first(choice.agent)]
            for name, value in choice.options.items()
            if value != first[name]
        }
        scores = self._scores(cells)
        return [
            replace(
                choice,
                # An option with which a run fails is left out.
                singles={
                    name: scores[agent, name]
                    for agent, name in cells
                    if agent == choice.agent and len(scores[agent, name]) == len(cells[agent, name])
                },
            )
            for choice in chosen
        ]

    def _confirm(self, chosen: Sequence[Chosen]) -> list[Chosen]:
        """The same choices with scores on the fresh cells."""
        cells = {
            (choice.agent, setting): configs
            for choice in chosen
            for setting, configs in self._fresh_cells(choice).items()
        }
        scores = self._scores(cells)
        return [
            replace(choice, fresh={s: scores[a, s] for a, s in cells if a == choice.agent})
            for choice in chosen
        ]

    def _fresh_cells(self, chosen: Chosen) -> dict[Setting, list[RunConfig]]:
        """The runs of every setting on the fresh cells."""
        agent, first = chosen.agent, self.plan.first(chosen.agent)
        trials = {result.number: result for result in self.searches[agent].results}
        settings: dict[Setting, Mapping[str, Any]] = {"start": first, "chosen": chosen.options}
        if agent in self.plan.singles:
            name = best_single(chosen, trials[START].scores)
            settings["one_option"] = {**first, name: chosen.options[name]} if name else first
        cells = {
            name: self.plan.cells(agent, options, "confirm") for name, options in settings.items()
        }
        cells["by_task"] = [
            config
            for task, number in chosen.by_task.items()
            for config in self.plan.cells(agent, trials[number].options, "confirm")
            if config.task == task
        ]
        return cells

    def _write(self, chosen: Sequence[Chosen]) -> None:
        plan = self.plan
        data = plan.model_dump(exclude_unset=True)
        about = {"plan": plan.name, "digest": plan.digest, "data": data}
        write_json(self.places["trials"], {**about, **to_json(self.results, chosen)})
        if chosen:
            command = to_paste("symsteer", "tune", plan.name)
            words = f"Chosen by `{command}`, {plan.total} trials an agent."
            write_atomically(self.places["preset"], to_preset(chosen, words).encode())


def preview(plan: TuningPlan) -> str:
    """What a plan asks for."""
    agent = plan.agents[0]
    cells, fresh = (len(plan.cells(agent, plan.first(agent), grid)) for grid in ("grid", "confirm"))
    lines = [f"{plan.name}: {plan.description}" if plan.description else plan.name, ""]
    lines += [
        f"{agent}: {plan.total} trials of {len(space)} options: {', '.join(space)}"
        for agent, space in plan.spaces.items()
    ]
    runs = sum(
        plan.total * cells + 3 * fresh + (agent in plan.singles) * (len(space) * cells + fresh)
        for agent, space in plan.spaces.items()
    )
    lines += [
        "",
        f"{cells} runs a trial, {plan.probe} of a trial that is given up; then {fresh} runs each "
        "with the first trial's options, the chosen settings, and those chosen for each task",
    ]
    if plan.singles:
        lines.append(f"options by themselves, {cells} runs each: {', '.join(plan.singles)}")
    return "\n".join([*lines, f"at most {runs:,} runs"])
