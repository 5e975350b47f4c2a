"""``shadowtool scan``."""

from pathlib import Path
from typing import Any

import click

from shadowtool.cli.options import gain_option, steady_option, step_command, transfer_option


@click.command()
@click.argument("source", metavar="FRAMES")
@click.option(
    "--plane",
    required=True,
    metavar="IMAGE|POLYGON",
    help='Where the reference plane is: a mask of the frames\' size, or "x,y x,y x,y ...".',
)
@gain_option
@steady_option
@transfer_option
@step_command
def command(source: str, output: Path, **options: Any) -> list[Any]:
    """Follow the shadow of a straight stick that is swept over the target scene once.

    Writes scan.exr (time: the frame in which the shadow's leading edge reaches the pixel; error:
    how far off that may be, in frames; contrast; own_time and own_error: what the pixel tells
    alone), lines.json (the edge on the reference plane, frame by frame) and scan.png.
    """
    from shadowtool.steps.scan import scan

    return [scan(source, output, **options)]
