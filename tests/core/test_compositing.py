import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.compositing import over, shade, shadow_ratio
from tests.scene import Scene

SCENE = Scene()


def test_beta_one_gives_the_lit_plate_exactly_and_zero_the_shadow_plate() -> None:
    ones = np.ones(SCENE.lit.shape[:2], np.float32)
    assert np.array_equal(shade(SCENE.lit, SCENE.shadow, ones), SCENE.lit)
    assert np.array_equal(shade(SCENE.lit, SCENE.shadow, 0 * ones), SCENE.shadow)


def test_where_the_target_is_in_shade_already_nothing_darkens() -> None:
    beta = SCENE.disk(80, 45)
    assert shade(SCENE.shadow, SCENE.shadow, beta) == pytest.approx(SCENE.shadow, abs=1e-6)


def test_coloured_beta_acts_on_each_channel() -> None:
    beta = np.zeros_like(SCENE.lit)
    beta[..., 0] = 1
    result = shade(SCENE.lit, SCENE.shadow, beta)
    assert np.array_equal(result[..., 0], SCENE.lit[..., 0])
    assert np.array_equal(result[..., 1:], SCENE.shadow[..., 1:])


@given(hnp.arrays(np.float32, (3, 4), elements=st.floats(0, 1, width=32)))
def test_light_grows_with_beta(beta: np.ndarray) -> None:
    lit, shadow = SCENE.lit[:3, :4], SCENE.shadow[:3, :4]
    more = np.minimum(beta + np.float32(0.1), 1)
    assert (shade(lit, shadow, more) >= shade(lit, shadow, beta) - 1e-6).all()


def test_the_figure_covers_by_its_alpha() -> None:
    colour = np.full((2, 2, 3), 0.3, np.float32)
    alpha = np.float32([[0, 0.25], [0.5, 1]])
    premultiplied = colour * alpha[..., None]
    background = np.full((2, 2, 3), 0.9, np.float32)
    expected = 0.3 * alpha + 0.9 * (1 - alpha)
    assert over(premultiplied, alpha, background)[..., 0] == pytest.approx(expected)


def test_what_is_unknown_behind_the_figure_does_no_harm() -> None:
    background = np.full((1, 2, 3), np.nan, np.float32)
    figure = np.full((1, 2, 3), 0.3, np.float32)
    found = over(figure, np.float32([[1, 0.5]]), background)
    assert np.array_equal(found[0, 0], figure[0, 0])
    assert np.isnan(found[0, 1]).all()


def test_the_ratio_multiplies_the_lit_plate_into_shadow() -> None:
    shaded = shade(SCENE.lit, SCENE.shadow, SCENE.disk(80, 45))
    ratio = shadow_ratio(shaded, SCENE.lit)
    assert ratio * SCENE.lit == pytest.approx(shaded, abs=1e-6)


def test_the_ratio_is_one_where_the_lit_plate_is_black() -> None:
    assert (
        shadow_ratio(np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 3), np.float32)) == 1
    ).all()
