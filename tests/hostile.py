"""A folder as a stranger might send it: every file in it tries to make its reader execute code, to
disclose another file, or to write elsewhere."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from symsteer.bench.bundles.fetch import MANIFEST, read_bundle
from symsteer.leaderboard.records import config_hash, run_id_of
from tests.fuzz.kinds import read_policy, write_sealed_policy

EVIL = "evilmod:Evil"

CODE = "import os; open(os.environ['CANARY'], 'a').write('{} ')\n"
"""What a module writes that nobody should import."""

SHADOWS = (
    *("__future__", "runpy", "signal", "typing", "json", "torch", "numpy", "tyro", "gymnasium"),
    *("sapien", "mani_skill", "matplotlib", "pydantic", "pebble", "tqdm", "git", "agents", "h5py"),
)
"""Modules that the current folder has, too."""

GIT = """
[core]
    repositoryformatversion = 0
    fsmonitor = "echo git >> $CANARY; false"
    hooksPath = hooks
    sshCommand = "echo ssh >> $CANARY; false"
    pager = "echo pager >> $CANARY; cat"
[filter "evil"]
    clean = "echo filter >> $CANARY; cat"
    smudge = "echo filter >> $CANARY; cat"
[diff]
    external = "echo diff >> $CANARY; cat"
[remote "origin"]
    url = ssh://nobody@127.0.0.1/x
    promisor = true
[extensions]
    partialClone = origin
"""

STUDY = """
declared = "0123456789abcdef0123456789abcdef01234567"
[[claim]]
name = "faster"
family = "a"
measure = "auc"
agents = ["equivariant", "standard"]
predicted = 1
smallest = 0.05
"""

SUITES = {
    "agent": f'[grid]\nagent = ["{EVIL}"]\n',
    "task": f'[grid]\ntask = ["{EVIL}"]\n',
    "variant": f'[grid]\nvariant = ["{EVIL}:0.5"]\n',
    "policy": f'[run]\npolicy = "{EVIL}"\n[grid]\nseed = [0]\n',
    "tasks": f'[run.policy]\nname = "edp-joint"\ntasks = ["{EVIL}"]\n[grid]\nseed = [0]\n',
}

PLAN = f"""
agents = ["{EVIL}"]
[grid]
task = ["PushCube-v1"]
[confirm]
task = ["PickCube-v1"]
[space]
lr = [1e-4, 1e-3]
"""


def make(place: Path, run: Path, bundle: Path, secret: Path) -> list[Path]:
    """Write the hostile folder.

    Args:
        place: a new folder.
        run: folder of an intact run.
        bundle: an intact bundle of its base policy and demonstrations.
        secret: a file of the reader that must not be disclosed, in HDF5.

    Returns:
        Everything that a verb could be given, the folder itself included.
    """
    place.mkdir()
    for name in (*SHADOWS, "evilmod", "evilplug"):
        (place / f"{name}.py").write_text(CODE.format(name) + "class Evil: pass\n")
    for name in ("multiprocessing", "symsteer_lab"):
        (place / name).mkdir()
        (place / name / "__init__.py").write_text(CODE.format(name))
    info = place / "evilx-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evilx\nVersion: 1.0\n")
    groups = (
        "pydantic",
        "symsteer.agents",
        "symsteer.tasks",
        "symsteer.variants",
        "wandb.triggers",
    )
    points = "".join(f"[{group}]\nevil = evilplug:Evil\n" for group in groups)
    (info / "entry_points.txt").write_text(points)
    (place / "matplotlibrc").write_text("backend: module://evilplug\ntext.usetex: True\n")
    _repository(place / ".git")
    _repository(place / "bare.git")  # found by git in its own folder, too
    (place / ".gitattributes").write_text("* filter=evil diff=evil\n")

    suites = {f"suite-{key}.toml": text for key, text in SUITES.items()}
    for name, text in {**suites, "study.toml": STUDY, "plan.toml": PLAN}.items():
        (place / name).write_text(text)
    shutil.copy(place / "study.toml", place / "bare.git" / "study.toml")
    runs = place / "runs"
    config = json.loads((run / "config.json").read_text())
    for kind in ("agent", "task", "variant", "policy"):
        _run(runs, run, config, kind)
    policy = place / "policy.safetensors"
    _policy(run / "policy.safetensors", policy, EVIL)
    _policy(run / "policy.safetensors", place / "world" / "policy.safetensors", "edp", EVIL)
    demos = _demonstrations(place, run.parent / "base", secret)
    _bundle(place / "bundle.zip", bundle, policy)
    settings = {"task": EVIL, "embodiment": "floating", "variant": f"{EVIL}:0.5", "group": "C8"}
    (place / "audit").mkdir()
    (place / "audit" / "audit.json").write_text(json.dumps({"settings": settings}))
    for folder in (place / "audit" / "summary.json", place / "summary.json"):
        folder.write_text(json.dumps([{**settings, "defect": 0.5}]))
    sweeps = runs / "sweeps"
    sweeps.mkdir()
    for name in ("suite-agent.log", "smoke.log"):
        (sweeps / name).symlink_to(secret)
    return [
        *(place / name for name in suites),
        *(place / "study.toml", place / "bare.git" / "study.toml", place / "plan.toml"),
        *sorted(folder for folder in runs.iterdir() if folder.name != "sweeps"),
        *(folder / "record.json" for folder in sorted(runs.glob("*=*"))),
        *(policy, place / "world", *demos, place / "bundle.zip"),
        *(place / "audit", place / "summary.json", runs, place),
    ]


def _repository(folder: Path) -> None:
    subprocess.run(["git", "init", "--bare", "--quiet", folder], check=True)
    (folder / "config").write_text(GIT)
    (folder / "hooks").mkdir(exist_ok=True)
    for name in ("post-index-change", "reference-transaction", "pre-auto-gc"):
        (folder / "hooks" / name).write_text("#!/bin/sh\necho hook >> $CANARY\n")
        (folder / "hooks" / name).chmod(0o755)


def _run(runs: Path, intact: Path, config: dict[str, Any], kind: str) -> None:
    """A run folder whose configuration and record name code as if they had always done so."""
    data = json.loads(json.dumps(config))
    if kind == "policy":
        data["policy"]["name"] = EVIL
    else:
        data[kind] = f"{EVIL}:0.5" if kind == "variant" else EVIL
    name = run_id_of({"files": {}, **data})
    folder = runs / (name if kind != "policy" else f"{name}-policy=Evil")
    shutil.copytree(intact, folder)
    (folder / "config.json").write_text(json.dumps(data))
    record = json.loads((intact / "record.json").read_text())
    extension = {"kind": kind, "name": EVIL, "target": EVIL, "distribution": None, "version": None}
    record |= {"config": data, "config_hash": config_hash(data), "run_id": name}
    record["provenance"]["extensions"] = [{**extension, "sha256": "0" * 64}]
    (folder / "record.json").write_text(json.dumps(record))
    (folder / ".lock").unlink(missing_ok=True)
    (folder / ".lock").symlink_to(Path(os.environ["HOME"]) / "lock-target")
    if kind == "policy":
        _policy(intact / "policy.safetensors", folder / "policy.safetensors", EVIL)


def _policy(intact: Path, path: Path, name: str, task: str | None = None) -> None:
    """A policy file that names another class, or another task, with its checksum mended."""
    path.parent.mkdir(exist_ok=True)
    data = read_policy(intact)
    data["policy"]["name"] = name
    if task:
        data["policy"]["report"]["world"]["task"] = task
    write_sealed_policy(path, data)


def _demonstrations(place: Path, base: Path, secret: Path) -> list[Path]:
    """Trajectories whose observations are in another file, in three ways."""
    intact = next(base.glob("*.h5"))
    description = json.loads(intact.with_suffix(".json").read_text())
    made = []
    for how in ("link", "storage", "virtual"):
        path = place / f"{how}.h5"
        shutil.copy(intact, path)
        (path.with_suffix(".json")).write_text(json.dumps(description))
        with h5py.File(path, "r+") as file:
            group = file["traj_0"]
            shape = group["obs"].shape
            del group["obs"]
            if how == "link":
                group["obs"] = h5py.ExternalLink(str(secret), "obs")
            elif how == "storage":
                size = int(np.prod(shape)) * 4
                group.create_dataset("obs", shape, np.float32, external=[(str(secret), 0, size)])
            else:
                layout = h5py.VirtualLayout(shape, np.float32)
                layout[:] = h5py.VirtualSource(str(secret), "obs", shape)
                group.create_virtual_dataset("obs", layout)
        made.append(path)
    return made


def _bundle(path: Path, intact: Path, policy: Path) -> None:
    """A bundle whose policy names code; its hashes are right."""
    import zipfile

    manifest, contents = read_bundle(intact)
    data = manifest.model_dump()
    name = manifest.path("policy")
    assert name is not None
    contents[name] = policy.read_bytes()
    for file in data["files"]:
        file["size"] = len(contents[file["path"]])
        file["sha256"] = hashlib.sha256(contents[file["path"]]).hexdigest()
    data["task"] = EVIL
    contents[MANIFEST] = json.dumps(data).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for member, content in contents.items():
            archive.writestr(member, content)
