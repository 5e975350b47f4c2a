"""Putting shadow and figure into the target scene (section 3)."""

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands, in_all_channels

Float32 = NDArray[np.float32]


def shade(lit: Float32, shadow: Float32, beta: Float32) -> Float32:
    """The background under a shadow, Eqs. (3) and (6): C' = βL' + (1 - β)S'.

    Args:
        lit, shadow: (H, W, 3) float32, linear light.
        beta: (H, W), or (H, W, 3) for coloured light; not limited to [0, 1].

    Returns:
        (H, W, 3) float32; exactly L' where β = 1 and S' where β = 0; NaN where an input is.
    """
    result = np.empty_like(lit)
    for rows in bands(lit.shape):
        visibility = beta[rows] if beta.ndim == 3 else in_all_channels(beta[rows])
        np.multiply(visibility, lit[rows], out=result[rows])
        result[rows] += (1 - visibility) * shadow[rows]
    return result


def over(foreground: Float32, alpha: Float32, background: Float32) -> Float32:
    """A premultiplied figure over a background, Eq. (1): C = αF + (1 - α)B.

    Args:
        foreground: (H, W, 3), premultiplied, linear light.
        alpha: (H, W) in [0, 1].
        background: (H, W, 3).

    Returns:
        (H, W, 3) float32; NaN where the background is and the figure does not hide it.
    """
    result = np.empty_like(background)
    for rows in bands(alpha.shape):
        past = 1 - in_all_channels(alpha[rows])
        np.multiply(past, background[rows], out=result[rows])
        result[rows][past == 0] = 0
        result[rows] += foreground[rows]
    return result


def shadow_ratio(shaded: Float32, lit: Float32) -> Float32:
    """What the lit plate is to be multiplied by to be in shadow: C'/L'.

    Returns:
        (H, W, 3) float32 ≥ 0, 1 where the lit plate is black.
    """
    ratio = np.ones_like(shaded)
    for rows in bands(shaded.shape):
        np.divide(shaded[rows], lit[rows], out=ratio[rows], where=lit[rows] > 0)
        np.maximum(ratio[rows], 0, out=ratio[rows])
    return ratio
