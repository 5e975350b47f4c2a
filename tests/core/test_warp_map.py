from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowtool.core.shadow_time import ShadowTimes
from shadowtool.core.warp_map import (
    Pass,
    WarpMap,
    error_of_confidence,
    from_st_map,
    identity_map,
    intersect,
    pass_angles,
    positions,
    sample,
    to_st_map,
    without_slips,
)
from tests.core.test_shadow_lines import SCENE, edge_times, lines_of
from tests.scene import Sweep

ANGLES = (0.2, 1.3, 2.4)


def passes(angles: tuple[float, ...] = ANGLES) -> list[Pass]:
    result = []
    for angle in angles:
        sweep = Sweep(angle)
        time = edge_times(sweep)
        frames = np.arange(SCENE.frames_of(sweep), dtype=np.float64)
        lines = lines_of(time, SCENE.plane, frames)
        result.append(Pass(ShadowTimes.alone(time, np.ones_like(time), 0.02), lines))
    return result


def intersected(scans: list[Pass]) -> WarpMap:
    return intersect(scans, identity_map(SCENE.height, SCENE.width))


@pytest.mark.parametrize("angles", [(0.2, 1.7), ANGLES, (0.1, 0.9, 1.7, 2.5, 4.0)])
def test_w_is_the_identity_on_the_plane_and_the_displacement_on_the_block(
    angles: tuple[float, ...],
) -> None:
    solved = intersected(passes(angles))
    known = np.isfinite(solved.error)
    assert known.mean() > 0.85
    error = np.linalg.norm(solved.warp - SCENE.warp, axis=-1)
    assert np.percentile(error[known & SCENE.plane], 99) < 0.1
    assert np.percentile(error[known & ~SCENE.plane], 99) < 0.1


def test_two_passes_are_needed() -> None:
    one, two, three = passes()
    one.times.time[:, :80] = np.nan
    two.times.time[:, :80] = np.nan
    three.times.time[:30] = np.nan
    solved = intersected([one, two, three])
    assert np.isinf(solved.error[:, :80]).all()
    assert np.isnan(solved.warp[:, :80]).all()
    assert np.isfinite(solved.error[:30, 85:]).mean() > 0.5


def test_near_parallel_passes_fix_nothing() -> None:
    assert np.isinf(intersected(passes((0.2, 0.25))).error).all()


def test_a_pass_of_low_contrast_counts_less() -> None:
    one, two, three = passes()
    faint = np.full_like(three.times.time, 0.01)
    late = Pass(ShadowTimes.alone(three.times.time + 1, faint), three.lines)
    solved = intersected([one, two, late])
    known = np.isfinite(solved.error)
    assert np.percentile(np.linalg.norm(solved.warp - SCENE.warp, axis=-1)[known], 95) < 0.1


def test_lines_of_three_passes_that_do_not_meet_are_known_to_be_off() -> None:
    one, two, three = passes()
    late = replace(three.times, time=three.times.time + 3)
    solved = intersected([one, two, Pass(late, three.lines)])
    known = np.isfinite(solved.error)
    error = np.linalg.norm(solved.warp - SCENE.warp, axis=-1)
    assert np.median(error[known]) > 2
    assert (error[known] < 3 * solved.error[known]).mean() > 0.95
    # Those of two always meet.
    assert np.nanmedian(intersected([two, Pass(late, three.lines)]).error[known]) < 2


def test_angles_are_those_of_the_sweeps() -> None:
    angles = {(i, j): angle for i, j, angle in pass_angles(passes((0.2, 1.3, 3.2)))}
    assert angles == pytest.approx(
        {(0, 1): 1.1, (0, 2): np.pi - 3.0, (1, 2): np.pi - 1.9}, abs=0.01
    )


def test_confidence_and_error_are_inverse() -> None:
    error = np.float32([0, 0.5, 3, np.inf])
    confidence = 1 / (1 + error)
    assert error_of_confidence(confidence) == pytest.approx(error)


def test_the_st_map_of_the_identity() -> None:
    st_map = to_st_map(identity_map(3, 4), 4, 3)
    assert st_map[0, 0] == pytest.approx([0.125, 1 - 0.5 / 3])
    assert st_map[2, 3] == pytest.approx([0.875, 0.5 / 3])


@given(st.integers(1, 5000), st.integers(1, 5000), st.floats(-100, 5000), st.floats(-100, 5000))
def test_st_maps_and_pixels_are_inverse(width: int, height: int, x: float, y: float) -> None:
    warp = np.float32([[[x, y]]])
    again = from_st_map(to_st_map(warp, width, height), width, height)
    # float32 has 24 bits for a position of up to this size.
    limit = 2.0**-22 * (abs(x) + abs(y) + width + height)
    assert again == pytest.approx(warp, abs=limit)


@pytest.mark.parametrize("shape", [(9, 13), (9, 13, 3)])
@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5, 0.8])
def test_what_is_unknown_spreads_to_no_others(shape: tuple[int, ...], shift: float) -> None:
    image = np.full(shape, 0.5, np.float32)
    image[4, 6], image[2, 3] = np.nan, np.inf
    unknown = np.zeros(shape[:2], bool)
    unknown[4, 6] = unknown[2, 3] = True
    warp = identity_map(9, 13)
    warp[..., 0] += np.float32(shift)
    found = sample(image, positions(warp), 0.5, unknown)
    bad = ~np.isfinite(found) if found.ndim == 2 else ~np.isfinite(found).all(axis=-1)
    # What lies midway is half of either.
    assert bad.sum() == (4 if shift == 0.5 else 2)
    assert found[np.isfinite(found)] == pytest.approx(0.5, abs=1e-6)


def bent(height: int = 30, width: int = 40) -> WarpMap:
    """A plane with something on it that moves W by three pixels and more."""
    warp = identity_map(height, width)
    warp[8:20, 10:25, 0] += 3 + 0.1 * np.arange(15, dtype=np.float32)
    return WarpMap(warp, np.full((height, width), 0.05, np.float32))


def same_maps(one: WarpMap, other: WarpMap) -> bool:
    return np.array_equal(one.warp, other.warp, equal_nan=True) and np.array_equal(
        one.error, other.error
    )


def test_a_pixel_off_all_around_it_that_agree_takes_their_displacement() -> None:
    true = bent()
    found = WarpMap(true.warp.copy(), true.error.copy())
    slips = [(4, 5), (25, 30), (14, 17)]
    for row, column in slips:
        found.warp[row, column] += (1.2, -0.9)
        found.error[row, column] = 0.3
    # Two that slipped together.
    found.warp[4, 33:35] += (0.0, 2.0)
    mended = without_slips(found)
    assert mended.warp == pytest.approx(true.warp, abs=0.06)
    assert np.array_equal(mended.error, true.error)
    assert found.warp[4, 5, 0] == pytest.approx(6.2)


def test_edges_and_corners_are_no_slips() -> None:
    found = bent()
    assert same_maps(without_slips(found), found)


def test_of_a_line_of_single_pixels_no_more_than_the_ends_can_be_taken_for_slips() -> None:
    found = bent()
    found.warp[2:28, 32, 1] -= 4
    found.warp[24, 4:20] += (1.0, 1.0)
    mended = without_slips(found)
    changed = np.argwhere((mended.warp != found.warp).any(axis=-1))
    assert {tuple(place) for place in changed.tolist()} <= {(2, 32), (27, 32), (24, 4), (24, 19)}


def test_where_neighbours_disagree_nothing_is_known_of_slips() -> None:
    rng = np.random.default_rng(0)
    found = bent()
    found.warp[:] += rng.normal(scale=1, size=found.warp.shape).astype(np.float32)
    mended = without_slips(found)
    assert (mended.warp != found.warp).any(axis=-1).mean() < 0.002


def test_what_is_unknown_is_left_and_is_no_neighbour() -> None:
    found = bent()
    found.warp[5, 5], found.error[5, 5] = np.nan, np.inf
    found.warp[25, 5] += 2
    found.warp[24, 4:6], found.error[24, 4:6] = np.nan, np.inf
    found.warp[26, 5], found.error[26, 5] = np.nan, np.inf
    assert same_maps(without_slips(found), found)
    lone = bent()
    lone.warp[22:27, 3:9], lone.error[22:27, 3:9] = np.nan, np.inf
    lone.warp[24, 5], lone.error[24, 5] = (5, 24), 0.1
    assert same_maps(without_slips(lone), lone)
    nothing = WarpMap(np.full((9, 9, 2), np.nan, np.float32), np.full((9, 9), np.inf, np.float32))
    assert same_maps(without_slips(nothing), nothing)
    for shape in ((1, 1), (1, 9), (2, 2)):
        small = WarpMap(identity_map(*shape), np.zeros(shape, np.float32))
        assert same_maps(without_slips(small), small)


def test_the_identity_resamples_to_the_same_picture() -> None:
    image = np.random.default_rng(0).uniform(size=(9, 13)).astype(np.float32)
    assert sample(image, positions(identity_map(9, 13)), 1.0) == pytest.approx(image, abs=1e-6)


def test_resampling_is_bilinear() -> None:
    ramp = np.tile(np.arange(10, dtype=np.float32), (10, 1))
    warp = identity_map(10, 10)[:, :8] + np.float32([0.37, 0.0])
    assert sample(ramp, positions(warp), 0.0) == pytest.approx(warp[..., 0], abs=1e-5)


def test_outside_the_frame_and_where_the_map_is_unknown_is_lit() -> None:
    image = np.zeros((5, 5), np.float32)
    warp = identity_map(5, 5)
    warp[0, 0] = np.nan
    warp[0, 1] = (99, 2)
    warp[0, 2] = (np.inf, 2)
    warp[0, 3] = (2, -1e9)
    assert sample(image, positions(warp), 1.0)[0].tolist() == [1, 1, 1, 1, 0]


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_resampling_keeps_channels_and_edge(channels: int) -> None:
    image = np.zeros((5, 5, channels), np.float32)
    result = sample(image, positions(identity_map(5, 5) + 50), 1.0)
    assert result.shape == (5, 5, channels)
    assert (result == 1).all()
