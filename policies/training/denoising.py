"""Training by denoising, decoding by DDIM: what all diffusion policies share.

A subclass says in :meth:`DiffusionPolicy.make_denoiser` which network predicts the clean chunk,
and may change the training batches in :meth:`DiffusionPolicy.augment`. Options of all of them:

- ``process``: diffusion or flow matching (:mod:`~symsteer.policies.training.diffusion`);
- ``orbit_targets`` (:mod:`~symsteer.policies.training.orbit`);
- ``action_frame``: noise and chunk are seen from a frame that the observation has.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import torch
from pydantic import Field
from torch import nn

from symsteer.errors import UserError
from symsteer.names import check
from symsteer.policies.contract import OBSERVATION_RADIUS
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.denoiser import Denoiser
from symsteer.policies.networks.in_hand import HandEncoder
from symsteer.policies.networks.keypoints import KeypointEncoder
from symsteer.policies.networks.pictures import PictureEncoder
from symsteer.policies.networks.points import CloudEncoder
from symsteer.policies.normalizer import Normalizer, clip_blocks
from symsteer.policies.training.diffusion import Diffusion, Prediction, Process
from symsteer.policies.training.frames import Frame
from symsteer.policies.training.gradient import GradientOptions, GradientPolicy
from symsteer.policies.training.orbit import orbit_targets

Network = Literal["mlp", "unet"]

DECODE_FIELDS = (
    *("group", "network", "channels", "width", "depth", "horizon", "execute"),
    *("diffusion_steps", "sampling_steps", "prediction"),
)
"""Options that a trained policy's behaviour depends on."""

LATER_FIELDS = {"process": "diffusion", "action_frame": ""}
"""The same, of policies that have another value than this one, which earlier versions had."""

SMALLEST_TOLD = 1e-3
"""A smaller half-range of what an encoder tells, in its unit sizes, counts as constant."""

Expanded = tuple[Denoiser, Sequence[torch.Tensor], KeypointEncoder | None]
"""Ready for inference: the denoiser, what it sees of each noise level, and the encoder."""


@dataclass(frozen=True)
class DenoisingOptions(GradientOptions):
    """Options of all diffusion policies."""

    network: Network = "mlp"
    """The network inside: residual MLP on the flattened chunk, or temporal U-Net."""
    channels: int = 64
    """Features of the observation embedding per group element."""
    width: int = 64
    """Features of the chunk per group element."""
    depth: int = 3
    """Residual blocks of the MLP."""
    zero_output: bool = False
    """Start the network's output layer at 0 instead of with random weights."""
    diffusion_steps: Annotated[int, Field(le=10_000)] = 100
    """K: noise levels in training."""
    sampling_steps: int = 2
    """DDIM steps of the sampler."""
    process: Process = "diffusion"
    """How chunks become noise: diffusion, or the straight paths of flow matching (flow)."""
    prediction: Prediction = "sample"
    """What the network predicts: the clean chunk (sample), the noise (epsilon; diffusion only) or
    noise minus chunk (velocity; flow only)."""
    snr_cap: float = 5.0
    """Largest weight of a noise level in the loss of sample prediction (Min-SNR); larger values
    spread the actions more over the noise, values of 0.05 or less weigh all levels alike."""
    observation_noise: float = 0.0
    """Standard deviation of the noise on normalised observations in training."""
    orbit_targets: bool = False
    """Train towards the mean of what a noisy chunk may come from: all turned copies of observation
    and chunk, weighted by their probability. Needs a group and observation_noise."""
    action_frame: str = ""
    """A vector of the observation, e.g. tcp_x_axis: noise and chunk are turned into the frame where
    it points along x (relative actions). Default: the world's frame."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("channels", "width", "depth")
        check("network", [self.network], get_args(Network))
        if self.network == "unet" and self.horizon % 2:
            raise UserError(
                f"the unet halves the chunk; choose an even horizon, not {self.horizon}"
            )
        if self.observation_noise < 0:
            raise UserError(
                f"observation_noise is {self.observation_noise}; it must not be negative"
            )
        if self.orbit_targets and not self.observation_noise:
            raise UserError(
                "orbit_targets need observation_noise above 0, e.g. 1: an observation that is "
                "known exactly tells which turned copy it belongs to"
            )
        self.diffusion.timesteps(self.sampling_steps)

    @property
    def diffusion(self) -> Diffusion:
        """The process that these options describe."""
        return Diffusion(self.diffusion_steps, self.prediction, self.snr_cap, self.process)

    def resolved(self, obs_layout: Layout, act_layout: Layout) -> Self:
        """Options in which everything that depends on the layouts is filled in."""
        return self


class DiffusionPolicy(GradientPolicy):
    """A diffusion policy: the denoiser of a subclass, trained and sampled in the same way.

    Args:
        options: as given or resolved; ``self.options`` are the resolved ones.

    Raises:
        UserError: if an option is out of range.
    """

    Options = DenoisingOptions
    options: Any
    hand_encoder: ClassVar[type[HandEncoder]] = HandEncoder

    def __init__(self, options: DenoisingOptions, obs_layout: Layout, act_layout: Layout):
        eyes = self.make_eyes(options, obs_layout)
        seen_layout = obs_layout if eyes is None else eyes.layout
        options = options.resolved(seen_layout, act_layout)
        super().__init__(options, seen_layout, act_layout)
        self.task_layout, self.eyes = obs_layout, eyes
        if eyes is not None:
            self.agent_normalizer = Normalizer(self.bounded_layout(seen_layout))
        self.diffusion = options.diffusion
        self.frame = Frame(options.action_frame, self.obs_layout, act_layout)
        self.denoiser = self.make_denoiser()
        self.group = self.denoiser.group
        if options.zero_output:
            self._zero_output()
        if options.orbit_targets and self.data_group.order == 1:
            raise UserError(
                f"orbit_targets need a group, and the network of {self.name} has none; leave them "
                "out, or choose another policy"
            )
        self._expanded: Expanded | None = None
        self.freeze()

    def _zero_output(self) -> None:
        layers = self.denoiser.output_layers()
        if not layers:
            raise UserError(
                f"zero_output needs to know the output layer, and the network of {self.name} does "
                "not tell it; define its output_layers, or leave zero_output out"
            )
        for layer in layers:
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)

    @abc.abstractmethod
    def make_denoiser(self) -> Denoiser:
        """The network, untrained; it may read ``self.options`` and the layouts."""

    @classmethod
    def check(cls, options: Any, obs_layout: Layout) -> None:
        """Clouds and pictures need an encoder; see :meth:`ChunkPolicy.check`."""
        with torch.random.fork_rng(devices=[]):
            cls.make_eyes(options, obs_layout)

    @classmethod
    def make_eyes(cls, options: Any, obs_layout: Layout) -> KeypointEncoder | None:
        """The encoder of the cloud or picture, untrained, if there is one."""
        if obs_layout.cloud is not None:
            return CloudEncoder(obs_layout.cloud, cls.picture_group(options))
        picture = obs_layout.picture
        if picture is None:
            return None
        if picture.in_hand:
            return cls.hand_encoder(picture, cls.hand_group(options))
        return PictureEncoder(picture, cls.picture_group(options))

    @classmethod
    def hand_group(cls, options: Any) -> Group:
        """Group of the encoder of pictures from the hand."""
        return cls.picture_group(options)

    @classmethod
    def picture_group(cls, options: Any) -> Group:
        """Group of the encoder of clouds and of pictures from above.

        Raises:
            UserError: if the policy has none.
        """
        raise UserError(
            f"the policy {cls.name} has no encoder of what these cameras see; choose one that has: "
            "edp, escnn, plain or plain-augmented"
        )

    @property
    def chunk_layout(self) -> Layout:
        """Geometry of an action as the network sees it."""
        return self.frame.layout

    @property
    def data_group(self) -> Group:
        """Symmetry of the data that training may use; by default the policy's own."""
        return self.group

    def augment(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Change a training batch; ``obs`` as the task gives it, ``chunks`` normalised."""
        return obs, chunks

    def observation_statistics(self, obs: torch.Tensor) -> Normalizer:
        """Of demonstrated observations; those of what cameras see are the encoder's."""
        if self.eyes is None:
            return super().observation_statistics(obs)
        seen = self.eyes.seen
        rest = Normalizer.fit(self.bounded_layout(seen.rest), obs[:, seen.rest_columns])
        return self.eyes.statistics(obs, rest)

    def finish(self, obs: torch.Tensor) -> None:
        """Learn how large the encoder's numbers became."""
        if self.eyes is None:
            return
        seen = [self.normalized_observation(self.see(part)) for part in obs.split(256)]
        layout = self.agent_normalizer.layout
        fitted = Normalizer.fit(layout, torch.cat(seen), smallest=SMALLEST_TOLD)
        self.agent_normalizer.load_state_dict(fitted.state_dict())

    def observation_for_agents(self, obs: torch.Tensor) -> torch.Tensor:
        """What an encoder tells is scaled to unit size once more, as it became in training."""
        seen = super().observation_for_agents(obs)
        if self.eyes is None:
            return seen
        normalizer = self.agent_normalizer
        return clip_blocks(normalizer.normalize(seen), normalizer.layout, OBSERVATION_RADIUS)

    def see(self, obs: torch.Tensor) -> torch.Tensor:
        """Encode the cloud or picture, if there is one; see :meth:`ChunkPolicy.see`."""
        eyes = self._inference()[2]
        return obs if eyes is None else eyes(obs)

    def loss(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """The denoising loss at uniformly drawn noise levels; see :meth:`GradientPolicy.loss`."""
        count, device = len(obs), obs.device
        levels = torch.randint(self.options.diffusion_steps, (count,), generator=generator)
        noise = torch.randn(chunks.shape, generator=generator)
        levels, noise = levels.to(device), noise.to(device)
        obs, clean = self.augment(obs, chunks, generator)
        noisy = self.diffusion.add_noise(clean, noise, levels)
        obs = obs if self.eyes is None else self.eyes(obs)
        seen = known = self.normalized_observation(obs)
        if deviation := self.options.observation_noise:
            seen = known + deviation * torch.randn(known.shape, generator=generator).to(device)
        if self.options.orbit_targets:
            keep, spread = self.diffusion.mixture(levels, clean)
            pairs = ((known, seen, 1.0, deviation), (clean, noisy, keep, spread))
            layouts = (self.obs_layout, self.act_layout)
            clean = orbit_targets(pairs, layouts, self.data_group)
            noise = (noisy - keep * clean) / spread
        turn = self.frame.angle(seen)
        context = self.denoiser.encode(seen)
        output = self.denoiser(
            self.frame.enter(noisy, turn), context, self.denoiser.encode_time(levels)
        )
        return self.diffusion.loss(self.frame.leave(output, turn), clean, noise, levels)

    def decode(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Follow the deterministic sampler from ``noise``; see :meth:`ChunkPolicy.decode`."""
        denoiser, times, _ = self._inference()
        seen = self.normalized_observation(obs)
        context, turn = denoiser.encode(seen), self.frame.angle(seen)
        clean = self.diffusion.sample(
            lambda x, t: denoiser(x, context, times[t]),
            self.frame.enter(noise, turn),
            self.options.sampling_steps,
            # Normalised demonstrations lie within radius 1, block by block.
            bound=self.bounded,
        )
        return self.bounded(self.act_normalizer.unnormalize(self.frame.leave(clean, turn)))

    def freeze(self) -> Self:
        """Evaluation mode, no gradients; drops cached matrices after a change of weights."""
        self.__dict__["_expanded"] = None
        return super().freeze()

    def decode_settings(self) -> dict[str, Any]:
        """The options that decoding uses."""
        options = vars(self.options)
        values = {k: options[k] for k in (*DECODE_FIELDS, *LATER_FIELDS) if k in options}
        return {key: x for key, x in values.items() if LATER_FIELDS.get(key) != x}

    def _inference(self) -> Expanded:
        """The denoiser with dense matrices, what it sees of each noise level, and the encoder."""
        if self._expanded is None:
            denoiser = self.denoiser.expanded()
            levels = torch.arange(self.options.diffusion_steps, device=self.device)
            # Not registered as a submodule: it is a cache, not part of the state.
            times = denoiser.encode_time(levels).split(1)
            self.__dict__["_expanded"] = denoiser, times, self.eyes and self.eyes.expanded()
        return self.__dict__["_expanded"]

    def _apply(self, fn, recurse=True):
        self.__dict__["_expanded"] = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *args, **kwargs):
        self.__dict__["_expanded"] = None
        super()._load_from_state_dict(*args, **kwargs)
