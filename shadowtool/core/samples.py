"""Samples of a take, (T, 3, N): some of its frames, each point by channel."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]
Index = NDArray[np.intp]


def rank(ascending: Index, part: float) -> Index:
    """Each point's sample below which this part of its samples are, (N,).

    Args:
        ascending: (T, N), each point's samples from dark to bright.
    """
    order: Index = ascending[int(part * (len(ascending) - 1))]
    return order


def ranked(stack: Float32, order: Index, pixels: Index | None = None) -> Float32:
    """The sample that each point, or each of some, has in one place of the order; (3, N).

    Args:
        order: (N,), of `rank`.
        pixels: which points; None for all.
    """
    pixels = np.arange(stack.shape[2]) if pixels is None else pixels
    return np.ascontiguousarray(stack[order[pixels], :, pixels].T)


def mean_where(stack: Float32, chosen: Iterable[Bool]) -> tuple[Float32, Float32]:
    """Each point's mean over the samples in which it is chosen, (T, N), as (3, N), 0 of none, and
    their number, (N,)."""
    total = np.zeros(stack.shape[1:], np.float32)
    count = np.zeros(stack.shape[2], np.float32)
    for sample, where in zip(stack, chosen, strict=True):
        part = where.astype(np.float32)
        total += sample * part
        count += part
    return np.asarray(total / np.maximum(count, 1), np.float32), count
