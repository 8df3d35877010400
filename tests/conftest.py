"""One thread a process: sums then do not depend on the machine, and tests run as processes."""

import os
import signal

import pytest

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # A shell starts programs in the background so; tests interrupt themselves.
    signal.signal(signal.SIGINT, signal.default_int_handler)

import torch  # noqa: E402  (reads the number of threads when it is imported)

torch.set_num_threads(1)


@pytest.fixture
def command(monkeypatch, capsys):
    """Calls the program with words: gives its exit code, and what it has written."""
    from symsteer.cli import main

    def call(*words):
        monkeypatch.setattr("sys.argv", ["symsteer", *map(str, words)])
        try:
            code = main()
        except SystemExit as error:
            code = int(error.code or 0)
        return code, capsys.readouterr()

    return call
