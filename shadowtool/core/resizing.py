"""Pictures at another size."""

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import not_finite

Float32 = NDArray[np.float32]

# A pixel of which less than this part is made of what is finite is unknown.
_LEAST_KNOWN = 0.5


def resized(image: Float32, size: tuple[int, int]) -> Float32:
    """A picture at another size: the mean over areas if it is narrower, bicubic if not.

    Around what is not finite, values are those of what is finite there, weighted as ever: Σwv/Σw.

    Args:
        image: (H, W, 3) float32, linear light.
        size: width and height in pixels.

    Returns:
        (h, w, 3) float32; NaN in all channels where the pixel itself was NaN or infinite in one,
        and nowhere else but next to it.
    """
    method = cv2.INTER_AREA if size[0] < image.shape[1] else cv2.INTER_CUBIC
    image = np.ascontiguousarray(image)
    bad = not_finite(image)
    if bad is None:
        return np.asarray(cv2.resize(image, size, interpolation=method), np.float32)
    good = (~bad).astype(np.float32)
    whole = np.where(bad[..., np.newaxis], np.float32(0), image)
    values, weight = (
        np.asarray(cv2.resize(part, size, interpolation=method), np.float32)
        for part in (whole, good)
    )
    lost = cv2.resize(good, size, interpolation=cv2.INTER_NEAREST) == 0
    lost |= weight < _LEAST_KNOWN
    values /= np.where(lost, np.float32(1), weight)[..., np.newaxis]
    values[lost] = np.nan
    return values
