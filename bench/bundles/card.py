"""The texts that go with what is taken away, in markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from symsteer.bench.bundles.contents import Contents
from symsteer.bench.bundles.manifest import BundledFile, Code, next_commands
from symsteer.bench.bundles.measure import Measured
from symsteer.bench.tasks import TASKS
from symsteer.leaderboard.records import flat
from symsteer.terminal import option_words, to_paste

LICENCE = "Apache-2.0"
"""Of SymSteer, and so of the demonstrations and policies that it makes."""

LICENCES = (
    f"Demonstrations and policies: {LICENCE}, as SymSteer. They contain nothing of ManiSkill: its "
    f"code is {LICENCE}, its assets (meshes and textures of robots and objects) are CC BY-NC 4.0."
)

PICTURES = " The video shows these assets."


def bundle_card(contents: Contents, measured: Measured | None, files: Sequence[BundledFile]) -> str:
    """The text of a bundle.

    Args:
        contents: of the bundle.
        measured: of its policy; None if it has none.
        files: of the bundle.
    """
    config, base = contents.config, Path("runs/base")
    policy = base / contents.name / "policy.safetensors" if measured else None
    demos = base / contents.demonstrations.name if contents.demonstrations else None
    count = config.demonstrations.count
    commands = next_commands(config.task, config.embodiment, policy, demos, count)
    use = "\n".join(["symsteer fetch-bundle FILE  # this bundle", *commands])
    table = "\n".join(f"| `{file.path}` | {file.size} | `{file.sha256}` |" for file in files)
    parts = [
        f"# {contents.name}",
        f"{_what(contents)}, for `{config.task}` with the embodiment `{config.embodiment}`. "
        f"Written by {Code.here()}.",
        f"The task: {TASKS.summary(config.task)}",
        *([_measured_table(measured)] if measured else []),
        f"## How to use it\n\n```sh\n{use}\n```",
        f"## How it was made\n\n{how_made(contents)}",
        f"## Files\n\n| file | bytes | SHA-256 |\n| :-- | --: | :-- |\n{table}",
        f"## Licence\n\n{LICENCES}",
    ]
    return "\n\n".join(parts).rstrip() + "\n"


def dataset_card(contents: Contents, episodes: int, frames: int, film: bool) -> str:
    """The text of a LeRobot dataset, with the header that dataset hubs read."""
    config = contents.config
    parts = [
        "---\nlicense: apache-2.0\ntask_categories:\n- robotics\ntags:\n- LeRobot\nconfigs:\n"
        "- config_name: default\n  data_files: data/*/*.parquet\n---",
        f"# {contents.name}",
        f"{episodes} episodes, {frames} frames: {_what(contents)}, for `{config.task}` with the "
        f"embodiment `{config.embodiment}`. Written by {Code.here()}, in LeRobot's dataset format "
        "v3.0.",
        f"The task: {TASKS.summary(config.task)}",
        "`observation.state` is the gripper's pose and width, `observation.environment_state` what "
        "is observed of the objects; `meta/symsteer.json` says which numbers are vectors. Every "
        "episode ends with its success.",
        f"## How it was made\n\n{how_made(contents)}",
        f"## Licence\n\n{LICENCES}{PICTURES if film else ''}",
    ]
    return "\n\n".join(parts).rstrip() + "\n"


def _what(contents: Contents) -> str:
    wanted = contents.config.demonstrations
    demonstrations = f"{wanted.count} {wanted.mode} demonstrations of a scripted expert"
    policy = f"The base policy `{contents.config.policy_name}`"
    if contents.policy is None:
        return demonstrations
    if contents.demonstrations is None:
        return policy
    return f"{policy} and the {demonstrations} that it was trained on"


def how_made(contents: Contents) -> str:
    """The command that makes the same files, or where they came from."""
    config = contents.config
    wanted = config.demonstrations
    world = ("--task", config.task, "--embodiment", config.embodiment)
    if contents.policy is None:
        command = to_paste(
            *("symsteer", "demos", f"{contents.name}.h5", *world, "--count", wanted.count),
            *("--mode", wanted.mode, "--seed", wanted.seed),
        )
        return f"```sh\n{command}\n```"
    if contents.origin:
        files = ", ".join(f"{kind} with SHA-256 `{key}`" for kind, key in contents.origin.items())
        return f"The run that it was taken from began with files of its user: {files}."
    defaults = flat(type(config.policy)().to_json())
    options = [
        word
        for key, value in flat(config.policy.to_json()).items()
        if value != defaults[key]
        for word in option_words(f"policy.{key}", value)
    ]
    command = to_paste(
        *("symsteer", "run", *world, "--policy.name", config.policy_name),
        *("--policy-seed", config.policy_seed, "--demonstrations.mode", wanted.mode),
        *("--demonstrations.count", wanted.count, "--demonstrations.seed", wanted.seed),
        *options,
    )
    return f"`symsteer run` trains this policy before it steers it:\n\n```sh\n{command}\n```"


def _measured_table(measured: Measured) -> str:
    found, (low, high) = measured.steerability, measured.interval
    solved = round(found["solvable"] * found["states"])
    rows = {
        "success with noise from N(0, I)": (
            f"{measured.success:.2f} [{low:.2f}, {high:.2f}]: {measured.successes} of "
            f"{measured.episodes} held-out episodes, 95 % Wilson interval"
        ),
        f"equivariance error of decoding, {measured.group}": (
            f"{measured.equivariance_error:.1e}: the root mean square of decode(g s, g w) - "
            "g decode(s, w) over that of decode(s, w), for the worst g"
        ),
        "solvable states": (
            f"{solved} of {found['states']} initial states are solved by at least one of "
            f"{found['draws']} draws of noise"
        ),
        "spread of the actions over the noise": (
            f"{found['action_std']:.2f} of the demonstrations' standard deviation"
        ),
        **({"warning": found["warning"]} if found.get("warning") else {}),
    }
    return "\n".join(["| | |", "| :-- | :-- |", *(f"| {k} | {v} |" for k, v in rows.items())])
