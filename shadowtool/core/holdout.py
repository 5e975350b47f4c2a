"""Keeping the figure out of the plates without any roto.

What a locked-off camera sees of the background lies on the line from S to L through each pixel; a
figure, for most of its pixels, does not. The lines are found from a sample of the frames on a thin
grid: L is the value on whose line most of a pixel's samples lie, S is L times the ratio that the
scene's shadows have in common.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import blocks
from shadowtool.core.color_line import Weighed, channels, line_distance
from shadowtool.core.common_ratio import common_ratio, ratio_scatter, usually_bright
from shadowtool.core.noise import NoiseModel
from shadowtool.core.ordering import ascending
from shadowtool.core.regions import large_parts
from shadowtool.core.samples import mean_where, ranked
from shadowtool.core.standing import Sampled

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

# A sample lies on a line within this many standard deviations, of its noise and this part of its
# value together.
_ON_LINE, _TOLERANCE = 4.0, 0.01
# Less than this part of its light is darkened. A take in which a shadow darkens more of the picture
# than the next, and so much at once, is that of a card waved over a scene.
_SHADED, _MOST, _AT_ONCE = 0.5, 0.5, 0.2
# So is one in which it darkens as much of both, a geometric mean, as the first of these, and more
# by so many times of what tells of somebody: what is brighter than lit ground, by a part, counted
# so many times; and in dark clothes what is darkened off the line differs from frame to frame by
# more than a factor.
_LARGE, _SOMEBODY = 0.09, 0.6
_BRIGHTER, _COUNTED, _DIFFERS = 0.1, 7.0, 1.35
# Where S/L scatters from point to point a sample may be off by this part of that too, up to the
# second; and where it does by more than the third, a logarithm, so many times of it make S darker:
# most of the ground is on the line then.
_ROUGHNESS, _ROUGHEST, _EVEN, _DARKER = 0.5, 0.05, 0.1, 2.0
# Where shadows have no ratio in common.
_ANY_RATIO = 0.25
# From the first to the second β a sample is neither in light nor in shade, and counts so much.
_SHADE_ENDS, _LIGHT_BEGINS, _BETWEEN = 0.15, 0.85, 0.75
# Candidates for L are every so many of a pixel's samples, dark to bright.
_EVERY = 2
# Pixels that are looked at together: what is known of each of their samples stays in the cache.
_BLOCK = 1 << 14
# Decided pixels are dropped when no more than this part is left.
_WORTHWHILE = 0.75
# A part of the scene in shade that the common ratio does not explain: so many samples at least.
_LEAST_SHADED = 3
# Of textured ground a figure hides the texture: its logarithm over that of L scatters by more
# than this within a few pixels.
_TEXTURE = 0.12
# A figure is at least this part of the picture, and so many grid points; of nine that lie together
# more than this part are its.
_LEAST_FIGURE, _FEW, _SUPPORT = 1 / 4000, 6, 0.4


@dataclass(frozen=True)
class Background:
    """Each grid point's line from S to L.

    Attributes:
        lit, shadow: (h, w, 3) float32.
        noise: the take's.
        under_card: whether a shadow came over most of the picture: that is a card waved over a
            scene whose surfaces have each their own S/L, for which these lines don't stand, and
            nobody is in it.
        tolerance: by what part of its value a sample may be off its line besides the noise.
        ratio: (3,), the median of S/L that the scene's shadows have in common; None if they have
            none.
    """

    lit: Float32
    shadow: Float32
    noise: NoiseModel
    under_card: bool
    tolerance: float
    ratio: Float32 | None


def find_background(samples: list[Float32], noise: NoiseModel) -> Background:
    """The background's lines from a sample of the take's frames on the grid.

    Args:
        samples: frames spread over the take, each (h, w, 3).
    """
    shape = samples[0].shape
    stack = np.stack([channels(sample) for sample in samples])
    stack = np.nan_to_num(stack, copy=False, nan=0.0, posinf=1e4, neginf=0.0)
    weighed = [Weighed(colours, noise, _TOLERANCE) for colours in stack]
    order = np.ascontiguousarray(ascending(np.ascontiguousarray(stack.sum(axis=1).T)).T)
    bright = usually_bright(stack, order)
    common = common_ratio(stack, bright, order, noise, shape[:2])
    ratio = np.full(stack.shape[1:], _ANY_RATIO, np.float32) if common is None else common
    lit = np.empty_like(ratio)
    for part in blocks(lit.shape[1], _BLOCK):
        samples_part = [sample.part(part) for sample in weighed]
        of_points = stack[..., part], order[:, part], samples_part, ratio[:, part]
        lit[:, part] = _most_supported(*of_points)
    known = Sampled(stack, weighed, lit, ratio, shape[:2]).uncovered()
    lit, on_line = known.lit, list(known.on_line)
    shadow = lit * ratio
    under_card = _under_a_card(stack, on_line, lit)
    shadow = _deeper_shade(stack, on_line, lit, shadow, shape[:2])
    scatter = 0.0 if common is None else ratio_scatter(stack, bright, noise, ratio, shape[:2])
    if scatter > _EVEN:
        shadow *= np.float32(math.exp(-_DARKER * scatter))
    tolerance = _TOLERANCE + min(_ROUGHNESS * scatter, _ROUGHEST)
    lit, shadow = (np.ascontiguousarray(plate.T).reshape(shape) for plate in (lit, shadow))
    told = None if common is None else np.median(common, axis=1)
    return Background(lit, shadow, noise, under_card, tolerance, told)


def figure_mask(image: Float32, background: Background) -> Bool:
    """Where a frame on the grid, (h, w, 3), shows something that is not the background."""
    line = background.lit, background.shadow, background.noise, background.tolerance
    off = line_distance(image, *line) > _ON_LINE
    # A lone grid point may be noise; a figure is connected, and its holes are its own.
    support = cv2.boxFilter(off.astype(np.float32), -1, (3, 3))
    solid = (off & (support > _SUPPORT)).view(np.uint8)
    solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, _disk(3)).astype(np.uint8)
    large = large_parts(solid > 0, max(_LEAST_FIGURE * solid.size, _FEW))
    return np.asarray(cv2.dilate(large.view(np.uint8), _disk(2)) > 0)


def _disk(radius: int) -> UInt8:
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def _on_line(sample: Weighed, lit: Float32, shadow: Float32) -> Bool:
    return np.asarray(sample.line_distance(lit, shadow) <= _ON_LINE)


def _most_supported(
    stack: Float32, ascending: Index, weighed: list[Weighed], ratio: Float32
) -> Float32:
    """For each pixel the sample on whose line, as L, most of the samples lie.

    That they are spread over the take counts half as much as their number: ground is seen before
    and after a figure that stops for a while. Samples between L and S count less: before whom that
    is brighter all ground is as if in a penumbra of his, where most of it is in light or in shade.
    """
    lit = np.zeros(stack.shape[1:], np.float32)
    best = np.full(stack.shape[2], -1, np.float32)
    most = len(stack) + (len(stack) - 1) / 2
    pixels, remaining = np.arange(best.size), weighed
    for order in ascending[::-_EVERY]:
        # Where all the samples agree already nothing can be better.
        undecided = best[pixels] < most
        if undecided.sum() < _WORTHWHILE * undecided.size:
            pixels = pixels[undecided]
            remaining = [sample.take(np.flatnonzero(undecided)) for sample in remaining]
        candidate = ranked(stack, order, pixels)
        score = _support(remaining, candidate, candidate * ratio[:, pixels])
        better = score > best[pixels]
        best[pixels[better]] = score[better]
        lit[:, pixels[better]] = candidate[:, better]
    # The mean of the samples that agree with it is less noisy than the sample.
    near = [_on_line(sample, lit, lit * np.float32(0.97)) for sample in weighed]
    mean, count = mean_where(stack, near)
    return np.where(count > 0, mean, lit)


def _support(samples: list[Weighed], lit: Float32, shadow: Float32) -> Float32:
    """How many samples lie on each pixel's line, those between its ends for less, and half the time
    between first and last."""
    end = np.float32(len(samples))
    votes, first, last = (np.zeros(lit.shape[1], np.float32) for _ in range(3))
    for time, sample in enumerate(samples):
        distance, part = sample.nearest(lit, shadow)
        vote = (distance <= _ON_LINE).astype(np.float32)
        between = (part > _SHADE_ENDS) & (part < _LIGHT_BEGINS)
        votes += vote * (1 - between * np.float32(1 - _BETWEEN))
        # How early, counted from the end, so that 0 is none for either.
        np.maximum(first, vote * (end - np.float32(time)), out=first)
        np.maximum(last, vote * np.float32(time), out=last)
    return np.asarray(votes + np.maximum(first + last - end, 0) / 2, np.float32)


def _under_a_card(stack: Float32, on_line: list[Bool], lit: Float32) -> bool:
    """Whether a shadow came over much of the picture, and over much of it at once.

    What is dark may be clothes, and is shadow for certain where the common ratio says so, but not
    all of a scene has the same: both count. A surface that has another ratio is darkened to the
    same each time, and only to that; where a figure passes, what is dark off the line is now this
    and now that, and its shadow, which is on the line, falls there, too. And hardly anything but a
    figure is brighter than lit ground.
    """
    light = lit.sum(axis=0)
    dark, shaded, others = (np.zeros(light.size, np.int32) for _ in range(3))
    least, most = np.full(light.size, np.inf, np.float32), np.zeros(light.size, np.float32)
    at_once, brighter = np.zeros((len(stack), 2)), 0.0
    for sample, lies, parts in zip(stack, on_line, at_once, strict=True):
        value = sample.sum(axis=0)
        now = value < _SHADED * light
        dark += now
        shaded += now & lies
        parts[:] = now.mean(), (now & lies).mean()
        off = now & ~lies
        others += off
        np.minimum(least, value, out=least, where=off)
        np.maximum(most, value, out=most, where=off)
        above = (sample > (1 + _BRIGHTER) * lit + _TOLERANCE).any(axis=0)
        brighter += float((above & ~lies).mean()) / len(stack)
    altogether = [float((often >= 2).mean()) for often in (dark, shaded)]
    widest = at_once.max(axis=0)
    if altogether[1] > _MOST or (altogether[0] > _MOST and widest[0] > _AT_ONCE):
        return True
    differs = (others >= 2) & (most > _DIFFERS * least)
    both = (others > 0) & (shaded > 0)
    somebody = float(differs.mean() + both.mean() / 2) / max(altogether[0], 1e-6)
    somebody += _COUNTED * brighter
    # A small card may come to each place but once.
    passed = [float((often >= 1).mean()) for often in (dark, shaded)]
    large = math.prod((*passed, *widest)) ** 0.25
    return bool(large > _LARGE + _SOMEBODY * somebody)


def _deeper_shade(
    stack: Float32, on_line: list[Bool], lit: Float32, shadow: Float32, size: tuple[int, int]
) -> Float32:
    """S of surfaces that get darker than the common ratio says: steep, glossy, or near a wall.

    They are told from a figure by L's texture, which shade keeps and a figure hides.
    """
    light = lit.sum(axis=0)
    off = [~lies & (s.sum(axis=0) < light) for s, lies in zip(stack, on_line, strict=True)]
    mean, count = mean_where(stack, off)
    ratio = np.log(np.maximum(mean.sum(axis=0), 1e-4) / np.maximum(light, 1e-4))
    candidate = count >= _LEAST_SHADED
    weight = _window_sum(candidate.reshape(size).astype(np.float32))
    values = np.where(candidate, ratio, np.float32(0)).reshape(size).astype(np.float32)
    first = _window_sum(values) / np.maximum(weight, 1)
    second = _window_sum(values**2) / np.maximum(weight, 1)
    smooth = np.sqrt(np.maximum(second - first**2, 0)) < _TEXTURE
    # On ground without texture nothing tells shade from a figure: the common ratio stands.
    kept = smooth & (_texture(light.reshape(size)) > 1.5 * _TEXTURE)
    shaded = candidate & kept.ravel() & (mean < lit).all(axis=0)
    return np.where(shaded, mean, shadow)


def _window_sum(values: Float32) -> Float32:
    return np.asarray(cv2.boxFilter(values, -1, (5, 5), normalize=False), np.float32)


def _texture(light: Float32) -> Float32:
    """Local scatter of log L, of L's sum over the channels."""
    gray = np.log(np.maximum(light, 1e-4)).astype(np.float32)
    mean = cv2.boxFilter(gray, -1, (5, 5))
    scatter = cv2.boxFilter(gray**2, -1, (5, 5)) - mean**2
    return np.asarray(np.sqrt(np.maximum(scatter, 0)), np.float32)
