"""Trials of the suites dial-a and dial-b: collects them, and chooses by minimax regret.

python -m tools.pages.dial                       # the tables of the committed trials
python -m tools.pages.dial RUNS [RUNS ...]       # adds finished runs of these folders

If all agents have the same settings, as in dial-a, a table before the others takes them together.

The committed trials are leaderboard/results/dial/trials.json: a run each, with its setting (the
options that are not the agent's defaults), its area under the success curve and its final success.
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from symsteer.agents import AGENTS
from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.leaderboard.keys import agent_options
from symsteer.leaderboard.records import read_record
from symsteer.leaderboard.records.measures import area_under_curve
from symsteer.tables import markdown
from symsteer.terminal import complain
from tools.pages.marks import CHECKOUT

TRIALS = CHECKOUT / "leaderboard" / "results" / "dial" / "trials.json"

SUCCESS, AREA = 0.05, 0.03
"""Regrets of equal weight: what the safe agent may lose."""


@dataclass(frozen=True)
class Trial:
    """One finished run.

    Attributes:
        setting: options that differ from the agent's defaults, as text.
        world: task and variant.
        area: under the curve of held-out success, as a share of the budget.
        success: in the final evaluation.
        seconds: wall-clock time.
    """

    agent: str
    setting: str
    world: str
    seed: int
    area: float
    success: float
    seconds: float

    @property
    def key(self) -> tuple[str, str, str, int]:
        """What makes it a trial of its own."""
        return self.agent, self.setting, self.world, self.seed


def trial_of(path: Path) -> Trial | None:
    """The trial of a record; None if the run is not finished."""
    record = read_record(path)
    if record.status != "finished" or record.final is None:
        return None
    config = record.settings
    usual = agent_options({"agent_options": vars(AGENTS.get(config.agent).Options())})
    options = agent_options(record.config)
    changed = {name: text for name, text in options.items() if usual.get(name) != text}
    steps = [evaluation.env_steps for evaluation in record.evaluations]
    successes = [evaluation.success_once for evaluation in record.evaluations]
    return Trial(
        config.agent,
        " ".join(f"{name}={value}" for name, value in sorted(changed.items())) or "defaults",
        f"{config.task} {config.variant}",
        config.seed,
        area_under_curve(steps, successes, config.env_steps),
        record.final.success_once,
        record.wall_clock.total,
    )


Candidate = tuple[str, str]
"""An agent and its setting."""


def below_best(trials: Iterable[Trial]) -> dict[Candidate, dict[str, tuple[float, float]]]:
    """By how much each candidate is below the best one of each world, in success and in area.

    Both are means over the base policies that all candidates of a world have.
    """
    by_world: dict[str, dict[Candidate, dict[int, Trial]]] = defaultdict(lambda: defaultdict(dict))
    for trial in trials:
        by_world[trial.world][trial.agent, trial.setting][trial.seed] = trial
    result: dict[Candidate, dict[str, tuple[float, float]]] = defaultdict(dict)
    for world, candidates in by_world.items():
        shared = sorted(set.intersection(*(set(runs) for runs in candidates.values())))
        if not shared:
            raise UserError(f"no base policy of {world} has been tried by all; finish the suite")
        means = {
            candidate: np.mean([(runs[s].success, runs[s].area) for s in shared], axis=0)
            for candidate, runs in candidates.items()
        }
        best = np.max(list(means.values()), axis=0)
        for candidate, mean in means.items():
            result[candidate][world] = tuple(best - mean)
    return dict(result)


def loss(regret: Mapping[str, tuple[float, float]]) -> float:
    """The largest regret over worlds and both measures, in units of what may be lost."""
    return max(max(success / SUCCESS, area / AREA) for success, area in regret.values())


def shared(trials: Iterable[Trial]) -> list[Trial]:
    """The same trials as those of one agent, ``all``: its policies are pairs of agent and policy.

    So a setting that all agents share is chosen by the mean over agents in each world.
    """
    agents = sorted({trial.agent for trial in trials})
    return [
        replace(trial, agent="all", seed=trial.seed * len(agents) + agents.index(trial.agent))
        for trial in trials
    ]


def render(trials: Sequence[Trial]) -> str:
    """A row for each candidate, the best of an agent first; in markdown."""
    of_candidate = below_best(trials)
    rows = []
    for (agent, setting), regret in sorted(
        of_candidate.items(), key=lambda item: (item[0][0], loss(item[1]))
    ):
        runs = [t for t in trials if (t.agent, t.setting) == (agent, setting)]
        worst = max(regret, key=lambda world: regret[world][0])
        rows.append(
            [
                f"`{agent}`",
                f"`{setting}`",
                str(len(runs)),
                f"{np.mean([t.area for t in runs]):.3f}",
                f"{np.mean([t.success for t in runs]):.3f}",
                f"{np.mean([s for s, _ in regret.values()]):.3f}",
                f"{regret[worst][0]:.2f} ({worst})",
                f"{max(a for _, a in regret.values()):.2f}",
                f"{loss(regret):.1f}",
                f"{np.mean([t.seconds for t in runs]):.0f}",
            ]
        )
    header = ["agent", "setting", "runs", "area", "success", "mean regret"]
    header += ["worst regret of success", "of area", "loss", "seconds"]
    return markdown(header, rows)


def main(arguments: Sequence[str]) -> int:
    """Collect, and print the table."""
    known: list[Trial] = []
    if TRIALS.is_file():
        known = TypeAdapter(list[Trial]).validate_json(TRIALS.read_bytes())
    by_key: dict[Any, Trial] = {trial.key: trial for trial in known}
    for folder in arguments:
        for path in sorted(Path(folder).glob("*/record.json")):
            if (trial := trial_of(path)) is not None:
                by_key[trial.key] = trial
    if arguments:
        text = json.dumps([asdict(by_key[key]) for key in sorted(by_key)], indent=0)
        TRIALS.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(TRIALS, f"{text}\n".encode())
    trials = list(by_key.values())
    settings = [
        {t.setting for t in trials if t.agent == agent} for agent in {t.agent for t in trials}
    ]
    if len(settings) > 1 and all(one == settings[0] for one in settings):
        print(f"{render(shared(trials))}\n")
    print(render(trials))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except UserError as error:
        sys.exit(complain(error, f"error: {error}", 2))
