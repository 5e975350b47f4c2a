"""The figure's matte and colour in front of a background that is known but for its shadow.

Behind each pixel of the figure lies βL + (1 - β)S with one unknown β: a line in colour space. What
does not lie on the line is the figure.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.color_line import line_distance
from shadowtool.core.noise import NoiseModel

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

BACKGROUND, UNKNOWN, FIGURE = np.uint8(0), np.uint8(128), np.uint8(255)

# Distances from the line, in standard deviations of its noise, at which a pixel starts to be, and
# surely is, something else than background.
_BACKGROUND_DISTANCE = 4.0
_FIGURE_DISTANCE = 12.0
# How exact plates are, as a part of their value.
_TOLERANCE = 0.015
# How much of the sky is left in the shadow near the foot of a figure.
_DEEPEST = 0.75
# Ground is in shadow below this β. Something dark borders on lit ground if no more than this part
# of the ground within so many pixels of it is in shadow.
_HALF_SHADE, _LIT_BORDER, _RING = 0.5, 0.2, 3


class Figure(NamedTuple):
    """The figure alone: `foreground` (H, W, 3) premultiplied by `alpha` (H, W), float32."""

    foreground: Float32
    alpha: Float32


def figure_distance(
    image: Float32, beta: Float32, lit: Float32, shadow: Float32, noise: NoiseModel
) -> Float32:
    """How far each pixel is from all that the background can look like, in standard deviations.

    Near its feet a figure takes some of the sky away from its shadow, which is then a little darker
    than S; and dark clothes look like such a shadow. What is darker than S counts as shadow where
    it borders on shadow, and as figure where the ground around it is lit.

    Args:
        image, lit, shadow: (H, W, 3), linear light.
        beta: (H, W), not clipped.

    Returns:
        (H, W) float32 ≥ 0.
    """
    strict = line_distance(image, lit, shadow, noise, _TOLERANCE)
    deeper = line_distance(image, shadow, np.float32(_DEEPEST) * shadow, noise, _TOLERANCE)
    distance = np.minimum(strict, deeper)
    doubtful = ((strict > _BACKGROUND_DISTANCE) & (deeper < strict)).astype(np.uint8)
    small = np.ones((3, 3), np.uint8)
    doubtful = cv2.morphologyEx(doubtful, cv2.MORPH_OPEN, small).astype(np.uint8)
    ground = strict <= _BACKGROUND_DISTANCE
    shaded = ground & (beta < _HALF_SHADE)
    height, width = distance.shape
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(doubtful, connectivity=8)
    for label, (x, y, w, h, _) in enumerate(boxes.tolist()[1:], start=1):
        part = (
            slice(max(y - _RING, 0), min(y + h + _RING, height)),
            slice(max(x - _RING, 0), min(x + w + _RING, width)),
        )
        own = (labels[part] == label).astype(np.uint8)
        size = 2 * _RING + 1
        around = (cv2.dilate(own, np.ones((size, size), np.uint8)) > 0) & (own == 0)
        ground_around = (around & ground[part]).sum()
        if (around & shaded[part]).sum() <= _LIT_BORDER * ground_around:
            np.copyto(distance[part], strict[part], where=own > 0)
    return np.asarray(distance, np.float32)


def difference_trimap(distance: Float32, band: int = 3) -> UInt8:
    """A trimap by difference.

    Args:
        distance: (H, W) from `figure_distance`.
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
        distance: (H, W) from `figure_distance`.
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
