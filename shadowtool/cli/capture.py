"""``shadowtool capture``."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from shadowtool.cli.options import format_option, step_command, transfer_option

if TYPE_CHECKING:
    from shadowtool.steps.capture import Crop


def _crop(ctx: click.Context, parameter: click.Parameter, value: str | None) -> "Crop | None":
    if value is None:
        return None
    parts = re.fullmatch(r"(\d+)x(\d+)\+(\d+)\+(\d+)", value)
    if parts is None or int(parts[1]) * int(parts[2]) == 0:
        raise click.BadParameter("write it as WIDTHxHEIGHT+X+Y, e.g. 1280x720+320+180")
    from shadowtool.steps.capture import Crop

    return Crop(*(int(part) for part in parts.groups()))


@click.command()
@click.argument("source", metavar="[INPUT]", required=False)
@transfer_option
@click.option(
    "--start",
    type=int,
    help="Number of the first frame. Default: 1001 for a movie or camera, a sequence keeps its"
    " own. --frames goes by it in a movie, and by a sequence's own numbers.",
)
@click.option("--crop", callback=_crop, metavar="WxH+X+Y", help="Part of the picture to keep.")
@click.option("--scale", type=float, default=1.0, metavar="FACTOR", help="Resize, after --crop.")
@format_option
@click.option("--strict", is_flag=True, help="Fail if the camera moved.")
@click.option("--device", type=click.IntRange(0, 999), metavar="N", help="Record from a camera.")
@click.option("--seconds", type=float, metavar="T", help="How long to record.")
@step_command
def command(source: str | None, output: Path, **options: Any) -> list[Any]:
    """Turn a movie, a sequence or a camera's picture into numbered linear frames.

    INPUT is a movie of any depth, a folder of EXR or PNG frames, or a pattern such as
    a/b.####.exr. Beside the frames, capture.json says what was assumed and measured: noise,
    clipping, dropped and doubled frames, and how far the camera moved.
    """
    from shadowtool.steps.capture import capture

    return [capture(source, output, **options)]
