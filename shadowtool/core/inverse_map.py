"""The inverse of a displacement map, and maps one after the other (the paper's section 7).

A source that isn't flat has a map of its own, from its pixels to the reference plane. The target's
map leads to that plane too; the source's, taken backwards, leads on to the pixel in which the
source shows that shadow.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.warp_map import WarpMap, identity_map

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

# Neighbours that a map takes further apart than this, pixels, are parts of different things.
_TORN = 6.0


def invert(warp_map: WarpMap) -> WarpMap:
    """Where in the picture each point of the reference plane is seen.

    The map is taken as linear over the triangles between pixels, and each of these is turned
    round. Where the map folds, several pixels show one point: the best known stands.

    Args:
        warp_map: W; NaN unknown.

    Returns:
        A map of the same size, such that ``invert(W)[W[p]] = p``; NaN and infinite error where no
        pixel shows the point. Its error is that of the pixel's own W.
    """
    height, width = warp_map.error.shape
    warp = np.full((height * width, 2), np.nan, np.float32)
    error = np.full(height * width, np.inf, np.float32)
    if height > 1 and width > 1:
        for rows in bands((height - 1, width)):
            found = _turned_round(warp_map, rows)
            # The best known of each cell comes last; of equals, the first pixel's.
            y, x = -found.place[:, 1], -found.place[:, 0]
            order = np.lexsort((x, y, -found.error, found.cell))
            cells = found.cell[order]
            last = order[np.append(cells[1:] != cells[:-1], True)[: len(order)]]
            cells, best = found.cell[last], found.error[last]
            better = (best < error[cells]) | np.isnan(warp[cells, 0])
            warp[cells[better]], error[cells[better]] = found.place[last[better]], best[better]
    return WarpMap(warp.reshape(height, width, 2), error.reshape(height, width))


class _Points(NamedTuple):
    """Points of the reference plane that some triangles show.

    Attributes:
        cell: (N,), the point's number, counted row by row.
        place: (N, 2), where it is seen, (x, y).
        error: (N,), the largest of the triangle's corners.
    """

    cell: NDArray[np.int64]
    place: Float64
    error: Float64


def _turned_round(warp_map: WarpMap, rows: slice) -> _Points:
    """What the triangles below some rows of pixels show."""
    height, width = warp_map.error.shape
    part = slice(rows.start, rows.stop + 1)
    place = identity_map(part.stop - part.start, width).reshape(-1, 2).astype(np.float64)
    place[:, 1] += part.start
    shown = warp_map.warp[part].reshape(-1, 2).astype(np.float64)
    error = warp_map.error[part].ravel().astype(np.float64)
    corners = _triangles(part.stop - part.start, width)
    corner = shown[corners]
    span = corner.max(axis=1) - corner.min(axis=1)
    corners = corners[(span <= _TORN).all(axis=1)]
    corner = shown[corners]
    first = np.ceil(corner.min(axis=1)).astype(np.int64)
    last = np.floor(corner.max(axis=1)).astype(np.int64)
    to_first, to_second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = to_first[:, 0] * to_second[:, 1] - to_first[:, 1] * to_second[:, 0]
    cells, places, errors = [], [], []
    columns, below = (last - first).T
    columns[area == 0] = -1
    for row, column in np.ndindex(int(_TORN) + 1, int(_TORN) + 1):
        some = np.flatnonzero((columns >= column) & (below >= row))
        point = first[some] + np.array([column, row])
        inside = ((point >= 0) & (point < (width, height))).all(axis=1)
        some, point = some[inside], point[inside]
        offset = point - corner[some, 0]
        # The point as first corner + a·(second - first) + b·(third - first).
        a = (offset[:, 0] * to_second[some, 1] - offset[:, 1] * to_second[some, 0]) / area[some]
        b = (offset[:, 1] * to_first[some, 0] - offset[:, 0] * to_first[some, 1]) / area[some]
        within = (a >= -1e-9) & (b >= -1e-9) & (a + b <= 1 + 1e-9)
        some, a, b = some[within], a[within, None], b[within, None]
        one, two, three = (place[corners[some, k]] for k in range(3))
        point = point[within]
        cells.append(point[:, 1] * width + point[:, 0])
        places.append(one + a * (two - one) + b * (three - one))
        errors.append(error[corners[some]].max(axis=1))
    return _Points(*(np.concatenate(parts) for parts in (cells, places, errors)))


def compose(first: WarpMap, second: WarpMap) -> WarpMap:
    """One map after the other: p goes to ``second[first[p]]``.

    Args:
        first: (H, W) map from the target to the reference plane.
        second: map from the reference plane to the source.

    Returns:
        (H, W) map; NaN and infinite error where either is unknown. Where the first leads out of
        the second's picture it stands as it is: nothing is known of that ground but that no shadow
        was seen on it.
    """
    height, width = second.error.shape
    x, y = (np.ascontiguousarray(np.nan_to_num(first.warp[..., i], nan=-1e6)) for i in (0, 1))
    moved = second.warp - identity_map(height, width)
    unknown = np.isnan(moved).any(axis=-1)
    layers = np.dstack([np.where(unknown[..., None], 0, moved), unknown]).astype(np.float32)
    seen = _remap(layers, x, y)
    error = np.where(np.isfinite(second.error), second.error, 0).astype(np.float32)
    spread = np.hypot(first.error, _remap(error, x, y))
    lost = seen[..., 2] > 1e-3
    warp = first.warp + seen[..., :2]
    warp[lost] = np.nan
    # What the first map only filled in stays that; what the second filled in is so here.
    filled = _remap(np.isinf(second.error).astype(np.float32), x, y) > 1e-3
    result = np.where(lost | filled, np.inf, spread).astype(np.float32)
    outside = (x < 0) | (y < 0) | (x > width - 1) | (y > height - 1)
    warp[outside], result[outside] = first.warp[outside], first.error[outside]
    return WarpMap(warp.astype(np.float32), result)


def _remap(image: Float32, x: Float32, y: Float32) -> Float32:
    return np.asarray(
        cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )


def _triangles(height: int, width: int) -> NDArray[np.int64]:
    """Two triangles between each four neighbouring pixels, (N, 3) indices."""
    index = np.arange(height * width).reshape(height, width)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    upper, lower = np.stack([a, b, c], axis=-1), np.stack([b, d, c], axis=-1)
    return np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)])
