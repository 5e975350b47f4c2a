"""Each shared option, once."""

import contextlib
import functools
import io
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from shadowtool.choices import FORMATS, GAINS, MISSING, PROGRESS, STEADY, TRANSFER_NAMES
from shadowtool.cli.progress import reporter
from shadowtool.cli.report import report

Function = TypeVar("Function", bound=Callable[..., Any])


class GivenPath(click.Path):
    """The name of a file or folder; an empty one, as of a shell's variable that is not set, is
    none."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("is empty; name a file or a folder", param, ctx)
        return super().convert(value, param, ctx)


output_option = click.option(
    "-o",
    "--output",
    type=GivenPath(),
    required=True,
    metavar="DIR",
    help="Folder to write to; made if it isn't there.",
)
frames_option = click.option(
    "--frames",
    metavar="RANGE",
    help="Frames to work on: 1001-1048, 1001-1048x2, 1,5,9-20. plate and scan look at them all"
    " together; the others make each by itself, so that machines may share them.",
)
missing_option = click.option(
    "--missing",
    type=click.Choice(MISSING),
    default="error",
    show_default=True,
    help="What to do about frames that are absent or damaged; after skipping the exit code is 3.",
)
jobs_option = click.option(
    "-j",
    "--jobs",
    type=click.IntRange(min=1, max=1024),
    metavar="N",
    help="Threads. Default: the CPUs that the process may use, or SLURM_CPUS_PER_TASK.",
)
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what is there.")
resume_option = click.option(
    "--resume", is_flag=True, help="Keep what is there, whole and up to date; make the rest."
)
progress_option = click.option(
    "--progress",
    type=click.Choice(PROGRESS),
    default="auto",
    show_default=True,
    help="On stderr. auto: a bar on a terminal, plain lines in a log.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
verbose_option = click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
quiet_option = click.option(
    "-q", "--quiet", is_flag=True, help="Say nothing but errors, print no result."
)
transfer_option = click.option(
    "--transfer",
    type=click.Choice(TRANSFER_NAMES),
    default="auto",
    show_default=True,
    help="How code values stand for light. auto: EXR linear, PNG sRGB, movies as they say or"
    " Rec.709. none: use code values as they are.",
)


format_option = click.option(
    "--format",
    "file_format",
    type=click.Choice(FORMATS),
    default="exr",
    show_default=True,
    help="exr: linear half. png: 16 bit, sRGB-encoded.",
)
gain_option = click.option(
    "--gain",
    type=click.Choice(GAINS),
    default="auto",
    show_default=True,
    help="Light that changes over the take. auto: each frame's exposure is found from the pixels"
    " that agree, taken out and recorded; so are, but by scan, its white balance and the bands of a"
    " lamp that flickers. none: frames are taken as they are.",
)
steady_option = click.option(
    "--steady",
    type=click.Choice(STEADY),
    default="auto",
    show_default=True,
    help="A camera that trembles. auto: if it does, frames are moved by parts of a pixel to where"
    " one place sees the scene from, and that is said and recorded. none: frames are taken as they"
    " are.",
)


def folder_option(
    name: str, parameter: str, help_text: str, required: bool = False
) -> Callable[[Function], Function]:
    """An option that takes a folder."""
    return click.option(
        name,
        parameter,
        type=GivenPath(),
        metavar="DIR",
        required=required,
        help=help_text,
    )


def step_command(function: Function) -> Function:
    """What every command has: -o, --frames, --jobs and the others; reports the step's result.

    The decorated function gets ``output`` and ``run`` beside its own options and returns the
    results to report, in order.
    """

    @functools.wraps(function)
    def wrapper(
        *,
        frames: str | None,
        missing: str,
        jobs: int | None,
        overwrite: bool,
        resume: bool,
        progress: str,
        as_json: bool,
        verbose: bool,
        quiet: bool,
        **others: Any,
    ) -> int:
        if overwrite and resume:
            raise click.UsageError("--overwrite and --resume exclude each other")
        level = logging.ERROR if quiet else logging.DEBUG if verbose else logging.WARNING
        logging.getLogger().setLevel(level)
        from shadowtool.steps.run import Run

        name = click.get_current_context().info_name or ""
        # OpenEXR prints a warning of its own for a damaged file; stdout is for results.
        silence = contextlib.nullcontext() if verbose else contextlib.redirect_stdout(io.StringIO())
        with silence, reporter(progress if not quiet else "none", name) as advance:
            run = Run(frames, missing, jobs, overwrite, resume, advance)  # type: ignore[arg-type]
            results = function(run=run, **others)
        if not quiet:
            report(results, as_json)
        return 3 if any(result.skipped for result in results) else 0

    for option in (
        quiet_option,
        verbose_option,
        json_option,
        progress_option,
        resume_option,
        overwrite_option,
        jobs_option,
        missing_option,
        frames_option,
        output_option,
    ):
        wrapper = option(wrapper)
    return wrapper  # type: ignore[return-value]
