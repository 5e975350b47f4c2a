import numpy as np

from shadowtool.core.pictures import display, time_picture, warp_picture
from shadowtool.core.warp_map import WarpMap
from tests.core.test_shadow_lines import SCENE, edge_times, fitted
from tests.scene import Sweep


def test_times_and_lines_are_drawn_over_the_frame() -> None:
    sweep = Sweep(0.5)
    picture = time_picture(display(SCENE.lit), edge_times(sweep), fitted(sweep), SCENE.plane)
    assert picture.shape == (90, 160, 3) and picture.dtype == np.uint8
    assert ((picture[..., 1] > 200) & (picture[..., 0] < 120)).sum() > 200


def test_a_pass_without_times_is_drawn_too() -> None:
    nothing = np.full((90, 160), np.nan, np.float32)
    assert time_picture(display(SCENE.lit), nothing, fitted(Sweep(0.5))).shape == (90, 160, 3)


def test_the_grid_breaks_at_the_block() -> None:
    solved = WarpMap(SCENE.warp, np.zeros((90, 160), np.float32))
    picture = warp_picture(SCENE.lit, solved)
    assert picture.shape == (90, 320, 3)
    grid = (picture[:, :160] == (60, 230, 90)).all(axis=-1)
    # On the plane the grid's lines are straight: row 15 in full, and broken across the block.
    assert grid[15, :58].all()
    assert not grid[47, 61:99].all()


def test_unknown_maps_are_drawn_dark() -> None:
    nothing = WarpMap(
        np.full((20, 30, 2), np.nan, np.float32), np.full((20, 30), np.inf, np.float32)
    )
    assert warp_picture(np.ones((20, 30, 3), np.float32), nothing).max() <= 235
