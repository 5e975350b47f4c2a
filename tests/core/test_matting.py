import numpy as np
import pytest

from shadowtool.core.beta import shadow_matte
from shadowtool.core.color_line import line_distance
from shadowtool.core.matting import (
    BACKGROUND,
    FIGURE,
    difference_alpha,
    difference_trimap,
    figure_distance,
    pull_figure,
)
from shadowtool.core.noise import NoiseModel
from tests.scene import Scene

SCENE = Scene()
NOISE = NoiseModel(np.full(3, 4.5e-5), np.full(3, 1e-6))


def distance_of(image: np.ndarray) -> np.ndarray:
    return line_distance(image, SCENE.lit, SCENE.shadow, NOISE, 0.01)


def shot(seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """A blue figure before a shadow, and its true alpha."""
    alpha = 1 - SCENE.disk(50, 45, radius=15, soft=2)
    background = SCENE.image(SCENE.disk(80, 45, radius=20))
    colour = np.float32([0.05, 0.1, 0.9])
    image = alpha[..., None] * colour + (1 - alpha[..., None]) * background
    return SCENE.noisy(image, seed), alpha


def test_background_in_any_shadow_lies_on_the_line() -> None:
    image = SCENE.noisy(SCENE.image(SCENE.disk(80, 45, radius=30, soft=40)), 2)
    assert np.percentile(distance_of(image), 99) < 5


def test_brighter_than_lit_and_darker_than_shadow_are_off_the_line() -> None:
    assert (distance_of(SCENE.lit * 1.5) > 8).all()
    assert (distance_of(SCENE.shadow * 0.2) > 8).mean() > 0.99


def test_unknown_plates_say_nothing_of_a_figure() -> None:
    nothing = np.full_like(SCENE.lit, np.nan)
    assert (line_distance(SCENE.lit, nothing, SCENE.shadow, NOISE, 0.01) == 0).all()


def test_the_trimap_is_right_where_it_is_sure() -> None:
    image, alpha = shot()
    trimap = difference_trimap(distance_of(image))
    assert (alpha[trimap == FIGURE] > 0.99).all()
    assert (alpha[trimap == BACKGROUND] < 0.01).all()
    assert (trimap == FIGURE).sum() > 0.5 * alpha.sum()


def test_an_empty_scene_has_no_figure() -> None:
    image = SCENE.noisy(SCENE.image(SCENE.disk(80, 45, radius=20)), 3)
    distance = distance_of(image)
    trimap = difference_trimap(distance)
    assert (trimap == BACKGROUND).all()
    assert (difference_alpha(distance, trimap) == 0).all()


def test_alpha_keeps_what_the_trimap_is_sure_of() -> None:
    image, alpha = shot()
    distance = distance_of(image)
    trimap = difference_trimap(distance)
    found = difference_alpha(distance, trimap)
    assert (found[trimap == FIGURE] == 1).all() and (found[trimap == BACKGROUND] == 0).all()
    assert np.abs(found - alpha).mean() < 0.02


def test_the_figure_over_its_own_background_is_the_picture() -> None:
    image, alpha = shot()
    background = SCENE.image(SCENE.disk(80, 45, radius=20))
    figure = pull_figure(image, alpha, background)
    again = figure.foreground + (1 - alpha[..., None]) * background
    solid = alpha > 0
    assert again[solid] == pytest.approx(np.maximum(image, 0)[solid], abs=0.02)
    assert (figure.foreground[alpha == 0] == 0).all()
    assert (figure.foreground >= 0).all()


def dark_patch(beta: np.ndarray) -> np.ndarray:
    """How much of a patch that is darker than S, on ground under β, is taken for figure."""
    image = SCENE.image(beta)
    image[40:50, 70:80] = np.float32(0.8) * SCENE.shadow[40:50, 70:80]
    found = shadow_matte(image, SCENE.lit, SCENE.shadow)
    distance = figure_distance(image, found, SCENE.lit, SCENE.shadow, NOISE)
    return (distance[41:49, 71:79] > 4).mean()


def test_what_is_darker_than_shadow_is_a_figure_on_lit_ground_and_shadow_within_shadow() -> None:
    assert dark_patch(np.ones((90, 160), np.float32)) > 0.9
    assert dark_patch(np.zeros((90, 160), np.float32)) == 0
