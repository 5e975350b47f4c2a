"""Shadow plates where the shadow never fell in full.

On a plane under one key light S/L is nearly the same everywhere. It is measured where the shadow
fell in full, and serves, in proportion to the lack of evidence, where it didn't: at the rim of the
region that a shadow swept, where only its penumbra passed.

A partial shadow and a surface with another S/L (steeper, glossier) are both brighter than expected.
They are told apart by their shape: at a rim S/L climbs from full shadow to none within the width of
a penumbra, on a surface it is level.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.filling import fill_membrane

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Frames that a pixel's shadow value must rest on to tell what the ratio is.
_FIRM = 3
# The ratio is averaged on a grid of every so many pixels.
_COARSE = 4
# Log ratios further than this from the common one belong to another surface or to a penumbra.
_COMMON = 0.45
# The slope of log(S/L), per pixel, at which a partial shadow is as likely as a surface.
_SLOPE = 0.05
# A shadow that reached more than this part of a picture was cast to reach all of it.
_MOST = 0.6
# Within this many times the materials' spread a measured ratio is the plane's.
_ALIKE = 2.5
# How far S/L of one plane's materials lies from their common one, as a part; at least.
_LEAST_SPREAD = 0.03


def shadow_ratio_field(
    lit: Float32, shadow: Float32, frames: NDArray[np.uint32], plane: Bool | None
) -> tuple[Float32, float] | None:
    """The smoothly varying S/L of the scene's main plane, and how far materials scatter about it.

    Args:
        lit, shadow: (H, W, 3), NaN unknown.
        frames: (H, W), how many frames the shadow rests on.
        plane: (H, W), where to look; None for everywhere.

    Returns:
        (H, W, 3) float32 and the spread of log ratios; None if nothing was shaded in full.
    """
    gray = _log_ratio(lit.sum(axis=-1), shadow.sum(axis=-1))
    firm = (frames >= _FIRM) & np.isfinite(gray)
    if plane is not None:
        firm &= plane
    # What climbs is a penumbra, however long it stood there.
    level = _opened(firm & (_slope(gray) < _SLOPE))
    if level.sum() < 50:
        return None
    common = _mode(gray[level])
    members = level & (np.abs(gray - common) < _COMMON)
    ratio = _log_ratio(lit, shadow)
    field = _smooth(ratio, members)
    members &= np.abs(gray - field.mean(axis=-1)) < _COMMON / 2
    if members.sum() < 50:
        return None
    field = _smooth(ratio, members)
    scatter = np.abs(gray - field.mean(axis=-1))[members]
    spread = max(float(np.median(scatter)) / 0.6745, _LEAST_SPREAD)
    return np.exp(field), spread


@dataclass(frozen=True)
class Completed:
    """A shadow plate without gaps.

    Attributes:
        shadow: (H, W, 3) float32; equal to the lit plate where there is nothing to go by.
        own: (H, W) float32, how much of each pixel is its own evidence, 0 to 1.
        partial: whether the take was read as that of a plane which a shadow covered in part.
    """

    shadow: Float32
    own: Float32
    partial: bool


def complete_shadow(
    lit: Float32,
    shadow: Float32,
    frames: NDArray[np.uint32],
    noise: Float32,
    plane: Bool | None = None,
) -> Completed:
    """The shadow plate with S/L of the plane where the shadow itself says too little.

    A take in which the shadow reached most of the picture is that of a waved card: what it never
    darkened is in shade of its own, and what it darkened for several frames is as dark as it gets.
    Else it is that of a plane which a shadow crossed: what is brighter than the plane's shadow was
    shaded in part, and what was never darkened would be as dark as the rest.

    Args:
        lit, shadow: (H, W, 3) float32, shadow NaN where the pixel was never darkened.
        frames: (H, W), how many frames the shadow rests on.
        noise: (H, W, 3), standard deviation of one frame's noise at ``shadow``.
        plane: (H, W) the region of the plane, if it is known: the second reading holds there, the
            first elsewhere.
    """
    dark = np.asarray(np.isfinite(shadow).all(axis=-1))
    measured = np.asarray(np.where(dark[..., None], shadow, lit), np.float32)
    firm = frames >= _FIRM
    seen = np.isfinite(lit).all(axis=-1)
    if plane is None:
        partial = bool((firm & seen).sum() < _MOST * max(int(seen.sum()), 1))
        region = np.full(dark.shape, partial)
    else:
        partial, region = True, plane
    found = shadow_ratio_field(lit, shadow, frames, plane)
    if found is None:
        return Completed(measured, np.asarray(dark, np.float32), partial=False)
    field, spread = found
    gray = _log_ratio(lit.sum(axis=-1), shadow.sum(axis=-1))
    excess = np.nan_to_num(gray - np.log(field.mean(axis=-1)), nan=np.inf)
    alike = np.asarray(np.abs(excess) < _ALIKE * spread)
    brighter, darker = excess >= _ALIKE * spread, excess <= -_ALIKE * spread
    # On the plane only what is level over some area can be a surface of its own.
    surface = _opened(dark & firm & (_slope(np.where(dark, gray, np.float32(0))) < _SLOPE))
    own = dark.astype(np.float32)
    few = region & dark & darker
    own[few] = np.minimum(frames[few] / np.float32(_FIRM), 1)
    own[region & brighter & ~surface] = 0
    result = measured.copy()
    # Few frames say less of the shadow than the plane's ratio does, where the two may be the same.
    both = alike & region & (own > 0)
    expected = field[both] * lit[both]
    precision = frames[both][:, None] / np.maximum(noise[both], 1e-6) ** 2
    prior = 1 / np.maximum(spread * expected, 1e-6) ** 2
    result[both] = (precision * measured[both] + prior * expected) / (precision + prior)
    lacking = (own < 1) & (dark | region)
    weight = own[lacking][:, None]
    result[lacking] = weight * result[lacking] + (1 - weight) * field[lacking] * lit[lacking]
    return Completed(result, np.asarray(own, np.float32), partial)


def _opened(mask: Bool) -> Bool:
    """A mask without what is narrower than a few pixels: noise that looks like a shadow."""
    small = np.ones((5, 5), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, small) > 0)


def _log_ratio(lit: Float32, shadow: Float32) -> Float32:
    """log(S/L), NaN where either is unknown."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.maximum(shadow, np.float32(1e-5)) / np.maximum(lit, np.float32(1e-5))
        return np.asarray(np.log(ratio), np.float32)


def _slope(gray: Float32) -> Float32:
    """Length of the gradient of a smoothed log ratio, per pixel; unknown pixels count as 0,
    which is no shadow at all."""
    known = np.isfinite(gray)
    smooth = cv2.medianBlur(np.where(known, gray, np.float32(0)), 5)
    smooth = cv2.GaussianBlur(smooth, (0, 0), 1.5)
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0) / 8
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1) / 8
    return np.asarray(np.hypot(x, y), np.float32)


def _mode(values: Float32) -> float:
    """The most frequent value."""
    counts, edges = np.histogram(values, bins=120, range=(-6.0, 0.5))
    smooth = np.convolve(counts, [1, 2, 3, 2, 1], mode="same")
    peak = int(np.argmax(smooth))
    return float((edges[peak] + edges[peak + 1]) / 2)


def _smooth(ratio: Float32, members: Bool) -> Float32:
    """The members' log ratios, averaged over an eighth of the picture, continued everywhere."""
    height, width = members.shape
    # Something this smooth needs no full resolution.
    small = (max(width // _COARSE, 1), max(height // _COARSE, 1))
    values = np.where(members[..., None], ratio, np.float32(0))
    weight = cv2.resize(members.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    total = cv2.resize(values, small, interpolation=cv2.INTER_AREA)
    sigma = max(small) / 16
    blurred = np.asarray(cv2.GaussianBlur(weight, (0, 0), sigma), np.float32)
    sums = np.asarray(cv2.GaussianBlur(total, (0, 0), sigma), np.float32)
    sums = sums.reshape(*blurred.shape, 3)
    mean = sums / np.maximum(blurred, np.float32(1e-9))[..., None]
    firm = blurred > min(0.02, float(blurred.max()))
    firm |= blurred >= blurred.max()
    filled = fill_membrane(np.asarray(mean, np.float32), firm.astype(np.float32))
    wide = cv2.resize(filled, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, np.float32).reshape(height, width, 3)
