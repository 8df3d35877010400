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
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import torch
from torch import nn
from torch.func import functional_call

from symsteer.agents.networks import Dense, Ensemble, Weights, dense
from symsteer.agents.optimization import Multiplier, adam
from symsteer.agents.replay import Batch
from symsteer.agents.sac import SacAgent

Owner = tuple[torch.optim.Optimizer, torch.Tensor]
"""A parameter of a member, and the optimiser of the member that it belongs to."""


def can_join(agent_class: type) -> bool:
    """Whether agents of a class can be members of a team."""
    return issubclass(agent_class, SacAgent) and bool(vars(agent_class).get("in_teams"))


class Team:
    """Updates its members together.

    Args:
        members: of one class, with equal options and layouts.

    Raises:
        ValueError: if they have not made equally many updates; their optimisers would not fit.
    """

    def __init__(self, members: Sequence[SacAgent]):
        if len({member.updates for member in members}) > 1:
            raise ValueError("the members of a team must have made equally many updates")
        self.members = list(members)
        self._stacks: list[_Stack] = []
        first = self.members[0]
        # An agent of the same class, whose tensors have the members in front.
        self.core = core = cast(Any, copy.copy(first))
        core.random = self._random
        core.after_update = lambda batch: {}  # called for each member
        core.context = dataclasses.replace(
            first.context,
            decode=_each([member.context.decode for member in members]),
            normalize_obs=_each([member.context.normalize_obs for member in members]),
        )
        networks = {name: self._network(name) for name in first.networks}
        core.actor, core.critic = networks.get("actor"), networks["critic"]
        core.noise_critic = networks.get("noise_critic", networks["critic"])
        core.optimizers = {name: self._optimizer(name, networks[name]) for name in networks}
        core.multipliers = {name: self._multiplier(name) for name in first.multipliers}
        core.target = self._target()
        for member in self.members:
            member.synchronize = self.synchronize

    def update(self, batches: Sequence[Batch]) -> list[dict[str, torch.Tensor]]:
        """One update of each member with its batch; the scalars of each."""
        turned = [m.augment(batch) for m, batch in zip(self.members, batches, strict=True)]
        stacked = Batch({name: torch.stack([b[name] for b in turned]) for name in turned[0]})
        self.core.decisions = self.members[0].decisions
        scalars = self.core.learn(stacked)
        found = []
        for index, (member, batch) in enumerate(zip(self.members, turned, strict=True)):
            member.updates = self.core.updates
            member.distillation_owed = self.core.distillation_owed
            own = {name: value[index] for name, value in scalars.items()}
            found.append(own | member.after_update(batch))
        return found

    def synchronize(self) -> None:
        """Write the optimisers' state to the members; all else they share with the team."""
        for stack in self._stacks:
            stack.scatter()

    def dissolve(self) -> None:
        """Give every member parameters of its own again."""
        self.synchronize()
        for stack in self._stacks:
            stack.separate()
        for member in self.members:
            member.target = [(w.clone(), b.clone()) for w, b in member.target]
            member.synchronize = lambda: None
            for network in member.networks.values():
                network.changed()

    def _random(self, draw: Callable[[torch.Generator], torch.Tensor]) -> torch.Tensor:
        return torch.stack([draw(member.generator) for member in self.members])

    def _network(self, name: str) -> StackedEnsemble:
        return StackedEnsemble([member.networks[name] for member in self.members])

    def _optimizer(self, name: str, network: StackedEnsemble) -> torch.optim.Adam:
        """The optimiser of a stacked network, with the groups and the state of the members'."""
        first = self.members[0]
        leaf_of = {id(p): leaf for leaf, own in network.owners.items() for p in own}
        groups = [
            {**group, "params": list(dict.fromkeys(leaf_of[id(p)] for p in group["params"]))}
            for group in first.parameter_groups(first.networks[name])
        ]
        optimizer = adam(groups, first.options.lr)
        each = [member.optimizers[name] for member in self.members]
        rows: dict[torch.Tensor, list[Owner]] = {
            leaf: [(each[row * len(each) // len(own)], p) for row, p in enumerate(own)]
            for leaf, own in network.owners.items()
        }
        self._stacks.append(_Stack(optimizer, rows))
        return optimizer

    def _multiplier(self, name: str) -> Multiplier:
        own = [member.multipliers[name] for member in self.members]
        stacked = copy.copy(own[0])
        stacked.log = torch.stack([m.log.detach() for m in own]).requires_grad_()
        stacked.optimizer = adam([{"params": [stacked.log]}], self.members[0].options.alpha_lr)
        self._stacks.append(
            _Stack(stacked.optimizer, {stacked.log: [(m.optimizer, m.log) for m in own]})
        )
        return stacked

    def _target(self) -> Weights:
        """The target critics of all members, who see their part of them."""
        layers = zip(*(member.target for member in self.members), strict=True)
        stacked = [
            (torch.cat([w for w, _ in layer]), torch.cat([b for _, b in layer])) for layer in layers
        ]
        count = len(self.members)
        parts = [zip(w.chunk(count), b.chunk(count), strict=True) for w, b in stacked]
        for member, own in zip(self.members, zip(*parts, strict=True), strict=True):
            member.target = list(own)
        return stacked


class StackedEnsemble(Ensemble):
    """The ensembles of a team's members as one.

    Args:
        ensembles: of equal shape, one of each member.

    Attributes:
        owners: the parameters of the ensembles in each stacked parameter, first member first.
    """

    def __init__(self, ensembles: Sequence[Ensemble]):
        nn.Module.__init__(self)
        first = ensembles[0]
        self.width, self.layer_norm = first.width, first.layer_norm
        self.activation = first.activation
        self._expanded: Weights | None = None
        self._ensembles = list(ensembles)
        self._stacked: list[tuple[_DenseOf, dict[str, torch.Tensor]]] = []
        self.owners: dict[torch.Tensor, list[nn.Parameter]] = {}
        members = [member for ensemble in ensembles for member in ensemble.members]
        for layers in zip(*members, strict=True):
            leaves: dict[str, torch.Tensor] = {}
            for name, _ in layers[0].named_parameters():
                own = [layer.get_parameter(name) for layer in layers]
                leaves[name] = leaf = nn.Parameter(torch.stack([p.detach() for p in own]))
                self.owners[leaf] = own
            self._stacked.append((_DenseOf(layers[0]), leaves))

    def changed(self) -> None:
        super().changed()
        for ensemble in self._ensembles:
            ensemble.changed()

    def layers(self) -> Iterator[tuple[nn.Module, dict[str, torch.Tensor]]]:
        for layer, leaves in self._stacked:
            yield layer.layer, leaves

    def apply_weights(self, weights: Weights, x: torch.Tensor) -> torch.Tensor:
        """``[runs, B, in] -> [runs, members, B, out]``."""
        runs = len(self._ensembles)
        size = len(weights[0][0]) // runs
        inputs = x.unsqueeze(1).expand(runs, size, *x.shape[1:]).flatten(0, 1)
        return self.propagate(weights, inputs).unflatten(0, (runs, size))

    def _expand(self) -> Weights:
        found: Weights = []
        for layer, leaves in self._stacked:
            if isinstance(layer.layer, Dense):
                matrix, bias = leaves["weight"], leaves["bias"]
            else:
                matrix, bias = torch.vmap(layer.expand)(leaves)
            found.append((matrix, bias.unsqueeze(1)))
        return found


class _DenseOf(nn.Module):
    """A layer's dense matrix as a function of its parameters."""

    def __init__(self, layer: nn.Module):
        super().__init__()
        self.layer = layer

    def forward(self) -> tuple[torch.Tensor, torch.Tensor]:
        return dense(self.layer)

    def expand(self, parameters: dict[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        return functional_call(self, {f"layer.{k}": p for k, p in parameters.items()}, ())


class _Stack:
    """Stacked parameters with their optimiser, and the members' parameters that they hold.

    Args:
        optimizer: of the stacked parameters.
        owners: of each stacked parameter, row by row.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, owners: dict[torch.Tensor, list[Owner]]):
        self.optimizer, self.owners = optimizer, owners
        for leaf, rows in owners.items():
            for row, (_, parameter) in enumerate(rows):
                parameter.data = leaf.data[row]
            states = [own.state[parameter] for own, parameter in rows if parameter in own.state]
            if states:
                optimizer.state[leaf] = {
                    name: value.clone()
                    if name == "step"
                    else torch.stack([state[name] for state in states])
                    for name, value in states[0].items()
                }

    def scatter(self) -> None:
        """Write the state of the optimiser to those of the members."""
        for leaf, rows in self.owners.items():
            state = self.optimizer.state.get(leaf, {})
            for row, (own, parameter) in enumerate(rows):
                own.state[parameter] = {
                    name: (value if name == "step" else value[row]).clone()
                    for name, value in state.items()
                }

    def separate(self) -> None:
        """Give the members' parameters memory of their own."""
        for rows in self.owners.values():
            for _, parameter in rows:
                parameter.data = parameter.data.clone()


def _each(functions: Sequence[Callable[..., torch.Tensor]]) -> Callable[..., torch.Tensor]:
    """Apply each function to its part of the stacked arguments, and stack the results."""

    def call(*arguments: torch.Tensor) -> torch.Tensor:
        parts = zip(*arguments, strict=True)
        return torch.stack([f(*part) for f, part in zip(functions, parts, strict=True)])

    return call
