"""The light's image: the one point to which all displacements W[p] - p are directed.

A point P of the scene, its shadow on the reference plane, the camera and the light lie in one
plane. So the images of P and of its shadow, p and W[p], lie on a line through the light's own
image, the epipole of camera and light, wherever P is. It may lie far outside the frame, or for the
sun at infinity; so it is kept homogeneous. What is left to find at a pixel is one number, how far
along its line W[p] lies, and even a single pass measures that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Displacements shorter than this, pixels, or than so many predicted errors, have no direction.
_SHORTEST, _SIGNIFICANT = 3.0, 4.0
_LEAST_PIXELS = 60
_HYPOTHESES, _SOME, _ROUNDS = 100, 500, 10
# Displacements have no point in common if in the median they miss it by more than this, pixels, by
# more than so many predicted errors, and by more than this part of their length.
_MISS, _MISS_RATIO, _MISS_PART = 0.5, 2.0, 0.02


@dataclass(frozen=True)
class Epipole:
    """The light's image.

    Attributes:
        point: (3,) float64, unit length: (x, y, w), pixels; the point is (x / w, y / w).
        scale: pixels; ``point`` counts positions from ``middle`` in this unit.
        middle: (2,) float64, pixels.
        miss: median distance of W from its line to the point, pixels.
    """

    point: Float64
    middle: Float64
    scale: float
    miss: float

    @property
    def position(self) -> Float64:
        """(2,) pixels (x, y); infinite for a light whose rays run parallel to the picture."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.point[:2] / self.point[2] * self.scale + self.middle)

    def directions(self, positions: Float32) -> Float32:
        """Unit vectors along the line from each position to the light's image.

        Args:
            positions: (..., 2), pixels.

        Returns:
            (..., 2) float32; along x where a position is that of the light's image itself.
        """
        x, y, w = (float(v) for v in self.point)
        centred = (positions - self.middle) / self.scale
        toward = np.stack([x - w * centred[..., 0], y - w * centred[..., 1]], axis=-1)
        length = np.hypot(toward[..., 0], toward[..., 1])[..., None]
        along_x = np.array([1.0, 0.0])
        return np.where(length > 1e-9, toward / np.maximum(length, 1e-9), along_x).astype(
            np.float32
        )


def find_epipole(warp: Float32, error: Float32, positions: Float32) -> Epipole | None:
    """The point to which the displacements are directed: robust least squares of the distances
    between each W[p] and the line from p to the point.

    Args:
        warp: (..., 2), W; NaN unknown.
        error: (...), predicted error of W, pixels; infinite unknown.
        positions: (..., 2), p.

    Returns:
        None if too few pixels are displaced to tell, or if they are directed to no single point.
    """
    length = np.linalg.norm(warp - positions, axis=-1)
    with np.errstate(invalid="ignore"):
        usable = np.isfinite(error) & (length > np.maximum(_SIGNIFICANT * error, _SHORTEST))
    if usable.sum() < _LEAST_PIXELS:
        return None
    start, end = (a[usable].astype(np.float64) for a in (positions, warp))
    spread = np.maximum(error[usable], 0.1).astype(np.float64)
    # Coordinates of the order of 1 keep the normal equations well conditioned.
    middle = start.mean(axis=0)
    scale = float(np.abs(start - middle).max()) or 1.0
    one, other = (_homogeneous((a - middle) / scale) for a in (start, end))
    lines = np.cross(one, other)
    weight = 1 / (spread / scale) ** 2
    point = _where_most_cross(lines, one)
    for _ in range(_ROUNDS):
        miss, reach = _miss(point, lines, one)
        typical = max(1.5 * float(np.median(miss)), 0.05 / scale)
        robust = 1 / (1 + (miss / (2 * typical)) ** 2)
        rows = lines * (np.sqrt(weight * robust) / reach)[:, None]
        point = np.linalg.eigh(rows.T @ rows)[1][:, 0]
    median = float(np.median(_miss(point, lines, one)[0])) * scale
    typical = float(np.median(length[usable]))
    if median > max(_MISS, _MISS_RATIO * float(np.median(spread)), _MISS_PART * typical):
        return None
    return Epipole(point, middle, scale, median)


def _miss(point: Float64, lines: Float64, start: Float64) -> tuple[Float64, Float64]:
    """How far each W[p] is from the line through p and the point, and p from the point."""
    # e · (p × W) is |e_xy - e_w p| times W's distance from the line through p and e.
    reach = np.maximum(np.hypot(*(point[:2] - point[2] * start[:, :2]).T), 1e-9)
    return np.abs(lines @ point) / reach, reach


def _where_most_cross(lines: Float64, start: Float64) -> Float64:
    """Of the points in which two displacements' lines cross, the one nearest to the others."""
    rng = np.random.default_rng(len(lines))
    some = rng.choice(len(lines), min(len(lines), _SOME), replace=False)
    pairs = rng.integers(0, len(lines), (_HYPOTHESES, 2))
    crossings = np.cross(lines[pairs[:, 0]], lines[pairs[:, 1]])
    length = np.linalg.norm(crossings, axis=-1)
    crossings = crossings[length > 0] / length[length > 0, None]
    typical = [float(np.median(_miss(p, lines[some], start[some])[0])) for p in crossings]
    return crossings[int(np.argmin(typical))] if typical else np.array([0.0, 0.0, 1.0])


def _homogeneous(points: Float64) -> Float64:
    return np.concatenate([points, np.ones((len(points), 1))], axis=-1)
