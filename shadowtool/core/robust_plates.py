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
from shadowtool.core.plates import seen_pixels

Float32 = NDArray[np.float32]
Int16 = NDArray[np.int16]
Bool = NDArray[np.bool_]

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
_LOWEST_KEY = np.int16(-32000)


class Keyed(NamedTuple):
    """A frame made ready for either reading.

    Attributes:
        keys: (H, W, 3) int16, the channels.
        gray: (H, W) int16, one key a pixel.
        seen: (H, W) bool, None for everywhere.
    """

    keys: Int16
    gray: Int16
    seen: Bool | None


def keyed(image: NDArray[np.floating], holdout: NDArray[np.number] | None = None) -> Keyed:
    """Make a frame (H, W, 3) ready; where ``holdout`` is above 0, or a channel isn't finite, the
    pixel is not seen."""
    halfs = image if image.dtype == np.float16 else np.clip(image, -65504, 65504)
    keys = to_keys(halfs.astype(np.float16, copy=False))
    return Keyed(keys, gray_keys(keys), seen_pixels(image, holdout))


class LitLevels:
    """The level at which each pixel is lit: the third highest of a sample of frames."""

    def __init__(self) -> None:
        self._highest: list[Int16] = []

    def add(self, frame: Keyed) -> None:
        """Take in one of the sample's frames."""
        gray = frame.gray
        if frame.seen is not None:
            gray = np.where(frame.seen, gray, _LOWEST_KEY)
        if not self._highest:
            self._highest = [np.full_like(gray, _LOWEST_KEY) for _ in range(_OUTLIERS + 1)]
        for rank, held in enumerate(self._highest):
            self._highest[rank] = np.maximum(held, gray)
            gray = np.minimum(held, gray)

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
    """For each pixel a group of frames that agree: their number, gray level and sums."""

    def __init__(self, pixels: int) -> None:
        self.count = np.zeros(pixels, np.int32)
        self.gray = np.zeros(pixels, np.float32)
        self.total = np.zeros((pixels, 3), np.int32)

    def start(self, where: NDArray[np.intp], gray: Float32, keys: Int16) -> None:
        self.count[where] = 1
        self.gray[where] = gray
        self.total[where] = keys

    def join(self, where: NDArray[np.intp], gray: Float32, keys: Int16) -> None:
        count = self.count[where] + 1
        self.count[where] = count
        self.gray[where] += (gray - self.gray[where]) / count
        self.total[where] += keys

    def take_over(self, where: NDArray[np.intp], other: "_Group") -> None:
        self.count[where] = other.count[where]
        self.gray[where] = other.gray[where]
        self.total[where] = other.total[where]


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
        self._lit_low[unsampled], self._lit_high[unsampled] = -32767, 32767
        self._dark[unsampled] = -32768
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
        lit = (frame.gray >= self._lit_low) & (frame.gray <= self._lit_high)
        dark = frame.gray < self._dark
        if frame.seen is not None:
            lit &= frame.seen
            dark &= frame.seen
        mask = lit.view(np.uint8)
        cv2.add(self._total, frame.keys, dst=self._total, mask=mask, dtype=cv2.CV_32S)
        cv2.add(self._count, mask, dst=self._count, dtype=cv2.CV_32S)
        where = np.flatnonzero(dark)
        self._darken(where, frame.gray.ravel()[where], frame.keys.reshape(-1, 3)[where])

    def _darken(self, where: NDArray[np.intp], gray: Int16, keys: Int16) -> None:
        """Let the darkened pixels of a frame join, found or pass over groups."""
        level = gray.astype(np.float32)
        lowest, backup = self._lowest, self._next
        width = self._width[where]
        fresh = lowest.count[where] == 0
        distance = level - lowest.gray[where]
        joins = ~fresh & (np.abs(distance) <= width)
        below = ~fresh & (distance < -width)
        lowest.join(where[joins], level[joins], keys[joins])
        backup.take_over(where[below], lowest)
        starts = fresh | below
        lowest.start(where[starts], level[starts], keys[starts])
        above = ~(joins | starts)
        spot, level, keys, width = where[above], level[above], keys[above], width[above]
        empty = backup.count[spot] == 0
        distance = level - backup.gray[spot]
        joins = ~empty & (np.abs(distance) <= width)
        backup.join(spot[joins], level[joins], keys[joins])
        starts = empty | (distance < -width)
        backup.start(spot[starts], level[starts], keys[starts])

    def measured(self) -> Measured:
        """The plates so far."""
        lowest, backup = self._lowest, self._next
        # A group of one or two frames below a much larger one is a bird, not the shadow.
        stray = (lowest.count < _LEAST_GROUP) & (backup.count >= 2 * np.maximum(lowest.count, 1))
        count = np.where(stray, backup.count, lowest.count)
        total = np.where(stray[:, None], backup.total, lowest.total)
        shape = self._shape
        shadow = mean_of_keys(total, count[:, None]).reshape(*shape, 3)
        lit = mean_of_keys(self._total, self._count[..., None])
        lit_frames = self._count
        # Never at its lit level: what it was all the time is all that is known of it.
        never = (lit_frames == 0) & (count.reshape(shape) > 0)
        if never.any():
            lit[never] = shadow[never]
            lit_frames = np.where(never, count.reshape(shape), lit_frames)
        return Measured(
            lit=lit,
            shadow=shadow,
            lit_frames=lit_frames.astype(np.uint32),
            shadow_frames=count.astype(np.uint32).reshape(shape),
        )


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
    return np.asarray(np.clip(np.rint(values), -32767, 32767), np.int16)
