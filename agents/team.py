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
from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import nn
from torch.func import functional_call

from symsteer.agents.networks import Dense, Ensemble, Weights, dense
from symsteer.agents.optimization import Adam
from symsteer.agents.replay import Batch
from symsteer.agents.sac import SacAgent


def can_join(agent_class: type) -> bool:
    """Whether agents of a class can be members of a team."""
    return issubclass(agent_class, SacAgent) and bool(vars(agent_class).get("in_teams"))


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
        stacked = {
            name: StackedEnsemble([member.networks[name] for member in members])
            for name in first.networks
        }
        core.networks = dict(stacked)
        stacks = {
            name: _Stack(network.owners, [member.optimizers[name] for member in members])
            for name, network in stacked.items()
        }
        core.optimizers = {name: stack.optimizer for name, stack in stacks.items()}
        self._stacks = list(stacks.values())
        core.multipliers = dict(first.multipliers)
        for name in first.multipliers:
            each = [member.multipliers[name] for member in members]
            core.multipliers[name] = multiplier = copy.copy(each[0])
            multiplier.log = torch.stack([m.log.detach() for m in each]).requires_grad_()
            stack = _Stack({multiplier.log: [m.log for m in each]}, [m.optimizer for m in each])
            multiplier.optimizer = stack.optimizer
            self._stacks.append(stack)
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
        turned = [m.augment(batch) for m, batch in zip(self.members, batches, strict=True)]
        stacked = Batch({name: torch.stack([b[name] for b in turned]) for name in turned[0]})
        self.core.decisions = self.members[0].decisions
        scalars = self.core.learn(stacked)
        for member in self.members:
            member.updates = self.core.updates
            member.distillation_owed = self.core.distillation_owed
        return [
            {name: value[i] for name, value in scalars.items()} | member.after_update(batch)
            for i, (member, batch) in enumerate(zip(self.members, turned, strict=True))
        ]

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


class StackedEnsemble(Ensemble):
    """The ensembles of a team's members as one.

    Args:
        ensembles: of equal shape, one of each member.

    Attributes:
        owners: the parameters of the ensembles in each stacked parameter, first member first.
    """

    def __init__(self, ensembles: Sequence[Ensemble]):
        nn.Module.__init__(self)
        self.width, self.layer_norm = ensembles[0].width, ensembles[0].layer_norm
        self.activation = ensembles[0].activation
        self._expanded: Weights | None = None
        self._ensembles = list(ensembles)
        self._stacked: list[tuple[_DenseOf, dict[str, torch.Tensor]]] = []
        self.owners: dict[torch.Tensor, list[torch.Tensor]] = {}
        members = [member for ensemble in ensembles for member in ensemble.members]
        for layers in zip(*members, strict=True):
            leaves: dict[str, torch.Tensor] = {}
            for name, _ in layers[0].named_parameters():
                each = [layer.get_parameter(name) for layer in layers]
                leaves[name] = leaf = nn.Parameter(torch.stack([p.detach() for p in each]))
                self.owners[leaf] = each
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
        expanded: Weights = []
        for layer, leaves in self._stacked:
            if isinstance(layer.layer, Dense):
                matrix, bias = leaves["weight"], leaves["bias"]
            else:
                matrix, bias = torch.vmap(layer.expand)(leaves)
            expanded.append((matrix, bias.unsqueeze(1)))
        return expanded


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
        owners: the members' parameters in each stacked one, row by row.
        optimizers: of the members.
    """

    def __init__(
        self, owners: Mapping[torch.Tensor, Sequence[torch.Tensor]], optimizers: Sequence[Adam]
    ):
        self.optimizer = Adam(owners, optimizers[0].defaults["lr"])
        # Of each row the member's parameter and its optimiser.
        self.rows = {
            leaf: [(p, optimizers[i * len(optimizers) // len(each)]) for i, p in enumerate(each)]
            for leaf, each in owners.items()
        }
        for leaf, rows in self.rows.items():
            for row, (parameter, _) in enumerate(rows):
                parameter.data = leaf.data[row]
            states = [adam.state[parameter] for parameter, adam in rows if parameter in adam.state]
            if states:
                self.optimizer.state[leaf] = {
                    name: value.clone()
                    if name == "step"
                    else torch.stack([state[name] for state in states])
                    for name, value in states[0].items()
                }

    def scatter(self) -> None:
        """Write the state of the optimiser to those of the members."""
        for leaf, state in self.optimizer.state.items():
            for row, (parameter, adam) in enumerate(self.rows[leaf]):
                adam.state[parameter] = {
                    name: (value if name == "step" else value[row]).clone()
                    for name, value in state.items()
                }

    def separate(self) -> None:
        """Give the members' parameters memory of their own."""
        for rows in self.rows.values():
            for parameter, _ in rows:
                parameter.data = parameter.data.clone()


def _each(functions: Sequence[Callable[..., torch.Tensor]]) -> Callable[..., torch.Tensor]:
    """Apply each function to its part of the stacked arguments, and stack the results."""

    def call(*arguments: torch.Tensor) -> torch.Tensor:
        each = zip(functions, *arguments, strict=True)
        return torch.stack([function(*given) for function, *given in each])

    return call
