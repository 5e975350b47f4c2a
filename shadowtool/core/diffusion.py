"""Smoothing the displacement map while it keeps its structure (section 4, last step).

Perona and Malik 1990, with the flow from pixels that can be trusted to pixels that can't.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.warp_map import WarpMap, identity_map

Float32 = NDArray[np.float32]


def diffuse(
    warp_map: WarpMap, iterations: int = 40, edge: float = 1.5, rate: float = 0.24
) -> WarpMap:
    """Anisotropic diffusion of the displacement W[p] - p, confidence-driven.

    A pixel takes from a neighbour by how much better the neighbour is known, and by
    exp(-(difference/edge)²). Unknown pixels are filled from around them first.

    Args:
        warp_map: W with NaN where unknown.
        iterations: steps; 0 only fills.
        edge: the difference in pixels that counts as a depth edge.
        rate: step size, at most 0.25.

    Returns:
        W without NaN, unless nothing at all is known. The predicted error stays what it was, and
        infinite where the value was filled in.
    """
    height, width = warp_map.warp.shape[:2]
    identity = identity_map(height, width)
    unknown = np.asarray(np.isnan(warp_map.warp).any(axis=-1))
    if unknown.all():
        return warp_map
    trust = np.where(unknown, np.float32(1e-3), warp_map.confidence).astype(np.float32)
    displacement = fill_by_pyramid(
        np.where(unknown[..., np.newaxis], np.float32(0), warp_map.warp - identity),
        np.where(unknown, np.float32(0), warp_map.confidence),
    )
    for _ in range(iterations):
        change = np.zeros_like(displacement)
        for axis in (0, 1):
            ahead = np.diff(displacement, axis=axis)
            conductance = np.exp(-(ahead**2).sum(axis=-1) / np.float32(edge**2))
            one, other = (trust[:-1], trust[1:]) if axis == 0 else (trust[:, :-1], trust[:, 1:])
            total = one + other
            flow_to_one = (conductance * other / total)[..., None] * ahead
            flow_to_other = (conductance * one / total)[..., None] * ahead
            if axis == 0:
                change[:-1] += flow_to_one
                change[1:] -= flow_to_other
            else:
                change[:, :-1] += flow_to_one
                change[:, 1:] -= flow_to_other
        displacement += np.float32(rate) * change
    return WarpMap(identity + displacement, np.where(unknown, np.float32(np.inf), warp_map.error))


def fill_by_pyramid(values: Float32, weight: Float32) -> Float32:
    """Fill pixels of no weight with the weighted mean of the nearest ones (pull and push).

    Args:
        values: (H, W, C) float32.
        weight: (H, W) float32 ≥ 0; pixels above 0 keep their values.

    Returns:
        (H, W, C) float32; all 0 if no pixel has any weight.
    """
    height, width = weight.shape
    known = weight > 0
    if known.all() or min(height, width) <= 1:
        if known.any():
            mean = (values * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
            return np.where(known[..., None], values, mean).astype(np.float32)
        return np.zeros_like(values)
    half = ((width + 1) // 2, (height + 1) // 2)
    small_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    small_sum = cv2.resize(values * weight[..., None], half, interpolation=cv2.INTER_AREA)
    small_sum = small_sum.reshape(half[1], half[0], -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        small = np.where(
            small_weight[..., None] > 0, small_sum / small_weight[..., None], np.float32(0)
        ).astype(np.float32)
    small = fill_by_pyramid(small, np.asarray(small_weight, np.float32))
    large = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], values, large.reshape(values.shape)).astype(np.float32)
