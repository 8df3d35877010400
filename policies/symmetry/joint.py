"""One policy for several tasks, told apart by scales and shifts that are invariant.

The observations of the tasks are merged: fields of the same name are one field, and those that a
task lacks are 0. Beside them the network sees which task it is, a one-hot vector, in two places:
it scales and shifts each regular field of the observation's embedding, and the hidden features of
the chunk. Scales and shifts are the same for all group elements: a shift moves the invariant part
of a field alone, a scale multiplies all its parts. So the network commutes with the group as before
(invariant FiLM, as in EquAct, arXiv 2505.21351).

For one task the embedding is constant, and so are the fields that the task lacks: both become a
part of the weights. So what :meth:`Joint.fit_tasks` returns for a task is an ordinary policy on
the task's own observations, with a file of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError
from symsteer.policies.contract import Episode, Progress
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.symmetry.lifted import (
    EquivariantDiffusionPolicy,
    EquivariantOptions,
    LiftedDenoiser,
)
from symsteer.policies.symmetry.unconstrained import PlainDiffusionPolicy, PlainOptions
from symsteer.policies.training.denoising import DenoisingOptions, DiffusionPolicy

TASK = "task"
"""The field of a merged observation that says which task it is of, one scalar for each."""


def merged_layout(layouts: Mapping[str, Layout]) -> Layout:
    """The fields of all tasks, each once, and ``task``.

    Args:
        layouts: observation layouts by task.

    Raises:
        UserError: if a field has another kind in another task, or a task shows a picture or points.
    """
    fields: dict[str, Field] = {}
    for task, layout in layouts.items():
        if layout.is_seen:
            shown = "cloud of points" if layout.cloud else "picture"
            raise UserError(
                f"{task} shows a {shown}, which has no place in a policy for several tasks; train "
                "another one, such as edp, for each task"
            )
        for field in layout.fields:
            if fields.setdefault(field.name, field) != field:
                raise UserError(
                    f"the field {field.name!r} of {task} has another geometry than that of the "
                    "other tasks; these tasks cannot share a policy"
                )
    return Layout([*fields.values(), Field(TASK, 0, multiplicity=len(layouts))])


def columns_of(layout: Layout, merged: Layout) -> torch.Tensor:
    """Where the numbers of a task's observation are in the merged one, ``[layout.dim]`` int64."""
    index = torch.arange(merged.dim)
    return torch.cat([index[merged.slice(field.name)] for field in layout.fields])


def merged_observation(
    obs: torch.Tensor, layout: Layout, merged: Layout, task: int
) -> torch.Tensor:
    """Observations ``[..., layout.dim]`` of a task as merged ones ``[..., merged.dim]``."""
    out = obs.new_zeros(*obs.shape[:-1], merged.dim)
    out[..., columns_of(layout, merged).to(obs.device)] = obs
    out[..., merged.slice(TASK).start + task] = 1
    return out


class TaskDenoiser(LiftedDenoiser):
    """A lifted denoiser of several tasks.

    Its arguments are those of the denoiser of one task; the observation is a merged one.
    """

    def __init__(
        self, options: DenoisingOptions, obs_layout: Layout, act_layout: Layout, group: Group
    ):
        *seen, last = obs_layout.fields
        self.tasks = last.multiplicity if last.name == TASK else 0
        super().__init__(options, Layout(seen) if self.tasks else obs_layout, act_layout, group)
        channels, films = self.condition.in_features, self.condition.out_features
        self.task_in = nn.Linear(self.told_size, 2 * channels, bias=False)
        self.task_condition = nn.Linear(self.told_size, films, bias=False)
        for layer in (self.task_in, self.task_condition):
            nn.init.zeros_(layer.weight)

    @property
    def told_size(self) -> int:
        """Numbers that tell the task."""
        return self.tasks

    def told(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """What is seen of an observation, and what tells the task, ``[B or 1, told_size]``."""
        seen, task = obs.split([obs.shape[-1] - self.tasks, self.tasks], dim=-1)
        return seen, task

    def embed(self, obs: torch.Tensor) -> torch.Tensor:
        """Embedding of an observation; ``[B, obs_dim] -> [B, order, channels]``."""
        seen, task = self.told(obs)
        scale, shift = self.task_in(task)[:, None].chunk(2, dim=-1)
        return self.obs_mix(functional.silu(self.obs_lift(seen) * (1 + scale) + shift))

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """What the network sees of it; ``[B, obs_dim] -> [B, order, condition]``."""
        return super().encode(obs) + self.task_condition(self.told(obs)[1])[:, None]

    def weights_of_task(
        self, columns: torch.Tensor, blank: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The state dict of a denoiser of one task, which predicts the same.

        Args:
            columns: where the task's observation is in the merged one.
            blank: a normalised merged observation ``[obs_dim]`` with the task and the values of
                the fields that it lacks. They are 0 but for invariants, which have an offset.
        """
        state = {key: value.double() for key, value in self.state_dict().items()}
        known, task = blank.double().split([len(blank) - self.tasks, self.tasks])
        weight = state["obs_lift.weight"]
        state["obs_lift.weight"] = weight[:, columns]
        state["obs_lift.bias"] = state["obs_lift.bias"] + weight @ known.index_fill(0, columns, 0.0)
        self.fold(state, task)
        return {key: value.to(blank.dtype) for key, value in state.items()}

    def fold(self, state: dict[str, torch.Tensor], task: torch.Tensor) -> None:
        """Make what tells the task, ``[tasks]``, a part of the weights of one task, in place."""
        scale, shift = (state.pop("task_in.weight") @ task).chunk(2)
        state["obs_lift.weight"] = (1 + scale)[:, None] * state["obs_lift.weight"]
        state["obs_lift.bias"] = (1 + scale) * state["obs_lift.bias"] + shift
        state["condition.bias"] = (
            state["condition.bias"] + state.pop("task_condition.weight") @ task
        )


@dataclass(frozen=True)
class JointOptions(DenoisingOptions):
    """Options of policies for several tasks."""

    tasks: tuple[str, ...] = ()
    """Tasks whose demonstrations it is trained on, with those of the run's task; the gradient steps
    are for each of them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "tasks", tuple(sorted(set(self.tasks))))

    def on(self, task: str) -> Self:
        """With all tasks, so that runs on each of them ask for the same base policy."""
        tasks = {task, *self.tasks}
        return dataclasses.replace(self, tasks=tuple(tasks)) if len(tasks) > 1 else self


class Joint(DiffusionPolicy):
    """Mixin of policies that are trained on several tasks; list it before the policy's class.

    On a merged observation it has the network of all tasks, on any other one that of its class.
    """

    options: Any

    @classmethod
    def check(cls, options: Any, obs_layout: Layout) -> None:
        """Nothing is shown to it, not even of one task; see :meth:`ChunkPolicy.check`."""
        merged_layout({"the task": obs_layout})

    def make_denoiser(self) -> LiftedDenoiser:
        """The network of all tasks, or of one."""
        if self.obs_layout.fields[-1].name != TASK:
            return super().make_denoiser()  # type: ignore[safe-super, return-value]
        group = Group.parse(self.options.group)
        return TaskDenoiser(self.options, self.obs_layout, self.chunk_layout, group)

    @classmethod
    def fit_tasks(
        cls,
        options: Any,
        demonstrations: Mapping[str, tuple[Sequence[Episode], Layout]],
        act_layout: Layout,
        seed: int = 0,
        progress: Progress | None = None,
        device: torch.device | str = "cpu",
    ) -> dict[str, Self]:
        """Train one network on several tasks; see :meth:`ChunkPolicy.fit`.

        Args:
            options: with the gradient steps for each task.
            demonstrations: episodes and observation layout of each task.
            act_layout: of the actions of all tasks.
            seed, progress, device: as for :meth:`ChunkPolicy.fit`.

        Returns:
            A policy for each task, on the task's own observations.

        Raises:
            UserError: as :meth:`ChunkPolicy.fit`, and if the observations cannot be merged.
        """
        names = sorted(demonstrations)
        layouts = {name: demonstrations[name][1] for name in names}
        merged = merged_layout(layouts)
        episodes = [
            (merged_observation(obs, layouts[name], merged, i), actions)
            for i, name in enumerate(names)
            for obs, actions in demonstrations[name][0]
        ]
        options = dataclasses.replace(options, tasks=tuple(names), steps=len(names) * options.steps)
        whole = cls.fit(options, episodes, merged, act_layout, seed, progress, device)
        return {name: whole.of_task(i, layouts[name]) for i, name in enumerate(names)}

    def options_of(self, task: int) -> Any:
        """Options of the policy for one task, as they were asked for."""
        options = self.options
        return dataclasses.replace(options, steps=options.steps // len(options.tasks))

    def of_task(self, task: int, obs_layout: Layout) -> Self:
        """The policy for one task, with the embedding in its weights.

        Args:
            task: its place in ``options.tasks``.
            obs_layout: of the task's own observations.
        """
        merged, statistics = self.obs_layout, self.obs_normalizer
        columns = columns_of(obs_layout, merged).to(self.device)
        blank = merged_observation(
            statistics.scale.new_zeros(obs_layout.dim), obs_layout, merged, task
        )
        policy = type(self)(self.options_of(task), obs_layout, self.act_layout).to(self.device)
        policy.obs_normalizer.load_state_dict(
            {name: value[columns] for name, value in statistics.state_dict().items()}
        )
        policy.act_normalizer.load_state_dict(self.act_normalizer.state_dict())
        assert isinstance(self.denoiser, TaskDenoiser)
        policy.denoiser.load_state_dict(
            self.denoiser.weights_of_task(columns, self.normalized_observation(blank))
        )
        policy.training_record = dict(self.training_record)
        return policy.freeze()


@dataclass(frozen=True)
class JointEquivariantOptions(JointOptions, EquivariantOptions):
    """Options of the equivariant policy for several tasks."""


class JointEquivariantPolicy(Joint, EquivariantDiffusionPolicy):
    """Equivariant Diffusion Policy that is trained on several tasks together."""

    name = "edp-joint"
    Options = JointEquivariantOptions
    options: JointEquivariantOptions


@dataclass(frozen=True)
class JointPlainOptions(JointOptions, PlainOptions):
    """Options of the plain policy for several tasks."""


class JointPlainPolicy(Joint, PlainDiffusionPolicy):
    """Plain diffusion policy that is trained on several tasks together."""

    name = "plain-joint"
    Options = JointPlainOptions
    options: JointPlainOptions
