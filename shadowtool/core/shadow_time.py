"""When the leading edge of a swept shadow reaches each pixel (section 4, temporal analysis).

An edge sharper than its own step falls between two frames; where, only those pixels tell that a
frame caught half-way. How long the edge takes to pass a pixel is told by how many were caught.
"""

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.half_floats import to_float
from shadowtool.core.noise import NoiseModel, extreme_range
from shadowtool.core.plane_fits import Windows, fit_planes

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
# Of what was brighter than this part of the lit value nothing is kept while a pass is read; so the
# crossing of pixels that lose less than twice as much in all may not be found.
_NEARLY_LIT = np.float32(0.96)
LEAST_CONTRAST = 2 * (1 - float(_NEARLY_LIT))
# How many frames are kept meanwhile.
_KEPT_BYTES, _LEAST_KEPT, _MOST_KEPT = 2**28, 6, 24
# Half the widths of the windows in which times are taken for linear, pixels.
_RADII = (2, 5)
_WINDOWS = Windows(_RADII)
# Less than this part of the usual loss of light is that of a pixel in shade.
SHADE = 0.3


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


class Crossings(NamedTuple):
    """Between which two frames each pixel's luminance first fell below (I_min + I_max) / 2.

    Attributes:
        at: (H, W) int32, position of the later frame among those looked at, ≥ 1; 0 unknown.
        before, after: (H, W) float32, luminance in the frame before and in that one.
        lowest, highest: (H, W) float32, I_min and I_max of the pass.
        lost: (H, W) bool, unknown only because the frame that would tell was no longer kept.
        frames: how many were looked at.
    """

    at: NDArray[np.int32]
    before: Float32
    after: Float32
    lowest: Float32
    highest: Float32
    lost: Bool
    frames: int


class CrossingFinder:
    """Finds each pixel's first crossing of the half-way threshold in one reading of the pass.

    The threshold is known only at the end. But as long as nothing was darker than it is so far, the
    crossing lies ahead, and a frame that is darker than it, is it. Only while an edge passes, and
    the threshold sinks with it, the crossing moves on to a frame after the first: that one is
    looked up among the last few, which are kept.

    What follows the leading edge makes no difference. A pixel that is below the threshold from the
    start has no crossing that was seen: unknown. Of pixels that never lose `LEAST_CONTRAST` of
    their light, crossings may be wrong.
    """

    def __init__(self, kept: int | None = None) -> None:
        """Args: how many frames are kept; an edge may take about twice as many to pass. None for
        as many as are no burden to memory."""
        self._kept = kept
        self._recent: deque[Float32] = deque()
        self._frames = 0

    def add(self, gray: Float32) -> None:
        """Take in one frame's luminance, (H, W), in the order of the pass.

        Where it isn't finite the last value that was stands.
        """
        gray = np.ascontiguousarray(gray, np.float32)
        finite = np.isfinite(gray)
        if not finite.all():
            last = self._recent[-1] if self._recent else np.full_like(gray, np.nan)
            gray = np.where(finite, gray, last)
        if self._frames:
            self._look(gray)
        else:
            self._shape = gray.shape
            if self._kept is None:
                self._kept = min(max(_KEPT_BYTES // gray.nbytes, _LEAST_KEPT), _MOST_KEPT)
            self._recent = deque(maxlen=self._kept + 2)
            self._low, self._high = gray.ravel().copy(), gray.ravel().copy()
            # The lowest a frame ago; and the lowest before the frame before the crossing.
            self._lower, self._floor = (np.full(gray.size, np.nan, np.float32) for _ in range(2))
            # As if all had crossed in the first frame, before which nothing is known.
            self._after = self._low.copy()
            self._before, self._earlier, self._next = (self._lower.copy() for _ in range(3))
            self._moved = np.arange(gray.size)
            self._darker = np.arange(gray.size)
            self._unseen = bool(np.isnan(self._low).any())
            self._at = np.zeros(gray.size, np.int32)
            self._lost = np.zeros(gray.size, bool)
        self._recent.append(gray)
        self._frames += 1

    def found(self) -> Crossings:
        """What was found.

        Raises:
            ValueError: no frame was looked at.
        """
        if not self._frames:
            raise ValueError("no frame was looked at")
        threshold = (self._low + self._high) / 2
        at, after, before = self._at.copy(), self._after.copy(), self._before.copy()
        with np.errstate(invalid="ignore"):
            # Light that grew after the crossing has raised the threshold: it lies earlier.
            lost = self._lost | (self._floor < threshold)
            late = (before < threshold) & ~lost
        at[late] -= 1
        after[late], before[late] = before[late], self._earlier[late]
        at[lost | ~np.isfinite(before)] = 0

        def plane(values: NDArray[Any]) -> NDArray[Any]:
            return values.reshape(self._shape)

        ends, extremes = (plane(before), plane(after)), (plane(self._low), plane(self._high))
        return Crossings(plane(at), *ends, *extremes, plane(lost), self._frames)

    def _look(self, gray: Float32) -> None:
        """Only where a frame is the darkest so far can the crossing move."""
        now = gray.ravel()
        low, high, after = self._low, self._high, self._after
        self._next[self._moved] = now[self._moved]
        np.fmax(high, now, out=high)
        darker = np.flatnonzero(now < low)
        values, lit = now[darker], high[darker]
        # What is nearly as bright as it ever was crosses no threshold that matters in the end; and
        # the crossing found last stands as long as the threshold is above it.
        threshold = (lit + values) / np.float32(2)
        crossed = (values < _NEARLY_LIT * lit) & ~(after[darker] < threshold)
        some, threshold = darker[crossed], threshold[crossed]
        fresh = low[some] >= np.minimum(threshold, _NEARLY_LIT * lit[crossed])
        begun = some[fresh]
        self._take(begun, 0, now)
        self._lost[begun] = False
        self._floor[begun] = self._lower[begun]
        self._lower[self._darker] = low[self._darker]
        low[darker] = values
        self._darker = darker
        if self._unseen:
            first = np.flatnonzero(np.isnan(low) & ~np.isnan(now))
            low[first] = now[first]
            self._unseen = bool(np.isnan(low).any())
            self._darker = np.concatenate([darker, first])
        old, threshold = some[~fresh], threshold[~fresh]
        onward = self._next[old] < threshold
        self._shift(old[onward])
        self._moved = np.concatenate([begun, self._search(old[~onward], threshold[~onward], now)])

    def _take(self, pixels: NDArray[np.intp], ago: int, now: Float32) -> None:
        """Put the crossing of these pixels into the frame so many ago."""

        def values(ago: int) -> Float32:
            if ago == 0:
                return now[pixels]
            if ago > len(self._recent):
                return np.full(len(pixels), np.nan, np.float32)
            return self._recent[-ago].ravel()[pixels]

        self._at[pixels] = self._frames - ago
        self._after[pixels], self._before[pixels] = values(ago), values(ago + 1)
        self._earlier[pixels] = values(ago + 2)
        self._next[pixels] = values(ago - 1) if ago else np.nan

    def _shift(self, pixels: NDArray[np.intp]) -> None:
        """Move the crossing of these pixels on by a frame."""
        self._at[pixels] += 1
        self._floor[pixels] = np.fmin(self._floor[pixels], self._before[pixels])
        self._earlier[pixels], self._before[pixels] = self._before[pixels], self._after[pixels]
        self._after[pixels], self._next[pixels] = self._next[pixels], np.nan

    def _search(
        self, pixels: NDArray[np.intp], threshold: Float32, now: Float32
    ) -> NDArray[np.intp]:
        """Move the crossing to the first frame below the threshold, among those still kept.

        Returns:
            The pixels whose crossing is in the frame under way.
        """
        kept = min(self._kept or 0, len(self._recent))
        old = self._at[pixels]
        # What passed between the old crossing and the frames that are kept can't be told.
        self._lost[pixels] |= self._frames - old > kept + 1
        floor = np.fmin(self._floor[pixels], self._before[pixels])
        above = self._after[pixels]
        for ago in range(kept, -1, -1):
            values = (now if ago == 0 else self._recent[-ago].ravel())[pixels]
            later = self._frames - ago > old
            below = later & (values < threshold)
            self._take(pixels[below], ago, now)
            self._floor[pixels[below]] = floor[below]
            if ago == 0:
                return pixels[below]
            floor = np.where(later, np.fmin(floor, above), floor)
            above = np.where(later, values, above)
            pixels, threshold, old = pixels[~below], threshold[~below], old[~below]
            floor, above = floor[~below], above[~below]
        return pixels[:0]


def significant(crossings: Crossings, noise: NoiseModel) -> Crossings:
    """Crossings without those of pixels whose minimum and maximum may be nothing but noise."""
    contrast = crossings.highest - crossings.lowest
    least = _sigma(crossings.highest, noise) * max(float(extreme_range(crossings.frames)), 8.0)
    with np.errstate(invalid="ignore"):
        seen = contrast > np.maximum(least, LEAST_CONTRAST * crossings.highest)
    return crossings._replace(
        at=np.where(seen, crossings.at, 0).astype(np.int32), lost=crossings.lost & seen
    )


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


def time_windows(time: Float32, plane: Bool) -> Windows:
    """Windows for `refined_times`: they grow with the edge's step, which is seen in the mean slope
    of the times on the reference plane.

    Args:
        time: (H, W), positions among the frames; NaN unknown.
        plane: (H, W), the reference plane region.
    """
    slopes = []
    for axis in (0, 1):
        slope = np.diff(time, axis=axis)
        both = plane[1:] & plane[:-1] if axis == 0 else plane[:, 1:] & plane[:, :-1]
        # Larger steps are from one thing to another.
        with np.errstate(invalid="ignore"):
            slope = slope[both & (np.abs(slope) < 2)]
        slopes.append(float(slope.mean()) if slope.size else 0.0)
    steepest = float(np.hypot(slopes[0], slopes[1]))
    return Windows.for_step(1 / steepest if steepest > 0 else 0.0, _RADII)


def refined_times(
    time: Float32, error: Float32, at: NDArray[np.int32], windows: Windows = _WINDOWS
) -> tuple[Float32, Float32]:
    """Times as the pixels around tell them too, each within its own interval between two frames.

    Args:
        time, error: (H, W) float32 from `own_times`.
        at: (H, W) from `Crossings`.
        windows: in which times are taken for linear.

    Returns:
        Positions among the frames and their predicted errors; (H, W) float32 each.
    """
    fitted, spread = fit_planes(time, error, windows)
    return np.clip(fitted, at - 1, at).astype(np.float32), spread


def usual_loss(contrast: Float32, highest: Float32, known: Bool, plane: Bool) -> Float32:
    """What part of its light each pixel loses to the stick, against what is usual on the plane.

    In shade of its own a pixel still loses some sky, at another time than it would lose the key
    light: below `SHADE` it counts as shade. Where a stick blocks the key light only in part, the
    middle of what is lost comes at another time than the edge: such times are to be trusted less.

    Args:
        contrast, highest: (H, W), I_max - I_min and I_max.
        known, plane: (H, W), where there is a time; the reference plane region.

    Returns:
        (H, W) float32 in [0, 1]; all 1 if nothing is known on the plane.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.nan_to_num(contrast / highest, posinf=0.0, neginf=0.0)
    usual = part[plane & known]
    if not usual.size:
        return np.ones(contrast.shape, np.float32)
    return np.asarray(np.clip(part / max(float(np.median(usual)), 1e-6), 0, 1), np.float32)


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
    weights = LUMA.astype(np.float64) ** 2
    slope, floor = float(weights @ noise.slope), float(weights @ noise.floor)
    variance = np.maximum(np.nan_to_num(gray), 0) * np.float32(slope) + np.float32(floor)
    return np.asarray(np.sqrt(variance), np.float32)


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
