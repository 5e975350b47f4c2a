"""The camera's noise against brightness, measured from a take.

Photon and read noise: the variance of a channel is ``slope * value + floor`` in linear light.
Both are found from differences between frames of a static camera, where motion is a minority that
a robust spread ignores.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import blocks
from shadowtool.core.exposure import Gains, row_gains, without_gain
from shadowtool.core.ordering import ascending

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Quantiles of |x| for a standard normal x. Of distant frames a smaller part is trusted, as more
# has moved between them.
_NEAR, _FAR = (0.5, 0.6744898), (0.3, 0.3853205)
# Of normal noise 8% of the differences are below a tenth of a standard deviation. A codec repeats
# pixels if more than this part is.
_FROZEN = 0.2
# Noise is as large as a code value, give or take this logarithm.
_ONE_CODE = 0.7
# Each quantile of |x| that rare noise is judged by, for a standard normal x; in how many tiles
# along each side; and how much too large it has to be.
_RARE, _TILES, _HEAVY = (0.9, 1.6448536), 8, 1.2
# Ground is lit that is brighter than the first part of what it was at most, and something dark has
# passed it if it was darker than the second; in so many tiles at least.
_LIGHT, _SHADE, _LEAST_TILES = 0.8, 0.6, 4
# If more than the second part of it was darker than the first part of what it was at most, before
# or after, penumbrae are what rare pixels are off by.
_HALF_LIT, _FEW = 0.9, 0.06
# Light that changes by less from one frame to the next leaves noise as it is.
_STEADY = 0.03
_LEVELS = 12
# Of the variance at the darkest level that was measured this part is left at none; if that is
# darker than this, nothing is to be guessed.
_LEFT_IN_THE_DARK, _LEAST_LIGHT = 0.35, 1e-3
_GRID = 10_000
# Channels, three of each pixel, that are gone through together.
_RUN = 3 << 12
_SAMPLES = 8
# Of frames far apart, this part of the pairs may be spoilt by something large that moved.
_FAR_QUANTILE = 0.25


@dataclass(frozen=True)
class NoiseModel:
    """Variance = slope * value + floor, per channel, linear light; or what another such line says,
    where that is less.

    Attributes:
        slope, floor: (3,) float64, non-negative.
        dark: slope and floor of the other line, for what is darker than anything that was measured;
            None for none.
    """

    slope: Float64
    floor: Float64
    dark: tuple[Float64, Float64] | None = None

    def record(self) -> list[list[float]]:
        """All that it says, to tell it from another."""
        return [[float(v) for v in row] for row in self._lines()]

    def sigma(self, image: NDArray[np.floating]) -> Float32:
        """Standard deviation of the noise at these values.

        Args:
            image: (..., 3), linear light; negative values count as 0; NaN gives NaN.

        Returns:
            (..., 3) float32, above 0 wherever ``floor`` is.
        """
        variance = self.variance(image)
        return np.asarray(np.sqrt(variance, out=variance), np.float32)

    def variance(self, image: NDArray[np.floating]) -> Float32:
        """The square of `sigma`."""
        value: Float32 = np.maximum(image, 0, dtype=np.float32)
        flat = value.reshape(-1)
        variance = np.empty_like(flat)
        # Many times faster than along an axis of three.
        run = min(flat.size, _RUN) // 3
        lines = [np.tile(own.astype(np.float32), run) for own in self._lines()]
        for part in blocks(flat.size, _RUN):
            own = flat[part]
            variance[part] = _lower(own, [line[: own.size] for line in lines])
        return variance.reshape(value.shape)

    def channel_variance(self, value: Float32, channel: int) -> Float32:
        """The same of one channel's values, ≥ 0, of any shape."""
        return _lower(value, [own[channel].astype(np.float32) for own in self._lines()])

    def _lines(self) -> tuple[Float64, ...]:
        """Slopes and floors in turn."""
        return (self.slope, self.floor, *(self.dark or ()))


@dataclass(frozen=True)
class NoiseLevel:
    """One step of the measured curve: the noise of one channel at one brightness."""

    channel: int
    value: float
    sigma: float


def sample_positions(frames: int) -> dict[int, int]:
    """Which frames of a take to measure its noise in.

    Args:
        frames: their number.

    Returns:
        Position of a frame by a running number; evenly spread neighbours, 2k and 2k + 1 a pair.
        Empty if there are fewer than two frames.
    """
    if frames < 2:
        return {}
    starts = np.unique(np.linspace(0, frames - 2, _SAMPLES).astype(int))
    return {2 * k + i: int(start) + i for k, start in enumerate(starts) for i in (0, 1)}


def thin(image: NDArray[np.floating]) -> Float32:
    """The fixed grid of about 10,000 pixels that is looked at of a frame, (H, W, 3) to (h, w, 3),
    or of one of its channels."""
    step = thinning(*image.shape[:2])
    return image[::step, ::step].astype(np.float32)


def thinning(height: int, width: int) -> int:
    """How many pixels that grid's lines are apart."""
    return max(1, int(np.sqrt(height * width / _GRID)))


class NoiseSamples:
    """Keeps evenly spread pairs of a take whose length is not known beforehand.

    Whenever there are twice too many, every other pair is dropped; memory stays bounded.
    """

    def __init__(self) -> None:
        self._kept: dict[int, dict[int, Float32]] = {}
        self._every = 2
        self._count = 0

    def add(self, sample: Float32) -> None:
        """Take in the next frame, thinned, (h, w, 3) linear light."""
        start, place = divmod(self._count, self._every)
        if place < 2:
            self._kept.setdefault(start * self._every, {})[place] = sample
        self._count += 1
        if len(self._kept) > 2 * _SAMPLES and place == 1:
            self._every *= 2
            self._kept = {s: pair for s, pair in self._kept.items() if s % self._every == 0}

    def samples(self) -> dict[int, Float32]:
        """What was kept, numbered as `noise_levels` takes it."""
        pairs = enumerate(self._kept[start] for start in sorted(self._kept))
        return {2 * k + place: image for k, pair in pairs for place, image in pair.items()}


def noise_levels(samples: Mapping[int, Float32]) -> list[NoiseLevel]:
    """The noise against brightness.

    From neighbouring frames. A codec may repeat a pixel's noise until it sends the pixel anew;
    then frames far apart are compared. And what a codec leaves of noise is often next to nothing
    and sometimes far off: then σ is that of normal noise that is as often as far off. Or it sends
    a pixel anew only when something else is to be seen there, and each time comes out elsewhere:
    then σ is that of what was seen before and after.

    Args:
        samples: thinned frames (h, w, 3) under the running numbers of `sample_positions`; any may
            be absent.

    Returns:
        Dark to bright, each channel in turn; empty where no two frames can be compared.
    """
    samples = _in_one_light(samples)
    firsts = sorted(a for a in samples if a % 2 == 0)
    near, far = (
        [(samples[a], samples[b]) for a, b in pairs]
        for pairs in (
            [(a, a + 1) for a in firsts if a + 1 in samples],
            [(a, b) for a, b in combinations(firsts, 2) if b - a >= len(firsts) // 2],
        )
    )
    measured = _spreads(near, _NEAR)
    if not measured:
        return []
    values, sigmas, frozen, steps = np.median(measured, axis=0)
    # Where noise spans about one code value, rounding makes many differences nothing.
    codes = np.abs(np.log(np.maximum(steps, 1e-12) / np.maximum(sigmas, 1e-12)))
    repeated = np.median(frozen) > _FROZEN and (codes > _ONE_CODE).any()
    compared, share = near, 0.5
    if repeated and (distant := _spreads(far, _FAR)):
        compared, share = far, _FAR_QUANTILE
        values, sigmas, _, steps = np.quantile(distant, share, axis=0)
    # A level of one code value says nothing of the next.
    some = np.where(steps > 0, steps, np.nan)
    step = np.array([np.nanmedian(own) if np.isfinite(own).any() else 0.0 for own in some.T])
    steps = np.where(steps > 0, steps, step)
    # Noise that rounding to code values hides is as large as the rounding.
    sigmas = np.sqrt(sigmas**2 + steps**2 / 12)
    levels = [
        NoiseLevel(channel, float(values[level, channel]), float(sigmas[level, channel]))
        for channel in range(3)
        for level in range(_LEVELS)
    ]
    model = replace(noise_model(levels), dark=None)
    times = np.maximum(
        _heaviness(compared, share, model), _renewal([samples[a] for a in firsts], model)
    )
    times = np.where(times < _HEAVY, 1.0, times)
    # By the model's noise, of which there is some even where a codec leaves none.
    return [
        replace(level, sigma=factor * float(model.sigma(np.full(3, level.value))[level.channel]))
        if (factor := float(times[level.channel])) > 1
        else level
        for level in levels
    ]


def _in_one_light(samples: Mapping[int, Float32]) -> Mapping[int, Float32]:
    """Samples without changes of the light, if it changes from most frames to the next; all of
    them in that of the first."""
    rows = np.arange(max((len(image) for image in samples.values()), default=0), dtype=np.float64)

    def gain(image: Float32, other: Float32) -> Gains:
        with np.errstate(invalid="ignore", over="ignore"):
            return row_gains(image, other, rows, banded=True)

    pairs = ((samples[a], samples[a + 1]) for a in samples if a % 2 == 0 and a + 1 in samples)
    gains = [gain(second, first) for first, second in pairs]
    steady = [isinstance(own, float) and abs(own - 1) < _STEADY for own in gains]
    if 2 * sum(steady) >= len(steady):
        return samples
    first = samples[min(samples)]
    return {
        a: without_gain(image, gain(image, first)).astype(np.float32, copy=False)
        for a, image in samples.items()
    }


def noise_model(levels: list[NoiseLevel], least: float = 2e-4) -> NoiseModel:
    """The line through the measured variances, and below the darkest of them one that falls by more
    with the light: what photons and a codec's code values make of noise falls to nothing, and what
    the first line makes of it in the dark, where nothing was measured, is a guess.

    Args:
        levels: from `noise_levels`; empty gives a model of ``least`` alone.
        least: noise that is always assumed, linear light: about what storing as half floats adds,
            and something to compare a rendering with.
    """
    slope, floor, darkest = np.zeros(3), np.zeros(3), np.zeros(3)
    for channel in range(3):
        own = [level for level in levels if level.channel == channel]
        if own:
            values = np.array([max(level.value, 0.0) for level in own])
            variances = np.array([level.sigma**2 for level in own])
            # Noise grows with brightness. Where it seems not to, what was compared moved: dark
            # pixels may be none but those that a soft shadow is passing.
            for i in range(len(own) - 1):
                variances[i] = min(variances[i], float(np.median(variances[i + 1 :])))
            slope[channel], floor[channel] = _non_negative_line(values, variances)
            # In the dark, rounding counts most, and the line must not pass below it.
            floor[channel] = max(floor[channel], variances[0] - slope[channel] * values[0])
            darkest[channel] = values[0]
    floor = np.maximum(floor, least**2)
    there, known = slope * darkest + floor, darkest > _LEAST_LIGHT
    dark_floor = np.maximum(_LEFT_IN_THE_DARK * there, least**2)
    # A line that falls by as much already stands.
    known &= dark_floor < floor
    dark_floor = np.where(known, dark_floor, floor)
    dark_slope = np.where(known, (there - dark_floor) / np.where(known, darkest, 1), slope)
    return NoiseModel(slope, floor, (dark_slope, dark_floor))


def _spreads(pairs: list[tuple[Float32, Float32]], part: tuple[float, float]) -> list[Float64]:
    """For each pair of thinned frames (4, levels, 3): brightness, standard deviation, the part of
    the differences that are next to nothing, and the step between code values."""
    spreads = []
    for pair in pairs:
        first, second = (image.reshape(-1, 3) for image in pair)
        usable = np.isfinite(first).all(axis=1) & np.isfinite(second).all(axis=1)
        # What is clipped to black in both frames has no noise left.
        usable &= (np.maximum(first, second) > 0).any(axis=1)
        if usable.sum() < 4 * _LEVELS:
            continue
        # By the brighter of the two: a pixel that the shadow covers in one of them alone, which
        # says nothing of the noise, is then among the lit ones, where it is in the minority.
        brighter = np.maximum(first[usable], second[usable])
        # The variance of a difference is twice that of one frame.
        difference = np.abs(first[usable] - second[usable]) / np.float32(np.sqrt(2))
        count = len(difference) // _LEVELS
        spread = np.empty((4, _LEVELS, 3))
        for channel in range(3):
            order = ascending(brighter[:, channel])
            rows = order[: count * _LEVELS].reshape(_LEVELS, count)
            own = difference[rows, channel]
            middle, quantile = np.quantile(own, (0.5, part[0]), axis=1)
            still = np.float32(0.1 / _NEAR[1]) * middle.astype(np.float32)
            spread[0, :, channel] = np.median(brighter[rows, channel], axis=1)
            spread[1, :, channel] = quantile / part[1]
            spread[2, :, channel] = (own <= still[:, np.newaxis]).mean(axis=1)
            spread[3, :, channel] = _code_steps(first[usable][rows, channel])
        spreads.append(spread)
    return spreads


def _lower(value: Float32, lines: Sequence[NDArray[np.float32] | np.float32]) -> Float32:
    """The lower one of one line or two at these values, each a slope and a floor, for all values or
    for each along the last axis."""
    found = []
    for slope, floor in zip(lines[::2], lines[1::2], strict=True):
        line: Float32 = value * slope
        line += floor
        found.append(line)
    lowest = found[0]
    for line in found[1:]:
        np.minimum(lowest, line, out=lowest)
    return lowest


def _heaviness(pairs: list[tuple[Float32, Float32]], share: float, noise: NoiseModel) -> Float64:
    """How many times as far off as normal noise of this model rare noise is in most of the picture,
    (3,): what moved is in some places, and noise in all. 1 where nothing tells. Of the pairs this
    share is no better."""
    found = []
    for first, second in pairs:
        # What is not finite is left out below.
        with np.errstate(invalid="ignore", over="ignore"):
            sigma = noise.sigma((first + second) / 2) * np.float32(np.sqrt(2))
            off = np.abs(first - second) / sigma
        if (rare := _rare(off)).size:
            found.append(np.median(rare, axis=0))
    return np.quantile(found, share, axis=0) if found else np.ones(3)


def _renewal(frames: list[Float32], noise: NoiseModel) -> Float64:
    """How many times as far as by this model's noise ground is off what it was, (3,), after
    something dark has passed it; 1 where nothing did, or did so slowly that little tells.

    Args:
        frames: thinned, spread over the take in its order.
    """
    if len(frames) < 3:
        return np.ones(3)
    stack = np.stack(frames)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        gray = stack.sum(axis=-1)
        brightest = gray.max(axis=0)
        lit, dark = gray > _LIGHT * brightest, gray < _SHADE * brightest
        first, last = lit.argmax(axis=0), len(stack) - 1 - lit[::-1].argmax(axis=0)
        number = np.arange(len(stack))[:, np.newaxis, np.newaxis]
        passed = (dark & (number > first) & (number < last)).any(axis=0)
        ends = [np.take_along_axis(gray, at[np.newaxis], axis=0)[0] for at in (first, last)]
        half_lit = np.minimum(*ends) < _HALF_LIT * brightest
        if np.count_nonzero(half_lit & passed) > _FEW * np.count_nonzero(passed):
            return np.ones(3)
        before, after = (
            np.take_along_axis(stack, which[np.newaxis, ..., np.newaxis], axis=0)[0]
            for which in (first, last)
        )
        before, after = (np.where(passed[..., np.newaxis], v, np.nan) for v in (before, after))
        # What a tile has in common is light that changed.
        common = _in_tiles((after / before).astype(np.float32), 0.5)
        off = np.abs(after - before * _of_tiles(common, passed.shape))
        off /= noise.sigma((before + after) / 2) * np.float32(np.sqrt(2))
    rare = _rare(off)
    return np.median(rare, axis=0) if len(rare) >= _LEAST_TILES else np.ones(3)


def _rare(off: Float32) -> Float64:
    """How far off rare pixels are in each tile that tells, as parts of how far off those of normal
    noise would be: (T, 3).

    Args:
        off: (h, w, 3), standard deviations; pixels that are not finite are left out.
    """
    rare = _in_tiles(off, _RARE[0]).reshape(-1, 3) / _RARE[1]
    return rare[np.isfinite(rare).all(axis=-1)]


def _in_tiles(picture: Float32, part: float) -> Float64:
    """A quantile of each channel of a picture (h, w, 3) in each tile, (T, T, 3). Pixels that are
    not finite are left out; NaN for tiles of few others."""
    height, width = picture.shape[:2]
    rows, columns = (-(-size // _TILES) for size in (height, width))
    whole = np.full((3, _TILES * rows, _TILES * columns), np.nan, np.float32)
    whole[:, :height, :width] = np.moveaxis(picture, -1, 0)
    whole[:, ~np.isfinite(whole).all(axis=0)] = np.nan
    tiles = whole.reshape(3, _TILES, rows, _TILES, columns).swapaxes(2, 3)
    # NaN comes last.
    ordered = np.sort(tiles.reshape(3, _TILES**2, rows * columns), axis=-1)
    count = np.isfinite(ordered[0]).sum(axis=-1)
    enough = np.flatnonzero(count >= _LEVELS)
    place = part * (count[enough] - 1)
    before = place.astype(int)
    low, high = ordered[:, enough, before], ordered[:, enough, before + 1]
    found = np.full((_TILES**2, 3), np.nan)
    found[enough] = (low + (high - low) * (place - before)).T
    return found.reshape(_TILES, _TILES, 3)


def _of_tiles(values: Float64, shape: tuple[int, ...]) -> Float64:
    """Each pixel's own of values of tiles (T, T, 3): (h, w, 3)."""
    rows, columns = (np.arange(size) // -(-size // _TILES) for size in shape)
    return np.asarray(values[rows[:, np.newaxis], columns], np.float64)


def _code_steps(values: Float32) -> Float32:
    """In each row (R, N), the distance of neighbouring code values in coarsely stored footage, next
    to 0 in fine: (R,)."""
    last = values.shape[1] - 1
    inner = np.sort(values, axis=1)[:, int(np.ceil(0.05 * last)) : int(0.95 * last) + 1]
    distinct = (np.diff(inner, axis=1) > 0).sum(axis=1)
    return np.asarray((inner[:, -1] - inner[:, 0]) / np.maximum(distinct, 1), np.float32)


def _non_negative_line(x: Float64, y: Float64) -> tuple[float, float]:
    """Slope and intercept >= 0 of y over x, each point weighted by the inverse of its value."""
    weight = 1 / np.maximum(y, max(float(y.max()) * 1e-2, 1e-20)) ** 2
    sw, sx, sy = weight.sum(), (weight * x).sum(), (weight * y).sum()
    sxx, sxy = (weight * x * x).sum(), (weight * x * y).sum()
    determinant = sw * sxx - sx * sx
    if determinant > 1e-12 * sw * sxx:
        slope = (sw * sxy - sx * sy) / determinant
        floor = (sxx * sy - sx * sxy) / determinant
        if slope >= 0 and floor >= 0:
            return float(slope), float(floor)
        if floor < 0 and sxx > 0:
            return float(sxy / sxx), 0.0
    return 0.0, float(sy / sw)


def extreme_range(frames: NDArray[np.integer] | int) -> Float32:
    """How far maximum and minimum of pure noise lie apart, in standard deviations.

    Args:
        frames: how many samples were looked at, any shape.

    Returns:
        An upper estimate of the range of that many normal samples, 2·sqrt(2·ln n) with three
        standard deviations of the range on top; float32, the shape of ``frames``.
    """
    count = np.maximum(np.asarray(frames, np.float32), 1)
    return np.asarray(2 * np.sqrt(2 * np.log(count)) + 3, np.float32)
