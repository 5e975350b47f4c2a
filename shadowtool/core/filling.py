"""Giving unknown pixels the values of those around them."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

_CROSS = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32) / 4
_RELAXATIONS = 24
# More unknown parts than this are filled all at once.
_MOST_PARTS = 64


def fill_membrane(values: Float32, weight: Float32) -> Float32:
    """Stretch a membrane over the unknown pixels: there the Laplacian is 0.

    From coarse to fine: each level of a pyramid starts from the one above and is relaxed.

    Args:
        values: (H, W, C) float32; unknown pixels may hold anything finite.
        weight: (H, W) float32 ≥ 0; pixels above 0 are known and keep their values. On coarser
            levels, known pixels that fall together count by their weight.

    Returns:
        (H, W, C) float32; all 0 if no pixel has any weight.
    """
    unknown = np.asarray(~(weight > 0))
    if unknown.all():
        return np.zeros_like(values)
    filled = values.copy()
    rows, columns = _around(cv2.boundingRect(unknown.view(np.uint8)), unknown.shape)
    scaled = np.maximum(weight[rows, columns] / weight.max(), np.float32(1e-6))
    scaled[unknown[rows, columns]] = 0
    _fill_parts(filled[rows, columns], scaled)
    return filled


def _fill_parts(filled: Float32, weight: Float32) -> None:
    """Fill each unknown part by itself, in place."""
    values = filled.copy()
    labels, boxes = _parts(weight == 0)
    for label, (rows, columns) in boxes.items():
        patch = _fill(values[rows, columns], np.ascontiguousarray(weight[rows, columns]))
        own = labels[rows, columns] == label
        for channel in range(values.shape[2]):
            np.copyto(filled[rows, columns, channel], patch[..., channel], where=own)


def _parts(
    unknown: NDArray[np.bool_],
) -> tuple[NDArray[np.int32], dict[int, tuple[slice, slice]]]:
    """The unknown parts' labels and boxes, each with the ring of known pixels that holds it."""
    height, width = unknown.shape
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(
        unknown.astype(np.uint8), connectivity=8
    )
    if count > _MOST_PARTS:
        return unknown.astype(np.int32), {1: (slice(0, height), slice(0, width))}
    found = {
        label: _around(box[:4], unknown.shape)
        for label, box in enumerate(boxes.tolist()[1:], start=1)
    }
    return np.asarray(labels, np.int32), found


def _around(box: Sequence[int], shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of a box (x, y, width, height) with the ring that holds what is in it."""
    x, y, width, height = box
    rows = slice(max(y - 2, 0), min(y + height + 2, shape[0]))
    return rows, slice(max(x - 2, 0), min(x + width + 2, shape[1]))


def _fill(values: Float32, weight: Float32) -> Float32:
    height, width = weight.shape
    known = weight > 0
    if known.all():
        return values
    if not known.any():
        return np.zeros_like(values)
    if max(height, width) <= 2:
        mean = (values * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
        return np.where(known[..., None], values, mean).astype(np.float32)
    half = ((width + 1) // 2, (height + 1) // 2)
    # Twice the half may be one more than the whole; a known edge is not stretched by repeating it.
    padded = ((0, height % 2), (0, width % 2))
    total = np.pad(weight, padded, mode="edge")
    weighted = np.pad(values * weight[..., None], (*padded, (0, 0)), mode="edge").astype(np.float32)
    small_weight = _halved(total)
    divisor = np.maximum(small_weight, np.float32(1e-12))[..., None]
    small = np.asarray(_halved(weighted) / divisor, np.float32)
    double = (2 * half[0], 2 * half[1])
    stretched = cv2.resize(_fill(small, small_weight), double, interpolation=cv2.INTER_LINEAR)
    held, mask = _for_opencv(values), known.view(np.uint8)
    filled = cv2.copyTo(held, mask, np.ascontiguousarray(stretched[:height, :width]))
    for _ in range(_RELAXATIONS):
        filled = cv2.filter2D(filled, -1, _CROSS, borderType=cv2.BORDER_REFLECT)
        cv2.copyTo(held, mask, filled)
    return np.asarray(filled, np.float32).reshape(values.shape)


def _for_opencv(values: Float32) -> Float32:
    # It drops an axis of a single channel, and takes most time where that is to be kept.
    return np.ascontiguousarray(values[..., 0] if values.shape[2] == 1 else values)


def _halved(image: Float32) -> Float32:
    """The mean of each two by two pixels."""
    return np.asarray(
        (image[::2, ::2] + image[1::2, ::2] + image[::2, 1::2] + image[1::2, 1::2]) / 4, np.float32
    )
