from dataclasses import replace

import cv2
import numpy as np
import pytest

from shadowtool.core.backdrop import Backdrop
from shadowtool.core.detection import Found, changed, find_figure, texture_evidence
from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN
from tests.figures import BACKDROP, DARK, KNOWN, SCENE, disk, shot, strand

REACH = 4
NOTHING = np.full(KNOWN.shape, UNKNOWN, np.uint8)


def found_in(image: np.ndarray, backdrop: Backdrop = BACKDROP, hint: np.ndarray = NOTHING) -> Found:
    return find_figure(image, backdrop, backdrop.nearest(image), KNOWN, hint, KNOWN.size, REACH)


@pytest.mark.parametrize("soft", [1, 6, 40])
@pytest.mark.parametrize("seed", range(3))
def test_a_shadow_is_no_figure(soft: float, seed: int) -> None:
    image = SCENE.noisy(SCENE.image(SCENE.disk(80, 50, radius=25, soft=soft)), seed)
    assert not found_in(image).maybe.any()


@pytest.mark.parametrize("deeper", [0.6, 0.8])
def test_ground_that_loses_some_of_the_sky_is_no_figure(deeper: float) -> None:
    beta = SCENE.disk(80, 50, radius=25, soft=6)
    image = SCENE.image(beta)
    image[40:60, 70:90] *= np.float32(deeper)
    assert not found_in(SCENE.noisy(image, 2)).mask.any()


@pytest.mark.parametrize("lit", [True, False])
def test_a_figure_is_found_to_the_pixel_in_light_and_in_shadow(lit: bool) -> None:
    alpha = disk(70, 50, 20)
    beta = None if lit else SCENE.disk(70, 50, radius=40, soft=6)
    mask = found_in(shot(alpha, beta).image).mask
    assert mask[alpha == 1].all()
    assert not mask[alpha == 0].any()


def test_dark_clothes_in_shadow_are_told_from_it_by_the_texture_that_they_hide() -> None:
    alpha = disk(70, 50, 20)
    mask = found_in(shot(alpha, SCENE.disk(70, 50, radius=40, soft=6), DARK).image).mask
    assert mask[alpha == 1].mean() > 0.99
    assert not mask[disk(70, 50, 22) == 0].any()


@pytest.mark.parametrize("radius", [0, 3, 12])
def test_what_looks_like_shadow_is_figure_where_there_is_none_around(radius: int) -> None:
    # The rim of the figure looks nearly like ground in shadow, and no texture tells them apart.
    alpha = disk(70, 50, 20)
    even = np.full_like(SCENE.lit, 0.5)
    backdrop = Backdrop(even, even / 4, BACKDROP.noise, BACKDROP.doubt)
    rim = (alpha == 1) & (disk(67, 50, 18) == 0)
    image = np.where(alpha[..., None] == 1, np.float32([0.05, 0.1, 0.6]), even)
    image[rim] = [0.21, 0.2, 0.195]
    image[disk(94 + radius, 50, radius) >= 1] = 0.125
    mask = found_in(SCENE.noisy(image, 1), backdrop).mask
    assert (mask[rim].mean() > 0.95) == (radius == 0)


def near_the_line(place: np.ndarray) -> np.ndarray:
    """Ground without texture, and something as dark as its shade that is of a little other hue."""
    even = np.full_like(SCENE.lit, 0.5)
    shade = np.float32([0.125, 0.125, 0.125])
    # Three standard deviations off the line, on either side of it.
    off = 3 * EVEN.noise.sigma(shade) * np.float32([1, -1, 0]) / np.sqrt(2)
    image = np.where(disk(70, 50, 20)[..., None] == 1, np.float32([0.05, 0.1, 0.6]), even)
    return SCENE.noisy(np.where(place[..., None], shade + off, image).astype(np.float32), 3)


EVEN = replace(BACKDROP, lit=np.full_like(SCENE.lit, 0.5), shadow=np.full_like(SCENE.lit, 0.125))
CLOTHES, SLIVER = np.zeros_like(KNOWN), np.zeros_like(KNOWN)
CLOTHES[62:86, 60:80] = True
SLIVER[69:72, 60:80] = True


def test_many_pixels_together_tell_clothes_from_shade_of_nearly_their_colour() -> None:
    # A shadow beside them, lest they be told by there being none.
    image = near_the_line(CLOTHES)
    image[40:80, 95:120] = SCENE.noisy(EVEN.shadow, 4)[40:80, 95:120]
    mask = found_in(image, EVEN).mask
    assert mask[CLOTHES].mean() > 0.9
    assert mask[40:80, 95:120].mean() < 0.01


def leaking() -> np.ndarray:
    """A large soft shadow, and a long one over whose sharp edges colour leaks for a few pixels."""
    beta = SCENE.disk(110, 70, radius=22, soft=16).astype(np.float32)
    beta[12:21, 20:140] = 0
    coarse = beta + np.float32(0.15) * (cv2.GaussianBlur(beta, (0, 0), 2) - beta)
    beta = np.dstack([coarse, beta, coarse])
    return SCENE.noisy((beta * EVEN.lit + (1 - beta) * EVEN.shadow).astype(np.float32), 2)


def test_edges_of_shade_over_which_colour_leaks_are_no_figure() -> None:
    assert not found_in(leaking(), EVEN).mask.any()


@pytest.mark.parametrize("y", [30, 40])
def test_something_small_beside_such_shade_is_figure(y: int) -> None:
    image, ball = leaking(), disk(70, y, 5) == 1
    image[ball] = SCENE.noisy(np.full_like(image, 0.3) * np.float32([0.2, 0.5, 1.5]), 5)[ball]
    mask = found_in(image, EVEN).mask
    assert mask[ball].mean() > 0.95
    assert not mask[disk(70, y, 12) == 0].any()


def test_a_few_pixels_do_not() -> None:
    image = near_the_line(SLIVER)
    image[40:80, 95:120] = SCENE.noisy(EVEN.shadow, 4)[40:80, 95:120]
    assert found_in(image, EVEN).mask[SLIVER].mean() < 0.5


def test_where_errors_are_those_of_blocks_they_do_not_add_up() -> None:
    image = near_the_line(CLOTHES)
    image[40:80, 95:120] = SCENE.noisy(EVEN.shadow, 4)[40:80, 95:120]
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.random((13, 20, 1)) < 0.1, np.ones((8, 8, 1)))[: len(image)]
    hue = 2.5 * EVEN.noise.sigma(EVEN.lit) * np.float32([1, -1, 0])
    lit = found_in(EVEN.lit + blocks * hue, EVEN)
    assert not lit.mask.any()
    blocky = np.where(CLOTHES[..., None], image, image + blocks * hue).astype(np.float32)
    assert found_in(blocky, EVEN).mask[CLOTHES].mean() < found_in(image, EVEN).mask[CLOTHES].mean()


def test_a_hair_hangs_on_the_head() -> None:
    head = disk(60, 60, 16)
    hair = strand((60, 60), (110, 20), 0.8)
    found = found_in(shot(np.maximum(head, hair)).image)
    middle = (hair >= 0.5) & (disk(60, 60, 20) == 0)
    assert found.maybe[middle].mean() > 0.95


def test_ground_that_a_figure_dims_is_no_figure() -> None:
    alpha = disk(70, 50, 20)
    even = np.full_like(SCENE.lit, 0.5)
    backdrop = Backdrop(even, even / 4, BACKDROP.noise, BACKDROP.doubt)
    image = np.where(disk(70, 50, 24)[..., None] > 0, even * np.float32([0.74, 0.76, 0.77]), even)
    image = np.where(alpha[..., None] == 1, np.float32([0.05, 0.1, 0.6]), image)
    mask = found_in(SCENE.noisy(image, 1), backdrop).mask
    assert mask[alpha < 1].mean() < 0.001


def test_ground_is_seen_through_a_narrow_gap() -> None:
    alpha = disk(70, 50, 20)
    alpha[50:75, 64:66] = 0
    # In about the ground's colour evidence is shared across the gap.
    mask = found_in(shot(alpha, colour=np.float32([0.5, 0.45, 0.5])).image).mask
    assert mask[50:65, 64:66].mean() < 0.2
    assert mask[alpha == 1].mean() > 0.99


def test_specks_are_no_figure_and_a_pinhole_is_none_in_it() -> None:
    alpha = disk(70, 50, 20)
    alpha[10, 10], alpha[50, 70] = 1, 0
    mask = found_in(shot(alpha).image).mask
    assert not mask[10, 10]
    assert mask[50, 70]


def test_pixels_of_which_nothing_is_known_follow_their_neighbours() -> None:
    alpha = disk(70, 50, 20)
    unknown = np.zeros_like(KNOWN)
    unknown[48:52, 68:72] = unknown[10:14, 10:14] = True
    image = shot(alpha).image
    image[unknown] = 0
    mask = find_figure(
        image, BACKDROP, BACKDROP.nearest(image), unknown, NOTHING, KNOWN.size, REACH
    ).mask
    assert mask[48:52, 68:72].all() and not mask[10:14, 10:14].any()


def test_a_hint_decides_where_the_frame_says_nothing_and_nowhere_else() -> None:
    even = np.full_like(SCENE.lit, 0.5)
    backdrop = Backdrop(even, even / 4, BACKDROP.noise, BACKDROP.doubt)
    figure, hole = disk(60, 50, 20) > 0, disk(60, 50, 8) > 0
    image = np.where(figure[..., None] & ~hole[..., None], np.float32([0.1, 0.2, 0.6]), even)
    hint = np.where(figure, FIGURE, BACKGROUND)
    assert found_in(image, backdrop, hint).mask[hole].mean() < 0.1
    dark = np.where(hole[..., None], np.float32(0.2), image)
    assert found_in(dark, backdrop, hint).mask[hole].all()
    assert not found_in(even, backdrop, hint).mask.any()


def around(evidence: np.ndarray) -> np.ndarray:
    return cv2.blur(evidence, (9, 9))


def test_texture_shows_through_any_shadow_and_not_through_a_figure() -> None:
    shadow = SCENE.image(SCENE.disk(80, 50, 30, soft=20))
    showing = texture_evidence(SCENE.noisy(shadow, 1), BACKDROP)
    assert (around(showing) < 0).mean() > 0.98
    covered = texture_evidence(shot(np.ones(KNOWN.shape)).image, BACKDROP)
    assert (around(covered) > 0).mean() > 0.98


def test_the_edges_of_a_shadow_say_nothing_of_texture() -> None:
    sharp = SCENE.disk(80, 50, 30, soft=1)
    edge = (sharp > 0.02) & (sharp < 0.98)
    evidence = texture_evidence(SCENE.image(sharp), BACKDROP)
    assert np.abs(evidence[edge]).mean() < np.abs(evidence[~edge]).mean()
    assert (around(evidence) < 0).mean() > 0.98


def test_ground_without_texture_says_nothing() -> None:
    even = np.full_like(SCENE.lit, 0.5)
    evidence = texture_evidence(even, Backdrop(even, even / 4, BACKDROP.noise, BACKDROP.doubt))
    assert evidence == pytest.approx(0, abs=1e-4)


def test_lit_ground_has_not_changed_and_a_shadow_has() -> None:
    beta = SCENE.disk(80, 50, radius=20)
    change = changed(SCENE.noisy(SCENE.image(beta), 5), BACKDROP)
    assert change[beta < 0.5].all()
    assert not change[SCENE.disk(80, 50, radius=27) == 1].any()
