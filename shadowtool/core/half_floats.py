"""Between half and single floats, several times faster than numpy's own casts.

OpenCV converts with the processor's instructions for it; subtracting 0 leaves every value as it is,
the sign of 0 too.
"""

from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float16 = NDArray[np.float16]

LARGEST_HALF = 65504.0
_INFINITE = 0x7C00
_NOTHING = np.zeros(1)
# Half of the unit that a single float's mantissa is rounded to, to keep 12 of its 23 bits.
_HALF_UNIT = np.uint32(1 << 10)


def to_float(values: NDArray[np.floating]) -> Float32:
    """Half floats of any shape as single floats, exactly; single floats as they are."""
    if values.dtype == np.float16 and values.size:
        return _converted(values, cv2.CV_32F).view(np.float32)
    return values.astype(np.float32, copy=False)


def to_half(values: NDArray[np.floating]) -> Float16:
    """Round to half floats; what is too large becomes the largest half, NaN stays."""
    halfs = rounded(values)
    if all_finite(halfs):
        return halfs
    return np.asarray(np.clip(values, -LARGEST_HALF, LARGEST_HALF), np.float16)


def rounded(values: NDArray[np.floating]) -> Float16:
    """Round to half floats; what is too large becomes infinite, NaN stays."""
    if values.dtype != np.float32 or not values.size:
        with np.errstate(over="ignore"):
            return np.asarray(values, np.float16)
    return _converted(values, cv2.CV_16F).view(np.float16)


def shortened(values: Float32) -> Float32:
    """Single floats of any shape with 12 bits of their mantissa, rounded; NaN stays.

    A quarter of what a half can tell apart. The rest of a mean of noisy frames is noise, and
    takes long to compress.
    """
    bits = values.view(np.uint32) + _HALF_UNIT
    bits &= ~(2 * _HALF_UNIT - 1)
    return bits.view(np.float32)


def all_finite(halfs: Float16) -> bool:
    """Whether half floats of any shape have neither NaN nor infinity among them."""
    bits = np.ascontiguousarray(halfs).view(np.int16)
    if bits.size and bits.min() < 0:
        bits = bits & np.int16(0x7FFF)
    return not bits.size or bool(bits.max() < _INFINITE)


def not_finite(image: NDArray[np.floating]) -> NDArray[np.bool_] | None:
    """Where an image (H, W), or a channel of one (H, W, C), is NaN or infinite, (H, W); None for
    nowhere."""
    if image.dtype == np.float16 and all_finite(image.astype(np.float16, copy=False)):
        return None
    # By channel: to reduce an axis of three is slow.
    finite = np.isfinite(image)
    if finite.ndim == 3:
        finite = reduce(np.logical_and, np.moveaxis(finite, -1, 0))
    bad = np.asarray(~finite)
    return bad if bad.any() else None


def _converted(values: NDArray[np.floating], depth: int) -> NDArray[np.generic]:
    # OpenCV takes a third axis for channels, and not more than four of them.
    rows = np.ascontiguousarray(values).reshape(values.shape[0] if values.ndim else 1, -1)
    return np.asarray(cv2.subtract(rows, _NOTHING, dtype=depth)).reshape(values.shape)
