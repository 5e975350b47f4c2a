import numpy as np
import pytest

from shadowtool.core.inverse_map import compose, invert
from shadowtool.core.warp_map import WarpMap, identity_map

HEIGHT, WIDTH = 60, 90
IDENTITY = identity_map(HEIGHT, WIDTH)


def known(warp: np.ndarray, error: float = 0.1) -> WarpMap:
    return WarpMap(warp.astype(np.float32), np.full(warp.shape[:2], error, np.float32))


def bent() -> WarpMap:
    """A smooth map with an inverse: it moves and stretches by a few pixels."""
    x, y = IDENTITY[..., 0], IDENTITY[..., 1]
    return known(np.stack([x + 4 * np.sin(y / 9), y + 3 * np.cos(x / 11)], axis=-1))


def test_the_inverse_of_the_identity_is_the_identity() -> None:
    inverse = invert(known(IDENTITY))
    assert inverse.warp == pytest.approx(IDENTITY, abs=1e-5)
    assert inverse.error == pytest.approx(0.1)


def test_a_map_and_its_inverse_cancel() -> None:
    warp_map = bent()
    there_and_back = compose(warp_map, invert(warp_map))
    inside = (
        (warp_map.warp >= 1).all(axis=-1)
        & (warp_map.warp[..., 0] <= WIDTH - 2)
        & (warp_map.warp[..., 1] <= HEIGHT - 2)
    )
    sure = np.isfinite(there_and_back.error) & inside
    assert sure.sum() > 0.9 * inside.sum()
    assert np.abs(there_and_back.warp - IDENTITY)[sure].max() < 0.05


def test_of_a_fold_the_best_known_pixel_is_taken() -> None:
    x = IDENTITY[..., 0]
    # Both halves show the left half of the plane.
    folded = np.stack([np.where(x < 45, x, x - 45), IDENTITY[..., 1]], axis=-1)
    warp_map = known(folded)
    warp_map.error[:, 45:] = 0.5
    left = invert(warp_map).warp[5:50, 2:40]
    assert left == pytest.approx(IDENTITY[5:50, 2:40], abs=1e-4)
    warp_map.error[:, 45:] = 0.05
    right = invert(warp_map).warp[5:50, 2:40]
    assert right == pytest.approx(IDENTITY[5:50, 47:85], abs=1e-4)


def test_ground_that_no_pixel_shows_is_unknown() -> None:
    x = IDENTITY[..., 0]
    # An object shows ground 20 pixels further on; what it hides is seen nowhere.
    behind = np.stack([np.where((x >= 30) & (x < 50), x + 40, x), IDENTITY[..., 1]], axis=-1)
    inverse = invert(known(behind))
    assert np.isnan(inverse.warp[:, 31:49]).all() and np.isinf(inverse.error[:, 31:49]).all()
    assert np.isfinite(inverse.error[:, :29]).all()


def test_unknown_pixels_show_nothing() -> None:
    warp = IDENTITY.copy()
    warp[20:30, 20:30] = np.nan
    error = np.where(np.isnan(warp[..., 0]), np.inf, 0.1).astype(np.float32)
    inverse = invert(WarpMap(warp, error))
    assert np.isnan(inverse.warp[21:29, 21:29]).all()
    assert np.array_equal(np.isnan(inverse.warp[..., 0]), np.isinf(inverse.error))


def test_after_the_identity_or_before_it_a_map_is_itself() -> None:
    warp_map = bent()
    assert compose(known(IDENTITY), warp_map).warp == pytest.approx(warp_map.warp, abs=1e-4)
    assert compose(warp_map, known(IDENTITY)).warp == pytest.approx(warp_map.warp, abs=1e-4)
    assert compose(warp_map, known(IDENTITY, 0.0)).error == pytest.approx(warp_map.error)


def test_beyond_the_picture_the_first_map_stands() -> None:
    away = known(IDENTITY + np.float32([200, 0]))
    onward = compose(away, bent())
    assert np.array_equal(onward.warp, away.warp)
    assert np.array_equal(onward.error, away.error)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (2, 2)])
def test_tiny_pictures_have_inverses_of_their_size(shape: tuple[int, int]) -> None:
    inverse = invert(known(identity_map(*shape)))
    assert inverse.warp.shape == (*shape, 2) and inverse.error.shape == shape


def test_inputs_are_left_alone() -> None:
    warp_map, other = bent(), bent()
    compose(warp_map, invert(warp_map))
    assert np.array_equal(warp_map.warp, other.warp)
    assert np.array_equal(warp_map.error, other.error)


def test_bands_change_no_bit(narrow_bands) -> None:
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:60, :80]
    warp = identity_map(60, 80) + np.dstack([8 * np.sin(y / 9), 5 * np.cos(x / 11)])
    warp += rng.normal(0, 0.3, warp.shape)
    warp[rng.random((60, 80)) < 0.02] = np.nan
    error = rng.choice([0.1, 0.2, np.inf], (60, 80))
    folded = WarpMap(warp.astype(np.float32), error.astype(np.float32))
    whole = invert(folded)
    narrow_bands()
    narrow = invert(folded)
    np.testing.assert_array_equal(whole.warp, narrow.warp)
    np.testing.assert_array_equal(whole.error, narrow.error)
