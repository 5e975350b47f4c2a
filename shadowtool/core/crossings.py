"""Between which two frames of a pass each pixel loses half of its light, found in one reading.

Luminances are kept as halfs, and compared as the integers of `half_keys`.
"""

import sys
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import blocks
from shadowtool.core.half_floats import rounded, to_float
from shadowtool.core.half_keys import from_keys, to_keys

try:
    from shadowtool.core import _crossings
except ImportError:
    # No compiler was there when this was installed.
    _crossings = None  # type: ignore[assignment]

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Indices = NDArray[np.intp]

# Of what was brighter than this part of the lit value nothing is kept while a pass is read; so the
# crossing of pixels that lose less than twice as much in all may not be found.
_NEARLY_LIT = np.float32(0.96)
LEAST_CONTRAST = 2 * (1 - float(_NEARLY_LIT))
# What loses the rest up to 1 loses at least so many keys, if it is no less than the least normal
# half, 0.00006.
_NEARLY_LIT_KEYS = np.int16(41)
# How many frames are in hand, those that wait to be looked at together among them. Times of edges
# that take longer than about forty frames are not worth having.
_BYTES, _LEAST, _MOST = 2**28, 8, 30
_WAITING = 0.3
# Pixels that are looked at together: an array of as many keys is 1 MB. With fewer, this thread
# would wait for those that read at every step.
_BLOCK = 1 << 19
# The key of NaN, beyond all others; and one below all others.
_UNKNOWN, _LOWEST = np.int16(0x7E00), np.int16(-0x8000)
_INFINITE = 0x7C00


class Crossings(NamedTuple):
    """Between which two frames each pixel's luminance first fell below (I_min + I_max) / 2.

    Luminances, and this threshold, are rounded to halfs.

    Attributes:
        at: (H, W) int32, position of the later frame among those looked at, ≥ 1; 0 unknown.
        before, after: (H, W) float32, luminance in the frame before and in that one.
        lowest, highest: (H, W) float32, I_min and I_max of the pass.
        lost: (H, W) bool, unknown only because the frame that would tell was no longer kept.
        frames: how many were looked at.
    """

    at: Int32
    before: Float32
    after: Float32
    lowest: Float32
    highest: Float32
    lost: Bool
    frames: int

    def part(self, rows: slice) -> "Crossings":
        """Some rows; nothing is copied."""
        return Crossings._make([*(values[rows] for values in self[:-1]), self.frames])


class _State(NamedTuple):
    """What is known of each pixel, (P,); luminances as keys.

    Attributes:
        low, high: the extremes so far.
        lower: the lowest but for the last frame.
        at: the crossing's frame; 0, before which nothing is known, until one is found.
        after, before, earlier: in that frame, the one before, and the one before that.
        floor: the lowest that came before all these.
        lost: between the crossing and the one found before it, frames were no longer in hand.
    """

    low: Int16
    high: Int16
    lower: Int16
    at: Int32
    after: Int16
    before: Int16
    earlier: Int16
    floor: Int16
    lost: Bool

    def part(self, pixels: slice) -> "_State":
        return _State._make(values[pixels] for values in self)


class CrossingFinder:
    """Finds each pixel's first crossing of the half-way threshold in one reading of the pass.

    The threshold is known only at the end. But as long as nothing was darker than it is so far, the
    crossing lies ahead, and the first frame that is darker than it, is it. Only while an edge
    passes, and the threshold sinks with it, the crossing moves on to a later frame: that one is
    looked up among the last few, which are kept. Frames are looked at several at a time: most
    edges have passed then, and a pixel is looked at but once.

    What follows the leading edge makes no difference. A pixel that is below the threshold from the
    start has no crossing that was seen: unknown. Of pixels that never lose `LEAST_CONTRAST` of
    their light, crossings may be wrong.
    """

    def __init__(self, in_hand: int | None = None, together: int | None = None) -> None:
        """Args:
        in_hand: how many frames are kept, three or more; an edge may take one and a half times as
            many to pass. None for as many as are no burden to memory, and 30 at most.
        together: how many of them are looked at at a time; None for three tenths.
        """
        self._in_hand, self._together = in_hand, together
        self._waiting: list[Int16] = []
        self._frames = 0
        self._holes = False

    def add(self, gray: NDArray[np.floating]) -> int:
        """Take in one frame's luminance, (H, W), in the order of the pass.

        Where it is not finite, or too large for a half, the last value that was stands.

        Returns:
            In how many pixels that is so.
        """
        halfs = np.ascontiguousarray(rounded(gray)).ravel()
        keys, not_finite = halfs.view(np.int16), 0
        # Neither negative nor infinite nor NaN: bits are keys.
        if halfs.view(np.uint16).max() >= _INFINITE:
            last = self._last() if self._frames else np.full_like(keys, _UNKNOWN)
            finite = np.isfinite(halfs)
            not_finite = finite.size - int(np.count_nonzero(finite))
            keys = np.where(finite, to_keys(halfs), last)
            self._holes = self._holes or bool((keys == _UNKNOWN).any())
        if self._frames:
            self._waiting.append(keys)
            self._frames += 1
            if len(self._waiting) == self._together:
                self._settle()
        else:
            self._shape = gray.shape
            self._begin(keys)
        return not_finite

    def found(self) -> Crossings:
        """What was found; the end of the pass.

        Raises:
            ValueError: no frame was looked at.
        """
        if not self._frames:
            raise ValueError("no frame was looked at")
        self._settle()
        self._seen.clear()
        size = len(self._state.at)
        at, lost = np.empty(size, np.int32), np.empty(size, bool)
        before, after, low, high = (np.empty(size, np.float32) for _ in range(4))
        for pixels in blocks(size, _BLOCK):
            state = self._state.part(pixels)
            # Of what was never known both are NaN.
            low[pixels], high[pixels] = _value(state.low), _value(state.high)
            threshold = _midway(low[pixels], high[pixels])
            # Light that grew after the crossing has raised the threshold: it lies earlier.
            lost[pixels] = state.lost | (state.floor < threshold)
            late = (state.before < threshold) & ~lost[pixels]
            ends = (
                np.where(late, state.earlier, state.before),
                np.where(late, state.before, state.after),
            )
            unknown = lost[pixels] | (ends[0] == _UNKNOWN)
            at[pixels] = np.where(unknown, 0, state.at - late)
            before[pixels], after[pixels] = map(_value, ends)

        def plane(values: NDArray[Any]) -> NDArray[Any]:
            return values.reshape(self._shape)

        ends, extremes = (plane(before), plane(after)), (plane(low), plane(high))
        return Crossings(plane(at), *ends, *extremes, plane(lost), self._frames)

    def _last(self) -> Int16:
        return self._waiting[-1] if self._waiting else self._seen[-1]

    def _begin(self, keys: Int16) -> None:
        in_hand = self._in_hand or min(max(_BYTES // max(keys.nbytes, 1), _LEAST), _MOST)
        self._together = self._together or max(int(in_hand * _WAITING), 1)
        unknown = np.full_like(keys, _UNKNOWN)
        # Two more than are searched, for what came before the crossing.
        self._seen = deque([unknown, unknown, keys], maxlen=max(in_hand - self._together, 1) + 2)
        # As if all had crossed in the first frame.
        self._state = _State(
            low=keys.copy(),
            high=np.where(keys == _UNKNOWN, _LOWEST, keys),
            lower=unknown.copy(),
            at=np.zeros(len(keys), np.int32),
            after=keys.copy(),
            before=unknown.copy(),
            earlier=unknown.copy(),
            floor=unknown.copy(),
            lost=np.zeros(len(keys), bool),
        )
        self._frames = 1

    def _settle(self) -> None:
        """Look at the frames that wait."""
        if not self._waiting:
            return
        seen, new = list(self._seen), self._waiting
        number = self._frames - len(new)
        if _crossings is not None and sys.byteorder == "little":
            first = number - len(seen)
            least = float(_NEARLY_LIT), int(_NEARLY_LIT_KEYS)
            _crossings.settle(self._state, seen + new, len(seen), first, *least)
        else:
            for pixels in blocks(len(self._state.at), _BLOCK):
                old, fresh = ([frame[pixels] for frame in frames] for frames in (seen, new))
                _look(self._state.part(pixels), old, fresh, number, self._holes)
        self._seen.extend(self._waiting)
        self._waiting.clear()
        self._holes = False


class SecondLook:
    """Finds the crossings that were lost, in another reading of the pass.

    Now that the threshold is known, the first frame that is below it is the crossing.
    """

    def __init__(self, found: Crossings, wanted: Bool) -> None:
        """Args:
        found: what `CrossingFinder` found in the same frames.
        wanted: (H, W), pixels whose crossing is looked for.
        """
        self._found = found
        self._pixels = np.flatnonzero(wanted)
        low, high = (plane.ravel()[self._pixels] for plane in (found.lowest, found.highest))
        self._threshold = to_float(rounded((low + high) / np.float32(2)))
        self._last = np.full(len(self._pixels), np.nan, np.float32)
        self._before, self._after = self._last.copy(), self._last.copy()
        self._at = np.zeros(len(self._pixels), np.int32)
        self._open = np.ones(len(self._pixels), bool)
        self._frames = 0

    def add(self, gray: NDArray[np.floating]) -> None:
        """Take in one frame's luminance, (H, W), in the order of the pass."""
        values = to_float(rounded(gray).ravel()[self._pixels])
        values = np.where(np.isfinite(values), values, self._last)
        crossed = self._open & (values < self._threshold)
        self._at[crossed] = self._frames
        self._before[crossed], self._after[crossed] = self._last[crossed], values[crossed]
        self._open &= ~crossed
        self._last = values
        self._frames += 1

    def found(self) -> Crossings:
        """All that is known, the end of the pass."""
        at, lost = self._found.at.copy(), self._found.lost.copy()
        before, after = self._found.before.copy(), self._found.after.copy()
        seen = (self._at > 0) & np.isfinite(self._before)
        at.ravel()[self._pixels] = np.where(seen, self._at, 0)
        before.ravel()[self._pixels], after.ravel()[self._pixels] = self._before, self._after
        lost.ravel()[self._pixels] = False
        return self._found._replace(at=at, before=before, after=after, lost=lost)


def _look(
    state: _State, seen: Sequence[Int16], new: Sequence[Int16], number: int, holes: bool
) -> None:
    """Look at new frames, the first of which has the number, for pixels that cross their threshold
    in them; `_crossings.c` does the same without arrays of places.

    Only where a frame is the darkest so far can the crossing move.

    Args:
        holes: whether anything in the new frames is unknown.
    """
    lower, high = state.low.copy(), state.high
    for frame in new:
        np.maximum(high, np.where(frame == _UNKNOWN, _LOWEST, frame) if holes else frame, out=high)
    for frame in new[:-1]:
        np.minimum(lower, frame, out=lower)
    low = np.minimum(lower, new[-1])
    darker = low < np.minimum(state.low, high - _NEARLY_LIT_KEYS)
    if low.min() >= 0:
        # The crossing found last stands as long as the threshold is above it. Keys are concave
        # in the light, so the threshold's is no less than the mean of theirs.
        darker &= state.after >= (low >> 1) + (high >> 1)
    pixels = np.flatnonzero(darker)
    lit, dark = _value(high.take(pixels)), low.take(pixels)
    threshold = _midway(_value(dark), lit)
    # What is nearly as bright as it ever was crosses no threshold that matters in the end.
    nearly_lit = to_keys(rounded(_NEARLY_LIT * lit))
    crossed = np.flatnonzero((dark < nearly_lit) & (state.after.take(pixels) >= threshold))
    pixels, threshold = pixels.take(crossed), threshold.take(crossed)
    nearly_lit = nearly_lit.take(crossed)
    before = state.low.take(pixels)
    fresh = before >= np.minimum(threshold, nearly_lit)
    begun, old = pixels[fresh], pixels[~fresh]
    # Darker by noise long before, and an edge that takes several frames to pass: where it
    # begins can't be told.
    aged = before[fresh] < nearly_lit[fresh]
    aged &= number - state.at.take(begun) > len(seen) - 1
    doubtful = aged | state.lost.take(begun)
    _creep(state, high, begun[doubtful], aged[doubtful], new)
    # As if they had crossed in the frame before.
    last = np.full(len(begun), number - 1), seen[-1].take(begun), state.lower.take(begun)
    _search(state, begun, threshold[fresh], last, [*seen[-2:], *new], number - 2)
    number -= len(seen)
    floor = np.minimum(state.floor[old], state.before[old])
    last = state.at[old], state.after[old], floor
    # What passed between the old crossing and the frames in hand can't be told.
    state.lost[old] |= last[0] < number + 1
    _search(state, old, threshold[~fresh], last, [*seen, *new], number)
    state.lower[:], state.low[:] = lower, low


def _creep(
    state: _State, high: Int16, pixels: Indices, aged: Bool, frames: Sequence[Int16]
) -> None:
    """Lose pixels that fall by many small steps, and find those again that then fall at once.

    Of the first the threshold sinks below the crossing found last only when they are darker than
    that already.

    Args:
        aged: (P,), whose crossing found last is too long ago to look up what came after it.
    """
    low, lit = state.low.take(pixels), _value(high.take(pixels))
    after = state.after.take(pixels)
    lost, passed = state.lost.take(pixels), np.zeros(len(pixels), bool)
    for frame in frames:
        values = frame.take(pixels)
        threshold = _midway(_value(values), lit)
        darker = values < low
        falls = darker & (low >= threshold)
        slips = darker & ~falls & ~passed & (after >= threshold)
        lost = (lost | (slips & aged)) & ~falls
        passed |= falls | slips
        np.minimum(low, values, out=low)
    state.lost[pixels] = lost


def _search(
    state: _State,
    pixels: Indices,
    threshold: Int16,
    last: tuple[NDArray[np.signedinteger[Any]], Int16, Int16],
    frames: Sequence[Int16],
    first: int,
) -> None:
    """Move the crossing of these pixels to the first later frame that is below the threshold.

    Args:
        last: for each pixel, the crossing found last: its number, its luminance, and the lowest
            before it.
        frames: where to look; the first two are for what comes before the crossing alone.
        first: the number of the first of them.
    """
    count = len(pixels)
    if not count:
        return
    old, after, floor = last[0] - first, *last[1:]
    start = max(int(old.min()) - 1, 0)
    old, first, frames = old - start, first + start, frames[start:]
    values, lowest = (np.empty((len(frames), count), np.int16) for _ in range(2))
    for row, frame in enumerate(frames):
        values[row] = frame.take(pixels)
    # The lowest since the old crossing, which itself is not among them.
    so_far, latest = np.full(count, _UNKNOWN), int(old.max())
    found = np.full(count, 2, np.uint8)
    for row, own in enumerate(values):
        since = np.where(row <= old, _UNKNOWN, own) if row <= latest else own
        so_far = np.minimum(since, so_far, out=lowest[row])
        if row >= 2:
            found += (so_far >= threshold).view(np.uint8)
    place = found * np.intp(count)
    place += np.arange(count)
    state.at[pixels] = first + found.astype(np.int32)
    every = values.ravel()
    state.after[pixels] = every.take(place)
    place -= count
    state.before[pixels] = every.take(place)
    place -= count
    state.earlier[pixels] = every.take(place)
    passed = found - 2 >= old
    floor = np.where(passed, np.minimum(floor, after), floor)
    state.floor[pixels] = np.minimum(floor, lowest.ravel().take(place))


def _value(keys: Int16) -> Float32:
    return to_float(from_keys(keys))


def _midway(low: Float32, high: Float32) -> Int16:
    """The threshold's key."""
    return to_keys(rounded((low + high) / np.float32(2)))
