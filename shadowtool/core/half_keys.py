"""Half floats as integers that compare alike.

The bits of a half are a piecewise linear logarithm of it: a step of one is a change of about a
thousandth, and 16-bit integers are compared and added many times faster than halfs.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import to_float

Int16 = NDArray[np.int16]
Float32 = NDArray[np.float32]

# Below this exponent halfs are evenly spaced.
_LEAST_EXPONENT = -14
_SIGN = np.int16(-0x8000)
# Keys of finite halfs are below this, and not below minus this.
_INFINITE = 0x7C00


def to_keys(halfs: NDArray[np.float16]) -> Int16:
    """Integers in the order of the halfs; -0 comes just below 0, NaN beyond infinity."""
    return _folded(np.ascontiguousarray(halfs).view(np.int16))


class FiniteKeys(NamedTuple):
    """Keys, and what there is to know of them.

    Attributes:
        keys: (H, W, 3) int16, as of `to_keys`.
        signed: whether one may be negative.
        bad: (H, W), where a channel is NaN or infinite; None for nowhere.
    """

    keys: Int16
    signed: bool
    bad: NDArray[np.bool_] | None


def finite_keys(halfs: NDArray[np.float16]) -> FiniteKeys:
    """`to_keys` of (H, W, 3), in one look where they are neither negative nor infinite."""
    bits = np.ascontiguousarray(halfs).view(np.uint16)
    if bits.max(initial=0) < _INFINITE:
        return FiniteKeys(bits.view(np.int16), False, None)
    keys = _folded(bits.view(np.int16))
    if keys.max() < _INFINITE and keys.min() >= -_INFINITE:
        return FiniteKeys(keys, True, None)
    bad = (keys >= _INFINITE) | (keys < -_INFINITE)
    return FiniteKeys(keys, True, np.asarray(bad.any(axis=-1), bool))


def from_keys(keys: Int16) -> NDArray[np.float16]:
    """The inverse of `to_keys`."""
    return _folded(keys).view(np.float16)


def _folded(bits: Int16) -> Int16:
    # Halfs are sign and magnitude: among negative ones a larger magnitude is a smaller number.
    # Flipping the magnitude's bits makes the integers ascend; doing it twice gives them back.
    if bits.size and bits.min() < 0:
        return np.asarray(bits ^ ((bits >> 15) & np.int16(0x7FFF)), np.int16)
    return bits


def mean_of_keys(total: NDArray[np.number], count: NDArray[np.number]) -> Float32:
    """The values that sums of keys stand for, with fractions of a key kept.

    The mean of keys is the mean of values where these differ by little: off by a hundredth of
    their spread, and by a tenth of it where that straddles a power of two.

    Args:
        total: sums of keys.
        count: of how many each is; NaN comes of none.
    """
    none = count == 0
    mean = np.divide(total, np.maximum(count, 1), dtype=np.float32)
    low = np.floor(mean)
    mean -= low
    keys = low.astype(np.int16)
    below = to_float(from_keys(keys))
    keys += np.int16(1)
    above = to_float(from_keys(keys))
    np.minimum(above, np.float32(65504), out=above)
    above -= below
    above *= mean
    below += above
    if none.any():
        below[np.broadcast_to(none, below.shape)] = np.nan
    return below


def keys_per_unit(values: NDArray[np.floating]) -> Float32:
    """How many keys lie in a change of 1 at these values, float32."""
    size = np.abs(values).astype(np.float32)
    _, exponent = np.frexp(np.maximum(size, np.float32(2.0**_LEAST_EXPONENT)))
    steps = np.ldexp(np.float32(1024), -(exponent - 1))
    return np.asarray(steps, np.float32)


def gray_keys(keys: Int16, signed: bool = True, out: Int16 | None = None) -> Int16:
    """One key a pixel, (H, W), of the keys of its three channels (H, W, 3): their luma.

    Args:
        signed: whether one may be negative.
        out: (H, W) to write to; an array of its own if there is none.
    """
    # OpenCV knows unsigned integers only; the weights add up to 1, so an offset stays the same.
    above = (keys ^ _SIGN if signed else keys).view(np.uint16)
    gray = np.empty(keys.shape[:2], np.int16) if out is None else out
    cv2.cvtColor(above, cv2.COLOR_RGB2GRAY, dst=gray.view(np.uint16))
    if signed:
        gray ^= _SIGN
    return gray
