"""How far along its line to the light's image each pixel's shadow comes from.

With the epipole known, W[p] = p + s u, u the unit vector towards it: each pass that reaches a pixel
measures the one number s by itself, n·(p + s u) + d = 0, and passes that disagree are outvoted.
"""

from typing import NamedTuple

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


class Parallax(NamedTuple):
    """What passes tell of s, (H, W) float32 each, pixels.

    Attributes:
        shift: s; NaN unknown.
        deviation: its standard deviation, as far as each pixel has its own; infinite unknown.
        common: what s is off, in the root mean square, with the lines that it was measured by:
            pixels around it are by the same; infinite unknown.
    """

    shift: Float32
    deviation: Float32
    common: Float32


def measure_parallax(passes: list[Pass], positions: Float32, directions: Float32) -> Parallax:
    """What the passes' own times tell of s, pixel by pixel.

    Args:
        passes: two or more, all of the size of ``positions``.
        positions, directions: (H, W, 2), p and u.

    Returns:
        s; unknown where fewer than two passes reached the pixel, or none measures it.
    """
    shape = positions.shape[:2]
    found = Parallax(*(np.empty(shape, np.float32) for _ in range(3)))
    for rows in bands(shape):
        own = [scan.part(rows) for scan in passes]
        for whole, part in zip(
            found, _measured(own, positions[rows], directions[rows]), strict=True
        ):
            whole[rows] = part
    return found


def _measured(passes: list[Pass], positions: Float32, directions: Float32) -> Parallax:
    measured = [_one(scan, positions, directions) for scan in passes]
    shift = np.stack([one.shift for one in measured])
    weight = _without_outvoted(shift, np.stack([one.weight for one in measured]))
    reached = np.sum([one.reached for one in measured], axis=0)
    count = (weight > 0).sum(axis=0)
    total = weight.sum(axis=0)
    safe = np.maximum(total, 1e-12)
    mean = (weight * shift).sum(axis=0) / safe
    scatter = (weight * (shift - mean) ** 2).sum(axis=0) / np.maximum(count - 1, 1)
    variance = np.maximum(scatter / _AGREE, 1) / safe
    off_lines = np.stack([one.off_line for one in measured])
    common = np.sqrt(((weight * off_lines) ** 2).sum(axis=0)) / safe
    known = (reached >= 2) & (count > 0)
    return Parallax(
        np.where(known, mean, np.nan).astype(np.float32),
        np.where(known, np.sqrt(variance), np.inf).astype(np.float32),
        np.where(known, common, np.inf).astype(np.float32),
    )


class _One(NamedTuple):
    """What one pass tells, (H, W) each.

    Attributes:
        weight: the inverse of the variance of ``shift``; 0 where it measures none.
        off_line: by how much ``shift`` is off with a line that is off by its residual, pixels.
        reached: the pixels that the pass reached.
    """

    shift: Float64
    weight: Float64
    off_line: Float64
    reached: NDArray[np.bool_]


def _one(scan: Pass, positions: Float32, directions: Float32) -> _One:
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
    shift, weight, off_line = (np.zeros(time.shape) for _ in range(3))
    shift[known] = along
    weight[known] = np.where(usable, across**2 / variance, 0)
    off_line[known] = lines.residual[inside] / np.abs(across)
    return _One(shift, weight, off_line, known)


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
