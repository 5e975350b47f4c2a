"""What a locked-off camera can see of the background: the line from S to L, and a little below S.

β is carried on below 0: there the background is (1 + β)S, ground that a figure near to it takes
some of the sky from, or whose S is only guessed.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.noise import NoiseModel

Float32 = NDArray[np.float32]

# How much of S may be missing near to what stands on it.
_DEEPEST = 0.5
# How exact plates are, as a part of their value.
_TOLERANCE = 0.01


class Nearest(NamedTuple):
    """The background that is likest to a pixel.

    Attributes:
        beta: (H, W) float32, from -0.5 to 1.
        distance2: (H, W) float32 ≥ 0, squared distance from it in standard deviations.
        from_lit2: (H, W) float32 ≥ 0, the same from L alone.
    """

    beta: Float32
    distance2: Float32
    from_lit2: Float32


@dataclass(frozen=True)
class Backdrop:
    """The scene without the figure.

    Attributes:
        lit, shadow: (H, W, 3) float32, linear light, without NaN.
        noise: the take's.
    """

    lit: Float32
    shadow: Float32
    noise: NoiseModel

    def part(self, box: tuple[slice, slice]) -> "Backdrop":
        """The rows and columns of a box."""
        return Backdrop(self.lit[box], self.shadow[box], self.noise)

    def under(self, beta: Float32) -> Float32:
        """What is seen under β, (H, W, 3); below 0 what is darker than S."""
        part = beta[..., np.newaxis]
        return np.where(
            part >= 0, self.shadow + part * (self.lit - self.shadow), self.shadow * (1 + part)
        )

    def variance(self, image: Float32) -> Float32:
        """Of what is seen of the background at these values, (..., 3): the noise's and the plates'
        own."""
        return self.noise_variance(image) + self.own_variance(image)

    def noise_variance(self, image: Float32) -> Float32:
        """Of the noise at these values, (..., 3)."""
        slope, floor = self.noise.slope, self.noise.floor
        return np.asarray(np.maximum(image, 0) * np.float32(slope) + np.float32(floor), np.float32)

    def own_variance(self, image: Float32) -> Float32:
        """Of plates at these values, (..., 3)."""
        return np.asarray((np.float32(_TOLERANCE) * np.maximum(image, 0)) ** 2, np.float32)

    def from_lit2(self, image: Float32) -> Float32:
        """Squared distance from L in standard deviations, (H, W)."""
        total = np.zeros(image.shape[:2], np.float32)
        for channel in range(3):
            value = image[..., channel]
            slope = np.float32(self.noise.slope[channel])
            floor = np.float32(self.noise.floor[channel])
            seen = np.maximum(value, 0)
            variance = (slope + np.float32(_TOLERANCE**2) * seen) * seen + floor
            total += (value - self.lit[..., channel]) ** 2 / variance
        return total

    def nearest(self, image: Float32) -> Nearest:
        """The background that is likest to each pixel of a frame (H, W, 3)."""
        weight = np.float32(1) / self.variance(image)
        above = image - self.shadow
        span = self.lit - self.shadow
        weighted = weight * above
        square: Float32 = (weighted * above).sum(axis=-1)
        between = self._along(weighted, weight, span, square, 0, 1)
        below = self._along(weighted, weight, self.shadow, square, -_DEEPEST, 0)
        deeper = below[1] < between[1]
        return Nearest(
            np.where(deeper, below[0], between[0]),
            np.where(deeper, below[1], between[1]),
            (weight * (image - self.lit) ** 2).sum(axis=-1),
        )

    @staticmethod
    def _along(
        weighted: Float32,
        weight: Float32,
        direction: Float32,
        square: Float32,
        low: float,
        high: float,
    ) -> tuple[Float32, Float32]:
        """The likeliest part of a direction from S, and the squared distance that is left."""
        length = np.maximum((weight * direction**2).sum(axis=-1), np.float32(1e-9))
        dot = (weighted * direction).sum(axis=-1)
        part = np.clip(dot / length, low, high).astype(np.float32)
        return part, np.maximum(square - part * (2 * dot - part * length), 0)
