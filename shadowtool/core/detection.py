"""Finding the figure in a frame: where it shows what the background can't look like.

Three kinds of evidence are weighed pixel by pixel, as logarithms of how much likelier a figure is
than the background: distance from the background's line; distance from L itself, which matches in
three channels where any shadow matches in two; and texture, which a shadow keeps and a figure
hides. Evidence is then shared among neighbours of like colour.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.backdrop import Backdrop, Nearest, Places
from shadowtool.core.bands import bands, channel_sum
from shadowtool.core.filling import fill_membrane
from shadowtool.core.regions import grown, large_parts, opened, parts_with, shrunk, square
from shadowtool.core.trimap import BACKGROUND, FIGURE

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# What is still evidence for the background: half a squared distance from its line, between the
# first two, and from L. A figure's colours are spread over so many times more of what a pixel can
# be.
_NEAR_LINE, _NEAR_LIT = (2.5, 5.0), 9.0
# Which of these it is lit ground tells, by the means of its squared distances over so many pixels
# squared. Noise averages out: but for the last part no mean is so many times the median, and the
# first holds. The larger these are, as where a codec left blocks, the nearer it is to the second.
# Of fewer lit pixels nothing is told.
_MEAN, _TAIL, _NEARLY_ALL, _LEAST_LIT = 5, 1.6, 0.95, 500
# No single pixel's colour says more than this, and no step between two.
_MOST, _MOST_TEXTURE = 8.0, 6.0
# A trimap from another frame is worth as much: it decides where colours don't.
_HINT = 6.0
# Logarithms are exact to the second, besides noise; steps that are off by more than the first count
# less and less.
_STEP, _LEAST_TEXTURE = 0.2, 0.03
# Strength and range of the sharing, in 8-bit levels of this power of linear light: shade has as
# many as light.
_SHARING, _LIKE, _GUIDE_POWER = 20.0, 10.0, 0.3
# A pixel at the figure's edge, or connected with it, that is so far off the line is not background.
_OFF_LINE2 = 12.0
# One that is no further from L, and does not hide its texture, is no figure whatever is around it:
# gaps are narrow.
_ON_LIT2 = 9.0
# Of normal noise 9 pixels in 10 are within this distance of the line, in two dimensions.
_NINE_TENTHS = 2.15
_LARGEST_ERROR, _LEAST_SAMPLE = 3.0, 100
# In and around a figure, this many times its edges' reach, there may be shadow where ground so many
# times that far away is below the first β, or ground beside the figure below the second.
_RING, _NO_SHADOW, _LIT, _FULL = 2, 5, 0.8, 0.15
# Elsewhere what is below this β is ground in the light that is seen around it, give or take the
# second, or a shadow, which costs as much as the third, a squared distance. Above it there is what
# a figure takes of the sky.
_DIMMED, _LIGHT, _NO_SHADOW2 = 0.6, 0.1, 8.0
# So many pixels far colour leaks over an edge of shade, up to this part of what changes there. Of a
# part of the figure at least the next part is so whatever leaks, or other evidence is so much, a
# logarithm, in the mean.
_LEAKS, _LEAKING, _CERTAIN, _TOLD = 2, 0.1, 0.2, 1.5
# What is so many pixels from the figure has nothing of it; beside it begins sooner.
_AWAY, _BESIDE = 5, 1
# A figure is at least this part of the picture, a hole in it at least that; neither is but a few
# pixels.
_LEAST_FIGURE, _LEAST_HOLE, _FEW = 1 / 5000, 1 / 20000, 4


class Found(NamedTuple):
    """A figure in a frame.

    Attributes:
        mask: (H, W) bool, most of the pixel shows the figure; nothing thin.
        maybe: (H, W) bool, mask and what hangs on it that is not background, strands above all.
        excess: by how much more than noise the ground is off its line, where it is most so; ≥ 1.
    """

    mask: Bool
    maybe: Bool
    excess: float


def changed(image: Float32, backdrop: Backdrop) -> Bool:
    """Where a frame is not plainly lit ground, (H, W)."""
    # By itself the mean of nine squared distances is 3; noise alone does not get it to 9.
    return np.asarray(_blurred(backdrop.from_lit2(image), 3) > _ON_LIT2)


def find_figure(
    image: Float32,
    backdrop: Backdrop,
    nearest: Nearest,
    unknown: Bool,
    hint: UInt8,
    frame_size: int,
    reach: int,
) -> Found:
    """The figure in a frame, or in a part of it.

    Args:
        image: (H, W, 3), linear light, without NaN.
        nearest: `Backdrop.nearest` of it.
        unknown: (H, W), nothing can be said of the pixel.
        hint: (H, W) uint8, a trimap that may be a little off; 128 says nothing.
        frame_size: how many pixels the whole frame has.
        reach: how far from the figure's edge it may at first be missed, pixels.
    """
    other = texture_evidence(image, backdrop)
    other[unknown] = 0
    other += np.float32(_HINT) * _leaning(hint)
    near_line = _near_line(nearest, unknown)
    guide = (np.clip(image, 0, 1) ** np.float32(_GUIDE_POWER) * 255).astype(np.uint8)

    def within(distance2: Float32, near: float) -> Bool:
        evidence = np.minimum(distance2 / 2 - near, nearest.from_lit2 / 2 - _NEAR_LIT)
        evidence = np.clip(evidence, -_MOST, _MOST)
        evidence[unknown] = 0
        evidence += other
        shared = cv2.ximgproc.fastGlobalSmootherFilter(guide, evidence, _SHARING, _LIKE)
        return np.asarray(shared > 0)

    def mask_of(distance2: Float32) -> Bool:
        figure = within(distance2, _NEAR_LINE[1])
        if near_line < _NEAR_LINE[1]:
            # What is so near to the line is told by many pixels together alone.
            more = within(distance2, near_line) & ~figure
            figure |= parts_with(more, opened(more, reach + 1))
        edge = grown(figure, 1) & ~shrunk(figure, 1)
        figure[edge & (distance2 > _OFF_LINE2)] = True
        figure[(nearest.from_lit2 < _ON_LIT2) & (other < 0) & ~unknown] = False
        return _solid(figure, frame_size)

    mask = mask_of(nearest.distance2)
    if not mask.any():
        return Found(mask, mask, 1.0)
    excess = _background_error(nearest, mask)
    distance2 = nearest.distance2 / excess**2
    ring, shadow2 = _without_shadow(image, backdrop, nearest, mask, unknown, reach)
    distance2[ring] = np.minimum(distance2[ring] + np.float32(_NO_SHADOW2), shadow2)
    mask = mask_of(distance2)
    # What is thinner than three pixels is no limb.
    limbs = opened(mask, 3)
    limbs = _certain_parts(limbs, _with_leaks(image, backdrop, nearest) / excess**2, other)
    strands = (distance2 > _OFF_LINE2) & (nearest.from_lit2 > _OFF_LINE2) & ~unknown
    return Found(limbs, parts_with(mask | strands, limbs), float(excess.max()))


def _with_leaks(image: Float32, backdrop: Backdrop, nearest: Nearest) -> Float32:
    """Squared distances from the line where, beside the noise, colour leaks over edges of shade, as
    a mosaic or coarse chroma makes it do."""
    ground, beta = nearest.distance2 < _OFF_LINE2, np.clip(nearest.beta, 0, 1)
    most = cv2.dilate(np.where(ground, beta, np.float32(0)), square(_LEAKS))
    least = cv2.erode(np.where(ground, beta, np.float32(1)), square(_LEAKS))
    step = np.subtract(most, least, out=most)
    step *= np.float32(_LEAKING)
    distance2 = np.empty_like(nearest.distance2)
    for rows in bands(image.shape):
        here = backdrop.at((rows, slice(None)))
        leak = np.maximum(step[rows], 0)[..., np.newaxis] * (here.lit - here.shadow)
        more = channel_sum(leak * leak / here.variance(image[rows])) / 3
        distance2[rows] = nearest.distance2[rows] / (1 + more)
    return distance2


def _certain_parts(mask: Bool, distance2: Float32, other: Float32) -> Bool:
    """The connected parts of a mask of which enough is off the line even where colour leaks, or
    that other evidence tells: the rest are strips of an edge of shade.

    Args:
        distance2: as of `_with_leaks`.
        other: (H, W), evidence besides the distance.
    """
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=8)
    own = labels[mask]
    size, sure = (
        np.bincount(some, minlength=count) for some in (own, own[distance2[mask] > _OFF_LINE2])
    )
    told = np.bincount(own, other[mask], count)
    kept = (sure >= _CERTAIN * size) | (told > _TOLD * size)
    kept[0] = False
    return np.asarray(kept[labels])


def _near_line(nearest: Nearest, unknown: Bool) -> float:
    """Half the squared distance from its line within which a pixel is background, as far as lit
    ground tells.

    What noise leaves of it averages out; blocks that a codec did not send anew do not.
    """
    lit = (_blurred(nearest.from_lit2, 3) < _ON_LIT2) & ~unknown
    off = _blurred(nearest.distance2, _MEAN)[lit]
    least, most = _NEAR_LINE
    if off.size < _LEAST_LIT:
        return most
    middle, tail = np.quantile(off, (0.5, _NEARLY_ALL))
    return float(np.clip(least * tail / max(_TAIL * middle, 1e-6), least, most))


def _blurred(square: Float32, size: int) -> Float32:
    """The mean of squared distances around each pixel, none of which counts for very much."""
    return np.asarray(cv2.blur(np.minimum(square, np.float32(100)), (size, size)), np.float32)


def _without_shadow(
    image: Float32,
    backdrop: Backdrop,
    nearest: Nearest,
    mask: Bool,
    unknown: Bool,
    reach: int,
) -> tuple[Places, Float32]:
    """Dark pixels in and around a figure that have no shadow near them, and their squared distance
    (N) in standard deviations from the background in the light that is seen around them."""
    ring = grown(mask, _RING * reach)
    seen = ~(ring | unknown)
    known = np.where(seen, nearest.beta, np.float32(0))[..., np.newaxis]
    beta = fill_membrane(known, seen.astype(np.float32))[..., 0]
    full = (nearest.beta < _FULL) & (nearest.distance2 < _OFF_LINE2) & ~mask & ~unknown
    darkest = np.where(opened(full, 3), np.float32(0), beta)
    darkest = cv2.erode(darkest, square(_NO_SHADOW * reach))
    places = np.nonzero(ring & (darkest > _LIT) & (nearest.beta < _DIMMED))
    here, value = backdrop.at(places), image[places]
    weight = 1 / here.variance(value)
    off, shift = value - here.under(beta[places]), here.lit - here.shadow
    # β may be off by so much: rank one more in the covariance.
    along = (weight * off * shift).sum(axis=-1) ** 2
    along /= (weight * shift**2).sum(axis=-1) + np.float32(1 / _LIGHT**2)
    return places, np.asarray((weight * off**2).sum(axis=-1) - along, np.float32)


def texture_evidence(image: Float32, backdrop: Backdrop) -> Float32:
    """How much better steps of log C from pixel to pixel are none than those of log L, (H, W).

    Above 0 the ground's texture is hidden, below 0 it shows, 0 if it has none. Each pixel has half
    of what the steps around it say.
    """
    value = np.maximum(channel_sum(image), np.float32(1e-3))
    seen = np.log(value)
    known = np.log(np.maximum(channel_sum(backdrop.lit), np.float32(1e-3)))
    each = np.asarray(value / 3, np.float32)
    noise = [backdrop.noise.channel_variance(each, channel) for channel in range(3)]
    variance = (noise[0] + noise[1] + noise[2]) / value**2 + np.float32(_LEAST_TEXTURE**2)
    evidence = np.zeros_like(value)
    for axis in (0, 1):
        here = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        there = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        step = seen[there] - seen[here]
        hidden, shown = step**2, (step - known[there] + known[here]) ** 2
        # What neither explains is an edge, of a shadow or a figure.
        weight = 1 / (1 + np.minimum(hidden, shown) / np.float32(_STEP**2))
        said = weight * (shown - hidden) / (2 * (variance[here] + variance[there]))
        said = np.clip(said, -_MOST_TEXTURE, _MOST_TEXTURE) / 2
        evidence[here] += said
        evidence[there] += said
    return evidence


def _leaning(hint: UInt8) -> Float32:
    """1 in a trimap's figure, -1 in its background, and half as much at their borders, falling from
    one to the other, (H, W): bands are drawn with the edge about in their middle."""
    sure = np.where(hint == FIGURE, np.float32(1), -(hint == BACKGROUND).astype(np.float32))
    if not ((hint == FIGURE).any() and (hint == BACKGROUND).any()):
        return sure
    figure, background = (
        cv2.distanceTransform((hint != value).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        for value in (FIGURE, BACKGROUND)
    )
    between = (background - figure) / (2 * (background + figure))
    return np.asarray(np.where(sure == 0, between, sure), np.float32)


def _background_error(nearest: Nearest, mask: Bool) -> Float32:
    """By how much more than noise the background is off its line, (H, W) ≥ 1: compression and
    coarse chroma, which do most harm around what moves, in shade and at its edge."""
    away, beside = (~grown(mask, radius) for radius in (_AWAY, _BESIDE))
    error = np.ones(mask.shape, np.float32)
    full, part = nearest.beta < 0.03, (nearest.beta >= 0.03) & (nearest.beta < 0.95)
    for shade, sample in ((full, away), (part, away), (~full & ~part, beside & ~away)):
        distance2 = nearest.distance2[shade & sample]
        if distance2.size >= _LEAST_SAMPLE:
            typical = np.sqrt(np.quantile(distance2, 0.9)) / _NINE_TENTHS
            error[shade] = np.clip(typical, 1, _LARGEST_ERROR)
    return error


def _solid(figure: Bool, frame_size: int) -> Bool:
    """Without specks, its small holes closed."""
    figure = large_parts(figure, max(_LEAST_FIGURE * frame_size, _FEW))
    return ~large_parts(~figure, max(_LEAST_HOLE * frame_size, _FEW), connectivity=4)
