"""Pictures of measurements with known errors, smoothed by the planes that fit around each pixel.

A surface that is flat or gently bent makes shadow times and displacements that are locally linear
in the pixel's position, and that end at its outline. So a pixel is given the value of a plane
fitted to a window that holds it, but need not be centred on it: of all such windows the one whose
plane is known best, among those that the measurements agree with.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Half the windows' widths, pixels, for edges that move up to so many pixels a frame; and the
# largest for any.
RADII, _STEP, _WIDEST = (1, 2, 4, 7), 12.0, 40
# Mean squared deviation from its plane, in squared errors, above which a window holds more than
# one surface.
_MISFIT = 1.5
# A pixel's own measurement may deviate from the plane, and the plane from that of smaller windows,
# by this many standard deviations.
_AGREES = 3.0
# Of the eight pixels around a measurement so many have to agree with it, within as many units.
_COMPANY, _NEAR = 3, 1.0
# Slopes are held back as if each window had seen none, with this weight.
_LEVEL = 0.1
# No plane is known better than this.
_FLOOR = 0.02


@dataclass(frozen=True)
class Windows:
    """In what windows planes are fitted.

    Attributes:
        radii: half their widths, pixels, ascending.
        factor: by how much a plane is known worse than from independent measurements.
    """

    radii: tuple[int, ...] = RADII
    factor: float = 1.0

    @property
    def reach(self) -> int:
        """How far from a pixel its value may depend on others, pixels."""
        return 2 * max(self.radii) + 1

    @classmethod
    def for_step(cls, step: float, radii: tuple[int, ...] = RADII) -> "Windows":
        """For edges that move ``step`` pixels a frame.

        What happens between two frames is told by windows about as wide as the step. In smaller
        ones all pixels say the same, and no more than a few of them.

        Args:
            radii: for steps of up to 12 pixels.
        """
        factor = max(step / _STEP, 1.0)
        return cls(tuple(min(round(radius * factor), _WIDEST) for radius in radii), factor)


def fit_planes(
    value: Float32, error: Float32, windows: Windows = Windows()
) -> tuple[Float32, Float32]:
    """Each pixel's value on the best known plane that agrees with the measurements around it.

    Args:
        value: (H, W) float32; NaN unknown, which takes no part.
        error: (H, W) float32, standard deviation of each value, in its unit; infinite unknown.

    Returns:
        Value and predicted error, (H, W) float32 each; NaN and infinite where the value was
        unknown. A lone measurement that no neighbour agrees with is replaced.
    """
    known = np.isfinite(value) & np.isfinite(error)
    measured = np.where(known, value, 0).astype(np.float64)
    variance = np.where(known, error.astype(np.float64) ** 2, np.inf)
    trusted = known & _in_company(measured, variance)
    weight = np.where(trusted, 1 / np.maximum(variance, 1e-12), 0)
    best = measured.astype(np.float32)
    own = best.copy()
    own_weight = weight.astype(np.float32)
    spread = np.where(trusted, variance, np.inf).astype(np.float32)
    for radius in windows.radii:
        plane, covariance, misfit = _planes(measured, weight, radius)
        smaller, smaller_spread = best.copy(), spread.copy()
        for row, column in np.ndindex(3, 3):
            dy, dx = (row - 1) * radius, (column - 1) * radius
            here, there = _overlap(value.shape, dy, dx)
            # The window's centre lies (dx, dy) ahead, so the pixel lies (-dx, -dy) off it.
            fitted = plane[0][there] - dx * plane[1][there] - dy * plane[2][there]
            certain = _variance(covariance, there, -dx, -dy)
            certain *= np.maximum(misfit[there], 1) * np.float32(windows.factor**2)
            certain += _FLOOR**2
            off_own = (fitted - own[here]) ** 2 * own_weight[here]
            off_smaller = (fitted - smaller[here]) ** 2
            better = (certain < spread[here]) & (misfit[there] < _MISFIT)
            better &= (off_own < _AGREES**2) & (off_smaller <= _AGREES**2 * smaller_spread[here])
            np.copyto(best[here], fitted, where=better)
            np.copyto(spread[here], certain, where=better)
    found = known & np.isfinite(spread)
    fitted_error = np.where(found, np.sqrt(np.where(found, spread, 0)), np.inf)
    return np.where(found, best, np.nan).astype(np.float32), fitted_error.astype(np.float32)


def _in_company(value: Float64, variance: Float64) -> Bool:
    """Where enough of the eight pixels around agree with a measurement."""
    company = np.zeros(value.shape, np.uint8)
    for row, column in np.ndindex(3, 3):
        dy, dx = row - 1, column - 1
        if dy == dx == 0:
            continue
        here, there = _overlap(value.shape, dy, dx)
        allowed = _AGREES * np.sqrt(variance[here] + variance[there]) + _NEAR
        agrees = np.isfinite(allowed) & (np.abs(value[here] - value[there]) < allowed)
        company[here] += agrees
    return company >= _COMPANY


def _planes(
    value: Float64, weight: Float64, radius: int
) -> tuple[list[Float32], list[Float32], Float32]:
    """The plane a + bx + cy fitted to the window around each pixel, x and y counted from there.

    Returns:
        (a, b, c); the six different elements of their covariance matrix, row by row; the mean
        squared deviation in squared errors. (H, W) float32 each.
    """
    ramp = np.arange(-radius, radius + 1, dtype=np.float64)
    flat = np.ones_like(ramp)

    def moment(image: Float64, across: Float64, down: Float64) -> Float64:
        total = cv2.sepFilter2D(image, -1, across, down, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(total, np.float64)

    weighted = weight * value
    w, wx, wy = moment(weight, flat, flat), moment(weight, ramp, flat), moment(weight, flat, ramp)
    wxx, wxy = moment(weight, ramp**2, flat) + _LEVEL, moment(weight, ramp, ramp)
    wyy = moment(weight, flat, ramp**2) + _LEVEL
    wv, wvx, wvy = (moment(weighted, *k) for k in ((flat, flat), (ramp, flat), (flat, ramp)))
    wvv = moment(weighted * value, flat, flat)
    count = moment((weight > 0).astype(np.float64), flat, flat)
    w += 1e-9
    # The inverse of the symmetric matrix of the normal equations, by cofactors.
    caa, cab, cac = wxx * wyy - wxy * wxy, wy * wxy - wx * wyy, wx * wxy - wxx * wy
    cbb, cbc, ccc = w * wyy - wy * wy, wx * wy - w * wxy, w * wxx - wx * wx
    determinant = w * caa + wx * cab + wy * cac
    for cofactor in (caa, cab, cac, cbb, cbc, ccc):
        cofactor /= determinant
    a = caa * wv + cab * wvx + cac * wvy
    b = cab * wv + cbb * wvx + cbc * wvy
    c = cac * wv + cbc * wvx + ccc * wvy
    misfit = np.maximum(wvv - (a * wv + b * wvx + c * wvy), 0) / np.maximum(count - 3, 1)
    misfit[count < 4] = np.inf
    plane = [part.astype(np.float32) for part in (a, b, c)]
    covariance = [part.astype(np.float32) for part in (caa, cab, cac, cbb, cbc, ccc)]
    return plane, covariance, misfit.astype(np.float32)


def _variance(
    covariance: list[Float32], where: tuple[slice, slice], x: int, y: int
) -> NDArray[np.float32]:
    """Of the plane's value at (x, y) from the window's centre."""
    caa, cab, cac, cbb, cbc, ccc = (part[where] for part in covariance)
    total = caa + 2 * x * cab
    total += 2 * y * cac
    total += x * x * cbb
    total += 2 * x * y * cbc
    total += y * y * ccc
    return np.asarray(np.maximum(total, 0, out=total), np.float32)


def _overlap(
    shape: tuple[int, ...], dy: int, dx: int
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The pixels that have another one (dy, dx) ahead within the picture, and those others."""
    height, width = shape
    here = (slice(max(-dy, 0), height - max(dy, 0)), slice(max(-dx, 0), width - max(dx, 0)))
    there = (slice(max(dy, 0), height - max(-dy, 0)), slice(max(dx, 0), width - max(-dx, 0)))
    if height <= abs(dy) or width <= abs(dx):
        return (slice(0, 0), slice(0, 0)), (slice(0, 0), slice(0, 0))
    return here, there
