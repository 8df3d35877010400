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
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState

from symsteer.bench.tuning.plan import LATER, Choices, Range, TuningPlan
from symsteer.errors import UserError
from symsteer.policies.files import DAMAGE

optuna.logging.set_verbosity(optuna.logging.WARNING)

ENDED = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.FAIL)


def storage_path(out: Path, name: str) -> Path:
    """The journal of a tuning plan."""
    return out / "tuning" / f"{name}.journal"


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
        self.space = {name: _distribution(values) for name, values in plan.spaces[agent].items()}
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
            self.study.enqueue_trial(plan.start(agent))
        elif self.study.user_attrs.get("plan") != plan.digest:
            raise UserError(
                f"{plan.source} is not as it was when its trials began; restore it (only "
                f"{', '.join(LATER)} may change), or name another folder with --out"
            )

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
        ended = len(self.study.get_trials(deepcopy=False, states=ENDED))
        trials = []
        for number in range(ended, min(ended + self.plan.batch, last)):
            # A continued search draws what an uninterrupted one would.
            self.study.sampler = optuna.samplers.TPESampler(
                seed=_seed(self.plan.seed, self.agent, number),
                n_startup_trials=max(self.plan.batch, self.plan.trials // 3),
            )
            trials.append(self.study.ask(fixed_distributions=self.space))
        return trials

    @property
    def ended(self) -> list[FrozenTrial]:
        """Trials that were completed, given up or failed, by number."""
        return self.study.get_trials(deepcopy=False, states=ENDED)


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


def _distribution(values: Range | Choices) -> BaseDistribution:
    if isinstance(values, Choices):
        return CategoricalDistribution(values.values)
    if isinstance(values.low, int) and isinstance(values.high, int):
        return IntDistribution(values.low, values.high, log=values.log)
    return FloatDistribution(values.low, values.high, log=values.log)


def _seed(seed: int, agent: str, number: int) -> int:
    entropy = [seed, number, *agent.encode()]
    return int(np.random.SeedSequence(entropy).generate_state(1)[0])
