"""How far a colour is from all that the background can look like.

What the camera sees of the background lies on the line from S to L through each pixel: brighter
than lit or darker than shadow is off it, and so is another hue.
"""

from copy import copy

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import blocks
from shadowtool.core.noise import NoiseModel

try:
    from shadowtool.core import _color_line as _compiled
except ImportError:
    # No compiler was there when this was installed.
    _compiled = None  # type: ignore[assignment]

Float32 = NDArray[np.float32]

# So many pixels at a time stay in the processor's cache.
_BLOCK = 1 << 15


def line_distance(
    image: Float32, lit: Float32, shadow: Float32, noise: NoiseModel, tolerance: float
) -> Float32:
    """Distance from the line between S and L, in standard deviations of what is still on it.

    With each channel in units of its deviation the nearest point of the line is the likeliest.

    Args:
        image, lit, shadow: (..., 3), linear light.
        tolerance: a deviation besides the noise, as a part of the value: plates, compression and
            light bounced from elsewhere are never exact.

    Returns:
        (...) float32 ≥ 0; 0 where anything is unknown.
    """
    arrays = np.broadcast_arrays(image, lit, shadow)
    pixels = [values.reshape(-1, 3) for values in arrays]
    flat = np.empty(len(pixels[0]), np.float32)
    for part in blocks(flat.size, _BLOCK):
        colours, light, shade = (channels(values[part]) for values in pixels)
        flat[part] = Weighed(colours, noise, tolerance).line_distance(light, shade)
    return flat.reshape(arrays[0].shape[:-1])


def channels(image: NDArray[np.floating]) -> Float32:
    """The colours of an image (..., 3) by channel, (3, N) float32."""
    return np.ascontiguousarray(image.reshape(-1, 3).T, np.float32)


class Weighed:
    """Colours that are held against one line after the other."""

    def __init__(self, colours: Float32, noise: NoiseModel, tolerance: float) -> None:
        """Args: as `line_distance`, but ``colours`` is (3, N)."""
        with np.errstate(invalid="ignore", over="ignore"):
            value = np.maximum(colours, 0)
            sigma = np.stack([noise.channel_variance(value[c], c) for c in range(3)])
            np.sqrt(sigma, out=sigma)
            value *= np.float32(tolerance)
            sigma += value
            np.maximum(sigma, np.float32(1e-6), out=sigma)
            self._weight: Float32 = np.divide(1, sigma, out=sigma)
        self._colours = colours

    def part(self, where: slice) -> "Weighed":
        """Some of the colours in a row; nothing is copied."""
        part = copy(self)
        part._colours, part._weight = self._colours[:, where], self._weight[:, where]
        return part

    def take(self, where: NDArray[np.intp]) -> "Weighed":
        """Some of the colours."""
        part = copy(self)
        part._colours = self._colours.take(where, axis=1)
        part._weight = self._weight.take(where, axis=1)
        return part

    def line_distance(self, lit: Float32, shadow: Float32) -> Float32:
        """`line_distance` from S and L, (3, N) each, to (N,)."""
        return self.nearest(lit, shadow)[0]

    def nearest(self, lit: Float32, shadow: Float32) -> tuple[Float32, Float32]:
        """The same, and where on the line the nearest point is: 0 at S, 1 at L; (N,) each."""
        if _compiled is not None:
            distance, part = (np.empty(lit.shape[1], np.float32) for _ in range(2))
            colours, weight = _in_rows(self._colours), _in_rows(self._weight)
            lit, shadow = _in_rows(lit), _in_rows(shadow)
            _compiled.nearest(colours, weight, lit, shadow, distance, part)
            return distance, part
        with np.errstate(invalid="ignore", over="ignore"):
            direction = lit - shadow
            direction *= self._weight
            rest = self._colours - shadow
            rest *= self._weight
            part = _dot(rest, direction)
            part /= np.maximum(_dot(direction, direction), np.float32(1e-9))
            np.clip(part, 0, 1, out=part)
            direction *= part
            rest -= direction
            distance = np.sqrt(_dot(rest, rest))
        # Of NaN and a number fmax takes the number.
        np.fmax(distance, 0, out=distance)
        return np.asarray(np.minimum(distance, 1e6, out=distance), np.float32), part


def _in_rows(channels: Float32) -> Float32:
    """Channels (3, N), the numbers of each of which follow each other."""
    return channels if channels.strides[1] == channels.itemsize else channels.copy("C")


def _dot(one: Float32, other: Float32) -> Float32:
    total: Float32 = one[0] * other[0]
    for channel in (1, 2):
        total += one[channel] * other[channel]
    return total
