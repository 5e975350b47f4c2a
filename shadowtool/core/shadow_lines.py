"""The swept shadow's edge as a straight line on the reference plane, frame by frame (section 4).

Lines are n·x + d = 0 with unit normal n, in pixels, pixel centres at whole numbers, x to the right
and y down. The normals of a pass all point to one side, so that neighbouring lines can be
interpolated; the paper's x = m·y + b fails for lines near horizontal.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.errors import NoLinesError

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Origin = Literal["fit", "refit", "interpolated"]

# Zero crossings between two neighbouring pixels are looked for over so many frames: more lie only
# between pixels that belong to different things.
_LARGEST_STEP = 8
_LEAST_POINTS = 12
# Root mean square distance of the points from their middle, along the line, pixels.
_LEAST_SPREAD = 4.0
# A fit tries this many lines through two points, judges them by about so many points, and keeps the
# points this near, pixels.
_HYPOTHESES, _JUDGES, _NEAR = 200, 500, 2.0
# A line is poor if its residual is this many times the pass's median, and larger than the floor.
_POOR_RATIO, _POOR_FLOOR = 2.5, 0.5
# So many poor lines in a row are replaced.
_LONGEST_RUN = 4
# A direction jumps if it is this many times the pass's median deviation off its neighbours'
# course, and by more than the floor, radians.
_JUMP_RATIO, _JUMP_FLOOR = 5.0, np.radians(0.75)
# Lines that lie no further apart than this, pixels, stand still.
_STILL = 0.5
# About so many pixels tell how far they are off their lines, and are so by more than this, pixels,
# only if something is wrong.
_SOME_PLACES, _OFF = 50_000, 2.0
# Bends are looked for in about so many lines, and told from so many.
_BENT_LINES, _LEAST_BENT = 24, 5


@dataclass(frozen=True)
class ShadowLines:
    """One line for each frame of a pass in which the edge crossed the reference plane.

    Attributes:
        frame: (F,) float64, ascending frame numbers.
        normal: (F, 2) float64, unit.
        offset: (F,) float64, pixels.
        residual: (F,) float64, root mean square distance of the points from the line, pixels.
        points: (F,) int64, how many points the line rests on.
        origin: how each came to be, F entries.
    """

    frame: Float64
    normal: Float64
    offset: Float64
    residual: Float64
    points: NDArray[np.int64]
    origin: tuple[Origin, ...]

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def angle(self) -> Float64:
        """(F,) direction of the normals, radians, unwrapped."""
        return np.unwrap(np.arctan2(self.normal[:, 1], self.normal[:, 0]))


def fit_shadow_lines(groups: dict[int, Float64], frames: Float64) -> ShadowLines:
    """Fit, reject and replace the shadow lines of one pass.

    Args:
        groups: points on the edge, pixels, by frame, from `zero_crossings`.
        frames: (N,) ascending numbers of the frames that were looked at.

    Returns:
        The lines of all frames from the first to the last in which one could be fitted.

    Raises:
        NoLinesError: fewer than two frames have a usable line.
    """
    fitted = {i: _fit(points) for i, points in groups.items() if len(points) >= _LEAST_POINTS}
    fits = {i: line for i, line in fitted.items() if line is not None}
    if len(fits) < 2:
        raise NoLinesError("fewer than two frames show the shadow's edge on the plane")
    fits = _aligned(fits)
    poor = _poor(fits)
    fits, refitted = _refit(fits, poor, groups)
    fits = _aligned(fits)
    dropped = _replaceable(_poor(fits), fits) | _jumping(fits, frames)
    kept = {i: line for i, line in fits.items() if i not in dropped}
    if len(kept) < 2:
        raise NoLinesError("no two lines on the plane agree with each other")
    first, last = min(kept), max(kept)
    indices = list(range(first, last + 1))
    lines = ShadowLines(
        frame=np.asarray([frames[i] for i in kept], np.float64),
        normal=np.asarray([line.normal for line in kept.values()]),
        offset=np.asarray([line.offset for line in kept.values()]),
        residual=np.asarray([line.residual for line in kept.values()]),
        points=np.asarray([line.points for line in kept.values()], np.int64),
        origin=tuple("refit" if i in refitted else "fit" for i in kept),
    )
    whole = interpolate_lines(lines, frames[indices])
    counts = np.asarray([kept[i].points if i in kept else 0 for i in indices], np.int64)
    origins: list[Origin] = [
        "interpolated" if i not in kept else "refit" if i in refitted else "fit" for i in indices
    ]
    return replace(whole, points=counts, origin=tuple(origins))


def interpolate_lines(lines: ShadowLines, times: Float64) -> ShadowLines:
    """The lines at any times between the first and the last (step 2a of the outline).

    The angle is interpolated, not the slope; the offset is taken about the lines' common middle,
    where it hardly depends on the angle. Both on a smooth curve: a board that moves evenly over the
    ground gains or loses speed in the picture.

    Args:
        times: (N,) frame numbers; outside the lines' span the result is NaN.
    """
    times = np.asarray(times, np.float64)
    inside = (times >= lines.frame[0]) & (times <= lines.frame[-1])
    pivot = _pivot(lines)
    about = lines.offset + lines.normal @ pivot
    angle = _curve(times, lines.frame, lines.angle)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    offset = _curve(times, lines.frame, about) - (normal * pivot).sum(axis=-1)
    residual = np.interp(times, lines.frame, lines.residual)
    normal[~inside] = np.nan
    offset[~inside] = np.nan
    residual[~inside] = np.nan
    none = np.zeros(len(times), np.int64)
    origin: list[Origin] = ["interpolated"] * len(times)
    return ShadowLines(times, normal, offset, residual, none, tuple(origin))


def _curve(times: Float64, frames: Float64, values: Float64) -> Float64:
    """Values between frames on cubics that have the slope of both neighbours at each."""
    if len(frames) < 3:
        return np.interp(times, frames, values)
    first = np.clip(np.searchsorted(frames, times, side="right") - 1, 0, len(frames) - 2)
    last, step = first + 1, np.diff(frames)[first]
    slope = np.gradient(values, frames)
    # Hermite's basis.
    u = np.clip((times - frames[first]) / step, 0, 1)
    near, far = (1 - u) ** 2, u**2
    ends = near * (1 + 2 * u) * values[first] + far * (3 - 2 * u) * values[last]
    return np.asarray(ends + step * u * (1 - u) * ((1 - u) * slope[first] - u * slope[last]))


def line_pace(
    lines: ShadowLines, times: NDArray[np.floating], points: NDArray[np.number]
) -> Float64:
    """How fast the lines pass points of the picture, pixels a frame along their normals.

    Before a low camera lines fan out, and pass some points many times as fast as others: by
    |(n'·p + d') - (n·p + d)| a frame from one line to the next.

    Args:
        times: (N,), frame numbers; those beyond the lines' span count as its ends.
        points: (N, 2), (x, y), on the line of each time or next to it.

    Returns:
        (N,) float64 ≥ 0; 0 of a single line.
    """
    if len(lines) < 2:
        return np.zeros(len(times))
    first = np.clip(np.searchsorted(lines.frame, times, side="right") - 1, 0, len(lines) - 2)
    behind, ahead = (
        (lines.normal[which] * points).sum(axis=-1) + lines.offset[which]
        for which in (first, first + 1)
    )
    return np.asarray(np.abs(ahead - behind) / np.diff(lines.frame)[first], np.float64)


def off_lines(time: Float32, plane: NDArray[np.bool_], lines: ShadowLines) -> Float32:
    """How far pixels on the reference plane lie off the line of their own time, |n·p + d|, where
    each should lie on it.

    Args:
        time: (H, W), frame numbers; NaN unknown.
        plane: (H, W), the reference plane region.

    Returns:
        (N,) float32 ≥ 0, pixels, of some of those whose time the lines span; empty if there is
        none.
    """
    places = some_of(plane & np.isfinite(time))
    own = interpolate_lines(lines, time[places].astype(np.float64))
    distance = np.abs((own.normal * np.stack(places[::-1], axis=-1)).sum(axis=-1) + own.offset)
    return np.asarray(distance[np.isfinite(distance)], np.float32)


def part_off_lines(time: Float32, plane: NDArray[np.bool_], lines: ShadowLines) -> float:
    """The part of the plane's pixels that are off their lines by more than measuring makes them, as
    of `off_lines`; 0 if there are none."""
    distance = off_lines(time, plane, lines)
    return float((distance > _OFF).mean()) if distance.size else 0.0


def some_of(region: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of some places of a region, (H, W), evenly spread: enough to tell what is
    usual there."""
    places = np.flatnonzero(region)
    y, x = np.divmod(places[:: max(1, places.size // _SOME_PLACES)], region.shape[1])
    return y, x


class Bend(NamedTuple):
    """How lines bow, as a lens with radial distortion bows them.

    Attributes:
        pixels: of a line as long as the picture is wide and half its height from the middle, how
            far its middle is off its ends' chord; above 0 if lines bow towards the picture's middle
            there (barrel distortion), below 0 if away from it.
        certainty: ``pixels`` in standard deviations, from how well the lines agree.
    """

    pixels: float
    certainty: float


def line_bend(
    groups: dict[int, Float64], frames: Float64, lines: ShadowLines, size: tuple[int, int]
) -> Bend:
    """Whether the lines' residuals bend systematically.

    A lens that moves a point at c + x to c + x(1 + k|x|²) moves the points of a line at the
    distance ρ from the middle c by kρ(ρ² + u²) along its normal, u counted along the line. What of
    that no straight line takes up is left in the residuals, and it has the same k in all lines.

    Args:
        groups, frames: as for `fit_shadow_lines`.
        lines: what that made of them.
        size: of the picture, (W, H).
    """
    width, height = size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    indices = np.searchsorted(frames, lines.frame)
    found, weights = [], []
    for line in range(0, len(lines), max(1, len(lines) // _BENT_LINES)):
        points = groups.get(int(indices[line]), np.zeros((0, 2)))
        normal, offset = lines.normal[line], lines.offset[line]
        residual = points @ normal + offset
        near = np.abs(residual) < _NEAR
        if near.sum() < _LEAST_POINTS:
            continue
        along = (points[near] - middle) @ np.array([-normal[1], normal[0]]) / width
        straight = np.stack([np.ones_like(along), along], axis=-1)
        both = np.stack([along**2, residual[near]], axis=-1)
        bow, rest = (both - straight @ np.linalg.lstsq(straight, both, rcond=None)[0]).T
        expected = -(normal @ middle + offset) / width * bow
        strength = float(expected @ expected)
        if strength > 0:
            found.append(float(expected @ rest) / strength)
            weights.append(strength)
    if len(found) < _LEAST_BENT:
        return Bend(0.0, 0.0)
    each, weight = np.asarray(found), np.asarray(weights)
    mean = float(weight @ each / weight.sum())
    spread = float(np.sqrt(weight**2 @ (each - mean) ** 2) / weight.sum())
    return Bend(-mean * height / (2 * width) / 4, abs(mean) / max(spread, 1e-9))


def zero_crossings(
    time: NDArray[np.float32], plane: NDArray[np.bool_], frames: Float64
) -> dict[int, Float64]:
    """Points where t - f changes its sign between neighbouring pixels, for each frame f.

    Args:
        time: (H, W) shadow times, frame numbers; NaN unknown.
        plane: (H, W) bool, the reference plane region.
        frames: (N,) ascending numbers of the frames that were looked at.

    Returns:
        By index into ``frames``: (P, 2) float64 points (x, y), interpolated between the pixels'
        centres. Frames without a point are left out.
    """
    indices, points = list[NDArray[np.int64]](), list[Float64]()
    for rows in bands(time.shape):
        # With the first row of the next band.
        band = slice(rows.start, rows.stop + 1)
        clock = np.where(plane[band], _frame_index(time[band], frames), np.float32(np.nan))
        whole = np.floor(clock)
        for axis, own in ((0, slice(None)), (1, slice(rows.stop - rows.start))):
            (a, b), (low, high) = (_neighbours(part[own], axis) for part in (clock, whole))
            steps = np.abs(high - low)
            y, x = np.nonzero((steps > 0) & (steps <= _LARGEST_STEP + 1))
            found = _between(a[y, x].astype(np.float64), b[y, x].astype(np.float64))
            for pair, index, part in found:
                point = np.stack([x[pair], y[pair] + rows.start], axis=-1).astype(np.float64)
                point[:, 1 - axis] += part
                indices.append(index)
                points.append(point)
    if not indices:
        return {}
    index, point = np.concatenate(indices), np.concatenate(points)
    # Noise takes a time beyond the first frame or the last.
    looked_at = (index >= 0) & (index < len(frames))
    index, point = index[looked_at], point[looked_at]
    order = np.argsort(index, kind="stable")
    index, point = index[order], point[order]
    cuts = np.nonzero(np.diff(index))[0] + 1
    return {
        int(i[0]): p
        for i, p in zip(np.split(index, cuts), np.split(point, cuts), strict=True)
        if len(i)
    }


def _neighbours(image: Float32, axis: int) -> tuple[Float32, Float32]:
    """Each pixel but the last ones along the axis, and the one after it."""
    return (image[:-1], image[1:]) if axis == 0 else (image[:, :-1], image[:, 1:])


def _between(
    start: Float64, end: Float64
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.int64], Float64]]:
    """Whole numbers between two ends: the pairs that have one, the number, and where it lies from
    start (0) to end (1)."""
    low, high = np.minimum(start, end), np.maximum(start, end)
    nearest = np.ceil(low)
    # A frame exactly at the lower of two times belongs to the pair on its other side.
    nearest += nearest == low
    near = high - low <= _LARGEST_STEP
    for step in range(_LARGEST_STEP + 1):
        pairs = np.flatnonzero(near & (nearest + step <= high))
        if not pairs.size:
            break
        index = nearest[pairs] + step
        part = (index - start[pairs]) / (end[pairs] - start[pairs])
        yield pairs, index.astype(np.int64), part


def _frame_index(time: Float32, frames: Float64) -> Float32:
    """Frame numbers to positions in the list of frames, NaN kept."""
    if (np.diff(frames) == 1).all():
        return time - np.float32(frames[0])
    clock = np.interp(time, frames, np.arange(len(frames), dtype=np.float64))
    clock[np.isnan(time)] = np.nan
    return clock.astype(np.float32)


@dataclass(frozen=True)
class _Line:
    normal: Float64
    offset: float
    residual: float
    points: int
    middle: Float64


def _fit(points: Float64) -> _Line | None:
    """Total least squares over the points that the best of many lines through two of them has
    near it: the plane has specks, and shade of its own."""
    rng = np.random.default_rng(len(points))
    one, other = points[rng.integers(0, len(points), (2, _HYPOTHESES))]
    along = other - one
    length = np.hypot(along[:, 0], along[:, 1])
    usable = length > _LEAST_SPREAD
    if usable.any():
        one, along, length = one[usable], along[usable], length[usable]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=-1) / length[:, None]
        offset = -(one * normal).sum(axis=-1)
        judges = points[:: max(1, len(points) // _JUDGES)]
        far = judges @ normal.T + offset
        far /= _NEAR
        far *= far
        # Not a count with a sharp bound but how near the near ones are.
        score = np.maximum(np.subtract(1, far, out=far), 0, out=far).sum(axis=0)
        best = int(np.argmax(score))
        points = points[np.abs(points @ normal[best] + offset[best]) <= _NEAR]
    if len(points) < _LEAST_POINTS:
        return None
    middle = points.mean(axis=0)
    centred = points - middle
    spread = centred.T @ centred / len(points)
    values, vectors = np.linalg.eigh(spread)
    # The normal is the direction in which the points spread least.
    if values[1] < _LEAST_SPREAD**2:
        return None
    normal = vectors[:, 0]
    residual = float(np.sqrt(max(values[0], 0)))
    return _Line(normal, float(-normal @ middle), residual, len(points), middle)


def _aligned(fits: dict[int, _Line]) -> dict[int, _Line]:
    """Turn each normal to its predecessor's side."""
    aligned: dict[int, _Line] = {}
    before: Float64 | None = None
    for index in sorted(fits):
        line = fits[index]
        if before is not None and line.normal @ before < 0:
            line = replace(line, normal=-line.normal, offset=-line.offset)
        aligned[index] = line
        before = line.normal
    return aligned


def _poor(fits: dict[int, _Line]) -> set[int]:
    residuals = np.asarray([line.residual for line in fits.values()])
    limit = max(_POOR_RATIO * float(np.median(residuals)), _POOR_FLOOR)
    return {i for i, line in fits.items() if line.residual > limit}


def _replaceable(poor: set[int], fits: dict[int, _Line]) -> set[int]:
    """Poor lines but for those of many frames in a row with others before and after: between lines
    so far apart nothing tells where the edge was, which these do."""
    good = sorted(set(fits) - poor)
    kept = set(poor)
    for before, after in pairwise(good):
        if after - before - 1 > _LONGEST_RUN:
            kept -= set(range(before + 1, after))
    return kept


def _refit(
    fits: dict[int, _Line], poor: set[int], groups: dict[int, Float64]
) -> tuple[dict[int, _Line], set[int]]:
    """Fit poor lines anew to the points between the nearest valid lines on both sides."""
    result, refitted = dict(fits), set[int]()
    valid = sorted(set(fits) - poor)
    for index in sorted(poor):
        before = [i for i in valid if i < index]
        after = [i for i in valid if i > index]
        if not before or not after:
            continue
        points = groups[index]
        behind, ahead = (points @ fits[i].normal + fits[i].offset for i in (before[-1], after[0]))
        # The normals agree, so a point between the lines lies on different sides of them.
        line = _fit(inside) if len(inside := points[behind * ahead <= 0]) >= _LEAST_POINTS else None
        if line is not None and line.residual < fits[index].residual:
            result[index] = line
            refitted.add(index)
    return result, refitted


def _jumping(fits: dict[int, _Line], frames: Float64) -> set[int]:
    """Lines whose direction is off the course of the two lines before and the two after.

    A stick turns evenly with time, or with the way that it goes: a hand that pauses, or turns back,
    holds its direction meanwhile.
    """
    order = sorted(fits)
    if len(order) < 5:
        return set()
    angle = np.unwrap([np.arctan2(fits[i].normal[1], fits[i].normal[0]) for i in order])
    at = frames[order]
    near = [
        [j for j in range(max(k - 2, 0), min(k + 3, len(order))) if j != k]
        for k in range(len(order))
    ]
    deviation = np.array(
        [abs(angle[k] - _on_course(at[own] - at[k], angle[own])) for k, own in enumerate(near)]
    )
    limit = max(_JUMP_RATIO * float(np.median(deviation)), _JUMP_FLOOR)

    def even_on_its_way(k: int) -> bool:
        line, others = fits[order[k]], [fits[order[j]] for j in near[k]]
        # How far they lie ahead where its own points are.
        way = np.array([other.normal @ line.middle + other.offset for other in others])
        off = abs(angle[k] - _on_course(way, angle[near[k]], _STILL))
        # Where no line fits, one may well lie between its neighbours by chance.
        return line.residual <= _POOR_FLOOR and off <= limit

    off_course = np.flatnonzero(deviation > limit).tolist()
    return {order[k] for k in off_course if not even_on_its_way(k)}


def _on_course(at: Float64, values: Float64, least: float = 0.0) -> float:
    """The value at 0 of the course that those at other places take, after Theil and Sen.

    Args:
        at: (N,), where the values are.
        least: places no further apart than this show no slope.
    """
    pairs = [(i, j) for i, j in combinations(range(len(at)), 2) if abs(at[j] - at[i]) > least]
    slopes = [(values[j] - values[i]) / (at[j] - at[i]) for i, j in pairs]
    return float(np.median(values - (np.median(slopes) if slopes else 0) * at))


def _pivot(lines: ShadowLines) -> Float64:
    """The point that all the lines pass nearest to."""
    matrix = lines.normal.T @ lines.normal
    # Parallel lines leave one direction free; a little pull towards the origin settles it.
    matrix += np.eye(2) * 1e-9 * len(lines)
    return np.asarray(np.linalg.solve(matrix, -lines.normal.T @ lines.offset))
