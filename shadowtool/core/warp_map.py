"""The displacement map W: where in the source plane each target pixel's shadow comes from.

``warp[y, x] == (x, y)`` is the identity, which W is on the reference plane.
"""

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.half_floats import to_float
from shadowtool.core.shadow_lines import ShadowLines, interpolate_lines, line_pace
from shadowtool.core.shadow_time import ShadowTimes

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Float64 = NDArray[np.float64]

# Passes less far apart than this can't fix a point.
LEAST_ANGLE = np.radians(10.0)
_LEAST_WEIGHT = 1e-3
# Outside any picture.
_FAR = -1e6
# A pixel has slipped if its displacement is further than this, pixels, from all but one of the
# eight around it, and at least six of these lie within half as much of their median.
_SLIPPED, _FRIENDS, _AGREED = 0.5, 1, 6
_AROUND = np.array([(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x])


@dataclass(frozen=True)
class WarpMap:
    """W and how far it can be trusted.

    Attributes:
        warp: (H, W, 2) float32, pixels (x, y); NaN unknown.
        error: (H, W) float32, predicted error of W, pixels; infinite where unknown, and where W
            was filled in from the surroundings.
    """

    warp: Float32
    error: Float32

    @property
    def confidence(self) -> Float32:
        """(H, W) float32: 1 / (1 + error), 0 where unknown."""
        return (1 / (1 + self.error)).astype(np.float32)


@dataclass(frozen=True)
class Pass:
    """One scan: the times of its leading edge and the lines on the reference plane.

    Attributes:
        plane: (H, W), what was marked as the reference plane; None where that isn't known.
    """

    times: ShadowTimes
    lines: ShadowLines
    plane: Bool | None = None

    @property
    def reached(self) -> Bool:
        """(H, W), where the edge passed at a time at which it lay on the plane."""
        own, frame = self.times.own_time, self.lines.frame
        return np.asarray((own >= frame[0]) & (own <= frame[-1]), bool)

    def part(self, rows: slice, columns: slice = slice(None)) -> "Pass":
        """The same scan of a part of the picture; the lines keep the whole's coordinates."""
        parts = {f.name: getattr(self.times, f.name)[rows, columns] for f in fields(self.times)}
        plane = None if self.plane is None else self.plane[rows, columns]
        return Pass(ShadowTimes(**parts), self.lines, plane)


def identity_map(height: int, width: int) -> Float32:
    """(H, W, 2) float32 with ``[y, x] == (x, y)``."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([x, y], axis=-1)


def intersect(passes: list[Pass], positions: Float32) -> WarpMap:
    """The weighted least squares intersection of the shadow lines through each pixel.

    Each pass contributes its line at t_s[p] with the weight w = c_s[p]² · exp(-E²), E the line's
    fitting error; q minimises Σ w (n·q + d)².

    Args:
        passes: two or more, all of one size.
        positions: (H, W, 2), the pixels' own.

    Returns:
        W; unknown where fewer than two passes that differ by `LEAST_ANGLE` reached the pixel. Where
        the lines of three or more don't meet, its error is larger by as much as they miss it.
    """
    shape = passes[0].times.time.shape
    found = WarpMap(np.empty((*shape, 2), np.float32), np.empty(shape, np.float32))
    for rows in bands(shape):
        part = _intersect([scan.part(rows) for scan in passes], positions[rows])
        found.warp[rows], found.error[rows] = part.warp, part.error
    return found


def _intersect(passes: list[Pass], positions: Float32) -> WarpMap:
    shape = passes[0].times.time.shape
    # The normal equations Σ w nnᵀ q = -Σ w d n, and the same with each line in units of its own
    # standard deviation, whose inverse is q's covariance.
    weighted = np.zeros((5, *shape))
    information = np.zeros((3, *shape))
    least_cosine = np.full(shape, np.inf)
    normals, through = [], []
    best = min(float(scan.lines.residual.min()) for scan in passes)
    for scan in passes:
        known = np.isfinite(scan.times.time)
        lines = interpolate_lines(scan.lines, scan.times.time[known].astype(np.float64))
        spans = np.isfinite(lines.offset)
        known[known] = spans
        nx, ny = lines.normal[spans].T
        d, residual = lines.offset[spans], lines.residual[spans]
        # Only the weights' ratios matter; a floor keeps the worst line from counting as none.
        fit = np.maximum(np.exp(best**2 - residual**2), _LEAST_WEIGHT)
        weight = scan.times.contrast[known].astype(np.float64) ** 2 * fit
        for row, term in zip(weighted, (nx * nx, nx * ny, ny * ny, nx * d, ny * d), strict=True):
            row[known] += weight * term
        # Where the pixel's line passes it nearest.
        here = positions[known]
        away = nx * here[:, 0] + ny * here[:, 1] + d
        passed = here - away[:, np.newaxis] * lines.normal[spans]
        pace = line_pace(scan.lines, lines.frame[spans], passed)
        spread = scan.times.error[known] * pace
        precision = 1 / (spread**2 + residual**2 + 1e-4)
        for row, term in zip(information, (nx * nx, nx * ny, ny * ny), strict=True):
            row[known] += precision * term
        normal = np.full((*shape, 2), np.nan)
        normal[known] = np.stack([nx, ny], axis=-1)
        normals.append(normal)
        through.append((known, nx, ny, d, precision))
    # |n·m| of the best separated pair of passes: the cosine of their angle.
    for i, one in enumerate(normals):
        for other in normals[i + 1 :]:
            cosine = np.abs((one * other).sum(axis=-1))
            least_cosine = np.fmin(least_cosine, cosine)
    known = least_cosine <= np.cos(LEAST_ANGLE)
    a, b, c, e, f = weighted
    warp = np.full((*shape, 2), np.nan, np.float32)
    error = np.full(shape, np.inf, np.float32)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        determinant = a * c - b * b
        known &= determinant > 0
        warp[..., 0] = np.where(known, (b * f - c * e) / determinant, np.nan)
        warp[..., 1] = np.where(known, (b * e - a * f) / determinant, np.nan)
        ia, ib, ic = information
        variance = (ia + ic) / (ia * ic - ib * ib)
        variance *= np.maximum(_scatter(warp, through), 1)
        error[known] = np.sqrt(variance[known])
    return WarpMap(warp, error)


def _scatter(
    warp: Float32, through: list[tuple[Bool, Float64, Float64, Float64, Float64]]
) -> Float64:
    """By how much lines of three passes or more miss the point that is found for them, (H, W): the
    mean square in units of their variances; 0 of two, which always meet.

    Args:
        through: of each pass the pixels that it reached, and their lines' nx, ny, d and 1/σ².
    """
    count = np.zeros(warp.shape[:2], np.int8)
    square = np.zeros(warp.shape[:2])
    for known, nx, ny, d, precision in through:
        x, y = warp[known].T
        count[known] += 1
        square[known] += precision * (nx * x + ny * y + d) ** 2
    return np.asarray(square * (count > 2) / np.maximum(count - 2, 1), np.float64)


def without_slips(found: WarpMap) -> WarpMap:
    """W with what the pixels around agree on where a pixel is off them all.

    Noise may choose the wrong interval between two frames, and once in a thousand pixels does so
    in all passes in the same sense: nothing in the pixel's own measurements then tells. But no
    surface is a single pixel large.

    Args:
        found: as measured, (H, W, 2) and (H, W) in pixels, NaN and infinite unknown; not filled in.

    Returns:
        Median displacement and error of the pixels around, where a pixel has slipped; all else as
        it was, bit for bit.
    """
    height, width = found.error.shape
    here = identity_map(height, width)
    displacement = np.nan_to_num(found.warp - here, nan=_FAR)
    off = np.hypot(*(part - cv2.medianBlur(part, 3) for part in cv2.split(displacement)))
    # Where enough of them agree, the median of all nine lies among them.
    off[(off <= _SLIPPED / 2) | np.isinf(found.error)] = 0
    off[[0, -1]], off[:, [0, -1]] = 0, 0
    places = np.argwhere(off)
    around = tuple((places[:, np.newaxis] + _AROUND).transpose(2, 0, 1))
    own, others = displacement[tuple(places.T)][:, np.newaxis], displacement[around]
    middle = np.median(others, axis=1)
    agreed = np.linalg.norm(others - middle[:, np.newaxis], axis=-1) <= _SLIPPED / 2
    agreed &= np.isfinite(found.error)[around]
    friends = np.linalg.norm(others - own, axis=-1) <= _SLIPPED
    slipped = (agreed.sum(axis=1) >= _AGREED) & (friends.sum(axis=1) <= _FRIENDS)
    warp, error, at = found.warp.copy(), found.error.copy(), tuple(places[slipped].T)
    warp[at] = here[at] + middle[slipped]
    error[at] = np.median(found.error[around], axis=1)[slipped]
    return WarpMap(warp, error)


def pass_angles(passes: list[Pass]) -> list[tuple[int, int, float]]:
    """The angle between each two passes' middle lines: (i, j, radians in [0, π/2])."""
    angles = []
    middles = [scan.lines.angle[len(scan.lines) // 2] for scan in passes]
    for i, one in enumerate(middles):
        for j in range(i + 1, len(middles)):
            difference = abs(one - middles[j]) % np.pi
            angles.append((i, j, float(min(difference, np.pi - difference))))
    return angles


def positions(warp: Float32) -> Float32:
    """W as `sample` takes it, (H', W', 2) float32: far outside instead of NaN.

    OpenCV's releases differ in what they make of NaN.
    """
    known = np.isfinite(warp).all(axis=-1, keepdims=True)
    return np.clip(np.where(known, warp, np.float32(_FAR)), _FAR, -_FAR)


def sample(
    image: NDArray[np.floating], places: Float32, outside: float, unknown: Bool | None = None
) -> Float32:
    """The image as a map sees it: image[W[p]], bilinear (section 4).

    Args:
        image: (H, W) or (H, W, C).
        places: (H', W', 2), of `positions`.
        outside: the value beyond the image's edge, and where W is unknown.
        unknown: (H, W), where the image is not to be gone by. What lies half or more on such
            pixels is NaN, the rest is made of the others; None for nowhere.

    Returns:
        (H', W') or (H', W', C) float32.
    """
    values = to_float(image)
    if unknown is None:
        return _remapped(values, places, outside)
    hidden = unknown if image.ndim == 2 else unknown[..., np.newaxis]
    result = _remapped(np.where(hidden, np.float32(0), values), places, outside)
    known = _remapped((~unknown).astype(np.float32), places, 1.0)
    weight = np.where(known > 0.5, known, np.float32(np.nan))
    result /= weight if image.ndim == 2 else weight[..., np.newaxis]
    return result


def _remapped(image: Float32, places: Float32, outside: float) -> Float32:
    channels = image.shape[2] if image.ndim == 3 else 1
    result = cv2.remap(  # type: ignore[call-overload]
        np.ascontiguousarray(image),
        places,
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(outside,) * min(channels, 4),
    )
    return np.asarray(result, np.float32).reshape(*places.shape[:2], *image.shape[2:])


def to_st_map(warp: Float32, width: int, height: int) -> Float32:
    """Pixels to an ST map: u = (x + 0.5)/width, v = 1 - (y + 0.5)/height.

    Args:
        warp: (H, W, 2) float32, positions in a picture of ``width`` × ``height``.

    Returns:
        (H, W, 2) float32 (u, v), origin bottom left.
    """
    exact = warp.astype(np.float64)
    u = (exact[..., 0] + 0.5) / width
    v = 1 - (exact[..., 1] + 0.5) / height
    return np.stack([u, v], axis=-1).astype(np.float32)


def from_st_map(st_map: Float32, width: int, height: int) -> Float32:
    """The inverse of `to_st_map`."""
    exact = st_map.astype(np.float64)
    x = exact[..., 0] * width - 0.5
    y = (1 - exact[..., 1]) * height - 0.5
    return np.stack([x, y], axis=-1).astype(np.float32)


def error_of_confidence(confidence: Float32) -> Float32:
    """The inverse of `WarpMap.confidence`: the predicted error in pixels, infinite for 0."""
    with np.errstate(divide="ignore"):
        return (1 / np.clip(confidence, 0, 1) - 1).astype(np.float32)
