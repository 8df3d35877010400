"""Updates as CUDA graphs: one launch in place of some hundreds.

An update of these small networks is bound by the time to launch its kernels. A graph launches those
that it has seen once, with the same sizes and addresses. So what it contains must neither wait for
the device nor branch on data: the batch is drawn inside, from as many rows as a number on the
device says, and what the processor decides (how many distillations) selects the graph.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol, TypeAlias, TypeVar

import torch

from symsteer.agents.networks import Ensemble
from symsteer.agents.replay import Batch, ReplayBuffer
from symsteer.terminal import tell

WARM_UPS = 3
"""Repetitions before a capture, in which libraries and caches allocate what they need."""


class Learner(Protocol):
    """What is captured: a learner, or the core of a team."""

    @property
    def networks(self) -> Mapping[str, Ensemble]:
        """Their cached matrices are dropped."""

    def tensors(self) -> list[torch.Tensor]:
        """All that an update changes."""

    def learn(self, batch: Batch, distillations: int) -> dict[str, torch.Tensor]:
        """The update."""


T = TypeVar("T")

Captured: TypeAlias = tuple[torch.cuda.CUDAGraph, list[str], torch.Tensor]
"""A graph, and the names and values of its scalars."""


def record(
    compute: Callable[[], T], generators: Sequence[torch.Generator]
) -> tuple[torch.cuda.CUDAGraph, T]:
    """A computation as a graph, after some repetitions, and its result, which replays fill anew."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(WARM_UPS):
            compute()
    torch.cuda.current_stream().wait_stream(side)
    gc.collect()
    graph = torch.cuda.CUDAGraph()
    for generator in generators:
        graph.register_generator_state(generator)
    # A capture that fails leaves its stream behind.
    with torch.cuda.stream(torch.cuda.current_stream()), torch.cuda.graph(graph):
        result = compute()
    return graph, result


class GraphedUpdates:
    """Makes updates of a learner or a team, each with one launch.

    Args:
        learner: what is updated.
        draw: a batch for the update; its numbers are drawn by ``generators``.
        replays: what ``draw`` draws from.
        generators: all that an update uses.
    """

    def __init__(
        self,
        learner: Learner,
        draw: Callable[[], Batch],
        replays: Sequence[ReplayBuffer],
        generators: Sequence[torch.Generator],
    ):
        self.learner, self.draw = learner, draw
        self.replays, self.generators = replays, generators
        self.graphs: dict[int, Captured | None] = {}
        self.addresses: list[int] = []

    def update(self, distillations: int) -> dict[str, torch.Tensor]:
        """One update with a number of distillations; its scalars."""
        addresses = [replay.rows.data_ptr() for replay in self.replays]
        if addresses != self.addresses:  # a replay has grown
            self.graphs, self.addresses = {}, addresses
        if distillations not in self.graphs:
            impossible = None in self.graphs.values()
            self.graphs[distillations] = None if impossible else self._capture(distillations)
        captured = self.graphs[distillations]
        if captured is None:
            return self.learner.learn(self.draw(), distillations)
        graph, names, values = captured
        graph.replay()
        self._forget()
        return dict(zip(names, values.clone().unbind(), strict=True))

    def _capture(self, distillations: int) -> Captured | None:
        """Record an update; afterwards everything is as before.

        None if it cannot be recorded: a base policy of another package may wait for the device.
        """
        # Clones of tensors with gradient would keep a node of theirs, and with it a stream, alive.
        before = [(tensor, tensor.detach().clone()) for tensor in self.learner.tensors()]
        states = [generator.get_state() for generator in self.generators]

        def compute() -> tuple[list[str], torch.Tensor]:
            self._forget()
            scalars = self.learner.learn(self.draw(), distillations)
            return [*scalars], torch.stack([*scalars.values()])

        try:
            graph, (names, values) = record(compute, self.generators)
            captured: Captured | None = (graph, names, values)
        except RuntimeError as error:
            captured = None
            why = str(error).splitlines()[0]
            tell(f"updates are not CUDA graphs here, and take some ten times as long: {why}")
        self._forget()
        with torch.no_grad():
            for tensor, value in before:
                tensor.copy_(value)
        for generator, state in zip(self.generators, states, strict=True):
            generator.set_state(state)
        return captured

    def _forget(self) -> None:
        """Drop matrices that were computed inside a graph, or outside of it."""
        for network in self.learner.networks.values():
            network.changed()
