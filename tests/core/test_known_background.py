import cv2
import numpy as np
import pytest

from shadowtool.core.backdrop import Backdrop
from shadowtool.core.known_background import colours, ground_beta, measure, solve
from shadowtool.core.noise import NoiseModel
from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN, Prior
from tests.figures import BACKDROP, BLUE, COLUMNS, KNOWN, NOISE, ROWS, SCENE, Shot, disk, shot

DISK = disk(70, 50, 20)
REACH = 4
OPEN = Prior(np.full(DISK.shape, 0.5, np.float32), np.full(DISK.shape, 0.3, np.float32))
SHADE = SCENE.disk(95, 50, radius=30, soft=8)


def trimap_of(alpha: np.ndarray, band: int = 1) -> np.ndarray:
    """The trimap of a disk in the middle of `DISK`: what is mixed and a little more is unknown."""
    trimap = np.full(alpha.shape, UNKNOWN, np.uint8)
    trimap[disk(70, 50, 20 - band - 1) == 1] = FIGURE
    trimap[disk(70, 50, 20 + band) == 0] = BACKGROUND
    return trimap


def behind(given: Shot, trimap: np.ndarray) -> np.ndarray:
    return ground_beta(BACKDROP.nearest(given.image).beta, trimap == BACKGROUND)


def searched(seen: np.ndarray, figure: np.ndarray, ground: np.ndarray, shift: np.ndarray) -> float:
    """The most probable alpha of one pixel: every alpha, β and light on the figure tried in turn.

    β is counted from what is expected, and spread by 0.02; light as a part of F, by 0.25.
    """
    alpha, beta, light = np.meshgrid(
        np.linspace(0, 1, 201),
        np.linspace(-0.1, 0.1, 41),
        np.linspace(-0.5, 0.5, 41),
        indexing="ij",
    )
    cover = alpha[..., None]
    mixed = cover * (1 + light[..., None]) * figure
    mixed += (1 - cover) * (ground + beta[..., None] * shift)
    variance = NOISE.sigma(seen) ** 2 + (cover * (0.04 * figure + 0.002)) ** 2
    variance = variance + ((1 - cover) * 0.01 * ground) ** 2
    cost = ((seen - mixed) ** 2 / variance).sum(axis=-1) + (beta / 0.02) ** 2 + (light / 0.25) ** 2
    return float(alpha.ravel()[np.argmin(cost)])


@pytest.mark.parametrize("true", [0.1, 0.4, 0.7, 0.95])
def test_alpha_is_that_which_a_search_finds(true: float) -> None:
    alpha = np.where(DISK == 1, 1.0, 0.0)
    alpha[50, 91] = true
    given = shot(alpha, colour=BLUE)
    trimap = np.where(alpha == 1, FIGURE, BACKGROUND).astype(np.uint8)
    trimap[50, 91] = UNKNOWN
    lit = np.ones_like(SHADE)
    found = measure(given.image, trimap, lit, BACKDROP).alpha[50, 91]
    expected = searched(
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
    found = measure(given.image, trimap, behind(given, trimap), BACKDROP)
    assert np.abs(found.alpha - DISK)[trimap == UNKNOWN].mean() < 0.03
    assert (found.alpha[trimap == FIGURE] == 1).all()
    assert (found.alpha[trimap == BACKGROUND] == 0).all()


def test_many_pixels_are_solved_as_few_are(monkeypatch: pytest.MonkeyPatch) -> None:
    given = shot(DISK, SHADE)
    trimap = trimap_of(DISK)
    whole = solve(given.image, trimap, behind(given, trimap), BACKDROP, REACH, OPEN)
    monkeypatch.setattr("shadowtool.core.known_background._BLOCK", 7)
    parts = solve(given.image, trimap, behind(given, trimap), BACKDROP, REACH, OPEN)
    for one, other in zip(whole, parts, strict=True):
        assert one == pytest.approx(other, abs=1e-5)


def test_the_error_that_it_predicts_is_the_one_it_makes() -> None:
    given = shot(DISK, SHADE)
    trimap = trimap_of(DISK)
    found = measure(given.image, trimap, behind(given, trimap), BACKDROP)
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
        found = solve(even, trimap, ones, backdrop, REACH, prior)
        assert found.alpha[trimap == UNKNOWN] == pytest.approx(expected, abs=0.15)


@pytest.mark.parametrize("given_prior", [False, True])
def test_light_on_the_figure_may_change_towards_its_rim(given_prior: bool) -> None:
    given = shot(DISK, SHADE)
    inwards = np.clip((20.5 - np.hypot(COLUMNS - 70, ROWS - 50)) / 3, 0, 1)[..., None]
    # With a prior the shade that ground has is thought of too.
    least = SCENE.shadow / SCENE.lit if given_prior else 0.6
    figure = given.foreground * (least + (1 - least) * inwards)
    image = SCENE.noisy(DISK[..., None] * figure + (1 - DISK[..., None]) * given.background, 1)
    trimap = trimap_of(DISK, 2)
    ground = behind(given, trimap)
    if given_prior:
        alpha = solve(image, trimap, ground, BACKDROP, REACH, OPEN).alpha
    else:
        alpha = measure(image, trimap, ground, BACKDROP).alpha
    assert np.abs(alpha - DISK)[trimap == UNKNOWN].mean() < 0.03


def test_where_colours_are_coarser_than_luma_luma_tells_alpha() -> None:
    given = shot(DISK, SHADE, colour=np.float32([0.9, 0.6, 0.1]))
    luma = given.image @ np.float32([0.2126, 0.7152, 0.0722])
    colours_alone = cv2.blur(given.image - luma[..., None], (4, 1))
    image = colours_alone + luma[..., None]
    trimap = trimap_of(DISK, 2)
    ground = behind(given, trimap)
    coarse, fine = (
        np.abs(measure(image, trimap, ground, BACKDROP, excess).alpha - DISK)[trimap == UNKNOWN]
        for excess in (3, 1)
    )
    assert coarse.mean() < 0.5 * fine.mean()


def test_a_sliver_of_shadow_at_a_sole_is_ground_though_ground_around_is_lit() -> None:
    sliver = (np.abs(ROWS - 71) <= 1) & (np.abs(COLUMNS - 68) <= 6)
    shadow = SCENE.disk(82, 74, radius=8, soft=1)
    given = shot(DISK, np.where(sliver & (DISK == 0), 0, shadow))
    trimap = trimap_of(DISK)
    trimap[sliver & (DISK < 1)] = UNKNOWN
    prior = Prior(np.full(DISK.shape, 0.8, np.float32), np.full(DISK.shape, 0.15, np.float32))
    lit = ground_beta(shadow, trimap == BACKGROUND)
    found = solve(given.image, trimap, lit, BACKDROP, REACH, prior)
    taken = sliver & (DISK == 0)
    assert lit[taken].mean() > 0.7
    assert np.median(found.alpha[taken]) < 0.1
    # Far from any shadow the same is dark clothes.
    alone = solve(given.image, trimap, np.ones_like(lit), BACKDROP, REACH, prior)
    assert np.median(alone.alpha[taken]) > 0.5


def test_colours_have_nothing_of_the_ground() -> None:
    given = shot(DISK, SHADE)
    trimap = trimap_of(DISK)
    for foreground in (
        solve(given.image, trimap, behind(given, trimap), BACKDROP, REACH, OPEN).foreground,
        colours(given.image, given.alpha, behind(given, trimap), BACKDROP, REACH),
    ):
        rim = (DISK > 0.3) & (DISK < 1)
        assert np.abs(foreground - given.foreground)[rim].mean() < 0.02
        assert (foreground >= 0).all()


def test_colours_of_a_figure_that_is_nowhere_opaque() -> None:
    given = shot(0.5 * DISK)
    found = colours(given.image, given.alpha, np.ones_like(SHADE), BACKDROP, REACH)
    assert np.isfinite(found).all() and (found[DISK == 0] == 0).all()


@pytest.mark.parametrize("value", [BACKGROUND, UNKNOWN])
def test_without_a_part_that_is_sure_there_is_no_figure(value: int) -> None:
    trimap = np.full(KNOWN.shape, value, np.uint8)
    found = solve(SCENE.lit, trimap, np.ones_like(SHADE), BACKDROP, REACH, OPEN)
    assert (found.alpha == 0).all() and (found.foreground == 0).all()


def test_ground_goes_on_behind_the_figure() -> None:
    ground = DISK == 0
    found = ground_beta(np.where(ground, SHADE, np.float32(7)), ground)
    assert np.array_equal(found[ground], SHADE[ground])
    assert found.max() <= 1
    assert (ground_beta(SHADE, np.zeros_like(ground)) == 1).all()


@pytest.mark.parametrize("seed", range(3))
def test_light_of_any_strength_gives_a_matte(seed: int) -> None:
    """Sparks and dead pixels among dark ones, with hardly any noise."""
    rng = np.random.default_rng(seed)

    def sparks() -> np.ndarray:
        strength = 10 ** rng.uniform(-4, 4, (*DISK.shape, 1)) * rng.choice([-0.1, 0, 1, 1])
        return (strength * rng.uniform(0.3, 1, (*DISK.shape, 3))).astype(np.float32)

    noise = NoiseModel(np.zeros(3), np.full(3, 4e-8))
    backdrop = Backdrop(sparks(), sparks(), noise, BACKDROP.doubt)
    image, trimap = sparks(), trimap_of(DISK, 3)
    ground = ground_beta(backdrop.nearest(image).beta, trimap == BACKGROUND)
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        found = measure(image, trimap, ground, backdrop)
        solved = solve(image, trimap, ground, backdrop, REACH, OPEN)
    assert np.isfinite(found.error).all()
    for alpha in (found.alpha, solved.alpha):
        assert ((alpha >= 0) & (alpha <= 1)).all()
    assert np.isfinite(solved.foreground).all()
