"""What a locked-off camera can see of the background: the line from S to L, and a little below S.

A figure takes some of the sky from ground that is near to it, so of S some may be missing at any β.
β is carried on below 0: there the background is (1 + β)S, and S may be only guessed.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.noise import NoiseModel
from shadowtool.core.regions import opened

Float32 = NDArray[np.float32]
Places = tuple[slice, ...] | tuple[NDArray[np.intp], ...]

# How much of S may be missing near to what stands on it.
_DEEPEST = 0.5
# So far from all shade, as a part of the picture's longer side, and where there is light, hardly
# more than a part is missing, a standard deviation.
_FROM_SHADE, _HARDLY = 1 / 30, 0.12
# What is narrower, pixels, is no shade but noise.
_SPECKS = 5
# How exact plates are, as a part of their value.
_TOLERANCE = 0.01


class Nearest(NamedTuple):
    """The background that is likest to a pixel.

    Attributes:
        beta: (H, W) float32, from -0.5 to 1; above 0 as if nothing of the sky were missing.
        distance2: (H, W) float32 ≥ 0, squared distance from it in standard deviations, of which
            how much is missing is one.
        from_lit2: (H, W) float32 ≥ 0, the same from L alone.
    """

    beta: Float32
    distance2: Float32
    from_lit2: Float32


def missing_shade(shadow_frames: NDArray[np.uint32]) -> Float32:
    """How much of S is usually missing, a standard deviation as a part of it, (H, W).

    Near to where a shadow fell there stood what casts it, and takes some of the sky from the
    ground; infinite there. Where none ever was what is darker than S is no ground.

    Args:
        shadow_frames: (H, W), how many frames S rests on.
    """
    shaded = opened(shadow_frames > 0, _SPECKS).view(np.uint8)
    away = cv2.distanceTransform(1 - shaded, cv2.DIST_L2, cv2.DIST_MASK_5)
    far = away > _FROM_SHADE * max(shaded.shape)
    return np.where(far, np.float32(_HARDLY), np.float32(np.inf))


@dataclass(frozen=True)
class Backdrop:
    """The scene without the figure.

    Attributes:
        lit, shadow: (H, W, 3) float32, linear light, without NaN; or any pixels of it, (..., 3).
        noise: the take's.
        doubt: (H, W) float32, by how much S may be off besides, as a part of it.
        missing: (H, W) float32, of `missing_shade`; None for as much as can be.
    """

    lit: Float32
    shadow: Float32
    noise: NoiseModel
    doubt: Float32
    missing: Float32 | None = None

    def at(self, places: Places) -> "Backdrop":
        """Some of its pixels, by their rows and columns."""
        missing = None if self.missing is None else self.missing[places]
        own = self.lit[places], self.shadow[places], self.noise, self.doubt[places]
        return Backdrop(*own, missing)

    def under(self, beta: Float32) -> Float32:
        """What is seen under β, (..., 3); below 0 what is darker than S."""
        lighter, deeper = np.maximum(beta, 0)[..., np.newaxis], np.minimum(beta, 0)[..., np.newaxis]
        seen = lighter * self.lit + (1 + deeper - lighter) * self.shadow
        return np.asarray(seen, np.float32)

    def variance(self, image: Float32) -> Float32:
        """Of what is seen of the background at these values, (..., 3): the noise's and the plates'
        own."""
        return self.noise.variance(image) + self.own_variance(image)

    def own_variance(self, image: Float32) -> Float32:
        """Of the plates at these values, (..., 3)."""
        value = np.maximum(image, 0)
        doubtful = self.doubt[..., np.newaxis] * np.minimum(value, self.shadow)
        return np.asarray((np.float32(_TOLERANCE) * value) ** 2 + doubtful**2, np.float32)

    def from_lit2(self, image: Float32) -> Float32:
        """Squared distance from L in standard deviations, (H, W)."""
        total = np.zeros(image.shape[:2], np.float32)
        for rows in bands(image.shape):
            for channel in range(3):
                # What lies apart in memory is slow.
                value, lit = (
                    np.ascontiguousarray(colours[rows, ..., channel])
                    for colours in (image, self.lit)
                )
                off = value - lit
                off *= off
                np.maximum(value, 0, out=value)
                variance = self.noise.channel_variance(value, channel)
                value *= value
                value *= np.float32(_TOLERANCE**2)
                variance += value
                off /= variance
                total[rows] += off
        return total

    def nearest(self, image: Float32) -> Nearest:
        """The background that is likest to each pixel of a frame (H, W, 3)."""
        result = Nearest(*(np.empty(image.shape[:2], np.float32) for _ in Nearest._fields))
        for rows in bands(image.shape):
            found = self.at((rows,))._nearest(image[rows])
            for whole, part in zip(result, found, strict=True):
                whole[rows] = part
        return result

    def _nearest(self, image: Float32) -> Nearest:
        shape = image.shape[:2]
        square, from_lit2 = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        dots = np.zeros((2, *shape), np.float32)
        lengths = np.full((2, *shape), 1e-9, np.float32)
        across = np.zeros(shape, np.float32)
        # By channel: sums over an axis of three are slow, and so is what lies apart in memory.
        for channel in range(3):
            value, lit, shadow = (
                np.ascontiguousarray(colours[..., channel])
                for colours in (image, self.lit, self.shadow)
            )
            above, span = value - shadow, lit - shadow
            np.maximum(value, 0, out=value)
            own = (np.float32(_TOLERANCE) * value) ** 2
            own += (self.doubt * np.minimum(value, shadow)) ** 2
            weight = 1 / (self.noise.channel_variance(value, channel) + own)
            square += weight * above**2
            from_lit2 += weight * (above - span) ** 2
            for direction, dot, length in zip((span, shadow), dots, lengths, strict=True):
                dot += weight * direction * above
                length += weight * direction**2
            across += weight * span * shadow
        of_span, of_shadow = dots
        along, dark = lengths
        # As one more measurement, that nothing of the sky is missing.
        held = dark + np.float32(1 / _HARDLY**2)
        missing = across * of_span - along * of_shadow
        missing /= np.maximum(along * held - across**2, np.float32(1e-9))
        np.clip(missing, 0, _DEEPEST, out=missing)
        lit = np.clip((of_span + missing * across) / along, 0, 1)
        # Where one of them is at its end the other is what goes with that.
        missing = np.clip((lit * across - of_shadow) / held, 0, _DEEPEST)
        off_between = square - lit * (2 * (of_span + missing * across) - lit * along)
        off_between += missing * (2 * of_shadow + missing * held)
        between = np.clip(of_span / along, 0, 1)
        if self.missing is not None:
            dark = dark + 1 / self.missing**2
        below = np.clip(of_shadow / dark, -_DEEPEST, 0)
        off_below = square - below * (2 * of_shadow - below * dark)
        deeper = off_below < off_between
        return Nearest(
            np.where(deeper, below, between),
            np.maximum(np.where(deeper, off_below, off_between), 0),
            from_lit2,
        )
