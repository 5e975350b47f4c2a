"""The shadow matte β: how much of the key light reaches each pixel (section 2)."""

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Fill
from shadowtool.core.bands import bands
from shadowtool.core.filling import fill_membrane
from shadowtool.core.half_floats import to_float
from shadowtool.core.noise import NoiseModel, extreme_range
from shadowtool.core.plates import Plates

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# A hole of more than this part of the frame is no hole but a region that the shadow never reached.
_LARGEST_HOLE = 0.005
# Below this many standard deviations between L and S, β would be off by more than 0.1.
_LEAST_CONTRAST = 10.0
_WINDOW = 5
_ONES = np.ones((1, 3), np.float32)
# Half the contrast's reciprocal more noise in full light, and so many deviations to be sure.
_LIT_NOISE, _SURE = 0.7, 3.0


def shadow_matte(image: NDArray[np.floating], lit: Float32, shadow: Float32) -> Float32:
    """Visibility of the key light by projection onto the line from S to L.

    Eq. (5) of Chuang et al. 2003: β = (C - S)·(L - S) / ‖L - S‖².

    Args:
        image, lit, shadow: (H, W, 3), linear light.

    Returns:
        (H, W) float32, not clipped; NaN where L = S in all channels or anything is NaN.
    """
    beta = np.empty(lit.shape[:2], np.float32)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for rows in bands(beta.shape):
            span = lit[rows] - shadow[rows]
            above = to_float(image[rows]) - shadow[rows]
            above *= span
            span *= span
            projection, length = _sum(above), _sum(span)
            np.divide(projection, length, out=beta[rows])
            beta[rows][~((length > 0) & np.isfinite(projection))] = np.nan
    return beta


def _sum(image: Float32) -> Float32:
    """The sum of three channels, (H, W)."""
    return np.asarray(cv2.transform(image, _ONES), np.float32)


def coloured_matte(image: NDArray[np.floating], lit: Float32, shadow: Float32) -> Float32:
    """Visibility of the key light in each channel: β = (C - S) / (L - S), for coloured glass and
    caustics (section 7 of the paper).

    Args:
        image, lit, shadow: (H, W, 3), linear light.

    Returns:
        (H, W, 3) float32, not clipped; NaN where L = S in the channel or anything is NaN.
    """
    beta = np.empty(lit.shape, np.float32)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for rows in bands(beta.shape):
            above = to_float(image[rows]) - shadow[rows]
            np.divide(above, lit[rows] - shadow[rows], out=beta[rows])
            beta[rows][~np.isfinite(beta[rows])] = np.nan
    return beta


def channel_contrast(plates: Plates, noise: NoiseModel) -> Float32:
    """`shadow_contrast` for each channel by itself, (H, W, 3) float32 ≥ 0."""
    sigma = noise.sigma((plates.lit + plates.shadow) / 2)
    return np.asarray(np.maximum(plates.lit - plates.shadow, 0) / sigma, np.float32)


def shadow_contrast(plates: Plates, noise: NoiseModel) -> Float32:
    """How far L and S lie apart, in standard deviations of the noise that β sees there.

    1 / contrast is the standard error of Eq. (5)'s β from noise in C at mid shadow: the noise
    projected onto the line, over the line's length.

    Returns:
        (H, W) float32 ≥ 0; NaN where a plate is.
    """
    contrast = np.empty(plates.lit.shape[:2], np.float32)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for rows in bands(contrast.shape):
            lit, shadow = plates.lit[rows], plates.shadow[rows]
            span = lit - shadow
            sigma = noise.sigma((lit + shadow) / 2)
            sigma *= span
            sigma *= sigma
            span *= span
            length = _sum(span)
            np.divide(length, np.sqrt(_sum(sigma)), out=contrast[rows])
            contrast[rows][length == 0] = 0
    return contrast


def unknown_beta(contrast: Float32, frames: NDArray[np.uint32] | None) -> Bool:
    """Where L and S do not differ by more than the noise, so that β can't be known.

    Args:
        contrast: (H, W) from `shadow_contrast`.
        frames: (H, W), how many frames the extremes were taken of; None for plates without noise
            of their own.

    Returns:
        (H, W) bool, true where the contrast is NaN too.
    """
    if frames is None:
        return ~(contrast > _LEAST_CONTRAST)
    # Each channel has extremes of its own, and the contrast is the root of the sum of squares.
    least = np.maximum(np.sqrt(np.float32(3)) * extreme_range(frames), _LEAST_CONTRAST)
    return np.asarray(~(contrast > least))


def without_noise(beta: Float32, contrast: Float32) -> Float32:
    """β cleared of noise as far as the picture around it allows; exactly 1 where it is lit.

    A Wiener filter over a small window: what a pixel's neighbours scatter beyond their noise is
    structure, an edge or a penumbra, and stays; what the noise explains goes. Where neither the
    pixel nor the window's mean differs from 1 by more than their noise, β is 1.

    Args:
        beta: (H, W) float32, not clipped; NaN unknown, which takes no part.
        contrast: (H, W), 1 over the standard error of each pixel's β.

    Returns:
        (H, W) float32 with the same NaN; within the range of what went in.
    """
    result = np.empty_like(beta)
    reach = _WINDOW // 2
    height = beta.shape[0]
    for rows in bands(beta.shape, channels=1):
        above, below = min(rows.start, reach), min(height - rows.stop, reach)
        taken = slice(rows.start - above, rows.stop + below)
        cleared = _without_noise(beta[taken], contrast[taken])
        result[rows] = cleared[above : cleared.shape[0] - below]
    return result


def _without_noise(beta: Float32, contrast: Float32) -> Float32:
    """`without_noise` of a few rows, right but for what lies beyond them."""
    known = np.isfinite(beta) & np.isfinite(contrast) & (contrast > 0)
    # In the light the noise is larger than half-way, for which the contrast stands.
    unknown = ~known
    deviations = contrast * np.float32(_LIT_NOISE)
    deviations[unknown] = 0
    weight = deviations * deviations
    values = beta.copy()
    values[unknown] = 1
    total = _window_sum(weight)
    safe = np.maximum(total, np.float32(1e-12))
    weighted = weight * values
    mean = _window_sum(weighted)
    mean /= safe
    weighted *= values
    scatter = _window_sum(weighted)
    scatter /= safe
    scatter -= mean * mean
    noise = _window_sum(known.astype(np.float32))
    noise /= safe
    structure = np.maximum(scatter, 0) - noise
    np.maximum(structure, 0, out=structure)
    keep = structure / (structure + 1 / np.maximum(weight, np.float32(1e-12)))
    keep *= values - mean
    keep += mean
    lit = np.abs(1 - mean) * np.sqrt(total) < _SURE
    lit &= np.abs(1 - values) * deviations < _SURE + 1
    lit &= structure < noise * np.float32(_WINDOW**2)
    keep[lit] = 1
    np.copyto(keep, beta, where=unknown)
    return np.asarray(keep, np.float32)


def _window_sum(image: Float32) -> Float32:
    """The sum over the window around each pixel, (H, W)."""
    box = (_WINDOW, _WINDOW)
    total = cv2.boxFilter(image, -1, box, normalize=False, borderType=cv2.BORDER_REFLECT)
    return np.asarray(total, np.float32)


def fill_beta(beta: Float32, never_reached: Bool, hidden: Bool, fill: Fill) -> Float32:
    """Give unknown pixels a value.

    With ``lit`` they become 1. With ``inpaint`` small unknown patches and what the figure hides
    are continued from around them, and large regions that the shadow never
    reached in the whole take become 1: nothing there is in shadow in this frame either. With
    ``none`` they stay NaN.

    Args:
        beta: (H, W) float32 in [0, 1] or NaN.
        never_reached: (H, W), from `without_holes`.
        hidden: (H, W), the figure is in front.

    Returns:
        (H, W) float32, a new array.
    """
    filled = beta.copy()
    if fill == "none":
        return filled
    if fill == "lit":
        filled[np.isnan(filled)] = 1
        return filled
    filled[never_reached] = 1
    # A pixel that was never shaded is no source to continue a shadow from only where it is itself
    # unknown; where it was set to 1 above it is as good as measured.
    filled[hidden] = np.nan
    return inpaint(filled)


def inpaint(image: Float32) -> Float32:
    """Continue an image smoothly into its NaN pixels; all 1 if nothing is known.

    Args:
        image: (H, W) float32.

    Returns:
        (H, W) float32 without NaN, known pixels unchanged.
    """
    known = np.isfinite(image)
    if known.all():
        return image
    if not known.any():
        return np.ones_like(image)
    values = image.copy()
    values[~known] = 0
    return fill_membrane(values[..., np.newaxis], known.astype(np.float32))[..., 0]


def without_holes(never_shaded: Bool) -> Bool:
    """Of the pixels, (H, W), without a difference between L and S the large connected regions,
    which the shadow never reached in the whole take."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        never_shaded.astype(np.uint8), connectivity=8
    )
    large = stats[:, cv2.CC_STAT_AREA] > _LARGEST_HOLE * never_shaded.size
    large[0] = False
    return np.asarray(large[labels])
