"""Colour differences of video that has fewer samples of them than of luma.

Between their samples they are taken to follow luma as they do around: where a shadow falls, all
that a surface sends gets darker at once, and an edge is where luma has it.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

# How wide the surroundings are, samples of chroma; and below which variance luma tells nothing,
# that of two code values of eight bits.
_AROUND, _FLAT = (5, 5), (2.5 / 255) ** 2


def chroma_at_luma(chroma: Float32, luma: Float32) -> Float32:
    """Chroma with as many samples as luma, by a guided filter (He, Sun and Tang 2013): a·luma and
    what that leaves of the samples, a = cov(chroma, luma) / var(luma) around.

    Args:
        chroma: (h, w), with samples on every second of luma's columns and between its rows, or as
            many as luma along either.
        luma: (H, W), from 0 to 1.

    Returns:
        (H, W) float32.
    """
    if chroma.shape == luma.shape:
        return chroma
    here = _at_chroma(luma, chroma.shape)
    mean_luma, mean_chroma = _mean(here), _mean(chroma)
    together = _mean(here * chroma) - mean_luma * mean_chroma
    slope = together / (_mean(here * here) - mean_luma**2 + np.float32(_FLAT))
    slope = _mean(slope)
    slope_there, rest = (_stretched(part, luma.shape) for part in (slope, chroma - slope * here))
    return slope_there * luma + rest


def _mean(values: Float32) -> Float32:
    return np.asarray(cv2.blur(values, _AROUND), np.float32)


def _at_chroma(luma: Float32, shape: tuple[int, ...]) -> Float32:
    """Luma where chroma's samples lie."""
    height, width = shape
    here = luma
    if luma.shape[0] != height:
        even = np.pad(here, ((0, 2 * height - len(here)), (0, 0)), mode="edge")
        here = np.asarray((even[::2] + even[1::2]) / 2, np.float32)
    if luma.shape[1] != width:
        beside = np.pad(here, ((0, 0), (1, 1)), mode="edge")
        here = np.asarray((beside[:, :-2] + 2 * here + beside[:, 2:])[:, ::2] / 4, np.float32)
    return np.ascontiguousarray(here)


def _stretched(chroma: Float32, shape: tuple[int, ...]) -> Float32:
    """Linearly between the samples."""
    height, width = shape
    if chroma.shape[1] != width:
        wide = np.repeat(chroma, 2, axis=1)
        wide[:, 1:-1:2] = (chroma[:, :-1] + chroma[:, 1:]) / 2
        chroma = wide[:, :width]
    if chroma.shape[0] != height:
        double = (chroma.shape[1], 2 * chroma.shape[0])
        tall = cv2.resize(np.ascontiguousarray(chroma), double, interpolation=cv2.INTER_LINEAR)
        chroma = np.asarray(tall, np.float32)[:height]
    return chroma
