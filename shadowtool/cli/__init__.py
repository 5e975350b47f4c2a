"""The command line: parse, call the step, report."""


def main() -> None:
    """Entry point of the ``shadowtool`` program; ends the process."""
    import signal

    # Until our own handler is there, Python's would show where in an import it was interrupted.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    from shadowtool.cli.process import run_process

    run_process()
