"""The command line: parse, call the step, report."""


def main() -> None:
    """Entry point of the ``shadowtool`` program; ends the process."""
    import os
    import signal

    # Read when numpy is first imported. Sums that its linear algebra splits among threads differ
    # in their last bits from machine to machine, and idle threads of its own only take time.
    for library in ("OPENBLAS", "MKL", "BLIS"):
        os.environ[f"{library}_NUM_THREADS"] = "1"
    # Memory in huge pages, which numpy asks for, costs a virtual machine more time when it is first
    # touched than it ever saves.
    os.environ["NUMPY_MADVISE_HUGEPAGE"] = "0"

    # Until our own handler is there, Python's would show where in an import it was interrupted.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    from shadowtool.cli.process import run_process

    run_process()
