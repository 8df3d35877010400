"""The search over an agent's options: Optuna's sampler, pruner and storage.

The storage is a journal file that ``optuna-dashboard FILE`` shows. Trials that a stopped process
left unfinished are continued with the same options.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import Trial, TrialState

from symsteer.bench.tuning.plan import LATER, TuningPlan
from symsteer.bench.tuning.trials import Chosen, Score, State, TrialResult, choose, mean_auc
from symsteer.errors import UserError
from symsteer.policies.files import DAMAGE

optuna.logging.set_verbosity(optuna.logging.WARNING)

STATES: Mapping[TrialState, State] = {
    TrialState.COMPLETE: "complete",
    TrialState.PRUNED: "pruned",
    TrialState.FAIL: "failed",
}
"""Of the trials that have ended."""


class Search:
    """The trials of one agent.

    Args:
        plan: the tuning plan.
        agent: one of its agents.
        storage: of all agents' trials.

    Raises:
        UserError: if the storage has trials of a plan that differs.
    """

    def __init__(self, plan: TuningPlan, agent: str, storage: JournalStorage):
        self.plan, self.agent = plan, agent
        self.study = optuna.create_study(
            storage=storage,
            study_name=f"{plan.name}-{agent}",
            direction="maximize",
            load_if_exists=True,
            # A trial is given up if its first cells are worse than those of half of the others.
            pruner=optuna.pruners.MedianPruner(n_startup_trials=plan.batch),
        )
        if not self.study.get_trials(deepcopy=False):
            self.study.set_user_attr("plan", plan.digest)
            self.study.enqueue_trial(plan.first(agent))
        elif self.study.user_attrs.get("plan") != plan.digest:
            raise UserError(
                f"{plan.name}.toml is not as it was when its trials began; restore it (only "
                f"{', '.join(LATER)} may change), or name another folder with --runs"
            )

    @property
    def results(self) -> list[TrialResult]:
        """Trials that were completed, given up or failed, by number."""
        ended = self.study.get_trials(deepcopy=False, states=tuple(STATES))
        return [
            TrialResult(
                self.agent,
                trial.number,
                STATES[trial.state],
                trial.params,
                [Score(**score) for score in trial.user_attrs.get("scores", [])],
            )
            for trial in ended
        ]

    @property
    def best(self) -> Chosen | None:
        """The trial that is chosen; None if the first one failed."""
        return choose(self.results)

    def enqueue(self, settings: Sequence[Mapping[str, Any]], begin: int, count: int) -> None:
        """Let the first trials from number ``begin`` on have these settings, but for those tried.

        Args:
            settings: options of the agent.
            begin: trials before them; if there are more, nothing is done.
            count: the most trials that get one.
        """
        known = self.study.get_trials(deepcopy=False)
        if len(known) > begin:
            return
        tried = [trial.params for trial in known]
        for options in settings:
            if options not in tried and len(tried) < begin + count:
                tried.append(dict(options))
                self.study.enqueue_trial(dict(options))

    def batch(self, last: int) -> list[Trial]:
        """The trials to execute next: those left unfinished, or new ones; empty at the end.

        Args:
            last: trials in all.
        """
        begun = self.study.get_trials(deepcopy=False, states=(TrialState.RUNNING,))
        if begun:
            return [Trial(self.study, trial._trial_id) for trial in begun]
        ended = len(self.study.get_trials(deepcopy=False, states=tuple(STATES)))
        trials = []
        for number in range(ended, min(ended + self.plan.batch, last)):
            # A continued search draws what an uninterrupted one would.
            entropy = [self.plan.seed, number, *self.agent.encode()]
            self.study.sampler = optuna.samplers.TPESampler(
                seed=int(np.random.SeedSequence(entropy).generate_state(1)[0]),
                n_startup_trials=max(self.plan.batch, self.plan.trials // 3),
            )
            trials.append(self.study.ask(dict(self.plan.spaces[self.agent])))
        return trials

    def gives_up(self, trial: Trial, scores: Sequence[Score]) -> bool:
        """Whether the first cells of a trial are too bad to go on with it."""
        if not self.study.trials[trial.number].intermediate_values:
            trial.report(mean_auc(scores), len(scores))
        return trial.should_prune()

    def end(self, trial: Trial, state: TrialState, scores: Sequence[Score]) -> None:
        """Store how a trial ended, and print it."""
        trial.set_user_attr("scores", [vars(score) for score in scores])
        value = mean_auc(scores) if state == TrialState.COMPLETE else None
        self.study.tell(trial, value, state)
        area = f"AUC {mean_auc(scores):.3f} over {len(scores)} cells" if scores else "no cell"
        number = f"{trial.number + 1} of {self.plan.total}"
        print(f"trial     {self.agent} {number}: {STATES[state]}, {area}", flush=True)


def open_storage(path: Path) -> JournalStorage:
    """Open the journal, or begin one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return JournalStorage(JournalFileBackend(str(path)))
    except DAMAGE as error:
        raise UserError(
            f"{path} is not a journal of trials ({type(error).__name__}: {error}); restore it, or "
            "delete it to begin the search again"
        ) from error
