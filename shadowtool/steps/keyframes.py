"""Trimaps drawn for some frames of a take, and what becomes of them in the others."""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Missing
from shadowtool.core.camera_motion import Place
from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN
from shadowtool.core.trimap_flow import Carried, Link, carry, flow_picture, links, merge
from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.image import read_header, read_image
from shadowtool.io.sequence import Frame, Sequence
from shadowtool.steps.footage import Footage, moved_with, require_frames

UInt8 = NDArray[np.uint8]

# What is nearly black or white in a trimap. Grey stays grey, 0.21, if a program has taken it for
# sRGB-encoded and made it linear.
_BLACK, _WHITE = 0.1, 0.9
# From further away nothing comes through. A frame's links lead as far to either side, and the next
# frame's are the same but for one.
_FURTHEST = 24
_NEXT = 8


@dataclass(frozen=True)
class Keyframes:
    """The trimaps that were drawn.

    Attributes:
        drawn: their files.
        footage: the take.
        links: between two frames, there and back.
        readable: whether a frame can be read.
    """

    drawn: Sequence
    footage: Footage
    links: Callable[[Frame, Frame], tuple[Link, Link]]
    readable: Callable[[Frame], bool]

    @classmethod
    def of(cls, drawn: Sequence, footage: Footage, missing: Missing) -> "Keyframes":
        """Raises InputError if they don't fit the take."""
        frames = [frame for frame in drawn.files if frame in footage.sequence.files]
        if not frames:
            raise InputError(
                f"{drawn.pattern}: has none of the frames of {footage.sequence.pattern};"
                " number the trimaps as the frames are"
            )
        require_frames(drawn, frames, footage.header, footage.sequence.pattern, missing)

        def between(here: Frame, there: Frame) -> tuple[Link, Link]:
            return links(*(flow_picture(footage.read(frame)) for frame in (here, there)))

        @cache
        def readable(frame: Frame) -> bool:
            try:
                footage.read(frame)
            except DamagedFileError:
                return False
            return True

        # Where damage is an error, reading for the links says so.
        passed = readable if missing == "skip" else lambda frame: True
        return cls(drawn, footage, lru_cache(2 * _FURTHEST + _NEXT)(between), passed)

    def sources(self, frame: Frame) -> list[Path]:
        """What a frame's trimap is made of."""
        files = [self.drawn.path(key) for key in self._keys(frame)]
        for key in self._keys(frame):
            files += [self.footage.sequence.path(step) for step in self._way(frame, key)[1:]]
        return files

    def trimap(self, frame: Frame, place: Place) -> UInt8:
        """A frame's trimap, (H, W) uint8: as drawn, or carried from the keyframes beside it; all
        unknown if they are too far away.

        Args:
            place: where the frame is moved, as of `Footage.off`; trimaps are drawn on what the
                camera saw.
        """
        keys = self._keys(frame)
        sides = [self._carried(frame, key) for key in keys]
        if not sides:
            width, height = self.footage.header.size
            return np.full((height, width), UNKNOWN, np.uint8)
        whole = merge(sides)
        if place == (0.0, 0.0):
            return whole
        path = self.drawn.path(keys[0])
        moved = moved_with(whole / np.float32(FIGURE), path, read_header(path), place)
        return _three_levels(moved, 1 / 4, 3 / 4)

    def _keys(self, frame: Frame) -> list[Frame]:
        """The keyframe itself, or those before and after that are near enough."""
        keys = sorted(key for key in self.drawn.files if key in self.footage.sequence.files)
        before = keys[: bisect_right(keys, frame)][-1:]
        after = keys[bisect_left(keys, frame) :][:1]
        keys = before if before == after else before + after
        return [key for key in keys if len(self._way(frame, key)) <= _FURTHEST + 1]

    def _way(self, frame: Frame, key: Frame) -> list[Frame]:
        """The take's frames from one to a keyframe, both included."""
        low, high = min(frame, key), max(frame, key)
        way = [step for step in self.footage.sequence.frames if low <= step <= high]
        return way if frame <= key else way[::-1]

    def _carried(self, frame: Frame, key: Frame) -> Carried:
        way = [step for step in self._way(frame, key) if self.readable(step)]
        return carry(trimap_of(self.drawn.path(key)), [self._link(*pair) for pair in pairwise(way)])

    def _link(self, here: Frame, there: Frame) -> Link:
        there_and_back = self.links(min(here, there), max(here, there))
        return there_and_back[0] if here < there else there_and_back[1]


def trimap_of(path: Path) -> UInt8:
    """A trimap from a file, (H, W) uint8: what is nearly black or white, and the rest unknown."""
    return _three_levels(np.nan_to_num(read_image(path).plane("Y")), _BLACK, _WHITE)


def _three_levels(plane: NDArray[np.floating], black: float, white: float) -> UInt8:
    """A trimap of what is below a value, above another, and between."""
    trimap = np.full(plane.shape, UNKNOWN, np.uint8)
    trimap[plane < black] = BACKGROUND
    trimap[plane > white] = FIGURE
    return trimap
