"""Keeping the figure out of the plates without any roto.

What a locked-off camera sees of the background lies on the line from S to L through each pixel; a
figure, for most of its pixels, does not. The lines are found from a sample of the frames on a thin
grid: L is the value on whose line most of a pixel's samples lie, S is L times the ratio that the
scene's shadows have in common.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import blocks
from shadowtool.core.color_line import Weighed, channels, line_distance
from shadowtool.core.half_floats import to_float
from shadowtool.core.medians import median
from shadowtool.core.noise import NoiseModel
from shadowtool.core.regions import large_parts
from shadowtool.core.standing import Sampled

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

# The grid has about this many columns.
_COLUMNS = 320
# A sample lies on a line within this many standard deviations, of its noise and this part of its
# value together.
_ON_LINE, _TOLERANCE = 4.0, 0.01
# Between these logarithms of S/L shadow is looked for, on ground that is so many times as bright as
# its noise. It is black if so many times as many samples are as have any one ratio.
_DEEPEST, _LIGHTEST, _CLEAR, _BLACK = 5.0, -0.25, 8.0, 2.0
# Of so many ratios that are frequent, each with what differs from it by this logarithm, and none
# nearer to another than so many bins.
_FREQUENT, _ALIKE, _BINS = 4, 0.1, 8
# What is lit is most frequent no lower than so many bins below light, and spreads to so many.
_LIT_BINS, _LIT_SPREAD = 15, 30
# Of two that are of one colour, so exactly, the deeper is the shadow, the other its penumbra, if
# more than half as much speaks for it.
_ONE_RAY, _DEEPER = 0.015, 0.5
# So many samples at least tell a ratio.
_TELLING = 20
# Ratios of shadow scatter by no more than noise and this part; and noise that widens a peak lowers
# it by so much at most.
_SCATTER, _LOWERED = 0.03, 2.0
# Less than this part of its light is darkened. A take in which a shadow darkens more of the picture
# than the next, and so much at once, is that of a card waved over a scene.
_SHADED, _MOST, _AT_ONCE = 0.5, 0.5, 0.2
# So is one in which it darkens as much of both, a geometric mean, as the first of these, and more
# by so many times of what tells of somebody: what is brighter than lit ground, by a part, counted
# so many times; and in dark clothes what is darkened off the line differs from frame to frame by
# more than a factor.
_LARGE, _SOMEBODY = 0.09, 0.6
_BRIGHTER, _COUNTED, _DIFFERS = 0.1, 7.0, 1.35
# Ranks of samples that may be lit, of which the one that most samples are as near to as that, as a
# part, is compared with, if there are so many samples: of fewer most may be in shade.
_BRIGHT_RANKS, _NEXT, _ENOUGH = (0.85, 0.7, 0.55), 0.08, 12
# Ranks of two samples whose texture is the ground's. Samples with ratios this much around a
# frequent one have texture in common with it if they are shadow; what has none, or no one colour,
# counts as the last part.
_TEXTURE_RANKS, _AROUND, _LEAST_LIKELY = (0.8, 0.95), 0.3, 0.05
# Samples of one colour are within so many deviations of it; it is found in so many rounds. No ratio
# of shadow is above the last.
_CLUSTER, _ROUNDS, _LIGHTEST_RATIO = 2.5, 3, 0.9
# So many windows down and across, of so many points down and across at least, may have ratios of
# their own, if they have more than the first part of the ground's texture for certain, and differ
# by no more than the second, a logarithm, in one look, and in no channel from the others by more
# than the third for what they differ by and 1: the light that is missing is of one colour.
_WINDOWS, _LEAST_WINDOW, _CERTAIN, _FURTHEST, _COLOURED = (4, 6), 20, 0.15, 1.2, 0.25
# Between them ratios lie on planes through those that are so many windows away, a standard
# deviation. That there is the common one, and no slope down or across, counts as so much of one.
_NEXT_WINDOWS, _AS_COMMON = 1.0, (0.05, 0.3, 0.3)
# Where their logarithms differ by more than the first, they are looked for again, so many times in
# all.
_EVEN, _LOOKS = 0.15, 3
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


def grid_step(width: int, height: int) -> int:
    """Every how many pixels the grid has a point."""
    return max(1, round(max(width, height) / _COLUMNS))


def exposure_step(width: int, height: int) -> int:
    """Every how many pixels exposure is looked at: fewer tell it than a figure's outline, unless
    there are few."""
    step = grid_step(width, height)
    return step if step == 1 else 2 * step


def exposure_rows(width: int, height: int) -> NDArray[np.float64]:
    """Where a picture's rows lie among those that exposure is looked at in, (H,)."""
    return np.arange(height) / exposure_step(width, height)


def on_grid(image: NDArray[np.floating], step: int) -> Float32:
    """The grid's pixels of a frame, (H, W, 3) to (h, w, 3) float32."""
    return to_float(np.ascontiguousarray(image[::step, ::step]))


@dataclass(frozen=True)
class Background:
    """Each grid point's line from S to L.

    Attributes:
        lit, shadow: (h, w, 3) float32.
        noise: the take's.
        under_card: whether a shadow came over most of the picture: that is a card waved over a
            scene whose surfaces have each their own S/L, for which these lines don't stand, and
            nobody is in it.
    """

    lit: Float32
    shadow: Float32
    noise: NoiseModel
    under_card: bool


def find_background(samples: list[Float32], noise: NoiseModel) -> Background:
    """The background's lines from a sample of the take's frames on the grid.

    Args:
        samples: frames spread over the take, each (h, w, 3).
    """
    shape = samples[0].shape
    stack = np.stack([channels(sample) for sample in samples])
    stack = np.nan_to_num(stack, copy=False, nan=0.0, posinf=1e4, neginf=0.0)
    weighed = [Weighed(colours, noise, _TOLERANCE) for colours in stack]
    ascending = np.argsort(stack.sum(axis=1), axis=0)
    ratio = _common_ratio(stack, ascending, noise, shape[:2])
    lit = np.empty_like(ratio)
    for part in blocks(lit.shape[1], _BLOCK):
        samples_part = [sample.part(part) for sample in weighed]
        of_points = stack[..., part], ascending[:, part], samples_part, ratio[:, part]
        lit[:, part] = _most_supported(*of_points)
    known = Sampled(stack, weighed, lit, ratio, shape[:2]).uncovered()
    lit, on_line = known.lit, list(known.on_line)
    shadow = lit * ratio
    under_card = _under_a_card(stack, on_line, lit)
    shadow = _deeper_shade(stack, on_line, lit, shadow, shape[:2])
    lit, shadow = (np.ascontiguousarray(plate.T).reshape(shape) for plate in (lit, shadow))
    return Background(lit, shadow, noise, under_card)


def figure_mask(image: Float32, background: Background) -> Bool:
    """Where a frame on the grid, (h, w, 3), shows something that is not the background."""
    lit, shadow, noise = background.lit, background.shadow, background.noise
    off = line_distance(image, lit, shadow, noise, _TOLERANCE) > _ON_LINE
    # A lone grid point may be noise; a figure is connected, and its holes are its own.
    support = cv2.boxFilter(off.astype(np.float32), -1, (3, 3))
    solid = (off & (support > _SUPPORT)).view(np.uint8)
    solid = cv2.morphologyEx(solid, cv2.MORPH_CLOSE, _disk(3)).astype(np.uint8)
    large = large_parts(solid > 0, max(_LEAST_FIGURE * solid.size, _FEW))
    return np.asarray(cv2.dilate(large.view(np.uint8), _disk(2)) > 0)


def full_size(mask: Bool, width: int, height: int, step: int) -> UInt8:
    """A grid's mask for the whole picture: (H, W) uint8, 255 where the figure is."""
    # The grid's points stand for the pixels nearest to them.
    rows, columns = (
        np.minimum((np.arange(size) + step // 2) // step, points - 1)
        for size, points in zip((height, width), mask.shape, strict=True)
    )
    values = np.where(mask, np.uint8(255), np.uint8(0))
    return np.asarray(values.take(columns, axis=1).take(rows, axis=0), np.uint8)


def _disk(radius: int) -> UInt8:
    size = 2 * radius + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def _on_line(sample: Weighed, lit: Float32, shadow: Float32) -> Bool:
    return np.asarray(sample.line_distance(lit, shadow) <= _ON_LINE)


def _rank(ascending: Index, part: float) -> Index:
    """Each pixel's sample below which this part of its samples are."""
    order: Index = ascending[int(part * (len(ascending) - 1))]
    return order


def _ranked(stack: Float32, order: Index, pixels: Index | None = None) -> Float32:
    """The sample that each pixel, or each of some, has in one place of the order; (3, N)."""
    pixels = np.arange(stack.shape[2]) if pixels is None else pixels
    return np.ascontiguousarray(stack[order[pixels], :, pixels].T)


class _Compared(NamedTuple):
    """Samples of a window of the grid beside light.

    Attributes:
        stack: (T, 3, N), the samples.
        bright: (3, N), one of each point's that is lit.
        difference: (T, N), the logarithm of their sums' ratio; 1 where it says nothing.
        logarithm: (T, N), that of the samples' sums.
        textures: (2, N), that of lit ground twice, so that noise is not taken for its texture.
        size: the window's, rows and columns.
    """

    stack: Float32
    bright: Float32
    difference: Float32
    logarithm: Float32
    textures: Float32
    size: tuple[int, int]

    def window(self, rows: Index, columns: Index) -> "_Compared":
        """The same of some of the rows and columns."""
        points = (rows[:, np.newaxis] * self.size[1] + columns).ravel()
        parts = [values.take(points, axis=-1) for values in self[:-1]]
        return _Compared._make([*parts, (len(rows), len(columns))])

    def dimmed(self, shift: Float32) -> "_Compared":
        """The same beside light that is less by exp(shift), (3, N)."""
        bright = self.bright * np.exp(shift)
        less = np.log(np.maximum(self.bright.sum(axis=0), np.float32(1e-4)))
        less -= np.log(np.maximum(bright.sum(axis=0), np.float32(1e-4)))
        # What says nothing still does.
        difference = np.where(self.difference < 1, self.difference + less, self.difference)
        return self._replace(bright=bright, difference=difference)


class _Frequent(NamedTuple):
    """A ratio that is frequent: (3,); how much speaks for it; how many samples have it, and how
    much of the ground's texture they have for certain."""

    ratio: Float32
    weight: float
    samples: float
    follows: float

    @property
    def ray(self) -> Float32:
        """The colour of the light that is missing, which adds up to 1; a penumbra's is the same."""
        missing = 1 - self.ratio
        return np.asarray(missing / missing.sum(), np.float32)


def _common_ratio(
    stack: Float32, ascending: Index, noise: NoiseModel, size: tuple[int, int]
) -> Float32:
    """S/L of each point, (3, N), as the scene's shadows have it in common around.

    Of a shadow that is all but black noise leaves no ratio, but then more samples are black than
    have any one. Where a lamp is near, its shadow is deeper than elsewhere: a window of the grid
    has a ratio of its own if that certainly has the ground's texture.
    """
    total = stack.sum(axis=1)
    bright = _usually_bright(stack, total, ascending)
    light = bright.sum(axis=0)
    clear = light > _CLEAR * noise.sigma(bright.T).sum(axis=1)
    part = total / np.where(clear, light, 1)
    difference = np.where(clear, np.log(np.maximum(part, 1e-4)), 1).astype(np.float32)
    others = [_ranked(stack, _rank(ascending, rank)).sum(axis=0) for rank in _TEXTURE_RANKS]
    logarithm, textures = (np.log(np.maximum(sums, np.float32(1e-4))) for sums in (total, others))
    compared = _Compared(stack, bright, difference, logarithm, textures, size)
    common = _most_frequent(compared, noise)
    black = difference <= -_DEEPEST
    # Of what is black penumbrae take from all channels alike.
    penumbra = common is not None and bool(np.abs(common.ray - np.float32(1 / 3)).max() < _ONE_RAY)
    least = (_DEEPER if penumbra else _BLACK) * (0 if common is None else common.samples)
    if black.sum() > max(least, _TELLING):
        _, ratios = _ratios(stack, bright, black)
        ratio = np.clip(median(ratios), 0, _LIGHTEST_RATIO)
        return np.repeat(ratio[:, np.newaxis], light.size, axis=1)
    if common is None:
        return np.full(bright.shape, 0.25, np.float32)
    return _with_windows(compared, common.ratio, noise)


def _with_windows(compared: _Compared, common: Float32, noise: NoiseModel) -> Float32:
    """The ratio of each point, (3, N), as windows have it in common.

    Where it differs much, so that it isn't one in a window either, it is looked for again in what
    it would be without that.
    """
    shift, beside = np.zeros(compared.bright.shape, np.float32), compared
    for _ in range(_LOOKS):
        further = _window_shifts(beside, common, noise)
        shift += further
        if np.ptp(further) < _EVEN:
            break
        beside = compared.dimmed(shift)
    ratio = common[:, np.newaxis] * np.exp(shift)
    return np.ascontiguousarray(np.clip(ratio, 0, _LIGHTEST_RATIO), np.float32)


def _window_shifts(compared: _Compared, common: Float32, noise: NoiseModel) -> Float32:
    """Logarithms of ratios over the common one, (3, N), 0 or less, between those of windows that
    have a ratio of their own."""
    # Smaller windows have too few samples of anything.
    rows, columns = (
        np.array_split(np.arange(length), max(min(windows, length // _LEAST_WINDOW), 1))
        for length, windows in zip(compared.size, _WINDOWS, strict=True)
    )
    places, shifts, weights = [], [], []
    for i, down in enumerate(rows):
        for j, across in enumerate(columns):
            found = _most_frequent(compared.window(down, across), noise)
            if found is None or found.samples < _TELLING or found.follows <= _CERTAIN:
                continue
            shift = np.log(np.maximum(found.ratio, 1e-3) / np.maximum(common, 1e-3))
            alike = np.ptp(shift) <= _COLOURED * (1 + abs(shift.mean()))
            if shift.mean() > -_FURTHEST and alike:
                # What is lighter may be a penumbra, and is on the line as it is.
                shifts.append(shift if shift.mean() < 0 else np.zeros(3))
                places.append((i + 0.5, j + 0.5))
                weights.append(found.follows)
    if not places:
        return np.zeros(compared.bright.shape, np.float32)
    # Nodes at the windows' middles and borders, on straight lines between which the others lie.
    nodes = [np.linspace(0, len(parts), 2 * len(parts) + 1) for parts in (rows, columns)]
    field = _local_planes(*map(np.array, (places, shifts, weights)), *nodes)
    down, across = (
        np.stack([np.interp(np.linspace(0, own[-1], length), own, one) for one in np.eye(own.size)])
        for own, length in zip(nodes, compared.size, strict=True)
    )
    whole = np.einsum("iy,ijc,jx->cyx", down, np.minimum(field, 0), across, optimize=True)
    return np.asarray(whole.reshape(3, -1), np.float32)


def _local_planes(
    places: NDArray[np.float64],
    values: NDArray[np.float64],
    weights: NDArray[np.float64],
    rows: NDArray[np.float64],
    columns: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Values (P, C), with weights (P,), known at places (P, 2), rows and columns, at each pair of
    other rows and columns, (R, S, C): of planes through what is known around, and 0 far from all.
    """
    nodes = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    away = places - nodes[:, :, np.newaxis]
    weight = weights * np.exp(-(away**2).sum(axis=-1) / (2 * _NEXT_WINDOWS**2))
    terms = np.concatenate([np.ones((*away.shape[:-1], 1)), away], axis=-1)
    normal = np.einsum("rsp,rspi,rspj->rsij", weight, terms, terms) + np.diag(_AS_COMMON)
    right = np.einsum("rsp,rspi,pc->rsic", weight, terms, values)
    return np.asarray(np.linalg.solve(normal, right)[:, :, 0])


def _most_frequent(compared: _Compared, noise: NoiseModel) -> _Frequent | None:
    """The ratio below 1 between a point's samples and a brighter one that is much more frequent
    than those a little above and below; None if none is.

    Shadow keeps the ground's texture, so its ratio is the same all around; a figure's is not, and
    in a penumbra all ratios occur. So ratios of shadow scatter in no channel by more than noise,
    where those of a figure scatter as widely as they are looked at. Plain clothes before even
    ground have one ratio, too, but nothing of the ground's texture.
    """
    difference = compared.difference
    # Beyond what is looked for, too: it is next to some of that.
    counts, edges = np.histogram(difference, bins=260, range=(-_DEEPEST, 1.5))
    counts = _without_lit(counts, int(np.searchsorted(edges, 0)))
    excess = _smoothed(counts, 11) - _smoothed(counts, 45)
    excess[(counts == 0) | (edges[1:] >= _LIGHTEST)] = -np.inf
    found: list[_Frequent] = []
    for _ in range(_FREQUENT):
        peak = int(np.argmax(excess))
        # Nothing that is no more frequent than this can be worth enough.
        most = max((other.weight for other in found), default=0.0)
        if excess[peak] * _LOWERED <= _DEEPER * most:
            break
        away = np.abs(difference - (edges[peak] + edges[peak + 1]) / 2)
        alike = away < _ALIKE
        if alike.sum() >= _TELLING:
            ratio, pure, noisy = _told(compared, alike, noise)
            lowered = min(float(np.hypot(1, noisy / _ALIKE)), _LOWERED)
            certain, possible = _follows(compared, away < _AROUND)
            weight = excess[peak] * lowered * pure * possible**2
            if weight > 0:
                found.append(_Frequent(ratio, weight, float(alike.sum()) * pure, certain))
        excess[max(peak - _BINS, 0) : peak + _BINS + 1] = -np.inf
    if not found:
        return None
    best = max(found, key=lambda other: other.weight)
    # In the colour of its penumbra, which may be the more frequent.
    umbrae = [
        other
        for other in found
        if other.weight > _DEEPER * best.weight and np.abs(other.ray - best.ray).max() < _ONE_RAY
    ]
    return min(umbrae, key=lambda other: float(other.ratio.sum()))


def _without_lit(counts: NDArray[np.integer], zero: int) -> NDArray[np.integer]:
    """A histogram of differences from light without those of what is lit: noise makes as much of it
    darker by so much as brighter, and the less the further."""
    # Where the light that it is beside was dimmed, what is lit is above 0.
    first = zero - _LIT_BINS
    lit = first + int(np.argmax(counts[first:]))
    above = np.minimum.accumulate(counts[lit + 1 : lit + 1 + _LIT_SPREAD])
    rest = counts.copy()
    below = rest[lit - len(above) : lit]
    below -= np.minimum(below, above[::-1])
    rest[lit:] = 0
    return rest


def _usually_bright(stack: Float32, total: Float32, ascending: Index) -> Float32:
    """Of a pixel's samples that may be lit the one that most others are next to, (3, N): somebody
    bright is not there for long."""
    found = np.zeros(stack.shape[1:], np.float32)
    most = np.full(stack.shape[2], -1)
    for part in _BRIGHT_RANKS[: None if len(stack) >= _ENOUGH else 1]:
        candidate = _ranked(stack, _rank(ascending, part))
        light = candidate.sum(axis=0)
        near = np.count_nonzero(np.abs(total - light) < _NEXT * light, axis=0)
        more = near > most
        found[:, more], most[more] = candidate[:, more], near[more]
    return found


def _ratios(stack: Float32, bright: Float32, chosen: Bool) -> tuple[Float32, Float32]:
    """The chosen samples, (T, N), and their ratios to what is bright; (M, 3) each."""
    time, pixel = np.nonzero(chosen)
    own, light = stack[time, :, pixel], bright[:, pixel].T
    # A channel may be black where the colour is not.
    return own, np.asarray(own / np.where(light > 0, light, 1), np.float32)


def _told(compared: _Compared, chosen: Bool, noise: NoiseModel) -> tuple[Float32, float, float]:
    """The ratio of the chosen samples, (T, N), in the colour that most of them have, (3,); what
    part of them has it; and what part of it is noise."""
    own, ratios = _ratios(compared.stack, compared.bright, chosen)
    logarithm = np.log(np.maximum(ratios, np.float32(1e-4)))
    noisy = noise.sigma(own) / np.maximum(own, np.float32(1e-4))
    within = _CLUSTER * np.hypot(noisy, _SCATTER)
    colour = logarithm - logarithm.mean(axis=1, keepdims=True)
    inside = (np.abs(colour - _densest(colour, float(median(within.ravel())))) < within).all(axis=1)
    for _ in range(_ROUNDS if inside.any() else 0):
        before = inside
        inside = (np.abs(colour - median(colour[inside])) < within).all(axis=1)
        if np.array_equal(inside, before):
            break
    pure = max(float(inside.mean()), _LEAST_LIKELY)
    ratio = median(ratios[inside] if inside.any() else ratios)
    return np.clip(ratio, 0, _LIGHTEST_RATIO), pure, float(median(noisy.ravel()))


def _densest(colour: Float32, width: float) -> Float32:
    """Where most of the colours (M, 3), logarithms that add up to 0, are; (3,)."""
    bins = np.arange(-1, 1 + width, max(width / 2, 0.01))
    counts, *_ = np.histogram2d(colour[:, 0], colour[:, 2], bins=(bins, bins))
    smooth = cv2.GaussianBlur(counts, (0, 0), 1)
    red, blue = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
    middle = (bins[:-1] + bins[1:]) / 2
    return np.array([middle[red], -middle[red] - middle[blue], middle[blue]], np.float32)


def _follows(compared: _Compared, chosen: Bool) -> tuple[float, float]:
    """How much the chosen samples, (T, N), have of the texture of lit ground, 1 all of it: at
    least, and at most; 0 and 1 where that can't be told.

    It is the slope of logarithmic steps from point to point, and twice its standard error.
    """
    logarithms = [
        values.reshape(-1, *compared.size) for values in (compared.logarithm, *compared.textures)
    ]
    pairs = []
    for axis in (1, 2):
        where = np.moveaxis(chosen.reshape(-1, *compared.size), axis, -1)
        time, row, column = np.nonzero(where[..., 1:] & where[..., :-1])
        changes = (np.diff(np.moveaxis(values, axis, -1)) for values in logarithms)
        pairs.append([change[time * (len(change) > 1), row, column] for change in changes])
    steps = np.hstack(pairs)
    # Where the ground itself differs by more only what follows it is among the chosen.
    own, one, other = steps[:, (np.abs(steps[1:]) < _AROUND / 2).all(axis=0)]
    texture, common = float(one @ other), float(own @ other)
    error = 2 * float(np.linalg.norm(own) * np.linalg.norm(other)) / max(len(own), 1) ** 0.5
    if texture <= error:
        return 0.0, 1.0
    least, most = (common - error) / texture, (common + error) / texture
    return max(least, 0.0), min(max(most, _LEAST_LIKELY), 1.0)


def _smoothed(counts: NDArray[np.integer], bins: int) -> NDArray[np.float64]:
    window = np.hanning(bins)
    return np.convolve(counts, window / window.sum(), mode="same")


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
        candidate = _ranked(stack, order, pixels)
        score = _support(remaining, candidate, candidate * ratio[:, pixels])
        better = score > best[pixels]
        best[pixels[better]] = score[better]
        lit[:, pixels[better]] = candidate[:, better]
    # The mean of the samples that agree with it is less noisy than the sample.
    near = [_on_line(sample, lit, lit * np.float32(0.97)) for sample in weighed]
    mean, count = _mean_where(stack, near)
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


def _mean_where(stack: Float32, chosen: list[Bool]) -> tuple[Float32, Float32]:
    """Each pixel's mean over the samples in which it is chosen, (3, N), and their number."""
    total = np.zeros(stack.shape[1:], np.float32)
    count = np.zeros(stack.shape[2], np.float32)
    for sample, where in zip(stack, chosen, strict=True):
        part = where.astype(np.float32)
        total += sample * part
        count += part
    return np.asarray(total / np.maximum(count, 1), np.float32), count


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
    mean, count = _mean_where(stack, off)
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
