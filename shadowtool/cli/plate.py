"""``shadowtool plate``."""

from pathlib import Path
from typing import Any

import click

from shadowtool.choices import ESTIMATORS
from shadowtool.cli.options import step_command, transfer_option


@click.command()
@click.argument("source", metavar="FRAMES")
@click.option(
    "--holdout",
    metavar="FRAMES|none",
    default="none",
    show_default=True,
    help="A matte, roto or trimap sequence; where it is above 0 the pixel is left out.",
)
@click.option(
    "--estimator",
    type=click.Choice(ESTIMATORS),
    default="minmax",
    show_default=True,
    help="minmax: the extremes over all frames, Eq. (4) of the paper.",
)
@transfer_option
@step_command
def command(source: str, holdout: str, output: Path, **options: Any) -> list[Any]:
    """Find the scene fully lit and fully in shadow, from frames with a moving shadow.

    Writes lit.exr, shadow.exr and confidence.exr (contrast between the two in units of the
    noise, and the number of frames that each pixel rests on).
    """
    from shadowtool.steps.plate import plate

    return [plate(source, output, holdout=None if holdout == "none" else holdout, **options)]
