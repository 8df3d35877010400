"""The beginning and the end of the program: it can be interrupted at any time, and ends in order.

Importing this module takes over SIGINT (Ctrl-C) and SIGTERM. A signal becomes an exception, except
while a module is imported: other packages catch every exception there, and the signal would be
lost. Then it is given again, until the program ends; also if it was lost in a destructor.
"""

# Built in: an import that takes time could be interrupted before there is a handler.
import _signal
import _thread
import os
import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import FrameType

SIGNALS = {_signal.SIGINT: "interrupted", _signal.SIGTERM: "terminated"}
"""What is said of each."""

REMIND_SECONDS = 0.2

PATIENCE = 3
"""So many signals end the program at once, whatever it is doing."""

_main_thread = _thread.get_ident()


class Interrupted(KeyboardInterrupt):
    """A KeyboardInterrupt that has passed `exec` of a text would make Python end by a signal."""


class _State:
    begun = ended = reminded = False
    number = count = 0


def _receive(number: int, frame: "FrameType | None") -> None:
    """Raise the exception of a signal where it is not lost. Python calls it in the main thread."""
    if _State.reminded:
        _State.reminded = False
    else:
        _State.number, _State.count = number, _State.count + 1
        if _State.ended or _State.count >= PATIENCE:
            if not _State.ended or _State.count == 1:
                os.write(2, f"{SIGNALS[number]}\n".encode())
            os._exit(128 + number)
        if _State.count == 1:
            _thread.start_new_thread(_remind, ())
    if _State.begun and not (_State.ended or _is_importing(frame) or _is_cleaning_up()):
        raise Interrupted


def _remind() -> None:
    """Give the signal again and again until the program ends."""
    from time import sleep

    _signal.pthread_sigmask(_signal.SIG_BLOCK, SIGNALS)  # they are for the main thread
    while True:
        sleep(REMIND_SECONDS)
        if _State.ended:
            return
        _State.reminded = True
        _signal.pthread_kill(_main_thread, _State.number)


def _is_importing(frame: "FrameType | None") -> bool:
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _is_cleaning_up() -> bool:
    """Whether the exception of an earlier signal is being handled."""
    error = sys.exception()
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _ignore_signals() -> None:
    for number in SIGNALS:
        _signal.signal(number, _signal.SIG_IGN)


for _number in SIGNALS:
    # What the caller ignores stays ignored.
    if _signal.getsignal(_number) is not _signal.SIG_IGN:
        _signal.signal(_number, _receive)


def main() -> int:
    """Run the command line.

    Returns:
        The exit code: that of :func:`symsteer.cli.main`; 130 after Ctrl-C, 143 after SIGTERM.
    """
    import atexit

    # The first to be registered is the last that is called: all is done then.
    atexit.register(_ignore_signals)
    # Processes that Python starts for this one do not look into the current folder either.
    os.environ["PYTHONSAFEPATH"] = "1"
    report = sys.unraisablehook
    sys.unraisablehook = lambda lost: (
        None if isinstance(lost.exc_value, KeyboardInterrupt) else report(lost)
    )
    interruption: BaseException = KeyboardInterrupt()
    try:
        from symsteer import cli

        _State.begun = True
        code = cli.main()
    except (Exception, KeyboardInterrupt) as error:
        if not _State.number:
            raise
        interruption = error
    finally:
        _State.ended = True
    if not _State.number:
        return code
    from symsteer.terminal import complain

    return complain(interruption, SIGNALS[_State.number], 128 + _State.number)
