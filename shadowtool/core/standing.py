"""Ground before which somebody stood so long that it was seen no more often than he.

Of two things that were each seen in one place for long, the ground is the one that goes on beyond
the place's outline: a figure ends there.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.color_line import Weighed
from shadowtool.core.regions import closed, grown, large_parts, parts, shrunk
from shadowtool.core.samples import mean_where

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

# Something else was there for long if so many samples, and this part of all, agree on it; beside
# somebody who is known to have stood there, so many. They agree within so many standard deviations
# of anything between a colour and this part of it.
_LEAST_SAMPLES, _LEAST_PART, _LEAST_BESIDE = 3, 0.08, 2
_ON_LINE, _DIMMED = 4.0, 0.97
# A place is at least this part of the picture, and so many points.
_LEAST_PLACE, _FEW = 1 / 4000, 6
# The outline is so many points wide, and compared with what lies from so many points beyond it up
# to so many.
_RIM, _GAP, _AROUND = 2, 2, 9
# Logarithms of colours, over the three channels together, count up to this much. What goes on
# differs by less than this part of what the other thing does.
_MOST_OFF, _GOES_ON = 1.5, 0.8
# A point is of a place if it was now this, now that, when most of the place was; 1 would be at
# exactly the same times, which are found in so many rounds.
_TOGETHER, _ROUNDS = 0.7, 4
# Shade has everywhere the same part of the light, but for so much, a logarithm.
_SHADE_SCATTER = 0.15
# More than this part of a place's points is most of them.
_MOSTLY = 0.5
# At some time a place was the one thing if this part of it was that, more than the other.
_THEN = 0.5
# Up to so many points around a place the same figure is what was seen in this part of his time.
_BESIDE, _STILL = 12, 0.7


class _Other(NamedTuple):
    """What else each of N points showed for long.

    Attributes:
        colour: (3, N), in light.
        seen: (T, N), in which samples, in light or in shade.
        often: (N,), whether it was long enough.
    """

    colour: Float32
    seen: Bool
    often: Bool


@dataclass(frozen=True)
class Sampled:
    """What a sample of a take's frames shows on a grid, as far as it is known.

    Attributes:
        stack: (T, 3, N), the samples in the order of the take.
        weighed: the same.
        lit: (3, N), what is taken for lit ground.
        ratio: (3, N), S/L.
        size: the grid's rows and columns.
    """

    stack: Float32
    weighed: list[Weighed]
    lit: Float32
    ratio: Float32
    size: tuple[int, int]

    @cached_property
    def on_line(self) -> Bool:
        """(T, N), which samples what is taken for ground explains, in light or in shade."""
        return _explained(self.weighed, self.lit, self.ratio)

    def uncovered(self) -> "Sampled":
        """The same with ``lit`` that of ground also where somebody who stood for long was taken for
        it; itself if nobody was.

        A surface in shade is told from somebody dark by what it has of the light, which is the
        same all over it.
        """
        found = self.lit.copy()
        least = max(_LEAST_PART * len(self.stack), _LEAST_SAMPLES)
        other = self._most_often(~self.on_line, least)
        places = other.often.reshape(self.size)
        for place in _places(places):
            then = self._uncover(found, other, place, ~places)
            if then is not None:
                self._beside(found, then, place, ~places)
        return self if np.array_equal(found, self.lit) else replace(self, lit=found)

    def _most_often(self, off: Bool, least: float) -> _Other:
        """What explains most of a point's samples that are ``off``, (T, N), if at least so many
        show it in light."""
        points = np.flatnonzero(off.sum(axis=0) >= least)
        off = off[:, points]
        samples = [sample.take(points) for sample in self.weighed]
        ratio = self.ratio[:, points]
        most = np.zeros(points.size, np.intp)
        seen, lit = np.zeros_like(off), np.zeros_like(off)
        for colours, own in zip(self.stack, off, strict=True):
            # What was found may already explain all that there is.
            tried = np.flatnonzero(own & (most < off.sum(axis=0)))
            candidate = colours[:, points[tried]]
            remaining = [sample.take(tried) for sample in samples]
            alike = _explained(remaining, candidate, np.float32(_DIMMED)) & off[:, tried]
            explained = _explained(remaining, candidate, ratio[:, tried]) & off[:, tried]
            score = explained.sum(axis=0) * (alike.sum(axis=0) >= least)
            better = score > most[tried]
            place = tried[better]
            most[place] = score[better]
            seen[:, place], lit[:, place] = explained[:, better], alike[:, better]
        whole_lit, whole_seen = (np.zeros(self.on_line.shape, bool) for _ in "01")
        whole_lit[:, points], whole_seen[:, points] = lit, seen
        often = np.zeros(self.on_line.shape[1], bool)
        often[points] = most >= least
        colour, _ = mean_where(self.stack, whole_lit)
        return _Other(colour, whole_seen, often)

    def _uncover(
        self, found: Float32, other: _Other, place: Bool, free: Bool
    ) -> NDArray[np.float64] | None:
        """Put what goes on around a place into what was found, if that is not there yet.

        Returns:
            (T,), when ground was seen, 1, and when the figure, -1; None if nothing was changed.
        """
        points = np.flatnonzero(place)
        change = self.on_line[:, points].astype(np.float64) - other.seen[:, points]
        pattern = change[:, np.argmax(np.abs(change).sum(axis=0))]
        for _ in range(_ROUNDS):
            turned = pattern @ change < 0
            pattern = np.where(turned, -change, change).mean(axis=1)
        lengths = np.linalg.norm(pattern) * np.linalg.norm(change, axis=0)
        together = np.abs(pattern @ change) > _TOGETHER * lengths
        points, turned = points[together], turned[together]
        first = np.where(turned, other.colour[:, points], self.lit[:, points])
        second = np.where(turned, self.lit[:, points], other.colour[:, points])
        off = _off_around(place, free, points, (first, second), self.lit)
        if off is None or min(off) > _GOES_ON * max(off):
            return None
        ground, figure, changed, then = (
            (first, second, turned, pattern)
            if off[0] < off[1]
            else (second, first, ~turned, -pattern)
        )
        if not changed.any() or _is_shade(ground[:, changed], figure[:, changed]):
            return None
        mistaken = points[changed]
        if self._passed(self.on_line[:, mistaken], other.seen[:, mistaken]):
            return None
        found[:, mistaken] = ground[:, changed]
        return then

    @staticmethod
    def _passed(ground: Bool, other: Bool) -> bool:
        """Whether most points, (T, N), showed what is taken for ground both before and after the
        other thing: that then came by and went, however well it goes with what is around."""
        begun, ended = (
            np.argmax(one, axis=0) < np.argmax(two, axis=0)
            for one, two in ((ground, other), (ground[::-1], other[::-1]))
        )
        return bool((begun & ended).mean() > _MOSTLY)

    def _beside(self, found: Float32, then: NDArray[np.float64], place: Bool, free: Bool) -> None:
        """Uncover ground beside a place that was uncovered, too, if the same figure stood there."""
        his, without = then <= -_THEN, then >= _THEN
        if not his.any():
            # Of whoever passes no two points show much at a time.
            return
        near = grown(place, _BESIDE).ravel()
        near &= (found == self.lit).all(axis=0)
        near &= self.on_line[his].mean(axis=0) >= _STILL
        off = ~self.on_line & without[:, np.newaxis] & near
        other = self._most_often(off, _LEAST_BESIDE)
        beside = other.often.reshape(self.size)
        for part in _places(beside):
            points = np.flatnonzero(part)
            things = other.colour[:, points], self.lit[:, points]
            off_around = _off_around(part, free & ~beside, points, things, self.lit)
            if off_around is None or off_around[0] > _GOES_ON * off_around[1]:
                continue
            if not _is_shade(*things):
                found[:, points] = things[0]


def _explained(samples: list[Weighed], lit: Float32, ratio: Float32 | np.float32) -> Bool:
    # Once for all samples.
    lit = np.ascontiguousarray(lit)
    shadow = np.ascontiguousarray(lit * ratio)
    return np.stack([sample.line_distance(lit, shadow) <= _ON_LINE for sample in samples])


def _places(mask: Bool) -> Iterator[Bool]:
    """The connected parts of a mask, (h, w), that are large enough; small gaps part nothing."""
    for part in parts(large_parts(closed(mask, 1), max(_LEAST_PLACE * mask.size, _FEW))):
        yield part & mask


def _off_around(
    place: Bool, free: Bool, points: Index, things: tuple[Float32, Float32], lit: Float32
) -> list[float] | None:
    """By how much each of two things, (3, P), differs at a place's outline from what is around;
    None if nothing can be seen there."""
    mask = closed(place, 1)
    inner = shrunk(mask, _RIM)
    away = (free & ~grown(mask, _GAP)).astype(np.float32)
    window = (2 * _AROUND + 1, 2 * _AROUND + 1)

    def total(values: Float32) -> Float32:
        summed = cv2.boxFilter(values, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(summed.ravel()[points], np.float32)

    weight = total(away)
    rim = ~inner.ravel()[points] & (weight >= _FEW)
    if np.count_nonzero(rim) < _FEW:
        return None
    planes = _logarithm(lit).reshape(3, *place.shape)
    around = np.stack([total(away * plane) for plane in planes]) / np.maximum(weight, 1)
    differs = (np.abs(_logarithm(thing) - around).sum(axis=0)[rim] for thing in things)
    return [float(np.minimum(values, _MOST_OFF).mean()) for values in differs]


def _is_shade(dark: Float32, light: Float32) -> bool:
    """Whether one thing, (3, P), is the other in shade: darker by the same everywhere."""
    ratio = _logarithm(dark) - _logarithm(light)
    return bool((np.median(ratio, axis=1) < 0).all() and (ratio.std(axis=1) < _SHADE_SCATTER).all())


def _logarithm(colours: Float32) -> Float32:
    return np.log(np.maximum(colours, np.float32(1e-4)))
