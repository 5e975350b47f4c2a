"""Lit and shadow plates: the scene with the key light unblocked, and blocked.

Eq. (4) of Chuang et al. 2003: S = min_f C_f, L = max_f C_f, each pixel and channel for itself.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.half_floats import to_float
from shadowtool.core.half_keys import from_keys, not_finite, to_keys

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

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.lit.shape[1], self.lit.shape[0]


class ExtremePlates:
    """Running per-channel minimum and maximum of frames, Eq. (4), in constant memory.

    Halfs are compared as 16-bit integers: the same order, thirty times faster. Which frame comes
    first makes no difference to any bit of the result.
    """

    def __init__(self) -> None:
        self._lowest: NDArray[np.int16] | Float32 | None = None
        self._highest: NDArray[np.int16] | Float32 | None = None
        self._frames: NDArray[np.uint32] | None = None

    def add(self, image: NDArray[np.floating], holdout: NDArray[np.number] | None = None) -> None:
        """Take one frame in.

        Args:
            image: (H, W, 3) float16 or float32, linear light, the same size in every call. A
                pixel with a NaN or infinity in any channel counts as not seen.
            holdout: (H, W) of any type; where above 0 the pixel is out.

        Raises:
            ValueError: the shape differs from that of the first frame.
        """
        if self._lowest is None or self._highest is None or self._frames is None:
            # For halfs the integers that stand for infinity: both survive going over to floats.
            infinity = _order_keys(np.full((1, 1, 3), np.inf, image.dtype))
            top = infinity[0, 0, 0]
            bottom = ~top if infinity.dtype == np.int16 else -top
            self._lowest = np.full(image.shape, top, infinity.dtype)
            self._highest = np.full(image.shape, bottom, infinity.dtype)
            self._frames = np.zeros(image.shape[:2], np.uint32)
        if image.shape != self._lowest.shape:
            raise ValueError(f"a frame of {image.shape} among frames of {self._lowest.shape}")
        mixed = (image.dtype == np.float16) != (self._lowest.dtype == np.int16)
        if mixed:
            # Halfs and floats in one take: go on in float, which holds every half.
            self._lowest, self._highest = _values(self._lowest), _values(self._highest)
        for rows in bands(image.shape):
            keys = _order_keys(image[rows])
            keys = _values(keys) if mixed else keys
            lowest, highest = self._lowest[rows], self._highest[rows]
            seen = seen_pixels(image[rows], None if holdout is None else holdout[rows])
            if seen is None:
                np.minimum(lowest, keys, out=lowest)
                np.maximum(highest, keys, out=highest)
                self._frames[rows] += np.uint32(1)
            else:
                mask = seen.view(np.uint8)
                cv2.copyTo(np.minimum(lowest, keys), mask, lowest)
                cv2.copyTo(np.maximum(highest, keys), mask, highest)
                self._frames[rows] += seen

    def plates(self) -> Plates:
        """The plates so far.

        Raises:
            ValueError: no frame was added.
        """
        if self._lowest is None or self._highest is None or self._frames is None:
            raise ValueError("no frame was added")
        unseen = self._frames == 0
        lit, shadow = _values(self._highest), _values(self._lowest)
        if unseen.any():
            lit[unseen] = np.nan
            shadow[unseen] = np.nan
        return Plates(lit, shadow, self._frames.copy())


def _order_keys(image: NDArray[np.floating]) -> NDArray[np.int16] | Float32:
    """Values that compare as the image's do: int16 for halfs, float32 else."""
    if image.dtype != np.float16:
        return np.asarray(image, np.float32)
    return to_keys(image.astype(np.float16, copy=False))


def _values(keys: NDArray[np.int16] | Float32) -> Float32:
    if keys.dtype == np.int16:
        return to_float(from_keys(keys.astype(np.int16, copy=False)))
    return keys.astype(np.float32)


def seen_pixels(
    image: NDArray[np.floating], holdout: NDArray[np.number] | None
) -> NDArray[np.bool_] | None:
    """Where the frame shows the background, or None for everywhere."""
    if image.dtype == np.float16:
        bad = not_finite(image.astype(np.float16, copy=False))
    else:
        wrong = ~np.isfinite(image)
        bad = np.asarray(wrong.any(axis=-1)) if wrong.any() else None
    seen = None if bad is None else ~bad
    if holdout is not None:
        # NaN in a matte says nothing in favour of the pixel.
        free = np.asarray(holdout <= 0)
        seen = free if seen is None else seen & free
    return seen
