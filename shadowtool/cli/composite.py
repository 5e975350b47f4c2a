"""``shadowtool composite``."""

from pathlib import Path
from typing import Any

import click

from shadowtool.choices import FILLS
from shadowtool.cli.options import GivenPath, folder_option, format_option, step_command


@click.command()
@click.argument("mattes", metavar="[MATTE]", required=False, type=GivenPath())
@folder_option("--plates", "plates", "Plates of the target scene.", required=True)
@click.option(
    "--warp",
    type=GivenPath(),
    metavar="FILE",
    help="ST map from warp; without it the shadow stays as it fell in the source.",
)
@click.option("--fg", "foreground", metavar="FRAMES", help="Figure frames instead of MATTE/fg.")
@click.option("--beta-frames", "beta", metavar="FRAMES", help="β frames instead of MATTE/beta.")
@click.option("--ratio", is_flag=True, help="Write ratio/ too: multiply by it to cast the shadow.")
@click.option(
    "--fill",
    type=click.Choice(FILLS),
    default="lit",
    show_default=True,
    help="What β becomes where it is unknown (NaN).",
)
@format_option
@step_command
def command(mattes: Path | None, output: Path, **options: Any) -> list[Any]:
    """Put the figure and its shadow into the target scene.

    MATTE is a folder written by matte. Each pixel becomes αF + (1 - α)(βL' + (1 - β)S').
    """
    from shadowtool.steps.composite import composite

    return [composite(mattes, output, **options)]
