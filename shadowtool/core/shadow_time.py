"""When the leading edge of a swept shadow reaches each pixel (section 4, temporal analysis).

An edge sharper than its own step falls between two frames; where, only those pixels tell that a
frame caught half-way. How long the edge takes to pass a pixel is told by how many were caught.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.noise import NoiseModel, extreme_range
from shadowtool.core.plane_fits import fit_planes

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Rec.709 luminance.
LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)

# A value between dark and lit was caught on its way if it is off both by so many standard
# deviations, and by a part of the contrast, this one at least: light flickers, and a codec's errors
# are largest where something has just changed.
_CAUGHT, _LEAST_CAUGHT = 3.0, 0.04
# Parts of the contrast by which values are counted, where they are on their way for certain, and
# how many times as often as there a value may occur that is.
_BINS, _CERTAIN, _TOO_OFTEN = 50, 0.2, 2.0
# Half the window in which an edge is taken to last equally long, pixels.
_LOCAL = 15
# How well an edge's profile is known, as a part of its duration; and the least error, frames.
_PROFILE, _LEAST_ERROR = 0.1, 0.01
# From the first duration on, in frames, to the second, interpolation between the frames takes over.
_SHARP, _SOFT = 0.6, 1.0
# Standard deviation of a time of which only the interval between two frames is known.
INTERVAL_ERROR = 1 / np.sqrt(12)
# Less than this part of the usual contrast is that of a pixel in shade.
_SHADE = 0.4


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
    """(H, W, 3) linear RGB to (H, W) float32."""
    red, green, blue = (image[..., c].astype(np.float32) for c in range(3))
    return np.asarray(red * LUMA[0] + green * LUMA[1] + blue * LUMA[2], np.float32)


class LuminanceRange:
    """Running I_min and I_max of a pass, in constant memory. Non-finite values are passed over."""

    def __init__(self) -> None:
        self.lowest: Float32 | None = None
        self.highest: Float32 | None = None
        self.frames = 0

    def add(self, gray: Float32) -> None:
        """Take in one frame's luminance, (H, W) float32."""
        finite = np.isfinite(gray)
        if not finite.all():
            gray = np.where(finite, gray, np.float32(np.nan))
        if self.lowest is None or self.highest is None:
            self.lowest, self.highest = gray.copy(), gray.copy()
        else:
            np.fmin(self.lowest, gray, out=self.lowest)
            np.fmax(self.highest, gray, out=self.highest)
        self.frames += 1


def least_contrast(highest: Float32, frames: int, noise: NoiseModel) -> Float32:
    """The contrast below which a pixel's minimum and maximum may be nothing but noise.

    Returns:
        (H, W) float32, linear light.
    """
    return np.asarray(_sigma(highest, noise) * np.maximum(extreme_range(frames), 8), np.float32)


class Crossings(NamedTuple):
    """Between which two frames each pixel's luminance first fell below (I_min + I_max) / 2.

    Attributes:
        at: (H, W) int32, position of the later frame among those looked at, ≥ 1; 0 unknown.
        before, after: (H, W) float32, luminance in the frame before and in that one.
        lowest, highest: (H, W) float32, I_min and I_max of the pass.
        frames: how many were looked at.
    """

    at: NDArray[np.int32]
    before: Float32
    after: Float32
    lowest: Float32
    highest: Float32
    frames: int


class CrossingFinder:
    """Finds the first crossing of the half-way threshold, frame by frame, in constant memory.

    What follows the leading edge makes no difference. A pixel that is below the threshold from the
    start has no crossing that was seen: unknown.
    """

    def __init__(self, lowest: Float32, highest: Float32, least: Float32) -> None:
        """Args: I_min, I_max and the contrast below which nothing is known, each (H, W)."""
        self._lowest, self._highest = lowest, highest
        self._threshold = (highest + lowest) / 2
        self._open = (highest - lowest) > least
        self._at = np.zeros(lowest.shape, np.int32)
        self._before = np.full(lowest.shape, np.nan, np.float32)
        self._after = self._before.copy()
        self._last: Float32 | None = None
        self._frames = 0

    def add(self, gray: Float32) -> None:
        """Take in one frame's luminance, (H, W), in the order of the pass.

        Where it isn't finite the last value that was stands.
        """
        finite = np.isfinite(gray)
        if not finite.all():
            last = np.full_like(gray, np.nan) if self._last is None else self._last
            gray = np.where(finite, gray, last)
        with np.errstate(invalid="ignore"):
            below = self._open & (gray < self._threshold)
        if self._last is not None:
            np.copyto(self._at, self._frames, where=below)
            np.copyto(self._before, self._last, where=below)
            np.copyto(self._after, gray, where=below)
        self._open &= ~below
        self._last = gray
        self._frames += 1

    def found(self) -> Crossings:
        """What was found so far."""
        at = np.where(np.isfinite(self._before), self._at, 0).astype(np.int32)
        ends = (self._before, self._after)
        return Crossings(at, *ends, self._lowest, self._highest, self._frames)


def interpolated_times(crossings: Crossings) -> Float32:
    """The paper's own: the threshold's crossing on a straight line from frame to frame.

    Returns:
        (H, W) float32, positions among the frames; NaN unknown.
    """
    before, after = crossings.before, crossings.after
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        threshold = (crossings.lowest + crossings.highest) / 2
        part = (before - threshold) / (before - after)
    time = crossings.at - 1 + np.clip(part, 0, 1)
    return np.where(crossings.at > 0, time, np.nan).astype(np.float32)


def own_times(crossings: Crossings, noise: NoiseModel) -> tuple[Float32, Float32]:
    """The time that each pixel tells alone, and how well it can.

    An edge that takes the part τ < 1 of a frame to pass is seen on its way by as many pixels. Of
    these the visibility v tells the time: t = f + τ(v - ½). Of all others nothing is known but
    the interval. τ follows from the sum of v(1 - v) over a pixel's frames, which for a straight
    flank is τ/6 in the mean. Edges that take longer are on their way in both frames, and
    interpolation between them is right.

    Returns:
        Positions among the frames and their standard deviations, in frames; (H, W) float32 each,
        NaN and infinite where unknown.
    """
    known = crossings.at > 0
    # The extremes of noise lie beyond what was lit and dark.
    lit_sigma = _sigma(crossings.highest, noise)
    dark_sigma = _sigma(crossings.lowest, noise)
    beyond = np.float32(_largest(crossings.frames / 2))
    lit = crossings.highest - beyond * lit_sigma
    dark = crossings.lowest + beyond * dark_sigma
    contrast = np.maximum(lit - dark, 1e-6)
    lit_sigma, dark_sigma = lit_sigma / contrast, dark_sigma / contrast
    with np.errstate(invalid="ignore"):
        lost = np.clip((lit - crossings.before) / contrast, 0, 1)
        left = np.clip((crossings.after - dark) / contrast, 0, 1)
    caught_before = known & (lost > np.maximum(_CAUGHT * lit_sigma, _least_caught(lost[known])))
    caught_after = known & (left > np.maximum(_CAUGHT * dark_sigma, _least_caught(left[known])))
    lost, left = np.where(caught_before, lost, 0), np.where(caught_after, left, 0)
    duration = 6 * _local_mean(lost * (1 - lost) + left * (1 - left), known)
    sharp = np.minimum(duration, 1)
    # Midway between the frames, unless one of them caught it.
    late = crossings.at.astype(np.float32)
    time, error = late - 0.5, np.maximum(1 - sharp, 0.1) * np.float32(INTERVAL_ERROR)
    for caught, other, at, sigma in (
        (caught_before, caught_after, late - 1 + (0.5 - lost) * sharp, lit_sigma),
        (caught_after, caught_before, late - (0.5 - left) * sharp, dark_sigma),
    ):
        alone = caught & ~other
        np.copyto(time, at, where=alone)
        np.copyto(error, sharp * np.hypot(sigma, _PROFILE) + _LEAST_ERROR, where=alone)
    straight = np.nan_to_num(interpolated_times(crossings))
    scatter = np.hypot(lit_sigma, dark_sigma) / 2
    soft = np.where(
        caught_before & caught_after, 1, np.clip((duration - _SHARP) / (_SOFT - _SHARP), 0, 1)
    )
    time += soft * (straight - time)
    error += soft * (np.maximum(duration, 1) * scatter + 3 * _LEAST_ERROR - error)
    time = np.where(known, np.clip(time, late - 1, late), np.nan)
    return time.astype(np.float32), np.where(known, error, np.inf).astype(np.float32)


def refined_times(time: Float32, error: Float32, at: NDArray[np.int32]) -> tuple[Float32, Float32]:
    """Times as the pixels around tell them too, each within its own interval between two frames.

    Args:
        time, error: (H, W) float32 from `own_times`.
        at: (H, W) from `Crossings`.

    Returns:
        Positions among the frames and their predicted errors; (H, W) float32 each.
    """
    fitted, spread = fit_planes(time, error)
    return np.clip(fitted, at - 1, at).astype(np.float32), spread


def without_shade(contrast: Float32, highest: Float32, known: Bool, plane: Bool) -> Bool:
    """Which of the known pixels the key light reaches at all.

    In shade of its own a pixel still loses some sky to the stick, at another time than it would
    lose the key light: its contrast is a small part of its brightness. How large a part it is in
    the light is seen on the reference plane.

    Args:
        contrast, highest: (H, W), I_max - I_min and I_max.
        known, plane: (H, W), where there is a time; the reference plane region.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        part = contrast / highest
    usual = part[plane & known]
    if not usual.size:
        return known
    with np.errstate(invalid="ignore"):
        return np.asarray(known & ~(part < _SHADE * np.median(usual)))


def _least_caught(part: Float32) -> float:
    """Below which part of the contrast a value may well be an error and no edge on its way.

    A flank passes all values about equally fast; where far more pixels have a value than that, most
    of them were lit or dark.
    """
    counts, edges = np.histogram(part, bins=_BINS, range=(0.0, 0.5))
    certain = edges[:-1] >= _CERTAIN
    often = counts > _TOO_OFTEN * max(float(np.median(counts[certain])), 1.0)
    often[certain] = False
    last = int(np.flatnonzero(often)[-1]) + 1 if often.any() else 0
    return max(float(edges[last]), _LEAST_CAUGHT)


def _sigma(gray: Float32, noise: NoiseModel) -> Float32:
    """Standard deviation of the luminance ``gray``, (H, W)."""
    colours = np.repeat(np.nan_to_num(gray)[..., None], 3, axis=-1)
    return np.asarray(np.sqrt(((noise.sigma(colours) * LUMA) ** 2).sum(axis=-1)), np.float32)


def _largest(count: float) -> float:
    """The largest of so many standard normal samples, in the mean (asymptotically)."""
    reach = np.sqrt(2 * np.log(max(count, 3)))
    return float(reach - (np.log(np.log(max(count, 3))) + np.log(4 * np.pi)) / (2 * reach))


def _local_mean(values: Float32, known: NDArray[np.bool_]) -> Float32:
    """Mean over the known pixels around each."""
    size = (2 * _LOCAL + 1, 2 * _LOCAL + 1)
    values = np.where(known, values, 0).astype(np.float32)
    total = cv2.boxFilter(values, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    count = cv2.boxFilter(
        known.astype(np.float32), -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(total / np.maximum(count, 1), np.float32)
