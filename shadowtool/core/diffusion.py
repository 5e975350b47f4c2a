"""Smoothing the displacement map while it keeps its structure (section 4, last step).

Perona and Malik 1990, with the flow from pixels that can be trusted to pixels that can't.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import overlapping_bands
from shadowtool.core.filling import fill_membrane
from shadowtool.core.warp_map import WarpMap, identity_map

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# What is unknown up to the frame's edge is connected by more than this width, pixels.
_NARROW = 5


def diffuse(
    warp_map: WarpMap,
    iterations: int = 40,
    edge: float = 1.5,
    rate: float = 0.24,
    plane_beyond: bool = False,
) -> WarpMap:
    """Anisotropic diffusion of the displacement W[p] - p, confidence-driven.

    A pixel takes from a neighbour by how much better the neighbour is known, and by
    exp(-(difference/edge)²). Unknown pixels are filled from around them first.

    Args:
        warp_map: W with NaN where unknown.
        iterations: steps; 0 only fills.
        edge: the difference in pixels that counts as a depth edge.
        rate: step size, at most 0.25.
        plane_beyond: take what is unknown up to the frame's edge, where no sweep went, for the
            reference plane, whose displacement is 0; otherwise it goes on as what is next to it.

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
    weight = np.where(unknown, np.float32(0), warp_map.confidence)
    if plane_beyond:
        weight[_open_to_the_edge(unknown)] = 1
    displacement = fill_membrane(
        np.where(unknown[..., np.newaxis], np.float32(0), warp_map.warp - identity), weight
    )
    smooth = np.empty_like(displacement)
    for rows, inner in overlapping_bands(height, iterations):
        smooth[rows][inner] = _diffused(displacement[rows], trust[rows], iterations, edge, rate)[
            inner
        ]
    smooth += identity
    return WarpMap(smooth, np.where(unknown, np.float32(np.inf), warp_map.error))


def _open_to_the_edge(unknown: Bool) -> Bool:
    """The unknown parts that the frame's edge cuts off."""
    size = np.ones((_NARROW, _NARROW), np.uint8)
    inner = slice(_NARROW, -_NARROW)
    # The picture goes on as it ends.
    around = np.pad(unknown.view(np.uint8), _NARROW, mode="edge")
    wide = np.asarray(cv2.morphologyEx(around, cv2.MORPH_OPEN, size), np.uint8)
    count, labels = cv2.connectedComponents(wide, connectivity=4)
    own = labels[inner, inner]
    cut = np.zeros(count, bool)
    for edge in (own[0], own[-1], own[:, 0], own[:, -1]):
        cut[edge] = True
    cut[0] = False
    reached = cv2.dilate(cut[labels].view(np.uint8), size)[inner, inner]
    return np.asarray((reached > 0) & unknown)


def _diffused(
    displacement: Float32, trust: Float32, iterations: int, edge: float, rate: float
) -> Float32:
    """Rows of the displacement, right but for as many at the ends as there are iterations."""
    displacement = displacement.copy()
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
    return displacement
