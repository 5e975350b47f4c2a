"""``shadowtool warp``."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from shadowtool.cli.options import step_command

if TYPE_CHECKING:
    from shadowtool.steps.run import Run


@click.command()
@click.argument("scans", metavar="[SCAN]...", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--map",
    "map_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Use this ST map instead of solving one from scans.",
)
@click.option("--apply", "apply_to", metavar="FRAMES", help="Warp these frames, e.g. β.")
@click.option(
    "--outside",
    type=float,
    default=1.0,
    show_default=True,
    help="With --apply, the value where the map points outside the frame.",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=0, max=10_000),
    default=40,
    show_default=True,
    help="Steps of the diffusion that smooths the map.",
)
@step_command
def command(
    scans: tuple[Path, ...],
    map_file: Path | None,
    apply_to: str | None,
    outside: float,
    iterations: int,
    output: Path,
    run: "Run",
) -> list[Any]:
    """Solve where in the source plane each target pixel's shadow comes from, from its scans.

    Writes warp.exr, an ST map (R G = u v, A = confidence) as Nuke and Natron read it, and
    warp.png. With --apply, frames as the map sees them go to DIR/NAME/.
    """
    from shadowtool.io.products import WARP
    from shadowtool.steps.warp import apply_warp, solve_warp

    if bool(scans) == (map_file is not None):
        raise click.UsageError("give two or more SCAN folders, or --map FILE")
    if map_file is not None:
        if apply_to is None:
            raise click.UsageError("--map FILE needs --apply FRAMES")
        return [apply_warp(map_file, apply_to, output, run=run, outside=outside, record_in=output)]
    results = [solve_warp(list(scans), output, run=run, iterations=iterations)]
    if apply_to is not None:
        results.append(apply_warp(output / WARP, apply_to, output, run=run, outside=outside))
    return results
