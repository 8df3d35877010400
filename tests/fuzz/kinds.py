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

from symsteer.bench.runs import base_policy
from symsteer.bench.runs import run as run_module
from symsteer.bench.runs.checkpoint import CHECKSUM_BYTES, FORMAT, load_checkpoint
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.trainer import Trainer
from symsteer.leaderboard import report
from symsteer.leaderboard.records import config_hash, flat, read_record
from symsteer.policies.files import _sha256, load_policy
from tests.bench.tuning.tiny_plan import TEXT as PLAN
from tests.fuzz.judge import BadEndingError, Ending, end_of, stopped_at
from tests.fuzz.mutate import (
    POISON,
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
    to_toml,
)


@dataclass
class Workshop:
    """Intact inputs.

    Attributes:
        config: of the run.
        options: the command line that asks for it.
        run: folder of a run that was stopped after its second checkpoint, name to bytes.
        run_id: its name.
        state: its checkpoint.
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


Way = Callable[[Path, Random], None]
"""Damages the file at a path."""


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        make: writes the intact input into a folder; the file to damage.
        ways: in which it is damaged.
        lines: command lines that read it.
        stop: where their work would begin.
        check: raises if damage was accepted.
    """

    make: Callable[[Workshop, Path], Path]
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
        arguments = line(workshop, path)
        names = (path.stem, workshop.run_id, "record.json", "policy.safetensors", "sweeps")
        with stopped_at(*self.stop):
            ending = end_of(arguments, names)
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
    return ["run", "--quiet", *more, "--out", "runs", *workshop.options]


def in_run(name: str) -> Callable[[Workshop, Path], Path]:
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

PRESET: dict[str, Any] = {
    "all": {"lr": 1e-3, "utd": 0.5, "layer_norm": True, "reduce": "min", "batch_size": 64},
    "equivariant": {"critics": 2, "lr": 2e-3},
    "standard": {"width": 64},
}

TEXTS = {
    "suite": to_toml(SUITE),
    "preset": to_toml(PRESET),
    "plan": PLAN + "[[further]]\nlr = 1e-2\ncritics = 4\n[run.agent]\ntau = 0.1\n",
    "study": (Path(report.__file__).parent / "studies" / "paper.toml").read_text(),
}


def toml_file(name: str) -> Callable[[Workshop, Path], Path]:
    def make(workshop: Workshop, folder: Path) -> Path:
        (folder / "a.json").write_text(workshop.records["a"])
        (folder / "mutant.toml").write_text(TEXTS[name])
        return folder / "mutant.toml"

    return make


def suite_with_preset(workshop: Workshop, path: Path) -> list[Any]:
    suite = path.with_name("suite.toml")
    suite.write_text(to_toml({"grid": {**SUITE["grid"], "agent.preset": [str(path)]}}))
    return ["sweep", suite, "--dry-run"]


# Configurations, records and what a display reads.


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
    path.write_text(json.dumps({**data, "config_hash": config_hash(data["config"])}))


def nothing_dropped(workshop: Workshop, path: Path, ending: Ending) -> None:
    """A record that was accepted says in memory what its file says."""
    stored = json.loads(path.read_text("utf-8"))
    read = json.loads(read_record(path).model_dump_json(by_alias=True))
    stored.pop("schema_version"), read.pop("schema_version")
    for name, value in flat(stored).items():
        have = flat(read).get(name)
        # Shortened and without the paths of a machine; in UTC.
        changed = name == "failure" or (name in ("started", "ended") and have is not None)
        require(have == value or changed, f"{name} is {have!r} in memory, {value!r} in the file")


def same_history(workshop: Workshop, path: Path, ending: Ending) -> None:
    """The record is written before the run goes on."""
    found, original = json.loads(path.read_text()), json.loads(workshop.run["record.json"])
    original["evaluations"] = original["evaluations"][: workshop.state["evaluations"]]
    for key in ("run_id", "config", "config_hash", "evaluations"):
        require(found[key] == original[key], f"another {key} was accepted")


def display(workshop: Workshop, folder: Path) -> Path:
    """The files of a run and of a sweep."""
    shutil.copytree(workshop.sweeps, folder / "sweeps")
    return workshop.restore_run(folder) / "progress.json"


def damage_any(path: Path, random: Random) -> None:
    path = random.choice([*path.parent.glob("*.json"), *(path.parents[1] / "sweeps").iterdir()])
    random.choice(JSON if path.suffix == ".json" else BYTES)(path, random)


# Demonstrations.


def demonstrations(workshop: Workshop, folder: Path) -> Path:
    path = folder / "mutant.h5"
    for file, data in zip((path, path.with_suffix(".json")), workshop.demos, strict=True):
        file.write_bytes(data)
    return path


def beside(way: Way) -> Way:
    """The same for the .json file beside it."""
    return lambda path, random: way(path.with_suffix(".json"), random)


def edit_description(path: Path, random: Random) -> None:
    data = json.loads(path.read_text())
    episode, kwargs = random.choice(data["episodes"]), data["env_info"]["env_kwargs"]
    table, key, values = random.choice(
        (
            (episode, "control_mode", ("pd_joint_delta_pos", ["pd_ee_delta_pose"])),
            (episode, "episode_id", (99, -1, None, "x/y", [], "../x")),
            (episode, "success", (False, None, "no", [], 0)),
            (kwargs, "embodiment", ("panda", None, 3, ["floating"])),
            (kwargs, "variant", ("wind:1", 5, None)),
            (data["env_info"], "env_id", ("PushCube-v1", "", None, 3)),
            (data["env_info"], "env_kwargs", ([], None, "x", 3)),
            (data, "episodes", ([], [None], [[]], ["traj_0"], {"0": {}}, data["episodes"] * 3)),
            (data, "symsteer", (None, [], "x", {"observation_layout": 3})),
        )
    )
    table[key] = random.choice(values)
    path.write_text(json.dumps(data))


def edit_arrays(path: Path, random: Random) -> None:
    with h5py.File(path, "r+") as file:
        group = file[f"traj_{random.randrange(2)}"]
        name = random.choice([name for name in ("actions", "obs", "env_states") if name in group])
        item = group[name]
        odd: list[Any] = [None, h5py.SoftLink("/nowhere"), np.zeros(3)]
        odd.append(h5py.ExternalLink("/etc/hostname", "/x"))
        if isinstance(item, h5py.Dataset):
            array = np.asarray(item)
            wrong = array.copy()
            index = tuple(random.randrange(size) for size in array.shape)
            wrong[index] = random.choice((np.nan, np.inf, -np.inf, 1e30, 0.125))
            odd += [wrong, wrong, array[:0], array[:-1], array[:, : array.shape[1] // 2]]
            odd += [array.astype(random.choice(("i4", "f2", "c8", "S4", "?", "f8"))), array.ravel()]
            odd += [np.repeat(array, 2, axis=random.randrange(2)), np.array(b"text")]
        del group[name]
        if (changed := random.choice(odd)) is not None:
            group[name] = changed


def same_arrays(workshop: Workshop, path: Path, ending: Ending) -> None:
    (demos,) = ending.found[1].values()
    with h5py.File(io.BytesIO(workshop.demos[0])) as file:
        for index, (obs, actions) in enumerate(demos.episodes):
            require(bool(obs.isfinite().all() and actions.isfinite().all()), "NaN was accepted")
            require(len(obs) == len(actions) + 1, "a wrong shape was accepted")
            for name, array in (("obs", obs), ("actions", actions)):
                same = np.array_equal(np.asarray(file[f"traj_{index}/{name}"]), array.numpy())
                require(same, "damaged arrays were accepted")


# Base policies.


def policy_file(workshop: Workshop, folder: Path) -> Path:
    return workshop.restore_run(folder) / "policy.safetensors"


def read_tensors(path: Path) -> tuple[dict[str, torch.Tensor], dict[str, str]]:
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return tensors, dict(file.metadata())


def damage_header(path: Path, random: Random) -> None:
    """The header holds all that is not a number of the network."""
    data = path.read_bytes()
    size = 8 + struct.unpack("<Q", data[:8])[0]
    path.write_bytes(flip_bits(data[:size], random) + data[size:])


def edit_tensors(path: Path, random: Random) -> None:
    tensors, meta = read_tensors(path)
    save_tensors(path, poison_tensors(tensors, random), meta)


def edit_metadata(path: Path, random: Random) -> None:
    tensors, meta = read_tensors(path)
    if random.random() < 0.5:
        meta["policy"] = json.dumps(poison_data(json.loads(meta["policy"]), random))
    else:
        meta[random.choice(sorted(meta))] = random.choice(("", "{}", "1", "99", "[]", "null"))
    save_file(tensors, path, meta)


def seal_policy(path: Path, random: Random) -> None:
    """A wrong description, or wrong numbers, with the checksums that belong to it."""
    tensors, meta = read_tensors(path)
    said = json.loads(meta["policy"])
    if random.random() < 0.3:
        tensors, intact = poison_tensors(tensors, random), load_policy(path)
        tensors = {key: value for key, value in tensors.items() if isinstance(value, torch.Tensor)}
        try:
            intact.load_state_dict(tensors)
            said["content_hash"] = intact.content_hash()
        except RuntimeError:
            pass
    else:
        said["training_record"].pop("losses", None)
        part = random.choice(("options", "report", "obs_layout", "act_layout", None))
        said = (
            {**said, part: poison_data(said[part], random)} if part else poison_data(said, random)
        )
    meta["policy"] = json.dumps(said)
    save_tensors(path, tensors, {**meta, "policy_sha256": _sha256(meta["policy"])})


def save_tensors(path: Path, tensors: dict[str, Any], meta: dict[str, str]) -> None:
    tensors = {k: v.contiguous() for k, v in tensors.items() if isinstance(v, torch.Tensor)}
    save_file(tensors, path, meta)


def same_policy(workshop: Workshop, path: Path, ending: Ending) -> None:
    intact = path.with_name("intact.safetensors")
    intact.write_bytes(workshop.run["policy.safetensors"])
    (have, said), (want, meant) = read_tensors(path), read_tensors(intact)
    have, want = ({k: v.double() for k, v in tensors.items()} for tensors in (have, want))
    require(alike(have, want), "other numbers were accepted")
    reports = [json.loads(meta["policy"])["report"] for meta in (said, meant)]
    require(reports[0] == reports[1], "another report was accepted")


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


def edit_state(path: Path, random: Random) -> None:
    """The state was edited; the checksum is the old one, or there is none."""
    original = path.read_bytes()
    content = torch.load(io.BytesIO(original[:-CHECKSUM_BYTES]), weights_only=True)
    buffer = io.BytesIO()
    torch.save(poison_tensors(content, random), buffer)
    path.write_bytes(buffer.getvalue() + original[-CHECKSUM_BYTES:] * random.randrange(2))


def seal_archive(path: Path, random: Random) -> None:
    path.write_bytes(sealed(poison_bytes(path.read_bytes()[:-CHECKSUM_BYTES], random)))


def seal_state(path: Path, random: Random) -> None:
    """Another state with the checksum that belongs to it."""
    file = torch.load(io.BytesIO(path.read_bytes()[:-CHECKSUM_BYTES]), weights_only=True)
    inner = random.choice([file["state"], file["state"]["agent"], file["state"]["replay"]])
    key = random.choice(sorted(inner, key=str))
    odd: tuple[Any, ...] = (
        *(torch.zeros(1).expand(10**9), nested(200, random.randrange(2)), {}, torch.zeros(())),
        *(torch.zeros(0, 2**40), torch.zeros(3, dtype=torch.complex64), random.choice(POISON)),
    )
    if random.random() < 0.5:
        inner[random.choice((key, key, "more"))] = random.choice(odd)
    else:
        poison_tensors(inner, random)
    buffer = io.BytesIO()
    torch.save(file, buffer, _use_new_zipfile_serialization=random.random() < 0.95)
    path.write_bytes(sealed(buffer.getvalue()))


def poison_tensors(state: dict[str, Any], random: Random) -> dict[str, Any]:
    """A key dropped, or a value replaced, at any depth; tensors lose an element or get NaN."""
    container: Any = state
    key = random.choice(sorted(container, key=str))
    while isinstance(container[key], dict) and container[key] and random.random() < 0.7:
        container = container[key]
        key = random.choice(sorted(container, key=str))
    value = container[key]
    if random.random() < 0.3:
        del container[key]
    elif isinstance(value, torch.Tensor) and value.numel() > 1 and random.random() < 0.8:
        line = value.flatten()
        changed = (line[1:], line.flip(0), value.double(), torch.full_like(value, float("nan")))
        container[key] = random.choice(changed if value.is_floating_point() else changed[:3])
    else:
        container[key] = random.choice(POISON)
    return state


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
    (folder / "mutant.zip").write_bytes(workshop.bundle)
    return folder / "mutant.zip"


def rewrite(edit: Callable[[dict[str, bytes], Random], None]) -> Way:
    """Edit the files in an archive."""

    def way(path: Path, random: Random) -> None:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        edit(members, random)
        with zipfile.ZipFile(path, "w", random.choice((0, 0, 0, zipfile.ZIP_DEFLATED))) as archive:
            for name, data in members.items():
                archive.writestr(name, data)

    return way


def edit_manifest(members: dict[str, bytes], random: Random) -> None:
    data = poison_data(json.loads(members["manifest.json"]), random)
    members["manifest.json"] = json.dumps(data).encode("utf-8", "surrogatepass")


def rename_member(members: dict[str, bytes], random: Random) -> None:
    old = random.choice(sorted(members))
    new = random.choice(("../x", "/x", "a/../../x", ".x", "a/b/c", "x\\y", "x\n", " ", "more"))
    members[new] = members.pop(old)


def edit_member(members: dict[str, bytes], random: Random) -> None:
    name = random.choice(sorted(members))
    members[name] = poison_bytes(members[name], random)


def same_members(workshop: Workshop, path: Path, ending: Ending) -> None:
    with zipfile.ZipFile(io.BytesIO(workshop.bundle)) as archive:
        whole = {archive.read(name) for name in archive.namelist()}
    for file in path.with_name("base").rglob("*"):
        known = file.name == "manifest.json" or file.is_dir() or file.read_bytes() in whole
        require(known, f"{file} was written")


KINDS: dict[str, Kind] = {
    "suite": Kind(toml_file("suite"), TOML, [lambda workshop, path: ["sweep", path, "--dry-run"]]),
    "preset": Kind(
        toml_file("preset"),
        TOML,
        [lambda workshop, path: new_run(workshop, "--agent.preset", path), suite_with_preset],
        [(run_module, "prepare_base")],
    ),
    "plan": Kind(toml_file("plan"), TOML, [lambda workshop, path: ["tune", path, "--dry-run"]]),
    "study": Kind(
        toml_file("study"),
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
    "status": Kind(display, (damage_any,) * 4, [lambda w, path: ["status", path.parents[1]]]),
    "demonstrations": Kind(
        demonstrations,
        (*BYTES, *map(beside, JSON[1:]), beside(edit_description), edit_arrays),
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
        policy_file,
        (*BYTES, damage_header, edit_tensors, edit_metadata),
        [lambda workshop, path: new_run(workshop, "--base-policy", path), RESUME],
        WORK,
        same_policy,
    ),
    "checkpoint": Kind(
        in_run("checkpoint.pt"),
        (*BYTES, set_trap, edit_state),
        [RESUME, EVALUATE],
        WORK,
        same_state,
    ),
    "bundle": Kind(
        bundle,
        (*BYTES, *map(rewrite, (edit_manifest, rename_member, edit_member))),
        [lambda workshop, path: ["fetch-bundle", path, "--out", path.with_name("base")]],
        check=same_members,
    ),
}
KINDS |= {
    "sealed policy": replace(
        KINDS["policy"], ways=[seal_policy], check=lambda workshop, path, ending: None
    ),
    "sealed checkpoint": replace(
        KINDS["checkpoint"],
        ways=[seal_archive, seal_state],
        check=lambda workshop, path, ending: None,
    ),
}
"""The sealed ones have wrong contents and the checksums that belong to them."""


# The command line of `symsteer run`.

VALUES = (
    *("-1", "0", "1", "7", "1e9", "nan", "inf", "-inf", "1e308", "-0.5", "0.5", "1.5", "+5", "16"),
    *("100000", "10000000000000", "9" * 26, "-" + "9" * 26, "1_0", "0x10", " 5", "4,5", "1e-320"),
    *("many", "", "None", "True", "PickCube-v1", "panda", "none", "D4", "C8", "E8", "C0", "SO2"),
    *("action_gain:0.5", "action_gain:0.5,wind:0.3", "action_gain:2", "wind:0.2+wind:0.3", "C97"),
    *("action_gain: 0.5", "action_gain:0.50", "action_gain:nan", "wind:+0.5", "wind:1e-3", "D1"),
    *("C999999999", "\x1b[31m", "a\nb", "x" * 3000, "../..", "-", "--", "ünï", "C8 C4", "diverse"),
)


def command(workshop: Workshop, number: int, folder: Path) -> Ending:
    """An option with an odd value, or a misspelt one; the other options keep their values."""
    random = Random(f"command {number}")
    policy = folder / "policy.safetensors"
    policy.write_bytes(workshop.run["policy.safetensors"])
    defaults = flat(workshop.config.to_json())
    # In turn, so that every option is tested; another agent or policy has other options.
    keys = sorted(set(defaults) - {"agent", "policy.name"})
    key = keys[number % len(keys)]
    option = "--" + key.replace("agent_options.", "agent.").replace("_", "-")
    at = random.randrange(3, len(option))
    odd = random.choice(
        (
            [option[:at] + random.choice("xy") + option[at + 1 :], "3"],
            *([option], ["--" + option, "1"], [key, "1"], ["--workers", random.choice(VALUES)]),
            *([option, random.choice(VALUES)] for _ in range(8)),
        )
    )
    with stopped_at((Trainer, "play")):
        ending = end_of([*new_run(workshop, "--base-policy", policy), *odd])
    if ending.kind == "accepted":
        trainer = ending.found[0]
        trainer.evaluator.close()
        found = flat(trainer.config.to_json())
        changed = {name for name in defaults if not alike(found[name], defaults[name])}
        require(changed <= {key}, f"{changed} have other values")
    return ending
