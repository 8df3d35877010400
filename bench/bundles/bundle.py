"""One file with the base policy of a run and its demonstrations: a zip archive with a manifest.

Members are stored without compression, in a fixed order and without times: the same run gives the
same bytes. Paths in the archive are those below RUNS/base, where ``symsteer run`` looks for
demonstrations and policies of the same settings.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from scipy.stats import binomtest

from symsteer.bench.bundles.fetch import (
    CARD,
    FORMAT,
    MANIFEST,
    VERSION,
    BundledDemonstrations,
    BundledFile,
    BundleManifest,
    Code,
    Role,
)
from symsteer.bench.runs.base_policy import demonstration_path, find_base
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.stored import RunFolder
from symsteer.bench.steering.evaluation import VISITED, held_out_episodes
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.tasks import TASKS, make, task_class
from symsteer.errors import UserError
from symsteer.files import prepare_folder, write_atomically
from symsteer.leaderboard.records import repeat_command
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy, policy_path
from symsteer.policies.geometry import Group
from symsteer.policies.steerability import decode_error, evenly
from symsteer.tables import markdown

PARALLEL = 100
"""Parallel environments in which a policy is measured, at most."""

LICENCE = "Apache-2.0"
"""Of SymSteer, and so of the demonstrations and policies that it makes."""

LICENCES = (
    f"Demonstrations and policies: {LICENCE}, as SymSteer. They contain nothing of ManiSkill: its "
    f"code is {LICENCE}, its assets (meshes and textures of robots and objects) are CC BY-NC 4.0."
)


def write_bundle(run: Path, out: Path) -> tuple[BundleManifest, str | None]:
    """Measure the base policy of a run and write it with its demonstrations to one file.

    Args:
        run: the run's folder; the folder ``base`` beside it has the demonstrations.
        out: ends in ``.zip``; an earlier file is replaced.

    Returns:
        The manifest, and why the demonstrations are not in the bundle; None if they are.

    Raises:
        UserError: for another suffix, if the folder is not a run's or has no base policy, or if the
            file cannot be written.
    """
    if out.suffix != ".zip":
        raise UserError(f"a bundle is a zip file: give --out a name that ends in .zip, not {out}")
    if out.is_dir():
        raise UserError(f"{out} is a folder; name a file for the bundle")
    prepare_folder(out.parent)
    begun = RunFolder.stored(run)
    run, config, origin = begun.folder, begun.config, begun.files
    policy, file, task = begun.policy(), policy_path(run), task_class(config.task)
    if policy is None:
        raise UserError(
            f"the run {run.name} has no base policy yet; `symsteer resume` brings it to its end"
        )
    demonstrations, absent = None, None
    base = find_base(config, run.parent)
    # A policy that came from a file of the user has the settings of another one in ``base``.
    if base is None or load_policy(base).content_hash() != policy.content_hash():
        kind = config.policy_name.rpartition(":")[2]
        name = f"{config.task}-{config.embodiment}-{kind}-{policy.content_hash()[:12]}"
        absent = f"{run.parent / 'base'} does not have those that the policy was trained on"
    else:
        name, origin = base.name, {}
        if len(config.policy_tasks) == 1:
            demonstrations = demonstration_path(config, run.parent)
        else:
            absent = f"the policy was trained on those of {', '.join(config.policy_tasks)}"
    contents: list[tuple[str, Role, bytes]] = []
    if demonstrations is not None:
        for part in (demonstrations, demonstrations.with_suffix(".json")):
            contents.append((part.name, "demonstrations", part.read_bytes()))
    contents.append((f"{name}/{file.name}", "policy", file.read_bytes()))
    manifest = BundleManifest(
        format=FORMAT,
        version=VERSION,
        name=name,
        task=config.task,
        embodiment=config.embodiment,
        code=Code.here(),
        licence=LICENCE,
        observation_layout=task.observation_layout.to_json(),
        action_layout=task.action_layout.to_json(),
        demonstrations=BundledDemonstrations(**vars(config.demonstrations)),
        policy=config.to_json()["policy"],
        policy_seed=config.policy_seed,
        origin=dict(origin),
        measured=measure(config, policy),
        files=[_listed(*content) for content in contents],
    )
    contents.insert(0, (CARD, "card", _card(manifest, config).encode()))
    manifest.files.insert(0, _listed(*contents[0]))
    text = json.dumps(manifest.model_dump(), indent=2) + "\n"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for path, _, data in [(MANIFEST, "", text.encode()), *contents]:
            member = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))
            member.create_system, member.external_attr = 3, 0o644 << 16
            archive.writestr(member, data)
    write_atomically(out, buffer.getvalue())
    return manifest, absent


def _listed(name: str, role: Role, data: bytes) -> BundledFile:
    digest = hashlib.sha256(data).hexdigest()
    return BundledFile(path=name, role=role, size=len(data), sha256=digest)


@torch.no_grad()
def measure(config: RunConfig, policy: ChunkPolicy) -> dict[str, Any]:
    """Play the held-out episodes and compare decoding with its turned copies.

    Args:
        config: task, embodiment, seed of the noise and number of episodes
            (``evaluation.final_episodes``).
        policy: the base policy, on the CPU.

    Returns:
        ``success``: share of the ``episodes`` that are solved with noise from N(0, I), with its
        95 % Wilson ``interval``; ``equivariance_error`` of decoding under ``group``, the policy's
        or C8: max over g of rms ||decode(gs, gw) - g decode(s, w)|| over rms ||decode(s, w)||, on
        visited states; ``steerability``: the report of the policy's file.

    Raises:
        UserError: if a part of the policy's steerability report is missing.
    """
    report = policy.report.get("steerability") or {}
    if None in map(report.get, ("solvable", "states", "draws", "action_std")):
        raise UserError(
            "the file of the base policy lacks a part of its steerability report, which the card "
            "shows; export it from the run that made it"
        )
    seed, episodes = config.policy_seed, config.evaluation.final_episodes
    num_envs = min(PARALLEL, episodes)
    env = make(config.task, num_envs=num_envs, embodiment=config.embodiment)
    with contextlib.closing(LatentNoiseEnv(env, policy, ignore_terminations=True)) as latent:
        played = held_out_episodes(latent, policy, seed, episodes)
    visited = evenly(played.obs[played.running], VISITED)
    successes = int(played.episodes["success_once"].sum())
    sure = binomtest(successes, episodes).proportion_ci(method="wilson")
    group = policy.group if policy.group.order > 1 else Group.parse("C8")
    error = decode_error(policy, visited, group, seed)
    return {
        "success": successes / episodes,
        "interval": [round(float(sure.low), 4), round(float(sure.high), 4)],
        "successes": successes,
        "episodes": episodes,
        "group": str(group),
        # Further digits are rounding.
        "equivariance_error": float(f"{error:.2e}"),
        "steerability": report,
    }


# ------------------------------------------------------------------------- the card


def _card(manifest: BundleManifest, config: RunConfig) -> str:
    """The text of a bundle, in markdown."""
    wanted = manifest.demonstrations
    what = f"The base policy `{config.policy_name}`"
    if manifest.path("demonstrations"):
        what += f" and the {wanted.count} {wanted.mode} demonstrations of a scripted expert"
        what += " that it was trained on"
    use = ["symsteer fetch-bundle FILE  # this bundle", *manifest.commands(Path("runs/base"))]
    table = [[f"`{f.path}`", str(f.size), f"`{f.sha256}`"] for f in manifest.files]
    blocks = [
        f"# {manifest.name}",
        f"{what}, for `{config.task}` with the embodiment `{config.embodiment}`. Written by "
        f"{manifest.code}.",
        f"The task: {TASKS.summary(config.task)}",
        _measured_table(manifest.measured or {}),
        "## How to use it\n\n```sh\n{}\n```".format("\n".join(use)),
        f"## How it was made\n\n{_how_made(config, manifest.origin)}",
        f"## Files\n\n{markdown(['file', 'bytes', 'SHA-256'], table)}",
        f"## Licence\n\n{LICENCES}",
    ]
    return "\n\n".join(blocks) + "\n"


def _how_made(config: RunConfig, origin: Mapping[str, str]) -> str:
    """The command that makes the same policy, or where it came from."""
    if origin:
        files = ", ".join(f"{kind} with SHA-256 `{key}`" for kind, key in origin.items())
        return f"The run that it was taken from began with files of its user: {files}."
    settings = config.to_json()
    keys = ("task", "embodiment", "demonstrations", "policy", "policy_seed")
    command = repeat_command({**{key: settings[key] for key in keys}, "agent_options": {}})
    command = command or "symsteer run  # with the settings in manifest.json"
    return f"`symsteer run` trains this policy before it steers it:\n\n```sh\n{command}\n```"


def _measured_table(measured: Mapping[str, Any]) -> str:
    report, (low, high) = measured["steerability"], measured["interval"]
    solved = round(report["solvable"] * report["states"])
    rows = {
        "success with noise from N(0, I)": (
            f"{measured['success']:.2f} [{low:.2f}, {high:.2f}]: {measured['successes']} of "
            f"{measured['episodes']} held-out episodes, 95 % Wilson interval"
        ),
        f"equivariance error of decoding, {measured['group']}": (
            f"{measured['equivariance_error']:.1e}: the root mean square of decode(g s, g w) - "
            "g decode(s, w) over that of decode(s, w), for the worst g"
        ),
        "solvable states": (
            f"{solved} of {report['states']} initial states are solved by at least one of "
            f"{report['draws']} draws of noise"
        ),
        "spread of the actions over the noise": (
            f"{report['action_std']:.2f} of the demonstrations' standard deviation"
        ),
        **({"warning": report["warning"]} if report.get("warning") else {}),
    }
    return markdown(["", ""], [list(row) for row in rows.items()], left=2)
