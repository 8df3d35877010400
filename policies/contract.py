"""What every base policy offers: its options, training, decoding and identity.

A new policy is one file with a class that inherits from :class:`ChunkPolicy`, and one line in the
registry ``symsteer.policies.POLICIES`` (or an entry point ``symsteer.policies`` of another
package). The run loop, the agents and the file format use nothing beyond this module.
"""

from __future__ import annotations

import abc
import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Self, TypeAlias

import torch
from pydantic import Field, TypeAdapter
from torch import nn

from symsteer.errors import UserError
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.normalizer import Normalizer, clip_blocks

Episode: TypeAlias = tuple[torch.Tensor, torch.Tensor]
"""Observations ``[T + 1, obs_dim]`` and actions ``[T, act_dim]``, environment units."""

Progress: TypeAlias = Callable[[int, int, float], None]
"""Called as ``progress(step, steps, loss)``."""

OBSERVATION_RADIUS = 3.0
"""Blocks of a normalised observation are shortened to this length. Numbers three times outside
of the demonstrated range carry no information and would blow up the network's output."""


@dataclass(frozen=True)
class PolicyOptions:
    """What every base policy can be told. A policy inherits from it and adds its own fields.

    Each field becomes an option ``--policy.FIELD`` of ``symsteer run`` with the docstring below
    it as help. Types are numbers, flags, texts, ``Literal`` and tuples of them.

    Raises:
        UserError: if a value is out of range.
    """

    IN_USE: ClassVar[tuple[str, ...]] = ()
    """Options that training does not depend on: a trained policy can be used with others."""

    horizon: Annotated[int, Field(le=1000)] = 8
    """Tp: actions in a chunk."""
    execute: int = 4
    """Ta: actions executed before the next decision."""
    hold: tuple[str, ...] = ("gripper",)
    """Action fields that keep their last value where a chunk runs past the end of its episode;
    all other fields are zero there (no motion)."""

    def __post_init__(self) -> None:
        self.require_positive("horizon", "execute")
        if self.execute > self.horizon:
            raise UserError(
                f"a chunk of {self.horizon} actions cannot execute {self.execute}; "
                "choose execute <= horizon"
            )

    def on(self, task: str) -> Self:
        """The same in a run on a task, with what depends on the task filled in."""
        return self

    def trained(self) -> Self:
        """The same with the defaults of the options ``IN_USE``."""
        fields = dataclasses.fields(self)
        defaults: dict[str, Any] = {f.name: f.default for f in fields if f.name in self.IN_USE}
        return dataclasses.replace(self, **defaults)

    def require_positive(self, *fields: str) -> None:
        """Raise a UserError if one of these fields is less than 1."""
        for field in fields:
            if getattr(self, field) < 1:
                raise UserError(
                    f"{field} of a base policy must be at least 1, not {getattr(self, field)}"
                )

    def to_json(self) -> dict[str, Any]:
        """Plain data; :meth:`from_json` reads it."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Rebuild options; missing fields get their defaults.

        Raises:
            UserError: if a value is out of range.
            ValueError: if it has another type, or a field is unknown.
        """
        if unknown := data.keys() - {field.name for field in dataclasses.fields(cls)}:
            raise ValueError(f"there is no option {min(unknown)!r}")
        # As JSON: strict mode then accepts 1 for 1.0 and lists for tuples.
        return TypeAdapter(cls).validate_json(json.dumps(data, allow_nan=False), strict=True)


class ChunkPolicy(nn.Module, abc.ABC):
    """A frozen, deterministic decoder from (observation, noise) to a chunk of actions.

    It commutes with its group up to rounding: decode(g s, g w) = g decode(s, w), normalisers and
    bounds included. All that decides what :meth:`decode` returns is in the options, the layouts
    and the module's state dict: the constructor and ``load_state_dict`` rebuild a saved policy.

    Args:
        options: of the class's own ``Options``.
        obs_layout: geometry of one observation.
        act_layout: geometry of one action.

    Attributes:
        task_layout: geometry of one observation of the task.
        obs_layout: the same as :meth:`see` makes it, which is what all other methods and agents
            take.
        group: the finite group that the policy keeps exactly; C1, unless a subclass sets another.
        obs_normalizer, act_normalizer: statistics of the demonstrations; at first identities.
        training_record: what training reports (losses, seconds, ...), JSON-ready.
        report: what is measured later (steerability), JSON-ready; saved with the policy.
    """

    name: ClassVar[str]
    """As in the registry; it is shown in records and tables."""
    Options: ClassVar[type[PolicyOptions]] = PolicyOptions
    """The dataclass of the policy's options."""

    def __init__(self, options: PolicyOptions, obs_layout: Layout, act_layout: Layout):
        super().__init__()
        self.options = options
        self.task_layout = self.obs_layout = obs_layout
        self.act_layout = act_layout
        self.group = Group.parse("C1")
        self.obs_normalizer, self.act_normalizer = Normalizer(obs_layout), Normalizer(act_layout)
        self.training_record: dict[str, Any] = {}
        self.report: dict[str, Any] = {}

    @classmethod
    @abc.abstractmethod
    def fit(
        cls,
        options: Any,
        episodes: Sequence[Episode],
        obs_layout: Layout,
        act_layout: Layout,
        seed: int = 0,
        progress: Progress | None = None,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Train a policy on demonstrations.

        On the CPU the result must depend on the arguments and the number of threads alone.
        (The name ``train`` is taken by ``nn.Module``.)

        Args:
            options: an instance of ``cls.Options``.
            episodes: pairs ``(obs [T + 1, obs_dim], actions [T, act_dim])``, environment units.
            obs_layout: geometry of an observation.
            act_layout: geometry of an action.
            seed: of every random draw.
            progress: called now and then as ``progress(step, steps, loss)``.
            device: where to train; the policy stays there.

        Returns:
            The frozen policy (see :meth:`freeze`) with its ``training_record``.

        Raises:
            UserError: if there are no episodes or their shapes do not fit the layouts.
        """

    def see(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations ``[B, task_layout.dim]`` of the task as ``[B, obs_layout.dim]``.

        A policy with an encoder of clouds or pictures puts what it tells in their place. Once for
        each decision; agents and replay know the result alone.
        """
        return obs

    @abc.abstractmethod
    def decode(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Turn noise into actions.

        Args:
            obs: ``[B, obs_dim]``, environment units.
            noise: ``[B, Tp, act_dim]``; standard normal noise gives the base policy.

        Returns:
            ``[B, Tp, act_dim]``, environment actions: every irrep block of norm at most 1.
        """

    @classmethod
    def check(cls, options: Any, obs_layout: Layout) -> None:
        """Check that it can be trained on such observations, before anything is built.

        Raises:
            UserError: if not; the message says what to change.
        """

    @classmethod
    def bounded_layout(cls, layout: Layout) -> Layout:
        """Says what has one norm and one scale in a vector of this layout: its irrep blocks."""
        return layout

    def bounded(self, actions: torch.Tensor) -> torch.Tensor:
        """Actions ``[..., act_dim]``, every block shortened to norm 1 at most."""
        return clip_blocks(actions, self.bounded_layout(self.act_layout), 1.0)

    @property
    def horizon(self) -> int:
        """Tp: actions in a chunk."""
        return self.options.horizon

    @property
    def execute(self) -> int:
        """Ta: actions executed before the next decision."""
        return self.options.execute

    @property
    def device(self) -> torch.device:
        """Where the policy is."""
        return self.act_normalizer.scale.device

    @property
    def noise_layout(self) -> Layout:
        """Geometry of one flattened noise chunk, ``[Tp * act_dim]``."""
        return self.act_layout.repeat(self.horizon)

    def normalized_observation(self, obs: torch.Tensor) -> torch.Tensor:
        """What networks see of ``obs [..., obs_dim]``: unit size, blocks of bounded length."""
        layout = self.bounded_layout(self.obs_layout)
        return clip_blocks(self.obs_normalizer.normalize(obs), layout, OBSERVATION_RADIUS)

    def observation_for_agents(self, obs: torch.Tensor) -> torch.Tensor:
        """What the networks of agents see of ``obs [..., obs_dim]``: unit size, too.

        It differs where the policy's own networks were trained with another scale.
        """
        return self.normalized_observation(obs)

    def used_with(self, options: PolicyOptions) -> Self:
        """The policy with the options ``IN_USE`` of others, unmeasured; itself if it has them."""
        own = dataclasses.replace(
            self.options, **{name: getattr(options, name) for name in self.options.IN_USE}
        )
        if own == self.options:
            return self
        policy = type(self)(own, self.task_layout, self.act_layout).to(self.device)
        policy.load_state_dict(self.state_dict())
        policy.training_record = dict(self.training_record)
        policy.report = {key: value for key, value in self.report.items() if key == "world"}
        return policy.freeze()

    def freeze(self) -> Self:
        """Evaluation mode, no gradients. To be called after every change of the weights."""
        return self.eval().requires_grad_(False)

    def parameter_count(self) -> int:
        """Numbers in the networks."""
        return sum(p.numel() for p in self.parameters())

    def decode_settings(self) -> dict[str, Any]:
        """What decides the result of :meth:`decode` beside layouts and tensors, JSON-ready."""
        return {"policy": self.name, **self.options.to_json()}

    def content_hash(self) -> str:
        """SHA-256 of all that decides what :meth:`decode` returns, as hexadecimal digits."""
        digest = hashlib.sha256()
        shape = {
            "obs_layout": self.obs_layout.to_json(),
            "act_layout": self.act_layout.to_json(),
            **self.decode_settings(),
        }
        digest.update(json.dumps(shape, sort_keys=True).encode())
        for key, tensor in sorted(self.state_dict().items()):
            digest.update(f"{key} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()
