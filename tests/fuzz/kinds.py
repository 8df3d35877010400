"""The kinds of input, how each is damaged, which commands read it, and what must then be true.

``KINDS[name](workshop, number, folder)`` damages an input in the way that belongs to the number,
gives it to the command line and returns how that ended. It raises ``BadEndingError`` if it ended in
a traceback or an unclear sentence, or if damage was accepted.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import shlex
import shutil
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import h5py
import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from symsteer.agents import presets
from symsteer.bench.runs import base_policy
from symsteer.bench.runs import run as run_module
from symsteer.bench.runs.checkpoint import CHECKSUM_BYTES, FORMAT, load_checkpoint
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.trainer import Trainer
from symsteer.bench.sweep import grid
from symsteer.leaderboard import report, study
from symsteer.leaderboard.records import config_hash, read_record, repeat_command
from symsteer.policies.files import _sha256
from tests.bench.tuning.tiny_plan import TEXT as PLAN
from tests.fuzz.judge import BadEndingError, Ending, end_of, stopped_at
from tests.fuzz.mutate import (
    POISON,
    Way,
    as_data,
    damage_bits,
    damage_bytes,
    damage_json,
    damage_json_text,
    damage_toml,
    damage_toml_text,
    extreme,
    flip_bits,
    nested,
    poison_bytes,
    poison_data,
    write_json,
)


@dataclass
class Workshop:
    """Intact inputs.

    Attributes:
        config: of the run.
        run: folder of a run that was stopped after its second checkpoint; beside it are the folder
            `base` of its demonstrations and base policy, and `bundle.zip` with both.
        state: its checkpoint.
        records: of other runs.
    """

    config: RunConfig
    run: Path
    state: dict[str, Any]
    records: dict[str, str]

    def restore_run(self, folder: Path) -> Path:
        """The stopped run as it was, in ``folder``."""
        return shutil.copytree(self.run, folder / self.run.name)

    @property
    def demos(self) -> Path:
        return next(self.run.parent.glob("base/*.h5"))


def options_of(config: RunConfig) -> list[str]:
    """The command line that asks for a configuration."""
    return shlex.split(str(repeat_command(config.to_json())))[2:]


Make = Callable[[Workshop, Path], Path]
"""Writes an intact input into a folder; the file to damage."""


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        make: writes the intact input.
        ways: in which it is damaged.
        lines: command lines that read it.
        stop: where their work would begin.
        check: raises if damage was accepted.
    """

    make: Make
    ways: Sequence[Way]
    lines: Sequence[Callable[[Workshop, Path], list[Any]]]
    stop: Sequence[tuple[Any, str]] = ()
    check: Callable[[Workshop, Path, Ending], None] = lambda workshop, path, ending: None

    def __call__(self, workshop: Workshop, number: int | None, folder: Path) -> Ending:
        """Damage the input in the way of a number (None: in no way), and give it to a command."""
        random = Random(f"{self.make.__name__} {number}")
        path = self.make(workshop, folder)
        if number is not None:
            self.ways[number % len(self.ways)](path, random)
        line = self.lines[0] if number is None else random.choice(self.lines)
        names = (path.stem, workshop.run.name, "record.json", "policy.safetensors", "option")
        with stopped_at(*self.stop):
            ending = end_of(line(workshop, path), names)
        if ending.kind == "accepted" and isinstance(ending.found[0], Trainer):
            ending.found[0].evaluator.close()
        if ending.kind == "done":
            lines = ending.found.splitlines()
            require(all(line.isprintable() for line in lines), "unprintable characters")
        require("too little memory" not in ending.sentence, "it took gigabytes")
        if number is not None and ending.kind in ("accepted", "done"):
            self.check(workshop, path, ending)
        return ending


def require(condition: bool, complaint: str) -> None:
    if not condition:
        raise BadEndingError(complaint)


def new_run(workshop: Workshop, *more: Any) -> list[Any]:
    return ["run", "--quiet", *more, "--runs", "runs", *options_of(workshop.config)]


def in_run(name: str) -> Make:
    """A file of the stopped run."""
    return lambda workshop, folder: workshop.restore_run(folder) / name


RESUME, EVALUATE = (
    lambda workshop, path, verb=verb: [verb, path.parent] for verb in ("resume", "evaluate")
)
WORK = ((Trainer, "play"), (run_module, "Evaluator"))
BYTES = (damage_bytes, damage_bits)
JSON = (damage_json, damage_json, damage_json_text, damage_bytes)
TOML = (damage_toml, damage_toml, damage_toml_text, damage_bytes)


# TOML: suites, presets, plans and studies.


def toml_file(text: str) -> Make:
    def make(workshop: Workshop, folder: Path) -> Path:
        (folder / "a.json").write_text(workshop.records["a"])
        (folder / "mutant.toml").write_text(text)
        return folder / "mutant.toml"

    return make


def suite_with_preset(workshop: Workshop, path: Path) -> list[Any]:
    """A suite may name a preset, as a run may."""
    path.with_name("suite.toml").write_text(f'[grid]\n"agent.preset" = ["{path}"]')
    return ["sweep", path.with_name("suite.toml"), "--dry-run"]


# Configurations and records.


def same_configuration(workshop: Workshop, path: Path, ending: Ending) -> None:
    config = getattr(ending.found[0], "config", ending.found[0])
    require(config == workshop.config, "another configuration was accepted")


def records(workshop: Workshop, folder: Path) -> Path:
    """Side by side, one of which is damaged."""
    for name, text in workshop.records.items():
        (folder / "results" / name).mkdir(parents=True)
        (folder / "results" / name / "record.json").write_text(text)
    return folder / "results" / "b" / "record.json"


def exaggerate(path: Path, random: Random) -> None:
    data = extreme(json.loads(path.read_text()), random)
    write_json(path, {**data, "config_hash": config_hash(data["config"])})


def nothing_dropped(workshop: Workshop, path: Path, ending: Ending) -> None:
    """A record that was accepted says in memory what its file says."""
    stored = json.loads(path.read_text("utf-8"))
    # Failures are shortened, without the paths of a machine; times are in UTC.
    for name in ("schema_version", "failure", "started", "ended"):
        stored.pop(name, None)
    read = json.loads(read_record(path).model_dump_json(by_alias=True))
    require(holds(read, stored), "what the record says was dropped")


def holds(data: Any, part: Any) -> bool:
    """Whether nested data have all that a part of them has."""
    if isinstance(part, dict):
        return all(name in data and holds(data[name], value) for name, value in part.items())
    if isinstance(part, list):
        return len(part) == len(data) and all(map(holds, data, part))
    return data == part


def same_history(workshop: Workshop, path: Path, ending: Ending) -> None:
    """The record is written before the run goes on."""
    found, original = (
        json.loads(path.read_text()),
        json.loads((workshop.run / "record.json").read_text()),
    )
    original["evaluations"] = original["evaluations"][: workshop.state["evaluations"]]
    for key in ("run_id", "config", "config_hash", "evaluations"):
        require(found[key] == original[key], f"another {key} was accepted")


# Demonstrations.


def demonstrations(workshop: Workshop, folder: Path) -> Path:
    for suffix in (".h5", ".json"):
        shutil.copy(workshop.demos.with_suffix(suffix), folder / f"mutant{suffix}")
    return folder / "mutant.h5"


def beside(way: Way) -> Way:
    """The same for the .json file beside it."""
    return lambda path, random: way(path.with_suffix(".json"), random)


def same_arrays(workshop: Workshop, path: Path, ending: Ending) -> None:
    (demos,) = ending.found[1].values()
    with h5py.File(workshop.demos) as file:
        for index, arrays in enumerate(demos.episodes):
            for name, array in zip(("obs", "actions"), arrays, strict=True):
                same = np.array_equal(np.asarray(file[f"traj_{index}/{name}"]), array.numpy())
                require(same, "damaged arrays were accepted")


# Base policies.


def read_policy(path: Path) -> dict[str, Any]:
    """Tensors, metadata, and what the metadata say of the policy."""
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        meta = dict(file.metadata())
    return {"tensors": tensors, "policy": json.loads(meta.pop("policy")), "meta": meta}


def write_policy(path: Path, data: dict[str, Any]) -> None:
    """What of the data a file of tensors can hold."""
    tensors, meta = (v if isinstance(v := data.get(k), dict) else {} for k in ("tensors", "meta"))
    tensors = {k: v.contiguous() for k, v in tensors.items() if isinstance(v, torch.Tensor)}
    policy = json.dumps(data.get("policy"))
    save_file(tensors, path, {**{k: str(v) for k, v in meta.items()}, "policy": policy})


def write_sealed_policy(path: Path, data: dict[str, Any]) -> None:
    """With the checksum of the description."""
    data["meta"]["policy_sha256"] = _sha256(json.dumps(data["policy"]))
    write_policy(path, data)


def damage_header(path: Path, random: Random) -> None:
    """The header holds all that is not a number of the network."""
    data = path.read_bytes()
    size = 8 + struct.unpack("<Q", data[:8])[0]
    path.write_bytes(flip_bits(data[:size], random) + data[size:])


def seal_policy(path: Path, random: Random) -> None:
    """A wrong description with the checksum that belongs to it."""
    data = read_policy(path)
    data["policy"]["training_record"].pop("losses", None)
    data["policy"] = poison_data(data["policy"], random)
    write_sealed_policy(path, data)


def same_policy(workshop: Workshop, path: Path, ending: Ending) -> None:
    have, want = read_policy(path), read_policy(workshop.run / "policy.safetensors")
    # The type of numbers may be another one.
    tensors = [{k: v.double() for k, v in policy["tensors"].items()} for policy in (have, want)]
    require(alike(*tensors), "other numbers were accepted")
    require(have["policy"]["report"] == want["policy"]["report"], "another report was accepted")


# Checkpoints.


class Trap:
    """Creates a folder if a reader unpickles it."""

    def __init__(self, path: Path):
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (self.path,)


def sealed(archive: bytes) -> bytes:
    return archive + hashlib.sha256(archive).digest()


def set_trap(path: Path, random: Random) -> None:
    """Four ways to insert code: with and without a checksum, pickle and torch's two formats."""
    trap, kind, buffer = Trap(path.with_name("sprung")), random.randrange(4), io.BytesIO()
    torch.save({"format": FORMAT, "state": trap}, buffer, _use_new_zipfile_serialization=kind != 1)
    archives = (pickle.dumps(trap), buffer.getvalue(), buffer.getvalue(), sealed(buffer.getvalue()))
    path.write_bytes(archives[kind])


def read_state(path: Path) -> dict[str, Any]:
    return torch.load(io.BytesIO(path.read_bytes()[:-CHECKSUM_BYTES]), weights_only=True)


def archive(data: Any) -> bytes:
    torch.save(data, buffer := io.BytesIO())
    return buffer.getvalue()


def old_checksum(path: Path, data: Any) -> None:
    path.write_bytes(archive(data) + path.read_bytes()[-CHECKSUM_BYTES:])


def seal_archive(path: Path, random: Random) -> None:
    path.write_bytes(sealed(poison_bytes(path.read_bytes()[:-CHECKSUM_BYTES], random)))


def seal_state(path: Path, random: Random) -> None:
    """Another state with the checksum that belongs to it; a size may be a lie."""
    data = read_state(path)
    inner = random.choice([data["state"], data["state"]["agent"], data["state"]["replay"]])
    key = random.choice([*sorted(inner, key=str), "more"])
    odd: tuple[Any, ...] = (
        *(torch.zeros(1).expand(10**9), torch.zeros(0, 2**40), torch.zeros(())),
        *(torch.zeros(3, dtype=torch.complex64), nested(200, random.randrange(2))),
        *(*poison_data([inner.get(key)], random), random.choice(POISON)),
    )
    inner[key] = random.choice(odd)
    path.write_bytes(sealed(archive(data)))


def alike(a: Any, b: Any) -> bool:
    """Whether two states agree to the last bit, types included."""
    if type(a) is not type(b):
        return False
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(alike, a, b))
    return a == b or (a != a and b != b)


def same_state(workshop: Workshop, path: Path, ending: Ending) -> None:
    require(alike(load_checkpoint(path.parent), workshop.state), "another state was accepted")


# Bundles.


def bundle(workshop: Workshop, folder: Path) -> Path:
    return shutil.copy(workshop.run.parent / "bundle.zip", folder / "mutant.zip")


def same_members(workshop: Workshop, path: Path, ending: Ending) -> None:
    with zipfile.ZipFile(workshop.run.parent / "bundle.zip") as packed:
        whole = {packed.read(name) for name in packed.namelist()}
    for file in path.with_name("base").rglob("*"):
        known = file.name == "manifest.json" or file.is_dir() or file.read_bytes() in whole
        require(known, f"{file} was written")


PRESET = Path(presets.__file__).with_name("tuned.toml").read_text()
SUITE = (grid.SUITES / "submission.toml").read_text()
STUDY = (study.FOLDER / "paper.toml").read_text()

KINDS: dict[str, Kind] = {
    "suite": Kind(toml_file(SUITE), TOML, [lambda workshop, path: ["sweep", path, "--dry-run"]]),
    "preset": Kind(
        toml_file(PRESET),
        TOML,
        [lambda workshop, path: new_run(workshop, "--agent.preset", path), suite_with_preset],
        [(run_module, "prepare_base")],
    ),
    "plan": Kind(toml_file(PLAN), TOML, [lambda workshop, path: ["tune", path, "--dry-run"]]),
    "study": Kind(
        toml_file(STUDY),
        TOML,
        [lambda w, path: ["report", path.with_name("a.json"), "--study", path, "--out", "board"]],
        [(report, "render")],
    ),
    "config": Kind(in_run("config.json"), JSON, [RESUME, EVALUATE], WORK, same_configuration),
    "record": Kind(
        records,
        (*JSON, exaggerate, exaggerate),
        [
            lambda workshop, path: ["report", path.parents[1], "--out", "board"],
            lambda workshop, path: ["report", path.parents[1], "--check"],
        ],
        check=nothing_dropped,
    ),
    "record of a run": Kind(in_run("record.json"), JSON, [RESUME], WORK, same_history),
    "demonstrations": Kind(
        demonstrations,
        (*BYTES, *map(beside, JSON[1:])),
        [
            lambda workshop, path, count=count: [
                *new_run(workshop, "--demos", path),
                *("--demonstrations.count", count),
            ]
            for count in (2, 2, 3, 4, 10**9)
        ],
        [(base_policy, "_train")],
        same_arrays,
    ),
    "policy": Kind(
        in_run("policy.safetensors"),
        (*BYTES, damage_header, as_data(read_policy, write_policy)),
        [lambda workshop, path: new_run(workshop, "--base-policy", path), RESUME],
        WORK,
        same_policy,
    ),
    "checkpoint": Kind(
        in_run("checkpoint.pt"),
        (*BYTES, set_trap, as_data(read_state, old_checksum)),
        [RESUME, EVALUATE],
        WORK,
        same_state,
    ),
    "bundle": Kind(
        bundle,
        BYTES,
        [lambda workshop, path: ["fetch-bundle", path, "--runs", path.parent]],
        check=same_members,
    ),
}
KINDS |= {
    "sealed policy": replace(KINDS["policy"], ways=[seal_policy] * 4, check=lambda *_: None),
    "sealed checkpoint": replace(
        KINDS["checkpoint"], ways=[seal_archive, seal_state], check=lambda *_: None
    ),
}
"""The sealed ones have wrong contents and the checksums that belong to them."""
