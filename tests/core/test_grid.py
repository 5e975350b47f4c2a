"""The thin grid by which a take is looked over."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shadowtool.core.grid import full_size, grid_step, on_grid


@given(st.integers(1, 5000), st.integers(1, 5000))
def test_the_grid_has_some_three_hundred_points_along_the_longer_side(
    width: int, height: int
) -> None:
    step = grid_step(width, height)
    assert step >= 1
    points = -(-max(width, height) // step)
    assert points <= 480 and (step == 1 or points >= 240)


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 9))
def test_the_grid_is_every_so_many_pixels(width: int, height: int, step: int) -> None:
    image = np.arange(width * height * 3, dtype=np.float16).reshape(height, width, 3)
    grid = on_grid(image, step)
    assert grid.dtype == np.float32 and grid.flags.c_contiguous
    for y, x in ((0, 0), (grid.shape[0] - 1, grid.shape[1] - 1)):
        assert np.array_equal(grid[y, x], image[y * step, x * step].astype(np.float32))
    assert (grid.shape[0] - 1) * step < height <= grid.shape[0] * step


@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 9), st.integers(0, 9))
def test_every_pixel_is_held_out_as_its_nearest_grid_point_is(
    width: int, height: int, step: int, seed: int
) -> None:
    shape = on_grid(np.zeros((height, width, 3), np.float32), step).shape[:2]
    mask = np.random.default_rng(seed).random(shape) < 0.5
    wide = full_size(mask, width, height, step)
    assert wide.shape == (height, width) and wide.dtype == np.uint8 and wide.flags.c_contiguous
    rows, columns = (
        np.minimum((np.arange(size) + step // 2) // step, points - 1)
        for size, points in ((height, shape[0]), (width, shape[1]))
    )
    assert np.array_equal(wide, np.where(mask[np.ix_(rows, columns)], 255, 0))
