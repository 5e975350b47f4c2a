"""Light that changes over a take: a frame's gain, found from the pixels that agree.

It is one number, or one for each row and channel where the light flickers or changes its colour.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands, channel_sum
from shadowtool.core.flicker import band_gains
from shadowtool.core.half_floats import rounded, to_float
from shadowtool.core.medians import median

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
# The gain of a whole picture, or of each row and channel, (H, 3).
Gains = float | Float64

# Logarithms of gains further from 0 are shadow, not exposure.
_WIDEST = 0.35
# A gain nearer to 1 than this is 1: the picture stays as it is, bit for bit.
_NOTHING = 0.004
# What moves no time by which a shadow passes.
_HARMLESS = 0.01
# A white balance nearer to the reference's than this is its: what penumbrae take has a colour, too.
_TINTED = 0.01
# White balance is told by pixels that agree to so much, and are no brighter than this part of the
# brightest, but for so few; by so many standard errors, and in so many rounds.
_SAME_LIGHT, _UNCLIPPED, _BRIGHTEST, _SURE = 0.03, 0.95, 0.995, 4.0
_ROUNDS = 3
# A take flickers if more than this part of its frames does.
_MOSTLY = 0.5
# Light is clipped that is no further than this below the most that frames hold, but for few pixels
# that may be broken, in so many of the frames. Where less than half scatters it may be a wall.
_AT_THE_TOP, _ALL_BUT_BROKEN, _IN_MOST, _SCATTERS = 0.998, 0.999, 0.5, 0.5
# Into about so many areas a picture's longer side is divided.
_AREAS = 160
# At least this part of the pixels must agree, and so many.
_LEAST_PART, _LEAST_PIXELS = 0.05, 16
# Ratios this near to each other agree; the middle of them is closed in on, as penumbrae lie on
# one side of it.
_NEAR = (0.03, 0.02, 0.012, 0.008, 0.008)


def frame_gain(image: Float32, reference: Float32) -> float:
    """By how much a frame is brighter than the reference where nothing but exposure changed.

    Ratios of the same surface in the same light agree; those of what a shadow or a figure covers
    lie elsewhere, or scatter.

    Args:
        image, reference: (h, w, 3), linear light, the same pixels.

    Returns:
        The most frequent ratio of the two; 1 if it is next to 1, or nothing agrees.
    """
    centre = _agreed(_ratios(channel_sum(image), channel_sum(reference)))
    return 1.0 if centre is None or abs(centre) < _NOTHING else float(np.exp(centre))


def row_gains(image: Float32, reference: Float32, rows: Float64, banded: bool) -> Gains:
    """By how much some rows of a frame are brighter, in each channel, than those of the reference.

    Args:
        image, reference: as of `frame_gain`.
        rows: (N,), places of rows, counted in those of the image.
        banded: whether the take `flickers`, so that bands are to be looked for.

    Returns:
        `frame_gain`, if that is all; else (N, 3).
    """
    level = frame_gain(image, reference)
    own = np.arange(len(image), dtype=np.float64)
    along = None
    if banded:
        along = band_gains(image, reference, level, np.concatenate([own, rows]))
    flat = level if along is None else level * along[: len(own), np.newaxis] * np.ones(3)
    tint = _tint(image, flat, reference)
    if along is None and tint is None:
        return level
    of_row = np.ones(len(rows)) if along is None else along[len(own) :]
    return level * of_row[:, np.newaxis] * (np.ones(3) if tint is None else tint)


def flickers(samples: Sequence[Float32], reference: Float32) -> bool:
    """Whether most frames of a sample, (h, w, 3) each, have bands of light and dark.

    A lamp flickers in all frames; a penumbra from side to side, which looks alike, lies in some.
    """
    rows = np.zeros(0)
    levels = [frame_gain(sample, reference) for sample in samples]
    banded = [
        band_gains(sample, reference, level, rows) is not None
        for sample, level in zip(samples, levels, strict=True)
    ]
    return bool(banded) and sum(banded) > _MOSTLY * len(banded)


def _tint(image: Float32, gain: Gains, reference: Float32) -> Float64 | None:
    """By how much each channel is brighter than all together, besides a gain, (3,); None if none
    is."""
    level = np.asarray(without_gain(image, gain), np.float32)
    least = max(_LEAST_PART * image.shape[0] * image.shape[1], _LEAST_PIXELS)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        same = np.abs(channel_sum(level) / channel_sum(reference) - 1) < _SAME_LIGHT
    if np.count_nonzero(same) < least or _largest(_means_ratio(level, reference, same)) < _TINTED:
        return None
    clear = same & _unclipped(image)
    now, then = level[clear].astype(np.float64), reference[clear].astype(np.float64)
    if len(now) < least or (then.mean(axis=0) < 1e-2).any():
        return None
    # Of differences, as the ratios of single dark pixels are no more than noise; and their medians,
    # as a figure's colours may be among them.
    tint = np.ones(3)
    for _ in range(_ROUNDS):
        tint += np.median(now - tint * then, axis=0) / then.mean(axis=0)
    tint /= np.exp(np.log(np.maximum(tint, 1e-6)).mean())
    error = (now - tint * then).std(axis=0) / (then.mean(axis=0) * np.sqrt(len(now)))
    return None if _largest(tint) < max(_TINTED, _SURE * error.max()) else tint


def _unclipped(image: Float32) -> NDArray[np.bool_]:
    """Where a picture as it was shot, (H, W, 3), is not next to the most that it holds; single
    pixels may be broken."""
    clear = np.ones(image.shape[:2], bool)
    for channel in cv2.split(image):
        values = channel[np.isfinite(channel)]
        if values.size:
            clear &= channel < _UNCLIPPED * np.quantile(values, _BRIGHTEST)
    return clear


def clipped_part(samples: Sequence[Float32], top: float | None) -> float:
    """What part of a take holds more light than its files can say.

    Clipped light is the most that there is, in most frames, and does not scatter.

    Args:
        samples: (h, w, 3) each, a few frames, linear light; not finite unknown. Those of which
            another exposure was taken out have another top, and count as below it or above.
        top: the most that the files can hold; None if they have no such bound, as floats: then a
            plateau counts, if light elsewhere scatters.

    Returns:
        The part of the pixels that are clipped in any channel; 0 of fewer than two samples.
    """
    if len(samples) < 2:
        return 0.0
    stack = np.stack(samples)
    known = np.where(np.isfinite(stack), stack, 0)
    most = np.quantile(known, _ALL_BUT_BROKEN, axis=(0, 1, 2))
    clipped = (known >= _AT_THE_TOP * most).mean(axis=0) >= _IN_MOST
    clipped &= most > (0 if top is None else _AT_THE_TOP * top)
    if top is None:
        still = (np.diff(known, axis=0) == 0).mean(axis=0) > _IN_MOST
        rest = still[~clipped & (known > 0).any(axis=0)]
        if not rest.size or rest.mean() > _SCATTERS:
            return 0.0
    return float(clipped.any(axis=-1).mean())


def _means_ratio(image: Float32, reference: Float32, where: NDArray[np.bool_]) -> Float64:
    """The ratio of each channel's mean, (3,), by that of all together."""
    now, then = (np.array(cv2.mean(i, where.view(np.uint8))[:3]) for i in (image, reference))
    ratio = np.maximum(now, 1e-6) / np.maximum(then, 1e-6)
    return np.asarray(ratio / np.exp(np.log(ratio).mean()))


def _largest(ratio: Float64) -> float:
    """The logarithm that is furthest from 0."""
    return float(np.abs(np.log(ratio)).max())


def is_one(gain: Gains) -> bool:
    """Whether a frame has the reference's exposure."""
    return isinstance(gain, float) and gain == 1


def of_rows(gain: Gains, rows: slice) -> Gains:
    """The gain of some rows of a picture."""
    return gain if isinstance(gain, float) else gain[rows]


def level_of(gain: Gains) -> float:
    """A frame's gain altogether."""
    return float(np.mean(gain))


def unevenness(gain: Gains) -> float:
    """By what part a row is brighter or darker than the frame altogether, at most."""
    if isinstance(gain, float):
        return 0.0
    along = gain.mean(axis=1)
    return float(np.abs(along / along.mean() - 1).max())


def tint_of(gain: Gains) -> list[float]:
    """By how much each channel is brighter than the frame altogether, three numbers."""
    if isinstance(gain, float):
        return [1.0, 1.0, 1.0]
    channels = gain.mean(axis=0)
    return [round(float(channel), 4) for channel in channels / channels.mean()]


def _ratios(now: Float32, then: Float32) -> Float32:
    """Logarithms of the ratios of two frames' brightness where it can be told."""
    usable = np.isfinite(now) & np.isfinite(then) & (then > 1e-2) & (now > 0)
    return np.asarray(np.log(now[usable] / then[usable]), np.float32)


def _agreed(ratios: Float32) -> float | None:
    """The most frequent of them; None if none is."""
    near = ratios[np.abs(ratios) < _WIDEST]
    if near.size < max(_LEAST_PART * ratios.size, _LEAST_PIXELS):
        return None
    counts, edges = np.histogram(near, bins=140, range=(-_WIDEST, _WIDEST))
    smooth = np.convolve(counts, np.hanning(9), mode="same")
    peak = int(np.argmax(smooth))
    centre = (edges[peak] + edges[peak + 1]) / 2
    agreed = near[np.abs(near - centre) < _NEAR[0]]
    # What agrees is many, and many more than if the ratios were anything at all.
    enough = max(_LEAST_PART * ratios.size, 2 * near.size * _NEAR[0] / _WIDEST)
    return None if agreed.size < enough else _closed_in(np.sort(near), centre)


def _closed_in(ordered: Float32, centre: float, spread: float = 0.0) -> float:
    """The middle of those ratios near the centre, of ratios in order; no nearer than they
    scatter."""
    for width in _NEAR:
        reach = max(width, spread)
        first, last = np.searchsorted(ordered, (centre - reach, centre + reach))
        centre = _middle(ordered[first:last]) if last > first else centre
    return centre


def _middle(ordered: Float32) -> float:
    """The median of what is in order."""
    count = len(ordered)
    return float(ordered[(count - 1) // 2 : count // 2 + 1].mean())


def sampled_areas(gray: NDArray[np.floating]) -> Float32:
    """Means of runs of pixels in evenly spaced rows, (H, W) to (h, w); what is left over at the
    right is left out."""
    step = max(1, round(max(gray.shape) / _AREAS))
    width = gray.shape[1] // step
    if width == 0:
        return np.array(gray[::step, :1], np.float32)
    runs = to_float(gray[::step, : width * step]).reshape(-1, width, step)
    return np.asarray(np.einsum("ijk->ij", runs) / np.float32(step), np.float32)


class RunningGain:
    """Each frame's exposure against the first, of frames that come one after the other.

    A shadow that is swept across the picture changes little of it from one frame to the next. So
    what most pixels did since the last frame is exposure, however much is in shadow; and those
    that are about as bright as that says, against the first frame, are in the same light as then:
    they tell it without what many small errors add up to.
    """

    def __init__(self) -> None:
        self._first: Float32 | None = None
        self._last: Float32 | None = None
        self._logarithm = 0.0

    def add(self, gray: Float32) -> float:
        """By how much this frame is brighter than the first; 1 if that does no harm.

        Args:
            gray: brightness of a few thousand pixels or small areas, the same in every frame,
                linear light; not finite unknown.
        """
        if self._first is None or self._last is None:
            self._first = self._last = gray
            return 1.0
        changes = np.sort(_ratios(gray, self._last))
        if not changes.size:
            return self._gain()
        middle = _middle(changes)
        # Of a picture that a shadow leaves all but black nothing can be told.
        agreed = np.count_nonzero(np.abs(changes - middle) < _NEAR[0])
        if agreed < max(_LEAST_PART * gray.size, _LEAST_PIXELS):
            return self._gain()
        spread = 1.48 * float(median(np.abs(changes - middle)))
        expected = self._logarithm + _closed_in(changes, middle, spread)
        ratios = _ratios(gray, self._first)
        same = np.abs(ratios - expected) < max(_NEAR[0], spread)
        if same.sum() >= max(_LEAST_PART * ratios.size, _LEAST_PIXELS):
            expected = _closed_in(np.sort(ratios), expected, spread)
        self._logarithm, self._last = expected, gray
        return self._gain()

    def _gain(self) -> float:
        steady = abs(self._logarithm) < _HARMLESS
        return 1.0 if steady else float(np.exp(self._logarithm))


def common_reference(samples: list[Float32]) -> Float32:
    """What most of a sample of frames show, with their own gains taken out; (h, w, 3).

    Its own exposure is that of the most frames: where long shade pulls the median down, the light
    that most of them agree in lifts it again. Where a lamp flickers, each row is taken to be as
    often lighter as darker.
    """
    reference = median(np.stack(samples))
    # By levels alone first: where shade lasts that middle is darker, as if all frames had bands.
    reference = _in_middle_light(samples, [frame_gain(sample, reference) for sample in samples])
    banded = flickers(samples, reference)
    gains = _row_gains_of_all(samples, reference, banded)
    if not all(isinstance(gain, float) for gain in gains):
        reference = _in_middle_light(samples, gains)
        gains = _row_gains_of_all(samples, reference, banded)
    usual = float(np.median([level_of(gain) for gain in gains]))
    if all(isinstance(gain, float) for gain in gains):
        return reference * np.float32(usual)
    uneven = [np.log(np.ones((len(reference), 3)) * gain / level_of(gain)) for gain in gains]
    rows = np.mean(uneven, axis=(0, 2))[:, np.newaxis]
    tint = np.median(np.mean(uneven, axis=1), axis=0)
    return without_gain(reference, np.exp(-rows - tint) / usual).astype(np.float32, copy=False)


def _row_gains_of_all(samples: list[Float32], reference: Float32, banded: bool) -> list[Gains]:
    rows = np.arange(len(reference), dtype=np.float64)
    return [row_gains(sample, reference, rows, banded) for sample in samples]


def _in_middle_light(samples: list[Float32], gains: Sequence[Gains]) -> Float32:
    """The median of frames without what tells their gains from the middle one."""
    level = float(np.median([level_of(gain) for gain in gains]))
    pairs = zip(samples, gains, strict=True)
    return median(np.stack([without_gain(sample, gain / level) for sample, gain in pairs]))


def without_gain(image: NDArray[np.floating], gain: Gains) -> NDArray[np.floating]:
    """The frame as it would be at gain 1; the very same array if it is.

    Args:
        image: (H, W, 3), or (H, W) for a gain that is one number.
    """
    if is_one(gain):
        return image
    if isinstance(gain, float):
        inverse = np.full(len(image), 1 / gain, np.float32).reshape(-1, *[1] * (image.ndim - 1))
    else:
        inverse = (1 / gain).astype(np.float32)[:, np.newaxis]
    if image.dtype != np.float16:
        with np.errstate(over="ignore"):
            return image.astype(np.float32) * inverse
    corrected = np.empty_like(image)
    for rows in bands(image.shape):
        corrected[rows] = rounded(to_float(image[rows]) * inverse[rows])
    return corrected
