"""Light that changes over a take: one gain a frame, found from the pixels that agree."""

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.half_floats import rounded, to_float

Float32 = NDArray[np.float32]

# Logarithms of gains further from 0 are shadow, not exposure.
_WIDEST = 0.35
# A gain nearer to 1 than this is 1: the picture stays as it is, bit for bit.
_NOTHING = 0.004
# At least this part of the pixels must agree.
_LEAST_PART = 0.05
# Ratios this near to each other agree; the middle of them is closed in on, as penumbrae lie on
# one side of it.
_NEAR = (0.03, 0.02, 0.012, 0.008, 0.008)


def frame_gain(image: Float32, reference: Float32) -> float:
    """By how much a frame is brighter than the reference where nothing but exposure changed.

    Ratios of the same surface in the same light agree; those of what a shadow or a figure covers
    lie elsewhere, or scatter.

    Args:
        image, reference: (h, w, 3), linear light, the same pixels.

    Returns:
        The most frequent ratio of the two; 1 if it is next to 1, or nothing agrees.
    """
    now, then = _sum(image), _sum(reference)
    usable = np.isfinite(now) & np.isfinite(then) & (then > 1e-2) & (now > 0)
    ratio = np.log(now[usable] / then[usable])
    near = np.sort(ratio[np.abs(ratio) < _WIDEST])
    if near.size < max(_LEAST_PART * usable.sum(), 16):
        return 1.0
    counts, edges = np.histogram(near, bins=140, range=(-_WIDEST, _WIDEST))
    smooth = np.convolve(counts, np.hanning(9), mode="same")
    peak = int(np.argmax(smooth))
    centre = (edges[peak] + edges[peak + 1]) / 2
    agreed = near[np.abs(near - centre) < _NEAR[0]]
    for width in _NEAR:
        members = near[np.abs(near - centre) < width]
        # Their median, as they are in order.
        middle = members[(members.size - 1) // 2 : members.size // 2 + 1]
        centre = float(middle.mean()) if middle.size else centre
    # What agrees is many, and many more than if the ratios were anything at all.
    enough = max(_LEAST_PART * usable.sum(), 2 * near.size * _NEAR[0] / _WIDEST)
    if agreed.size < enough or abs(centre) < _NOTHING:
        return 1.0
    return float(np.exp(centre))


def _sum(image: Float32) -> Float32:
    """Of the channels, (h, w); several times faster than along so short an axis."""
    return np.asarray(image[..., 0] + image[..., 1] + image[..., 2], np.float32)


def common_reference(samples: list[Float32]) -> Float32:
    """What most of a sample of frames show, with their own gains taken out; (h, w, 3).

    Its own exposure is that of the most frames: where long shade pulls the median down, the light
    that most of them agree in lifts it again.
    """
    reference = np.median(samples, axis=0)
    gains = [frame_gain(sample, reference) for sample in samples]
    level = float(np.median(gains))
    corrected = [
        sample * np.float32(level / gain) for sample, gain in zip(samples, gains, strict=True)
    ]
    reference = np.asarray(np.median(corrected, axis=0), np.float32)
    usual = float(np.median([frame_gain(sample, reference) for sample in samples]))
    return reference * np.float32(usual)


def without_gain(image: NDArray[np.floating], gain: float) -> NDArray[np.floating]:
    """The frame as it would be at gain 1; the very same array if it is."""
    if gain == 1:
        return image
    if image.dtype != np.float16:
        return image.astype(np.float32) * np.float32(1 / gain)
    corrected = np.empty_like(image)
    for rows in bands(image.shape):
        corrected[rows] = rounded(to_float(image[rows]) * np.float32(1 / gain))
    return corrected
