"""The shadow matte β: how much of the key light reaches each pixel (section 2)."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Beta, Fill
from shadowtool.core.bands import bands, channel_sum, in_all_channels, overlapping_bands
from shadowtool.core.boxes import Box, around
from shadowtool.core.exposure import Gains, is_one, of_rows, without_gain
from shadowtool.core.filling import fill_membrane
from shadowtool.core.half_floats import to_float, to_half
from shadowtool.core.noise import NoiseModel, extreme_range
from shadowtool.core.plates import Plates
from shadowtool.core.regions import grown, large_parts

Float16 = NDArray[np.float16]
Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# A hole of more than this part of the frame is no hole but a region that the shadow never reached.
_LARGEST_HOLE = 0.005
# Between these parts of the way from the darkest to the lightest around the figure, β continued
# behind it is a penumbra; where these differ by more than the next, and where penumbrae that are so
# near, pixels, are narrower than the figure by this factor; of twice that it is one altogether.
_PENUMBRA, _EVEN, _NEARBY, _NARROWER = (0.2, 0.6), 0.1, 12, 2.0
# Below this many standard deviations between L and S, β would be off by more than 0.1.
_LEAST_CONTRAST = 10.0
_WINDOW = 5
_BOX = np.ones(_WINDOW, np.float32)
# What is unknown is continued from what is this near, pixels.
_RING = 2
# So many pixels at a time stay in the processor's cache with all that is made of them.
_PIXELS = 1 << 17
# Half the contrast's reciprocal more noise in full light, and so many deviations to be sure.
_LIT_NOISE, _SURE = 0.7, 3.0


def inverse_span(lit: Float32, shadow: Float32, beta: Beta = "scalar") -> Float32:
    """What C - S is multiplied by to give β, the same for every frame.

    The vector (L - S) / ‖L - S‖² of Eq. (5), whose product with C - S is summed over the channels;
    with ``rgb`` 1 / (L - S) in each, for coloured glass and caustics (section 7 of the paper).

    Args:
        lit, shadow: (H, W, 3) float32, linear light.

    Returns:
        (H, W, 3) float32; NaN where L = S, in all channels or in the one, or a plate is NaN.
    """
    inverse = np.empty_like(lit)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for rows in bands(lit.shape):
            span = lit[rows] - shadow[rows]
            if beta == "rgb":
                np.divide(1, span, out=inverse[rows])
            else:
                np.divide(span, in_all_channels(channel_sum(span * span)), out=inverse[rows])
            inverse[rows][~np.isfinite(inverse[rows])] = np.nan
    return inverse


def shadow_matte(
    image: NDArray[np.floating], shadow: Float32, inverse: Float32, beta: Beta = "scalar"
) -> Float32:
    """Visibility of the key light by projection onto the line from S to L.

    Eq. (5) of Chuang et al. 2003: β = (C - S)·(L - S) / ‖L - S‖².

    Args:
        image, shadow: (H, W, 3), linear light.
        inverse: (H, W, 3) float32, from `inverse_span`.

    Returns:
        (H, W) float32, with ``rgb`` (H, W, 3), not clipped; NaN or infinite where anything is.
    """
    result = np.empty(shadow.shape[: 2 if beta == "scalar" else 3], np.float32)
    with np.errstate(invalid="ignore", over="ignore"):
        for rows in bands(shadow.shape):
            # Halfs are converted on the way.
            above = np.asarray(
                cv2.subtract(image[rows], shadow[rows], dtype=cv2.CV_32F), np.float32
            )
            above *= inverse[rows]
            result[rows] = channel_sum(above) if beta == "scalar" else above
    return result


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
            span *= span
            length = channel_sum(span)
            span *= noise.variance((lit + shadow) / 2)
            np.divide(length, np.sqrt(channel_sum(span)), out=contrast[rows])
            contrast[rows][length == 0] = 0
    return contrast


def never_shaded(contrast: Float32, frames: NDArray[np.uint32] | None) -> Bool:
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


def confidence(contrast: Float32) -> Float16:
    """How far β can be relied on: 1 minus its standard error.

    Args:
        contrast: (H, W), from `shadow_contrast`.

    Returns:
        (H, W) float16 in [0, 1]; 0 where the contrast is NaN.
    """
    result = np.empty(contrast.shape, np.float16)
    for rows in bands(contrast.shape, channels=1):
        error = 1 / np.fmax(contrast[rows], np.float32(1e-6))
        result[rows] = to_half(np.maximum(1 - error, 0))
    return result


def weight_of(contrast: Float32) -> Float32:
    """What a pixel counts by in `without_noise`: the reciprocal of β's variance in full light.

    Args:
        contrast: (H, W), 1 over the standard error of β half-way between light and shadow.

    Returns:
        (H, W) float32 ≥ 0; 0 where the contrast is NaN.
    """
    deviations = np.fmax(contrast, 0) * np.float32(_LIT_NOISE)
    return np.asarray(deviations * deviations, np.float32)


def without_noise(beta: Float32, weight: Float32) -> Float32:
    """β cleared of noise as far as the picture around it allows; exactly 1 where it is lit.

    A Wiener filter over a small window: what a pixel's neighbours scatter beyond their noise is
    structure, an edge or a penumbra, and stays; what the noise explains goes. Where neither the
    pixel nor the window's mean differs from 1 by more than their noise, β is 1.

    Args:
        beta: (H, W) float32, not clipped; unknown where it is not finite, which takes no part.
        weight: (H, W) float32 ≥ 0, the reciprocal of each pixel's variance in full light; where it
            is 0 the pixel takes no part and is left as it is.

    Returns:
        (H, W) float32, NaN where β is unknown; within the range of what went in.
    """
    # From 1: in the light there is least to be rounded away.
    off = beta - np.float32(1)
    known = np.isfinite(off)
    known &= weight > 0
    all_known = bool(known.all())
    count: Float32 | np.float32 = np.float32(_WINDOW**2)
    if not all_known:
        np.copyto(off, 0, where=~known)
        weight = weight * known
        count = _window_sum(known.astype(np.float32))
    total = _window_sum(weight)
    total += np.float32(1e-12)
    weighted = weight * off
    mean = _window_sum(weighted)
    # Squares in units of their variance: of the pixel, the window's mean, and what is left.
    weighted *= off
    scatter = _window_sum(weighted)
    shaded = weighted >= np.float32((_SURE + 1) ** 2)
    square = np.multiply(mean, mean, out=weighted)
    square /= total
    mean /= total
    shaded |= square >= np.float32(_SURE**2)
    scatter -= square
    scatter -= count
    shaded |= scatter >= np.float32(_WINDOW**2) * count
    # Of the pixel's own value is kept structure / (structure + noise).
    np.maximum(scatter, 0, out=scatter)
    scatter *= weight
    total += scatter
    scatter /= total
    off -= mean
    off *= scatter
    off += mean
    off *= shaded
    off += np.float32(1)
    if not all_known:
        left = np.where(np.isfinite(beta), beta, np.float32(np.nan))
        np.copyto(off, left, where=~known)
    return off


def _window_sum(image: Float32) -> Float32:
    """The sum over the window around each pixel, (H, W); it rests on nothing beyond the window."""
    total = cv2.sepFilter2D(image, -1, _BOX, _BOX, borderType=cv2.BORDER_REFLECT)
    return np.asarray(total, np.float32)


@dataclass(frozen=True)
class Gauge:
    """What β is measured by in every frame of a take.

    Attributes:
        shadow: (H, W, 3) float32, S.
        inverse: (H, W, 3) float32, from `inverse_span`; NaN where β can't be known.
        weights: for each plane of β (H, W) float32, from `weight_of`.
    """

    shadow: Float32
    inverse: Float32
    weights: tuple[Float32, ...]

    @classmethod
    def of(cls, plates: Plates, contrasts: Sequence[Float32], unknown: Bool) -> "Gauge":
        """From the plates, β's `shadow_contrast` or that of each channel, and (H, W) where β can't
        be known."""
        kind: Beta = "scalar" if len(contrasts) == 1 else "rgb"
        inverse = inverse_span(plates.lit, plates.shadow, kind)
        inverse[unknown] = np.nan
        return cls(plates.shadow, inverse, tuple(map(weight_of, contrasts)))

    def measure(
        self,
        image: NDArray[np.floating],
        unseen: Bool,
        gain: Gains = 1.0,
        ground: tuple[Box, Float32] | None = None,
        clamp: bool = False,
    ) -> Float32:
        """β of a frame, projected and cleared of noise a few rows at a time.

        Args:
            image: (H, W, 3), linear light.
            unseen: (H, W), where the frame does not show the ground.
            gain: how much brighter than the plates the frame is, or each of its rows and
                channels.
            ground: rows and columns of a part of the frame, and what is seen of the ground there
                at gain 1, (h, w, 3).
            clamp: keep β within 0 and 1.

        Returns:
            (H, W) float32, or (H, W, 3) for a plane in each channel; NaN unknown.
        """
        kind: Beta = "scalar" if len(self.weights) == 1 else "rgb"
        result = np.empty(image.shape[: 2 if kind == "scalar" else 3], np.float32)
        height, width = image.shape[:2]
        step = max(1, _PIXELS // max(width, 1))
        for taken, own in overlapping_bands(height, _WINDOW // 2, step):
            light = image[taken]
            if not is_one(gain):
                light = without_gain(to_float(light), of_rows(gain, taken))
            beta = shadow_matte(light, self.shadow[taken], self.inverse[taken], kind)
            if ground is not None:
                self._project(beta, taken, *ground)
            beta[unseen[taken]] = np.nan
            planes = np.atleast_3d(beta)
            for channel, weight in enumerate(self.weights):
                cleared = without_noise(planes[..., channel], weight[taken])[own]
                if clamp:
                    np.clip(cleared, 0, 1, out=cleared)
                np.atleast_3d(result[taken][own])[..., channel] = cleared
        return result

    def _project(self, beta: Float32, taken: slice, box: Box, ground: Float32) -> None:
        """Put β of what is seen in a box into that of some rows."""
        rows = slice(max(box.rows.start, taken.start), min(box.rows.stop, taken.stop))
        if rows.start < rows.stop:
            part = ground[rows.start - box.rows.start : rows.stop - box.rows.start]
            place = (rows, box.columns)
            kind: Beta = "scalar" if beta.ndim == 2 else "rgb"
            found = shadow_matte(part, self.shadow[place], self.inverse[place], kind)
            beta[rows.start - taken.start : rows.stop - taken.start, box.columns] = found


def fill_beta(beta: Float32, lit: Bool, hidden: Bool, fill: Fill) -> Float32:
    """Give unknown pixels a value.

    With ``lit`` they become 1. With ``inpaint`` small unknown patches and what the figure hides
    are continued from around them, and large regions that the shadow never
    reached in the whole take become 1: nothing there is in shadow in this frame either. Behind the
    figure it is as light or as dark as around it but for a narrow penumbra, wherever that may lie:
    not the even slope that continuing alone would make. With ``none`` they stay NaN.

    Args:
        beta: (H, W) float32 in [0, 1] or NaN.
        lit: (H, W), where the shadow never reached, as of `never_reached`.
        hidden: (H, W), the figure is in front.

    Returns:
        (H, W) float32, a new array.
    """
    filled = beta.copy()
    if fill == "none":
        return filled
    if fill == "lit":
        np.copyto(filled, 1, where=np.isnan(filled))
        return filled
    np.copyto(filled, 1, where=lit)
    # A pixel that was never shaded is no source to continue a shadow from only where it is itself
    # unknown; where it was set to 1 above it is as good as measured.
    np.copyto(filled, np.nan, where=hidden)
    _inpaint(filled)
    _steepen(filled, hidden)
    return filled


def _steepen(beta: Float32, hidden: Bool) -> None:
    """Make a penumbra of the slope behind each part of the figure, in place, as far as penumbrae
    around it are narrower than the part."""
    box = around(hidden, _NEARBY)
    if box is None:
        return
    whole = beta[box]
    count, labels = cv2.connectedComponents(hidden[box].view(np.uint8))
    # How wide a penumbra is tells its steepest slope.
    seen = np.where(hidden[box], np.float32(np.nan), whole)
    across, down = (np.abs(np.diff(seen, axis=axis, prepend=np.nan)) for axis in (1, 0))
    slope = np.fmax(across, down)
    for part in range(1, count):
        own = around(labels == part, _NEARBY)
        assert own is not None
        inside = labels[own] == part
        depth = cv2.distanceTransform(np.pad(inside, 1).view(np.uint8), cv2.DIST_L2, 3)
        wide = 2 * float(depth.max())
        near, beside = grown(inside, _NEARBY), grown(inside, _RING) & ~inside
        around_it, steepest = whole[own][beside], slope[own][near]
        steepest = steepest[np.isfinite(steepest)]
        if not around_it.size or not steepest.size:
            continue
        darkest, lightest = (float(v) for v in np.quantile(around_it, (0.02, 0.98)))
        if lightest - darkest < _EVEN:
            continue
        narrow = float(steepest.max()) / (lightest - darkest) * wide
        low, high = (darkest + place * (lightest - darkest) for place in _PENUMBRA)
        place = np.clip((whole[own] - low) / np.float32(high - low), 0, 1)
        steep = darkest + (lightest - darkest) * place * place * (3 - 2 * place)
        share = np.float32(np.clip(narrow / _NARROWER - 1, 0, 1))
        steep = share * steep + (1 - share) * whole[own]
        np.copyto(whole[own], steep.astype(np.float32), where=inside > 0)


def inpaint(image: Float32) -> Float32:
    """Continue an image smoothly into its NaN pixels; all 1 if nothing is known.

    Args:
        image: (H, W) float32.

    Returns:
        (H, W) float32 without NaN, a new array; known pixels unchanged.
    """
    filled = image.copy()
    _inpaint(filled)
    return filled


def _inpaint(image: Float32) -> None:
    unknown = ~np.isfinite(image)
    box = around(unknown, _RING)
    if box is None:
        return
    hole = unknown[box]
    if hole.all():
        image[:] = 1
        return
    values = np.where(hole, np.float32(0), image[box])
    image[box] = fill_membrane(values[..., np.newaxis], (~hole).astype(np.float32))[..., 0]


def never_reached(never_shaded: Bool) -> Bool:
    """Of the pixels, (H, W), without a difference between L and S the large connected regions,
    which the shadow never reached in the whole take; small ones are holes."""
    return large_parts(never_shaded, _LARGEST_HOLE * never_shaded.size)
