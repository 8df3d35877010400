"""Reading never executes: a stranger's files against every verb that takes a path (docs/trust.md).

What counts is not what a verb says but what it and its processes do: a file that hostile code
writes, the content of a secret file in any output, and the events of an audit hook.
"""

from __future__ import annotations

import importlib
import inspect
import os
import pkgutil
import signal
import sys
import tempfile
import time
import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import symsteer
from symsteer import cli
from symsteer.bench.bundles.bundle import write_bundle
from symsteer.bench.runs.config import Execution
from tests import hostile
from tests.bench.tiny_run import execute, tiny_config, write_suite
from tests.children import ROOT, start
from tests.fuzz.kinds import options_of

pytestmark = pytest.mark.long

WATCH = """
import os, sys

log, homes = os.environ.get("AUDIT"), os.environ.get("HOMES", "").split(os.pathsep)

def note(*words):
    fd = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.write(fd, (" ".join(map(str, words)) + "\\n").encode())
    os.close(fd)

def look(event, args):
    if event == "open" and isinstance(args[0], str) and args[2] & (os.O_WRONLY | os.O_RDWR):
        path = os.path.realpath(args[0])
        if path != log and not any(path.startswith(home) for home in homes):
            note("write", path)
    elif event in ("subprocess.Popen", "os.exec", "os.posix_spawn", "os.system"):
        note(event, args[0], args[1] if len(args) > 1 else "")
    elif event == "socket.connect" and not isinstance(args[1], str):  # not between processes
        note(event, args[1])
    elif event == "import" and args[0].startswith("evil"):
        note(event, args[0])

if log:
    sys.addaudithook(look)
"""

SECRET = 0.31830988

UNREAD = 10**9
"""Time at which the secret was last read: a file system notes the next time."""

SECONDS = 3
"""After so long a verb that goes on working is ended."""

IMPORT_ALL = """
import importlib, pkgutil, symsteer
modules = [module.name for module in pkgutil.walk_packages(symsteer.__path__, "symsteer.")]
list(map(importlib.import_module, modules))
print("imported", len(modules))
class Agent: pass
"""

SMALL = {
    **{"count": 1, "episodes": 1, "states": 1, "resets": 2, "repeats": 1, "seeds": 1},
    **{"demonstrations": 1, "num_envs": 1, "workers": 1, "cores": 1},
}
"""Options that keep a verb short that does not refuse."""

TEMPORARY = f"{tempfile.gettempdir()}/tmp"

HARMLESS = (
    *("/proc", "/ldconfig", "ffmpeg", "/gcc", "/ld", "uname", "lscpu", "nvidia-smi", "fc-list"),
)
"""Programs that torch, matplotlib and Python's platform module ask about the machine."""


@pytest.fixture(scope="session")
def intact(tmp_path_factory) -> Path:
    """Folder of an intact run, with demonstrations and base policy beside it."""
    out = tmp_path_factory.mktemp("intact")
    run = execute(tiny_config(agent="base"), out)
    write_bundle(run, out / "bundle.zip")
    # A fork need not import again what is imported here; `launch` takes over signals.
    for module in pkgutil.walk_packages(symsteer.__path__, "symsteer."):
        if module.name not in ("symsteer.launch", "symsteer.__main__"):
            importlib.import_module(module.name)
    return run


@pytest.fixture
def strangers(intact, tmp_path, monkeypatch) -> types.SimpleNamespace:
    """The hostile folder, as the current one, and where its effects would be seen."""
    home = tmp_path / "home"
    home.mkdir()
    secret = home / "secret.h5"
    with h5py.File(next(intact.parent.glob("base/*.h5"))) as demos, h5py.File(secret, "w") as file:
        file["obs"] = np.full_like(demos["traj_0/obs"], SECRET)
    os.utime(secret, (UNREAD, UNREAD + 1))
    place = tmp_path / "place"
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("CANARY", str(tmp_path / "CANARY"))
    monkeypatch.setenv("AUDIT", str(tmp_path / "audit"))
    monkeypatch.setenv("HOMES", os.pathsep.join((f"{tempfile.gettempdir()}/", "/dev")))
    watch = tmp_path / "watch"
    watch.mkdir()
    (watch / "sitecustomize.py").write_text(WATCH)
    # It can be imported: consent alone keeps it from being executed.
    (watch / "evilmod.py").write_text(hostile.CODE.format("evilmod") + "class Evil: pass\n")
    monkeypatch.syspath_prepend(watch)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (watch, ROOT))))
    artefacts = hostile.make(place, intact, intact.parent / "bundle.zip", secret)
    (tmp_path / "audit").touch()
    # `report --check` reads all committed records, a thousand of them.
    monkeypatch.setattr("symsteer.leaderboard.command.RECORDS", tmp_path / "committed")
    monkeypatch.chdir(place)
    return types.SimpleNamespace(place=place, artefacts=artefacts, secret=secret, top=tmp_path)


def takes_paths(kind: Any) -> bool:
    return Path in (kind, *typing.get_args(kind)) or kind is str or str in typing.get_args(kind)


def ways(name: str, artefact: Path, intact: Path) -> Iterator[list[str]]:
    """Every command line of a verb with the artefact in place of one path, name or text."""
    if name == "run":
        paths = [field.name for field in fields(Execution) if field.type in ("Path", "Path | None")]
        for option in (*paths, "agent.preset"):
            place = [] if option == "runs" else ["--runs", "made"]
            yield [name, *options_of(SHORT), f"--{option.replace('_', '-')}", str(artefact), *place]
        return
    verb = cli.VERBS[name]
    module, _, attribute = verb.target.partition(":")
    function: Callable[..., int] = getattr(importlib.import_module(module), attribute)
    hints = typing.get_type_hints(function)
    parameters = inspect.signature(function).parameters.values()
    for chosen in parameters:
        if not takes_paths(hints[chosen.name]) or chosen.name == "trust":
            continue
        words, options = [name], []
        for p in parameters:
            value = str(SMALL[p.name]) if p.name in SMALL else None
            if p is chosen:
                value = str(artefact)
            # The committed ones are many.
            elif p.name == "records" or (name, p.name) == ("advise", "runs"):
                value = str(intact)
            elif p.default is p.empty:
                value = "made.zip" if p.name == "out" else "standard"
            if value is not None and (p.kind == p.POSITIONAL_ONLY or p.name == "records"):
                words.append(value)
            elif value is not None:
                options += [f"--{p.name.replace('_', '-')}", value]
        yield words + options
        if name == "report":
            yield [*words, *options, "--check"]


SHORT = tiny_config(agent="base")


def forked(arguments: list[str], place: Path) -> str:
    """Run the command line in a fork, watched; what it printed."""
    shown = place.parent / "shown"
    child = os.fork()
    if child == 0:
        os.setsid()
        file = os.open(shown, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1), os.dup2(file, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        os.chdir(place)
        code = 99
        try:
            exec(WATCH, {})
            sys.argv = ["symsteer", *arguments]
            from symsteer.launch import main  # not in the process of the tests: it takes signals

            code = main()
        except SystemExit:
            code = 2
        except BaseException:
            import traceback

            traceback.print_exc()
        finally:
            sys.stdout.flush(), sys.stderr.flush()
            os._exit(code if isinstance(code, int) else 1)
    end = time.monotonic() + SECONDS
    while os.waitpid(child, os.WNOHANG) == (0, 0):
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.01)
    return shown.read_text(errors="replace")


def check(strangers: Any, arguments: list[str], shown: str) -> None:
    """Nothing was executed, disclosed, or written or started elsewhere."""
    canary = strangers.top / "CANARY"
    assert not canary.exists(), (canary.read_text(), arguments, shown)
    assert "Traceback" not in shown, (arguments, shown)
    events = (strangers.top / "audit").read_text().splitlines()
    known = (sys.executable, f"-C', '{ROOT}", f"-C', '{TEMPORARY}", *HARMLESS)
    bad = [event for event in events if not any(word in event for word in known)]
    assert not bad, (bad, arguments)
    assert strangers.secret.stat().st_atime == UNREAD, (arguments, "the secret was read")
    assert strangers.secret.stat().st_mtime == UNREAD + 1, (arguments, "the secret was written to")
    assert not (Path(os.environ["HOME"]) / "lock-target").exists(), arguments


@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", list(cli.VERBS))
def test_no_verb_is_harmed_by_any_file(name, whole, intact, strangers):
    """Every file in every place; or every file in one place, and every place with some files."""
    tried = 0
    for index, artefact in enumerate(strangers.artefacts):
        lines = list(ways(name, artefact, intact))
        for arguments in lines if whole else lines[index % max(1, len(lines)) :][:1]:
            check(strangers, arguments, forked(arguments, strangers.place))
            tried += 1
    print(f"{name}: {tried} command lines")


def test_nothing_is_imported_from_the_current_folder(strangers):
    """A program of its own, whose user names a module that imports every other one."""
    watch = strangers.top / "place-watch"
    watch.mkdir()
    (watch / "every.py").write_text(IMPORT_ALL)
    arguments = ["run", "--agent", "every:Agent"]
    child = start(*arguments, watch=WATCH, cwd=strangers.place)
    shown = "".join(child.communicate(timeout=120))
    assert "imported" in shown
    check(strangers, arguments, shown)


def test_processes_import_nothing_from_the_current_folder(strangers):
    """Those of a sweep, and those that share a simulation."""
    suite = write_suite(strangers.top, SHORT, "seed = [0, 1]")
    for arguments in (
        ["sweep", suite, "--workers", "2", "--runs", "made"],
        ["run", *options_of(SHORT), "--sim-workers", "2", "--runs", "shards"],
    ):
        child = start(*arguments, watch=WATCH, cwd=strangers.place)
        shown = "".join(child.communicate(timeout=300))
        assert child.returncode == 0, shown
        assert "no picture" not in shown  # a matplotlibrc there asks for LaTeX
        check(strangers, arguments, shown)
