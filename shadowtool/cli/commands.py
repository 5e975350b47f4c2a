"""The command group; a command's module is imported when it is asked for."""

import importlib
from collections.abc import Sequence

import click

from shadowtool import __version__

COMMANDS = ("capture", "plate", "matte", "scan", "warp", "composite")


class _Lazy(click.Group):
    def list_commands(self, ctx: click.Context) -> Sequence[str]:  # type: ignore[override]
        return COMMANDS

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command = getattr(importlib.import_module(f"shadowtool.cli.{cmd_name}"), "command")  # noqa: B009
        return command if isinstance(command, click.Command) else None


@click.group(
    cls=_Lazy, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, prog_name="shadowtool")
def shadowtool() -> None:
    """Lift an actor's shadow out of one filmed scene and put it into another.

    A shot goes through the commands in the order in which they are listed; each reads folders of
    EXR or PNG frames and writes one. Exit codes: 0 done, 1 failed, 2 wrong usage, 3 done but
    frames were skipped, 75 a fault of the machine worth retrying, 130 and 143 interrupted.
    """
