"""The ratio of shadow to light that a scene's shadows have in common.

Ground in shade has its own texture and all around the same part of its light; somebody in front of
it has neither.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.medians import median
from shadowtool.core.noise import NoiseModel
from shadowtool.core.samples import rank, ranked

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]

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
# So many samples at least tell a ratio; and so many tell it as well as more would.
_TELLING, _WELL_TOLD = 20, 50_000
# Ratios of shadow scatter by no more than noise and this part; and noise that widens a peak lowers
# it by so much at most.
_SCATTER, _LOWERED = 0.03, 2.0
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
# How ratios scatter every so many samples tell; in colour by no more than noise and this.
_SOME_SAMPLES, _ROUGH_COLOUR = 3, 0.05
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


def common_ratio(
    stack: Float32, bright: Float32, ascending: Index, noise: NoiseModel, size: tuple[int, int]
) -> Float32 | None:
    """S/L of each point, (3, N), as the scene's shadows have it in common around; None if none is
    much more frequent than others.

    Of a shadow that is all but black noise leaves no ratio, but then more samples are black than
    have any one. Where a lamp is near, its shadow is deeper than elsewhere: a window of the grid
    has a ratio of its own if that certainly has the ground's texture.

    Args:
        stack: (T, 3, N), samples of the take on the grid, linear light, finite.
        bright: (3, N), of `usually_bright`.
        ascending: (T, N), each point's samples from dark to bright.
        size: the grid's rows and columns.
    """
    total = stack.sum(axis=1)
    light = bright.sum(axis=0)
    clear = light > _CLEAR * noise.sigma(bright.T).sum(axis=1)
    part = total / np.where(clear, light, 1)
    difference = np.where(clear, np.log(np.maximum(part, 1e-4)), 1).astype(np.float32)
    others = [ranked(stack, rank(ascending, part)).sum(axis=0) for part in _TEXTURE_RANKS]
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
    return None if common is None else _with_windows(compared, common.ratio, noise)


def ratio_scatter(
    stack: Float32, bright: Float32, noise: NoiseModel, ratio: Float32, size: tuple[int, int]
) -> float:
    """How far S/L differs from point to point, a standard deviation of its logarithm besides the
    noise; 0 where too few samples tell.

    Ground that is rough has grains that face the sky and others that don't, and a mosaic makes more
    of that. Points in shade that are next to each other tell, wherever the ratio in common varies
    across the picture.

    Args:
        stack, bright, noise, size: as of `common_ratio`.
        ratio: (3, N), what that found.
    """
    shade = np.maximum(bright * ratio, np.float32(1e-4))
    noisy = np.hypot(noise.sigma(shade.T).T / shade, noise.sigma(bright.T).T / bright.clip(1e-4))
    off = np.log(np.maximum(stack[::_SOME_SAMPLES], np.float32(1e-4)) / shade)
    level = off.mean(axis=1)
    in_shade = (np.abs(off - level[:, np.newaxis]) < _CLUSTER * np.hypot(noisy, _ROUGH_COLOUR)).all(
        axis=1
    )
    in_shade &= np.abs(level) < np.abs(np.log(np.maximum(ratio, np.float32(1e-4)))).mean(axis=0) / 2
    in_shade &= bright.sum(axis=0) > _CLEAR * noise.sigma(bright.T).sum(axis=1)
    level, in_shade = (values.reshape(-1, *size) for values in (level, in_shade))
    steps = np.diff(level, axis=2)[in_shade[..., 1:] & in_shade[..., :-1]]
    if steps.size < _TELLING:
        return 0.0
    scatter = float(median(np.abs(steps))) / (0.6745 * np.sqrt(2))
    of_mean = float(np.median(noisy)) / np.sqrt(3)
    return float(np.sqrt(max(scatter**2 - of_mean**2, 0)))


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


def usually_bright(stack: Float32, ascending: Index) -> Float32:
    """Of a point's samples that may be lit the one that most others are next to, (3, N): somebody
    bright is not there for long. Arguments as for `common_ratio`."""
    total = stack.sum(axis=1)
    found = np.zeros(stack.shape[1:], np.float32)
    most = np.full(stack.shape[2], -1)
    for part in _BRIGHT_RANKS[: None if len(stack) >= _ENOUGH else 1]:
        candidate = ranked(stack, rank(ascending, part))
        light = candidate.sum(axis=0)
        near = np.count_nonzero(np.abs(total - light) < _NEXT * light, axis=0)
        more = near > most
        found[:, more], most[more] = candidate[:, more], near[more]
    return found


def _ratios(stack: Float32, bright: Float32, chosen: Bool) -> tuple[Float32, Float32]:
    """The chosen samples, (T, N), or some of them, and their ratios to what is bright; (M, 3)
    each."""
    places = np.flatnonzero(chosen)
    time, pixel = np.divmod(places[:: max(places.size // _WELL_TOLD, 1)], chosen.shape[1])
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
