"""How far the camera moved between two frames of a take that should be locked off, and what a frame
would be if it hadn't."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import channel_sum, overlapping_bands
from shadowtool.core.half_floats import not_finite, to_float, to_half

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Place = tuple[float, float]

# Larger frames are measured at this width; the result is in pixels of the full frame.
_WIDTH = 640
_TILES = 4, 3
_LEAST_TILE = 24
# A tile whose correlation is below this shows something else than before.
_LEAST_CORRELATION = 0.5
# Of less contrast than this, as a logarithm, a tile shows nothing: what a codec makes of it moves
# with what passes, and where it is off by parts of a pixel nobody sees it.
_LEAST_DETAIL = 1e-2
# Displacements are looked for in pictures smaller by these, one after the other; in so many steps
# each at most, till one is shorter than this, pixels.
_SMALLER, _STEPS, _ARRIVED = (4, 2, 1), 5, 0.002
# From how many standard deviations on pixels don't count; along what shows one direction only a
# tile is taken not to move.
_OUT, _ONE_WAY = 4.7, 0.01
# The standard error of a median, times the square root of their number, in median deviations.
_MEDIAN_ERROR = 1.48 * 1.25
# Fewer than this part of the tiles may all be what moves in front of the camera.
_FEWEST = 1 / 4
# A camera moves so many of the tiles alike, give or take this, pixels, or this part of it: what
# moves fewer of them moved in front of it.
_CAMERA, _TOGETHER, _PART = 2 / 3, 0.15, 0.5
# Nearer to each other than this, pixels, two places are one.
_SAME = 0.01
# Lobes of the kernel that a moved picture is interpolated by; by what part of it the least and the
# most of the pixels around may be exceeded.
_LOBES, _RINGING = 3, np.float32(0.5)
# So many rows at a time stay in the processor's cache.
_ROWS = 48


def prepare(gray: Float32) -> Float32:
    """Make (H, W) linear luminance ready to be compared: small, and blind to slow shading.

    The logarithm's local contrast looks the same in light and in shadow.
    """
    height, width = gray.shape
    if width > _WIDTH:
        size = (_WIDTH, max(1, round(height * _WIDTH / width)))
        gray = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.float32)
    level = np.log(np.maximum(np.nan_to_num(gray, nan=0.0, posinf=1e4, neginf=0.0), 1e-3))
    smooth = cv2.GaussianBlur(level.astype(np.float32), (0, 0), 1.0)
    detail = smooth - cv2.GaussianBlur(smooth, (0, 0), 6.0)
    # A shadow's edge stands out of the texture; bounding it keeps it from pulling the fit.
    spread = float(np.median(np.abs(detail))) * 4 + 1e-6
    return np.asarray(np.clip(detail, -spread, spread), np.float32)


def shift(reference: Float32, other: Float32, width: int) -> float | None:
    """Length of the displacement from one prepared frame to another, as far as it is certain.

    A camera moves all that is seen alike; of what parts of the picture disagree in, as where the
    grain of wood shows one direction only, three standard errors are taken off.

    Args:
        reference, other: from `prepare`, of one size.
        width: that of the full frame, pixels.

    Returns:
        Pixels of the full frame; None where the picture has too little texture to tell.
    """
    found = _displacement(reference, other)
    if found is None:
        return None
    x, y = np.maximum(np.abs(found.place) - 3 * found.error, 0)
    return float(np.hypot(x, y) * width / reference.shape[1])


class _Displacement(NamedTuple):
    """Where one prepared picture shows what another does, other(p + place) = reference(p), and the
    standard error of that; (x, y) in pixels, (2,) each; and what part of the tiles say so."""

    place: Float64
    error: Float64
    share: float


def _displacement(reference: Float32, other: Float32) -> _Displacement | None:
    """By steps of Lucas and Kanade (1981) from coarse to fine, each the median over a grid of
    tiles, so that what moves in the scene is outvoted; None if nothing tells."""
    place, agreed = np.zeros(2), np.zeros((0, 2))
    for smaller in _SMALLER:
        if smaller > 1 and min(reference.shape) < 2 * _LEAST_TILE * smaller:
            continue
        one, two = (_smaller(picture, smaller) for picture in (reference, other))
        for _ in range(_STEPS):
            x, y = (place / smaller).tolist()
            agreed, others = _steps(one, displaced(two, (x, y)))
            step = np.median(agreed if len(agreed) else others, axis=0)
            # What repeats itself is not to be followed from one period to the next.
            place = place + np.clip(step, -1, 1) * smaller
            if np.abs(step).max() * smaller < _ARRIVED:
                break
        if smaller > 1 and len(agreed) < len(others):
            place = np.zeros(2)
    if len(agreed) < max(_FEWEST * (len(agreed) + len(others)), 1):
        return None
    off = np.abs(agreed - np.median(agreed, axis=0))
    together = max(_TOGETHER, _PART * float(np.abs(place).max()))
    share = float((off.max(axis=1) < together).mean())
    error = _MEDIAN_ERROR * np.median(off, axis=0) / np.sqrt(len(agreed))
    return _Displacement(place, error, share)


def _smaller(picture: Float32, times: int) -> Float32:
    size = (picture.shape[1] // times, picture.shape[0] // times)
    if times == 1:
        return picture
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)


def _steps(reference: Float32, other: Float32) -> tuple[Float64, Float64]:
    """The steps, (N, 2), that explain the difference of two pictures' tiles: of those that show
    the same, and of the others."""
    agreed, others = list[Float64](), list[Float64]()
    for one, two in zip(_tiles(reference), _tiles(other), strict=True):
        size = math.sqrt(float((one**2).sum()) * float((two**2).sum()))
        alike = float((one * two).sum()) >= _LEAST_CORRELATION * size
        alike &= size > one.size * _LEAST_DETAIL**2
        (agreed if alike else others).append(_step(one, two))
    return np.array(agreed).reshape(-1, 2), np.array(others).reshape(-1, 2)


def _step(reference: Float32, other: Float32) -> Float64:
    middle, change = (reference + other) / 2, (reference - other).ravel()
    slopes = [
        np.asarray(cv2.Sobel(middle, cv2.CV_32F, dx, 1 - dx, ksize=1, scale=0.5)).ravel()
        for dx in (1, 0)
    ]
    terms = np.stack(slopes, axis=-1)
    # What is seen in one of them only, as a shadow's edge, is off by more than the rest.
    spread = _OUT * float(np.median(np.abs(change))) / 0.6745 + 1e-9
    weighted = terms * (np.clip(1 - (change / np.float32(spread)) ** 2, 0, 1) ** 2)[:, np.newaxis]
    normal = (weighted.T @ terms).astype(np.float64)
    normal += (_ONE_WAY * normal.trace() + 1e-12) * np.eye(2)
    return np.asarray(np.linalg.solve(normal, (weighted.T @ change).astype(np.float64)), np.float64)


def _tiles(image: Float32) -> list[Float32]:
    height, width = image.shape
    columns = max(1, min(_TILES[0], width // _LEAST_TILE))
    rows = max(1, min(_TILES[1], height // _LEAST_TILE))
    return [
        np.ascontiguousarray(tile)
        for strip in np.array_split(image, rows, axis=0)
        for tile in np.array_split(strip, columns, axis=1)
    ]


@dataclass(frozen=True)
class Vantage:
    """The place that a take's frames are to be seen from.

    Attributes:
        picture: what is seen from there or nearby, from `prepare`.
        width: of the full frame, pixels.
        place: the vantage's own, off the picture's, (x, y) in pixels.
    """

    picture: Float32
    width: int
    place: Place = (0.0, 0.0)

    @classmethod
    def of(cls, image: NDArray[np.floating]) -> "Vantage":
        """That of an image (H, W) or (H, W, 3), linear light; not finite unknown."""
        return cls(prepared(image), image.shape[1])

    def off(self, image: NDArray[np.floating]) -> Place:
        """Where an image, as of `of`, shows what is seen from here: displaced by (x, y), pixels;
        (0, 0) if it is next to that, or shows too little to tell, or not all of it moved alike."""
        return self.off_prepared(prepared(image))

    def off_prepared(self, picture: Float32) -> Place:
        """The same of an image that was `prepared`."""
        found = _displacement(self.picture, picture)
        if found is None or found.share < _CAMERA:
            return 0.0, 0.0
        # Sums come out otherwise in their last digits on other processors.
        place = found.place * self.width / self.picture.shape[1] - self.place
        x, y = (round(float(v), 3) for v in place)
        return (x, y) if max(abs(x), abs(y)) > _SAME else (0.0, 0.0)

    def amid(self, places: list[Place]) -> "Vantage":
        """The one in the middle of others, that lie so far off this one."""
        if not places:
            return self
        x, y = (float(v) for v in np.median(places, axis=0) + self.place)
        return Vantage(self.picture, self.width, (x, y))


def prepared(image: NDArray[np.floating]) -> Float32:
    """`prepare` of an image (H, W) or (H, W, 3), linear light."""
    values = to_float(image)
    return prepare(values if values.ndim == 2 else channel_sum(values) / np.float32(3))


def displaced(image: NDArray[np.floating], place: Place) -> NDArray[np.floating]:
    """The image as it is seen from another place, image(p + place) at p; the same array if that is
    (0, 0).

    Interpolated by Lanczos' kernel, and kept within half of the least and of the most of the pixels
    around.
    What isn't finite stays where it is, and what is near it, too. Beyond the frame's edge the
    picture is taken to go on as it ends there.

    Args:
        image: (H, W) or (H, W, 3), float16 or float32.
        place: (x, y) in pixels.

    Returns:
        Of the image's shape and type.
    """
    if place == (0.0, 0.0):
        return image
    found = np.empty_like(image)
    reach = [_LOBES + math.ceil(abs(offset)) for offset in place]
    for rows, inner in overlapping_bands(len(image), reach[1], _ROWS):
        found[rows][inner] = _displaced(np.ascontiguousarray(image[rows]), place, reach)[inner]
    return found


def _displaced(image: NDArray[np.floating], place: Place, reach: list[int]) -> NDArray[np.floating]:
    """`displaced` of some rows, of which the outer ones are only looked at."""
    values = to_float(image)
    bad = not_finite(values)
    if bad is not None:
        values = np.where(bad if values.ndim == 2 else bad[..., np.newaxis], np.float32(0), values)
    across, down = (_kernel(offset, taps) for offset, taps in zip(place, reach, strict=True))
    border = cv2.BORDER_REPLICATE
    moved = np.asarray(cv2.sepFilter2D(values, -1, across, down, borderType=border), np.float32)
    x, y = (1 + 2 * math.ceil(abs(offset)) for offset in place)
    around = np.ones((y, x), np.uint8)
    least, most = (
        np.asarray(change(values, around, borderType=border), np.float32)
        for change in (cv2.erode, cv2.dilate)
    )
    least -= _RINGING * np.abs(least)
    most += _RINGING * np.abs(most)
    np.clip(moved, least, most, out=moved)
    found = to_half(moved) if image.dtype == np.float16 else moved
    if bad is not None:
        near = cv2.dilate(bad.view(np.uint8), np.ones([1 + 2 * n for n in reach[::-1]])) > 0
        found[near] = image[near]
    return found


def _kernel(offset: float, reach: int) -> Float64:
    """Taps by which a row of pixels is seen so much further on."""
    x = np.arange(-reach, reach + 1) - offset
    taps = np.sinc(x) * np.sinc(x / _LOBES) * (np.abs(x) < _LOBES)
    return np.asarray(taps / taps.sum(), np.float64)
