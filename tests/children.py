"""Programs as a user starts them, watched with all processes that they start."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def start(*arguments: str | Path, watch: str, cwd: Path, **variables: str) -> subprocess.Popen[str]:
    """Start ``symsteer``, which with all that it starts executes a ``sitecustomize`` first.

    Args:
        arguments: of the command line.
        watch: text of the module ``sitecustomize``.
        cwd: the current folder.
        variables: of the environment.
    """
    folder = cwd.parent / f"{cwd.name}-watch"
    folder.mkdir(exist_ok=True)
    (folder / "sitecustomize.py").write_text(watch)
    path = os.pathsep.join(map(str, (folder, ROOT)))
    return subprocess.Popen(
        [sys.executable, "-m", "symsteer", *map(str, arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", **variables},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A test suite that runs in the background has its children ignore interrupts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
