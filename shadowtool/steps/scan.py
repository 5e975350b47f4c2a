"""Shadow times and shadow lines of one sweep."""

import logging
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Gain, Steady
from shadowtool.core.bands import overlapping_bands
from shadowtool.core.camera_motion import displaced
from shadowtool.core.crossings import CrossingFinder, Crossings, SecondLook
from shadowtool.core.exposure import RunningGain, sampled_areas, without_gain
from shadowtool.core.lengths import length
from shadowtool.core.medians import median
from shadowtool.core.noise import (
    NoiseModel,
    noise_levels,
    noise_model,
    sample_positions,
    thin,
    thinning,
)
from shadowtool.core.pictures import display, time_picture
from shadowtool.core.plane_fits import understated
from shadowtool.core.shadow_lines import (
    Bend,
    ShadowLines,
    fit_shadow_lines,
    line_bend,
    line_pace,
    part_off_lines,
    some_of,
    zero_crossings,
)
from shadowtool.core.shadow_time import (
    SHADE,
    ShadowTimes,
    misled,
    own_times,
    refined_times,
    significant,
    time_windows,
    usual_loss,
)
from shadowtool.core.trembling import UNSTEADY, strips, tremble
from shadowtool.core.warp_map import Pass
from shadowtool.errors import DamagedFileError, InputError, MissingError, NoLinesError, ReshootError
from shadowtool.io.files import fingerprint_file, make_folder
from shadowtool.io.image import Header, write_png
from shadowtool.io.products import LINES, MANIFEST, SCAN, encode_times, write_scan
from shadowtool.io.sequence import Frame, frame_range
from shadowtool.parallel import meanwhile, ordered_map
from shadowtool.steps.footage import Footage, open_footage, say_assumed
from shadowtool.steps.plane import read_plane
from shadowtool.steps.run import (
    Figures,
    Recipe,
    Result,
    Run,
    left_out,
    or_missing,
    refuse_existing,
    refuse_inputs,
    refuse_other_step,
    say_skipped,
    unchanged,
    warn_of_nan,
    write_manifest,
)

logger = logging.getLogger(__name__)

Float16 = NDArray[np.float16]
Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
PICTURE = "scan.png"

# Bends of more pixels than this, that are so many standard deviations, come from a lens.
_BENT, _CERTAIN = 1.0, 6.0
# From this frame number on single floats are an eighth of a frame apart, or more.
_FEW_DIGITS = 2**20
# A sweep reaches little of the frame, and is fast: a part of the frame, pixels a frame.
_LITTLE, _FAST = 0.5, 20.0
# Times differ by so many times what noise explains only if something is wrong; and by so many,
# with less than this part of the edges on lines, only if what moved is no straight shadow.
_TREMBLING, _NO_SWEEP, _ON_LINES = 2.0, 4.0, 0.5
# So many pixels of the plane are off the lines of their times only if something is wrong.
_MANY_OFF = 0.06
# More than this of what a sweep reached has times at which no edge lay on the plane only if too
# little of the plane is marked.
_BEYOND = 0.3
# Between frames so many times further apart than usual the shadow passes more than can be told.
_HOLE = 3.0
# If more of the frame than this can't be told from one reading, the frames are read again.
_LOST = 0.05


def scan(
    source: str | Path,
    output: Path,
    *,
    plane: str,
    run: Run = Run(),
    gain: Gain = "auto",
    steady: Steady = "auto",
    transfer: str = "auto",
) -> Result:
    """Write ``scan.exr`` (times, their errors, contrast), ``lines.json`` and a picture of both.

    Args:
        plane: the reference plane region: a mask image (above half is inside), or a polygon
            ``x,y x,y x,y …`` in pixels.
        gain: follow the light's changes and take them out, or take frames as they are.
        steady: of a camera that trembles, move frames to one place, or take them as they are.

    Raises:
        InputError: frames or mask are missing or don't fit.
        OptionError: the polygon can't be read.
        ReshootError: the plane shows too little of the sweep, or something that is none.
    """
    footage = open_footage(source, "frames", transfer, run.missing)
    say_assumed(footage, transfer)
    frames, absent = footage.sequence.select(run.frames, run.missing)
    if len(frames) < 3:
        raise InputError(f"{footage.sequence.pattern}: {len(frames)} frames make no sweep")
    region, plane_name, plane_mark = read_plane(plane, footage.header)
    products = [output / SCAN, output / LINES, output / PICTURE]
    refuse_other_step("scan", output, run)
    refuse_existing([*products, output / MANIFEST], run)
    refuse_inputs(products, [*footage.sequence.files.values(), Path(plane)])
    recipe = Recipe(
        "scan",
        {
            "frames": frame_range(frames),
            "gain": gain,
            "steady": steady,
            "transfer": footage.transfer,
        },
        {"frames": Path(footage.sequence.pattern).name, "--plane": plane_name},
    )
    if run.resume:
        paths = [footage.sequence.path(frame) for frame in frames]
        known = dict(zip(frames, ordered_map(fingerprint_file, paths, run.jobs), strict=True))
        figures = unchanged(output, products, _mark(recipe, plane_mark, known))
        if figures is not None:
            skipped = left_out(figures)
            used = [frame for frame in frames if frame not in skipped]
            return Result("scan", output, used, len(used), [*absent, *skipped], figures)
    reading = _crossings(footage, frames, gain, run)
    trembling = reading.trembling
    if steady == "auto" and trembling > UNSTEADY:
        footage, readable = footage.steadied(reading.sampled, run.jobs), list(reading.gains)
        if footage.vantage is not None:
            # There is no room for both readings.
            del reading
            reading = _crossings(footage, readable, gain, run)
        else:
            # What moved is not the camera.
            trembling = 0.0
            reading = reading._replace(trembling=trembling)
    crossings, noise, remaining, marks, gains, bad, first, _ = reading
    del reading
    warn_of_nan(output, bad)
    used = list(gains)
    skipped = [frame for frame in frames if frame not in used]
    numbers = np.array([float(frame) for frame in used])
    if np.abs(numbers).max() > _FEW_DIGITS:
        logger.warning(
            "%s: frame numbers this large leave float32 times few digits; renumber the take",
            footage.sequence.pattern,
        )
    times, raised = _times(crossings, noise, remaining, region, numbers, run.jobs)
    # The encoder wants the room.
    del crossings
    for before in np.flatnonzero(_holes(numbers)):
        logger.warning(
            "%s: no frames between %s and %s; what the shadow passed meanwhile is unknown",
            footage.sequence.pattern,
            used[before],
            used[before + 1],
        )
    known = {frame: fingerprint_file(footage.sequence.path(frame)) for frame in skipped}
    known |= dict(zip(used, marks, strict=True))
    mark = _mark(recipe, plane_mark, {frame: known[frame] for frame in frames})
    provenance = recipe.provenance(mark)
    with meanwhile(
        lambda: encode_times(output, times, region, footage.header, provenance)
    ) as encoded:
        points = zero_crossings(times.time, region, numbers)
        lines = _lines(points, numbers, raised, footage.sequence.pattern)

        def draw() -> UInt8:
            picture = display(footage.read(used[0])) if first is None else first
            return time_picture(picture, times.time, lines, region)

        make_folder(output)
        with meanwhile(lambda: write_png(output / PICTURE, draw(), provenance, True)) as drawn:
            bend = line_bend(points, numbers, lines, footage.header.size)
            figures = _figures(times, lines, region, gains, bend) | {
                "skipped": frame_range(skipped),
                "errors_raised": round(raised, 2),
                "trembling": round(trembling, 3),
                "off_lines": round(part_off_lines(times.time, region, lines), 4),
            }
            _advise(figures, footage)
            write_scan(output, Pass(times, lines, region), footage.header, provenance, encoded())
            drawn()
    write_manifest(output, recipe, mark, figures)
    return Result("scan", output, used, 0, [*absent, *skipped], figures)


def _mark(recipe: Recipe, plane: str, frames: dict[Frame, str]) -> str:
    """What stands for the pass: its frames' content, and their numbers, which times are given in.

    Args:
        plane, frames: fingerprints of the mask and of the frames.
    """
    return recipe.fingerprint([plane, *(f"{frame} {own}" for frame, own in frames.items())])


class _Reading(NamedTuple):
    """What one reading of the pass gives.

    Attributes:
        trembling: by how much the camera's place varies, pixels.
        marks: the content of its files.
        gains: of the frames that could be read.
        not_finite: how many pixels of frames are NaN or infinite.
        first: the first frame, if it could be read, to be looked at.
        sampled: the frames that noise and trembling were measured in.
    """

    crossings: Crossings
    noise: NoiseModel
    trembling: float
    marks: list[str]
    gains: dict[Frame, float]
    not_finite: dict[str, int]
    first: UInt8 | None
    sampled: list[Frame]


class _Seen(NamedTuple):
    """What is taken from a frame; of sampled ones thinned colours and rows, too."""

    gray: Float16
    areas: Float32
    sample: tuple[Float32, Float32] | None
    picture: UInt8 | None
    mark: str


class _Colours:
    """What is kept of a frame's colours while its rows go by.

    Attributes:
        grid: (h, w, 3) float32, linear light at every so many rows and columns.
        picture: all of it, to be looked at; None if that is not wanted.
    """

    def __init__(self, header: Header, every: int, picture: bool) -> None:
        height, width = header.height, header.width
        self._every = every
        self.grid = np.empty((-(-height // every), -(-width // every), 3), np.float32)
        self.picture = np.empty((height, width, 3), np.uint8) if picture else None

    def add(self, rows: slice, *colours: NDArray[np.floating]) -> None:
        """Take in some rows' R, G and B."""
        every = self._every
        kept = slice(-(-rows.start // every), -(-rows.stop // every))
        for index, colour in enumerate(colours):
            self.grid[kept, :, index] = colour[-rows.start % every :: every, ::every]
            if self.picture is not None:
                self.picture[rows, :, index] = display(colour)


def _crossings(footage: Footage, frames: list[Frame], gain: Gain, run: Run) -> _Reading:
    samples = sample_positions(len(frames))
    # To be moved, a picture has to be whole.
    steady = footage.vantage is None
    every = thinning(footage.header.height, footage.header.width) if steady else 1

    def seen(position: int) -> _Seen:
        sampled, first = position in samples.values(), position == 0
        kept = _Colours(footage.header, every, first) if sampled or first else None
        look = None if kept is None else kept.add
        gray, mark = footage.luminance(frames[position], look)
        place = footage.off(gray)
        gray = displaced(gray, place)
        sample = picture = None
        if kept is not None:
            picture = kept.picture
            if sampled:
                grid = thin(displaced(kept.grid, place)) if every == 1 else kept.grid
                sample = grid, strips(gray)
        return _Seen(gray, sampled_areas(gray), sample, picture, mark)

    finder, exposure = CrossingFinder(), RunningGain()
    marks, gains, bad = list[str](), dict[Frame, float](), dict[str, int]()
    thinned: dict[int, Float32] = {}
    rows: list[Float32] = []
    first: UInt8 | None = None
    sampled = []
    run.progress(0, len(frames))
    looked_at = ordered_map(or_missing(seen, run), range(len(frames)), run.jobs)
    for position, item in enumerate(looked_at):
        if isinstance(item, MissingError):
            say_skipped(item)
        else:
            gray, areas, sample, picture, mark = item
            first = first if picture is None else picture
            own = exposure.add(areas) if gain == "auto" else 1.0
            bad[str(frames[position])] = finder.add(without_gain(gray, own))
            marks.append(mark)
            gains[frames[position]] = own
            if sample is not None:
                level = without_gain(sample[0], own)
                rows.append(sample[1])
                sampled.append(frames[position])
                thinned |= {n: level for n, where in samples.items() if where == position}
        run.progress(position + 1, len(frames))
    if len(gains) < 3:
        raise DamagedFileError(f"{footage.sequence.pattern}: too few frames can be read")

    def measure() -> tuple[NoiseModel, float]:
        return noise_model(noise_levels(thinned)), tremble(rows)

    with meanwhile(measure) as measured:
        found = finder.found()
    noise, trembling = measured()
    crossings = significant(found, noise)
    if crossings.lost.mean() > _LOST:
        crossings = _looked_at_again(footage, crossings, gains, run)
    return _Reading(crossings, noise, trembling, marks, gains, bad, first, sampled)


def _looked_at_again(
    footage: Footage, crossings: Crossings, gains: dict[Frame, float], run: Run
) -> Crossings:
    """With what one reading lost, because an edge took long to pass, or noise is large."""
    look = SecondLook(crossings, crossings.lost)

    def read(frame: Frame) -> Float16:
        gray, _ = footage.luminance(frame)
        return displaced(gray, footage.off(gray))

    for done, (gray, own) in enumerate(
        zip(ordered_map(read, gains, run.jobs), gains.values(), strict=True), start=1
    ):
        look.add(without_gain(gray, own))
        run.progress(done, len(gains))
    return look.found()


def _times(
    crossings: Crossings,
    noise: NoiseModel,
    trembling: float,
    region: NDArray[np.bool_],
    numbers: NDArray[np.float64],
    jobs: int | None,
) -> tuple[ShadowTimes, float]:
    """Times and errors, each pixel's own and as its neighbours tell them too; and by what factor
    errors are larger than noise makes them."""
    own, own_error, duration = own_times(crossings, noise, trembling)
    contrast = np.nan_to_num(crossings.highest - crossings.lowest)
    loss = usual_loss(contrast, crossings.highest, crossings.at > 0, region)
    in_shade = loss < SHADE
    own[in_shade], own_error[in_shade] = np.nan, np.inf
    off = misled(duration, loss)
    length(own_error, off, out=own_error)
    if (holes := _holes(numbers)).any():
        in_hole = np.append(False, holes)[crossings.at]
        own[in_hole], own_error[in_hole] = np.nan, np.inf
    time, error = np.empty_like(own), np.empty_like(own_error)
    windows = time_windows(own, region)
    raised = understated(own, own_error, region, windows)
    own_error *= np.float32(raised)

    def refine(band: tuple[slice, slice]) -> None:
        rows, inner = band
        found = refined_times(own[rows], own_error[rows], crossings.at[rows], windows, inner)
        time[rows][inner], error[rows][inner] = found

    for _ in ordered_map(refine, overlapping_bands(len(own), windows.reach), jobs):
        pass
    # Neighbours are misled alike: it does not average out.
    length(error, off, out=error)
    if (np.diff(numbers) != 1).any():
        # From positions among the frames to frame numbers, which are not one apart.
        spacing = np.interp(np.nan_to_num(own), np.arange(len(numbers) - 1) + 0.5, np.diff(numbers))
        error, own_error = ((e * spacing).astype(np.float32) for e in (error, own_error))
    time, own = _numbers(time, numbers), _numbers(own, numbers)
    if (largest := np.abs(numbers).max()) > _FEW_DIGITS:
        step = np.float32(np.spacing(np.float32(largest)) / np.sqrt(12))
        error, own_error = np.hypot(error, step), np.hypot(own_error, step)
    return ShadowTimes(time, error, contrast, own, own_error), raised


def _holes(numbers: NDArray[np.float64]) -> NDArray[np.bool_]:
    """After which of the frames but the last too many are missing."""
    steps = np.diff(numbers)
    return np.asarray(steps > _HOLE * np.median(steps), bool)


def _numbers(clock: Float32, numbers: NDArray[np.float64]) -> Float32:
    """Positions among the frames to frame numbers, NaN kept."""
    if (np.diff(numbers) == 1).all():
        return clock + np.float32(numbers[0])
    return np.interp(clock, np.arange(len(numbers)), numbers).astype(np.float32)


def _lines(
    points: dict[int, NDArray[np.float64]], numbers: NDArray[np.float64], raised: float, take: str
) -> ShadowLines:
    """The pass's lines, if it is a sweep.

    Args:
        points: as of `zero_crossings`.
        raised: by what factor errors are larger than noise makes them.

    Raises:
        ReshootError: the plane shows too little of the sweep, or something that is none.
    """
    try:
        lines = fit_shadow_lines(points, numbers)
    except NoLinesError as error:
        raise ReshootError(
            f"{take}: reshoot: {error}; sweep the shadow across the plane, or mark a larger plane"
        ) from None
    on_lines = int(lines.points.sum()) / sum(map(len, points.values()))
    if raised > _NO_SWEEP and on_lines < _ON_LINES:
        raise ReshootError(
            f"{take}: reshoot: of what moves over the plane only {100 * on_lines:.0f}% lies on"
            " straight lines; sweep a straight stick's shadow across it, and keep the camera and"
            " all else still"
        )
    return lines


def _advise(figures: Figures, footage: Footage) -> None:
    """Say what a crew should know before it leaves."""
    take = footage.sequence.pattern
    bend, reached = figures["bend"], figures["reached"]
    if abs(bend["pixels"]) > _BENT and bend["certainty"] > _CERTAIN:
        logger.warning(
            "%s: the shadow's lines bend by %.1f pixels, as a lens bends them; take the lens's"
            " distortion out of all footage first",
            take,
            abs(bend["pixels"]),
        )
    if reached < _LITTLE:
        logger.warning(
            "%s: the sweep reached only %.0f%% of the frame; what it misses needs two others",
            take,
            100 * reached,
        )
    trembles = figures["trembling"] > UNSTEADY
    if figures["errors_raised"] > _TREMBLING:
        logger.warning(
            "%s: times on the plane differ by %.1f times what noise explains; %s",
            take,
            figures["errors_raised"],
            "a camera that trembles or a codec does that, fix it or stabilize the take"
            if trembles
            else "an uneven pace, steps larger than the shadow is wide, or a codec does that;"
            " sweep evenly and more slowly, with a wider board",
        )
    if trembles:
        logger.warning(
            "%s: the camera trembles by %.2f pixels; %s",
            take,
            figures["trembling"],
            "objects are less well known; hold it firmly, or give --steady auto"
            if footage.vantage is None
            else "frames are moved to one place",
        )
    if figures["off_lines"] > _MANY_OFF:
        logger.warning(
            "%s: %.0f%% of the plane lies off the edge's lines; a board that is bent, a stick that"
            " is too narrow, %s, or something else that crosses does that",
            take,
            100 * figures["off_lines"],
            "a camera that trembles" if trembles else "an uneven pace",
        )
    if figures["beyond_lines"] > _BEYOND:
        logger.warning(
            "%s: the shadow reached %.0f%% of what it did before or after it crossed the plane, and"
            " tells nothing there; mark a larger plane, or sweep across it",
            take,
            100 * figures["beyond_lines"],
        )
    if figures["pixels_per_frame"] > _FAST:
        logger.warning(
            "%s: the shadow moves %.0f pixels a frame; small things fall between two frames,"
            " sweep more slowly",
            take,
            figures["pixels_per_frame"],
        )


def _figures(
    times: ShadowTimes,
    lines: ShadowLines,
    region: NDArray[np.bool_],
    gains: dict[Frame, float],
    bend: Bend,
) -> Figures:
    reached = np.isfinite(times.time)
    known = times.time[reached]
    beyond = (known < lines.frame[0]) | (known > lines.frame[-1])
    # What is usual, some of them tell.
    errors = times.error[some_of(reached)]
    y, x = some_of(region & reached)
    pace = line_pace(lines, times.time[y, x], np.stack([x, y], axis=-1))
    turned = math.degrees(float(lines.angle[-1] - lines.angle[0]))
    origins = list(lines.origin)
    return {
        "frames": len(gains),
        "gain": {"least": round(min(gains.values()), 4), "most": round(max(gains.values()), 4)},
        "reached": round(float(reached.mean()), 4),
        "beyond_lines": round(float(beyond.mean()), 4) if beyond.size else 0.0,
        "lines": {
            "first": float(lines.frame[0]),
            "last": float(lines.frame[-1]),
            **{origin: origins.count(origin) for origin in ("fit", "refit", "interpolated")},
        },
        "residual": {
            "median": round(float(np.median(lines.residual)), 4),
            "largest": round(float(lines.residual.max()), 4),
        },
        "predicted_error": {
            # Of a time, in frames, and on the plane as far as the edge moves meanwhile.
            "frames": round(float(median(errors)), 4),
            "pixels": round(float(median(times.error[y, x] * pace)), 3),
        },
        "bend": {"pixels": round(bend.pixels, 2), "certainty": round(min(bend.certainty, 1e6), 1)},
        "pixels_per_frame": round(float(median(pace)), 3),
        "direction_degrees": round(math.degrees(float(lines.angle[len(lines) // 2])) % 360, 2),
        "turned_degrees": round(turned, 2),
    }
