"""The figure's matte and colour in front of a background that is known but for its shadow.

Behind each pixel of the figure lies βL + (1 - β)S with one unknown β: a line in colour space. What
does not lie on the line is the figure.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

BACKGROUND, UNKNOWN, FIGURE = np.uint8(0), np.uint8(128), np.uint8(255)

# Distances from the line, in standard deviations of its noise, at which a pixel starts to be, and
# surely is, something else than background.
_BACKGROUND_DISTANCE = 4.0
_FIGURE_DISTANCE = 12.0


class Figure(NamedTuple):
    """The figure alone: `foreground` (H, W, 3) premultiplied by `alpha` (H, W), float32."""

    foreground: Float32
    alpha: Float32


def difference_trimap(distance: Float32, band: int = 3) -> UInt8:
    """A trimap by difference.

    Args:
        distance: (H, W) from `color_line.line_distance`.
        band: half the width of the unknown band, pixels.

    Returns:
        (H, W) uint8: 0 background, 128 unknown, 255 figure.
    """
    # A single noisy pixel is no figure, a whole neighbourhood off the line is.
    smooth = cv2.GaussianBlur(np.minimum(distance, 3 * _FIGURE_DISTANCE), (0, 0), 1.0)
    figure = (smooth > _FIGURE_DISTANCE / 2).astype(np.uint8)
    small = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    figure = cv2.morphologyEx(figure, cv2.MORPH_OPEN, small).astype(np.uint8)
    closing = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    figure = cv2.morphologyEx(figure, cv2.MORPH_CLOSE, closing).astype(np.uint8)
    figure = _without_specks(figure)
    edge = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    trimap = np.full(figure.shape, UNKNOWN, np.uint8)
    trimap[cv2.erode(figure, edge) > 0] = FIGURE
    trimap[cv2.dilate(figure, edge) == 0] = BACKGROUND
    return trimap


def difference_alpha(distance: Float32, trimap: UInt8) -> Float32:
    """Alpha by difference: 0 on the line between L and S, 1 far from it.

    Args:
        distance: (H, W) from `color_line.line_distance`.
        trimap: (H, W) uint8; 0 and 255 are kept as they are.

    Returns:
        (H, W) float32 in [0, 1].
    """
    smooth = cv2.GaussianBlur(distance, (0, 0), 0.7)
    alpha = np.clip(
        (smooth - _BACKGROUND_DISTANCE) / (_FIGURE_DISTANCE - _BACKGROUND_DISTANCE), 0, 1
    )
    alpha[trimap == BACKGROUND] = 0
    alpha[trimap == FIGURE] = 1
    return np.asarray(alpha, np.float32)


def pull_figure(image: Float32, alpha: Float32, background: Float32) -> Figure:
    """The figure's premultiplied colour, Eq. (1): αF = C - (1 - α)B.

    Args:
        image: (H, W, 3) float32, linear light.
        alpha: (H, W) float32 in [0, 1].
        background: (H, W, 3), βL + (1 - β)S; NaN counts as black.

    Returns:
        The figure; its colour is at least 0, and 0 where alpha or the picture is unknown.
    """
    foreground = np.nan_to_num(image) - (1 - alpha[..., None]) * np.nan_to_num(background)
    foreground[alpha == 0] = 0
    return Figure(np.maximum(foreground, 0).astype(np.float32), alpha)


def _without_specks(mask: UInt8) -> UInt8:
    """Drop parts smaller than 1/5000 of the frame, close holes of that size."""
    least = mask.size / 5000
    for value in (1, 0):
        part = (mask == value).astype(np.uint8)
        _, labels, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
        small = stats[:, cv2.CC_STAT_AREA] < least
        small[0] = False
        mask = np.where(small[labels], np.uint8(1 - value), mask)
    return mask
