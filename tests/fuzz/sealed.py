"""Files whose checksums are right and whose content is wrong, each read in a process of its own.

``SEALED[name](workshop, random, folder)`` damages a file of a kind, or leaves it as it is where
``random`` is None, mends its checksums, gives it to the command line and returns how that ended.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import signal
import tomllib
import traceback
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from symsteer.bench.runs import run as run_module
from symsteer.bench.runs.checkpoint import CHECKSUM_BYTES
from symsteer.bench.runs.trainer import Trainer
from symsteer.leaderboard import report
from symsteer.policies.files import _sha256, load_policy
from tests.bench.tuning.tiny_plan import TEXT as PLAN
from tests.fuzz.judge import Ending, end_of, stopped_at
from tests.fuzz.kinds import SUITE, Workshop, _poison_tensors, _sealed, to_toml
from tests.fuzz.mutate import POISON, places, poison_bytes, poison_data, poison_lines

SECONDS = 60
"""The longest that reading a damaged file may take: a limit for hangs."""

STUDY = Path(report.__file__).parent / "studies" / "paper.toml"

PRESET: dict[str, Any] = {
    "all": {"lr": 1e-3, "utd": 0.5, "layer_norm": True, "reduce": "min", "batch_size": 64},
    "equivariant": {"critics": 2, "lr": 2e-3},
    "standard": {"width": 64},
}


def nested(depth: int, kind: int = 0) -> Any:
    """Lists or tables in each other."""
    value: Any = 1
    for _ in range(depth):
        value = [value] if kind else {"a": value}
    return value


def poisoned(data: Any, random: Random) -> Any:
    """Plain data with some values of other types, sizes or depths."""
    data = poison_data(data, random, random.choice((1, 1, 2, 3)))
    if random.random() < 0.2 and (found := places(data)):
        container, key = random.choice(found)
        container[key] = random.choice(
            (
                nested(random.choice((3, 40, 150)), random.randrange(2)),
                2**40,
                10**9,
                -(10**9),
                20000,
            )
        )
    return data


def toml(data: dict[str, Any], random: Random) -> bytes:
    """A damaged TOML file."""
    kind = random.randrange(10)
    if kind == 0:
        return poison_bytes(to_toml(data).encode(), random)
    if kind == 1:
        return poison_lines(to_toml(data), random).encode()
    if kind == 2:
        table, depth = random.choice(list(data)), random.choice((20, 200, 900, 5000))
        deep = (
            f"[{table}.{'.'.join('a' * depth)}]\nb = 1\n",
            f"[more.{'.'.join('a' * depth)}]\nb = 1\n",
            f"{table} = {'[' * depth}{']' * depth}\n",
            f"{table}.x = {'{a=' * depth}1{'}' * depth}\n",
        )
        return random.choice(deep).encode()
    if kind == 3:
        values = (
            "1",
            "1979-05-27",
            "nan",
            "-inf",
            "1e400",
            "[]",
            "[[]]",
            "''",
            "[1]",
            "{}",
            "9e99",
        )
        return f"{random.choice(list(data))} = {random.choice(values)}\n".encode()
    return to_toml(poisoned(data, random)).encode("utf-8", "surrogatepass")


def preset(workshop: Workshop, random: Random | None, folder: Path) -> Ending:
    """A preset, read by ``symsteer run`` or named by a suite."""
    path, suite = folder / "mutant.toml", folder / "suite.toml"
    path.write_bytes(toml(PRESET, random) if random else to_toml(PRESET).encode())
    if random and random.random() < 0.5:
        grid = {**SUITE["grid"], "agent.preset": [str(path)]}
        suite.write_text(to_toml({"grid": grid}))
        return end_of(["sweep", suite, "--dry-run", "--out", folder / "runs"], ["mutant.toml"])
    with stopped_at((run_module, "prepare_base")):
        agent = random.choice(("standard", "equivariant", "zero")) if random else "standard"
        arguments = ["--agent", agent, "--agent.preset", path, "--out", folder / "runs"]
        return end_of(["run", "--quiet", *arguments], ["mutant.toml"])


def plan(workshop: Workshop, random: Random | None, folder: Path) -> Ending:
    """A tuning plan, read by ``symsteer tune``."""
    path = folder / "mutant.toml"
    text = PLAN + "[[further]]\nlr = 1e-2\ncritics = 4\n[run.agent]\ntau = 0.1\n"
    path.write_bytes(toml(tomllib.loads(text), random) if random else text.encode())
    return end_of(["tune", path, "--dry-run"], ["mutant.toml"])


def study(workshop: Workshop, random: Random | None, folder: Path) -> Ending:
    """A study, read by ``symsteer report``."""
    path, record = folder / "mutant.toml", folder / "a.json"
    path.write_bytes(
        toml(tomllib.loads(STUDY.read_text()), random) if random else STUDY.read_bytes()
    )
    record.write_text(workshop.records["a"])
    with stopped_at((report, "render")):
        return end_of(["report", record, "--study", path, "--out", folder / "board"], ["mutant"])


def policy(workshop: Workshop, random: Random | None, folder: Path) -> Ending:
    """A base policy, read by ``symsteer run``, ``resume`` or ``evaluate``."""
    run = workshop.restore_run(folder)
    path = run / "policy.safetensors"
    if random:
        with safe_open(path, framework="pt") as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            meta = dict(file.metadata())
        said = json.loads(meta["policy"])
        if random.random() < 0.3:
            tensors = _poison_tensors(tensors, random)
            tensors = {k: v for k, v in tensors.items() if isinstance(v, torch.Tensor)}
            intact = load_policy(path)
            try:
                intact.load_state_dict(tensors)
                said["content_hash"] = intact.content_hash()
            except RuntimeError:
                pass
        elif random.random() < 0.4:
            part = random.choice(("options", "report", "obs_layout", "act_layout"))
            said[part] = poisoned(said[part], random)
        else:
            said["training_record"].pop("losses", None)
            said = poisoned(said, random)
        meta["policy"] = json.dumps(said)
        meta["policy_sha256"] = _sha256(meta["policy"])
        save_file({k: v.contiguous() for k, v in tensors.items()}, path, meta)
    new = ["run", "--quiet", "--base-policy", path, "--out", folder / "runs", *workshop.options]
    verb = random.choice((new, ["resume", run], ["evaluate", run])) if random else new
    with stopped_at((Trainer, "play"), (run_module, "Evaluator")):
        return _closed(end_of(verb, ["policy.safetensors", workshop.run_id]))


def checkpoint(workshop: Workshop, random: Random | None, folder: Path) -> Ending:
    """A checkpoint, read by ``symsteer resume`` or ``evaluate``."""
    run = workshop.restore_run(folder)
    path = run / "checkpoint.pt"
    archive = path.read_bytes()[:-CHECKSUM_BYTES]
    if random and random.random() < 0.3:
        path.write_bytes(_sealed(poison_bytes(archive, random)))
    elif random:
        file = torch.load(io.BytesIO(archive), weights_only=True)
        for _ in range(random.choice((1, 1, 2))):
            inner = random.choice([file["state"], file["state"]["agent"], file["state"]["replay"]])
            if isinstance(inner, dict) and inner:
                _poison_state(inner, random)
            if not all(isinstance(file["state"].get(k), dict) for k in ("agent", "replay")):
                break
        buffer = io.BytesIO()
        torch.save(file, buffer, _use_new_zipfile_serialization=random.random() < 0.95)
        path.write_bytes(_sealed(buffer.getvalue()))
    verb = random.choice(("resume", "evaluate")) if random else "resume"
    with stopped_at((Trainer, "play"), (run_module, "Evaluator")):
        return _closed(end_of([verb, run], ["checkpoint.pt", "record.json", "policy.safetensors"]))


def _poison_state(state: dict[str, Any], random: Random) -> None:
    kind = random.randrange(8)
    key = random.choice(sorted(state, key=str))
    if kind == 0:
        state[key] = torch.zeros(1).expand(10**9)
    elif kind == 1:
        state[key] = nested(random.choice((50, 200)), random.randrange(2))
    elif kind == 2:
        state[key] = random.choice(POISON)
    elif kind == 3:
        state[random.choice((key, "more"))] = random.choice(
            (torch.zeros(0, 2**40), torch.zeros(3, dtype=torch.complex64), torch.zeros(()), {})
        )
    else:
        _poison_tensors(state, random)


def _closed(ending: Ending) -> Ending:
    if ending.kind == "accepted" and isinstance(ending.found[0], Trainer):
        ending.found[0].evaluator.close()
        ending.found = None
    return ending


Runner = Callable[[Workshop, Random | None, Path], Ending]

SEALED: dict[str, Runner] = {
    "preset": preset,
    "plan": plan,
    "study": study,
    "policy": policy,
    "checkpoint": checkpoint,
}


def in_child(work: Callable[[], Ending]) -> tuple[str, str, int]:
    """How work ends in a fork of this process: its kind, its sentence, and its peak of memory."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(read)
            signal.alarm(SECONDS)
            ending = work()
            answer = ending.kind, ending.sentence
        except BaseException:
            answer = "failed", traceback.format_exc()[-1500:]
        with os.fdopen(write, "wb") as pipe:
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            pickle.dump((*answer, peak), pipe)
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    return pickle.loads(told) if told else ("failed", f"ended by signal {status}", 0)
