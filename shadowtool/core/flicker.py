"""Lamps that flicker while a sensor is read row by row: bands of light and dark across a frame."""

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import channel_sum
from shadowtool.core.medians import known_median

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Logarithms of ratios further from 0 are shadow.
_WIDEST = 0.2
# A frame is cut into so many strips, each of them at least so many pixels wide.
_STRIPS, _NARROWEST = 6, 4
# A row of a strip is known if half of it is, a row if so many strips are, and a frame if this part
# of its rows is.
_LEAST_STRIPS, _LEAST_ROWS = 3, 0.7
# Bands are two waves, one twice as fast, of which the slower goes through the frame so many times;
# found in steps; and no faster than one in so many rows.
_SLOWEST, _FASTEST, _STEP, _ROWS_A_WAVE = 0.8, 20.0, 0.1, 6
# Their logarithm is at least so large, they explain so much of how rows differ, strips agree in how
# strong they are to so much, and rows are as often above as below the middle, but for this part of
# their range: of a shadow's edge most are above.
_LEAST, _EXPLAINED, _ALIKE, _LOPSIDED = 0.01, 0.8, 0.25, 0.35
# Holds back waves that rows hardly tell apart.
_RIDGE = 1e-6


def band_gains(image: Float32, reference: Float32, level: float, rows: Float64) -> Float64 | None:
    """By how much some rows of a frame are brighter than a frame altogether.

    All strips of a frame have the same bands; shadows and figures have edges.

    Args:
        image, reference: (h, w, 3), linear light, the same pixels; not finite is unknown.
        level: how much brighter than the reference the frame is altogether.
        rows: (N,), places of rows, counted in those of the image.

    Returns:
        (N,), or None for a frame without bands.
    """
    strips = _of_strips(image, reference, level)
    if strips is None:
        return None
    known = np.isfinite(strips).sum(axis=1) >= _LEAST_STRIPS
    places = np.flatnonzero(known)
    if len(places) < max(_LEAST_ROWS * len(strips), 1):
        return None
    usual = known_median(strips[known])
    # By a sort, several times faster than numpy's quantiles.
    low, middle, high = np.sort(usual)[[round(part * (len(usual) - 1)) for part in (0.1, 0.5, 0.9)]]
    off_middle = abs(middle - (low + high) / 2)
    if high - low < 2 * _LEAST or off_middle > _LOPSIDED * (high - low):
        return None
    cycles = np.arange(_SLOWEST, min(_FASTEST, len(strips) / _ROWS_A_WAVE), _STEP) / len(strips)
    if not cycles.size:
        return None
    terms = _waves(cycles, places.astype(np.float64))
    normal = np.einsum("kni,knj->kij", terms, terms) + _RIDGE * len(places) * np.eye(terms.shape[2])
    right = np.einsum("kni,n->ki", terms, usual)
    weights = np.linalg.solve(normal, right[..., np.newaxis])
    left = ((usual - (terms @ weights)[..., 0]) ** 2).sum(axis=1)
    best = int(np.argmin(left))
    bands = (terms[best] @ weights[best])[:, 0]
    away = bands - bands.mean()
    explained = 1 - left[best] / ((usual - usual.mean()) ** 2).sum()
    if explained < _EXPLAINED or np.sqrt(2) * bands.std() < _LEAST:
        return None
    # How strong they are in each strip.
    seen = np.isfinite(strips[known])
    values = np.where(seen, strips[known] - bands.mean(), 0)
    strength = away @ values / np.maximum(away**2 @ seen, 1e-12)
    told = seen.sum(axis=0) > len(places) / 2
    if np.count_nonzero(told) < _LEAST_STRIPS or np.median(np.abs(strength[told] - 1)) > _ALIKE:
        return None
    wanted = (_waves(cycles[best : best + 1], rows)[0] @ weights[best])[:, 0]
    # Of rows that are not known no more is said than of those that are.
    return np.asarray(np.exp(np.clip(wanted, bands.min(), bands.max())))


def _of_strips(image: Float32, reference: Float32, level: float) -> Float64 | None:
    """Logarithms of the ratios of rows of upright strips, (h, S), NaN unknown; None if the picture
    is too narrow."""
    now, then = channel_sum(image) / np.float32(level), channel_sum(reference)
    width = now.shape[1] // _STRIPS
    if width < _NARROWEST:
        return None
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ratio = np.log(now / then)
        usable = (then > 1e-2) & (np.abs(ratio) < _WIDEST)
    ratio = np.where(usable, ratio, np.float32(np.nan))[:, : _STRIPS * width]
    ratio = ratio.reshape(-1, _STRIPS, width)
    enough = 2 * np.count_nonzero(np.isfinite(ratio), axis=2) >= width
    return np.where(enough, known_median(ratio), np.nan).astype(np.float64)


def _waves(cycles: Float64, rows: Float64) -> Float64:
    """1 and two waves at rows (N,), for each of (K,) cycles a row, (K, N, 5)."""
    angle = 2 * np.pi * cycles[:, np.newaxis] * rows
    parts = [np.ones_like(angle), np.cos(angle), np.sin(angle), np.cos(2 * angle)]
    return np.stack([*parts, np.sin(2 * angle)], axis=-1)
