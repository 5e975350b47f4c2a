"""The command line: parse, call the step, report."""


def main() -> None:
    """Entry point of the ``shadowtool`` program; ends the process."""
    from shadowtool.cli.process import run_process

    run_process()
