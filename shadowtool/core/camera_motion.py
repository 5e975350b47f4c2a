"""How far the camera moved between two frames of a take that should be locked off, and by how much
it trembled all along."""

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import to_float

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# A camera's place varies by more than this, pixels, only if it isn't held firmly.
UNSTEADY = 0.05
# Larger frames are measured at this width; the result is in pixels of the full frame.
_WIDTH = 640
_TILES = 4, 3
_LEAST_TILE = 24
# A tile whose best correlation is below this shows something else than before.
_LEAST_CORRELATION = 0.5
# How many pairs of rows, and of places in them, tell how a camera trembles; how often what doesn't
# fit is weighed anew, and from how many deviations on it doesn't count.
_STRIPS, _PLACES, _WEIGHED, _OUT = 32, 128, 4, 4.7
# The standard error of a median, times the square root of their number, in median deviations.
_MEDIAN_ERROR = 1.48 * 1.25


def prepare(gray: Float32) -> Float32:
    """Make (H, W) linear luminance ready for `shift`: small, and blind to slow shading.

    The logarithm's local contrast looks the same in light and in shadow.
    """
    height, width = gray.shape
    if width > _WIDTH:
        size = (_WIDTH, max(1, round(height * _WIDTH / width)))
        gray = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.float32)
    level = np.log(np.maximum(np.nan_to_num(gray, nan=0.0, posinf=1e4, neginf=0.0), 1e-3))
    smooth = cv2.GaussianBlur(level.astype(np.float32), (0, 0), 1.0)
    detail = smooth - cv2.GaussianBlur(smooth, (0, 0), 6.0)
    # A shadow's edge stands out of the texture; bounding it keeps it from pulling the fit.
    spread = float(np.median(np.abs(detail))) * 4 + 1e-6
    return np.asarray(np.clip(detail, -spread, spread), np.float32)


def shift(reference: Float32, other: Float32, width: int) -> float | None:
    """Length of the translation from one prepared frame to another, as far as it is certain.

    The median over a grid of tiles, so that what moves in the scene is outvoted; each tile by
    maximising the enhanced correlation coefficient (Evangelidis and Psarakis 2008). A camera moves
    all tiles alike; of what they disagree in, as where the grain of wood shows one direction only,
    three standard errors of the median are taken off.

    Args:
        reference, other: from `prepare`, of one size.
        width: that of the full frame, pixels.

    Returns:
        Pixels of the full frame; None where the picture has too little texture to tell.
    """
    shifts = [
        tile_shift
        for one, two in zip(_tiles(reference), _tiles(other), strict=True)
        if (tile_shift := _tile_shift(one, two)) is not None
    ]
    if not shifts:
        return None
    middle = np.median(shifts, axis=0)
    error = _MEDIAN_ERROR * np.median(np.abs(shifts - middle), axis=0) / np.sqrt(len(shifts))
    x, y = np.maximum(np.abs(middle) - 3 * error, 0)
    return float(np.hypot(x, y) * width / reference.shape[1])


def strips(gray: NDArray[np.floating]) -> Float32:
    """What `tremble` looks at of a frame: evenly spaced places in pairs of neighbouring rows, each
    between the pixels on its left and right.

    Args:
        gray: (H, W) float16 or float32, linear luminance or a channel; not finite unknown.

    Returns:
        (K, 2, P, 3) float32; P is 0 of less than three columns.
    """
    rows = np.unique(np.linspace(0, max(len(gray) - 2, 0), _STRIPS).astype(int))
    pairs = np.stack([rows, np.minimum(rows + 1, len(gray) - 1)], axis=1)
    width = gray.shape[1]
    columns = np.arange(1, width - 1, -(-width // _PLACES))[:, np.newaxis] + (-1, 0, 1)
    return to_float(gray[pairs[..., np.newaxis, np.newaxis], columns])


def tremble(frames: list[Float32]) -> float:
    """By how much a camera's place varies over a take, the standard deviation along each axis.

    As far as frames differ from the first by I(x + s) - I(x) ≈ s·∇I and by their exposure, s
    follows by least squares (Lucas and Kanade 1981); what something moved in front of fits badly
    and is left out.

    Args:
        frames: from `strips`, (K, 2, P, 3) each, spread over the take; not finite is left out.

    Returns:
        Pixels ≥ 0; what is within the error of its measurement counts as nothing.
    """
    if len(frames) < 2:
        return 0.0
    first, places, errors = frames[0], [np.zeros(2)], [0.0]
    for other in frames[1:]:
        with np.errstate(invalid="ignore", over="ignore"):
            middle = (first + other) / 2
            across = (middle[..., 2] - middle[..., 0]).mean(axis=1) / 2
            down = middle[:, 1, :, 1] - middle[:, 0, :, 1]
            light, change = (part[..., 1].mean(axis=1) for part in (middle, other - first))
        table = np.stack([across, down, light, change], axis=-1).reshape(-1, 4).astype(np.float64)
        table = table[np.isfinite(table).all(axis=1)]
        place, error = _moved(table[:, :3], table[:, 3])
        places.append(place)
        errors.append(error)
    variance = np.var(places, axis=0).mean() - np.mean(errors)
    # Sums come out otherwise in their last digits on other processors.
    return round(float(np.sqrt(max(variance, 0))), 4)


def _moved(terms: Float64, change: Float64) -> tuple[Float64, float]:
    """The displacement (2,) that explains the change best, and its variance along an axis."""
    solved: Float64 = np.zeros(3)
    inverse: Float64 = np.zeros((3, 3))
    spread = 0.0
    for _ in range(_WEIGHED if change.size else 0):
        rest = change - terms @ solved
        spread = float(np.median(np.abs(rest))) / 0.6745 + 1e-9
        weight = np.clip(1 - (rest / (_OUT * spread)) ** 2, 0, 1) ** 2
        normal = terms.T @ (terms * weight[:, np.newaxis]) + 1e-9 * np.eye(3)
        # Of what nothing tells, as along stripes, it says that nothing moved.
        inverse = np.asarray(np.linalg.pinv(normal, hermitian=True), np.float64)
        solved = np.asarray(inverse @ (terms.T @ (weight * change)), np.float64)
    return solved[:2], float(inverse[:2, :2].trace() / 2 * spread**2)


def _tiles(image: Float32) -> list[Float32]:
    height, width = image.shape
    columns = max(1, min(_TILES[0], width // _LEAST_TILE))
    rows = max(1, min(_TILES[1], height // _LEAST_TILE))
    return [
        np.ascontiguousarray(tile)
        for strip in np.array_split(image, rows, axis=0)
        for tile in np.array_split(strip, columns, axis=1)
    ]


def _tile_shift(reference: Float32, other: Float32) -> tuple[float, float] | None:
    matrix = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 1e-4)
    try:
        correlation, _ = cv2.findTransformECC(
            reference, other, matrix, cv2.MOTION_TRANSLATION, criteria
        )
    except cv2.error:
        return None
    if correlation < _LEAST_CORRELATION:
        return None
    return float(matrix[0, 2]), float(matrix[1, 2])
