"""The command ``symsteer``: finds a verb, reads its arguments, turns errors into exit codes.

Only the module of the given verb is imported. So ``symsteer --help`` does not import torch or
ManiSkill, and ``symsteer doctor`` works even if they cannot be imported.
"""

from __future__ import annotations

import errno
import functools
import importlib
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from symsteer.bench.sim.errors import WorkerLostError
from symsteer.bench.sim.versions import first_warning
from symsteer.errors import UserError
from symsteer.hints import check_options
from symsteer.names import unknown
from symsteer.registry import summary_of
from symsteer.terminal import careful_output, complain, folded

ABOUT = "How much symmetry should an RL agent keep when it steers an equivariant diffusion policy?"

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Verb:
    """A verb of the command line.

    Attributes:
        target: ``module:function``; the function returns the exit code, and the first line of its
            docstring says in the list of verbs what it does.
        computes: whether it uses torch; then the number of threads is set.
        parses: whether the function parses the list of arguments itself. For all others, tyro
            parses them from the function's signature.
    """

    target: str
    computes: bool = True
    parses: bool = False


BENCH = "symsteer.bench.cli"

GROUPS = {
    "run experiments": {
        "demo": Verb("symsteer.demo:demo"),
        "run": Verb(f"{BENCH}:run", parses=True),
        "resume": Verb(f"{BENCH}:resume"),
        "sweep": Verb(f"{BENCH}:sweep"),
        "status": Verb(f"{BENCH}:status", computes=False),
        "tune": Verb(f"{BENCH}:tune"),
    },
    "look at results": {
        "report": Verb("symsteer.leaderboard.command:report", computes=False),
        "site": Verb("symsteer.leaderboard.command:site", computes=False),
        "compare": Verb("symsteer.leaderboard.command:compare", computes=False),
        "evaluate": Verb(f"{BENCH}:evaluate"),
        "film": Verb(f"{BENCH}:film"),
        "reproduce": Verb(f"{BENCH}:reproduce"),
    },
    "demonstrations and base policies": {
        "demos": Verb(f"{BENCH}:demos"),
        "export": Verb(f"{BENCH}:export"),
        "export-lerobot": Verb(f"{BENCH}:export_lerobot"),
        "fetch-bundle": Verb(f"{BENCH}:fetch_bundle", computes=False),
    },
    "broken symmetry, and agents": {
        "audit": Verb(f"{BENCH}:audit"),
        "audit-episodes": Verb(f"{BENCH}:audit_episodes"),
        "advise": Verb("symsteer.advise:advise"),
        "new": Verb("symsteer.agents.new:new", computes=False),
    },
    "what there is": {
        "list": Verb(f"{BENCH}:list_names", computes=False),
        "doctor": Verb("symsteer.bench.sim.capabilities:doctor", computes=False, parses=True),
        "throughput": Verb(f"{BENCH}:throughput"),
    },
}
"""The verbs by what one wants to do."""

VERBS = {name: verb for verbs in GROUPS.values() for name, verb in verbs.items()}

REMOVED = {
    "base": "`symsteer sweep policies` compares base policies",
    "detect": "`symsteer audit` measures how broken a task is; no detector was reliable",
}
"""Verbs of earlier versions, and what there is in their place."""


def main() -> int:
    """Run the verb that the command line names.

    Returns:
        The exit code: 0 done, 1 something failed, 2 the input is wrong.
    """
    # Warnings of other packages about optional parts that SymSteer does not use.
    warnings.filterwarnings("ignore", message=".*py3nj.*")
    warnings.filterwarnings("ignore", message="Failed to find system libvulkan.*")
    try:
        with careful_output():
            return _run(sys.argv[1:])
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    except WorkerLostError as error:
        return complain(error, f"error: {error}", 1)
    except ImportError as error:
        # A package of others, or a library that it needs. One of our own is a bug.
        if (error.name or "").partition(".")[0] == "symsteer":
            raise
        cure = "`symsteer doctor` says what to install"
        return complain(error, f"error: a package cannot be imported: {error}; {cure}", 1)
    except BrokenPipeError:
        # The reader closed the pipe.
        return 128 + signal.SIGPIPE
    except OSError as error:
        # A path that cannot be read or written. An error without a path is a bug.
        if error.filename is None:
            raise
        cure = "free space" if error.errno in DISK_FULL else "choose another path"
        return complain(error, f"error: {error.filename}: {error.strerror}; {cure}", 2)
    except (MemoryError, RuntimeError) as error:
        if not _is_out_of_memory(error):
            raise
        return complain(
            error,
            "error: this machine has too little memory for what was asked; lower the numbers of "
            "environments and episodes, the replay capacity or the networks' width",
            2,
        )


def _run(arguments: Sequence[str]) -> int:
    """Run a verb; without a verb or with --help, print the list of verbs."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_overview())
        return 0
    name, *rest = arguments
    if name == "--version":
        from symsteer import __version__

        print(f"symsteer {__version__}")
        return 0
    if name in REMOVED:
        raise UserError(f"the verb {name!r} was removed in version 0.3.0; {REMOVED[name]}")
    if name not in VERBS:
        raise unknown("verb", name, VERBS)
    check_options(name, rest)
    verb = VERBS[name]
    module, _, attribute = verb.target.partition(":")
    function: Callable[..., int] = getattr(importlib.import_module(module), attribute)

    @functools.wraps(function)
    def work(*args: object, **options: object) -> int:
        if verb.computes:
            # A run goes on when its terminal is closed.
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
            _limit_threads()
            if warning := first_warning():
                print(f"warning: {warning}", file=sys.stderr)
        return function(*args, **options)

    if verb.parses:
        if name == "run":
            from symsteer.bench.runs.brief import brief, wants_brief

            if wants_brief(rest):
                print(brief())
                return 0
        return work(rest)
    import tyro

    return tyro.cli(work, prog=f"symsteer {name}", args=rest)


def _overview() -> str:
    """The help text of ``symsteer``."""
    lines = ["usage: symsteer VERB [OPTIONS]", "", folded("", ABOUT)]
    for title, verbs in GROUPS.items():
        lines += ["", f"{title}:"]
        lines += [folded(f"  {name:14s} ", summary_of(verb.target)) for name, verb in verbs.items()]
    lines += ["", "symsteer VERB --help: the options of a verb; symsteer --version: the version"]
    return "\n".join(lines)


def _limit_threads() -> None:
    """Let torch use one thread, or the number in OMP_NUM_THREADS.

    The networks are small: more threads make them slower, especially when several runs share a
    machine.
    """
    import torch

    torch.set_num_threads(_threads(os.environ.get("OMP_NUM_THREADS", "")))


def _threads(wanted: str) -> int:
    """The first number in OMP_NUM_THREADS (it may be a list); 1 if there is none."""
    number = re.match(r"\s*0*([1-9]\d{0,3})\b", wanted)
    return int(number[1]) if number else 1


def _is_out_of_memory(error: Exception) -> bool:
    # torch raises OutOfMemoryError on CUDA, a plain RuntimeError on the CPU.
    torch = sys.modules.get("torch")
    on_cuda = torch is not None and isinstance(error, torch.OutOfMemoryError)
    return on_cuda or isinstance(error, MemoryError) or "allocate memory" in str(error)
