"""A plan that has been played to its end with known runs, once for all tests."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from symsteer.bench.tuning.trials import Chosen, TrialResult
from tests.bench.tuning.tiny_plan import TEXT, KnownRuns, write_plan


class Played(NamedTuple):
    """What a plan came to."""

    trials: list[TrialResult]
    chosen: list[Chosen]
    runs: KnownRuns
    folder: Path
    """Of the files of tuning."""

    def of(self, agent: str) -> list[TrialResult]:
        """The trials of an agent."""
        return [trial for trial in self.trials if trial.agent == agent]


def play_plan(folder: Path, text: str = TEXT, **kwargs: float | int) -> Played:
    """Play a plan in a folder; ``kwargs`` are those of `KnownRuns`."""
    from symsteer.bench.tuning import command
    from symsteer.bench.tuning.plan import read_plan

    runs = KnownRuns(**kwargs)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "run_plan", runs)
        tuner = command.Tuner(read_plan(write_plan(folder, text)), folder / "runs")
        return Played(*tuner.play(), runs, folder / "runs" / "tuning")


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Played:
    """The plan ``TEXT``, played without a stop."""
    return play_plan(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def again(whole: Played, tmp_path: Path) -> Callable[..., Played]:
    """Plays a plan where ``TEXT`` has been played to its end."""
    shutil.copytree(whole.folder.parent, tmp_path / "runs")
    return lambda **kwargs: play_plan(tmp_path, **kwargs)
