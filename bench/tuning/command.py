"""``symsteer tune``: rounds of trials for all agents, then the chosen settings on fresh cells."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from optuna.trial import FrozenTrial, Trial, TrialState

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import run_id, write_json
from symsteer.bench.sweep.command import run_plan
from symsteer.bench.sweep.plan import make_plan
from symsteer.bench.sweep.suite import Suite
from symsteer.bench.tuning.plan import TuningPlan
from symsteer.bench.tuning.search import Search, open_storage, storage_path
from symsteer.bench.tuning.trials import (
    START,
    Chosen,
    Score,
    Setting,
    State,
    TrialResult,
    best_single,
    choose,
    mean_auc,
    read_scores,
    score_of,
    to_json,
    to_preset,
)
from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.terminal import to_paste

STATES: Mapping[TrialState, State] = {
    TrialState.COMPLETE: "complete",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
}


class Tuner:
    """Executes a tuning plan, and continues it where it was stopped.

    Args:
        plan: what to tune.
        out: folder of the runs; the trials are in ``out/tuning``.
        workers: number of runs at the same time; 0: one per core, or as many as fit on the cluster.
        ray: address of a Ray cluster to use instead of this machine.
        together: learners that share a process, if they differ in seeds and variants alone.

    Raises:
        UserError: if ``out`` holds trials of a plan that differs.
    """

    def __init__(
        self,
        plan: TuningPlan,
        out: Path,
        workers: int = 0,
        ray: str | None = None,
        together: int = 1,
    ):
        self.plan, self.out = plan, out
        self.workers, self.ray, self.together = workers, ray, together
        self._known = read_scores(self.places["scores"])
        storage = open_storage(storage_path(out, plan.name))
        self.searches = {agent: Search(plan, agent, storage) for agent in plan.agents}

    def play(self) -> tuple[list[TrialResult], list[Chosen]]:
        """Execute all that is left: trials, single options, comparison on fresh cells."""
        plan = self.plan
        self._rounds(plan.trials)
        for agent, search in self.searches.items():
            search.enqueue(plan.further(agent), plan.trials, plan.listed - plan.trials)
        self._rounds(plan.listed)
        self._exchange()
        self._rounds(plan.listed + plan.exchange)
        chosen = [found for a in plan.agents if (found := self._best(a))]
        # Fresh cells take long: trials and choice are there if the comparison is stopped.
        self._write(chosen)
        chosen = self._confirm(self._try_singles(chosen))
        self._write(chosen)
        return self.results, chosen

    @property
    def results(self) -> list[TrialResult]:
        """All trials that have ended, by agent and number."""
        return [
            _result(agent, trial)
            for agent, search in self.searches.items()
            for trial in search.ended
        ]

    @property
    def places(self) -> dict[str, Path]:
        """The files that tuning writes."""
        folder, name = self.out / "tuning", self.plan.name
        return {
            "trials": folder / f"{name}.json",
            "preset": folder / f"{name}-preset.toml",
            "scores": folder / f"{name}-scores.json",
            "journal": storage_path(self.out, name),
        }

    def _rounds(self, last: int) -> None:
        """Execute rounds until every agent has so many trials."""
        searches = self.searches.items()
        while batch := [(a, trial) for a, s in searches for trial in s.batch(last)]:
            self._round(batch)
            self._write([])

    def _exchange(self) -> None:
        """Let every agent try the settings of the others, with its best own options."""
        best = {
            agent: choice.options for agent in self.plan.agents if (choice := self._best(agent))
        }
        for agent, own in best.items():
            others = [options for other, options in best.items() if other != agent]
            shared = [{k: v for k, v in options.items() if k in own} for options in others]
            settings = [{**own, **options} for options in shared]
            self.searches[agent].enqueue(settings, self.plan.listed, self.plan.exchange)

    def _round(self, batch: Sequence[tuple[str, Trial]]) -> None:
        """Execute trials: first a few cells of each, then the others of those that are good."""
        cells = [self.plan.cells(agent, trial.params) for agent, trial in batch]
        probe = self.plan.probe
        self._run([config for configs in cells for config in configs[:probe]])
        kept = []
        for (agent, trial), configs in zip(batch, cells, strict=True):
            scores = self._scores(configs[:probe])
            if len(scores) < probe:
                self._end(agent, trial, TrialState.FAIL, scores)
                continue
            if not self.searches[agent].study.trials[trial.number].intermediate_values:
                trial.report(mean_auc(scores), probe)
            if trial.should_prune():
                self._end(agent, trial, TrialState.PRUNED, scores)
            else:
                kept.append((agent, trial, configs))
        self._run([config for _, _, configs in kept for config in configs[probe:]])
        for agent, trial, configs in kept:
            scores = self._scores(configs)
            done = len(scores) == len(configs)
            self._end(agent, trial, TrialState.COMPLETE if done else TrialState.FAIL, scores)

    def _run(self, configs: Sequence[RunConfig]) -> None:
        """Execute runs; a run that fails is the fault of its options, and only shown.

        Raises:
            UserError: if another process works on a run; its trial is not lost.
        """
        runs = tuple(run for run in dict.fromkeys(configs) if not self._score(run))
        if not runs:
            return
        suite = Suite(f"tune-{self.plan.name}", self.plan.description, runs)
        plan = make_plan(suite, self.out, self.ray is not None)
        outcomes = run_plan(plan, self.workers, self.ray, self.together)
        for outcome in outcomes:
            if outcome.status == "elsewhere":
                raise UserError(
                    f"another process works on {outcome.run.label}; start the search again when it "
                    "has ended"
                )
            if outcome.status == "failed":
                print(f"failed: {outcome.run.label}: {outcome.reason}", file=sys.stderr)
        self._scores(runs)
        scores = {name: vars(score) for name, score in self._known.items()}
        write_json(self.places["scores"], scores)

    def _score(self, config: RunConfig) -> Score | None:
        """The score of a run, which is kept: the folders of finished runs may be deleted."""
        name = run_id(config, {})
        if name not in self._known and (score := score_of(config, self.out)):
            self._known[name] = score
        return self._known.get(name)

    def _scores(self, configs: Sequence[RunConfig]) -> list[Score]:
        return [score for config in configs if (score := self._score(config))]

    def _end(self, agent: str, trial: Trial, state: TrialState, scores: list[Score]) -> None:
        trial.set_user_attr("scores", [vars(score) for score in scores])
        value = mean_auc(scores) if state == TrialState.COMPLETE else None
        self.searches[agent].study.tell(trial, value, state)
        area = f"AUC {mean_auc(scores):.3f} over {len(scores)} cells" if scores else "no cell"
        of = f"{trial.number + 1} of {self.plan.listed + self.plan.exchange}"
        print(f"trial     {agent} {of}: {STATES[state]}, {area}", flush=True)

    def _best(self, agent: str) -> Chosen | None:
        return choose([trial for trial in self.results if trial.agent == agent])

    def _try_singles(self, chosen: Sequence[Chosen]) -> list[Chosen]:
        """The same choices with scores of the first trial with one of their options."""
        tried = [
            {name: self.plan.cells(c.agent, single) for name, single in self._singles(c).items()}
            for c in chosen
        ]
        self._run([config for each in tried for configs in each.values() for config in configs])
        scores = [{name: self._scores(cells) for name, cells in each.items()} for each in tried]
        return [
            # An option with which a run fails is left out.
            dataclasses.replace(
                c, singles={name: own for name, own in each.items() if len(own) == len(cells[name])}
            )
            for c, each, cells in zip(chosen, scores, tried, strict=True)
        ]

    def _singles(self, chosen: Chosen) -> dict[str, dict[str, Any]]:
        """The first trial's options with one of the choice, by option."""
        if chosen.agent not in self.plan.singles:
            return {}
        first = self.plan.start(chosen.agent)
        return {
            name: {**first, name: value}
            for name, value in chosen.options.items()
            if value != first[name]
        }

    def _confirm(self, chosen: Sequence[Chosen]) -> list[Chosen]:
        """The same choices with scores on the fresh cells."""
        compared = [self._fresh_cells(choice) for choice in chosen]
        self._run([config for each in compared for configs in each.values() for config in configs])
        return [
            dataclasses.replace(c, fresh={s: self._scores(configs) for s, configs in each.items()})
            for c, each in zip(chosen, compared, strict=True)
        ]

    def _fresh_cells(self, chosen: Chosen) -> dict[Setting, list[RunConfig]]:
        """The runs of every setting on the fresh cells."""
        agent, first = chosen.agent, self.plan.start(chosen.agent)
        trials = {trial.number: trial for trial in self.results if trial.agent == agent}
        settings: dict[Setting, Mapping[str, Any]] = {
            "start": first,
            "chosen": chosen.options,
        }
        if agent in self.plan.singles:
            name = best_single(chosen, trials[START].scores)
            single = {name: chosen.options[name]} if name else {}
            settings["one_option"] = {**first, **single}
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
        places = self.places
        about = {"plan": self.plan.name, "digest": self.plan.digest, "data": dict(self.plan.data)}
        write_json(places["trials"], {**about, **to_json(self.results, chosen)})
        if chosen:
            words = (
                f"Chosen by `{to_paste('symsteer', 'tune', self.plan.name)}`, "
                f"{self.plan.listed + self.plan.exchange} trials an agent."
            )
            write_atomically(places["preset"], to_preset(chosen, words).encode())


def preview(plan: TuningPlan) -> str:
    """What a plan asks for."""
    first = plan.agents[0]
    cells = len(plan.cells(first, plan.start(first)))
    fresh = len(plan.cells(first, plan.start(first), "confirm"))
    lines = [f"{plan.name}: {plan.description}" if plan.description else plan.name, ""]
    trials = plan.listed + plan.exchange
    lines += [
        f"{agent}: {trials} trials of {len(space)} options: {', '.join(space)}"
        for agent, space in plan.spaces.items()
    ]
    runs = sum(
        trials * cells + 3 * fresh + (agent in plan.singles) * (len(space) * cells + fresh)
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


def _result(agent: str, trial: FrozenTrial) -> TrialResult:
    scores = [Score(**score) for score in trial.user_attrs.get("scores", [])]
    return TrialResult(agent, trial.number, STATES[trial.state], trial.params, scores)
