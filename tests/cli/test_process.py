"""Signals reach the command whatever Python is doing; memory and threads are used as agreed."""

import os
import platform
import signal
import subprocess
import sys
import time
import weakref

import pytest

from shadowtool.cli import process


@pytest.fixture(autouse=True)
def handlers(monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", process._unraisable)
    monkeypatch.setattr(process, "_AGAIN", 0.05)
    kept = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT, signal.SIGALRM)}
    signal.signal(signal.SIGTERM, process._terminate)
    signal.signal(signal.SIGINT, process._interrupt)
    yield
    process._arrived()
    for number, handler in kept.items():
        signal.signal(number, handler)


def wait() -> None:
    end = time.monotonic() + 5
    while time.monotonic() < end:
        time.sleep(0.01)


class Something:
    pass


SIGNALS = [(signal.SIGTERM, process._Terminated), (signal.SIGINT, process._Interrupted)]


@pytest.mark.parametrize(("number", "kind"), SIGNALS)
def test_a_signal_that_python_dropped_comes_again(number, kind, capsys):
    thing = Something()
    reference = weakref.ref(thing, lambda _: os.kill(os.getpid(), number))
    del thing
    with pytest.raises(kind):
        wait()
    assert reference() is None
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("number", "kind"), SIGNALS)
def test_what_is_tidied_up_meanwhile_is_not_disturbed(number, kind):
    tidied = False
    with pytest.raises(kind):
        try:
            os.kill(os.getpid(), number)
            wait()
        finally:
            time.sleep(0.3)
            tidied = True
    assert tidied


@pytest.mark.parametrize(
    ("code", "kind"), [(143, process._Terminated), (130, process._Interrupted)]
)
def test_a_signal_that_stops_an_import_is_no_fault(code, kind, monkeypatch, capsys):
    def importing(*args, **kwargs):
        try:
            raise kind
        except BaseException as error:
            raise ImportError("initialization failed") from error

    monkeypatch.setattr(process.shadowtool, "main", importing)
    assert process.run_command(["plate"]) == code
    assert "a fault of shadowtool's own" not in capsys.readouterr().err


def test_other_things_that_cannot_be_raised_are_still_shown(capsys):
    thing = Something()
    reference = weakref.ref(thing, lambda _: 1 // 0)
    del thing
    assert reference() is None
    assert "ZeroDivisionError" in capsys.readouterr().err


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="it is for GNU's C library alone")
def test_memory_that_was_freed_is_used_again_without_the_system():
    script = """
import resource
import numpy as np
import shadowtool.cli.process as process
def faults(arguments):
    def touch():
        pieces = [np.ones(2_000_000) for _ in range(8)]
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    before, after = touch(), touch()
    print(after - before < 50)
process.run_command = faults
process.run_process()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True)
    assert done.stdout == b"True\n"


def test_linear_algebra_runs_on_one_thread_whatever_the_machine_has():
    script = """
import os
import shadowtool.cli.process as process
def count():
    import numpy
    print(len(os.listdir("/proc/self/task")))
process.run_process = count
from shadowtool.cli import main
main()
"""
    variables = {**os.environ, "OPENBLAS_NUM_THREADS": "4"}
    done = subprocess.run([sys.executable, "-c", script], env=variables, capture_output=True)
    assert done.stdout == b"1\n"
