import numpy as np
import pytest

from shadowtool.core.matting import (
    HIDDEN,
    Figure,
    colour_figure,
    pull_figure,
    without_figure,
)
from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN
from tests.figures import (
    BACKDROP,
    BLUE,
    DARK,
    KNOWN,
    SCENE,
    Shot,
    disk,
    in_motion,
    shot,
    strand,
)

DISK = disk(70, 50, 20)
FOOT = SCENE.disk(95, 62, radius=22, soft=2)


def pulled(given: Shot, drawn: np.ndarray | None = None) -> Figure:
    return pull_figure(given.image, BACKDROP, KNOWN, drawn)


def error(found: Figure, given: Shot) -> float:
    """Mean error of alpha, per mixed pixel."""
    mixed = (given.alpha > 0) & (given.alpha < 1)
    return float(np.abs(found.alpha - given.alpha).sum() / mixed.sum())


@pytest.mark.parametrize(
    ("colour", "beta", "most"),
    # Dark clothes before a shadow are told from it by little.
    [(BLUE, None, 0.1), (BLUE, FOOT, 0.1), (DARK, None, 0.1), (DARK, FOOT, 0.3)],
    ids=["blue, lit", "blue, shadow", "dark, lit", "dark, shadow"],
)
def test_alpha_of_a_sharp_edge(colour: np.ndarray, beta: np.ndarray | None, most: float) -> None:
    given = shot(DISK, beta, colour)
    assert error(pulled(given), given) < most


def test_alpha_of_a_limb_in_motion() -> None:
    given = shot(in_motion(lambda t: strand((55 + 5 * t, 15), (75 + 5 * t, 85), 14)), FOOT)
    found = pulled(given)
    assert error(found, given) < 0.12
    blurred = (given.alpha > 0.2) & (given.alpha < 0.8)
    assert np.abs(found.alpha - given.alpha)[blurred].mean() < 0.15


def test_hair_stays_fractional() -> None:
    hair = np.max(
        [strand((60, 55), (60 + 45 * np.cos(a), 55 - 45 * np.sin(a)), 0.7) for a in (0.6, 1.2, 2)],
        axis=0,
    )
    given = shot(np.maximum(disk(60, 55, 18), hair), FOOT)
    found = pulled(given)
    strands = (hair > 0.2) & (disk(60, 55, 22) == 0)
    assert np.abs(found.alpha - given.alpha)[strands].mean() < 0.15
    assert (found.trimap[strands] == UNKNOWN).mean() > 0.9


def test_what_is_mixed_lies_in_the_unknown_band() -> None:
    given = shot(DISK, FOOT)
    trimap = pulled(given).trimap
    mixed = (DISK > 0.02) & (DISK < 0.98)
    assert (trimap[mixed] == UNKNOWN).mean() > 0.98
    assert (trimap == UNKNOWN).sum() < 5.5 * 2 * np.pi * 20


def test_shadow_is_not_taken_for_figure() -> None:
    given = shot(DISK, FOOT)
    found = pulled(given)
    shadow = (FOOT < 0.5) & (DISK == 0)
    assert (found.alpha[shadow] > 0.5).mean() < 0.002
    assert found.alpha[shadow].mean() < 0.005


@pytest.mark.parametrize("over", [0.0, 0.2, 1.0])
def test_no_halo_over_black_green_and_white(over: float) -> None:
    given = shot(DISK, FOOT)
    found = pulled(given)
    ground = np.float32([0, over, 0]) if over == 0.2 else np.full(3, over, np.float32)
    cover = given.alpha[..., None]
    true = cover * given.foreground + (1 - cover) * ground
    shown = found.foreground + (1 - found.alpha[..., None]) * ground
    mixed = (DISK > 0) & (DISK < 1)
    assert np.sqrt(np.mean((shown - true)[mixed] ** 2)) < 0.05


def test_over_its_own_ground_the_figure_is_the_frame_again() -> None:
    given = shot(DISK, FOOT)
    found = pulled(given)
    again = found.foreground + (1 - found.alpha[..., None]) * given.background
    sigma = 0.003 * np.sqrt(np.maximum(given.image, 0.01) / 0.18)
    off = np.abs(again - given.image)[DISK > 0] / sigma[DISK > 0]
    assert np.percentile(off, 95) < 4


@pytest.mark.parametrize("beta", [None, FOOT], ids=["lit", "shadow"])
def test_without_a_figure_there_is_none(beta: np.ndarray | None) -> None:
    found = pulled(shot(0 * DISK, beta))
    assert not found.alpha.any() and not found.foreground.any() and not found.trimap.any()


def test_a_figure_cut_by_the_frame() -> None:
    given = shot(disk(0, 99, 40), FOOT)
    found = pulled(given)
    assert found.alpha[99, 0] == 1
    assert error(found, given) < 0.1


def test_a_drawn_trimap_is_kept_and_closes_what_is_open() -> None:
    given = shot(DISK, FOOT, seed=2)
    drawn = np.full(KNOWN.shape, UNKNOWN, np.uint8)
    drawn[disk(70, 50, 15) == 1], drawn[disk(70, 50, 26) == 0] = FIGURE, BACKGROUND
    drawn[45:55, 60:64] = BACKGROUND
    drawn[10:14, 10:14] = FIGURE
    found = pulled(given, drawn)
    assert (found.trimap[drawn != UNKNOWN] == drawn[drawn != UNKNOWN]).all()
    assert (found.trimap == UNKNOWN).sum() < 0.7 * (drawn == UNKNOWN).sum()
    assert (found.alpha[drawn == FIGURE] == 1).all()
    assert (found.alpha[drawn == BACKGROUND] == 0).all()
    rim = (DISK > 0) & (DISK < 1)
    assert np.abs(found.alpha - DISK)[rim].mean() < 0.1


def test_a_given_alpha_is_kept_and_coloured() -> None:
    given = shot(DISK, FOOT)
    found = colour_figure(given.image, BACKDROP, KNOWN, given.alpha)
    assert np.array_equal(found.alpha, given.alpha)
    assert np.abs(found.foreground - DISK[..., None] * given.foreground).max() < 0.05
    none = colour_figure(given.image, BACKDROP, KNOWN, 0 * given.alpha)
    assert not none.foreground.any() and not none.trimap.any()


def test_unknown_pixels_are_black_and_harm_nobody() -> None:
    given = shot(DISK, FOOT)
    image = given.image.copy()
    image[40:44, 60:64] = np.nan
    image[5, 5, 0] = np.inf
    found = pulled(Shot(image, given.alpha, given.foreground, given.beta))
    assert np.isfinite(found.foreground).all() and np.isfinite(found.alpha).all()
    assert not found.foreground[40:44, 60:64].any()
    assert error(found, given) < 0.1


def test_the_same_frame_gives_the_same_bits() -> None:
    given = shot(DISK, FOOT)
    for one, other in zip(pulled(given), pulled(given), strict=True):
        assert np.array_equal(one, other)


def test_past_an_edge_the_ground_is_seen() -> None:
    given = shot(DISK, FOOT, noise=0)
    true = Figure(DISK[..., None] * given.foreground, given.alpha, np.zeros(KNOWN.shape, np.uint8))
    seen = given.alpha < HIDDEN
    assert without_figure(given.image, true)[seen] == pytest.approx(
        given.background[seen], abs=1e-4
    )
    assert np.array_equal(without_figure(given.image, true)[~seen], given.image[~seen])
