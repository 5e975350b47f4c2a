import numpy as np
import pytest

from shadowtool.core.known_background import colours, ground_beta, solve
from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN, Prior
from tests.figures import BACKDROP, BLUE, KNOWN, NOISE, SCENE, Shot, disk, shot

DISK = disk(70, 50, 20)
SHADE = SCENE.disk(95, 50, radius=30, soft=8)


def trimap_of(alpha: np.ndarray, band: int = 1) -> np.ndarray:
    """The trimap of a disk in the middle of `DISK`: what is mixed and a little more is unknown."""
    trimap = np.full(alpha.shape, UNKNOWN, np.uint8)
    trimap[disk(70, 50, 20 - band - 1) == 1] = FIGURE
    trimap[disk(70, 50, 20 + band) == 0] = BACKGROUND
    return trimap


def behind(given: Shot, trimap: np.ndarray) -> np.ndarray:
    return ground_beta(BACKDROP.nearest(given.image).beta, trimap == BACKGROUND)


def searched(
    seen: np.ndarray, figure: np.ndarray, ground: np.ndarray, shift: np.ndarray
) -> tuple[float, float]:
    """The most probable alpha and β of one pixel: every pair tried in turn.

    β is counted from what is expected, and spread by 0.02.
    """
    alphas, betas = np.meshgrid(np.linspace(0, 1, 1001), np.linspace(-0.2, 0.2, 401), indexing="ij")
    mixed = alphas[..., None] * figure + (1 - alphas[..., None]) * (
        ground + betas[..., None] * shift
    )
    variance = NOISE.sigma(seen) ** 2 + (alphas[..., None] * (0.08 * figure + 0.002)) ** 2
    variance = variance + ((1 - alphas[..., None]) * 0.01 * ground) ** 2
    cost = ((seen - mixed) ** 2 / variance).sum(axis=-1) + (betas / 0.02) ** 2
    best = np.unravel_index(np.argmin(cost), cost.shape)
    return float(alphas[best]), float(betas[best])


@pytest.mark.parametrize("true", [0.1, 0.4, 0.7, 0.95])
def test_alpha_is_that_which_a_search_finds(true: float) -> None:
    alpha = np.where(DISK == 1, 1.0, 0.0)
    alpha[50, 91] = true
    given = shot(alpha, colour=BLUE)
    trimap = np.where(alpha == 1, FIGURE, BACKGROUND).astype(np.uint8)
    trimap[50, 91] = UNKNOWN
    lit = np.ones_like(SHADE)
    found = solve(given.image, trimap, lit, BACKDROP).alpha[50, 91]
    expected, _ = searched(
        given.image[50, 91],
        given.foreground[50, 89],
        SCENE.lit[50, 91],
        SCENE.lit[50, 91] - SCENE.shadow[50, 91],
    )
    assert found == pytest.approx(expected, abs=0.03)
    assert found == pytest.approx(true, abs=0.08)


@pytest.mark.parametrize("beta", [None, SHADE, np.zeros_like(SHADE)])
def test_alpha_in_light_in_shadow_and_across_its_edge(beta: np.ndarray | None) -> None:
    given = shot(DISK, beta)
    trimap = trimap_of(DISK)
    found = solve(given.image, trimap, behind(given, trimap), BACKDROP)
    assert np.abs(found.alpha - DISK)[trimap == UNKNOWN].mean() < 0.03
    assert (found.alpha[trimap == FIGURE] == 1).all()
    assert (found.alpha[trimap == BACKGROUND] == 0).all()


def test_many_pixels_are_solved_as_few_are(monkeypatch: pytest.MonkeyPatch) -> None:
    given = shot(DISK, SHADE)
    trimap = trimap_of(DISK)
    whole = solve(given.image, trimap, behind(given, trimap), BACKDROP)
    monkeypatch.setattr("shadowtool.core.known_background._BLOCK", 7)
    parts = solve(given.image, trimap, behind(given, trimap), BACKDROP)
    for one, other in zip(whole, parts, strict=True):
        assert one == pytest.approx(other, abs=1e-5)


def test_the_error_that_it_predicts_is_the_one_it_makes() -> None:
    given = shot(DISK, SHADE)
    trimap = trimap_of(DISK)
    found = solve(given.image, trimap, behind(given, trimap), BACKDROP)
    mixed = (DISK > 0.05) & (DISK < 0.95)
    off = (found.alpha - DISK)[mixed] / np.maximum(found.error[mixed], 0.01)
    assert np.mean(np.abs(off) < 3) > 0.9


def test_a_prior_decides_where_the_figure_looks_like_the_ground() -> None:
    ground = SCENE.lit.mean(axis=(0, 1))
    even = SCENE.lit * 0 + ground
    backdrop = type(BACKDROP)(even, even / 4, NOISE, BACKDROP.doubt)
    trimap = trimap_of(DISK)
    ones = np.ones_like(SHADE)
    for expected in (0.2, 0.9):
        prior = Prior(np.float32(expected) * ones, np.float32(0.05) * ones)
        found = solve(even, trimap, ones, backdrop, prior)
        assert found.alpha[trimap == UNKNOWN] == pytest.approx(expected, abs=0.02)


def test_colours_have_nothing_of_the_ground() -> None:
    given = shot(DISK, SHADE)
    trimap = trimap_of(DISK)
    for foreground in (
        solve(given.image, trimap, behind(given, trimap), BACKDROP).foreground,
        colours(given.image, given.alpha, behind(given, trimap), BACKDROP),
    ):
        rim = (DISK > 0.3) & (DISK < 1)
        assert np.abs(foreground - given.foreground)[rim].mean() < 0.02
        assert (foreground >= 0).all()


def test_colours_of_a_figure_that_is_nowhere_opaque() -> None:
    given = shot(0.5 * DISK)
    found = colours(given.image, given.alpha, np.ones_like(SHADE), BACKDROP)
    assert np.isfinite(found).all() and (found[DISK == 0] == 0).all()


@pytest.mark.parametrize("value", [BACKGROUND, UNKNOWN])
def test_without_a_part_that_is_sure_there_is_no_figure(value: int) -> None:
    trimap = np.full(KNOWN.shape, value, np.uint8)
    found = solve(SCENE.lit, trimap, np.ones_like(SHADE), BACKDROP)
    assert (found.alpha == 0).all() and (found.foreground == 0).all()


def test_ground_goes_on_behind_the_figure() -> None:
    ground = DISK == 0
    found = ground_beta(np.where(ground, SHADE, np.float32(7)), ground)
    assert np.array_equal(found[ground], SHADE[ground])
    assert found.max() <= 1
    assert (ground_beta(SHADE, np.zeros_like(ground)) == 1).all()
