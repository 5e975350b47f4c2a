"""Pictures of measurements with known errors, smoothed by the planes that fit around each pixel.

A surface that is flat or gently bent makes shadow times and displacements that are locally linear
in the pixel's position, and that end at its outline. So a pixel is given the value of a plane
fitted to a window that holds it, but need not be centred on it: of all such windows the one whose
plane is known best, among those that the measurements agree with.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Floats = NDArray[np.floating]
Bool = NDArray[np.bool_]
Powers = Sequence[tuple[int, int]]

# Half the windows' widths, pixels, for edges that move up to so many pixels a frame; and the
# largest for any. Where a step is longer than usual, the largest must still reach over it.
RADII, _STEP, _WIDEST = (1, 2, 4, 7), 8.0, 40
# Mean squared deviation from its plane, in squared errors, above which a window holds more than
# one surface.
_MISFIT = 1.5
# On a plane three quarters of the windows are to deviate by no more than this; windows of so many
# pixels together tell.
_USUAL_MISFIT, _TOLD = 1.2, 200_000
# A pixel's own measurement may deviate from the plane, and the plane from that of smaller windows,
# by this many standard deviations.
_AGREES = 3.0
# Of the eight pixels around a measurement so many have to agree with it.
_COMPANY = 3
# Slopes are held back as if each window had seen none, with this weight.
_LEVEL = 0.1
# No plane is known better than this.
_FLOOR = 0.02
# From these radii on, windows are made of cells of so many pixels squared.
_WIDE = {8: 2, 16: 4}
# So many arrays of pixels are worked on together.
_ARRAYS = 6


@dataclass(frozen=True)
class Windows:
    """In what windows planes are fitted.

    Attributes:
        radii: half their widths, pixels, ascending.
        factor: by how much a plane is known worse than from independent measurements.
        near: by how much neighbours may differ that agree, besides what their errors explain.
    """

    radii: tuple[int, ...] = RADII
    factor: float = 1.0
    near: float = 1.0

    @property
    def reach(self) -> int:
        """How far from a pixel its value may depend on others, pixels; a multiple of all cells."""
        size, radius = _cells(max(self.radii))
        largest = max(_WIDE.values())
        return -(-(2 * radius + 1) * size // largest) * largest

    @classmethod
    def for_step(cls, step: float, radii: tuple[int, ...] = RADII) -> "Windows":
        """For edges that move ``step`` pixels a frame.

        What happens between two frames is told by windows wider than the step. In smaller ones
        all pixels say the same, and no more than a few of them.

        Args:
            radii: for steps of up to 8 pixels.
        """
        factor = max(step / _STEP, 1.0)
        return cls(tuple(min(round(radius * factor), _WIDEST) for radius in radii), factor)


def fit_planes(
    value: Float32, error: Float32, windows: Windows = Windows(), wanted: slice = slice(None)
) -> tuple[Float32, Float32]:
    """Each pixel's value on the best known plane that agrees with the measurements around it.

    Args:
        value: (H, W) float32; NaN unknown, which takes no part.
        error: (H, W) float32, standard deviation of each value, in its unit; infinite unknown.
        wanted: rows; no others are worked out.

    Returns:
        Value and predicted error, (H, W) float32 each, of the rows wanted; NaN and infinite where
        the value was unknown. A lone measurement that no neighbour agrees with is replaced.
    """
    known = np.isfinite(value) & np.isfinite(error)
    variance = np.where(known, error, 1).astype(np.float64) ** 2
    trusted = _trusted(value, error, windows.near)
    measured = np.where(known, value, 0).astype(np.float64)
    weight = np.where(trusted, 1 / np.maximum(variance, 1e-12), 0)
    first, last, _ = wanted.indices(len(value))
    known, trusted, variance = known[wanted], trusted[wanted], variance[wanted]
    best = measured[wanted].astype(np.float32)
    spread = np.where(trusted, variance, np.inf).astype(np.float32)
    # A plane may deviate from the measurement by so much.
    allowed = np.where(trusted, _AGREES * np.sqrt(variance), np.inf).astype(np.float32)
    least, most = best - allowed, best + allowed
    for radius in windows.radii:
        size, cells = _cells(radius)
        # A pixel's windows are centred up to so many cells off its own, and end at as many more.
        start = max(first // size - 2 * cells, 0) * size
        stop = (-(-last // size) + 2 * cells) * size
        planes = _planes(measured[start:stop], weight[start:stop], size, cells, windows.factor)
        for rows in bands(best.shape, channels=_ARRAYS):
            chosen = _Choice(*(part[rows] for part in (best, spread, least, most)))
            _choose(planes, size * cells, rows.start + first - start, chosen)
    found = known & np.isfinite(spread)
    best[~found] = np.nan
    spread[~found] = np.inf
    return best, np.sqrt(spread, out=spread)


def _trusted(value: Float32, error: Float32, near: float) -> Bool:
    """Which measurements are known, and agree with others around them."""
    known = np.isfinite(value) & np.isfinite(error)
    variance = np.where(known, error, 1).astype(np.float32) ** 2
    return known & _in_company(np.where(known, value, np.float32(np.nan)), variance, near)


def understated(value: Float32, error: Float32, plane: Bool, windows: Windows = Windows()) -> float:
    """By what factor errors are larger than they were said to be, judged where a plane is known to
    be; 1 if they are not.

    A camera that trembles, or a codec, moves measurements by more than their noise explains. Where
    errors are understated next to no window seems to hold a single surface. With r the deviations
    from a window's own plane and n their number, Σ(r/σ)² / (n - 3) would be 1; what three quarters
    of the windows stay below tells by how much it is more.

    Args:
        value, error: (H, W) float32 as of `fit_planes`; NaN and infinite unknown, left out.
        plane: (H, W) bool, where all belongs to one plane.
        windows: the largest of them are looked at, as many as lie on the plane altogether.

    Returns:
        The factor, at least 1; 1 also if no window can tell.
    """
    radius = max(windows.radii)
    size = (2 * radius + 1, 2 * radius + 1)
    inside = cv2.erode(
        plane.astype(np.uint8), np.ones(size), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    places = np.flatnonzero(inside)
    if not places.size:
        return 1.0
    every = max(1, len(places) * size[0] ** 2 // _TOLD)
    middle = np.divmod(places[::every], value.shape[1])
    # With a margin, as a measurement is trusted by those around it.
    y, x = np.mgrid[-radius - 1 : radius + 2, -radius - 1 : radius + 2]
    around = tuple(
        place[:, np.newaxis, np.newaxis] + off for place, off in zip(middle, (y, x), strict=True)
    )
    within = tuple(np.clip(place, 0, n - 1) for place, n in zip(around, value.shape, strict=True))
    outside = (around[0] != within[0]) | (around[1] != within[1])
    values, errors = np.where(outside, np.float32(np.nan), value[within]), error[within]
    # One below the other: only their margins meet.
    tall = (-1, values.shape[2])
    trusted = _trusted(values.reshape(tall), errors.reshape(tall), windows.near)
    used = trusted.reshape(values.shape)[:, 1:-1, 1:-1].reshape(len(values), -1)
    values, errors = (
        part[:, 1:-1, 1:-1].reshape(len(part), -1).astype(np.float64) for part in (values, errors)
    )
    y, x = (part[1:-1, 1:-1].ravel() for part in (y, x))
    weight = np.where(used, 1 / np.maximum(errors**2, 1e-12), 0)
    measured = np.where(used, values, 0)
    terms = np.stack([np.ones(len(x)), x / radius, y / radius], axis=-1)
    normal = np.einsum("nk,ki,kj->nij", weight, terms, terms) + 1e-6 * np.eye(3)
    right = np.einsum("nk,ki->ni", weight * measured, terms)
    planes = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
    count = used.sum(axis=1)
    misfit = (weight * (measured - planes @ terms.T) ** 2).sum(axis=1) / np.maximum(count - 3, 1)
    misfit = misfit[count > len(x) / 2]
    return float(np.sqrt(max(np.quantile(misfit, 0.75) / _USUAL_MISFIT, 1))) if misfit.size else 1.0


def _in_company(value: Float32, variance: Float32, near: float) -> Bool:
    """Where enough of the eight pixels around agree with a measurement; NaN agrees with none."""
    company = np.zeros(value.shape, np.uint8)
    # The other four directions are these from the other pixel's point of view.
    for dy, dx in ((0, 1), (1, -1), (1, 0), (1, 1)):
        here, there = _overlap(value.shape, dy, dx)
        allowed = np.sqrt(variance[here] + variance[there])
        allowed *= np.float32(_AGREES)
        allowed += np.float32(near)
        agrees = np.abs(value[here] - value[there]) < allowed
        company[here] += agrees
        company[there] += agrees
    return company >= _COMPANY


def _cells(radius: int) -> tuple[int, int]:
    """The cells that windows of a radius are made of: their size in pixels, and how many lie on
    either side of the middle one."""
    size = max((size for least, size in _WIDE.items() if radius >= least), default=1)
    return size, round((2 * radius + 1 - size) / (2 * size))


class _Planes(NamedTuple):
    """The planes a + bx + cy fitted to the windows around the pixels, x and y counted from the
    middle in radii; the variance at (x, y) is aa + x·ab + y·ac + x²·bb + xy·bc + y²·cc, infinite
    where the window holds more than one surface. (H, W) float32 each."""

    a: Float32
    b: Float32
    c: Float32
    aa: Float32
    ab: Float32
    ac: Float32
    bb: Float32
    bc: Float32
    cc: Float32

    def at(self, pixels: tuple[slice, slice], x: int, y: int) -> tuple[Float32, Float32]:
        """Value and variance at (x, y), each of which is -1, 0 or 1, of the windows at pixels."""
        a, b, c, aa, ab, ac, bb, bc, cc = (part[pixels] for part in self)
        value, variance = a.copy(), aa.copy()
        for side, slope, linear, square in ((x, b, ab, bb), (y, c, ac, cc)):
            if side:
                _added(value, slope, side)
                _added(variance, linear, side)
                variance += square
        if x and y:
            _added(variance, bc, x * y)
        return value, variance

    def from_column(self, x: Float32) -> "_Planes":
        """The same counted from (x, 0)."""
        a, b, c, aa, ab, ac, bb, bc, cc = self
        a, aa = a + x * b, aa + x * (ab + x * bb)
        return _Planes(a, b, c, aa, ab + 2 * x * bb, ac + x * bc, bb, bc, cc)

    def from_row(self, y: Float32) -> "_Planes":
        """The same counted from (0, y)."""
        a, b, c, aa, ab, ac, bb, bc, cc = self
        a, aa = a + y * c, aa + y * (ac + y * cc)
        return _Planes(a, b, c, aa, ab + y * bc, ac + 2 * y * cc, bb, bc, cc)


def _added(total: Float32, part: Float32, sign: int) -> None:
    (np.add if sign > 0 else np.subtract)(total, part, out=total)


class _Choice(NamedTuple):
    """Value and variance of what was chosen so far, and between what a plane's value has to lie to
    agree with the pixel's own; (H, W) float32 each."""

    value: Float32
    variance: Float32
    least: Float32
    most: Float32


def _choose(planes: _Planes, radius: int, first: int, chosen: _Choice) -> None:
    """Replace what was chosen by the best known of the windows that hold a pixel.

    Args:
        first: the row among the planes that is the first of the choice.
    """
    best, spread, least, most = chosen
    rows = slice(first, first + len(best))
    # And with what smaller windows told.
    allowed = np.sqrt(spread)
    allowed *= np.float32(_AGREES)
    least, most = np.maximum(least, best - allowed), np.minimum(most, best + allowed)
    for row, column in np.ndindex(3, 3):
        y, x = row - 1, column - 1
        # The window's centre lies (x, y) ahead, so the pixel lies (-x, -y) off it.
        here, there = _overlap(planes.a.shape, y * radius, x * radius, rows)
        value, variance = planes.at(there, -x, -y)
        better = variance < spread[here]
        better &= value >= least[here]
        better &= value <= most[here]
        # Many times faster than numpy's own where it goes now one way, now the other.
        cv2.copyTo(value, better.view(np.uint8), best[here])
        cv2.copyTo(variance, better.view(np.uint8), spread[here])


def _planes(value: Float64, weight: Float64, size: int, cells: int, factor: float) -> _Planes:
    """The planes fitted to the windows around all pixels.

    Args:
        size, cells: what windows are made of, as of `_cells`: those of a cell's pixels are the
            same.
        factor: by how much planes are known worse than from independent measurements.
    """
    weighted = weight * value
    used = (weight > 0).astype(np.float32)
    sums = [
        *_window_sums(weight, size, cells, ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))),
        *_window_sums(weighted, size, cells, ((0, 0), (1, 0), (0, 1))),
        *_window_sums(weighted * value, size, cells, ((0, 0),)),
        *_window_sums(used, size, cells, ((0, 0),)),
    ]
    found = _Planes(*(np.empty(sums[0].shape, np.float32) for _ in range(9)))
    for rows in bands(sums[0].shape, channels=_ARRAYS):
        _solve([part[rows] for part in sums], factor, size * cells, rows, found)
    return found if size == 1 else _for_pixels(found, value.shape, size, cells)


def _for_pixels(found: _Planes, shape: tuple[int, ...], size: int, cells: int) -> _Planes:
    """The same planes for each of the cells' pixels, counted as if it were the cell's middle."""
    height, width = found.a.shape
    # In radii, as the planes are.
    offsets = ((np.arange(size) - (size - 1) / 2) / (size * cells)).astype(np.float32)
    wide = (width * size, height)
    parts = (cv2.resize(part, wide, interpolation=cv2.INTER_NEAREST) for part in found)
    moved = _Planes(*(np.asarray(part, np.float32) for part in parts)).from_column(
        np.tile(offsets, width)
    )
    planes = _Planes(*(np.empty((height, size, width * size), np.float32) for _ in found))
    for row in range(size):
        for part, own in zip(planes, moved.from_row(offsets[row : row + 1]), strict=True):
            part[:, row] = own
    own_rows, own_columns = map(slice, shape)
    return _Planes(*(part.reshape(height * size, -1)[own_rows, own_columns] for part in planes))


def _window_sums(image: Floats, size: int, cells: int, powers: Powers) -> list[Floats]:
    """Sums of the image times xᵃyᵇ over the windows around all cells, x and y counted from there
    in pixels."""
    border = cv2.BORDER_CONSTANT
    if size == 1:
        ramp = np.arange(-cells, cells + 1, dtype=np.float64)
        kernels = [ramp**power for power in range(3)]
        return [
            np.asarray(cv2.sepFilter2D(image, -1, kernels[a], kernels[b], borderType=border))
            for a, b in powers
        ]
    moments = _moments(image, size, powers)
    height, width = moments[0, 0].shape
    # All about the picture's middle, to be summed up, and then each about its own window's.
    x = size * (np.arange(width) - width / 2)
    y = size * (np.arange(height) - height / 2)[:, np.newaxis]
    _count_from(moments, -x, -y)
    window = (2 * cells + 1, 2 * cells + 1)
    for power, own in moments.items():
        total = cv2.boxFilter(own, -1, window, normalize=False, borderType=border)
        moments[power] = np.asarray(total, np.float64)
    _count_from(moments, x, y)
    return [moments[power] for power in powers]


def _moments(image: Floats, size: int, powers: Powers) -> dict[tuple[int, int], Float64]:
    """Sums of the image times xᵃyᵇ over each cell, x and y counted from its middle in pixels."""
    height, width = (-(-length // size) for length in image.shape)
    if (height * size, width * size) != image.shape:
        rest = [(0, n * size - own) for n, own in zip((height, width), image.shape, strict=True)]
        image = np.pad(image, rest)
    offsets = np.arange(size) - (size - 1) / 2
    across = [np.zeros((height * size, width)) for _ in range(1 + max(a for a, _ in powers))]
    for column, x in enumerate(offsets):
        for a, total in enumerate(across):
            total += x**a * image[:, column::size]
    moments = {power: np.zeros((height, width)) for power in powers}
    for row, y in enumerate(offsets):
        for (a, b), total in moments.items():
            total += y**b * across[a][row::size]
    return moments


def _count_from(moments: dict[tuple[int, int], Float64], x: Float64, y: Float64) -> None:
    """Have moments, of all powers up to the highest, counted from (x, y)."""
    total = moments[0, 0]
    if (2, 0) in moments:
        moments[2, 0] -= x * (2 * moments[1, 0] - x * total)
        moments[1, 1] -= x * moments[0, 1] + y * (moments[1, 0] - x * total)
        moments[0, 2] -= y * (2 * moments[0, 1] - y * total)
    if (1, 0) in moments:
        moments[1, 0] -= x * total
        moments[0, 1] -= y * total


def _solve(
    sums: list[Floats],
    factor: float,
    radius: int,
    rows: slice,
    planes: _Planes,
) -> None:
    """The planes of some rows from the sums over their windows, which are overwritten."""
    w, wx, wy, wxx, wxy, wyy, wv, wvx, wvy, wvv, count = sums
    w += 1e-9
    wxx += _LEVEL
    wyy += _LEVEL
    # About the weighted mean, where slopes and level are told apart.
    inverse = 1 / w
    mean_x, mean_y, mean_v = wx * inverse, wy * inverse, wv * inverse
    wxx -= wx * mean_x
    wxy -= wx * mean_y
    wyy -= wy * mean_y
    wvx -= mean_x * wv
    wvy -= mean_y * wv
    wvv -= mean_v * wv
    determinant = wxx * wyy - wxy * wxy
    slopes = wyy / determinant, -wxy / determinant, wxx / determinant
    # From here on nothing large cancels out.
    x, y, caa, cbb, cbc, ccc, vx, vy, misfit = (
        part.astype(np.float32) for part in (mean_x, mean_y, inverse, *slopes, wvx, wvy, wvv)
    )
    b = cbb * vx + cbc * vy
    c = cbc * vx + ccc * vy
    planes.a[rows] = mean_v
    planes.a[rows] -= b * x + c * y
    np.multiply(b, radius, out=planes.b[rows])
    np.multiply(c, radius, out=planes.c[rows])
    misfit -= b * vx + c * vy
    misfit /= np.maximum(count - 3, 1)
    cab, cac = cbb * x + cbc * y, cbc * x + ccc * y
    caa += cab * x + cac * y
    worse = np.maximum(misfit, 1)
    worse *= factor**2
    elements: tuple[Float32, ...] = (caa, cab, cac, cbb, cbc, ccc)
    factors = (1, -2 * radius, -2 * radius, radius**2, 2 * radius**2, radius**2)
    for part, element, times in zip(planes[3:], elements, factors, strict=True):
        np.multiply(element, worse, out=part[rows])
        part[rows] *= times
    planes.aa[rows] += np.float32(_FLOOR**2)
    planes.aa[rows][(misfit >= _MISFIT) | (count < 4)] = np.inf


def _overlap(
    shape: tuple[int, ...], dy: int, dx: int, rows: slice = slice(None)
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The pixels of these rows that have another one (dy, dx) ahead within the picture, counted
    from the first of the rows, and those others."""
    height, width = shape
    first, last, _ = rows.indices(height)
    start, stop = max(first, -dy), min(last, height - dy)
    left, right = max(0, -dx), min(width, width - dx)
    if start >= stop or left >= right:
        return (slice(0, 0), slice(0, 0)), (slice(0, 0), slice(0, 0))
    here = (slice(start - first, stop - first), slice(left, right))
    return here, (slice(start + dy, stop + dy), slice(left + dx, right + dx))
