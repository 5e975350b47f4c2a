"""Transfer functions between coded and linear light.

Values outside [0, 1] are carried through by the same curve, negative ones mirrored at zero;
NaN stays NaN.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import to_float

Float32 = NDArray[np.float32]

# What R, G and B add to luminance (Rec. ITU-R BT.709).
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)


def _mirrored(curve: Callable[[Float32], Float32], values: NDArray[np.floating]) -> Float32:
    single = to_float(np.asarray(values))
    return np.copysign(curve(np.abs(single)), single).astype(np.float32, copy=False)


def decode_srgb(coded: NDArray[np.floating]) -> Float32:
    """sRGB code values to linear light (IEC 61966-2-1). Any shape; 1.0 maps to 1.0."""
    return _mirrored(
        lambda v: np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** np.float32(2.4)), coded
    )


def encode_srgb(linear: NDArray[np.floating]) -> Float32:
    """Linear light to sRGB code values (IEC 61966-2-1). Any shape; 1.0 maps to 1.0."""
    return _mirrored(
        lambda v: np.where(
            v <= 0.0031308, v * 12.92, 1.055 * v ** np.float32(1 / 2.4) - np.float32(0.055)
        ),
        linear,
    )


# ITU-R BT.2020-2 gives the two constants of BT.709's curve to more digits than BT.709 does; with
# them the two branches meet.
_ALPHA_709 = np.float32(1.09929682680944)
_BETA_709 = np.float32(0.018053968510807)


def decode_rec709(coded: NDArray[np.floating]) -> Float32:
    """Rec.709 camera code values to scene-linear light (the inverse of BT.709's OETF)."""
    return _mirrored(
        lambda v: np.where(
            v < 4.5 * _BETA_709,
            v / np.float32(4.5),
            ((v + (_ALPHA_709 - 1)) / _ALPHA_709) ** np.float32(1 / 0.45),
        ),
        coded,
    )


def encode_rec709(linear: NDArray[np.floating]) -> Float32:
    """Scene-linear light to Rec.709 camera code values (BT.709's OETF)."""
    return _mirrored(
        lambda v: np.where(
            v < _BETA_709,
            v * np.float32(4.5),
            _ALPHA_709 * v ** np.float32(0.45) - (_ALPHA_709 - 1),
        ),
        linear,
    )


def _identity(values: NDArray[np.floating]) -> Float32:
    return to_float(values)


class Transfer(NamedTuple):
    """A pair of inverse curves; both take and give float32 arrays of any shape."""

    decode: Callable[[NDArray[np.floating]], Float32]
    encode: Callable[[NDArray[np.floating]], Float32]


TRANSFERS = {
    "linear": Transfer(_identity, _identity),
    "srgb": Transfer(decode_srgb, encode_srgb),
    "rec709": Transfer(decode_rec709, encode_rec709),
    # The paper's own practice: code values are used as they are.
    "none": Transfer(_identity, _identity),
}
