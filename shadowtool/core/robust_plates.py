"""Lit and shadow plates without the bias of extremes.

The maximum of noisy samples is too bright and the minimum too dark. Here a pixel's lit value is
the mean of all the frames in which it was lit, and its shadow value the mean of the darkest group
of frames that agree within the noise. Two readings, in memory that does not grow with the frames:
`SampledLevels` looks at a sample of frames for the levels to tell lit from shaded by,
`RobustPlates` at all of them.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import in_all_channels
from shadowtool.core.half_keys import (
    finite_keys,
    from_keys,
    gray_keys,
    keys_per_unit,
    mean_of_keys,
)
from shadowtool.core.noise import NoiseModel

try:
    from shadowtool.core import _robust_plates as _compiled
except ImportError:
    # No compiler was there when this was installed.
    _compiled = None  # type: ignore[assignment]

Float32 = NDArray[np.float32]
Int16 = NDArray[np.int16]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]
Window = tuple[slice, slice]
Value = TypeVar("Value", np.int16, np.float32)

# A sample of this many frames tells the lit level.
SAMPLES = 28
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
# So many rows at a time stay in the processor's cache.
_ROWS = 32
# So many frames are taken in together, where they wait in no more bytes than these.
_TOGETHER, _WAITING = 8, 64 << 20
# Where more than this part of a window is darkened, all of it is gone through.
_DENSE = 0.12


class Keyed(NamedTuple):
    """A frame made ready for either reading.

    Attributes:
        keys: (H, W, 3) int16, the channels.
        gray: (H, W) int16, one key a pixel; those that are not seen are marked by `hide`.
        signed: whether a key may be negative.
        not_finite: how many pixels have a channel that is NaN or infinite.
    """

    keys: Int16
    gray: Int16
    signed: bool
    not_finite: int


def keyed(image: NDArray[np.floating], holdout: NDArray[np.number] | None = None) -> Keyed:
    """Make a frame (H, W, 3) ready; where ``holdout`` is above 0, or a channel isn't finite, the
    pixel is not seen."""
    halfs = image
    if image.dtype != np.float16:
        halfs = np.where(np.isfinite(image), np.clip(image, -65504, 65504), np.nan)
    halfs = np.ascontiguousarray(halfs, np.float16)
    keys = halfs.view(np.int16)
    gray = np.empty(keys.shape[:2], np.int16)
    signed, not_finite = False, 0
    for start in range(0, len(keys), _ROWS):
        rows = slice(start, start + _ROWS)
        own = finite_keys(halfs[rows])
        if own.signed:
            # Halfs are their own keys where none is negative.
            keys = keys if signed else keys.copy()
            keys[rows], signed = own.keys, True
        gray_keys(own.keys, own.signed, gray[rows])
        if own.bad is not None:
            hide(gray[rows], own.bad)
            not_finite += int(np.count_nonzero(own.bad))
    if holdout is not None:
        # NaN in a matte says nothing in favour of the pixel.
        hide(gray, np.asarray(~(holdout <= 0)))
    return Keyed(keys, gray, signed, not_finite)


def hide(gray: Int16, where: Bool) -> None:
    """Mark pixels of a frame's gray keys, (H, W), as not seen."""
    np.copyto(gray, _UNSEEN, where=where)


def _are_enough(frames: int, size: int) -> bool:
    """Whether frames of so many bytes wait for no others."""
    return frames >= _TOGETHER or (frames + 1) * size > _WAITING


class Levels(NamedTuple):
    """What a sample of frames says of each pixel: gray keys, (H, W) int16.

    Attributes:
        lit: the third highest.
        darkest: the lowest.
        shaded: the third lowest.
    """

    lit: Int16
    darkest: Int16
    shaded: Int16


class SampledLevels:
    """The three highest and the three lowest gray keys of each pixel in a sample of frames."""

    def __init__(self, height: int, width: int) -> None:
        shape = height, width
        self._highest = [np.full(shape, _LOWEST_KEY, np.int16) for _ in range(_OUTLIERS + 1)]
        self._lowest = [np.full(shape, _UNSEEN, np.int16) for _ in range(_OUTLIERS + 1)]
        self._waiting: list[Int16] = []

    def add(self, gray: Int16) -> None:
        """Take in the gray keys of one of the sample's frames, (H, W), which are not to change
        until `levels` is asked for: up to eight frames wait, or 64 MB of them.

        Raises:
            ValueError: it is of another size.
        """
        if gray.shape != self._lowest[0].shape:
            raise ValueError(f"a frame of {gray.shape} among frames of {self._lowest[0].shape}")
        if _compiled is None:
            self._add(gray)
            return
        self._waiting.append(gray)
        if _are_enough(len(self._waiting), gray.nbytes):
            self._take_in()

    def _take_in(self) -> None:
        waiting, self._waiting = self._waiting, []
        if waiting:
            _compiled.sample(tuple(waiting), (*self._highest, *self._lowest))

    def _add(self, gray: Int16) -> None:
        for start in range(0, len(gray), _ROWS):
            rows = slice(start, start + _ROWS)
            own = gray[rows]
            for lowest in self._lowest:
                held = lowest[rows]
                higher = np.maximum(held, own)
                np.minimum(held, own, out=held)
                own = higher
            own = gray[rows]
            if own.max() == _UNSEEN:
                own = np.where(own == _UNSEEN, _LOWEST_KEY, own)
            for highest in self._highest:
                held = highest[rows]
                lower = np.minimum(held, own)
                np.maximum(held, own, out=held)
                own = lower

    def levels(self) -> Levels:
        """What was found; where fewer than three frames saw the pixel, ``lit`` is the lowest of
        those, and ``shaded`` above all that is seen."""
        self._take_in()
        lit = self._highest[-1]
        for brighter in reversed(self._highest[:-1]):
            lit = np.where(lit == _LOWEST_KEY, brighter, lit)
        return Levels(lit, self._lowest[0], self._lowest[-1])


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


class _Members(NamedTuple):
    """Groups of frames, one of each of N pixels.

    Attributes:
        frames: (N,) float32, how many they are.
        gray: (N,) float32, the mean of their gray keys, counted from so far up that it is negative:
            a group of none, all 0, lies above every frame.
        total: (N, 3) float32, the sums of their channels' keys.
    """

    frames: Float32
    gray: Float32
    total: Float32

    def take(self, which: Index) -> "_Members":
        return _Members(*(values.take(which, axis=0) for values in self))


class _Group:
    """For each pixel of a picture a group of frames that agree: the fields of `_Members`."""

    def __init__(self, height: int, width: int) -> None:
        self.frames = np.zeros((height, width), np.float32)
        self.gray = np.zeros((height, width), np.float32)
        self.total = np.zeros((height, width, 3), np.float32)
        self._flat = _Members(self.frames.ravel(), self.gray.ravel(), self.total.reshape(-1, 3))

    @property
    def parts(self) -> tuple[Float32, Float32, Float32]:
        """What is known of it."""
        return self.frames, self.gray, self.total

    def at(self, where: Index) -> _Members:
        return self._flat.take(where)

    def put(self, where: Index, members: _Members) -> None:
        """Let pixels start with these."""
        for held, new in zip(self._flat, members, strict=True):
            held[where] = new

    def join(self, window: Window, frame: Keyed, dark: Bool, width: Float32) -> Bool:
        """Let the dark pixels of a window found groups, or join those within a width of them.

        Returns:
            Which of them are left.
        """
        frames, gray = self.frames[window], self.gray[window]
        distance = _below(frame.gray[window])
        distance -= gray
        joining = np.abs(distance) <= width[window]
        joining |= frames == 0
        joining &= dark
        frames += joining
        distance *= joining
        distance /= np.maximum(frames, 1)
        gray += distance
        _accumulate(frame, window, self.total, joining.view(np.uint8))
        return dark & ~joining

    def add(self, where: Index, single: _Members, width: Float32) -> tuple[Index, Index, _Members]:
        """Let groups of one join those within a width of them, or replace brighter ones.

        Returns:
            Which of them lie above and are left out; which replaced a group, and that group.
        """
        distance = single.gray - self._flat.gray.take(where)
        near = np.abs(distance) <= width
        joining, above = np.flatnonzero(near), np.flatnonzero(~near & (distance > 0))
        place = where.take(joining)
        frames, gray, total = self.at(place)
        frames += 1
        gray += distance.take(joining) / frames
        total += single.total.take(joining, axis=0)
        self.put(place, _Members(frames, gray, total))
        below = np.flatnonzero(~near & (distance < 0))
        place = where.take(below)
        replaced = self.at(place)
        self.put(place, single.take(below))
        known = np.flatnonzero(replaced.frames)
        return above, below.take(known), replaced.take(known)


class RobustPlates:
    """Means of the lit and of the fully shaded frames of each pixel.

    Where three frames of the sample agree on the darkest level, frames about it are shaded, and
    only what is darker still has to found groups.
    """

    def __init__(self, levels: Levels, noise: NoiseModel) -> None:
        """Args: the levels of the first reading, and the take's noise."""
        tables = _thresholds(noise)
        height, width = levels.lit.shape
        self._lit_low, self._lit_high, self._dark = (
            _looked_up(table, levels.lit) for table in (tables.low, tables.high, tables.dark)
        )
        self._near = _looked_up(tables.near, levels.lit)
        # From the least to the highest key of what is shaded; nothing is where that is not known.
        self._shaded_low, self._shaded_high = (np.empty((height, width), np.int16) for _ in "01")
        # Below this, frames found groups or join them.
        self._deep = np.empty((height, width), np.int16)
        for start in range(0, height, _ROWS):
            rows = slice(start, start + _ROWS)
            dark, shaded = self._dark[rows], levels.shaded[rows].astype(np.int32)
            reach = _looked_up(tables.reach, levels.shaded[rows])
            known = (shaded < dark) & (shaded - levels.darkest[rows] <= reach)
            low = np.maximum(shaded - reach, -32767)
            self._shaded_low[rows] = np.where(known, low, 1)
            self._shaded_high[rows] = np.where(known, np.minimum(shaded + reach, dark - 1), 0)
            self._deep[rows] = np.where(known, low, dark)
        # OpenCV's new arrays cost more than what is worked out in them.
        self._mask = np.empty((_ROWS, width), np.uint8)
        self._total = np.zeros((height, width, 3), np.float32)
        self._count = np.zeros((height, width), np.int32)
        # The next group is that of what is shaded where that is known.
        self._lowest, self._next = _Group(height, width), _Group(height, width)
        self._waiting: list[Keyed] = []

    def add(self, frame: Keyed) -> None:
        """Take in one frame, which is not to change until `measured` is asked for: up to eight
        frames wait, or 64 MB of them. Frames come in the order of the take.

        Raises:
            ValueError: it is of another size.
        """
        if frame.gray.shape != self._count.shape:
            raise ValueError(f"a frame of {frame.gray.shape} among frames of {self._count.shape}")
        if _compiled is None:
            self._add(frame)
            return
        self._waiting.append(frame)
        if _are_enough(len(self._waiting), frame.keys.nbytes + frame.gray.nbytes):
            self._take_in()

    def _take_in(self) -> None:
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        _compiled.add(
            tuple(part for frame in waiting for part in (frame.keys, frame.gray)),
            (
                *(self._lit_low, self._lit_high, self._dark),
                *(self._shaded_low, self._shaded_high, self._deep),
            ),
            self._near,
            (self._count, self._total),
            (*self._lowest.parts, *self._next.parts),
            _LEAST_GROUP,
        )

    def _add(self, frame: Keyed) -> None:
        founding = []
        for start in range(0, len(frame.gray), _ROWS):
            rows = slice(start, start + _ROWS)
            gray = frame.gray[rows]
            lit = self._mask[: len(gray)]
            cv2.inRange(gray, self._lit_low[rows], self._lit_high[rows], dst=lit)
            _accumulate(frame, (rows, slice(None)), self._total, lit)
            # As signed bytes the mask's 255 are -1.
            self._count[rows] -= lit.view(np.int8)
            dark = gray < self._dark[rows]
            columns = np.flatnonzero(dark.any(axis=0))
            if columns.size:
                window = rows, slice(int(columns[0]), int(columns[-1]) + 1)
                founding.append(self._darken(frame, window))
        if founding:
            self._found(frame, np.concatenate(founding))

    def _darken(self, frame: Keyed, window: Window) -> Index:
        """Take in a window's darkened pixels; those that are to found groups are left over."""
        gray = frame.gray[window]
        shaded = cv2.inRange(gray, self._shaded_low[window], self._shaded_high[window])
        self._next.frames[window] -= shaded.view(np.int8)
        _accumulate(frame, window, self._next.total, np.asarray(shaded, np.uint8))
        deep = gray < self._deep[window]
        if np.count_nonzero(deep) > _DENSE * deep.size:
            # Most join, and are quickest added where they stand.
            deep = self._lowest.join(window, frame, deep, self._near)
        rows, columns = np.divmod(np.flatnonzero(deep), deep.shape[1])
        place = (rows + window[0].start) * frame.gray.shape[1] + (columns + window[1].start)
        return np.asarray(place, np.intp)

    def _found(self, frame: Keyed, where: Index) -> None:
        """Let pixels, groups of one, join, found or pass over groups."""
        where = where[~self._settled(frame, where)]
        if not where.size:
            return
        single = _Members(
            np.ones(where.size, np.float32),
            _below(frame.gray.ravel().take(where)),
            frame.keys.reshape(-1, 3).take(where, axis=0).astype(np.float32),
        )
        width = self._near.ravel().take(where)
        above, below, replaced = self._lowest.add(where, single, width)
        unknown = self._shaded_low.ravel().take(where) > self._shaded_high.ravel().take(where)
        kept = np.flatnonzero(unknown.take(below))
        self._next.put(where.take(below.take(kept)), replaced.take(kept))
        above = above[unknown.take(above)]
        self._next.add(where.take(above), single.take(above), width.take(above))

    def _settled(self, frame: Keyed, where: Index) -> Bool:
        """Which pixels of a frame lie above a group that no brighter one can replace any more."""
        distance = _below(frame.gray.ravel().take(where)) - self._lowest.gray.ravel().take(where)
        above = distance > self._near.ravel().take(where)
        above &= self._lowest.frames.ravel().take(where) >= _LEAST_GROUP
        return above

    def measured(self) -> Measured:
        """The plates so far."""
        self._take_in()
        shape = self._count.shape
        lit, shadow = np.empty((*shape, 3), np.float32), np.full((*shape, 3), np.nan, np.float32)
        lit_frames, shadow_frames = self._count.astype(np.uint32), np.zeros(shape, np.uint32)
        for start in range(0, shape[0], _ROWS):
            rows = slice(start, start + _ROWS)
            lit[rows] = _mean(self._total[rows], self._count[rows].astype(np.float32))
            count, backup = self._lowest.frames[rows], self._next.frames[rows]
            # A group of one or two frames below a much larger one is a bird, not the shadow.
            stray = (count < _LEAST_GROUP) & (backup >= 2 * count)
            count = np.where(stray, backup, count)
            if count.any():
                total = self._lowest.total[rows].copy()
                cv2.copyTo(self._next.total[rows], stray.view(np.uint8), total)
                shadow[rows], shadow_frames[rows] = _mean(total, count), count
        # Never at its lit level: what it was all the time is all that is known of it.
        never = (lit_frames == 0) & (shadow_frames > 0)
        if never.any():
            lit[never] = shadow[never]
            lit_frames[never] = shadow_frames[never]
        return Measured(lit, shadow, lit_frames, shadow_frames)


def _mean(total: Float32, count: Float32) -> Float32:
    """Values, (H, W, 3), of sums of so many keys, (H, W); NaN of none."""
    return mean_of_keys(total, in_all_channels(count))


def _below(gray: Int16) -> Float32:
    """Gray keys counted from that of the unseen, negative."""
    return np.asarray(gray - np.float32(_UNSEEN), np.float32)


def _accumulate(frame: Keyed, window: Window, total: Float32, mask: NDArray[np.uint8]) -> None:
    """Add a window of a frame's keys to sums (H, W, 3) where the window's mask is not 0.

    Single floats hold the sums of 500 frames exactly, and are added to several times faster than
    integers of their size; of thousands they are off by a hundredth of a key.
    """
    keys, sums = frame.keys[window], total[window]
    if frame.signed:
        cv2.add(sums, keys, dst=sums, mask=mask, dtype=cv2.CV_32F)
    else:
        cv2.accumulate(keys.view(np.uint16), sums, mask)


class _Thresholds(NamedTuple):
    """Tables by the bits of a level's key.

    Attributes:
        low, high: (65536,) int16, the least and the highest key of what is lit, by the lit level.
        dark: (65536,) int16, the key below which it is darkened, by the lit level.
        near: (65536,) float32, how far a darkened frame may be from the group that it belongs to,
            by the lit level.
        reach: (65536,) int16, how far a frame may be from a level, by that.
    """

    low: Int16
    high: Int16
    dark: Int16
    near: Float32
    reach: Int16


def _thresholds(noise: NoiseModel) -> _Thresholds:
    levels = np.arange(1 << 16, dtype=np.uint16).view(np.int16)
    unsampled = levels == _LOWEST_KEY
    values = np.maximum(np.nan_to_num(from_keys(levels).astype(np.float32), posinf=65504), 0)
    sigma_at = _KeySigma(noise)
    sigma = sigma_at(values)
    middle = levels - _THIRD_HIGHEST * sigma
    low, high = _to_int16(middle - _LIT * sigma), _to_int16(middle + _LIT * sigma)
    dark = _to_int16(middle - _DARK * sigma)
    # Of a pixel that no sample showed, whatever frame does is taken.
    low[unsampled], high[unsampled] = _LOWEST_KEY, _UNSEEN - 1
    dark[unsampled] = _LOWEST_KEY
    # The noise of a shadow is that of a fraction of the light; which one hardly matters.
    shaded = np.maximum(values * np.float32(_SHADE), np.float32(1e-4))
    near = np.asarray(_GROUP * sigma_at(shaded), np.float32)
    return _Thresholds(low, high, dark, near, _to_int16(_GROUP * sigma))


def _looked_up(table: NDArray[Value], keys: Int16) -> NDArray[Value]:
    return np.asarray(cv2.LUT(np.ascontiguousarray(keys).view(np.uint16), table), table.dtype)


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
