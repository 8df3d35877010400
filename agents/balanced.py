"""Three learners on one replay; episodes go to the one whose regret bound is smallest.

`standard`, `equivariant` and `slow` learn from the decisions of all. Which of them plays an episode
is chosen by regret balancing with bounds from data (D3RB, arXiv 2306.02869): learner i has played
n_i episodes with scores that sum to u_i, and is trusted to lose at most d_i sqrt(n_i) against the
best one. The next episode goes to the smallest d_i sqrt(n_i). If even with this bound a learner is
worse than another one,

    u_i / n_i + d_i / sqrt(n_i) + c_i < max_j (u_j / n_j - c_j),
    c_i = confidence sqrt(log(3 log n_i / 0.05) / n_i),

its d_i is doubled. A score is 1 plus the return as a share of the time limit, so that it lies in
[0, 1].

The paper's learners do not change; ours learn, and one that is late may end best. So every third
episode goes round (ours), and an evaluation plays the learner with the best recent scores, where
all forget by the same clock, the episodes of all. An update of all three costs three times that of
one.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from symsteer.agents.agent import Agent, AgentContext, Budget, MakeEnv
from symsteer.agents.episodes import Played
from symsteer.agents.equivariant import EquivariantAgent
from symsteer.agents.generators import owned
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import tuned
from symsteer.agents.replay import Batch, Transition
from symsteer.agents.sac import SacAgent
from symsteer.agents.slow import SlowAgent
from symsteer.agents.standard import StandardAgent

KINDS: tuple[type[SacAgent], ...] = (StandardAgent, EquivariantAgent, SlowAgent)

UNSURE = 0.05
"""Probability that the bounds of the scores may be wrong."""

ROUND = 3
"""Every such episode goes round."""


@dataclass(frozen=True)
class BalancedOptions(SacOptions):
    """Options of the balanced agent; all three learners have those of SAC."""

    rate: float = 0.03
    """That of `slow`."""
    bound: float = 0.1
    """d_i at the start."""
    confidence: float = 0.2
    """Factor on the uncertainty of the scores."""
    memory: float = 0.99
    """Weight in the recent scores that an episode, of any learner, leaves to those before it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("be positive", lambda value: value > 0, "bound")
        self._require("not be negative", lambda value: value >= 0, "rate", "confidence")
        self._require("lie in [0, 1)", lambda value: 0 <= value < 1, "memory")


class Balance:
    """Who plays the next episode, and who is best.

    Args:
        learners: how many.
        options: of the agent.

    Attributes:
        plays, scores, bounds: n, u and d of each learner.
        recent: its recent score, and the weight that it has.
        pending: episodes that have begun and not ended.
        begun: all that have begun.
    """

    def __init__(self, learners: int, options: BalancedOptions):
        self.options = options
        self.plays, self.pending = [0] * learners, [0] * learners
        self.scores, self.bounds = [0.0] * learners, [options.bound] * learners
        self.recent = [(0.0, 0.0)] * learners
        self.begun = 0

    def begin(self) -> int:
        """The learner of a new episode."""
        learners = range(len(self.plays))
        chosen = min(
            learners, key=lambda i: self.bounds[i] * math.sqrt(self.plays[i] + self.pending[i])
        )
        turn, rest = divmod(self.begun, ROUND)
        if rest == ROUND - 1:
            chosen = turn % len(learners)
        self.begun += 1
        self.pending[chosen] += 1
        return chosen

    def end(self, learner: int, score: float | None) -> None:
        """An episode has ended with a score; None: it was given up."""
        self.pending[learner] -= 1
        if score is None:
            return
        self.plays[learner] += 1
        self.scores[learner] += score
        memory = self.options.memory
        self.recent = [(memory * total, memory * weight) for total, weight in self.recent]
        total, weight = self.recent[learner]
        self.recent[learner] = (total + score, weight + 1)
        played = [i for i, n in enumerate(self.plays) if n]
        n, mean = self.plays[learner], self.scores[learner] / self.plays[learner]
        best = max(self.scores[i] / self.plays[i] - self._doubt(i) for i in played)
        if mean + self.bounds[learner] / math.sqrt(n) + self._doubt(learner) < best:
            self.bounds[learner] *= 2

    @property
    def best(self) -> int:
        """The learner with the best recent score."""
        means = [total / weight if weight else -1.0 for total, weight in self.recent]
        return means.index(max(means))

    def _doubt(self, learner: int) -> float:
        n = self.plays[learner]
        often = len(self.plays) * max(math.log(n), 1.0) / UNSURE
        return self.options.confidence * math.sqrt(math.log(often) / n)


@tuned
class BalancedAgent(Agent):
    """A plain, a strict and a slow learner; the better ones play more of the episodes."""

    name = "balanced"
    role = "learner"
    Options = BalancedOptions
    options: BalancedOptions

    def __init__(self, context: AgentContext, options: BalancedOptions | None = None):
        super().__init__(context, options)
        given = vars(self.options)
        self.learners: list[SacAgent] = []
        for kind in KINDS:
            known = {field.name for field in dataclasses.fields(kind.Options)}
            learner = kind(context, kind.Options(**{k: x for k, x in given.items() if k in known}))
            learner.generator, learner.streams = self.generator, [self.generator]
            if self.learners:
                learner.replay = self.learners[0].replay
                # Their warm-up would be the same noise three times.
                learner.generators = self.learners[0].generators
            self.learners.append(learner)
        self.replay = self.learners[0].replay
        self.networks = {
            f"{learner.name}_{name}": network
            for learner in self.learners
            for name, network in learner.networks.items()
        }
        self.balance = Balance(len(KINDS), self.options)
        self.limit = math.inf
        # Of the episode in each environment: its learner, its return, where it goes on.
        self.players: list[int] = []
        self.returns = self.following = torch.zeros(0)
        self.learning = self.learners[0]

    @classmethod
    def check(cls, options: Any, budget: Budget) -> None:
        """As for one learner."""
        SacAgent.check(options, budget)

    @property
    def best(self) -> SacAgent:
        """The learner that evaluations play."""
        return self.learners[self.balance.best]

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Train for the whole budget."""
        self.limit = budget.max_episode_steps
        return budget.env_steps

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``: of the best learner, or of that of each environment's episode."""
        if deterministic:
            return self.best.act(obs, True)
        if not self.players:
            self.players = [self.balance.begin() for _ in obs]
        players = torch.tensor(self.players, device=self.device)
        noise = obs.new_empty(len(obs), self.rows, self.act_layout.dim, dtype=self.dtype)
        for index in sorted({*self.players}):
            rows = players == index
            noise[rows] = self.learners[index].act(obs[rows])
        return noise

    def observe(self, transition: Transition) -> None:
        """Store the decisions for all, and give the episodes that have ended to their learners."""
        counts = self.learners[0].decisions >= self.options.warmup
        self.learners[0].observe(transition)
        for learner in self.learners[1:]:
            learner.owe(len(transition.reward))
        if len(self.returns):
            # Environments that began anew, before their episodes had ended.
            self.returns[(transition.obs != self.following).any(-1)] = 0
        else:
            self.returns = torch.zeros_like(transition.reward)
        self.returns += transition.reward
        self.following = getattr(transition, "obs_after", transition.next_obs).clone()
        ended = transition.terminal.bool() | transition.truncated.bool()
        for row in ended.nonzero().flatten().tolist():
            score = 1 + self.returns[row].item() / self.limit
            self._end(row, min(max(score, 0.0), 1.0) if counts else None)

    def _end(self, row: int, score: float | None) -> None:
        self.balance.end(self.players[row], score)
        self.players[row], self.returns[row] = self.balance.begin(), 0

    def batches(self) -> Iterator[Batch]:
        """The batches that are due, learner by learner."""
        for learner in self.learners:
            self.learning = learner
            yield from learner.batches()

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One update of the learner whose batch it is."""
        return self.learning.update(batch)

    @torch.no_grad()
    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A draw of the best learner."""
        return self.best.sample(obs)

    def q_values(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Values by its critics."""
        return self.best.q_values(obs, action)

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Those of the best learner, and the share of the episodes that each learner has played."""
        total = max(sum(self.balance.plays), 1)
        pairs = zip(self.learners, self.balance.plays, strict=True)
        shares = {f"plays_{learner.name}": plays / total for learner, plays in pairs}
        return {**self.best.diagnostics(played), **shares}

    def description(self) -> dict[str, Any]:
        """Also those of the learners."""
        return {**super().description(), "learners": [x.description() for x in self.learners]}

    def state_dict(self) -> dict[str, Any]:
        """Also the learners, and who has played how well."""
        balance = {k: copy.copy(x) for k, x in vars(self.balance).items() if k != "options"}
        kept = {"players": list(self.players), "returns": self.returns, "following": self.following}
        states = [learner.state_dict() for learner in self.learners]
        state = {**super().state_dict(), "learners": states, "balance": balance, **kept}
        return owned({**state, "limit": self.limit})

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        for learner, stored in zip(self.learners, state["learners"], strict=True):
            learner.load_state_dict(stored)
        vars(self.balance).update({k: copy.copy(x) for k, x in state["balance"].items()})
        self.players, self.limit = list(state["players"]), state["limit"]
        self.returns, self.following = (
            state[name].to(self.device) for name in ("returns", "following")
        )
        if not {*self.players} <= {*range(len(self.learners))}:
            raise ValueError(f"episodes are played by the learners {sorted({*self.players})}")
        if any(len(x) not in (0, len(self.players)) for x in (self.returns, self.following)):
            raise ValueError("not every environment has an episode")
