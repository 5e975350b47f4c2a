"""Shadow plates where the shadow never fell in full.

On a plane under one key light S/L is nearly the same everywhere. It is measured where the shadow
fell in full, and serves, in proportion to the lack of evidence, where it didn't: at the rim of the
region that a shadow swept, where only its penumbra passed.

A partial shadow and a surface with another S/L (steeper, glossier) are both brighter than expected.
They are told apart by their shape: at a rim S/L climbs from full shadow to none within the width of
a penumbra, on a surface it is level.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import blocks, channel_sum
from shadowtool.core.filling import fill_membrane
from shadowtool.core.lengths import length
from shadowtool.core.noise import NoiseModel
from shadowtool.core.regions import grown, large_parts, opened

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# Frames that a pixel's shadow value must rest on to tell what the ratio is.
_FIRM = 3
# The ratio is averaged on a grid of about so many cells along the longer side, of so many pixels
# at least.
_CELLS, _LEAST_CELL = 120, 4
# Log ratios further than this from the common one belong to another surface or to a penumbra.
_COMMON = 0.45
# The slope of log(S/L), per pixel, at which a partial shadow is as likely as a surface.
_SLOPE = 0.05
# A shadow that reached more than this part of a picture was cast to reach all of it.
_MOST, _NEARLY_ALL = 0.6, 0.85
# Within this many times the materials' spread a measured ratio is the plane's. A surface with
# another is as large as a square of so many coarse cells.
_ALIKE, _SURFACE = 2.5, 4
# Of ground in light colours differ by less than this, the range of a log over the channels.
_COLOUR = 0.7
# Most of the ground is as bright as half of it is, to this logarithm.
_GROUND = 0.5
# So many pixels at a time stay in the processor's cache.
_BLOCK = 1 << 15
# What is narrower than so many pixels is noise that looks like a shadow.
_NOISE = 5
# What is dimmed by less than this part of what shadows have in common, a logarithm, or by less than
# the second where they are deep, is none: whoever stands near takes some of the sky.
_HARDLY, _HARDLY_DEEP = 1 / 3, 0.4
# How far S/L of one plane's materials lies from their common one, as a part; at least.
_LEAST_SPREAD = 0.03


def _surfaces(usual: Float32, frames: NDArray[np.uint32], dimmed: Bool) -> Iterator[Bool]:
    """Where a shadow may have fallen in full, (H, W), what tells it best first.

    Args:
        usual: of `_usual`.
        dimmed: (H, W), where anything that is a shadow fell.
    """
    # What climbs is a penumbra, however long it stood there.
    level = dimmed & (_slope(usual) < _SLOPE)
    # In a take of few frames no shadow stays for several.
    for least in (_FIRM, 1):
        yield opened(level & (frames >= least), _NOISE)
    # A thin one is level nowhere.
    often = dimmed & (frames >= _FIRM)
    yield opened(often & ~opened(often, 2 * _cell(usual.shape) + 1), 3)


def _usual(gray: Float32) -> Float32:
    """The log ratio that most of the pixels around have; unknown ones count as 0, no shadow."""
    return np.asarray(cv2.medianBlur(np.nan_to_num(gray), 5), np.float32)


def _ratio_field(
    lit: Float32, shadow: Float32, gray: Float32, level: Bool, plane: Bool | None
) -> tuple[Float32, float] | None:
    where = _looked_at(level if plane is None else level & plane)
    if where.size < 50:
        return None
    own = gray.ravel().take(where)
    member = np.abs(own - _mode(own)) < _COMMON
    where, own = where[member], own[member]
    ratio = _log_ratio(*(plate.reshape(-1, 3).take(where, axis=0) for plate in (lit, shadow)))

    def away(field: Float32) -> Float32:
        common = _stretched(field.mean(axis=-1), gray.shape)
        return np.asarray(np.abs(own - common.ravel().take(where)), np.float32)

    member = away(_smooth(ratio, where, gray.shape)) < _COMMON / 2
    if member.sum() < 50:
        return None
    field = _smooth(ratio[member], where[member], gray.shape)
    spread = max(float(np.median(away(field)[member])) / 0.6745, _LEAST_SPREAD)
    return _stretched(np.exp(field), gray.shape), spread


@dataclass(frozen=True)
class Completed:
    """A shadow plate without gaps.

    Attributes:
        shadow: (H, W, 3) float32; equal to the lit plate where there is nothing to go by.
        own: (H, W) float32, how much of each pixel is its own evidence, 0 to 1.
        partial: whether the take was read as that of a plane which a shadow covered in part.
    """

    shadow: Float32
    own: Float32
    partial: bool


def complete_shadow(
    lit: Float32,
    shadow: Float32,
    frames: NDArray[np.uint32],
    noise: NoiseModel,
    plane: Bool | None = None,
    card: bool | None = None,
    ratio: Float32 | None = None,
) -> Completed:
    """The shadow plate with S/L of the plane where the shadow itself says too little.

    A take in which the shadow reached most of the picture is that of a waved card: what it darkened
    for several frames is as dark as it gets, and what it never darkened is in shade of its own, as
    far as it is no brighter than that makes ground around; what is as bright as ground in light the
    card missed, and would be as dark as the rest.
    Else it is that of a plane which a shadow crossed: what is brighter than the plane's shadow was
    shaded in part, and what was never darkened would be as dark as the rest.

    Args:
        lit, shadow: (H, W, 3) float32, shadow NaN where the pixel was never darkened.
        frames: (H, W), how many frames the shadow rests on.
        noise: the noise of one frame.
        plane: (H, W) the region of the plane, if it is known: the second reading holds there, the
            first elsewhere, but that what was never darkened is left as it is.
        card: which of the two holds for all of it otherwise; None if nobody knows.
        ratio: (3,), what S/L the take's shadows have in common, if that is known of a scene that a
            shadow crossed. What is dimmed by much less is no shadow, and where none fell in full it
            is the plane's.
    """
    seen, dark = np.isfinite(channel_sum(lit)), np.isfinite(channel_sum(shadow))
    if plane is None:
        pixels = max(int(seen.sum()), 1)
        firm, some = (((frames >= least) & seen).sum() / pixels for least in (_FIRM, 1))
        # A card that goes by quickly shades no pixel often, but all.
        partial = bool(firm < _MOST and some < _NEARLY_ALL) if card is None else not card
        region = np.full(dark.shape, partial)
    else:
        partial, region = True, plane
    gray = _log_ratio(channel_sum(lit), channel_sum(shadow))
    usual = _usual(gray)
    with np.errstate(invalid="ignore"):
        alone = np.abs(gray - usual) > _COMMON
    dimmed = gray < -_least_dimmed(ratio)
    for surface in _surfaces(usual, frames, dimmed):
        if (found := _ratio_field(lit, shadow, gray, surface, plane)) is not None:
            break
    result = np.asarray(cv2.copyTo(shadow, dark.view(np.uint8), lit.copy()), np.float32)
    if found is None and partial and ratio is not None:
        found = np.ones_like(lit) * ratio, _LEAST_SPREAD
    if found is None:
        return Completed(result, np.asarray(dark, np.float32), plane is not None)
    expected, spread = found
    missed = np.zeros_like(dark)
    if not partial:
        missed = _missed_by_the_card(lit, seen, dark, expected)
    with np.errstate(divide="ignore"):
        common = np.log(channel_sum(expected) / 3)
    above = usual - common > spread
    gray -= common
    with np.errstate(invalid="ignore"):
        darker, alike = gray <= -_ALIKE * spread, np.abs(gray) < _ALIKE * spread
        brighter = gray > _ALIKE * spread
    expected *= lit
    own = dark.astype(np.float32)
    few = region & dark & darker
    own[few] = np.minimum(frames[few] / np.float32(_FIRM), 1)
    # On the plane only what is level over some area can be a surface of its own: in a take of few
    # frames a partial shadow is level here and there.
    own[region & ~(darker | alike | (_large(surface & above) & ~alone))] = 0
    own[region & ~dimmed] = 0
    # Few frames say less of the shadow than the plane's ratio does, where the two may be the same.
    both = np.flatnonzero(alike & region & (own > 0))
    for part in blocks(both.size, _BLOCK):
        where = both[part]
        measured, ratios = (p.reshape(-1, 3).take(where, axis=0) for p in (result, expected))
        precision = frames.reshape(-1, 1).take(where, axis=0) / noise.variance(measured)
        prior = 1 / np.maximum(spread * ratios, 1e-6) ** 2
        mean = (precision * measured + prior * ratios) / (precision + prior)
        result.reshape(-1, 3)[where] = mean
    weight = own[few][:, None]
    result[few] = weight * result[few] + (1 - weight) * expected[few]
    if missed.any():
        # At the rim of what the card missed only its penumbra fell.
        beside = grown(missed, 2 * _cell(dark.shape))
        own[beside & brighter & dark & ~surface] = 0
    nothing = (own == 0) & (dark | region | missed)
    cv2.copyTo(expected, nothing.view(np.uint8), result)
    return Completed(result, own, partial)


def _least_dimmed(ratio: Float32 | None) -> float:
    """By how much light is dimmed at least where a shadow falls, a logarithm."""
    if ratio is None:
        return -np.inf
    deep = -float(np.log(np.maximum(ratio, np.float32(1e-5))).mean())
    return min(_HARDLY * deep, _HARDLY_DEEP)


def _missed_by_the_card(lit: Float32, looked_at: Bool, dark: Bool, ratio: Float32) -> Bool:
    """Where nothing got dark though light falls there, (H, W): what is more like lit ground around
    than like that in shade, and not of quite another colour, as the sky is."""
    never = looked_at & ~dark
    where = _looked_at(looked_at & dark)
    if not never.any() or where.size < 50:
        return np.zeros_like(never)
    light = np.log(np.maximum(lit.reshape(-1, 3).take(where, axis=0), np.float32(1e-5)))
    brightness = light.mean(axis=1)
    ground = np.abs(brightness - np.median(brightness)) < _GROUND
    if ground.mean() > 0.5:
        # Beside something black, shade would pass for ground in light.
        where, light = where[ground], light[ground]
    # Areas are told by some of their pixels.
    every = (slice(None, None, _step(dark.shape)),) * 2
    around = _stretched(_smooth(light, where, dark.shape), dark.shape)[every].copy()
    wanted = never[every]
    own = np.log(np.maximum(lit[every], np.float32(1e-5)))
    own[~wanted] = 0
    # Past the ground's texture.
    size = (2 * (_cell(dark.shape) // _step(dark.shape)) + 1,) * 2
    weight = np.maximum(cv2.blur(wanted.astype(np.float32), size), np.float32(1e-6))
    own = cv2.blur(own, size) / weight[..., np.newaxis]
    halfway = np.log(np.maximum(ratio[every], np.float32(1e-5))).mean(axis=-1) / 2
    missed = np.zeros_like(wanted)
    # Next to something that stands on the ground that is what is around, but not all ground.
    for usual in (around, np.median(light, axis=0)):
        off = own - usual
        missed |= (off.mean(axis=-1) > halfway) & (np.ptp(off, axis=-1) < _COLOUR)
    whole = cv2.resize(missed.view(np.uint8), dark.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray((whole > 0) & never)


def _large(mask: Bool) -> Bool:
    """The connected parts of a mask that are as large as several coarse cells."""
    return large_parts(mask, (_SURFACE * _cell(mask.shape)) ** 2, connectivity=4)


def _log_ratio(lit: Float32, shadow: Float32) -> Float32:
    """log(S/L), NaN where either is unknown."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.maximum(shadow, np.float32(1e-5)) / np.maximum(lit, np.float32(1e-5))
        return np.asarray(np.log(ratio), np.float32)


def _slope(gray: Float32) -> Float32:
    """Length of the gradient of a log ratio without noise, per pixel."""
    smooth = cv2.GaussianBlur(gray, (0, 0), 1.5)
    x = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    y = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    return length(x, y, out=x)


def _mode(values: Float32) -> float:
    """The most frequent value."""
    counts, edges = np.histogram(values, bins=120, range=(-6.0, 0.5))
    smooth = np.convolve(counts, [1, 2, 3, 2, 1], mode="same")
    peak = int(np.argmax(smooth))
    return float((edges[peak] + edges[peak + 1]) / 2)


def _cell(shape: tuple[int, ...]) -> int:
    """The side of a coarse cell, pixels."""
    return max(_LEAST_CELL, round(max(shape) / _CELLS))


def _step(shape: tuple[int, ...]) -> int:
    """Every how many rows and columns of a coarse cell are looked at; some 64 points do."""
    return max(1, _cell(shape) // 8)


def _looked_at(mask: Bool) -> NDArray[np.intp]:
    """Places of a picture that are in the mask, as many as are looked at."""
    step = _step(mask.shape)
    rows, columns = np.nonzero(mask[::step, ::step])
    return np.asarray(rows * (step * mask.shape[1]) + columns * step, np.intp)


def _smooth(ratio: Float32, where: NDArray[np.intp], shape: tuple[int, ...]) -> Float32:
    """Log ratios (N, 3) at these places of a picture, averaged over an eighth of it and continued
    everywhere; (h, w, 3), by coarse cells."""
    cell = _cell(shape)
    height, width = (-(-size // cell) for size in shape)
    rows, columns = np.divmod(where, shape[1])
    place = rows // cell * width + columns // cell
    part = (_step(shape) / cell) ** 2
    planes = [
        np.bincount(place, values, height * width).reshape(height, width).astype(np.float32)
        for values in (np.full(len(where), part), *(ratio.T * np.float32(part)))
    ]
    sigma = max(height, width) / 16
    blurred, *sums = (
        np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma), np.float32) for plane in planes
    )
    mean = np.stack(sums, axis=-1) / np.maximum(blurred, np.float32(1e-9))[..., None]
    firm = blurred > min(0.02, float(blurred.max()))
    firm |= blurred >= blurred.max()
    return fill_membrane(np.asarray(mean, np.float32), firm.astype(np.float32))


def _stretched(coarse: Float32, shape: tuple[int, ...]) -> Float32:
    """A coarse field, (h, w) or (h, w, 3), at the picture's size."""
    cell = _cell(shape)
    size = (coarse.shape[1] * cell, coarse.shape[0] * cell)
    wide = cv2.resize(coarse, size, interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(wide[: shape[0], : shape[1]], np.float32)
