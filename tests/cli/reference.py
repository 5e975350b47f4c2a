"""The README's reference of the commands, made from their own ``--help``.

``python -m tests.cli.reference`` writes it into README.md.
"""

import re
from pathlib import Path

import click

from shadowtool.cli.commands import COMMANDS, shadowtool

README = Path(__file__).parents[2] / "README.md"
BLOCK = re.compile(r"(<!-- reference -->\n).*?(<!-- end of reference -->)", re.DOTALL)


def help_text(*words: str) -> str:
    """What ``shadowtool WORDS --help`` prints, at a fixed width."""
    command: click.Command | None = shadowtool
    settings = shadowtool.context_settings
    context = click.Context(shadowtool, info_name="shadowtool", terminal_width=96, **settings)
    for word in words:
        assert isinstance(command, click.Group)
        command = command.get_command(context, word)
        assert command is not None
        context = click.Context(command, info_name=word, parent=context, terminal_width=96)
    assert command is not None
    return command.get_help(context)


def reference() -> str:
    parts = [f"```text\n{help_text()}\n```\n"]
    parts += [f"### {name}\n\n```text\n{help_text(name)}\n```\n" for name in COMMANDS]
    return "\n".join(parts)


def with_reference(text: str) -> str:
    return BLOCK.sub(lambda match: f"{match[1]}\n{reference()}\n{match[2]}", text)


if __name__ == "__main__":
    README.write_text(with_reference(README.read_text()))
