"""When the leading edge of a swept shadow reaches each pixel (section 4, temporal analysis).

An edge sharper than its own step falls between two frames; where, only those pixels tell that a
frame caught half-way. How long the edge takes to pass a pixel is told by how many were caught.
"""

import sys
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.crossings import LEAST_CONTRAST, Crossings
from shadowtool.core.half_floats import rounded, to_float
from shadowtool.core.lengths import length
from shadowtool.core.noise import NoiseModel, extreme_range
from shadowtool.core.plane_fits import Windows, fit_planes
from shadowtool.core.transfer import LUMA

# No compiler was there when this was installed, or none that knows what they need.
try:
    from shadowtool.core import _luminance
except ImportError:
    _luminance = None  # type: ignore[assignment]
try:
    from shadowtool.core import _own_times
except ImportError:
    _own_times = None  # type: ignore[assignment]

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# A value between dark and lit was caught on its way if it is off both by so many standard
# deviations, and by a part of the contrast, this one at least: light flickers, and a codec's errors
# are largest where something has just changed.
_CAUGHT, _LEAST_CAUGHT = 3.0, 0.04
# Parts of the contrast by which values are counted, where they are on their way for certain, and
# how many times as often as there a value may occur that is.
_BINS, _CERTAIN, _TOO_OFTEN = 50, 0.2, 2.0
# Half the window in which an edge is taken to last equally long, pixels.
_LOCAL = 15
# So many arrays of pixels are worked on together; about so many rows tell how fast an edge moves,
# and pixels what they usually lose.
_ARRAYS, _SLOPE_ROWS, _USUAL = 4, 128, 100_000
# How well an edge's profile is known, as a part of its duration; and the least error, frames.
_PROFILE, _LEAST_ERROR = 0.1, 0.01
# From the first duration on, in frames, to the second, interpolation between the frames takes over.
_SHARP, _SOFT = 0.6, 1.0
# From how many frames on an edge's duration is told by its fall, and up to how many; how large a
# fall noise makes by itself where it chooses the frame, in standard deviations.
_LONG, _LONGEST, _CHOSEN = 2.5, 100.0, 1.5
# Standard deviation of a time of which only the interval between two frames is known.
INTERVAL_ERROR = 1 / np.sqrt(12)
# Steps of so many times the usual one are from one thing to another; and on one thing times differ
# from pixel to pixel by so many times their slope on the plane.
_OTHER, _SLOPED = 3.0, 1.5
# Noise moves a time by up to so many of its standard deviations.
_MOVED = 3.0
# Half the widths of the windows in which times are taken for linear, pixels.
_RADII = (2, 5)
_WINDOWS = Windows(_RADII)
# Less than this part of the usual loss of light is that of a pixel in shade. A pixel that loses the
# part p has a time that is off by up to so much of the edge's duration, 1/p - 1 times.
SHADE, _MISLED = 0.3, 0.2


@dataclass(frozen=True)
class ShadowTimes:
    """The result of one pass.

    Attributes:
        time: (H, W) float32, frame numbers with fractions, as the pixels around a pixel tell them
            too; NaN unknown.
        error: (H, W) float32, predicted error of ``time``, frames; infinite unknown.
        contrast: (H, W) float32 ≥ 0, I_max - I_min of the pass, linear light.
        own_time, own_error: (H, W) float32, what each pixel tells alone.
    """

    time: Float32
    error: Float32
    contrast: Float32
    own_time: Float32
    own_error: Float32

    @classmethod
    def alone(
        cls, time: Float32, contrast: Float32, error: float | Float32 = INTERVAL_ERROR
    ) -> "ShadowTimes":
        """Times of which no more is known than each pixel tells."""
        known = np.where(np.isfinite(time), error, np.inf).astype(np.float32)
        return cls(time, known, contrast, time, known)


def luminance(image: NDArray[np.floating]) -> Float32:
    """(H, W, 3) linear RGB to (H, W) float32; not finite where a channel isn't."""
    gray = np.empty(image.shape[:2], np.float32)
    for rows in bands(image.shape):
        gray[rows] = cv2.transform(to_float(image[rows]), LUMA[np.newaxis])
    return gray


def luminance_halfs(
    red: NDArray[np.floating],
    green: NDArray[np.floating],
    blue: NDArray[np.floating],
    out: NDArray[np.float16] | None = None,
) -> NDArray[np.float16]:
    """Luminance of three channels (H, W), rounded to halfs; infinite where it is too large for one,
    not finite where a channel isn't.

    Args:
        out: (H, W) to write to; an array of its own if there is none.
    """
    gray = np.empty(red.shape, np.float16) if out is None else out
    channels, weights = (red, green, blue), LUMA.tolist()
    halfs = all(
        part.dtype == np.float16 and part.strides[1] == 2 and part.shape == gray.shape
        for part in (*channels, gray)
    )
    if _luminance is not None and halfs and sys.byteorder == "little":
        _luminance.luminance(*channels, gray, *weights)
        return gray
    for rows in bands(red.shape, channels=1):
        first, second, third = (
            to_float(channel[rows]) * np.float32(weight)
            for channel, weight in zip(channels, weights, strict=True)
        )
        first += second
        first += third
        gray[rows] = rounded(first)
    return gray


def significant(crossings: Crossings, noise: NoiseModel) -> Crossings:
    """Crossings without those of pixels whose minimum and maximum may be nothing but noise."""
    sigmas = max(float(extreme_range(crossings.frames)), 8.0)
    at, lost = np.empty_like(crossings.at), np.empty_like(crossings.lost)
    for rows in bands(at.shape, _ARRAYS):
        highest = crossings.highest[rows]
        least = np.maximum(_sigma(highest, noise) * sigmas, LEAST_CONTRAST * highest)
        seen = highest - crossings.lowest[rows] > least
        at[rows] = crossings.at[rows] * seen
        lost[rows] = crossings.lost[rows] & seen
    return crossings._replace(at=at, lost=lost)


def interpolated_times(crossings: Crossings) -> Float32:
    """The paper's own: the threshold's crossing on a straight line from frame to frame.

    Returns:
        (H, W) float32, positions among the frames; NaN unknown.
    """
    time = _passed(crossings, (crossings.lowest + crossings.highest) / 2)
    return np.where(crossings.at > 0, time, np.nan).astype(np.float32)


def _passed(crossings: Crossings, threshold: NDArray[np.floating]) -> Float32:
    """When a straight line from the frame before the crossing to the next is at a threshold."""
    before, after = crossings.before, crossings.after
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        part = (before - threshold) / (before - after)
    return np.asarray(crossings.at.astype(np.float32) - 1 + np.clip(part, 0, 1), np.float32)


def own_times(
    crossings: Crossings, noise: NoiseModel, trembling: float = 0.0
) -> tuple[Float32, Float32, Float32]:
    """The time that each pixel tells alone, and how well it can.

    An edge that takes the part τ < 1 of a frame to pass is seen on its way by as many pixels. Of
    these the visibility v tells the time: t = f + τ(v - ½). Of all others nothing is known but
    the interval. τ follows from the sum of v(1 - v) over a pixel's frames, which for a straight
    flank is τ/6 in the mean. Edges that take longer are on their way in both frames, and
    interpolation between them is right; how long they take, and so how far noise moves the time,
    is told by how little of the light is lost from one of the two frames to the other.

    Args:
        trembling: by how much the camera's place varies, standard deviation in pixels. On texture
            that is so much more noise.

    Returns:
        Positions among the frames and their standard deviations, in frames, NaN and infinite where
        unknown, and how many frames the edge takes to pass; (H, W) float32 each.
    """
    known = crossings.at > 0
    ends = (crossings.lowest, crossings.highest) if trembling else ()
    rough = [np.float32(trembling) * _slope(end) for end in ends]
    (lost, left, fall), counts = _caught(crossings, noise, rough)
    passing = np.empty_like(lost)
    cuts = list(bands(known.shape, _ARRAYS))
    least = [np.float32(_least_caught(count)) for count in counts]
    for rows in cuts:
        total = passing[rows]
        total[:] = 0
        for values, enough in zip((lost[rows], left[rows]), least, strict=True):
            values *= values > enough
            total += values * (1 - values)
    duration, slower = _local_means([passing, fall], known)
    duration *= np.float32(6)
    longer = 1 / np.maximum(slower, np.float32(1 / _LONGEST))
    # Two frames tell of no more than three.
    np.copyto(duration, longer, where=(longer > _LONG) & (duration > 1))
    time, error = _told(crossings, noise, rough, (lost, left, duration))
    return time, error, duration


def _caught(
    crossings: Crossings, noise: NoiseModel, rough: list[Float32]
) -> tuple[tuple[Float32, Float32, Float32], NDArray[np.number]]:
    """What of an edge the two frames around each crossing caught.

    Args:
        rough: standard deviations of what was dark and lit besides the noise; nothing if there are
            none.

    Returns:
        What part of the light was lost in the frame before, and what was left in the one after, 0
        where that may be noise, and how much fell between them, (H, W) float32 each, 0 where no
        crossing is known; and how often each part occurs of the first two, (2, _BINS).
    """
    lost, left, fall = (np.empty(crossings.at.shape, np.float32) for _ in range(3))
    found = lost, left, fall
    # Where an edge falls by less than the noise from frame to frame, noise chooses the frame.
    chosen = _CHOSEN / 2
    if _own_times is not None:
        counted = np.zeros((2, _BINS), np.int64)
        _own_times.catch(
            _parts(crossings, rough), found, counted, *_numbers(crossings, noise), _CAUGHT, chosen
        )
        return found, counted
    counts = np.zeros((2, _BINS))
    for rows in bands(fall.shape, _ARRAYS):
        part, known = crossings.part(rows), crossings.at[rows] > 0
        lit, dark, contrast, *sigmas = _extremes(part, noise, [texture[rows] for texture in rough])
        passed = (lost, lit - part.before), (left, part.after - dark)
        for (values, of), count, sigma in zip(passed, counts, sigmas, strict=True):
            seen = np.minimum(np.fmax(of / contrast, 0), 1)
            count += _counts(seen, known)
            # Not caught is as good as not on its way.
            np.multiply(seen, known & (seen > _CAUGHT * sigma), out=values[rows])
        noise_alone = chosen * (sigmas[0] + sigmas[1])
        between = np.fmax((part.before - part.after) / contrast, 0) ** 2 - noise_alone**2
        # What is not known is nothing; in a mean NaN would spread.
        fall[rows] = np.where(known, np.sqrt(np.fmax(between, 0)), np.float32(0))
    return found, counts


def _parts(crossings: Crossings, rough: list[Float32]) -> tuple[NDArray[Any] | None, ...]:
    """Crossings as the compiled functions take them."""
    at, *lights = crossings[:5]
    singles = [np.ascontiguousarray(light, np.float32) for light in (*lights, *rough)]
    return np.ascontiguousarray(at, np.int32), *singles, *([] if rough else [None, None])


def _numbers(crossings: Crossings, noise: NoiseModel) -> tuple[float, float, float]:
    """Variance of luminance by light and without it, and how many standard deviations the extremes
    of noise lie beyond what was lit and dark."""
    return *_luminance_noise(noise), _largest(crossings.frames / 2)


def _luminance_noise(noise: NoiseModel) -> tuple[float, float]:
    weights = LUMA.astype(np.float64) ** 2
    return float(weights @ noise.slope), float(weights @ noise.floor)


def _slope(gray: Float32) -> Float32:
    """Length of the gradient of a picture (H, W), per pixel; unknown is 0."""
    gray = np.nan_to_num(gray)
    # Differences of neighbours on either side, with nothing of the rows and columns beside them.
    x, y = (cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, ksize=1, scale=0.5) for dx in (1, 0))
    return length(x, y)


def _extremes(
    crossings: Crossings, noise: NoiseModel, rough: list[Float32]
) -> tuple[Float32, Float32, Float32, Float32, Float32]:
    """Luminance lit and dark, their difference, and the standard deviations of both in its unit.

    Args:
        rough: as of `_caught`.
    """
    lit_sigma = _sigma(crossings.highest, noise)
    dark_sigma = _sigma(crossings.lowest, noise)
    for sigma, more in zip((dark_sigma, lit_sigma), rough, strict=False):
        length(sigma, more, out=sigma)
    beyond = np.float32(_numbers(crossings, noise)[-1])
    lit = crossings.highest - beyond * lit_sigma
    dark = crossings.lowest + beyond * dark_sigma
    contrast = np.maximum(lit - dark, np.float32(1e-6))
    return lit, dark, contrast, lit_sigma / contrast, dark_sigma / contrast


def _told(
    crossings: Crossings,
    noise: NoiseModel,
    rough: list[Float32],
    caught: tuple[Float32, Float32, Float32],
) -> tuple[Float32, Float32]:
    """Times and errors, NaN and infinite where no crossing is known.

    Args:
        rough: as of `_caught`.
        caught: what part of the light was lost in the frame before, and what was left in the one
            after the crossing, 0 where the edge was not caught on its way; and how many frames it
            takes to pass, around each pixel.
    """
    found = time, error = np.empty_like(caught[0]), np.empty_like(caught[0])
    if _own_times is not None:
        numbers = _PROFILE**2, _LEAST_ERROR, 3 * _LEAST_ERROR, INTERVAL_ERROR, _SHARP
        _own_times.tell(
            _parts(crossings, rough),
            caught,
            found,
            *_numbers(crossings, noise),
            *numbers,
            _SOFT - _SHARP,
        )
        return found
    for rows in bands(time.shape, _ARRAYS):
        part, known = crossings.part(rows), crossings.at[rows] > 0
        extremes = _extremes(part, noise, [texture[rows] for texture in rough])
        told = _told_of_known(part, extremes, *(values[rows] for values in caught))
        time[rows] = np.where(known, told[0], np.float32(np.nan))
        error[rows] = np.where(known, told[1], np.float32(np.inf))
    return found


def _told_of_known(
    crossings: Crossings,
    extremes: tuple[Float32, Float32, Float32, Float32, Float32],
    lost: Float32,
    left: Float32,
    duration: Float32,
) -> tuple[Float32, Float32]:
    """`_told` of known pixels; the extremes as of `_extremes`."""
    lit, dark, _, lit_sigma, dark_sigma = extremes
    sharp = np.minimum(duration, 1)
    half, one = np.float32(0.5), np.float32(1)
    # Midway between the frames, unless one of them caught it.
    late = crossings.at.astype(np.float32)
    time, error = late - half, np.maximum(one - sharp, 0.1) * np.float32(INTERVAL_ERROR)
    both = (lost > 0) & (left > 0)
    for part, at, sigma in (
        (lost, late - one + (half - lost) * sharp, lit_sigma),
        (left, late - (half - left) * sharp, dark_sigma),
    ):
        alone = ((part > 0) & ~both).view(np.uint8)
        spread = sharp * np.sqrt(sigma * sigma + np.float32(_PROFILE**2)) + np.float32(_LEAST_ERROR)
        cv2.copyTo(at, alone, time)
        cv2.copyTo(spread, alone, error)
    # Midway between what was lit and what was dark, not between the extremes of their noise.
    straight = _passed(crossings, (lit + dark) / 2)
    scatter = np.sqrt(lit_sigma * lit_sigma + dark_sigma * dark_sigma) / 2
    soft = np.clip((duration - _SHARP) / (_SOFT - _SHARP), 0, 1)
    np.maximum(soft, both, out=soft)
    time += soft * (straight - time)
    error += soft * (np.maximum(duration, 1) * scatter + 3 * _LEAST_ERROR - error)
    return np.clip(time, late - one, late), error


def time_windows(time: Float32, plane: Bool) -> Windows:
    """Windows for `refined_times`: they grow with the edge's step, which is seen in the mean slope
    of the times on the reference plane.

    Args:
        time: (H, W), positions among the frames; NaN unknown.
        plane: (H, W), the reference plane region.
    """
    slopes = []
    # A few rows are enough, each with the one below it.
    every = max(1, len(time) // _SLOPE_ROWS)
    above, below = time[:-1:every], time[1::every]
    inside, inside_below = plane[:-1:every], plane[1::every]
    for first, second, both in (
        (above, below, inside & inside_below),
        (above[:, :-1], above[:, 1:], inside[:, :-1] & inside[:, 1:]),
    ):
        slope = (second - first)[both]
        slope = slope[np.isfinite(slope)]
        if slope.size:
            # Larger steps are from one thing to another.
            usual = float(np.median(np.abs(slope)))
            slope = slope[np.abs(slope) < max(2, _OTHER * usual)]
        slopes.append(float(slope.mean()) if slope.size else 0.0)
    steepest = float(np.hypot(slopes[0], slopes[1]))
    windows = Windows.for_step(1 / steepest if steepest > 0 else 0.0, _RADII)
    return replace(windows, near=max(1.0, _SLOPED * steepest))


def refined_times(
    time: Float32,
    error: Float32,
    at: NDArray[np.int32],
    windows: Windows = _WINDOWS,
    wanted: slice = slice(None),
) -> tuple[Float32, Float32]:
    """Times as the pixels around tell them too, each within its own interval between two frames, or
    as far beyond it as noise may have moved it.

    Args:
        time, error: (H, W) float32 from `own_times`.
        at: (H, W) from `Crossings`.
        windows: in which times are taken for linear.
        wanted: rows; no others are worked out.

    Returns:
        Positions among the frames and their predicted errors; (H, W) float32 each, of the rows
        wanted.
    """
    fitted, spread = fit_planes(time, error, windows, wanted)
    late, own = at[wanted].astype(np.float32), error[wanted]
    beyond = np.where(own > INTERVAL_ERROR, np.float32(_MOVED) * own, np.float32(0))
    return np.clip(fitted, late - 1 - beyond, late + beyond, out=fitted), spread


def usual_loss(contrast: Float32, highest: Float32, known: Bool, plane: Bool) -> Float32:
    """What part of its light each pixel loses to the stick, against what is usual on the plane.

    In shade of its own a pixel still loses some sky, at another time than it would lose the key
    light: below `SHADE` it counts as shade.

    Args:
        contrast, highest: (H, W), I_max - I_min and I_max.
        known, plane: (H, W), where there is a time; the reference plane region.

    Returns:
        (H, W) float32 in [0, 1]; all 1 if nothing is known on the plane.
    """
    part = contrast / np.maximum(highest, np.float32(1e-30))
    part[~(highest > 0)] = 0
    usual = part[plane & known]
    if not usual.size:
        return np.ones(contrast.shape, np.float32)
    # As many as tell a median well.
    middle = float(np.median(usual[:: max(1, usual.size // _USUAL)]))
    part /= np.float32(max(middle, 1e-6))
    return np.minimum(part, 1, out=part)


def misled(duration: Float32, loss: Float32) -> Float32:
    """How far off a time may be because not all that is lost is the key light's.

    A surface that the key light grazes, or that a stick blocks in part, loses as much of the sky as
    others. While the edge passes that shifts the middle of what is lost, and alike for all pixels
    around.

    Args:
        duration: (H, W), frames that the edge takes to pass, as of `own_times`.
        loss: (H, W) as of `usual_loss`.

    Returns:
        (H, W) float32, frames; 0 where the loss is the usual one.
    """
    besides = 1 / np.maximum(loss, np.float32(SHADE)) - 1
    return np.asarray(np.float32(_MISLED) * duration * besides, np.float32)


def _counts(part: Float32, known: Bool) -> NDArray[np.float32]:
    """How many of the known pixels have which part of the contrast, up to a half of it."""
    counts = cv2.calcHist([part], [0], known.view(np.uint8), [_BINS], [0.0, 0.5])
    return np.asarray(counts, np.float32).ravel()


def _least_caught(counts: NDArray[np.floating]) -> float:
    """Below which part of the contrast a value may well be an error and no edge on its way.

    A flank passes all values about equally fast; where far more pixels have a value than that, most
    of them were lit or dark.

    Args:
        counts: from `_counts`.
    """
    edges = np.linspace(0, 0.5, _BINS + 1)
    certain = edges[:-1] >= _CERTAIN
    often = counts > _TOO_OFTEN * max(float(np.median(counts[certain])), 1.0)
    often[certain] = False
    last = int(np.flatnonzero(often)[-1]) + 1 if often.any() else 0
    return max(float(edges[last]), _LEAST_CAUGHT)


def _sigma(gray: Float32, noise: NoiseModel) -> Float32:
    """Standard deviation of the luminance ``gray``, (H, W)."""
    slope, floor = _luminance_noise(noise)
    # Of NaN and 0 it gives 0.
    variance = np.fmax(gray, 0) * np.float32(slope)
    variance += np.float32(floor)
    return np.asarray(np.sqrt(variance, out=variance), np.float32)


def _largest(count: float) -> float:
    """The largest of so many standard normal samples, in the mean (asymptotically)."""
    reach = np.sqrt(2 * np.log(max(count, 3)))
    return float(reach - (np.log(np.log(max(count, 3))) + np.log(4 * np.pi)) / (2 * reach))


def _local_means(pictures: list[Float32], known: Bool) -> list[Float32]:
    """Means over the known pixels around each; the others are 0."""
    size = (2 * _LOCAL + 1, 2 * _LOCAL + 1)

    def total(image: NDArray[Any]) -> NDArray[Any]:
        return cv2.boxFilter(
            image, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT
        )

    count = total(known.view(np.uint8))
    np.maximum(count, 1, out=count)
    return [np.asarray(total(picture) / count, np.float32) for picture in pictures]
