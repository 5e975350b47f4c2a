"""Masks: what is connected in them, what is large, and what lies within so many pixels.

Masks are (H, W) bool and are not changed.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

Bool = NDArray[np.bool_]


def square(radius: int) -> NDArray[np.uint8]:
    """What lies within so many pixels down and across, for OpenCV's morphology."""
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def grown(mask: Bool, radius: int) -> Bool:
    """A mask with all that lies within so many pixels of it, down and across."""
    return np.asarray(cv2.dilate(mask.view(np.uint8), square(radius)) > 0)


def shrunk(mask: Bool, radius: int) -> Bool:
    """What of a mask lies further than so many pixels from all that is none; the picture goes on as
    it ends."""
    return np.asarray(cv2.erode(mask.view(np.uint8), square(radius)) > 0)


def opened(mask: Bool, width: int) -> Bool:
    """A mask without what is narrower than so many pixels."""
    size = np.ones((width, width), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_OPEN, size) > 0)


def closed(mask: Bool, radius: int) -> Bool:
    """A mask with the gaps that are no wider than twice so many pixels."""
    size = square(radius)
    return np.asarray(cv2.morphologyEx(mask.view(np.uint8), cv2.MORPH_CLOSE, size) > 0)


def large_parts(mask: Bool, least: float, connectivity: int = 8) -> Bool:
    """The connected parts of a mask that have at least so many pixels.

    Args:
        connectivity: 8 if pixels that meet at a corner are connected, 4 if not.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.view(np.uint8), connectivity=connectivity
    )
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return np.asarray(large[labels])


def parts_with(mask: Bool, seeds: Bool) -> Bool:
    """The connected parts of a mask that hold a seed, a pixel of another mask."""
    _, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    kept = np.zeros(int(labels.max(initial=0)) + 1, bool)
    kept[labels[seeds]] = True
    kept[0] = False
    return np.asarray(kept[labels])


def parts(mask: Bool) -> Iterator[Bool]:
    """Each connected part of a mask as a mask, from the top down."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    for label in range(1, count):
        yield np.asarray(labels == label)
