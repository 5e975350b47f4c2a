"""Working through a picture a part at a time, so that what is in hand stays in the cache."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

# Values in a band: an array of as many single floats is 1.5 MB. Smaller ones fit the cache better,
# but threads that work through many bands wait for one another at each.
_VALUES = 3 << 17
# Rows that are worked through with those around them: about so many, or so many times as many as
# these are, as what is read twice costs more than threads that have no band of their own gain;
# always a multiple of the last number, as others count in cells.
_ROWS, _REACHES, _WHOLE = 192, 4, 16
_ONES = np.ones((1, 3), np.float32)


def bands(shape: tuple[int, ...], channels: int = 3) -> Iterator[slice]:
    """Rows of a picture (H, W, ...) from top to bottom, as many at a time as are worked on fastest.

    Args:
        channels: of the arrays that are made on the way.
    """
    height, width = shape[:2]
    step = max(1, _VALUES // max(width * channels, 1))
    for start in range(0, height, step):
        yield slice(start, min(start + step, height))


def blocks(count: int, together: int) -> Iterator[slice]:
    """Parts of so many values in a row, as many together as are given."""
    for start in range(0, count, together):
        yield slice(start, min(start + together, count))


def overlapping_bands(
    height: int, reach: int, rows: int | None = None
) -> list[tuple[slice, slice]]:
    """Rows of a picture of which each result depends on others around it.

    Args:
        reach: how far, pixels.
        rows: of a band; None for so many that little is read twice, and all bands are alike.

    Returns:
        For each band the rows that are to be read, and where in these its own rows lie.
    """
    if rows is None:
        count = max(round(height / max(_ROWS, _REACHES * reach)), 1)
        rows = -(-max(height, 1) // (count * _WHOLE)) * _WHOLE
    cut = []
    for first in range(0, height, rows):
        last = min(first + rows, height)
        start, stop = max(first - reach, 0), min(last + reach, height)
        cut.append((slice(start, stop), slice(first - start, last - start)))
    return cut


def in_all_channels(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) as (H, W, 3), the same in each channel."""
    return np.asarray(cv2.merge([plane, plane, plane]), np.float32)


def channel_sum(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The sum of three channels (H, W, 3), (H, W); NaN where one is. Several times faster than
    along so short an axis."""
    return np.asarray(cv2.transform(image, _ONES), np.float32)
