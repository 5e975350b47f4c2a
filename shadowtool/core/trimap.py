"""Trimaps: what is surely background, what is surely figure, and the band between.

How a figure's edge goes from 0 to 1 depends on lens, sampling, compression and motion. It is
measured: alpha as it comes out of a wide band, by the distance from the edge, tells what to expect
of it and how wide the band has to be.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.regions import shrunk, square

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

BACKGROUND, UNKNOWN, FIGURE = np.uint8(0), np.uint8(128), np.uint8(255)

# The band's width outwards; how deep inwards is up to the caller.
_OUTWARDS = 2.0
# Of a limb's thickness the core is at least this deep, in parts of its half, and in pixels.
_CORE, _LEAST_CORE = 0.7, 2.0
# Alpha in a layer is measured from this many pixels that are this exact and well explained.
_LEAST_PIXELS, _EXACT, _EXPLAINED = 50, 0.15, 9.0
# Failing that it is that of a sharp edge: mean and deviation just outside and inside.
_SHARP = {0: (0.05, 0.1), 1: (0.8, 0.3), 2: (0.98, 0.08)}
_LEAST_DEVIATION = 0.05
# A stretch of the edge is blurred where its layers, over this window, are below this part of what
# they are elsewhere; to begin with, so many pixels speak for elsewhere.
_WINDOW, _BLURRED, _ELSEWHERE = 15, 0.75, 4.0
_RISE = 0.6
_BLURRED_DEVIATION = 0.3
# What is no further from the background than this is expected to be so much less of the figure.
_LIKE_BACKGROUND2, _DOUBT = 8.0, 0.35
# Of what hangs loosely on a figure little is expected, which hair is exact enough to overcome.
_LOOSE = (0.1, 0.25)
# What is expected to be this opaque is not doubted; from the second mean inwards all is figure:
# hardly any of the ground is in its colours.
_OPAQUE, _SOLID = 0.9, 0.95


class Prior(NamedTuple):
    """What is known of alpha beforehand: (H, W) float32 mean and standard deviation."""

    mean: Float32
    deviation: Float32


def wide_trimap(mask: Bool, maybe: Bool, reach: int) -> UInt8:
    """A trimap with a band that holds the edge even of what is blurred.

    Args:
        mask: (H, W), most of the pixel shows the figure.
        maybe: (H, W), may show something of it.
        reach: how far the band goes inwards, pixels; limbs keep a core.

    Returns:
        (H, W) uint8: 0 background, 128 unknown, 255 figure.
    """
    inside, outside = _distances(mask)
    thickness = cv2.dilate(inside, square(reach))
    depth = np.minimum(reach + 0.5, np.maximum(_CORE * thickness + 0.5, _LEAST_CORE))
    core = mask & (inside >= depth)
    if not core.any():
        core = mask & (inside >= _CORE * thickness)
    trimap = np.full(mask.shape, UNKNOWN, np.uint8)
    trimap[core] = FIGURE
    trimap[(outside > _OUTWARDS) & ~maybe] = BACKGROUND
    return trimap


def edge_prior(
    alpha: Float32, error: Float32, misfit: Float32, trimap: UInt8, mask: Bool, reach: int
) -> Prior:
    """What to expect of alpha, layer by layer from the mask's edge.

    In most of a layer the figure's colour is as near to that of its core as was taken for granted,
    so quartiles tell how alpha goes over the edge, where single pixels don't.

    Args:
        alpha, error, misfit: (H, W), solved without a prior.
        trimap: that of `wide_trimap`, which was solved.
        mask, reach: what that was made from.
    """
    layer = _layers(mask)
    usable = (trimap == UNKNOWN) & (error < _EXACT) & (misfit < _EXPLAINED)
    mean = np.where(layer > 0, np.float32(1), np.float32(0))
    deviation = np.full(mask.shape, _LEAST_DEVIATION, np.float32)
    elsewhere = {}
    for number in range(-1, reach + 2):
        own = layer == number
        sample = alpha[own & usable]
        if sample.size >= _LEAST_PIXELS:
            low, middle, high = np.quantile(sample, (0.25, 0.5, 0.75))
            expected, scatter = (low + middle + high) / 3, (high - low) / 1.35
        else:
            expected, scatter = _SHARP.get(number, (float(number > 0), 0.0))
        mean[own] = expected
        deviation[own] = max(scatter, _LEAST_DEVIATION)
        elsewhere[number] = expected

    def along(number: int) -> Float32:
        return _along_edge(alpha, (layer == number) & usable, elsewhere[number])

    # Over a blurred edge alpha rises from layer to layer; that of another colour jumps.
    rises = along(1) < _RISE * along(3)
    for number in range(1, reach + 2):
        found = along(number)
        blurred = (layer == number) & rises & (found < _BLURRED * mean)
        mean[blurred] = found[blurred]
        deviation[blurred] = _BLURRED_DEVIATION
    loose = (trimap == UNKNOWN) & (layer < -1)
    mean[loose], deviation[loose] = _LOOSE
    return Prior(mean, deviation)


def doubted(prior: Prior, distance2: Float32) -> Prior:
    """A prior that expects less of pixels at the edge which by themselves look like background.

    Args:
        distance2: (H, W), squared distance from the background in standard deviations.
    """
    doubtful = (prior.mean < _OPAQUE) & (distance2 < _LIKE_BACKGROUND2)
    mean = np.where(doubtful, np.float32(_DOUBT) * prior.mean, prior.mean)
    return Prior(mean, prior.deviation)


def narrowed(trimap: UInt8, prior: Prior, mask: Bool) -> UInt8:
    """A trimap whose unknown band is as wide as its edge; the mask's rim stays in it."""
    inside = shrunk(mask, 1)
    narrow = trimap.copy()
    narrow[(trimap == UNKNOWN) & inside & (prior.mean >= _SOLID)] = FIGURE
    return narrow


def _along_edge(alpha: Float32, sample: Bool, elsewhere: float) -> Float32:
    """The mean of a sample of alpha around each pixel, (H, W)."""
    window = (_WINDOW, _WINDOW)
    weight = sample.astype(np.float32)
    count = cv2.boxFilter(weight, -1, window, normalize=False) + np.float32(_ELSEWHERE)
    total = cv2.boxFilter(weight * alpha, -1, window, normalize=False)
    return np.asarray((total + np.float32(_ELSEWHERE * elsewhere)) / count, np.float32)


def _distances(mask: Bool) -> tuple[Float32, Float32]:
    """From pixels of the mask to the nearest outside it, and the other way round; 0 elsewhere."""
    # Where there is no other side at all it is out of sight.
    sight = np.float32(sum(mask.shape))
    inner, outer = (
        cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        for part in (mask, ~mask)
    )
    return np.minimum(inner, sight), np.minimum(outer, sight)


def _layers(mask: Bool) -> NDArray[np.int32]:
    """Layers of pixels from the mask's edge: 1, 2 and so on inwards, 0, -1 and so on outwards."""
    inside, outside = _distances(mask)
    inwards, outwards = np.ceil(inside - 0.5), 1 + np.floor(0.5 - outside)
    return np.asarray(np.where(mask, inwards, outwards), np.int32)
