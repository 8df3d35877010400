"""Trials of the suites dial-a to dial-d: collects them, and chooses by minimax regret.

python -m tools.pages.dial                       # the tables of the committed trials
python -m tools.pages.dial RUNS [RUNS ...]       # adds finished runs of these folders
python -m tools.pages.dial --tasks StackCube-v1 --seeds 120      # only of this task and this policy
python -m tools.pages.dial --without utd noise_bound             # only what stage A has chosen

A setting is compared if it has all worlds and base policies that any setting has. If all agents
have the same settings, as in dial-a, a table before the others takes them together.

The committed trials are the records of leaderboard/results/search. The setting of a trial: the
options that are not those of the preset dial.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symsteer.agents import AGENTS
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import preset_options
from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.leaderboard.keys import agent_options
from symsteer.leaderboard.records import read_record
from symsteer.leaderboard.records.measures import area_under_curve
from symsteer.tables import markdown
from symsteer.terminal import complain
from tools.pages.marks import CHECKOUT

TRIALS = CHECKOUT / "leaderboard" / "results" / "search"

SUCCESS, AREA = 0.05, 0.03
"""Regrets of equal weight: what the safe agent may lose."""


@dataclass(frozen=True)
class Trial:
    """One finished run.

    Attributes:
        setting: options that differ from those of the preset ``dial``, as text.
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


def trial_of(path: Path) -> Trial | None:
    """The trial of a record; None if the run is not finished."""
    record = read_record(path)
    if record.status != "finished" or record.final is None:
        return None
    config = record.settings
    # Some agents of the search are no longer here; all their own options are shown.
    kind = AGENTS.get(config.agent).Options if config.agent in AGENTS else SacOptions
    preset = kind(**preset_options("dial", config.agent, kind))
    usual = agent_options({"agent_options": vars(preset)})
    options = agent_options(record.config)
    changed = {name: text for name, text in options.items() if usual.get(name) != text}
    steps = [evaluation.env_steps for evaluation in record.evaluations]
    successes = [evaluation.success_once for evaluation in record.evaluations]
    return Trial(
        config.agent,
        " ".join(f"{name}={value}" for name, value in sorted(changed.items())) or "dial",
        f"{config.task} {config.variant}",
        config.seed,
        area_under_curve(steps, successes, config.env_steps),
        record.final.success_once,
        record.wall_clock.total,
    )


Candidate = tuple[str, str]
"""An agent and its setting."""


def complete(trials: Iterable[Trial]) -> dict[Candidate, list[Trial]]:
    """The trials of each candidate that has all worlds and base policies that any has."""
    of_candidate: dict[Candidate, list[Trial]] = defaultdict(list)
    for trial in trials:
        of_candidate[trial.agent, trial.setting].append(trial)
    places = {c: {(t.world, t.seed) for t in tried} for c, tried in of_candidate.items()}
    every = set().union(*places.values())
    found = {c: tried for c, tried in of_candidate.items() if places[c] == every}
    if not found:
        raise UserError(
            "no setting was tried in all worlds with all base policies; finish the suite, or name "
            "fewer with --tasks and --seeds"
        )
    return found


def below_best(
    candidates: Mapping[Candidate, Sequence[Trial]],
) -> dict[Candidate, dict[str, tuple[float, float]]]:
    """By how much each candidate is below the best one of each world, in success and in area.

    Both are means over base policies.
    """
    result: dict[Candidate, dict[str, tuple[float, float]]] = defaultdict(dict)
    for world in sorted({trial.world for tried in candidates.values() for trial in tried}):
        means = {
            candidate: np.mean([(t.success, t.area) for t in tried if t.world == world], axis=0)
            for candidate, tried in candidates.items()
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
    candidates = complete(trials)
    of_candidate = below_best(candidates)
    rows = []
    for (agent, setting), regret in sorted(
        of_candidate.items(), key=lambda item: (item[0][0], loss(item[1]))
    ):
        runs = candidates[agent, setting]
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
    parser = argparse.ArgumentParser(
        description=(__doc__ or "").split("\n", 1)[0],
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("runs", nargs="*", type=Path, help="folders of runs to add")
    parser.add_argument("--tasks", nargs="*", default=[], help="all if none is named")
    parser.add_argument("--seeds", nargs="*", type=int, default=[], help="all if none is named")
    parser.add_argument(
        "--without", nargs="*", default=[], help="options that may not differ from the preset"
    )
    given = parser.parse_args(arguments)
    for folder in given.runs:
        for path in sorted(folder.glob("*/record.json")):
            if trial_of(path):
                TRIALS.mkdir(parents=True, exist_ok=True)
                write_atomically(TRIALS / f"{path.parent.name}.json", path.read_bytes())
    every = [trial for path in sorted(TRIALS.glob("*.json")) if (trial := trial_of(path))]
    trials = [
        trial
        for trial in every
        if (not given.tasks or trial.world.split()[0] in given.tasks)
        and (not given.seeds or trial.seed in given.seeds)
        and not any(f" {name}=" in f" {trial.setting}" for name in given.without)
    ]
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
