"""``shadowtool warp``."""

from pathlib import Path
from typing import Any

import click

from shadowtool.choices import ITERATIONS, OUTSIDE
from shadowtool.cli.options import GivenPath, step_command


@click.command()
@click.argument("scans", metavar="[SCAN]...", nargs=-1, type=GivenPath())
@click.option(
    "--map",
    "map_file",
    type=GivenPath(),
    metavar="FILE",
    help="Use this ST map instead of solving one from scans.",
)
@click.option(
    "--source-scan",
    "source_scans",
    type=GivenPath(),
    multiple=True,
    metavar="SCAN",
    help="A scan of the source, for a source that isn't flat; give two or more.",
)
@click.option("--apply", "apply_to", metavar="FRAMES", help="Warp these frames, e.g. β.")
@click.option(
    "--outside",
    type=float,
    default=OUTSIDE,
    show_default=True,
    help="With --apply, the value where the map points outside the frame.",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0, max=10_000),
    default=ITERATIONS,
    show_default=True,
    help="Steps of the diffusion that smooths the map.",
)
@step_command
def command(
    scans: tuple[Path, ...], output: Path, source_scans: tuple[Path, ...], **options: Any
) -> list[Any]:
    """Solve where in the source plane each target pixel's shadow comes from, from its scans.

    Writes warp.exr, an ST map (R G = u v, A = confidence) as Nuke and Natron read it, and
    warp.png. With --apply, frames as the map sees them go to DIR/NAME/.
    """
    from shadowtool.steps.warp import warp

    return warp(list(scans), output, source_scans=list(source_scans), **options)
