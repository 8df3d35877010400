"""Several learners of one kind, trained together: one batched product in place of many.

An update is many small operations, whose overhead is larger than their work. A team stacks the
parameters of its members, so that one update of the team is an update of each member. The members
stay what they are: they act, and keep their replay, generators and checkpoints. Their parameters
become views of the stacked ones. Each one draws its own random numbers, so a member learns what it
would learn alone, but for rounding.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import nn

from symsteer.agents.graphs import GraphedUpdates
from symsteer.agents.networks import Ensemble, Weights
from symsteer.agents.optimization import Adam, Trained
from symsteer.agents.replay import Batch
from symsteer.agents.sac import SacAgent
from symsteer.policies.contract import ChunkPolicy


class Team:
    """Updates its members together.

    Args:
        members: of one class, with equal options and layouts.

    Attributes:
        core: an agent of the same class, whose tensors have the members in front.

    Raises:
        ValueError: if they have not made equally many updates; their optimisers would not fit.
    """

    def __init__(self, members: Sequence[SacAgent]):
        if len({member.updates for member in members}) > 1:
            raise ValueError("the members of a team must have made equally many updates")
        self.members = list(members)
        first = self.members[0]
        self.core = core = copy.copy(first)
        core.streams, core.stacked = [member.generator for member in members], True
        core.context = dataclasses.replace(
            first.context,
            decode=_each([member.context.decode for member in members]),
            normalize_obs=_each([member.context.normalize_obs for member in members]),
        )
        core.networks, core.optimizers, core.multipliers = {}, {}, {}
        self._adams: list[tuple[Adam, list[Adam]]] = []
        for name in first.networks:
            stacked = StackedEnsemble([member.networks[name] for member in members])
            core.networks[name] = stacked
            core.optimizers[name] = self._adam(stacked, [m.optimizers[name] for m in members])
        for name in first.multipliers:
            each = [member.multipliers[name] for member in members]
            core.multipliers[name] = stack = copy.copy(each[0])
            stack.log = torch.stack([one.log for one in each])
            for one, log in zip(each, stack.log, strict=True):
                one.log = log
            stack.optimizer = self._adam(stack, [one.optimizer for one in each])
        count, layers = len(members), zip(*(member.target for member in members), strict=True)
        core.target = [
            (torch.cat([w for w, _ in layer]), torch.cat([b for _, b in layer])) for layer in layers
        ]
        for i, member in enumerate(members):
            # Each sees its part of the stacked target critics.
            member.target = [(w.chunk(count)[i], b.chunk(count)[i]) for w, b in core.target]
            member.synchronize = self.synchronize

    def update(self, batches: Sequence[Batch]) -> list[dict[str, torch.Tensor]]:
        """One update of each member with its batch; the scalars of each."""
        distillations, *_ = [member.count_update() for member in self.members]
        self.core.decisions = self.members[0].decisions
        if any(batches):
            stacked = Batch({name: torch.stack([b[name] for b in batches]) for name in batches[0]})
            scalars = self.core.learn(self.core.augment(stacked), distillations)
        else:
            scalars = self.graphs.update(distillations)
        of_members = torch.stack([*scalars.values()], 1).unbind()
        return [dict(zip(scalars, values.unbind(), strict=True)) for values in of_members]

    @functools.cached_property
    def graphs(self) -> GraphedUpdates:
        """The same with batches that are drawn inside."""
        replays = [member.replay for member in self.members]
        generators = [*self.core.streams, *(replay.generator for replay in replays)]
        return GraphedUpdates(self.core, self._draw, replays, generators)

    def _draw(self) -> Batch:
        size, replay = self.core.options.batch_size, self.core.replay
        rows = torch.stack([member.replay.sample_rows(size) for member in self.members])
        return self.core.augment(replay.batch_of(rows))

    def synchronize(self) -> None:
        """Write the optimisers' state to the members; all else they share with the team."""
        for adam, members in self._adams:
            adam.scatter(members)

    def dissolve(self) -> None:
        """Give every member parameters of its own again."""
        self.synchronize()
        for member in self.members:
            member.target = [(w.clone(), b.clone()) for w, b in member.target]
            member.synchronize = lambda: None
            for multiplier in member.multipliers.values():
                multiplier.log = multiplier.log.clone()
            for network in member.networks.values():
                network.own()
                network.changed()
            member.graphs = None

    def _adam(self, trained: Trained, members: list[Adam]) -> Adam:
        """The optimiser of what is stacked, with the state of those of the members."""
        adam = Adam(trained, members[0].lr)
        adam.gather(members)
        self._adams.append((adam, members))
        return adam


class StackedEnsemble(Ensemble):
    """The ensembles of a team's members as one, which keeps their parameters.

    Args:
        ensembles: of equal shape, one of each member.
    """

    def __init__(self, ensembles: Sequence[Ensemble]):
        first, self._ensembles = ensembles[0], list(ensembles)
        layers = [
            [*cast(nn.ModuleList, member)] for ensemble in ensembles for member in ensemble.members
        ]
        super().__init__(layers, first.layer_norm, first.activation)
        parts = zip(*(x.detach().chunk(len(ensembles)) for x in self.tensors), strict=True)
        for ensemble, tensors in zip(ensembles, parts, strict=True):
            ensemble.tensors = list(tensors)

    def changed(self) -> None:
        super().changed()
        for ensemble in self._ensembles:
            ensemble.changed()

    def apply_weights(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """``[runs, B, in] -> [runs, members, B, out]``."""
        runs = len(self._ensembles)
        size = len(weights[0][0]) // runs
        inputs = x.unsqueeze(1).expand(runs, size, *x.shape[1:]).flatten(0, 1)
        return self.propagate(weights, inputs).unflatten(0, (runs, size))


def _each(functions: Sequence[Callable[..., torch.Tensor]]) -> Callable[..., torch.Tensor]:
    """Apply each function to its part of the stacked arguments, and stack the results.

    If they are methods of the same base policy, all rows are one batch.
    """
    owners = [getattr(function, "__self__", None) for function in functions]
    hashes = {x.content_hash() if isinstance(x, ChunkPolicy) else None for x in owners}
    if len(hashes) == 1 and None not in hashes:
        return lambda *arguments: functions[0](*(x.flatten(0, 1) for x in arguments)).unflatten(
            0, (len(functions), -1)
        )

    def call(*arguments: torch.Tensor) -> torch.Tensor:
        each = zip(functions, *arguments, strict=True)
        return torch.stack([function(*given) for function, *given in each])

    return call
