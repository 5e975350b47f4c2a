"""The figure's matte and colour in a frame whose background is known but for its shadow."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.backdrop import Backdrop
from shadowtool.core.boxes import around
from shadowtool.core.detection import Found, changed, find_figure
from shadowtool.core.half_floats import not_finite
from shadowtool.core.known_background import colours, ground_beta, measure, solve
from shadowtool.core.trimap import (
    BACKGROUND,
    FIGURE,
    UNKNOWN,
    doubted,
    edge_prior,
    narrowed,
    wide_trimap,
)

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# Edges are looked for this far inwards: pixels, and of wide pictures a part of their width.
_REACH, _REACH_PART = 4, 1 / 240
# So much of the surroundings is worked on too, pixels.
MARGIN = 16
# From this alpha on the ground behind is not told by what is seen past the figure.
HIDDEN = 0.5
# Alpha as near as this to 0 or 1 is noise.
_NOTHING = 0.01


class Figure(NamedTuple):
    """The figure alone.

    Attributes:
        foreground: (H, W, 3) float32 ≥ 0, premultiplied.
        alpha: (H, W) float32 in [0, 1].
        trimap: (H, W) uint8: 0 background, 128 unknown, 255 figure.
    """

    foreground: Float32
    alpha: Float32
    trimap: UInt8


def differs(image: Float32, backdrop: Backdrop, unknown: Bool) -> Bool:
    """Where a frame, or some rows of it, is not plainly lit ground, (H, W); arguments as for
    `pull_figure`."""
    seen, _, _ = _without_unknown(image, backdrop, unknown)
    return changed(seen, backdrop)


def pull_figure(
    image: Float32,
    backdrop: Backdrop,
    unknown: Bool,
    drawn: UInt8 | None = None,
    hint: UInt8 | None = None,
    frame_size: tuple[int, int] | None = None,
) -> Figure:
    """The figure in a frame, its alpha, colour and trimap.

    All arguments may be of a part of the frame that holds all in which it `differs`, and a margin
    of `MARGIN`.

    Args:
        image: (H, W, 3) float32, linear light; where it is not finite it is unknown.
        unknown: (H, W), the plates say nothing of the pixel.
        drawn: (H, W) uint8, a trimap from elsewhere whose 0 and 255 are kept; what is 128 in it is
            found as without one.
        hint: (H, W) uint8, a trimap that may be a little off, for what the frame leaves open.
        frame_size: height and width of the whole frame, if this is a part.

    Returns:
        The figure; empty if there is none, black where the frame is unknown.
    """
    height, width = frame_size or image.shape[:2]
    if drawn is None:
        drawn = np.full(image.shape[:2], UNKNOWN, np.uint8)
    trimap = np.where(drawn == FIGURE, FIGURE, BACKGROUND)
    seen, unknown, bad = _without_unknown(image, backdrop, unknown)
    box = around(changed(seen, backdrop) | (trimap == FIGURE), MARGIN)
    if box is None:
        return Figure(np.zeros_like(image), np.zeros(image.shape[:2], np.float32), trimap)
    reach = max(_REACH, round(_REACH_PART * width))
    part, ground = seen[box], backdrop.at(box)
    nearest = ground.nearest(part)
    hint = drawn if hint is None else hint
    found = find_figure(part, ground, nearest, unknown[box], hint[box], height * width, reach)
    found = _within(found, drawn[box])
    wide = wide_trimap(found.mask, found.maybe, reach)
    wide = np.where(drawn[box] == UNKNOWN, wide, drawn[box])
    behind = ground_beta(nearest.beta, (wide == BACKGROUND) & ~unknown[box])
    measured = measure(part, wide, behind, ground, found.excess)
    prior = edge_prior(*measured, wide, found.mask, reach)
    narrow = narrowed(wide, prior, found.mask)
    prior = doubted(prior, nearest.distance2)
    # Pictures of the figure's size are the most of what a frame takes.
    del measured, nearest
    solved = solve(part, narrow, behind, ground, reach, prior, found.excess)
    whole = np.where(solved.alpha > 1 - _NOTHING, np.float32(1), solved.alpha)
    alpha, foreground = np.zeros(image.shape[:2], np.float32), np.zeros_like(image)
    alpha[box] = np.where(whole < _NOTHING, np.float32(0), whole)
    np.multiply(alpha[box][..., np.newaxis], solved.foreground, out=foreground[box])
    foreground[bad] = 0
    trimap[box] = narrow
    return Figure(foreground, alpha, trimap)


def colour_figure(image: Float32, backdrop: Backdrop, unknown: Bool, alpha: Float32) -> Figure:
    """The colour of a figure whose alpha is given; arguments and result as for `pull_figure`.

    All of them may be of a part of the picture that holds the figure and a margin of `MARGIN`.

    Args:
        alpha: (H, W) float32 in [0, 1], kept as it is.
    """
    trimap = np.where(alpha >= 1, FIGURE, np.where(alpha > 0, UNKNOWN, BACKGROUND))
    foreground = np.zeros(image.shape, np.float32)
    box = around(alpha > 0, MARGIN)
    if box is not None:
        part, ground, cover = image[box], backdrop.at(box), alpha[box]
        seen, unknown, bad = _without_unknown(part, ground, unknown[box])
        behind = ground_beta(ground.nearest(seen).beta, (cover == 0) & ~unknown)
        colour = cover[..., np.newaxis] * colours(seen, cover, behind, ground, _REACH)
        colour[bad] = 0
        foreground[box] = colour
    return Figure(foreground, alpha, np.asarray(trimap, np.uint8))


def without_figure(image: Float32, figure: Figure) -> Float32:
    """The ground that is seen past a figure's edge, (C - αF) / (1 - α); the frame where there is no
    figure, or where it hides the ground."""
    edge = (figure.alpha > 0) & (figure.alpha < HIDDEN)
    ground = image.copy()
    left = 1 - figure.alpha[edge][:, np.newaxis]
    ground[edge] = (image[edge] - figure.foreground[edge]) / left
    return ground


def _without_unknown(
    image: Float32, backdrop: Backdrop, unknown: Bool
) -> tuple[Float32, Bool, Bool]:
    """The frame with lit ground in place of what is unknown of it; what is unknown of either, and
    of the frame."""
    bad = not_finite(image)
    if bad is None:
        return image, unknown, np.zeros(image.shape[:2], bool)
    return np.where(bad[..., np.newaxis], backdrop.lit, image), unknown | bad, bad


def _within(found: Found, drawn: UInt8) -> Found:
    """What was found, as far as a drawn trimap leaves it open."""
    mask = (drawn == FIGURE) | ((drawn == UNKNOWN) & found.mask)
    return found._replace(mask=mask, maybe=mask | ((drawn == UNKNOWN) & found.maybe))
