"""The file format of base policies: safetensors with a JSON description as metadata."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BaseModel, Field
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialize
from torch.nn.modules.module import register_module_parameter_registration_hook

from symsteer.errors import UserError, first_problem
from symsteer.files import shallow, write_atomically
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Layout
from symsteer.registry import NotAllowedError, NotInstalledError

FORMAT = "symsteer-policy"
VERSION = 3
READABLE = ("1", "2", "3")
FILE_NAME = "policy.safetensors"

DAMAGE = (
    *(ArithmeticError, AttributeError, LookupError, RuntimeError, SafetensorError),
    *(StopIteration, TypeError, UserError, ValueError),
)
"""What a description or tensors of the wrong form raise while something is built from them."""


class OutdatedError(UserError):
    """A file is whole, but what it holds is no longer what the policy is."""


Count = Annotated[int, Field(ge=0, le=10**12)]
Size = Annotated[float, Field(ge=0, le=1e30)]
Share = Annotated[float, Field(ge=0, le=1)]


class _Steerability(BaseModel):
    success: Share | None = None
    episodes: Count | None = None
    solvable: Share | None = None
    states: Count | None = None
    draws: Count | None = None
    action_std: Size | None = None
    equivariance_error: Size | None = None
    jump: Size | None = None
    warning: Annotated[str, Field(max_length=2000)] | None = None


class _Report(BaseModel):
    world: dict[str, str | int | dict[str, Any]] = {}
    steerability: _Steerability = _Steerability()


class _Training(BaseModel):
    seconds: Size | None = None


class _Description(BaseModel):
    """What is read of a description; files of earlier versions have a part of the report."""

    name: str
    options: dict[str, Any]
    training_record: _Training
    report: _Report
    content_hash: str


def policy_path(folder_or_path: str | Path) -> Path:
    """The policy file meant by a path: itself, or ``policy.safetensors`` in a folder."""
    path = Path(folder_or_path)
    return path if path.suffix == ".safetensors" else path / FILE_NAME


def save_policy(
    policy: ChunkPolicy, folder_or_path: str | Path, extra: dict[str, Any] | None = None
) -> Path:
    """Write a policy; the file appears whole or not at all.

    Args:
        policy: with its training record and report.
        folder_or_path: a ``.safetensors`` file, or a folder that gets ``policy.safetensors``.
        extra: JSON-ready additions to the report.

    Returns:
        The file's path.

    Raises:
        UserError: if the file cannot be written (an earlier one stays as it was), or the policy's
            class cannot be imported by name.
    """
    path = policy_path(folder_or_path)
    name = POLICIES.name_of(type(policy))
    extension = POLICIES.extension(name)
    description = json.dumps(
        {
            "name": name,
            "extension": extension and extension.to_json(),
            "options": policy.options.to_json(),
            "obs_layout": policy.task_layout.to_json(),
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
    write_atomically(path, serialize(tensors, metadata))
    return path


def load_policy(
    folder_or_path: str | Path,
    expect_obs_layout: Layout | None = None,
    expect_act_layout: Layout | None = None,
    device: torch.device | str = "cpu",
) -> ChunkPolicy:
    """Read a policy that :func:`save_policy` wrote, in this format version or an earlier one.

    Args:
        folder_or_path: the file or its folder.
        expect_obs_layout: the environment's observation layout, if it must match.
        expect_act_layout: the environment's action layout, if it must match.
        device: where the policy goes.

    Raises:
        UserError: if the file is missing, damaged, no policy, of another version or layout, or if
            what it needs is not installed or is code that nobody has consented to.
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
    if metadata.get("version") not in READABLE:
        raise UserError(
            f"{path} has policy format version {metadata.get('version')}, and this SymSteer reads "
            f"versions up to {VERSION}; train the policy again or use the SymSteer that wrote it"
        )
    # Version 1 had a checksum of the tensors alone.
    wanted = metadata.get("policy_sha256", None if metadata["version"] == "1" else "")
    if wanted is not None and wanted != _sha256(metadata.get("policy", "")):
        raise UserError(
            f"{path} is damaged: its description does not match its checksum; copy it again"
        )
    cure = "train it again"
    try:
        description = shallow(json.loads(metadata["policy"]))
        if "config" in description:
            description |= _described_by_config(description["config"])
        _Description.model_validate(description, strict=True)
        if found := description["extension"]:
            POLICIES.require(found["name"], found["target"], found["distribution"], path)
        POLICIES.check_allowed(description["name"], path)
        kind = POLICIES.get(description["name"])
        obs_layout = Layout.from_json(description["obs_layout"])
        act_layout = Layout.from_json(description["act_layout"])
        if obs_layout.cloud and not any(name.startswith("eyes.") for name in tensors):
            raise OutdatedError(f"{path} is of a time when clouds had no encoder; train it again")
        for side, layout in (("obs", obs_layout), ("act", act_layout)):
            # An encoder decides how many numbers a cloud or a picture becomes.
            if not layout.is_seen and layout.dim != len(tensors[f"{side}_normalizer.scale"]):
                raise ValueError(f"{side}_layout does not fit the normaliser")
        if description["extension"]:
            cure += f", or let the constructor of {kind.__name__} build all tensors that fit fills"
        options = kind.Options.from_json(description["options"])
        with _no_larger_than(10 * sum(tensor.numel() for tensor in tensors.values())):
            policy = kind(options, obs_layout, act_layout)
        policy.to(next(t.dtype for t in tensors.values() if t.is_floating_point()))
        policy.load_state_dict(tensors)
        stored_hash = description["content_hash"]
        policy.training_record = description["training_record"]
        policy.report = description["report"]
    except (NotAllowedError, NotInstalledError, OutdatedError):
        raise
    except DAMAGE as error:
        reason = " ".join(first_problem(error).split())[:200]
        raise UserError(f"{path} is a damaged SymSteer policy ({reason}); {cure}") from error
    for what, found, expected in (
        ("observation", obs_layout, expect_obs_layout),
        ("action", act_layout, expect_act_layout),
    ):
        if expected is not None and found != expected:
            raise UserError(
                f"{path} was trained for another {what} layout: it has {found}, but the "
                f"environment has {expected}; use a policy of the same task and embodiment"
            )
    if policy.content_hash() != stored_hash:
        raise UserError(f"{path} is damaged: its contents do not match its checksum; copy it again")
    if not _is_finite(policy):
        raise UserError(
            f"{path} decodes to NaN or infinity, so nothing can be steered; train it again, with a "
            "lower policy.learning_rate if it diverged"
        )
    return policy.freeze().to(device)


def _is_finite(policy: ChunkPolicy) -> bool:
    """Whether parameters and actions are finite, at a few observations like those of the data."""
    draw = torch.Generator().manual_seed(0)
    like = policy.act_normalizer.scale
    obs = torch.rand(8, policy.obs_layout.dim, generator=draw).to(like)
    noise = torch.randn(8, policy.horizon, policy.act_layout.dim, generator=draw).to(like)
    with torch.no_grad(), torch.random.fork_rng(devices=[]):
        actions = policy.freeze().decode(policy.obs_normalizer.unnormalize(obs), noise)
    return all(bool(t.isfinite().all()) for t in (actions, *policy.parameters()))


@contextlib.contextmanager
def _no_larger_than(numbers: int) -> Iterator[None]:
    """Refuse to build networks of more parameters, before their memory is used."""

    def register(module: Any, name: str, parameter: torch.Tensor | None) -> None:
        nonlocal numbers
        numbers -= 0 if parameter is None else parameter.numel()
        if numbers < 0:
            raise ValueError("its options ask for a larger network than the file holds")

    with register_module_parameter_registration_hook(register):
        yield


def _described_by_config(config: dict[str, Any]) -> dict[str, Any]:
    """Name and options of files up to version 2, where one table held the options of all kinds."""
    fields = {"group", "match_parameters", "match_compute", "augmentation"}
    own = POLICIES.get(config["name"]).Options.__dataclass_fields__
    unused = {"name"} | (fields - set(own))
    options = {key: value for key, value in config.items() if key not in unused}
    return {"name": config["name"], "extension": None, "options": options}


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
