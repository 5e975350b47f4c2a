import numpy as np
import pytest

from shadowtool.core.epipole import find_epipole
from shadowtool.core.parallax import measure_parallax, without_unchecked
from shadowtool.core.shadow_time import ShadowTimes
from shadowtool.core.warp_map import Pass, WarpMap, identity_map
from tests.core.test_shadow_lines import SCENE
from tests.core.test_warp_map import passes

POSITIONS = identity_map(SCENE.height, SCENE.width)
# The block's displacement is (6, -9) everywhere: its light is infinitely far.
LENGTH = float(np.hypot(*SCENE.displacement))
DIRECTIONS = np.broadcast_to(
    np.float32(SCENE.displacement) / np.float32(LENGTH), POSITIONS.shape
).copy()


def measured(scans: list[Pass]) -> tuple[np.ndarray, np.ndarray]:
    found = measure_parallax(scans, POSITIONS, DIRECTIONS)
    return found.shift, found.deviation


@pytest.mark.parametrize("angles", [(0.2, 1.7), (0.2, 1.3, 2.4)])
def test_s_is_0_on_the_plane_and_the_length_of_the_displacement_on_the_block(
    angles: tuple[float, ...],
) -> None:
    shift, error = measured(passes(angles))
    known = np.isfinite(error)
    assert known.mean() > 0.85
    truth = np.where(SCENE.plane, 0, LENGTH)
    assert np.percentile(np.abs(shift - truth)[known], 99) < 0.15


def test_what_no_other_pass_checks_is_known_worse() -> None:
    one, two, three = passes()
    for scan in (two, three):
        scan.times.own_time[:, :80] = np.nan
    shift, error = measured([one, two, three])
    assert np.isfinite(shift[:, :75]).mean() > 0.7
    assert np.nanmin(error[:, :75]) > 0.5 > np.median(error[:, 90:])


def alone(columns: slice) -> tuple[WarpMap, list[Pass]]:
    """The scene's W as three passes tell it, but for columns that only the first one reached."""
    one, two, three = passes()
    for scan in (two, three):
        scan.times.own_time[:, columns] = np.nan
    error = np.where(one.reached, np.float32(0.1), np.float32(np.inf))
    return WarpMap(np.where(one.reached[..., np.newaxis], SCENE.warp, np.nan), error), [
        one,
        two,
        three,
    ]


def kept(found: WarpMap, scans: list[Pass], region: np.ndarray) -> float:
    """How much of a region that one pass reached is left."""
    left = np.isfinite(without_unchecked(found, scans, SCENE.plane).error)
    return float(left[region & scans[0].reached].mean())


def test_one_pass_is_believed_on_a_surface_that_others_tell_of() -> None:
    found, scans = alone(np.s_[90:])
    part = np.zeros_like(SCENE.plane)
    part[:, 90:] = True
    # But for the block's corners.
    assert kept(found, scans, part & ~SCENE.plane) > 0.99
    # However steep it is, but not across a step.
    columns = np.arange(SCENE.width, dtype=np.float32)[np.newaxis]
    found.warp[..., 0] += np.where(SCENE.plane, 0, 3 * columns)
    assert kept(found, scans, part & ~SCENE.plane) > 0.99
    found.warp[:, 90:, 0] += np.where(SCENE.plane, 0, 4)[:, 90:]
    assert kept(found, scans, part & ~SCENE.plane) == 0


@pytest.mark.parametrize(("first", "believed"), [(80, True), (65, False)])
def test_one_pass_is_not_believed_where_others_tell_little_of_a_surface(
    first: int, believed: bool
) -> None:
    found, scans = alone(np.s_[first:])
    part = np.zeros_like(SCENE.plane)
    part[:, first + 3 :] = True
    assert (kept(found, scans, part & ~SCENE.plane) > 0.99) == believed


def test_a_lone_pixel_that_others_tell_of_is_dropped_with_what_is_around_it() -> None:
    found, scans = alone(np.s_[58:])
    for scan, whole in zip(scans, passes(), strict=True):
        scan.times.own_time[45, 80] = whole.times.own_time[45, 80]
    assert kept(found, scans, ~SCENE.plane) == 0


def test_one_pass_is_believed_on_the_plane_if_it_finds_it_there() -> None:
    found, scans = alone(np.s_[120:])
    part = np.zeros_like(SCENE.plane)
    part[:, 120:] = True
    assert kept(found, scans, part) == 1
    found.warp[:, 120:] += np.float32(2)
    assert kept(found, scans, part) == 0
    assert kept(found, scans, ~part) == 1


def test_a_pass_that_disagrees_is_outvoted_by_two_that_agree() -> None:
    one, two, three = passes()
    late = Pass(ShadowTimes.alone(three.times.time + 4, three.times.contrast, 0.02), three.lines)
    honest, _ = measured([one, two])
    shift, error = measured([one, two, late])
    known = np.isfinite(error) & np.isfinite(honest)
    assert np.percentile(np.abs(shift - honest)[known], 95) < 0.05


def test_two_passes_that_disagree_are_known_badly() -> None:
    one, two = passes((0.2, 1.7))
    late = Pass(ShadowTimes.alone(two.times.time + 4, two.times.contrast, 0.02), two.lines)
    both = (np.isfinite(m[1]) for m in (measured([one, two]), measured([one, late])))
    known = np.logical_and(*both)
    assert np.median(measured([one, late])[1][known]) > 5 * np.median(
        measured([one, two])[1][known]
    )


def test_a_pass_along_the_displacement_leaves_the_measuring_to_the_other() -> None:
    # Its lines run in the direction of the displacement: the normal is square to that.
    along = float(np.arctan2(SCENE.displacement[1], SCENE.displacement[0])) + np.pi / 2
    shift, error = measured(passes((along, 1.3)))
    known = np.isfinite(error)
    assert known.mean() > 0.7
    truth = np.where(SCENE.plane, 0, LENGTH)
    assert np.percentile(np.abs(shift - truth)[known], 95) < 0.15


def test_the_light_of_the_scene_is_found_in_its_own_displacements() -> None:
    found = find_epipole(SCENE.warp, np.full(SCENE.plane.shape, 0.05, np.float32), POSITIONS)
    assert found is not None
    assert np.abs((found.directions(POSITIONS) * DIRECTIONS).sum(axis=-1)) == pytest.approx(
        1, abs=1e-4
    )


def test_inputs_are_left_alone() -> None:
    scans = passes()
    before = [scan.times.own_time.copy() for scan in scans]
    measured(scans)
    for scan, kept in zip(scans, before, strict=True):
        assert np.array_equal(scan.times.own_time, kept, equal_nan=True)
