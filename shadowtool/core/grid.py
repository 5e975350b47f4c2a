"""The thin grid of pixels by which a take is looked over before all of it is read."""

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import to_float

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# The grid has about this many columns.
_COLUMNS = 320


def grid_step(width: int, height: int) -> int:
    """Every how many pixels the grid has a point."""
    return max(1, round(max(width, height) / _COLUMNS))


def exposure_step(width: int, height: int) -> int:
    """Every how many pixels exposure is looked at: fewer tell it than a figure's outline, unless
    there are few."""
    step = grid_step(width, height)
    return step if step == 1 else 2 * step


def exposure_rows(width: int, height: int) -> NDArray[np.float64]:
    """Where a picture's rows lie among those that exposure is looked at in, (H,)."""
    return np.arange(height) / exposure_step(width, height)


def on_grid(image: NDArray[np.floating], step: int) -> Float32:
    """The grid's pixels of a frame, (H, W, 3) to (h, w, 3) float32."""
    return to_float(np.ascontiguousarray(image[::step, ::step]))


def full_size(mask: Bool, width: int, height: int, step: int) -> UInt8:
    """A grid's mask for the whole picture: (H, W) uint8, 255 where the figure is."""
    # The grid's points stand for the pixels nearest to them.
    rows, columns = (
        np.minimum((np.arange(size) + step // 2) // step, points - 1)
        for size, points in zip((height, width), mask.shape, strict=True)
    )
    values = np.where(mask, np.uint8(255), np.uint8(0))
    return np.asarray(values.take(columns, axis=1).take(rows, axis=0), np.uint8)
