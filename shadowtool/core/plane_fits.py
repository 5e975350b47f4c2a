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

try:
    # There is a function of that name here.
    from shadowtool.core import _planes as _compiled
except ImportError:
    # No compiler was there when this was installed.
    _compiled = None  # type: ignore[assignment]

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Floats = NDArray[np.floating]
Bool = NDArray[np.bool_]
Powers = Sequence[tuple[int, int]]
Moments = dict[tuple[int, int], Floats]

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
# Slopes are held back as if each window had seen none, with this weight; and values by this.
_LEVEL, _WEIGHT = 0.1, 1e-9
# No plane is known better than this.
_FLOOR = 0.02
# Nor does a measurement weigh more than as of this variance: digits would not do for it and others.
_LEAST_VARIANCE = 1e-6
# From these radii on, windows are made of cells of so many pixels squared.
_WIDE = {8: 2, 16: 4}
# So many arrays of pixels are worked on together.
_ARRAYS = 6
# What weights, weighted values, their squares, and the number of pixels are summed up with.
_POWERS: tuple[Powers, ...] = (
    ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)),
    ((0, 0), (1, 0), (0, 1)),
    ((0, 0),),
    ((0, 0),),
)


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
    value, error = (np.ascontiguousarray(part, np.float32) for part in (value, error))
    known, variance = _known(value, error)
    trusted = _trusted(value, known, variance, windows.near)
    measured, weight = (np.empty(value.shape) for _ in range(2))
    for rows in bands(value.shape):
        measured[rows] = np.where(known[rows], value[rows], np.float32(0))
        weight[rows] = trusted[rows] / np.maximum(variance[rows], np.float32(_LEAST_VARIANCE))
    first, last, _ = wanted.indices(len(value))
    known, trusted, variance = known[wanted], trusted[wanted], variance[wanted]
    best = measured[wanted].astype(np.float32)
    spread = np.where(trusted, variance, np.float32(np.inf))
    # A plane may deviate from the measurement by so much.
    allowed = np.sqrt(spread)
    allowed *= np.float32(_AGREES)
    least, most = best - allowed, best + allowed
    for radius in windows.radii:
        size, cells = _cells(radius)
        # A pixel's windows are centred up to so many cells off its own, and end at as many more.
        start = max(first // size - 2 * cells, 0) * size
        stop = (-(-last // size) + 2 * cells) * size
        planes = _planes(measured[start:stop], weight[start:stop], size, cells, windows.factor)
        for rows in bands(best.shape, channels=_ARRAYS // 2):
            chosen = _Choice(*(part[rows] for part in (best, spread, least, most)))
            _choose(planes, rows.start + first - start, chosen)
    found = known & np.isfinite(spread)
    best[~found] = np.nan
    spread[~found] = np.inf
    return best, np.sqrt(spread, out=spread)


def _known(value: Float32, error: Float32) -> tuple[Bool, Float32]:
    """Which measurements are known, and their variances; 1 where they are not."""
    known = np.isfinite(value)
    known &= np.isfinite(error)
    variance = np.where(known, error, np.float32(1))
    return known, np.square(variance, out=variance)


def _trusted(value: Float32, known: Bool, variance: Float32, near: float) -> Bool:
    """Which of the known measurements agree with enough of the eight around them."""
    value = np.where(known, value, np.float32(np.nan))
    allowed = variance * np.float32(_AGREES**2)
    if _compiled is not None:
        trusted = np.empty(value.shape, bool)
        _compiled.trust(value, allowed, trusted, near, _COMPANY)
        return trusted
    company = np.zeros(value.shape, np.uint8)
    # The other four directions are these from the other pixel's point of view.
    for rows in bands(value.shape):
        for dy, dx in ((0, 1), (1, -1), (1, 0), (1, 1)):
            here, there = _overlap(value.shape, dy, dx, rows)
            here = (slice(here[0].start + rows.start, here[0].stop + rows.start), here[1])
            apart = np.abs(value[here] - value[there])
            apart -= np.float32(near)
            np.maximum(apart, 0, out=apart)
            # NaN agrees with none.
            agrees = np.square(apart, out=apart) <= allowed[here] + allowed[there]
            company[here] += agrees
            company[there] += agrees
    return company >= _COMPANY


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
    trusted = _trusted(
        values.reshape(tall), *_known(values.reshape(tall), errors.reshape(tall)), windows.near
    )
    used = trusted.reshape(values.shape)[:, 1:-1, 1:-1].reshape(len(values), -1)
    values, errors = (
        part[:, 1:-1, 1:-1].reshape(len(part), -1).astype(np.float64) for part in (values, errors)
    )
    y, x = (part[1:-1, 1:-1].ravel() for part in (y, x))
    weight = np.where(used, 1 / np.maximum(errors**2, _LEAST_VARIANCE), 0)
    measured = np.where(used, values, 0)
    terms = np.stack([np.ones(len(x)), x / radius, y / radius], axis=-1)
    normal = np.einsum("nk,ki,kj->nij", weight, terms, terms) + 1e-6 * np.eye(3)
    right = np.einsum("nk,ki->ni", weight * measured, terms)
    planes = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
    count = used.sum(axis=1)
    misfit = (weight * (measured - planes @ terms.T) ** 2).sum(axis=1) / np.maximum(count - 3, 1)
    misfit = misfit[count > len(x) / 2]
    return float(np.sqrt(max(np.quantile(misfit, 0.75) / _USUAL_MISFIT, 1))) if misfit.size else 1.0


def _cells(radius: int) -> tuple[int, int]:
    """The cells that windows of a radius are made of: their size in pixels, and how many lie on
    either side of the middle one."""
    size = max((size for least, size in _WIDE.items() if radius >= least), default=1)
    return size, round((2 * radius + 1 - size) / (2 * size))


class _Planes(NamedTuple):
    """The planes a + bx + cy fitted to the windows around cells, x and y counted in radii; the
    variance at (x, y) is r + (p + x·px + y·py)² + (q + y·qy)², infinite where the window holds more
    than one surface. (rows of cells, W) float32 each.

    Squares, as of a sum of products rounding may leave less than nothing.

    They stand for each column of pixels, x counted from it, and y from the middle of the cells.
    """

    a: Float32
    b: Float32
    c: Float32
    r: Float32
    p: Float32
    px: Float32
    py: Float32
    q: Float32
    qy: Float32

    def from_column(self, x: Float32) -> "_Planes":
        """The same counted from (x, 0)."""
        return self._replace(a=self.a + x * self.b, p=self.p + x * self.px)

    def along(self, rows: slice, y: Float32) -> "_Lines":
        """What they are at several y, (N, 1), for some rows."""
        a, b, c, r, p, px, py, q, qy = (part[rows, np.newaxis] for part in self)
        q = q + y * qy
        return _Lines(a + y * c, b, r + q * q, p + y * py, px)


class _Lines(NamedTuple):
    """Planes at one y each: a + bx, with the variance r + (p + x·px)²; (rows of cells, N, W)."""

    a: Float32
    b: Float32
    r: Float32
    p: Float32
    px: Float32

    def at(self, x: int, columns: slice) -> tuple[Float32, Float32]:
        """Value and variance at x, which is -1, 0 or 1, of some columns; (rows, columns)."""
        a, b, r, p, px = (part[..., columns] for part in self)
        if x:
            combine = np.add if x > 0 else np.subtract
            a, p = combine(a, b), combine(p, px)
        variance = r + p * p
        shape = a.shape[0] * a.shape[1], a.shape[2]
        return a.reshape(shape), variance.reshape(shape)


class _Fitted(NamedTuple):
    """Planes, and the windows that they were fitted to.

    Attributes:
        height: of the picture that was fitted.
        size, cells: what windows are made of, as of `_cells`.
    """

    planes: _Planes
    height: int
    size: int
    cells: int


class _Choice(NamedTuple):
    """Value and variance of what was chosen so far, and between what a plane's value has to lie to
    agree with the pixel's own; (H, W) float32 each."""

    value: Float32
    variance: Float32
    least: Float32
    most: Float32


def _choose(fitted: _Fitted, first: int, chosen: _Choice) -> None:
    """Replace what was chosen by the best known of the windows that hold a pixel.

    Args:
        first: the row among those fitted that is the first of the choice.
    """
    planes, height, size, cells = fitted
    radius = size * cells
    if _compiled is not None:
        _compiled.choose(planes, chosen, height, size, radius, first, _AGREES)
        return
    # And with what smaller windows told.
    allowed = np.sqrt(chosen.variance)
    allowed *= np.float32(_AGREES)
    least = np.maximum(chosen.least, chosen.value - allowed)
    most = np.minimum(chosen.most, chosen.value + allowed)
    best, spread, _, _ = chosen
    shape, rows = (height, best.shape[1]), slice(first, first + len(best))
    # From the middle of a cell, in radii, as planes are.
    offsets = (np.arange(size, dtype=np.float32)[:, np.newaxis] - (size - 1) / 2) / radius
    for dy in (-1, 0, 1):
        # The window's centre lies (dx, dy) ahead, so the pixel lies (-dx, -dy) off it.
        (own, _), (there, _) = _overlap(shape, dy * radius, 0, rows)
        whole = slice(there.start // size, -(-there.stop // size))
        inner = slice(there.start - whole.start * size, there.stop - whole.start * size)
        lines = planes.along(whole, np.asarray(offsets - dy, np.float32))
        for dx in (-1, 0, 1):
            (_, columns), (_, ahead) = _overlap(shape, 0, dx * radius, rows)
            value, variance = (part[inner] for part in lines.at(-dx, ahead))
            here = own, columns
            better = variance < spread[here]
            better &= value >= least[here]
            better &= value <= most[here]
            # Many times faster than numpy's own where it goes now one way, now the other.
            cv2.copyTo(value, better.view(np.uint8), best[here])
            cv2.copyTo(variance, better.view(np.uint8), spread[here])


def _planes(value: Float64, weight: Float64, size: int, cells: int, factor: float) -> _Fitted:
    """The planes fitted to the windows around all pixels.

    Args:
        size, cells: what windows are made of, as of `_cells`: those of a cell's pixels are the
            same.
        factor: by how much planes are known worse than from independent measurements.
    """
    height, width = value.shape
    sums = _window_sums(value, weight, size, cells)
    planes = _Planes(*(np.empty(sums[0].shape, np.float32) for _ in range(9)))
    for rows in bands(sums[0].shape, channels=_ARRAYS):
        _solve([part[rows] for part in sums], factor, size * cells, rows, planes)
    if size > 1:
        # The pixels' columns from the middle of their cells, in radii, as the planes are.
        offsets = ((np.arange(width) % size - (size - 1) / 2) / (size * cells)).astype(np.float32)
        wide = (sums[0].shape[1] * size, sums[0].shape[0])
        parts = (cv2.resize(part, wide, interpolation=cv2.INTER_NEAREST) for part in planes)
        columns = (np.ascontiguousarray(part[:, :width], np.float32) for part in parts)
        planes = _Planes(*columns).from_column(offsets)
    return _Fitted(planes, height, size, cells)


def _images(value: Float64, weight: Float64) -> list[tuple[Floats, Powers]]:
    """What is summed up over windows, and times which powers (a, b) of the place, xᵃyᵇ."""
    weighted = weight * value
    used = (weight > 0).astype(np.float64)
    return list(zip((weight, weighted, weighted * value, used), _POWERS, strict=True))


def _window_sums(value: Float64, weight: Float64, size: int, cells: int) -> list[Floats]:
    """Sums of the `_images` over the windows around all cells, x and y counted from there in
    pixels."""
    border = cv2.BORDER_CONSTANT
    if size == 1:
        ramp = np.arange(-cells, cells + 1, dtype=np.float64)
        kernels = [ramp**power for power in range(3)]
        return [
            np.asarray(cv2.sepFilter2D(image, -1, kernels[a], kernels[b], borderType=border))
            for image, powers in _images(value, weight)
            for a, b in powers
        ]
    height, width = (-(-length // size) for length in value.shape)
    # From the picture's middle, to be summed up, and then each from its own window's.
    x = size * (np.arange(width) - width / 2)
    y = size * (np.arange(height) - height / 2)[:, np.newaxis]
    window = (2 * cells + 1, 2 * cells + 1)
    sums = list[Floats]()
    for moments in _moments(value, weight, size):
        _count_from(moments, -x, -y)
        for power, own in moments.items():
            total = cv2.boxFilter(own, -1, window, normalize=False, borderType=border)
            moments[power] = np.asarray(total, np.float64)
        _count_from(moments, x, y)
        sums += moments.values()
    return sums


def _moments(value: Float64, weight: Float64, size: int) -> list[Moments]:
    """Sums of the `_images` over each cell, x and y counted from its middle in pixels."""
    height, width = (-(-length // size) for length in value.shape)
    if _compiled is not None:
        moments = np.empty((sum(map(len, _POWERS)), height, width))
        _compiled.add_up(value, weight, moments, size)
        every = iter(moments)
        return [{power: next(every) for power in powers} for powers in _POWERS]
    sums: list[Moments] = []
    for rows in bands((height, size * value.shape[1])):
        taken = slice(size * rows.start, size * rows.stop)
        for place, (image, powers) in enumerate(_images(value[taken], weight[taken])):
            if place == len(sums):
                sums.append({power: np.empty((height, width)) for power in powers})
            for power, own in _cell_sums(image, size, powers).items():
                sums[place][power][rows] = own
    return sums


def _cell_sums(image: Floats, size: int, powers: Powers) -> Moments:
    """`_moments` of one image; cells that its edge cuts off go on with 0."""
    rest = [(0, -length % size) for length in image.shape]
    if rest != [(0, 0), (0, 0)]:
        image = np.pad(image, rest)
    half = size // 2
    offsets = np.arange(half) + 0.5

    def powers_of(parts: list[Floats], highest: int) -> list[Floats]:
        # Offsets come in pairs of either sign.
        before, after = parts[half - 1 :: -1], parts[half:]
        signed = [
            [combine(*pair) for pair in zip(after, before, strict=True)]
            for combine in (np.add, np.subtract)[: 1 + highest]
        ]
        return [_combined(signed[power % 2], offsets**power) for power in range(1 + highest)]

    # Down first, along whole rows, as across them fewer numbers are left.
    down = powers_of([image[row::size] for row in range(size)], max(b for _, b in powers))
    across = [
        powers_of([total[:, column::size] for column in range(size)], max(a for a, _ in powers))
        for total in down
    ]
    return {(a, b): across[b][a] for a, b in powers}


def _combined(parts: list[Floats], factors: Floats) -> Floats:
    total: Floats = parts[0] * factors[0]
    for part, factor in zip(parts[1:], factors[1:], strict=True):
        total += part * factor if factor != 1 else part
    return total


def _count_from(moments: Moments, x: Float64, y: Float64) -> None:
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
    """The planes of some rows from the sums over their windows."""
    if _compiled is not None:
        terms = (factor**2, radius, _WEIGHT, _LEVEL, _FLOOR**2, _MISFIT)
        _compiled.solve(tuple(sums), tuple(part[rows] for part in planes), *terms)
        return
    w, wx, wy, wxx, wxy, wyy, wv, wvx, wvy, wvv, count = sums
    # About the weighted mean, where slopes and level are told apart.
    inverse = 1 / (w + _WEIGHT)
    mean_x, mean_y, mean_v = wx * inverse, wy * inverse, wv * inverse
    wxx = wxx + _LEVEL - wx * mean_x
    wxy = wxy - wx * mean_y
    wyy = wyy + _LEVEL - wy * mean_y
    wvx, wvy, wvv = wvx - mean_x * wv, wvy - mean_y * wv, wvv - mean_v * wv
    # The slopes' covariance, as the squares of what they have in common and of the second alone.
    # But for rounding neither is known worse than from what holds them back.
    second = 1 / np.maximum(wyy, _LEVEL)
    slant = wxy * second
    first = 1 / np.maximum(wxx - slant * wxy, _LEVEL)
    b = first * (wvx - slant * wvy)
    c = second * wvy - slant * b
    misfit = (wvv - (b * wvx + c * wvy)) / np.maximum(count - 3, 1)
    worse = np.maximum(misfit, 1) * factor**2
    p, q = np.sqrt(first * worse), np.sqrt(second * worse)
    px = p * radius
    planes.a[rows] = mean_v - (b * mean_x + c * mean_y)
    planes.b[rows] = b * radius
    planes.c[rows] = c * radius
    planes.r[rows] = inverse * worse + _FLOOR**2
    planes.r[rows][(misfit >= _MISFIT) | (count < 4)] = np.inf
    planes.p[rows] = p * (slant * mean_y - mean_x)
    planes.px[rows] = px
    planes.py[rows] = -(slant * px)
    planes.q[rows] = -(q * mean_y)
    planes.qy[rows] = q * radius


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
