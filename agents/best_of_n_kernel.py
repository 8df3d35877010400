"""Best of n with a kernel critic: returns are regressed, nothing is bootstrapped but loose ends.

As in :mod:`symsteer.agents.best_of_n`, n noises are drawn from N(0, I) and decoded, and the chunk
with the largest Q is played. Here Q is the mean of a Gaussian process on x = (s, a), fitted to
discounted returns of the agent's own episodes, with a kernel that is averaged over the group
(arXiv 2511.03473):

    k_G(x, x') = 1/|G| sum over g of k(x, g x'),   k(x, x') = exp(-|x - x'|^2 / (2 l^2)).

Q is then invariant. Returns that go on beyond a time-out, or beyond what was played so far, end
with max_i Q(s', a_i) of the previous fit.

Our choices, for the paper is theory: k; scales of observations and actions by their median
distances; l and the ridge by the marginal likelihood; the last ``points`` decisions, fitted anew
every ``refit``.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch

from symsteer.agents.agent import Agent, AgentContext, AgentOptions, Budget, MakeEnv, Role
from symsteer.agents.diagnostics import (
    SYMMETRY_STATES,
    bound_violation,
    critic_preference,
    decode_equivariance_error,
    orbit_variance,
    value_errors,
)
from symsteer.agents.episodes import Played
from symsteer.agents.generators import continue_stream
from symsteer.agents.presets import tuned
from symsteer.agents.replay import ReplayBuffer, Transition
from symsteer.errors import UserError
from symsteer.policies.geometry import Group, Layout

LENGTHS = (0.25, 0.5, 1.0, 2.0)
"""Candidates for l, in median distances."""

RIDGES = (0.03, 0.1, 0.3, 1.0)
"""Candidates for the variance of a return given x, in units of that of the kernel."""

SELECTION = 400
"""Decisions of which the marginal likelihood is computed."""

QUERIES = 2048
"""States whose values are computed at once."""


@dataclass(frozen=True)
class KernelOptions(AgentOptions):
    """Options of best of n with a kernel critic."""

    candidates: int = 8
    """n: chunks to choose from."""
    group: str = "C8"
    """Group over which the kernel is averaged; C1: a plain kernel."""
    gamma: float = 0.95
    """Discount per decision."""
    points: int = 2_000
    """Decisions that are regressed: the last ones."""
    refit: int = 640
    """Decisions between two fits; before the first one the agent is the base policy."""

    reduce: ClassVar[Literal["mean"]] = "mean"

    def __post_init__(self) -> None:
        for name in ("candidates", "points", "refit"):
            if getattr(self, name) < 1:
                raise UserError(f"agent option {name} must be at least 1")
        if not 0 < self.gamma < 1:
            raise UserError(f"agent option gamma must be between 0 and 1, not {self.gamma}")
        _ = Group.parse(self.group).order


@tuned
class KernelBestOfNAgent(Agent):
    """Plays the best of n chunks of the base policy, by regressed returns."""

    name = "best-of-n-kernel"
    role: ClassVar[Role] = "learner"
    Options = KernelOptions
    options: KernelOptions
    replay: ReplayBuffer

    def __init__(self, context: AgentContext, options: KernelOptions | None = None):
        super().__init__(context, options)
        self.group = Group.parse(self.options.group)
        self.executed_layout = self.act_layout.repeat(context.execute)
        self.replay = self._new_replay(self.options.points)
        self.fit_generator = self._new_generator(1)
        self.decisions = self.fits = 0
        nothing = torch.zeros(0, device=self.device, dtype=self.dtype)
        self.fitted: dict[str, torch.Tensor] = {
            "orbits": nothing.view(self.group.order, 0, 0),
            "coefficients": nothing,
            "prior": torch.zeros((), device=self.device, dtype=self.dtype),
            "scales": torch.ones(3, device=self.device, dtype=self.dtype),
        }
        """Turned inputs of the points ``[order, points, dim]`` in units of l, their coefficients,
        the mean return, and the scales of observations and actions, and l."""

    @classmethod
    def check(cls, options: KernelOptions, budget: Budget) -> None:
        """Check that a fit fits into the budget, and the decisions of one step into the points."""
        if budget.env_steps <= options.refit * budget.execute:
            raise UserError(
                f"env_steps is {budget.env_steps}, which ends before the first fit at "
                f"{options.refit * budget.execute}; raise env_steps or lower agent.refit"
            )
        if options.points < budget.num_envs:
            raise UserError(
                f"agent.points is {options.points}, less than one decision of each of "
                f"{budget.num_envs} environments; raise it or lower num_envs"
            )

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Train for the whole budget."""
        return budget.env_steps

    # Acting.

    @torch.no_grad()
    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """The best of n new noises, ``[B, Tp, Da]``; in evaluations, too, they are random."""
        return self._best(obs, self.generator)[0]

    def sample(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The same; there is no log-probability, and it is given as 0."""
        noise = self.act(obs)
        return noise, noise.new_zeros(len(noise))

    def q_values(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Q of ``noise [B, Tp, Da]``, ``[1, B]``; 0 before the first fit."""
        with torch.no_grad():
            actions = self.decode(obs, noise.to(self.dtype))[:, : self.context.execute]
            return self._values(obs, actions.flatten(1)).unsqueeze(0)

    def _best(
        self, obs: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The best of n noises for each state, and its value."""
        size = self.options.candidates
        noise = self.gaussian_noise(size * len(obs), generator)
        q = self.q_values(obs.repeat_interleave(size, 0), noise).view(len(obs), size)
        value, index = q.max(1)
        rows = torch.arange(len(obs), device=self.device)
        return noise.unflatten(0, (len(obs), size))[rows, index], value

    # Learning.

    def observe(self, transition: Transition) -> None:
        """Store the decisions; after every ``refit`` of them the critic is fitted."""
        fields = vars(transition)
        self.replay.add({name: fields[name] for name in self.replay.shapes})
        before = self.decisions // self.options.refit
        self.decisions += len(transition.reward)
        if self.decisions // self.options.refit > before:
            self.fit()

    @torch.no_grad()
    def fit(self) -> None:
        """Regress the returns of what is stored."""
        rows = self.replay.in_order()
        returns = self._returns(rows)
        prior = returns.mean()
        spread = returns.std(unbiased=False).clamp(min=1e-6)
        wanted = (returns - prior) / spread
        obs, actions = self._features(rows["obs"]), rows["actions"].flatten(1)
        scales = [self._median_distance(x) for x in (obs, actions)]
        inputs = torch.cat([x / scale for x, scale in zip((obs, actions), scales, strict=True)], 1)
        chosen = torch.randperm(len(wanted), generator=self.fit_generator, device=self.device)
        chosen = chosen[:SELECTION]
        few = inputs[chosen]
        kernels = {length: _kernel(few / length, self._orbits(few / length)) for length in LENGTHS}
        length, ridge = max(
            itertools.product(LENGTHS, RIDGES),
            key=lambda pair: _likelihood(kernels[pair[0]], wanted[chosen], pair[1]),
        )
        orbits = self._orbits(inputs / length)
        factor = _factor(_kernel(inputs / length, orbits), ridge)
        coefficients = torch.cholesky_solve(wanted.double().unsqueeze(1), factor).squeeze(1)
        self.fitted = {
            "orbits": orbits,
            "coefficients": spread * coefficients.to(self.dtype),
            "prior": prior,
            "scales": torch.stack([*scales, inputs.new_tensor(length)]),
        }
        self.fits += 1

    def _returns(self, rows: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Discounted returns of stored decisions ``[steps * envs]``, oldest first."""
        stride, gamma = self.replay.stride, self.options.gamma
        count = len(rows["reward"])
        follows = torch.zeros(count, dtype=torch.bool, device=self.device)
        # Fresh scenes begin new episodes without an end of the old ones.
        joined = (rows["obs"][stride:] == rows["next_obs"][:-stride]).all(1)
        follows[:-stride] = joined & ((rows["terminal"] + rows["truncated"])[:-stride] == 0)
        loose = ~follows & (rows["terminal"] == 0)
        after = torch.zeros_like(rows["reward"])
        if self.fits:
            ends = rows["next_obs"][loose]
            parts = [self._best(part, self.fit_generator)[1] for part in ends.split(QUERIES)]
            after[loose] = torch.cat(parts)
        else:  # nothing is known: the costs go on
            after[loose] = rows["reward"].mean() / (1 - gamma)
        returns = rows["reward"] + gamma * after
        for begin in reversed(range(0, count - stride, stride)):
            here = slice(begin, begin + stride)
            then = returns[begin + stride : begin + 2 * stride]
            going_on = rows["reward"][here] + gamma * then
            returns[here] = torch.where(follows[here], going_on, returns[here])
        return returns

    def _values(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Q of ``obs [B, obs_dim]`` in environment units and flat executed actions, ``[B]``."""
        if not self.fits:
            return actions.new_zeros(len(actions))
        to_obs, to_actions, length = self.fitted["scales"]
        queries = torch.cat([self._features(obs) / to_obs, actions / to_actions], 1) / length
        orbits, coefficients = self.fitted["orbits"], self.fitted["coefficients"]
        kernels = (_kernel(part, orbits) @ coefficients for part in queries.split(QUERIES))
        return self.fitted["prior"] + torch.cat(list(kernels))

    def _orbits(self, inputs: torch.Tensor) -> torch.Tensor:
        """All turned copies of ``inputs [N, dim]``, ``[order, N, dim]``."""
        layout = Layout.join(obs=self.obs_layout, actions=self.executed_layout)
        return torch.stack([layout.transform(inputs, *g) for g in self.group.elements])

    def _median_distance(self, x: torch.Tensor) -> torch.Tensor:
        """Of random pairs of rows."""
        order = torch.randperm(len(x), generator=self.fit_generator, device=self.device)
        return (x - x[order]).norm(dim=1).median().clamp(min=1e-6)

    def _features(self, obs: torch.Tensor) -> torch.Tensor:
        return self.context.normalize_obs(obs).to(self.dtype)

    # Reports and checkpoints.

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Those of the critic; an actor's are not measured."""
        assert played.long is not None
        low, high = played.feasible
        obs, noise = (x[played.greedy.running] for x in (played.greedy.obs, played.greedy.noise))
        q = self.q_values(obs, noise)
        few = torch.randperm(len(obs), generator=torch.Generator().manual_seed(0))
        few = few[:SYMMETRY_STATES].to(obs.device)
        orbit = orbit_variance(self, obs[few], noise[few], self.group)
        size = q[:, few].double().square().mean().sqrt().item()
        return {
            "q_mean": q.mean().item(),
            "q_min": q.min().item(),
            "q_max": q.max().item(),
            **bound_violation(q, low, high),
            "q_low": low,
            "q_high": high,
            **value_errors(self, played.long),
            "q_preference": critic_preference(self, obs, played.generator)["critic_preference"],
            "noise_norm": noise.flatten(1).norm(dim=1).mean().item(),
            "orbit_variance": orbit["orbit_variance"],
            "equivariance_critic": orbit["orbit_variance"] ** 0.5 / max(size, 1e-30),
            "equivariance_decode": decode_equivariance_error(
                self, obs[few], noise[few], self.group
            ),
        }

    def description(self) -> dict[str, Any]:
        """Also the group."""
        return {**super().description(), "group": self.options.group}

    def state_dict(self) -> dict[str, Any]:
        """Also what was fitted, and the counters."""
        return {
            **super().state_dict(),
            "fitted": {name: tensor.clone() for name, tensor in self.fitted.items()},
            "fit_generator": self.fit_generator.get_state(),
            "decisions": self.decisions,
            "fits": self.fits,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue exactly where :meth:`state_dict` was taken."""
        super().load_state_dict(state)
        self.fitted = {
            name: state["fitted"][name].to(tensor) for name, tensor in self.fitted.items()
        }
        continue_stream(self.fit_generator, state["fit_generator"])
        self.decisions, self.fits = int(state["decisions"]), int(state["fits"])
        # Of another shape, they cannot tell a value.
        self._values(*(torch.zeros(1, x.dim) for x in (self.obs_layout, self.executed_layout)))


def _kernel(queries: torch.Tensor, orbits: torch.Tensor) -> torch.Tensor:
    """k_G of ``queries [B, dim]`` and points with ``orbits [order, N, dim]``, ``[B, N]``."""
    distances = torch.cdist(queries, orbits.flatten(0, 1)).square_().mul_(-0.5)
    return distances.exp_().view(len(queries), *orbits.shape[:2]).mean(1)


def _likelihood(kernel: torch.Tensor, wanted: torch.Tensor, ridge: float) -> float:
    """Log marginal likelihood per return, at the best variance, up to a constant."""
    factor = _factor(kernel, ridge)
    white = torch.linalg.solve_triangular(factor, wanted.double().unsqueeze(1), upper=False)
    return (-factor.diagonal().log().mean() - 0.5 * white.square().mean().log()).item()


def _factor(kernel: torch.Tensor, ridge: float) -> torch.Tensor:
    """Cholesky factor of the kernel plus its ridge, in double precision."""
    kernel = kernel.double()
    # Rounding makes it asymmetric.
    return torch.linalg.cholesky(
        0.5 * (kernel + kernel.mT) + ridge * torch.eye(len(kernel)).to(kernel)
    )
