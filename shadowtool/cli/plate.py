"""``shadowtool plate``."""

from pathlib import Path
from typing import Any

import click

from shadowtool.choices import ESTIMATORS, READINGS
from shadowtool.cli.options import gain_option, steady_option, step_command, transfer_option


@click.command()
@click.argument("source", metavar="FRAMES")
@click.option(
    "--holdout",
    metavar="FRAMES|auto|none",
    default="auto",
    show_default=True,
    help="A matte, roto or trimap sequence; where it is above 0 the pixel is left out. auto: what"
    " isn't background is found, and written to holdout/ to be looked at.",
)
@click.option(
    "--estimator",
    type=click.Choice(ESTIMATORS),
    default="robust",
    show_default=True,
    help="robust: means of the frames in which a pixel was lit, and fully shaded; where the shadow"
    " fell only in part, the plane's ratio of shadow to light. minmax: the extremes over all"
    " frames, Eq. (4) of the paper.",
)
@click.option(
    "--plane",
    metavar="IMAGE|POLYGON",
    help="The plane that the shadow falls on, as for scan. Default: as --read-as says.",
)
@click.option(
    "--read-as",
    type=click.Choice(READINGS),
    default="auto",
    show_default=True,
    help="plane: a shadow crossed a plane, as in a source, and what it didn't reach would be as"
    " dark as the rest. card: a card was waved over a scene, as in a target, and what never got"
    " darker is in shade already, unless it is as bright as what did. auto: by how much got dark,"
    " altogether and at once, and whether what is dark looks like somebody.",
)
@gain_option
@steady_option
@transfer_option
@step_command
def command(source: str, output: Path, **options: Any) -> list[Any]:
    """Find the scene fully lit and fully in shadow, from frames with a moving shadow.

    Writes lit.exr, shadow.exr and confidence.exr (contrast between the two in units of the
    noise, and the number of frames that each pixel rests on).
    """
    from shadowtool.steps.plate import plate

    return [plate(source, output, **options)]
