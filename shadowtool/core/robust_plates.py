"""Lit and shadow plates without the bias of extremes.

The maximum of noisy samples is too bright and the minimum too dark. Here a pixel's lit value is
the mean of all the frames in which it was lit, and its shadow value the mean of the darkest group
of frames that agree within the noise. Two readings, in memory that does not grow with the frames:
`LitLevels` looks at a sample of frames for the level to tell lit from shaded by, `RobustPlates` at
all of them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_keys import (
    from_keys,
    gray_keys,
    keys_per_unit,
    mean_of_keys,
    to_keys,
)
from shadowtool.core.noise import NoiseModel

Float32 = NDArray[np.float32]
Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

# A sample of this many frames tells the lit level.
SAMPLES = 24
# So many of the brightest samples may be outliers.
_OUTLIERS = 2
# The expected place of the third highest of some two dozen lit samples, standard deviations.
_THIRD_HIGHEST = 1.2
# Around the lit level, frames within this many standard deviations are lit, and those further
# below are in shadow to some degree.
_LIT, _DARK = 3.5, 5.0
# A frame belongs to a pixel's darkest group within this many standard deviations of its mean.
_GROUP, _SHADE = 4.0, 0.25
# A darkest group of fewer frames than this gives way to the next one, if that is much larger.
_LEAST_GROUP = 3
# The gray key of what is not seen, above and below that of all that is.
_UNSEEN, _LOWEST_KEY = np.int16(32767), np.int16(-32000)
# Keys of finite halfs are from minus this to one less.
_INFINITE = 0x7C00
# So many rows at a time stay in the processor's cache.
_ROWS = 32


class Keyed(NamedTuple):
    """A frame made ready for either reading.

    Attributes:
        keys: (H, W, 3) int16, the channels.
        gray: (H, W) int16, one key a pixel; those that are not seen are marked by `hide`.
    """

    keys: Int16
    gray: Int16


def keyed(image: NDArray[np.floating], holdout: NDArray[np.number] | None = None) -> Keyed:
    """Make a frame (H, W, 3) ready; where ``holdout`` is above 0, or a channel isn't finite, the
    pixel is not seen."""
    halfs = image
    if image.dtype != np.float16:
        halfs = np.where(np.isfinite(image), np.clip(image, -65504, 65504), np.nan)
    halfs = np.ascontiguousarray(halfs, np.float16)
    keys = halfs.view(np.int16)
    gray = np.empty(keys.shape[:2], np.int16)
    # Halfs are their own keys if none is negative.
    same = keys.min() >= 0
    if not same:
        keys = np.empty_like(keys)
    for start in range(0, len(keys), _ROWS):
        rows = slice(start, start + _ROWS)
        if not same:
            keys[rows] = to_keys(halfs[rows])
        gray[rows] = gray_keys(keys[rows])
    low, high, _, _ = cv2.minMaxLoc(keys.reshape(1, -1))
    if low < -_INFINITE or high >= _INFINITE:
        finite = (keys >= -_INFINITE) & (keys < _INFINITE)
        hide(gray, np.asarray(~finite.all(axis=-1)))
    if holdout is not None:
        # NaN in a matte says nothing in favour of the pixel.
        hide(gray, np.asarray(~(holdout <= 0)))
    return Keyed(keys, gray)


def hide(gray: Int16, where: Bool) -> None:
    """Mark pixels of a frame's gray keys, (H, W), as not seen."""
    np.copyto(gray, _UNSEEN, where=where)


class LitLevels:
    """The level at which each pixel is lit: the third highest of a sample of frames."""

    def __init__(self, height: int, width: int) -> None:
        shape = height, width
        self._highest = [np.full(shape, _LOWEST_KEY, np.int16) for _ in range(_OUTLIERS + 1)]

    def add(self, gray: Int16) -> None:
        """Take in the gray keys of one of the sample's frames, (H, W)."""
        gray = gray.copy()
        gray[gray == _UNSEEN] = _LOWEST_KEY
        for held in self._highest:
            lower = np.minimum(held, gray)
            np.maximum(held, gray, out=held)
            gray = lower

    def levels(self) -> Int16:
        """(H, W) keys; where fewer frames than that saw the pixel, the lowest of those."""
        level = self._highest[-1]
        for brighter in reversed(self._highest[:-1]):
            level = np.where(level == _LOWEST_KEY, brighter, level)
        return level


@dataclass(frozen=True)
class Measured:
    """What the second reading found.

    Attributes:
        lit, shadow: (H, W, 3) float32, linear light; lit is NaN where no frame showed the pixel,
            shadow where it was never darkened.
        lit_frames, shadow_frames: (H, W) uint32, how many frames each rests on.
    """

    lit: Float32
    shadow: Float32
    lit_frames: NDArray[np.uint32]
    shadow_frames: NDArray[np.uint32]


class _Group:
    """For each pixel a group of frames that agree.

    Attributes:
        planes: (5, N) int32: the number of frames, the bits of their mean gray as a float32, and
            the sums of their channels' keys. Gray is counted from so far up that it is negative:
            a group of none, all 0, lies above every frame.
    """

    def __init__(self, pixels: int) -> None:
        self.planes = np.zeros((5, pixels), np.int32)

    def put(self, where: Index, planes: Int32) -> None:
        """Let pixels start with these planes."""
        for held, new in zip(self.planes, planes, strict=True):
            held[where] = new

    def add(self, where: Index, single: Int32, width: Float32) -> tuple[Index, Index, Int32]:
        """Let groups of one join those within a width of them, or replace brighter ones.

        Returns:
            Which of them lie above and are left out; which replaced a group, and that one's planes.
        """
        held = self.planes.take(where, axis=1)
        count, mean = held[0], held[1].view(np.float32)
        distance = single[1].view(np.float32) - mean
        apart = np.flatnonzero(np.abs(distance) > width)
        above = distance.take(apart) > 0
        before = held.take(apart, axis=1)
        count += 1
        distance /= count.astype(np.float32)
        mean += distance
        held[2:] += single[2:]
        held[:, apart] = np.where(above, before, single.take(apart, axis=1))
        self.put(where, held)
        below = ~above & (before[0] > 0)
        return apart[above], apart[below], before[:, below]


class RobustPlates:
    """Means of the lit and of the fully shaded frames of each pixel."""

    def __init__(self, levels: Int16, noise: NoiseModel) -> None:
        """Args: the lit levels of the first reading, (H, W), and the take's noise."""
        unsampled = levels == _LOWEST_KEY
        values = np.maximum(np.nan_to_num(from_keys(levels).astype(np.float32), posinf=65504), 0)
        self._sigma_at = _KeySigma(noise)
        sigma = self._sigma_at(values)
        middle = levels - _THIRD_HIGHEST * sigma
        self._lit_low = _to_int16(middle - _LIT * sigma)
        self._lit_high = _to_int16(middle + _LIT * sigma)
        self._dark = _to_int16(middle - _DARK * sigma)
        # Of a pixel that no sample showed, whatever frame does is taken.
        self._lit_low[unsampled], self._lit_high[unsampled] = _LOWEST_KEY, _UNSEEN - 1
        self._dark[unsampled] = _LOWEST_KEY
        # The noise of a shadow is that of a fraction of the light; which one hardly matters.
        shaded = np.maximum(values * np.float32(_SHADE), np.float32(1e-4))
        self._width = (_GROUP * self._sigma_at(shaded)).ravel()
        pixels = levels.size
        self._shape = levels.shape
        self._total = np.zeros((*levels.shape, 3), np.int32)
        self._count = np.zeros(levels.shape, np.int32)
        self._lowest, self._next = _Group(pixels), _Group(pixels)

    def add(self, frame: Keyed) -> None:
        """Take in one frame; frames come in the order of the take."""
        lit = np.asarray(cv2.inRange(frame.gray, self._lit_low, self._lit_high), np.uint8)
        cv2.add(self._total, frame.keys, dst=self._total, mask=lit, dtype=cv2.CV_32S)
        # As signed bytes the mask's 255 are -1.
        np.subtract(self._count, lit.view(np.int8), out=self._count)
        for start in range(0, len(frame.gray), _ROWS):
            self._darken(frame, slice(start, start + _ROWS))

    def _darken(self, frame: Keyed, rows: slice) -> None:
        """Let the darkened pixels of some rows, groups of one, join, found or pass over groups."""
        gray = frame.gray[rows]
        dark = np.flatnonzero(gray < self._dark[rows])
        if not dark.size:
            return
        single = np.empty((5, dark.size), np.int32)
        single[0] = 1
        single[1] = (gray.ravel().take(dark) - np.float32(_UNSEEN)).view(np.int32)
        single[2:] = frame.keys[rows].reshape(-1, 3).take(dark, axis=0).T
        where = dark + rows.start * gray.shape[1]
        width = self._width.take(where)
        above, below, replaced = self._lowest.add(where, single, width)
        self._next.put(where.take(below), replaced)
        self._next.add(where.take(above), single.take(above, axis=1), width.take(above))

    def measured(self) -> Measured:
        """The plates so far."""
        shape = self._shape
        lit = np.empty((*shape, 3), np.float32)
        shadow = np.full((*shape, 3), np.nan, np.float32)
        lit_frames, shadow_frames = np.empty(shape, np.uint32), np.zeros(shape, np.uint32)
        for start in range(0, shape[0], _ROWS):
            rows = slice(start, start + _ROWS)
            lit[rows] = mean_of_keys(self._total[rows], self._count[rows][..., None])
            lit_frames[rows] = self._count[rows]
            first = start * shape[1]
            where = first + np.flatnonzero(self._lowest.planes[0, first : first + _ROWS * shape[1]])
            lowest, backup = (
                group.planes.take(where, axis=1) for group in (self._lowest, self._next)
            )
            # A group of one or two frames below a much larger one is a bird, not the shadow.
            stray = (lowest[0] < _LEAST_GROUP) & (backup[0] >= 2 * lowest[0])
            group = np.where(stray, backup, lowest)
            shadow.reshape(-1, 3)[where] = mean_of_keys(group[2:], group[0]).T
            shadow_frames.ravel()[where] = group[0]
        # Never at its lit level: what it was all the time is all that is known of it.
        never = (lit_frames == 0) & (shadow_frames > 0)
        if never.any():
            lit[never] = shadow[never]
            lit_frames[never] = shadow_frames[never]
        return Measured(lit, shadow, lit_frames, shadow_frames)


class _KeySigma:
    """Standard deviation of a gray key at a gray value."""

    def __init__(self, noise: NoiseModel) -> None:
        self._slope = float(noise.slope.mean())
        self._floor = float(noise.floor.mean())

    def __call__(self, values: Float32) -> Float32:
        sigma = np.sqrt(self._slope * values + self._floor)
        # Half floats are rounded to whole keys.
        return np.asarray(sigma * keys_per_unit(values) + np.float32(0.5), np.float32)


def _to_int16(values: NDArray[np.floating]) -> Int16:
    return np.asarray(np.clip(np.rint(values), -32767, _UNSEEN - 1), np.int16)
