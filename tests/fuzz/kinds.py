"""The kinds of input, how each is damaged, and what may happen.

``KINDS[name](workshop, number, folder)`` damages an input in the way that belongs to the number,
gives it to the command line and returns how that ended. It raises ``BadEndingError`` if it ended in
a traceback or an unclear sentence, or if damage was accepted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import itertools
import json
import math
import os
import pickle
import re
import shutil
import struct
import tomllib
import typing
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any
from unittest.mock import patch

import h5py
import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from symsteer import cli
from symsteer.bench.runs import base_policy
from symsteer.bench.runs import run as run_module
from symsteer.bench.runs.checkpoint import CHECKSUM_BYTES, FORMAT, load_checkpoint
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.trainer import Trainer
from symsteer.bench.sweep.suite import load_suite
from symsteer.bench.tasks import task_class
from symsteer.leaderboard.records import config_hash, flat, read_record
from symsteer.policies.files import save_policy
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions
from symsteer.variant import parse_variant, variant_text
from tests.fuzz.judge import BadEndingError, Ending, end_of, stopped_at
from tests.fuzz.mutate import (
    POISON,
    extreme,
    flip_bits,
    poison_bytes,
    poison_data,
    poison_json,
    poison_lines,
    same,
)


@dataclasses.dataclass
class Workshop:
    """Intact inputs.

    Attributes:
        config: of the run.
        options: the command line that asks for it.
        run: folder of a run that was stopped after its second checkpoint, name to bytes.
        run_id: its name.
        state: its checkpoint.
        progress: its progress.json.
        sweeps: folder of the bookkeeping of a sweep.
        base: folder of its demonstrations and base policy.
        demos: its demonstrations, .h5 and .json.
        bundle: its demonstrations and base policy as one file.
        records: of other runs.
        other: the checkpoint of another run.
    """

    config: RunConfig
    options: list[str]
    run: dict[str, bytes]
    run_id: str
    state: dict[str, Any]
    progress: bytes
    sweeps: Path
    base: Path
    demos: tuple[bytes, bytes]
    bundle: bytes
    records: dict[str, str]
    other: bytes

    def restore_run(self, folder: Path) -> Path:
        """The stopped run as it was, in ``folder``."""
        path = folder / self.run_id
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
        for name, data in self.run.items():
            (path / name).write_bytes(data)
        return path


def _require(condition: bool, complaint: str) -> None:
    if not condition:
        raise BadEndingError(complaint)


# Suites.

SUITE: dict[str, Any] = {
    "description": "two tasks, a broken and an unbroken world",
    "grid": {
        "task": ["PushCube-v1", "PickCube-v1"],
        "variant": ["none", "action_gain"],
        "strength": [0.5, 1],
        "agent": ["standard", "equivariant"],
        "demonstrations.count": [5, 20],
        "seed": [0, 1],
    },
    "run": {
        "env_steps": 20000,
        "policy": {"steps": 800, "learning_rate": 1e-3, "hold": ["gripper"]},
        "agent": {"gamma": 0.95, "layer_norm": True},
        "evaluation": {"every": 5000, "episodes": 25},
    },
}


def to_toml(data: dict[str, Any], prefix: str = "") -> str:
    """A table as TOML; values that TOML does not have are written as in JSON."""
    lines, tables = [], []
    for key, value in data.items():
        name = json.dumps(str(key))
        if isinstance(value, dict):
            tables.append(f"[{prefix}{name}]\n{to_toml(value, f'{prefix}{name}.')}")
        elif isinstance(value, float) and not math.isfinite(value):
            lines.append(f"{name} = {value}")
        else:
            lines.append(f"{name} = {_inline(value)}")
    return "\n".join([*lines, *tables])


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(k)} = {_inline(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    return json.dumps(value)


def suite(workshop: Workshop, number: int, folder: Path) -> Ending:
    """A suite file, read by ``symsteer sweep --dry-run``."""
    random = Random(f"suite {number}")
    path = folder / "mutant.toml"
    kind = random.randrange(10)
    if kind < 6:
        data = poison_data(SUITE, random, random.choice((1, 1, 2)))
        path.write_text(to_toml(data), "utf-8", "surrogatepass")
    elif kind == 6:
        path.write_text(poison_lines(to_toml(SUITE), random))
    elif kind == 7:
        path.write_text(
            random.choice(
                (
                    "",
                    "[grid]\nseed = " + "[" * 3000 + "]" * 3000,
                    "[grid]\nseed = [" + "0, " * 2000 + "1]\nnum_envs = [" + "1, " * 2000 + "2]",
                    "[[grid]]\nseed = [0]\n[[grid]]\nsede = [1]",
                    "[run]\nseed = 2026-01-31",
                    "[run]\nenv_steps = 1e400",
                    "run = [1]",
                    "grid = 1",
                    "description = 7",
                    "[grid]\n'agent.lr.more' = [1]",
                    "[grid]\n'' = [1]",
                    "[grid]\n'.' = [1]",
                    "[grid]\nstrength = [0.5]",
                    "[grid]\nvariant = ['none']\nstrength = ['0.5']",
                    "[grid]\nvariant = ['action_gain,wind']\nstrength = [0.5]",
                    "[run]\nseed = 99999999999999999999999999",
                )
            )
        )
    else:
        path.write_bytes(poison_bytes(to_toml(SUITE).encode(), random))
    ending = end_of(["sweep", path, "--dry-run", "--out", folder / "runs"], [path.stem])
    if ending.kind == "done":
        found = [flat(config.to_json()) for config in load_suite(str(path)).runs]
        wanted = _grid(tomllib.loads(path.read_text()))
        _require(len(found) == len(wanted), f"{len(found)} runs of {len(wanted)}")
        for have, want in zip(found, wanted, strict=True):
            for name, value in want.items():
                key = re.sub(r"^agent\.", "agent_options.", name)
                have_value = list(have[key]) if isinstance(have[key], tuple) else have[key]
                _require(have_value == value, f"{key} is {have_value!r}, not {value!r}")
    return ending


def _grid(data: dict[str, Any]) -> list[dict[str, Any]]:
    """The runs of a suite, read independently: one flat table per run, without repetitions."""
    shared = flat(data.get("run", {}))
    grids = data.get("grid", {})
    wanted: list[dict[str, Any]] = []
    for grid in grids if isinstance(grids, list) else [grids]:
        for values in itertools.product(*grid.values()):
            cell = dict(zip(grid, values, strict=True))
            strength = cell.pop("strength", None)
            variant = cell.get("variant", "none")
            if strength is not None and variant != "none" and ":" not in variant:
                cell["variant"] = "+".join(f"{v}:{strength:g}" for v in variant.split("+"))
            run = {**shared, **cell}
            if run not in wanted:
                wanted.append(run)
    return wanted


# Configurations.


def config_file(workshop: Workshop, number: int, folder: Path) -> Ending:
    """config.json of a stopped run, read by ``symsteer resume``."""
    random = Random(f"config {number}")
    run = workshop.restore_run(folder)
    path = run / "config.json"
    original = path.read_text()
    path.write_text(poison_json(original, random), "utf-8", "surrogatepass")
    verb = random.choice(("resume", "evaluate"))
    with stopped_at((run_module, "Trainer"), (run_module, "Evaluator")):
        ending = end_of([verb, run], ["config.json", workshop.run_id])
    if ending.kind == "accepted":
        _require(ending.found[0] == workshop.config, "another configuration was accepted")
    return ending


NUMBERS = (
    *("-1", "0", "1", "3", "7", "1e9", "nan", "inf", "-inf", "1e308", "-0.5", "0.5", "1.5", "+5"),
    *("2", "16", "128", "100000", "10000000000000"),
    *("4" * 10, "9" * 26, "-" + "9" * 26, "1_0", "0x10", " 5", "4,5", "1e-320", "0.3", "99999999"),
)
WORDS = (
    *("many", "", "None", "True", "PickCube-v1", "panda", "none", "D4", "C8", "E8", "C0", "SO2"),
    *("action_gain:0.5", "action_gain:0.5,wind:0.3", "action_gain:2", "wind:0.2+wind:0.3", "C97"),
    *("action_gain: 0.5", "action_gain:0.50", "action_gain:nan", "wind:+0.5", "wind:1e-3", "D1"),
    *("C999999999", "\x1b[31m", "a\nb", "x" * 3000, "../..", "-", "--", "ünï", "C8 C4", "diverse"),
    *("zero", "epsilon", "obstacle:1+wind:1+gravity_tilt:1+friction_patch:1+frame_offset:1"),
)
"""Values on a command line."""


def command(workshop: Workshop, number: int, folder: Path) -> Ending:
    """The command line of ``symsteer run``."""
    random = Random(f"command {number}")
    policy = folder / "policy.safetensors"
    policy.write_bytes(workshop.run["policy.safetensors"])
    options = [*workshop.options, "--base-policy", str(policy), "--out", str(folder / "runs")]
    defaults = flat(workshop.config.to_json())
    # In turn, so that every option is tested; another agent or policy has other options.
    fields = sorted(set(defaults) - {"agent", "policy.name"})
    key = fields[number % len(fields)]
    option = "--" + key.replace("agent_options.", "agent.").replace("_", "-")
    kind = random.randrange(8)
    if kind == 0:
        at = random.randrange(3, len(option))
        options += [option[:at] + random.choice(("", "x", "y")) + option[at + 1 :], "3"]
    elif kind == 1:
        options += random.choice(([option], ["--" + option, "1"], ["-" + key[0]], [key, "1"]))
    elif kind == 2:
        options += ["--workers", random.choice(NUMBERS)]
    else:
        # Mostly values that the parser lets through.
        numeric = isinstance(defaults[key], float | int | None)
        likely, odd = (NUMBERS, WORDS) if numeric else (WORDS, NUMBERS)
        options += [option, random.choice(likely if random.random() < 0.8 else odd)]
    shutil.rmtree(folder / "runs", ignore_errors=True)
    with stopped_at((Trainer, "play")):
        ending = end_of(["run", "--quiet", *options])
    if ending.kind == "accepted":
        trainer = ending.found[0]
        trainer.evaluator.close()
        found, asked = flat(trainer.config.to_json()), defaults
        if kind >= 3:
            value = _read_as(workshop.config, key, options[-1])
            asked[key] = variant_text(parse_variant(value)) if key == "variant" else value
        elif options[-1] == option:  # a flag
            asked[key] = True
        for name, value in asked.items():
            _require(same(found[name], value), f"{name} is {found[name]!r}, not {value!r}")
    return ending


def _read_as(config: RunConfig, key: str, text: str) -> Any:
    """What an option's text means."""
    owner: Any = config
    *path, last = key.split(".")
    for part in path:
        owner = getattr(owner, part)
    kind = typing.get_type_hints(type(owner))[last]
    if typing.get_origin(kind) is tuple:
        return (text,)
    if text == "None" and type(None) in typing.get_args(kind):
        return None
    if kind is bool:
        return {"True": True, "False": False}[text]
    if kind is int:
        return int(text)
    return float(text) if kind is float or float in typing.get_args(kind) else text


# Records.


def record(workshop: Workshop, number: int, folder: Path) -> Ending:
    """A record, read by ``symsteer report`` beside intact ones, or by ``symsteer resume``."""
    random = Random(f"record {number}")
    if number % 3 == 2:
        return _record_of_a_run(workshop, random, folder)
    # As run folders, or as files side by side.
    ending = random.choice(("/record.json", ".json"))
    texts = {name + ending: text for name, text in workshop.records.items()}
    name = random.choice(sorted(texts))
    if random.random() < 0.4:
        data = extreme(json.loads(texts[name]), random)
        data["config_hash"] = config_hash(data["config"])
        texts[name] = json.dumps(data)
    else:
        texts[name] = poison_json(texts[name], random)
    results = folder / "results"
    shutil.rmtree(results, ignore_errors=True)
    for file, text in texts.items():
        path = results / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8", "surrogatepass")
    path = results / name
    if number % 3 == 1:
        # Says of each record whether it is admissible, and why not.
        return end_of_check(results, path)
    ending = end_of(["report", results, "--out", folder / "board"], [name, "run_id"])
    if ending.kind == "done":
        _nothing_dropped(path)
    return ending


def end_of_check(results: Path, path: Path) -> Ending:
    """``symsteer report --check`` has a verdict on every record, on stdout."""
    out, err = io.StringIO(), io.StringIO()
    arguments = ["symsteer", "report", str(results), "--check"]
    with (
        patch("sys.argv", arguments),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            code = cli.main()
        except BaseException as error:
            raise BadEndingError(f"{type(error).__name__}: {error}") from error
    text = out.getvalue() + err.getvalue()
    _require("Traceback" not in text, text)
    _require(all(line.isprintable() for line in text.splitlines()), "unprintable characters")
    _require(code in (0, 2), f"exit code {code}")
    admitted = f"{path}: admissible" in text
    if admitted:
        _nothing_dropped(path)
        return Ending("done", found=text)
    _require(str(path) in text, f"{path.name} is not named: {text[:500]}")
    return Ending("refused", text)


def _record_of_a_run(workshop: Workshop, random: Random, folder: Path) -> Ending:
    run = workshop.restore_run(folder)
    path = run / "record.json"
    path.write_text(poison_json(path.read_text(), random), "utf-8", "surrogatepass")
    original = json.loads(workshop.run["record.json"])
    with stopped_at((Trainer, "play")):
        ending = end_of(["resume", run], ["record.json", workshop.run_id])
    if ending.kind == "accepted":
        trainer = ending.found[0]
        trainer.evaluator.close()
        # The record is written before the run goes on.
        found = json.loads(path.read_text())
        kept = workshop.state["evaluations"]
        for key in ("run_id", "config", "config_hash"):
            _require(found[key] == original[key], f"another {key} was accepted")
        _require(
            len(found["evaluations"]) == kept
            and json.dumps(found["evaluations"], sort_keys=True)
            == json.dumps(original["evaluations"][:kept], sort_keys=True),
            "other evaluations were accepted",
        )
    return ending


def _nothing_dropped(path: Path) -> None:
    """A record that was accepted says in memory what its file says."""
    stored = json.loads(path.read_text("utf-8"))
    read = json.loads(read_record(path).model_dump_json(by_alias=True))
    stored.pop("schema_version"), read.pop("schema_version")
    for name, value in flat(stored).items():
        have = flat(read).get(name)
        alike = have == value or (name in ("started", "ended") and have is not None)
        if name == "failure":  # shortened, and without the paths of a machine
            alike = True
        _require(alike, f"{name} is {have!r} in memory and {value!r} in the file")


# Demonstrations.


def demonstrations(workshop: Workshop, number: int, folder: Path) -> Ending:
    """A pair of .h5 and .json, read by ``symsteer run --demos``."""
    random = Random(f"demos {number}")
    path = folder / "mutant.h5"
    side = path.with_suffix(".json")
    path.write_bytes(workshop.demos[0])
    side.write_bytes(workshop.demos[1])
    foreign = number % 5 == 0
    if foreign:
        _make_foreign(path, side)
    kind = random.randrange(8)
    if kind == 0:
        path.write_bytes(poison_bytes(path.read_bytes(), random))
    elif kind == 1:
        path.write_bytes(flip_bits(path.read_bytes(), random))
    elif kind in (2, 3):
        side.write_text(poison_json(side.read_text(), random), "utf-8", "surrogatepass")
    elif kind == 4:
        data = json.loads(side.read_text())
        _edit_description(data, random)
        side.write_text(json.dumps(data))
    else:
        _edit_arrays(path, random)
    count = str(random.choice((2, 2, 2, 2, 2, 3, 3, 4, 10**9)))
    arguments = [*workshop.options, "--demonstrations.count", count, "--out", folder / "runs"]
    with stopped_at((base_policy, "_train")):
        ending = end_of(["run", "--quiet", "--demos", path, *arguments], ["mutant"])
    if ending.kind == "accepted":
        (demos,) = ending.found[1].values()
        layout = task_class(workshop.config.task).observation_layout
        for obs, actions in demos.episodes:
            _require(bool(obs.isfinite().all() and actions.isfinite().all()), "NaN was accepted")
            _require(obs.shape == (len(actions) + 1, layout.dim), "a wrong shape was accepted")
        intact = _content(*workshop.demos, len(demos))
        found = [(o.numpy().tobytes(), a.numpy().tobytes()) for o, a in demos.episodes]
        _require(foreign or found == intact, "damaged arrays were accepted")
    return ending


def _content(h5: bytes, side: bytes, count: int) -> list[tuple[bytes, ...]]:
    with h5py.File(io.BytesIO(h5)) as file:
        return [
            (
                np.asarray(file[f"traj_{i}/obs"]).tobytes(),
                np.asarray(file[f"traj_{i}/actions"]).tobytes(),
            )
            for i in range(count)
        ]


def _make_foreign(path: Path, side: Path) -> None:
    """As if ManiSkill had written it: states, no observations, no section or checksum of ours."""
    data = json.loads(side.read_text())
    del data["symsteer"]
    side.write_text(json.dumps(data))
    with h5py.File(path, "r+") as file:
        file.attrs.clear()
        for group in file.values():
            del group["obs"]


def _edit_description(data: dict[str, Any], random: Random) -> None:
    episode = random.choice(data["episodes"])
    kwargs = data["env_info"]["env_kwargs"]
    edits: tuple[Callable[[], Any], ...] = (
        lambda: episode.update(control_mode="pd_joint_delta_pos"),
        lambda: episode.update(control_mode=["pd_ee_delta_pose"]),
        lambda: episode.update(episode_id=random.choice((99, -1, None, "x/y", [], "../x"))),
        lambda: episode.update(success=random.choice((False, None, "no", [], 0))),
        lambda: kwargs.update(embodiment=random.choice(("panda", None, 3, ["floating"]))),
        lambda: kwargs.update(variant=random.choice(("wind:1", 5, None))),
        lambda: data["env_info"].update(env_id=random.choice(("PushCube-v1", "", None, 3))),
        lambda: data.update(episodes=random.choice(([], [None], [[]], ["traj_0"], {"0": {}}))),
        lambda: data.update(episodes=data["episodes"] * 3),
        lambda: data["env_info"].update(env_kwargs=random.choice(([], None, "x", 3))),
        lambda: data.update(symsteer=random.choice((None, [], "x", {"observation_layout": 3}))),
    )
    random.choice(edits)()


def _edit_arrays(path: Path, random: Random) -> None:
    names = ["actions", "obs", "env_states/actors/cube", "env_states"]
    with h5py.File(path, "r+") as file:
        name = f"traj_{random.randrange(2)}/{random.choice(names)}"
        if name not in file:
            name = "traj_0/actions"
        item = file[name]
        array = None if isinstance(item, h5py.Group) else np.asarray(item)
        kind = random.randrange(10)
        if kind == 0 or array is None:
            del file[name]
            if kind == 1:
                file[name] = h5py.SoftLink("/nowhere")
            elif kind == 2:
                file[name] = h5py.ExternalLink("/etc/hostname", "/x")
            elif kind == 3:
                file[name] = np.zeros(3)
            return
        if kind in (1, 2):
            index = tuple(random.randrange(size) for size in array.shape)
            array[index] = random.choice((np.nan, np.inf, -np.inf, 1e30, 0.125))
        changed = {
            3: lambda: array[:0],
            4: lambda: array[:-1],
            5: lambda: array[:, : array.shape[1] // 2],
            6: lambda: array.astype(random.choice(("i4", "f2", "c8", "S4", "?", "f8"))),
            7: lambda: array.ravel(),
            8: lambda: np.repeat(array, 2, axis=random.randrange(2)),
            9: lambda: np.array(random.choice((3.0, b"text", np.nan))),
        }.get(kind, lambda: array)()
        del file[name]
        file[name] = changed


# What a display reads.


def status(workshop: Workshop, number: int, folder: Path) -> Ending:
    """A file of a sweep or of its runs, read by ``symsteer status``."""
    random = Random(f"status {number}")
    run = workshop.restore_run(folder)
    shutil.copytree(workshop.sweeps, folder / "sweeps")
    (run / "progress.json").write_bytes(workshop.progress)
    path = random.choice(
        [run / name for name in ("progress.json", "progress.json", "config.json", "record.json")]
        + sorted((folder / "sweeps").iterdir())
    )
    if path.suffix == ".json":
        path.write_text(poison_json(path.read_text(), random), "utf-8", "surrogatepass")
    else:
        path.write_bytes(poison_bytes(path.read_bytes(), random))
    ending = end_of(["status", folder], [path.name])
    if ending.kind == "done":
        _require(
            all(line.isprintable() for line in ending.found.splitlines()), "unprintable characters"
        )
    return ending


# Base policies.


def policy(workshop: Workshop, number: int, folder: Path) -> Ending:
    """A saved base policy, read by ``symsteer run --base-policy`` or in the folder of a run."""
    random = Random(f"policy {number}")
    original = workshop.run["policy.safetensors"]
    in_run = number % 4 == 3
    path = (workshop.restore_run(folder) if in_run else folder) / "policy.safetensors"
    path.write_bytes(original)
    kind = random.randrange(6)
    if kind in (0, 1):
        path.write_bytes(flip_bits(original, random, random.choice((1, 1, 3))))
    elif kind == 2:
        # The header holds all that is not a number of the network.
        size = 8 + struct.unpack("<Q", original[:8])[0]
        path.write_bytes(flip_bits(original[:size], random) + original[size:])
    elif kind == 3:
        path.write_bytes(poison_bytes(original, random))
    else:
        _edit_policy(path, random)
    verb = (
        ["resume", path.parent]
        if in_run
        else ["run", "--quiet", "--base-policy", path, "--out", folder / "runs", *workshop.options]
    )
    with stopped_at((run_module, "Trainer")):
        ending = end_of(verb, ["policy.safetensors", workshop.run_id])
    if ending.kind == "accepted":
        found, intact = ending.found[2], folder / "intact.safetensors"
        intact.write_bytes(original)
        (have, said), (want, meant) = _policy_content(path), _policy_content(intact)
        _require(have.keys() == want.keys(), "other tensors were accepted")
        _require(all(torch.equal(have[k], want[k]) for k in have), "other numbers were accepted")
        _require(said == meant == found.report, "another report was accepted")
    return ending


def _policy_content(path: Path) -> tuple[dict[str, torch.Tensor], Any]:
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return tensors, json.loads(file.metadata()["policy"])["report"]


def _edit_policy(path: Path, random: Random) -> None:
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        meta = dict(file.metadata())
    key = random.choice(sorted(tensors))
    kind = random.randrange(8)
    if kind == 0:
        del tensors[key]
    elif kind == 1:
        tensors["more"] = torch.zeros(2)
    elif kind == 2:
        tensors[key] = tensors[key].to(random.choice((torch.float16, torch.float64, torch.int32)))
    elif kind == 3:
        tensors[key] = torch.full_like(tensors[key], float("nan"))
    elif kind == 4:
        tensors[key] = tensors[key].flatten()[: tensors[key].numel() // 2]
    elif kind == 5:
        meta[random.choice(sorted(meta))] = random.choice(("", "{}", "1", "99", "[]", "null"))
    elif kind == 6:
        meta["policy"] = json.dumps(poison_data(json.loads(meta["policy"]), random))
    else:
        task = task_class("PushCube-v1")
        options = EquivariantOptions(channels=8, width=16, depth=1)
        save_policy(
            EquivariantDiffusionPolicy(options, task.observation_layout, task.action_layout), path
        )
        return
    save_file(tensors, path, meta)


# Checkpoints.


class _Trap:
    """Creates a folder if a reader unpickles it."""

    def __init__(self, path: Path):
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


def checkpoint(workshop: Workshop, number: int, folder: Path) -> Ending:
    """checkpoint.pt of a stopped run, read by ``symsteer resume`` or ``symsteer evaluate``."""
    random = Random(f"checkpoint {number}")
    run = workshop.restore_run(folder)
    path, trap = run / "checkpoint.pt", folder / "sprung"
    original = path.read_bytes()
    kind = random.randrange(7)
    if kind in (0, 1, 2):
        path.write_bytes(flip_bits(original, random, random.choice((1, 1, 1, 4))))
    elif kind == 3:
        path.write_bytes(poison_bytes(original, random))
    elif kind == 4:
        path.write_bytes(_trapped(_Trap(trap), random))
    elif kind == 5:
        path.write_bytes(_edited_state(original, random))
    else:
        path.write_bytes(workshop.other)
    verb = random.choice(("resume", "evaluate"))
    with stopped_at((Trainer, "play"), (run_module, "Evaluator")):
        ending = end_of([verb, run], ["checkpoint.pt"])
    _require(not trap.exists(), "code in a checkpoint was executed")
    if ending.kind == "accepted":
        if verb == "resume":
            ending.found[0].evaluator.close()
        _require(_alike(load_checkpoint(run), workshop.state), "another state was accepted")
    return ending


def _trapped(trap: _Trap, random: Random) -> bytes:
    """Four ways to insert code: with and without a checksum, pickle and torch's two formats."""
    buffer = io.BytesIO()
    kind = random.randrange(4)
    if kind == 0:
        return pickle.dumps(trap)
    content = {"format": FORMAT, "state": trap}
    torch.save(content, buffer, _use_new_zipfile_serialization=kind != 1)
    return _sealed(buffer.getvalue()) if kind == 3 else buffer.getvalue()


def _edited_state(original: bytes, random: Random) -> bytes:
    """The state was edited; the checksum is the old one, or there is none."""
    content = torch.load(io.BytesIO(original[:-CHECKSUM_BYTES]), weights_only=True)
    buffer = io.BytesIO()
    torch.save(_poison_tensors(content, random), buffer)
    return buffer.getvalue() + original[-CHECKSUM_BYTES:] * random.randrange(2)


def _sealed(archive: bytes) -> bytes:
    return archive + hashlib.sha256(archive).digest()


def _poison_tensors(state: dict[str, Any], random: Random) -> dict[str, Any]:
    """A key dropped, or a value replaced, at any depth; tensors lose an element or get NaN."""
    container: Any = state
    key = random.choice(sorted(container, key=str))
    while isinstance(container[key], dict) and container[key] and random.random() < 0.7:
        container = container[key]
        key = random.choice(sorted(container, key=str))
    value = container[key]
    if random.random() < 0.3:
        del container[key]
    elif isinstance(value, torch.Tensor) and value.numel() > 1 and random.random() < 0.7:
        flat_value = value.flatten()
        container[key] = random.choice(
            (flat_value[1:], flat_value.flip(0), value.double(), torch.zeros_like(value))
        )
    else:
        container[key] = random.choice(POISON)
    return state


def _alike(a: Any, b: Any) -> bool:
    """Whether two states agree to the last bit."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(_alike(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(_alike, a, b))
    return same(a, b)


# Bundles.


def bundle(workshop: Workshop, number: int, folder: Path) -> Ending:
    """A bundle, read by ``symsteer fetch-bundle``."""
    random = Random(f"bundle {number}")
    path, out = folder / "mutant.zip", folder / "base"
    with zipfile.ZipFile(io.BytesIO(workshop.bundle)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    whole = set(members.values())
    kind = random.randrange(6)
    if kind == 0:
        path.write_bytes(poison_bytes(workshop.bundle, random))
    elif kind == 1:
        path.write_bytes(flip_bits(workshop.bundle, random))
    else:
        if kind in (2, 3):
            text = poison_json(members["manifest.json"].decode(), random)
            members["manifest.json"] = text.encode("utf-8", "surrogatepass")
        elif kind == 4:
            old = random.choice(sorted(members))
            new = random.choice(("../x", "/x", "a/../../x", ".x", "a/b/c", "x\\y", "x\n", " ", old))
            members[new if random.random() < 0.8 else "more"] = members.pop(old)
        else:
            name = random.choice(sorted(members))
            members[name] = poison_bytes(members[name], random)
        with zipfile.ZipFile(path, "w", random.choice((0, 0, 0, zipfile.ZIP_DEFLATED))) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
    ending = end_of(["fetch-bundle", path, "--out", out], ["mutant.zip"])
    written = [file for file in folder.rglob("*") if file.is_file() and file != path]
    if ending.kind == "refused":
        _require(not written, f"{written} were written")
    for file in written:
        known = file.name == "manifest.json" or file.read_bytes() in whole
        _require(known and out in file.parents, f"{file} was written")
    return ending


Runner = Callable[[Workshop, int, Path], Ending]

KINDS: dict[str, tuple[Runner, int]] = {
    "suite": (suite, 170),
    "config": (config_file, 100),
    "command": (command, 110),
    "record": (record, 170),
    "demonstrations": (demonstrations, 150),
    "policy": (policy, 90),
    "checkpoint": (checkpoint, 90),
    "status": (status, 60),
    "bundle": (bundle, 60),
}
"""How each kind is tried, and how many times in the whole test."""
