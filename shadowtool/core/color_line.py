"""How far a colour is from all that the background can look like.

What the camera sees of the background lies on the line from S to L through each pixel: brighter
than lit or darker than shadow is off it, and so is another hue.
"""

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.noise import NoiseModel

Float32 = NDArray[np.float32]


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
    with np.errstate(invalid="ignore", over="ignore"):
        sigma = noise.sigma(image) + np.float32(tolerance) * np.maximum(image, 0)
        weight = 1 / np.maximum(sigma, np.float32(1e-6))
        direction = (lit - shadow) * weight
        above = (image - shadow) * weight
        length = np.maximum((direction**2).sum(axis=-1), np.float32(1e-9))
        part = np.clip((above * direction).sum(axis=-1) / length, 0, 1)
        rest = above - part[..., None] * direction
        distance = np.sqrt((rest**2).sum(axis=-1))
    return np.asarray(np.nan_to_num(distance, nan=0.0, posinf=1e6), np.float32)
