"""Lengths of pairs of numbers.

OpenCV's own differ in their last bits with where arrays lie in memory.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

# What OpenCV gives has no type of its own.
Singles = NDArray[Any]


def length(x: Singles, y: Singles, out: Singles | None = None) -> NDArray[np.float32]:
    """√(x² + y²) of arrays of one shape; NaN where either is, else infinite where either is.

    Args:
        x, y: float32.
        out: an array of that shape to write to, x or y itself perhaps.
    """
    with np.errstate(over="ignore"):
        squares = np.square(x)
        squares += np.square(y)
    return np.asarray(np.sqrt(squares, out=squares if out is None else out), np.float32)
