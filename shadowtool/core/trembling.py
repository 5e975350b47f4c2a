"""By how much a camera that should be locked off trembles, from a few rows of a few frames.

It costs next to nothing, and tells whether frames have to be looked at more closely.
"""

import math

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import to_float

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# A camera's place varies by more than this, pixels, only if it isn't held firmly.
UNSTEADY = 0.05
# How many pairs of rows, and of places in them, tell how a camera trembles; how often what doesn't
# fit is weighed anew, and from how many deviations on it doesn't count.
_STRIPS, _PLACES, _WEIGHED, _OUT = 32, 128, 4, 4.7


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

    Args:
        frames: from `strips`, (K, 2, P, 3) each, spread over the take; not finite is left out.

    Returns:
        Pixels ≥ 0; what is within the error of its measurement counts as nothing.
    """
    if len(frames) < 2:
        return 0.0
    places, errors = _roughly_moved(frames[0], frames)
    return _rounded_root(float(np.var(places, axis=0).mean() - np.mean(errors)))


def off_place(reference: Float32, frames: list[Float32]) -> float:
    """How far a camera's place is off that of a picture, the root of the mean square along each
    axis; else as `tremble`."""
    if not frames:
        return 0.0
    places, errors = _roughly_moved(reference, frames)
    return _rounded_root(float(np.mean(places**2) - np.mean(errors)))


def _rounded_root(variance: float) -> float:
    # Sums come out otherwise in their last digits on other processors.
    return round(math.sqrt(max(variance, 0)), 4)


def _roughly_moved(first: Float32, frames: list[Float32]) -> tuple[Float64, list[float]]:
    """How far frames are displaced, (N, 2), and the variances of that; all from `strips`.

    As far as a frame differs from the first by I(x + s) - I(x) ≈ s·∇I and by its exposure, s
    follows by least squares (Lucas and Kanade 1981); what something moved in front of fits badly
    and is left out.
    """
    places, errors = [], []
    for other in frames:
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
    return np.array(places), errors


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
