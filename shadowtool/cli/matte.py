"""``shadowtool matte``."""

from pathlib import Path
from typing import Any

import click

from shadowtool.choices import BETAS, FILLS, ONLY
from shadowtool.cli.options import (
    folder_option,
    gain_option,
    steady_option,
    step_command,
    transfer_option,
)


@click.command()
@click.argument("source", metavar="FRAMES")
@folder_option("--plates", "plates", "Plates of this scene, from plate.", required=True)
@click.option(
    "--trimap",
    metavar="FRAMES",
    help="Trimaps (0, 128, 255) drawn for any of the frames. There they decide; in the frames"
    " between, carried by optical flow, they decide what colours leave open.",
)
@click.option(
    "--alpha",
    metavar="FRAMES",
    help="The figure's matte, used as it is given; its colour is still solved.",
)
@click.option("--only", type=click.Choice(ONLY), help="Write one product and stop.")
@click.option(
    "--beta",
    type=click.Choice(BETAS),
    default="scalar",
    show_default=True,
    help="One β for all channels, or one for each: for coloured glass.",
)
@click.option(
    "--clamp/--no-clamp",
    default=True,
    show_default=True,
    help="Keep β within 0 and 1; caustics are above 1.",
)
@click.option(
    "--fill",
    type=click.Choice(FILLS),
    default="inpaint",
    show_default=True,
    help="What β becomes where it can't be known. inpaint: small patches and what the figure"
    " hides are continued from around them, regions that no shadow ever reached are lit.",
)
@gain_option
@steady_option
@transfer_option
@step_command
def command(source: str, output: Path, **options: Any) -> list[Any]:
    """Pull the shadow matte β and the figure's matte out of a scene whose plates are known.

    Writes trimap/, fg/ (R G B A, premultiplied) and beta/ (Y, 1 lit to 0 in full shadow, and
    confidence: 1 minus the expected error of β, 0 where it was filled in).
    """
    from shadowtool.steps.matte import matte

    return [matte(source, output, **options)]
