"""How far along its line to the light's image each pixel's shadow comes from.

With the epipole known, W[p] = p + s u, u the unit vector towards it: each pass that reaches a pixel
measures the one number s by itself, n·(p + s u) + d = 0, and passes that disagree are outvoted.
"""

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.shadow_lines import interpolate_lines, line_pace
from shadowtool.core.warp_map import Pass

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Lines nearer than this to the direction of the displacement, as a cosine, do not measure it.
_ALONG = 0.05
# How well a line is known that its points fit perfectly, pixels.
_LEAST_RESIDUAL = 0.05
# Passes disagree if their squared deviations are above this in units of their errors; one is
# outvoted if without it they shrink to less than this part.
_DISAGREE, _SETTLED = 12.0, 0.25
# A squared deviation in its own units up to which the error of the mean stays as it is.
_AGREE = 4.0


def measure_parallax(
    passes: list[Pass], positions: Float32, directions: Float32
) -> tuple[Float32, Float32]:
    """What the passes' own times tell of s, pixel by pixel.

    Args:
        passes: two or more, all of the size of ``positions``.
        positions, directions: (H, W, 2), p and u.

    Returns:
        s and its standard deviation, pixels, (H, W) float32 each; NaN and infinite where fewer than
        two passes reached the pixel, or none measures it.
    """
    shape = positions.shape[:2]
    shift, deviation = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for rows in bands(shape):
        own = [scan.part(rows) for scan in passes]
        part = _measured(own, positions[rows], directions[rows])
        shift[rows], deviation[rows] = part
    return shift, deviation


def _measured(
    passes: list[Pass], positions: Float32, directions: Float32
) -> tuple[Float32, Float32]:
    measured = [_one(scan, positions, directions) for scan in passes]
    shift = np.stack([m[0] for m in measured])
    weight = np.stack([m[1] for m in measured])
    weight = _without_outvoted(shift, weight)
    reached = np.sum([m[2] for m in measured], axis=0)
    count = (weight > 0).sum(axis=0)
    total = weight.sum(axis=0)
    safe = np.maximum(total, 1e-12)
    mean = (weight * shift).sum(axis=0) / safe
    scatter = (weight * (shift - mean) ** 2).sum(axis=0) / np.maximum(count - 1, 1)
    variance = np.maximum(scatter / _AGREE, 1) / safe
    known = (reached >= 2) & (count > 0)
    return (
        np.where(known, mean, np.nan).astype(np.float32),
        np.where(known, np.sqrt(variance), np.inf).astype(np.float32),
    )


def _one(
    scan: Pass, positions: Float32, directions: Float32
) -> tuple[Float64, Float64, NDArray[np.bool_]]:
    """One pass's s, the inverse of its variance, which is 0 where it measures none, and which
    pixels it reached."""
    time, error = scan.times.own_time, scan.times.own_error
    known = np.isfinite(time)
    lines = interpolate_lines(scan.lines, time[known].astype(np.float64))
    inside = np.isfinite(lines.offset)
    known[known] = inside
    normal, offset = lines.normal[inside], lines.offset[inside]
    across = (normal * directions[known]).sum(axis=-1)
    distance = -(normal * positions[known]).sum(axis=-1) - offset
    usable = np.abs(across) > _ALONG
    across = np.where(usable, across, 1)
    along = np.where(usable, distance / across, 0)
    passed = positions[known] + along[:, np.newaxis] * directions[known]
    pace = line_pace(scan.lines, lines.frame[inside], passed)
    variance = (error[known] * pace) ** 2 + lines.residual[inside] ** 2 + _LEAST_RESIDUAL**2
    shift, weight = np.zeros(time.shape), np.zeros(time.shape)
    shift[known] = along
    weight[known] = np.where(usable, across**2 / variance, 0)
    return shift, weight, known


def _without_outvoted(shift: Float64, weight: Float64) -> Float64:
    """Weights without the one pass of three or more without which the others agree."""
    if len(shift) < 3:
        return weight
    total, moment = weight.sum(axis=0), (weight * shift).sum(axis=0)
    square = (weight * shift**2).sum(axis=0)
    scatter = square - moment**2 / np.maximum(total, 1e-12)
    least, outvoted = np.full(total.shape, np.inf), np.zeros(total.shape, np.int8)
    for index, (one, own) in enumerate(zip(shift, weight, strict=True)):
        rest = np.maximum(total - own, 1e-12)
        others = square - own * one**2 - (moment - own * one) ** 2 / rest
        np.copyto(outvoted, index, where=others < least)
        least = np.minimum(least, others)
    settled = (scatter > _DISAGREE) & (least < _SETTLED * scatter)
    settled &= (weight > 0).sum(axis=0) >= 3
    kept = weight.copy()
    for index in range(len(shift)):
        kept[index][settled & (outvoted == index)] = 0
    return kept
