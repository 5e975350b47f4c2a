"""How far along its line to the light's image each pixel's shadow comes from.

With the epipole known, W[p] = p + s u, u the unit vector towards it: each pass that reaches a pixel
measures the one number s by itself, n·(p + s u) + d = 0, and passes that disagree are outvoted.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.shadow_lines import interpolate_lines, line_pace
from shadowtool.core.warp_map import Pass, WarpMap, identity_map

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

# Lines nearer than this to the direction of the displacement, as a cosine, do not measure it.
_ALONG = 0.05
# How well a line is known that its points fit perfectly, pixels.
_LEAST_RESIDUAL = 0.05
# Passes disagree if their squared deviations are above this in units of their errors; one is
# outvoted if without it they shrink to less than this part.
_DISAGREE, _SETTLED = 12.0, 0.25
# A squared deviation in its own units up to which the error of the mean stays as it is.
_AGREE = 4.0
# What no other pass checks counts as worse known by this factor, and by this, pixels, besides.
_ALONE, _LEAST_ALONE = 2.0, 0.5
# Where the slope of displacements changes by more than this, pixels, a surface ends; displacements
# up to this are the plane's.
_STEP = 1.5
# A surface is believed if two passes or more tell of so many of its pixels, and of this part.
_LEAST_CHECKED, _CHECKED = 50, 1 / 3
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)


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
        s; unknown where no pass measures it.
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
    variance = np.where(reached < 2, _ALONE**2 * variance + _LEAST_ALONE**2, variance)
    off_lines = np.stack([one.off_line for one in measured])
    common = np.sqrt(((weight * off_lines) ** 2).sum(axis=0)) / safe
    known = count > 0
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
    reached: Bool


def _one(scan: Pass, positions: Float32, directions: Float32) -> _One:
    time, error, known = scan.times.own_time, scan.times.own_error, scan.reached
    lines = interpolate_lines(scan.lines, time[known].astype(np.float64))
    across = (lines.normal * directions[known]).sum(axis=-1)
    distance = -(lines.normal * positions[known]).sum(axis=-1) - lines.offset
    usable = np.abs(across) > _ALONG
    across = np.where(usable, across, 1)
    along = np.where(usable, distance / across, 0)
    passed = positions[known] + along[:, np.newaxis] * directions[known]
    pace = line_pace(scan.lines, lines.frame, passed)
    variance = (error[known] * pace) ** 2 + lines.residual**2 + _LEAST_RESIDUAL**2
    shift, weight, off_line = (np.zeros(time.shape) for _ in range(3))
    shift[known] = along
    weight[known] = np.where(usable, across**2 / variance, 0)
    off_line[known] = lines.residual / np.abs(across)
    return _One(shift, weight, off_line, known)


def without_unchecked(found: WarpMap, passes: list[Pass], plane: Bool) -> WarpMap:
    """W without what a single pass tells, but where it goes on from what two or more tell.

    A pass takes all that darkens a pixel for the edge's shadow, a hand that passes before it, too.
    Where no other pass checks that, the surface does that the pixel would lie on: one that others
    tell enough of, without a step between; or the plane, if it was marked.

    Args:
        found: W as measured, (H, W); NaN unknown.
        passes: those that check each other.
        plane: (H, W), what is marked as the reference plane.
    """
    height, width = found.error.shape
    displacement = found.warp - identity_map(height, width)
    known = np.isfinite(found.error)
    checked = np.sum([scan.reached for scan in passes], axis=0, dtype=np.uint8) >= 2
    smooth = known & ~plane
    for axis, inner in ((0, np.s_[1:-1]), (1, np.s_[:, 1:-1])):
        # A slope may be as steep as it likes.
        smooth[inner] &= ~(np.linalg.norm(np.diff(displacement, 2, axis), axis=-1) > _STEP)
    count, surfaces = cv2.connectedComponents(smooth.view(np.uint8), connectivity=4)
    size, sure = (
        np.bincount(surfaces[part], minlength=count) for part in (smooth, smooth & checked)
    )
    believed = ((sure >= _LEAST_CHECKED) & (sure >= _CHECKED * size))[surfaces] & smooth
    # At a step the slope changes in the last pixel of either surface, at a lone error in five.
    believed = cv2.dilate(believed.view(np.uint8), _CROSS) > 0
    on_plane = np.linalg.norm(displacement, axis=-1) <= _STEP
    left = known & (checked | np.where(plane, on_plane, believed))
    # Two passes meet in lone pixels by chance.
    left &= cv2.boxFilter(left.astype(np.uint8), -1, (3, 3), normalize=False) > 1
    lost = known & ~left
    warp, error = found.warp.copy(), found.error.copy()
    warp[lost], error[lost] = np.nan, np.inf
    return WarpMap(warp, error)


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
