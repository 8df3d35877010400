"""The frozen chunk policy that steering agents drive, its configuration, and its file format."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch import nn

from symsteer.errors import UserError
from symsteer.policies.diffusion import Diffusion, Prediction
from symsteer.policies.edp import Denoiser, parameter_count
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.normalizer import Normalizer, clip_blocks
from symsteer.policies.plain import matched_size

PolicyName = Literal["edp", "plain", "plain-augmented"]
Network = Literal["mlp", "unet"]

FORMAT = "symsteer-policy"
VERSION = 2
FILE_NAME = "policy.safetensors"

DECODE_FIELDS = (
    "group",
    "network",
    "channels",
    "width",
    "depth",
    "horizon",
    "execute",
    "diffusion_steps",
    "sampling_steps",
    "prediction",
)
"""What of the configuration a trained policy's behavior depends on."""

OBSERVATION_RADIUS = 3.0
"""Normalised observation blocks are shortened to this length: what lies three times outside the
demonstrated range carries no information for the network, and must not blow it up."""


@dataclass(frozen=True)
class PolicyConfig:
    """Everything that defines a base policy and its training, seed and data apart.

    Raises:
        UserError: if a value is out of range.
    """

    name: PolicyName = "edp"
    """Which policy: equivariant diffusion policy, plain diffusion policy, or the plain one
    trained on randomly turned demonstrations."""
    group: str = "C8"
    """The finite symmetry group: C_n or D_n. A plain policy ignores it but for matching its
    number of parameters to the equivariant policy of that group."""
    augmentation: str = "C8"
    """What plain-augmented turns its demonstrations by: C_n, D_n or SO2 (any angle)."""
    network: Network = "mlp"
    """The network inside: residual MLP on the flattened chunk, or temporal U-Net."""
    channels: int = 64
    """Features of the observation embedding per group element."""
    width: int = 64
    """Features of the chunk per group element."""
    depth: int = 3
    """Residual blocks of the MLP."""
    match_parameters: bool = True
    """Widen a plain policy until it has as many parameters as the equivariant one."""
    match_compute: bool = True
    """Train a plain policy for more steps, order/2 times as many (C8: 4 times): about the time
    that the equivariant policy's slices take."""
    horizon: int = 8
    """Tp: actions in a chunk."""
    execute: int = 8
    """Ta: actions executed before the next decision."""
    diffusion_steps: int = 100
    """K: noise levels in training."""
    sampling_steps: int = 8
    """DDIM steps of the sampler."""
    prediction: Prediction = "sample"
    """What the network predicts: the clean chunk (sample) or the noise (epsilon)."""
    snr_cap: float = 5.0
    """Largest weight of a noise level in the loss of sample prediction (Min-SNR); larger values
    spread the actions more over the noise, values of 0.05 or less weigh all levels alike."""
    steps: int = 1500
    """Gradient steps."""
    batch_size: int = 128
    """Chunks in a gradient step."""
    learning_rate: float = 1e-3
    """Peak learning rate of AdamW; cosine decay to zero."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW."""
    warmup_steps: int = 100
    """Gradient steps of linear warm-up."""
    ema_decay: float = 0.995
    """Decay of the averaged weights that the policy keeps; (1 + n)/(10 + n) while that is less."""
    hold: tuple[str, ...] = ("gripper",)
    """Action fields that keep their last value where a chunk runs past the end of its episode;
    all other fields are zero there (no motion)."""

    def __post_init__(self) -> None:
        for field, choices in (
            ("name", get_args(PolicyName)),
            ("network", get_args(Network)),
            ("prediction", get_args(Prediction)),
        ):
            if getattr(self, field) not in choices:
                raise UserError(
                    f"unknown {field} {getattr(self, field)!r} of a base policy; "
                    f"choose {', '.join(choices)}"
                )
        _ = Group.parse(self.group).order
        Group.parse(self.augmentation)
        for field in (
            "channels",
            "width",
            "depth",
            "horizon",
            "execute",
            "diffusion_steps",
            "sampling_steps",
            "steps",
            "batch_size",
        ):
            if getattr(self, field) < 1:
                raise UserError(
                    f"{field} of a base policy must be at least 1, not {getattr(self, field)}"
                )
        if self.execute > self.horizon:
            raise UserError(
                f"a chunk of {self.horizon} actions cannot execute {self.execute}; "
                "choose execute <= horizon"
            )
        if self.network == "unet" and self.horizon % 2:
            raise UserError(
                f"the unet halves the chunk; choose an even horizon, not {self.horizon}"
            )
        if self.sampling_steps > self.diffusion_steps:
            raise UserError(
                f"sampling_steps must be at most diffusion_steps, {self.diffusion_steps}, "
                f"not {self.sampling_steps}"
            )
        if not (self.learning_rate > 0 and self.weight_decay >= 0 and self.warmup_steps >= 0):
            raise UserError(
                "a base policy needs learning_rate > 0, weight_decay >= 0 and warmup_steps >= 0"
            )
        if not 0 <= self.ema_decay < 1:
            raise UserError(f"ema_decay must lie in [0, 1), not {self.ema_decay}")

    def resolved(self, obs_layout: Layout, act_layout: Layout) -> PolicyConfig:
        """The configuration with the plain policies' group (C1), size and steps filled in."""
        if self.name == "edp" or self.group == "C1":
            return self
        channels, width, steps = self.channels, self.width, self.steps
        if self.match_compute:
            # Measured at the default sizes: a step over 8 slices costs 3 to 4 plain steps.
            steps *= max(1, Group.parse(self.group).order // 2)
        if self.match_parameters:
            channels, width = matched_size(
                obs_layout,
                act_layout,
                self.horizon,
                Group.parse(self.group),
                self.network,
                channels,
                width,
                self.depth,
            )
        return dataclasses.replace(self, group="C1", channels=channels, width=width, steps=steps)

    def to_json(self) -> dict[str, Any]:
        """A JSON-ready description; :meth:`from_json` reads it."""
        return json.loads(json.dumps(dataclasses.asdict(self)))

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> PolicyConfig:
        """Rebuild a configuration.

        Raises:
            UserError: if a value is out of range.
            TypeError: if a field is unknown.
        """
        return cls(**{**data, "hold": tuple(data["hold"])})


class ChunkPolicy(nn.Module):
    """A deterministic decoder from (observation, noise) to a chunk of actions.

    It commutes with its group: decode(g s, g w) = g decode(s, w), normalisers, bounds and sampler
    included. Actions are the environment's, each irrep block of length at most 1.

    Attributes:
        obs_layout, act_layout: geometry of one observation and one action (and one noise vector).
        horizon: Tp, actions in a chunk; execute: Ta, how many of them to execute.
        group: the symmetry group; C1 for plain policies.
        config: the resolved configuration.
        training_record: what training reports (losses, seconds, ...), JSON-ready.
        report: anything measured later (steerability), JSON-ready; saved with the policy.
    """

    def __init__(
        self,
        config: PolicyConfig,
        obs_layout: Layout,
        act_layout: Layout,
        obs_normalizer: Normalizer | None = None,
        act_normalizer: Normalizer | None = None,
    ):
        super().__init__()
        config = config.resolved(obs_layout, act_layout)
        self.config = config
        self.obs_layout, self.act_layout = obs_layout, act_layout
        self.horizon, self.execute = config.horizon, config.execute
        self.group = Group.parse(config.group)
        self.diffusion = Diffusion(config.diffusion_steps, config.prediction, config.snr_cap)
        self.obs_normalizer = obs_normalizer or Normalizer(obs_layout)
        self.act_normalizer = act_normalizer or Normalizer(act_layout)
        self.denoiser = Denoiser(
            obs_layout,
            act_layout,
            config.horizon,
            self.group,
            config.network,
            config.channels,
            config.width,
            config.depth,
        )
        self.training_record: dict[str, Any] = {}
        self.report: dict[str, Any] = {}
        self._expanded: Denoiser | None = None
        self.freeze()

    def freeze(self) -> ChunkPolicy:
        """Evaluation mode, no gradients; drops cached matrices after a change of weights."""
        self.__dict__["_expanded"] = None
        return self.eval().requires_grad_(False)

    def normalized_observation(self, obs: torch.Tensor) -> torch.Tensor:
        """What the network sees of ``obs [..., obs_dim]``."""
        return clip_blocks(self.obs_normalizer.normalize(obs), self.obs_layout, OBSERVATION_RADIUS)

    def decode(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Turn noise into actions.

        Args:
            obs: ``[B, obs_dim]``, environment units.
            noise: ``[B, Tp, act_dim]``; standard normal noise gives the base policy.

        Returns:
            ``[B, Tp, act_dim]``, environment actions in [-1, 1], vectors of norm at most 1.
        """
        denoiser = self._inference_denoiser()
        context = denoiser.encode(self.normalized_observation(obs))
        levels = self.diffusion.timesteps(self.config.sampling_steps)
        times = denoiser.encode_time(torch.tensor(levels, device=obs.device))
        by_level = dict(zip(levels, times, strict=True))
        clean = self.diffusion.sample(
            lambda x, t: denoiser(x, context + by_level[t]),
            noise,
            self.config.sampling_steps,
            # Normalised demonstrations lie within radius 1, block by block.
            bound=lambda x: clip_blocks(x, self.act_layout, 1.0),
        )
        return clip_blocks(self.act_normalizer.unnormalize(clean), self.act_layout, 1.0)

    def parameter_count(self) -> int:
        """Numbers in the denoising network."""
        return parameter_count(self.denoiser)

    def content_hash(self) -> str:
        """SHA-256 of all that decides what :meth:`decode` returns, as hexadecimal digits."""
        digest = hashlib.sha256()
        shape = {
            "obs_layout": self.obs_layout.to_json(),
            "act_layout": self.act_layout.to_json(),
            **{key: getattr(self.config, key) for key in DECODE_FIELDS},
        }
        digest.update(json.dumps(shape, sort_keys=True).encode())
        for key, tensor in sorted(self.state_dict().items()):
            digest.update(f"{key} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
        return digest.hexdigest()

    def _inference_denoiser(self) -> Denoiser:
        if self._expanded is None:
            # Kept out of the module's registry: it is a cache, not part of the state.
            self.__dict__["_expanded"] = self.denoiser.expanded()
        return self.__dict__["_expanded"]

    def _apply(self, fn, recurse=True):
        self.__dict__["_expanded"] = None
        return super()._apply(fn, recurse)

    def _load_from_state_dict(self, *args, **kwargs):
        self.__dict__["_expanded"] = None
        super()._load_from_state_dict(*args, **kwargs)


def policy_path(folder_or_path: str | Path) -> Path:
    """The policy file meant by a path: itself, or ``policy.safetensors`` in a folder."""
    path = Path(folder_or_path)
    return path if path.suffix == ".safetensors" else path / FILE_NAME


def save_policy(
    policy: ChunkPolicy, folder_or_path: str | Path, extra: dict[str, Any] | None = None
) -> Path:
    """Write a policy as safetensors with JSON metadata; the file appears whole or not at all.

    Args:
        policy: with its training record and report.
        folder_or_path: a ``.safetensors`` file, or a folder that gets ``policy.safetensors``.
        extra: JSON-ready additions to the report.

    Returns:
        The file's path.

    Raises:
        UserError: if the file cannot be written; an earlier one stays as it was.
    """
    path = policy_path(folder_or_path)
    description = json.dumps(
        {
            "config": policy.config.to_json(),
            "obs_layout": policy.obs_layout.to_json(),
            "act_layout": policy.act_layout.to_json(),
            "training_record": policy.training_record,
            "report": {**policy.report, **(extra or {})},
            "content_hash": policy.content_hash(),
        }
    )
    metadata = {
        "format": FORMAT,
        "version": str(VERSION),
        "policy": description,
        "policy_sha256": _sha256(description),
    }
    tensors = {key: value.cpu().contiguous() for key, value in policy.state_dict().items()}
    payload = serialize(tensors, metadata)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "wb") as file:
            file.write(payload)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise UserError(
            f"{path} cannot be written: {error.strerror}; free space or choose another folder"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()
    return path


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def load_policy(
    folder_or_path: str | Path,
    expect_obs_layout: Layout | None = None,
    expect_act_layout: Layout | None = None,
    device: torch.device | str = "cpu",
) -> ChunkPolicy:
    """Read a policy that :func:`save_policy` wrote.

    Args:
        folder_or_path: the file or its folder.
        expect_obs_layout: the environment's observation layout, if it must match.
        expect_act_layout: the environment's action layout, if it must match.
        device: where the policy goes.

    Raises:
        UserError: if the file is missing, damaged, no policy, of another version or layout.
    """
    path = policy_path(folder_or_path)
    if not path.is_file():
        raise UserError(f"no policy at {path}; train one, or give the path of a saved policy")
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise UserError(
            f"{path} is truncated or no safetensors file ({error}); train or copy it again"
        ) from error
    if metadata.get("format") != FORMAT:
        raise UserError(f"{path} holds no SymSteer policy; give a file that SymSteer wrote")
    if metadata.get("version") not in ("1", str(VERSION)):
        raise UserError(
            f"{path} has policy format version {metadata.get('version')}, and this SymSteer reads "
            f"version {VERSION}; train the policy again or use the SymSteer that wrote it"
        )
    # Version 1 had a checksum of the tensors alone.
    wanted = metadata.get("policy_sha256", None if metadata["version"] == "1" else "")
    if wanted is not None and wanted != _sha256(metadata.get("policy", "")):
        raise UserError(
            f"{path} is damaged: its description does not match its checksum; copy it again"
        )
    try:
        description = json.loads(metadata["policy"])
        obs_layout = Layout.from_json(description["obs_layout"])
        act_layout = Layout.from_json(description["act_layout"])
        policy = ChunkPolicy(PolicyConfig.from_json(description["config"]), obs_layout, act_layout)
        policy.to(next(t.dtype for t in tensors.values() if t.is_floating_point()))
        policy.load_state_dict(tensors)
        stored_hash = description["content_hash"]
        policy.training_record = description["training_record"]
        policy.report = description["report"]
    except (KeyError, TypeError, ValueError, RuntimeError, StopIteration, UserError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"{path} is a damaged SymSteer policy ({reason}); train it again"
        ) from error
    for kind, found, expected in (
        ("observation", obs_layout, expect_obs_layout),
        ("action", act_layout, expect_act_layout),
    ):
        if expected is not None and found != expected:
            raise UserError(
                f"{path} was trained for another {kind} layout: it has {found}, but the "
                f"environment has {expected}; use a policy of the same task and embodiment"
            )
    if policy.content_hash() != stored_hash:
        raise UserError(f"{path} is damaged: its contents do not match its checksum; copy it again")
    return policy.freeze().to(device)
