"""The beginning and the end of the program, in this process: signals, errors, lost output."""

from __future__ import annotations

import atexit
import errno
import importlib
import os
import signal
import sys
import time

import pytest

from symsteer import cli
from symsteer.bench.sim.errors import WorkerLostError
from symsteer.errors import UserError
from symsteer.terminal import LONGEST_LINE, _Output, complain


@pytest.fixture
def launch(monkeypatch):
    """The module, imported anew; what it takes over is given back."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr(atexit, "register", lambda function: function)
    sys.modules.pop("symsteer.launch", None)
    yield importlib.import_module("symsteer.launch")
    del sys.modules["symsteer.launch"]
    for number, handler in handlers.items():
        signal.signal(number, handler)


def send(number):
    os.kill(os.getpid(), number)
    time.sleep(5)


def in_an_import(tmp_path):
    """A signal while a module catches every exception: it is given again."""
    kill = f"os.kill({os.getpid()}, {int(signal.SIGINT)})"
    text = f"import os\ntry: {kill}\nexcept BaseException: pass\n"
    (tmp_path / "catches.py").write_text(text)
    sys.path.insert(0, str(tmp_path))
    try:
        importlib.import_module("catches")
    finally:
        del sys.path[0], sys.modules["catches"]
    time.sleep(5)


@pytest.mark.parametrize(
    ("work", "code", "said"),
    [
        (lambda path: 3, 3, ""),
        (lambda path: send(signal.SIGINT), 130, "interrupted\n"),
        (lambda path: send(signal.SIGTERM), 143, "terminated\n"),
        (in_an_import, 130, "interrupted\n"),
    ],
)
def test_a_signal_ends_the_program_in_order(
    work, code, said, launch, monkeypatch, capsys, tmp_path
):
    monkeypatch.setattr(cli, "main", lambda: work(tmp_path))
    assert launch.main() == code
    assert capsys.readouterr().err == said


def test_the_third_signal_ends_the_program_at_once(launch, monkeypatch, capfd):
    codes = []
    monkeypatch.setattr(os, "_exit", codes.append)
    monkeypatch.setattr(launch._thread, "start_new_thread", lambda *_: None)
    for _ in range(launch.PATIENCE):
        launch._receive(signal.SIGTERM, None)
    assert (codes, capfd.readouterr().err) == ([143], "terminated\n")


def test_a_bug_is_no_signal(launch, monkeypatch):
    monkeypatch.setattr(cli, "main", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        launch.main()


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (UserError("wrong"), 2, "error: wrong"),
        (WorkerLostError("a worker"), 1, "error: a worker"),
        (BrokenPipeError(), 141, ""),
        (OSError(errno.ENOSPC, "full", "x.h5"), 2, "error: x.h5: full; free space"),
        (OSError(errno.EACCES, "denied", "x.h5"), 2, "choose another path"),
        (MemoryError(), 2, "too little memory"),
        (RuntimeError("can't allocate memory"), 2, "too little memory"),
        (OSError("no path"), None, ""),
        (RuntimeError("a bug"), None, ""),
    ],
)
def test_errors_become_exit_codes(error, code, words, monkeypatch, capsys):
    def work(arguments):
        raise error

    monkeypatch.setattr(cli, "_run", work)
    if code is None:
        with pytest.raises(type(error)):
            cli.main()
    else:
        assert cli.main() == code
        assert words in capsys.readouterr().err


def test_output_that_cannot_be_written_is_said_once():
    """A full device is the user's mistake, a reader that has gone none of ours."""
    with open("/dev/full", "wb") as device:
        output = _Output(device.fileno(), "wb", closefd=False)
        with pytest.raises(UserError, match="the output cannot be written: No space left"):
            output.write(b"text")
        assert output.write(b"more") == 4
    reader, writer = os.pipe()
    os.close(reader)
    with _Output(writer, "wb") as output, pytest.raises(BrokenPipeError):
        output.write(b"text")


def test_a_complaint_is_one_line_with_its_notes(capsys):
    error = ValueError()
    error.add_note("continue with: x")
    assert complain(error, "error:\n" + "long " * LONGEST_LINE, 7) == 7
    line, note = capsys.readouterr().err.splitlines()
    assert len(line) <= LONGEST_LINE + 5
    assert note == "continue with: x"
