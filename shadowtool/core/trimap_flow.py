"""Trimaps that were drawn for some frames, carried to those between by optical flow."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import rounded, to_float
from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN

Float16 = NDArray[np.float16]
Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

# Flow is found on pictures of about this width.
_WIDTH = 480
# This percentile of every so many rows and columns is white, if it is brighter than 1.
_WHITE, _EVERY = 99, 4
# What each step adds to the error in pixels of them, and the error at which a pixel is lost.
_DRIFT, _LOST = 0.25, 6.0


class Link(NamedTuple):
    """Where the pixels of a frame are in a neighbouring one.

    Attributes:
        flow: (h, w, 2) half, displacement (x, y) in pixels; many are kept, and an eighth of a pixel
            is as good.
        error: (h, w) half ≥ 0, by how much the way there and back misses.
    """

    flow: Float16
    error: Float16


class Carried(NamedTuple):
    """A trimap as it is in another frame: (H, W) uint8, and the error in pixels that it may have,
    (H, W) float32, infinite where the way was lost."""

    trimap: UInt8
    error: Float32


def flow_picture(image: NDArray[np.floating]) -> UInt8:
    """The small grey picture, (h, w) uint8, of a frame (H, W, 3) in linear light; NaN is black, and
    what is infinite white."""
    height, width = image.shape[:2]
    step = max(1.0, width / _WIDTH)
    size = (max(round(width / step), 16), max(round(height / step), 16))
    with np.errstate(over="ignore"):
        grey = np.nan_to_num(image.astype(np.float32), posinf=np.inf).mean(axis=-1)
    some = grey[::_EVERY, ::_EVERY]
    some = some[np.isfinite(some)]
    white = max(float(np.percentile(some, _WHITE)), 1) if some.size else 1.0
    grey = np.clip(grey / np.float32(white), 0, 1)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.rint(small ** np.float32(1 / 2.2) * 255), np.uint8)


def links(here: UInt8, there: UInt8) -> tuple[Link, Link]:
    """The flow from one picture to another and the flow back, and how far they agree."""
    forward, back = _flow(here, there), _flow(there, here)
    return _checked(forward, back), _checked(back, forward)


def carry(trimap: UInt8, way: Sequence[Link]) -> Carried:
    """A keyframe's trimap in a frame that is some links away from it.

    What is nearer to a border of the trimap than the error is unknown.

    Args:
        trimap: (H, W) uint8, as drawn.
        way: the links from the frame to the keyframe; none for the keyframe itself.
    """
    height, width = trimap.shape
    if not way:
        return Carried(trimap, np.zeros(trimap.shape, np.float32))
    flow: Float32 = np.zeros_like(way[0].flow, np.float32)
    error = np.zeros_like(way[0].error, np.float32)
    for step in way:
        error += _moved(to_float(step.error), flow) + np.float32(_DRIFT)
        flow += _moved(to_float(step.flow), flow)
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    lost = cv2.resize((error > _LOST).astype(np.uint8), (width, height)) > 0
    error = np.asarray(cv2.resize(error, (width, height)) * scale.max(), np.float32)
    flow = np.asarray(cv2.resize(flow, (width, height)) * scale, np.float32)
    figure, background = (_moved(_depth(trimap == value), flow) for value in (FIGURE, BACKGROUND))
    carried = np.full(trimap.shape, UNKNOWN, np.uint8)
    carried[figure > error] = FIGURE
    carried[background > error] = BACKGROUND
    return Carried(carried, np.where(lost, np.float32(np.inf), error).astype(np.float32))


def merge(sides: Sequence[Carried]) -> UInt8:
    """One trimap of those that came from the keyframes before and after, one or two.

    Where both are known and disagree it is unknown, unless one is much surer; where neither is
    known it is unknown.
    """
    first, second = sides[0], sides[-1]
    merged = np.where(first.trimap == second.trimap, first.trimap, UNKNOWN)
    merged = np.where(2 * first.error < second.error, first.trimap, merged)
    merged = np.where(2 * second.error < first.error, second.trimap, merged)
    lost = np.isinf(first.error) & np.isinf(second.error)
    return np.asarray(np.where(lost, UNKNOWN, merged), np.uint8)


def _checked(forward: Float32, back: Float32) -> Link:
    missed = np.linalg.norm(forward + _moved(back, forward), axis=-1)
    return Link(rounded(forward), rounded(missed))


def _flow(here: UInt8, there: UInt8) -> Float32:
    flow = np.zeros((*here.shape, 2), np.float32)
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(method.calc(here, there, flow), np.float32)


def _moved(image: Float32, flow: Float32) -> Float32:
    """What an image shows where a displacement leads; beyond its border what lies there."""
    height, width = flow.shape[:2]
    columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    x, y = flow[..., 0] + columns, flow[..., 1] + rows[:, np.newaxis]
    moved = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)


def _depth(part: NDArray[np.bool_]) -> Float32:
    """How deep within a part of the picture each of its pixels lies, 0 elsewhere; the picture's
    border is none of the part's."""
    padded = np.pad(part, 1, mode="edge").astype(np.uint8)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
    return np.ascontiguousarray(np.minimum(depth, np.float32(sum(part.shape))), np.float32)
