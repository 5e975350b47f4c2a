"""A displacement map from passes, band by band."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import overlapping_bands
from shadowtool.core.epipole import Epipole, find_epipole
from shadowtool.core.parallax import measure_parallax, without_unchecked
from shadowtool.core.plane_fits import Windows, fit_planes
from shadowtool.core.shadow_lines import line_pace
from shadowtool.core.warp_map import Pass, WarpMap, identity_map, intersect, without_slips
from shadowtool.parallel import ordered_map
from shadowtool.steps.run import Progress, no_progress

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# About so many pixels are enough to find the light's image.
_THIN = 200_000
# If displacements miss the light's image by more than this, pixels, and without one of the passes
# by less than this part of that, and of what they do without any other, that pass is wrong.
_MISSED, _WRONG = 0.5, 0.4
# The plane is what more than this part of the passes have marked.
_MOSTLY = 0.5


class Solved(NamedTuple):
    """W as measured.

    Attributes:
        warp_map: W, NaN where unknown.
        epipole: the light's image, if W shows where it is.
        left_out: the number of a pass that does not agree with the others; None if they do.
    """

    warp_map: WarpMap
    epipole: Epipole | None
    left_out: int | None


def solve(passes: list[Pass], jobs: int | None = None, progress: Progress = no_progress) -> Solved:
    """Intersect the lines of all passes, first for the light's image, then for W towards it.

    Where nothing stands on the plane, or where the displacements agree on no light's image, W is
    the intersection in two dimensions. A pass that does not agree with two others or more is used
    only where these say nothing. With the light's image one pass is believed by itself where what
    it tells goes on from what others do.

    Args:
        passes: two or more, all of one size.
        progress: told of bands done, and of how many.
    """
    height, width = passes[0].times.time.shape
    positions = identity_map(height, width)
    epipole, left_out = _light(passes, positions)
    used = [scan for number, scan in enumerate(passes) if number != left_out]
    windows = Windows.for_step(max(map(_usual_pace, used)))

    def measured(some: list[Pass], rows: slice, inner: slice) -> WarpMap:
        own, here = [scan.part(rows) for scan in some], positions[rows]
        if epipole is None:
            return _in_two_dimensions(own, here, windows, inner)
        return _towards(epipole, own, here, windows, inner)

    def band(cut: tuple[slice, slice]) -> tuple[slice, WarpMap]:
        rows, inner = cut
        part = measured(used, rows, inner)
        if left_out is not None:
            # Where the others say nothing it is better than nothing.
            unknown, other = np.isinf(part.error), measured(passes, rows, inner)
            part.warp[unknown], part.error[unknown] = other.warp[unknown], other.error[unknown]
        return slice(rows.start + inner.start, rows.start + inner.stop), part

    whole = WarpMap(np.empty((height, width, 2), np.float32), np.empty((height, width), np.float32))
    cuts = overlapping_bands(height, windows.reach)
    progress(0, len(cuts))
    for done, (rows, part) in enumerate(ordered_map(band, cuts, jobs), start=1):
        whole.warp[rows], whole.error[rows] = part.warp, part.error
        progress(done, len(cuts))
    if epipole is not None:
        whole = without_unchecked(whole, used, marked(used))
    return Solved(without_slips(whole), epipole, left_out)


def _light(passes: list[Pass], positions: Float32) -> tuple[Epipole | None, int | None]:
    """The light's image, and the number of the pass that was left out to find it, if one is wrong.

    On the reference plane displacements are errors, which many of its pixels may have in common:
    there nothing is looked for.
    """
    every = max(1, math.isqrt(positions.shape[0] * positions.shape[1] // _THIN))
    thin = slice(None, None, every)
    parts, here = [scan.part(thin, thin) for scan in passes], positions[thin, thin]
    plane = marked(parts)

    def seen_by(some: list[Pass]) -> Epipole | None:
        found = intersect(some, here)
        off_plane = np.where(plane, np.float32(np.inf), found.error)
        epipole = find_epipole(found.warp, off_plane, here)
        # A mark may be drawn over all that stands on the plane.
        return epipole or (find_epipole(found.warp, found.error, here) if plane.any() else None)

    everything = seen_by(parts)
    if len(parts) < 3 or (everything is not None and everything.miss <= _MISSED):
        return everything, None
    without = [seen_by(parts[:number] + parts[number + 1 :]) for number in range(len(parts))]
    misses = [math.inf if epipole is None else epipole.miss for epipole in without]
    best = int(np.argmin(misses))
    # Two passes have a point of their own whatever they are, if now and then: one is wrong only if
    # with it all is, and without it all is well.
    worse = min(misses[:best] + misses[best + 1 :])
    if everything is not None:
        worse = min(worse, everything.miss)
    agreed = misses[best] < _WRONG * worse and (everything is not None or misses[best] <= _MISSED)
    return (without[best], best) if agreed else (everything, None)


def marked(passes: list[Pass]) -> Bool:
    """(H, W), what most passes that have a mark have marked as the reference plane."""
    marks = [scan.plane for scan in passes if scan.plane is not None]
    if not marks:
        return np.zeros(passes[0].times.time.shape, bool)
    return np.asarray(np.mean(marks, axis=0) > _MOSTLY, bool)


def _usual_pace(scan: Pass) -> float:
    """How fast most lines pass the middle of the picture, pixels a frame."""
    lines, (height, width) = scan.lines, scan.times.time.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    away = lines.normal @ middle + lines.offset
    nearest = middle - away[:, np.newaxis] * lines.normal
    return float(np.median(line_pace(lines, lines.frame, nearest)))


def _towards(
    epipole: Epipole,
    passes: list[Pass],
    positions: Float32,
    windows: Windows,
    wanted: slice,
) -> WarpMap:
    directions = epipole.directions(positions)
    measured = measure_parallax(passes, positions, directions)
    shift, error = fit_planes(measured.shift, measured.deviation, windows, wanted)
    # What lines are off does not average out among pixels that have them in common. On the plane,
    # whose own pixels they were fitted to, that is what these deviate by.
    off_plane = ~marked(passes)[wanted]
    error[off_plane] = np.hypot(error[off_plane], measured.common[wanted][off_plane])
    return WarpMap(positions[wanted] + shift[..., None] * directions[wanted], error)


def _in_two_dimensions(
    passes: list[Pass],
    positions: Float32,
    windows: Windows,
    wanted: slice,
) -> WarpMap:
    found = intersect(passes, positions)
    displacement = found.warp - positions
    # The predicted error is that of both coordinates together.
    each = (found.error / np.sqrt(2)).astype(np.float32)
    x, y = (fit_planes(displacement[..., axis], each, windows, wanted) for axis in (0, 1))
    warp = positions[wanted] + np.stack([x[0], y[0]], axis=-1)
    return WarpMap(warp, np.hypot(x[1], y[1]).astype(np.float32))
