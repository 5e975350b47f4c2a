"""Lit and shadow plates: the scene with the key light unblocked, and blocked.

Eq. (4) of Chuang et al. 2003: S = min_f C_f, L = max_f C_f, each pixel and channel for itself.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.half_floats import not_finite, to_float
from shadowtool.core.half_keys import finite_keys, from_keys

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Plates:
    """The two plates of a scene and what they rest on.

    Attributes:
        lit: (H, W, 3) float32, linear light; NaN where no frame showed the pixel.
        shadow: (H, W, 3) float32, likewise.
        frames: (H, W) uint32, the number of frames that the lit plate rests on; None for plates
            that come from elsewhere (a renderer, a paint program).
        shadow_frames: (H, W) uint32, likewise for the shadow plate; None for extremes, for which
            every frame counts in both.
    """

    lit: Float32
    shadow: Float32
    frames: NDArray[np.uint32] | None = None
    shadow_frames: NDArray[np.uint32] | None = None


class ExtremePlates:
    """Running per-channel minimum and maximum of frames, Eq. (4), in constant memory.

    Halfs are compared as 16-bit integers: the same order, thirty times faster. Which frame comes
    first makes no difference to any bit of the result.
    """

    def __init__(self) -> None:
        self._lowest: NDArray[np.int16] | Float32 | None = None
        self._highest: NDArray[np.int16] | Float32 | None = None
        self._frames = 0
        # In how many of them each pixel was not seen; None while all were in all.
        self._missed: NDArray[np.uint32] | None = None

    def add(self, image: NDArray[np.floating], holdout: NDArray[np.number] | None = None) -> int:
        """Take one frame in; returns how many of its pixels are not finite.

        Args:
            image: (H, W, 3) float16 or float32, linear light, the same size in every call. A
                pixel with a NaN or infinity in any channel counts as not seen.
            holdout: (H, W) of any type; where above 0 the pixel is out.

        Raises:
            ValueError: the shape differs from that of the first frame.
        """
        if self._lowest is None or self._highest is None:
            # For halfs the integers that stand for infinity: both survive going over to floats.
            infinity, _ = _order_keys(np.full((1, 1, 3), np.inf, image.dtype))
            top = infinity[0, 0, 0]
            bottom = ~top if infinity.dtype == np.int16 else -top
            self._lowest = np.full(image.shape, top, infinity.dtype)
            self._highest = np.full(image.shape, bottom, infinity.dtype)
        if image.shape != self._lowest.shape:
            raise ValueError(f"a frame of {image.shape} among frames of {self._lowest.shape}")
        mixed = (image.dtype == np.float16) != (self._lowest.dtype == np.int16)
        if mixed:
            # Halfs and floats in one take: go on in float, which holds every half.
            self._lowest, self._highest = _values(self._lowest), _values(self._highest)
        self._frames += 1
        not_finite = 0
        for rows in bands(image.shape):
            keys, out = _order_keys(image[rows])
            keys = _values(keys) if mixed else keys
            lowest, highest = self._lowest[rows], self._highest[rows]
            not_finite += 0 if out is None else int(np.count_nonzero(out))
            if holdout is not None:
                # NaN in a matte says nothing in favour of the pixel.
                held = np.asarray(~(holdout[rows] <= 0))
                out = held if out is None else held | out
            if out is None or not out.any():
                np.minimum(lowest, keys, out=lowest)
                np.maximum(highest, keys, out=highest)
            else:
                mask = (~out).view(np.uint8)
                cv2.copyTo(np.minimum(lowest, keys), mask, lowest)
                cv2.copyTo(np.maximum(highest, keys), mask, highest)
                if self._missed is None:
                    self._missed = np.zeros(image.shape[:2], np.uint32)
                self._missed[rows] += out
        return not_finite

    def plates(self) -> Plates:
        """The plates so far.

        Raises:
            ValueError: no frame was added.
        """
        if self._lowest is None or self._highest is None:
            raise ValueError("no frame was added")
        lit, shadow = _values(self._highest), _values(self._lowest)
        frames = np.full(lit.shape[:2], self._frames, np.uint32)
        if self._missed is not None:
            frames -= self._missed
            unseen = frames == 0
            lit[unseen] = np.nan
            shadow[unseen] = np.nan
        return Plates(lit, shadow, frames)


def _order_keys(
    image: NDArray[np.floating],
) -> tuple[NDArray[np.int16] | Float32, NDArray[np.bool_] | None]:
    """Values that compare as the image's do, int16 for halfs and float32 else, and where a channel
    is not finite, None for nowhere."""
    if image.dtype == np.float16:
        keys, _, bad = finite_keys(image.astype(np.float16, copy=False))
        return keys, bad
    return np.asarray(image, np.float32), not_finite(image)


def _values(keys: NDArray[np.int16] | Float32) -> Float32:
    if keys.dtype == np.int16:
        return to_float(from_keys(keys.astype(np.int16, copy=False)))
    return keys.astype(np.float32)
