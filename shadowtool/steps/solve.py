"""A displacement map from passes, band by band."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import overlapping_bands
from shadowtool.core.epipole import Epipole, find_epipole
from shadowtool.core.parallax import measure_parallax
from shadowtool.core.plane_fits import Windows, fit_planes
from shadowtool.core.shadow_lines import line_pace
from shadowtool.core.warp_map import Pass, WarpMap, identity_map, intersect, without_slips
from shadowtool.parallel import ordered_map
from shadowtool.steps.run import Progress, no_progress

Float32 = NDArray[np.float32]

# About so many pixels are enough to find the light's image.
_THIN = 200_000


class Solved(NamedTuple):
    """W as measured, NaN where unknown, and the light's image if W shows where it is."""

    warp_map: WarpMap
    epipole: Epipole | None


def solve(passes: list[Pass], jobs: int | None = None, progress: Progress = no_progress) -> Solved:
    """Intersect the lines of all passes, first for the light's image, then for W towards it.

    Where nothing stands on the plane, or where the displacements agree on no light's image, W is
    the intersection in two dimensions.

    Args:
        passes: two or more, all of one size.
        progress: told of bands done, and of how many.
    """
    height, width = passes[0].times.time.shape
    positions = identity_map(height, width)
    windows = Windows.for_step(max(map(_usual_pace, passes)))
    every = max(1, math.isqrt(height * width // _THIN))
    thin = slice(None, None, every)
    found = intersect([scan.part(thin, thin) for scan in passes], positions[thin, thin])
    epipole = find_epipole(found.warp, found.error, positions[thin, thin])

    def band(cut: tuple[slice, slice]) -> tuple[slice, WarpMap]:
        rows, inner = cut
        own = [scan.part(rows) for scan in passes]
        here = positions[rows]
        if epipole is None:
            part = _in_two_dimensions(own, here, windows, inner)
        else:
            part = _towards(epipole, own, here, windows, inner)
        return slice(rows.start + inner.start, rows.start + inner.stop), part

    whole = WarpMap(np.empty((height, width, 2), np.float32), np.empty((height, width), np.float32))
    cuts = overlapping_bands(height, windows.reach)
    progress(0, len(cuts))
    for done, (rows, part) in enumerate(ordered_map(band, cuts, jobs), start=1):
        whole.warp[rows], whole.error[rows] = part.warp, part.error
        progress(done, len(cuts))
    return Solved(without_slips(whole), epipole)


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
    shift, error = measure_parallax(passes, positions, directions)
    shift, error = fit_planes(shift, error, windows, wanted)
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
