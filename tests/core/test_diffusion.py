import numpy as np
import pytest

from shadowtool.core.diffusion import diffuse
from shadowtool.core.warp_map import WarpMap, identity_map
from tests.scene import Scene

SCENE = Scene()


def noisy_map(sigma: float = 0.3, error: float = 0.3, seed: int = 0) -> WarpMap:
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=SCENE.warp.shape).astype(np.float32) * np.float32(sigma)
    return WarpMap(SCENE.warp + noise, np.full(SCENE.warp.shape[:2], error, np.float32))


def distance(warp: np.ndarray) -> np.ndarray:
    return np.linalg.norm(warp - SCENE.warp, axis=-1)


def test_noise_is_smoothed() -> None:
    noisy = noisy_map()
    assert distance(diffuse(noisy).warp).mean() < 0.35 * distance(noisy.warp).mean()


def test_the_step_of_an_object_stays_sharp() -> None:
    smooth = diffuse(noisy_map(0.1))
    rows, columns = SCENE.rows, SCENE.columns
    inside = smooth.warp[rows[0] : rows[1], columns[0] : columns[1]]
    expected = SCENE.warp[rows[0] : rows[1], columns[0] : columns[1]]
    assert np.linalg.norm(inside - expected, axis=-1).max() < 0.5


def test_unknown_pixels_are_filled_and_say_so() -> None:
    known = noisy_map(0.0)
    warp, error = known.warp.copy(), known.error.copy()
    warp[70:80, 20:40] = np.nan
    error[70:80, 20:40] = np.inf
    filled = diffuse(WarpMap(warp, error))
    assert np.isfinite(filled.warp).all()
    assert distance(filled.warp)[70:80, 20:40].max() < 0.1
    assert np.isinf(filled.error[70:80, 20:40]).all()
    assert (filled.confidence[70:80, 20:40] == 0).all()


def test_where_no_sweep_went_is_the_plane_and_a_hole_is_what_is_around_it() -> None:
    known = noisy_map(0.0)
    unknown = np.zeros(known.error.shape, bool)
    # A strip along the frame's edge that cuts the block, with a crack from it to a hole within.
    unknown[: SCENE.rows[0] + 8] = True
    hole = slice(SCENE.rows[0] + 14, SCENE.rows[0] + 20), slice(70, 80)
    unknown[hole] = unknown[SCENE.rows[0] + 8 : SCENE.rows[0] + 14, 75] = True
    warp = np.where(unknown[..., None], np.float32(np.nan), known.warp)
    error = np.where(unknown, np.float32(np.inf), known.error)
    filled = diffuse(WarpMap(warp, error), iterations=0, plane_beyond=True).warp
    identity = identity_map(SCENE.height, SCENE.width)
    assert np.array_equal(filled[: SCENE.rows[0] + 8], identity[: SCENE.rows[0] + 8])
    assert distance(filled)[hole].max() < 0.5
    on = diffuse(WarpMap(warp, error), iterations=0).warp - identity
    assert np.linalg.norm(on[SCENE.rows[0], 75]) > 3


def test_a_lone_pixel_at_the_frames_edge_is_no_place_where_no_sweep_went() -> None:
    identity = identity_map(40, 60)
    warp, error = identity + np.float32([9, 0]), np.full((40, 60), 0.1, np.float32)
    unknown = np.random.default_rng(0).random((40, 60)) < 0.03
    warp[unknown], error[unknown] = np.nan, np.inf
    filled = diffuse(WarpMap(warp, error), iterations=0, plane_beyond=True).warp
    assert filled == pytest.approx(identity + np.float32([9, 0]), abs=0.1)


def test_what_is_well_known_is_not_moved_by_what_is_not() -> None:
    known = noisy_map(0.0, 0.05)
    warp, error = known.warp.copy(), known.error.copy()
    warp[:, 120:] += 1.0
    error[:, 120:] = 50.0
    smooth = diffuse(WarpMap(warp, error))
    assert distance(smooth.warp)[:, :118].max() < 0.15
    assert distance(smooth.warp)[10:80, 121].mean() < 0.7


def test_a_bump_flows_to_all_four_sides_alike() -> None:
    still = identity_map(9, 9)
    warp = still.copy()
    warp[4, 4, 0] += 0.5
    bump = diffuse(WarpMap(warp, np.ones((9, 9), np.float32)), iterations=1).warp - still
    around = [bump[y, x, 0] for y, x in ((3, 4), (5, 4), (4, 3), (4, 5))]
    assert around == pytest.approx([around[0]] * 4, abs=1e-6)
    assert around[0] > 0.04
    assert bump[..., 0].sum() == pytest.approx(0.5, abs=1e-5)


def test_rows_worked_on_at_a_time_leave_no_seam() -> None:
    rng = np.random.default_rng(2)
    warp = identity_map(300, 9) + rng.normal(size=(300, 9, 2)).astype(np.float32)
    error = rng.uniform(0.1, 2, (300, 9)).astype(np.float32)
    whole = diffuse(WarpMap(warp, error), iterations=6).warp
    # Each of the two parts is small enough to be worked on at once, and far from its cut as before.
    for kept, cut in ((slice(0, 90), slice(0, 100)), (slice(120, 180), slice(110, 190))):
        part = diffuse(WarpMap(warp[cut] - (0, cut.start), error[cut]), iterations=6).warp
        inner = slice(kept.start - cut.start, kept.stop - cut.start)
        assert part[inner] + (0, cut.start) == pytest.approx(whole[kept], abs=1e-4)


def test_nothing_known_stays_unknown() -> None:
    nothing = WarpMap(np.full((8, 9, 2), np.nan, np.float32), np.full((8, 9), np.inf, np.float32))
    assert np.isnan(diffuse(nothing).warp).all()


def test_no_iterations_only_fill() -> None:
    noisy = noisy_map()
    assert diffuse(noisy, iterations=0).warp == pytest.approx(noisy.warp, abs=1e-4)


def test_the_identity_stays_exactly() -> None:
    identity = WarpMap(identity_map(20, 30), np.zeros((20, 30), np.float32))
    assert np.array_equal(diffuse(identity).warp, identity.warp)
