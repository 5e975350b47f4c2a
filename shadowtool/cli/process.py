"""The program as a process: signals, streams, exit codes."""

import contextlib
import ctypes
import io
import logging
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import NoReturn

import click

from shadowtool.cli.commands import shadowtool
from shadowtool.errors import RetryError, ShadowtoolError

INTERRUPTED, TERMINATED = 130, 143
# A message longer than this is one with an absurd path in it.
_LONGEST = 1000
# cv2.Error.StsNoMem, without the import.
_OPENCV_NO_MEMORY = -4
# Seconds after which a signal that was lost is acted on again.
_AGAIN = 0.5
# Of GNU's C library: how much of what is freed stays, from which size on pieces come from the
# system each for itself, and how many threads have memory of their own; `mallopt`'s numbers.
_ALLOCATION = {-1: 1 << 30, -3: 1 << 25, -8: 1}


class _Terminated(BaseException):
    """SIGTERM arrived."""


class _Interrupted(BaseException):
    """SIGINT arrived; not a KeyboardInterrupt, at which click writes an empty line."""


def run_process() -> NoReturn:
    """Run the command line of this process and end it with its exit code."""
    try:
        sys.unraisablehook = _unraisable
        signal.signal(signal.SIGTERM, _terminate)
        # A shell starts background jobs with SIGINT ignored; that is to stay so.
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, _interrupt)
        _keep_memory()
        if "-v" not in sys.argv and "--verbose" not in sys.argv:
            _silence_libraries()
        code = run_command(sys.argv[1:])
        # From here on the work is done, and a signal changes nothing.
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, signal.SIG_IGN)
    except _Terminated:
        _arrived()
        code = TERMINATED
    except _Interrupted:
        _arrived()
        code = INTERRUPTED
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    # Not sys.exit: a reader that closed our pipe would make the interpreter complain at its end.
    os._exit(code)


def run_command(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; messages go to stderr."""
    logging.basicConfig(format="shadowtool: %(message)s", stream=sys.stderr, force=True)
    try:
        return _code_of(arguments)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except ShadowtoolError as error:
        _say(str(error))
        return error.exit_code
    except (KeyboardInterrupt, click.Abort, _Interrupted):
        _arrived()
        _say("interrupted; finished frames are whole, --resume goes on from here")
        return INTERRUPTED
    except _Terminated:
        _arrived()
        _say("terminated; finished frames are whole, --resume goes on from here")
        return TERMINATED
    except BrokenPipeError:
        return 1
    except OSError as error:
        from shadowtool.io.files import translated

        # Without a name it is our own output that can't be written.
        name, verb = (error.filename, "read") if error.filename else ("standard output", "write")
        fault = translated(error, Path(str(name)), verb)
        _say(str(fault))
        return fault.exit_code
    except Exception as error:
        if _is_of_memory(error):
            _say("out of memory; give a smaller --jobs or run on a larger machine")
            return RetryError.exit_code
        if logging.getLogger().isEnabledFor(logging.DEBUG):
            traceback.print_exc()
        place = traceback.extract_tb(error.__traceback__)[-1]
        _say(
            f"a fault of shadowtool's own: {type(error).__name__}: {error}"
            f" ({os.path.basename(place.filename)}:{place.lineno}); -v shows where"  # noqa: PTH119
        )
        return 1


def _code_of(arguments: Sequence[str]) -> int:
    try:
        code = shadowtool.main(list(arguments), "shadowtool", standalone_mode=False)
    except Exception as error:
        # A library whose import a signal stops says that its import failed.
        if (signalled := _signalled(error)) is not None:
            raise signalled from None
        raise
    return code if isinstance(code, int) else 0


def _is_of_memory(error: Exception) -> bool:
    """Whether there was no memory: OpenCV and threads say so in ways of their own."""
    if type(error).__module__ == "cv2":
        return getattr(error, "code", 0) == _OPENCV_NO_MEMORY
    no_thread = isinstance(error, RuntimeError) and "start new thread" in str(error)
    # Of a library that finds no room: "failed to map segment from shared object".
    no_room = isinstance(error, ImportError) and "map segment" in str(error)
    return no_thread or no_room or isinstance(error, MemoryError)


def _say(message: str) -> None:
    line = "".join(c if c.isprintable() else " " for c in message)
    if len(line) > _LONGEST:
        line = f"{line[: _LONGEST // 2]}…{line[-_LONGEST // 2 :]}"
    with contextlib.suppress(OSError):
        print(f"shadowtool: error: {line}", file=sys.stderr, flush=True)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    _stop(_Terminated)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    _stop(_Interrupted)


def _stop(kind: type[BaseException]) -> NoReturn:
    """Raise, and again after a while if it did not get through.

    Python drops what is raised while it runs a callback of its own, of a weak reference or an
    object's end, and the work would go on as if nothing had been asked.
    """
    signal.signal(signal.SIGALRM, lambda number, frame: _stop_if_dropped(kind))
    signal.setitimer(signal.ITIMER_REAL, _AGAIN, _AGAIN)
    raise kind


def _stop_if_dropped(kind: type[BaseException]) -> None:
    # Else it is on its way, and threads are being waited for.
    if not isinstance(_signalled(sys.exc_info()[1]), kind):
        raise kind


def _signalled(error: BaseException | None) -> BaseException | None:
    """What a signal raised, if an exception came of it."""
    while error is not None and not isinstance(error, (_Terminated, _Interrupted)):
        error = error.__context__
    return error


def _arrived() -> None:
    signal.setitimer(signal.ITIMER_REAL, 0)


def _unraisable(dropped: "sys.UnraisableHookArgs") -> None:
    if not issubclass(dropped.exc_type, (_Terminated, _Interrupted)):
        sys.__unraisablehook__(dropped)


def _keep_memory() -> None:
    """Have what is freed kept for what comes next, on whatever thread.

    Frames come and go by the dozen megabytes, made on one thread and freed on another. To give them
    back to the system and take them from it again, page by page, costs up to a tenth of a step.
    """
    # What another C library does stays as it is.
    with contextlib.suppress(OSError, AttributeError):
        adjust = ctypes.CDLL(None).mallopt
        for number, value in _ALLOCATION.items():
            adjust(number, value)


def _silence_libraries() -> None:
    """Keep what libraries print to stdout and stderr from getting between our lines.

    OpenEXR writes a warning to stdout for a damaged file, which is then reported by us; numpy
    writes one to stderr for light that is too bright for a float, whose pixels are unknown or
    counted in the end. stdout holds only results. ``-v`` leaves everything as it is.
    """
    warnings.simplefilter("ignore", RuntimeWarning)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for name, number in (("stdout", 1), ("stderr", 2)):
        try:
            kept = os.dup(number)
        except OSError:
            continue
        stream = io.TextIOWrapper(
            os.fdopen(kept, "wb"), errors="backslashreplace", write_through=True
        )
        setattr(sys, name, stream)
        os.dup2(nowhere, number)
    os.close(nowhere)
