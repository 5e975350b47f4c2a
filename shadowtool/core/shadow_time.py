"""When the leading edge of a swept shadow reaches each pixel (section 4, temporal analysis)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.noise import NoiseModel, extreme_range

Float32 = NDArray[np.float32]

# Rec.709 luminance.
# Edges of which less than this part passes from frame to frame are soft.
_SOFT = 0.4
# Diffusion of times: steps, their size, and the difference in frames that counts as an edge.
_REFINEMENTS, _RATE, _STEP = 24, 0.24, 0.5
# Less than this part of the usual contrast is that of a pixel in shade.
_SHADE = 0.4

LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)


@dataclass(frozen=True)
class ShadowTimes:
    """The result of one pass.

    Attributes:
        time: (H, W) float32, frame numbers with fractions; NaN unknown.
        contrast: (H, W) float32 ≥ 0, I_max - I_min of the pass, linear light.
    """

    time: Float32
    contrast: Float32


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
    gray = np.repeat(highest[..., None], 3, axis=-1)
    sigma = np.sqrt(((noise.sigma(gray) * LUMA) ** 2).sum(axis=-1))
    return np.asarray(sigma * np.maximum(extreme_range(frames), 8), np.float32)


def without_shade(times: ShadowTimes, highest: Float32, plane: NDArray[np.bool_]) -> ShadowTimes:
    """Times without the pixels that the key light never reaches.

    In shade of its own a pixel still loses some sky to the stick, at another time than it would
    lose the key light: its contrast is a small part of its brightness. How large a part it is in
    the light is seen on the reference plane.

    Args:
        highest: (H, W), I_max.
        plane: (H, W), the reference plane region.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        part = times.contrast / highest
    usual = part[plane & np.isfinite(times.time)]
    if not usual.size:
        return times
    shade = part < _SHADE * np.median(usual)
    return ShadowTimes(np.where(shade, np.float32(np.nan), times.time), times.contrast)


def refine_times(time: Float32, frames: NDArray[np.float64], sharpness: Float32) -> Float32:
    """Times within the frame interval in which each pixel was crossed, from its neighbours'.

    An edge sharper than its own step falls between two frames, and interpolation then says
    half-way. That the crossing lies between the two is certain; where is told by the pixels around,
    which the edge reached just before and after. Times are diffused within their intervals, and
    not over steps as large as those between surfaces.

    Args:
        time: (H, W) float32, frame numbers; NaN unknown, which takes no part.
        frames: (N,) ascending numbers of the frames that were looked at.
        sharpness: (H, W), the part of the contrast that was lost from one frame to the next. Of an
            edge that takes several frames to pass, interpolation is right already.

    Returns:
        (H, W) float32, each time within its interval, NaN where it was.
    """
    known = np.isfinite(time)
    positions = np.arange(len(frames), dtype=np.float64)
    clock = np.interp(np.where(known, time, frames[0]), frames, positions).astype(np.float32)
    last = np.maximum(np.ceil(clock), 1)
    first = last - 1
    freedom = np.clip((sharpness - _SOFT) / (1 - _SOFT), 0, 1).astype(np.float32)
    first, last = np.maximum(first, clock - freedom), np.minimum(last, clock + freedom)
    pairs = (known[1:] & known[:-1], known[:, 1:] & known[:, :-1])
    for _ in range(_REFINEMENTS):
        change = np.zeros_like(clock)
        for axis, both in enumerate(pairs):
            ahead = np.diff(clock, axis=axis)
            flow = np.where(both, np.exp(-((ahead / _STEP) ** 2)) * ahead, 0).astype(np.float32)
            if axis == 0:
                change[:-1] += flow
                change[1:] -= flow
            else:
                change[:, :-1] += flow
                change[:, 1:] -= flow
        clock += np.float32(_RATE) * change
        np.clip(clock, first, last, out=clock)
    refined = np.interp(clock, positions, frames).astype(np.float32)
    return np.where(known, refined, np.float32(np.nan))


class CrossingTimes:
    """Finds the first crossing of the half-way threshold, frame by frame, in constant memory.

    A pixel crosses in the first frame f whose value lies below (I_min + I_max) / 2; the time is
    interpolated linearly from the frame before. What follows the leading edge makes no difference.
    A pixel that is below the threshold from the start has no crossing that was seen: unknown.

    Attributes:
        sharpness: (H, W), the part of the contrast that was lost in that one step.
    """

    def __init__(self, lowest: Float32, highest: Float32, least: Float32) -> None:
        """Args: I_min, I_max and the contrast below which nothing is known, each (H, W)."""
        self._contrast = highest - lowest
        self._threshold = (highest + lowest) / 2
        self._open = self._contrast > least
        self._time = np.full(lowest.shape, np.nan, np.float32)
        self.sharpness = np.zeros(lowest.shape, np.float32)
        self._before: Float32 | None = None
        self._before_frame = 0.0

    def add(self, frame: float, gray: Float32) -> None:
        """Take in one frame's luminance, (H, W), in the order of the pass.

        Where it isn't finite the last value that was stands.
        """
        finite = np.isfinite(gray)
        if not finite.all():
            before = np.full_like(gray, np.nan) if self._before is None else self._before
            gray = np.where(finite, gray, before)
        with np.errstate(invalid="ignore"):
            below = self._open & (gray < self._threshold)
        if self._before is not None and below.any():
            before, now = self._before[below], gray[below]
            with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
                part = (before - self._threshold[below]) / (before - now)
                self.sharpness[below] = np.clip((before - now) / self._contrast[below], 0, 1)
            self._time[below] = self._before_frame + part * (frame - self._before_frame)
        self._open &= ~below
        self._before, self._before_frame = gray, frame

    def times(self) -> ShadowTimes:
        """What was found so far."""
        return ShadowTimes(self._time.copy(), np.nan_to_num(self._contrast, nan=0.0))
