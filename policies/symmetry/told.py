"""One policy for several tasks that is told in words what to do.

As in :mod:`~symsteer.policies.symmetry.joint`, but the embedding of a sentence tells the task
(:mod:`~symsteer.policies.words`), in place of a one-hot vector. A sentence does not turn with the
scene, so it scales and shifts all group elements alike: invariant FiLM, as in EquAct (arXiv
2505.21351).

In training, each batch calls every task by a sentence of its own, drawn anew. What
:meth:`~symsteer.policies.symmetry.joint.Joint.fit_tasks` returns for a task keeps the layers that
hear: with the option ``instruction`` the same weights follow another sentence.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from random import Random
from typing import Any, ClassVar, Self

import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.symmetry.joint import Joint, JointOptions, TaskDenoiser
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions
from symsteer.policies.training.denoising import DenoisingOptions
from symsteer.policies.words import SIZE, check_instruction, embedding, sentences


class ToldDenoiser(TaskDenoiser):
    """A lifted denoiser that is told in words what to do.

    Attributes:
        heard: embedding of the sentence for each task of a merged observation, ``[tasks, SIZE]``;
            of any other observation there is one. It is no part of the state dict.
    """

    heard: torch.Tensor

    def __init__(
        self, options: DenoisingOptions, obs_layout: Layout, act_layout: Layout, group: Group
    ):
        super().__init__(options, obs_layout, act_layout, group)
        self.register_buffer("heard", torch.zeros(max(1, self.tasks), SIZE), persistent=False)

    @property
    def told_size(self) -> int:
        """Numbers of a sentence."""
        return SIZE

    def told(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What is seen of an observation, and the sentence, ``[B or 1, SIZE]``."""
        seen, task = super().told(obs)
        # Normalised, a one-hot vector is still largest at its task.
        return seen, self.heard[task.argmax(dim=-1)] if self.tasks else self.heard

    def fold(self, state: dict[str, torch.Tensor], task: torch.Tensor) -> None:
        """Nothing: the policy of one task hears, too."""


@dataclass(frozen=True)
class ToldOptions(JointOptions, EquivariantOptions):
    """Options of the policy that is told in words what to do."""

    IN_USE: ClassVar[tuple[str, ...]] = ("instruction",)

    instruction: str = ""
    """What it is told to do; default: the first sentence of the task. It names no direction, since
    it must stay true when the scene is turned. Training does not depend on it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.instruction:
            check_instruction(self.instruction)

    def on(self, task: str) -> Self:
        """With all tasks, each of which needs sentences, and with an instruction."""
        tasks = {task, *self.tasks}
        first = {name: sentences(name)[0] for name in sorted(tasks)}
        told = self.instruction or first[task]
        return dataclasses.replace(self, tasks=tuple(tasks), instruction=told)


class ToldEquivariantPolicy(Joint, EquivariantDiffusionPolicy):
    """Equivariant Diffusion Policy for several tasks that is told in words what to do."""

    name = "edp-told"
    Options = ToldOptions
    options: ToldOptions
    denoiser: ToldDenoiser
    said = 0
    """Batches of the training until now."""

    def make_denoiser(self) -> ToldDenoiser:
        """The network of all tasks, or of one; both hear."""
        if self.eyes:
            raise UserError(
                f"the policy {self.name} takes no clouds or pictures; choose another policy"
            )
        group = Group.parse(self.options.group)
        return ToldDenoiser(self.options, self.obs_layout, self.chunk_layout, group)

    def hear(self, said: list[torch.Tensor]) -> None:
        """Let the network hear one sentence for each of its tasks."""
        self.denoiser.heard = torch.stack(said).to(self.act_normalizer.scale)

    def augment(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Say something else in every batch: for each task one of its sentences of the training."""
        if len(self.options.tasks) == len(self.denoiser.heard):
            # Not from the generator: batches shall be those of a policy with a one-hot vector.
            self.said += 1
            draw = Random(f"{generator.initial_seed()} {self.said}").choice
            self.hear([embedding(draw(sentences(task))) for task in self.options.tasks])
        return super().augment(obs, chunks, generator)

    def options_of(self, task: int) -> Any:
        """Options of the policy for one task, with the first sentence of the task."""
        first = sentences(self.options.tasks[task])[0]
        return dataclasses.replace(super().options_of(task), instruction=first)

    def freeze(self) -> Self:
        """Evaluation mode: hear the instruction, or of several tasks the first sentence of each."""
        said = [self.options.instruction]
        if self.denoiser.tasks:
            said = [sentences(task)[0] for task in self.options.tasks]
        self.hear([embedding(sentence) for sentence in said])
        return super().freeze()

    def decode_settings(self) -> dict[str, Any]:
        """With the instruction."""
        return {**super().decode_settings(), "instruction": self.options.instruction}
