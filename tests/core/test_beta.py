import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.beta import (
    fill_beta,
    inpaint,
    inverse_span,
    never_reached,
    never_shaded,
    shadow_contrast,
    shadow_matte,
)
from shadowtool.core.compositing import shade
from shadowtool.core.noise import NoiseModel
from shadowtool.core.plates import Plates
from tests.scene import Scene

NOISE = NoiseModel(np.full(3, 4.5e-5), np.full(3, 1e-6))
UNIT = st.floats(0, 1, width=32)


def matte_of(image: np.ndarray, lit: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    return shadow_matte(image, shadow, inverse_span(lit, shadow))


@given(hnp.arrays(np.float32, (6, 7), elements=UNIT), st.integers(0, 5))
def test_the_matte_of_a_composite_is_the_matte_that_went_in(beta: np.ndarray, seed: int) -> None:
    scene = Scene(6, 7, seed, rows=(0, 0), columns=(0, 0))
    found = matte_of(shade(scene.lit, scene.shadow, beta), scene.lit, scene.shadow)
    assert found == pytest.approx(beta, abs=2e-5)


def test_lit_is_one_and_shadow_is_zero() -> None:
    scene = Scene()
    assert matte_of(scene.lit, scene.lit, scene.shadow) == pytest.approx(1, abs=1e-5)
    assert np.all(matte_of(scene.shadow, scene.lit, scene.shadow) == 0)


def test_projection_is_the_least_squares_estimate() -> None:
    rng = np.random.default_rng(0)
    lit, shadow = rng.uniform(0.5, 1, 3), rng.uniform(0, 0.3, 3)
    observed = rng.uniform(0, 1, 3)
    best, *_ = np.linalg.lstsq((lit - shadow)[:, None], observed - shadow, rcond=None)
    arrays = [a.reshape(1, 1, 3).astype(np.float32) for a in (observed, lit, shadow)]
    assert matte_of(*arrays)[0, 0] == pytest.approx(best[0], abs=1e-5)


def test_no_difference_between_the_plates_is_unknown() -> None:
    scene = Scene()
    shadow = scene.shadow.copy()
    shadow[3:5] = scene.lit[3:5]
    beta = matte_of(scene.lit, scene.lit, shadow)
    assert np.isnan(beta[3:5]).all() and np.isfinite(beta[6:]).all()


def test_beta_is_not_clipped_and_nan_stays_in_its_pixel() -> None:
    scene = Scene()
    image = scene.shadow + np.float32(1.5) * (scene.lit - scene.shadow)
    image[0, 0] = np.nan
    beta = matte_of(image, scene.lit, scene.shadow)
    assert np.isnan(beta[0, 0]) and np.isnan(beta).sum() == 1
    assert beta[1:] == pytest.approx(1.5, abs=1e-4)


def test_contrast_predicts_the_error_of_beta() -> None:
    scene = Scene()
    plates = Plates(scene.lit, scene.shadow)
    half = scene.image(np.full((90, 160), 0.5, np.float32))
    rng = np.random.default_rng(3)
    noisy = half + rng.normal(size=half.shape) * NOISE.sigma(half)
    error = matte_of(noisy, scene.lit, scene.shadow) - 0.5
    predicted = 1 / shadow_contrast(plates, NOISE)
    assert np.std(error / predicted) == pytest.approx(1, abs=0.03)


def test_extremes_of_noise_alone_are_unknown() -> None:
    rng = np.random.default_rng(0)
    clean = Scene().lit
    shots = clean + rng.normal(size=(60, *clean.shape)) * NOISE.sigma(clean)
    plates = Plates(shots.max(axis=0).astype(np.float32), shots.min(axis=0).astype(np.float32))
    frames = np.full(clean.shape[:2], 60, np.uint32)
    assert never_shaded(shadow_contrast(plates, NOISE), frames).mean() > 0.999
    scene = Scene()
    real = Plates(scene.lit, scene.shadow)
    assert not never_shaded(shadow_contrast(real, NOISE), frames).any()


def test_nan_contrast_is_unknown() -> None:
    assert never_shaded(np.float32([[np.nan, 100]]), None).tolist() == [[True, False]]


def holes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    beta = np.ones((60, 80), np.float32)
    beta[20:50, 20:60] = 0.25
    never = np.zeros(beta.shape, bool)
    never[:, 70:] = True
    never[30:33, 30:33] = True
    hidden = np.zeros(beta.shape, bool)
    hidden[35:48, 40:50] = True
    beta[never | hidden] = np.nan
    return beta, never, hidden


def test_filling_lit() -> None:
    beta, never, hidden = holes()
    filled = fill_beta(beta, never, hidden, "lit")
    assert (filled[never | hidden] == 1).all()


def test_filling_none_keeps_what_is_unknown() -> None:
    beta, never, hidden = holes()
    assert np.array_equal(fill_beta(beta, never, hidden, "none"), beta, equal_nan=True)


def test_inpainting_continues_holes_and_lights_what_no_shadow_reached() -> None:
    beta, never, hidden = holes()
    filled = fill_beta(beta, never_reached(never), hidden, "inpaint")
    assert filled[31, 31] == pytest.approx(0.25, abs=0.02)
    assert filled[40:43, 44:46] == pytest.approx(0.25, abs=0.02)
    assert (filled[:, 70:] == 1).all()
    known = np.isfinite(beta)
    assert np.array_equal(filled[known], beta[known])


def test_behind_the_figure_light_meets_shadow_in_a_narrow_penumbra() -> None:
    """A shadow that begins at the feet, at the lower end of what is hidden."""
    beta = np.ones((90, 60), np.float32)
    beta[76:, 20:] = 0
    hidden = np.zeros(beta.shape, bool)
    hidden[10:80, 22:38] = True
    beta[hidden] = np.nan
    filled = fill_beta(beta, np.zeros_like(hidden), hidden, "inpaint")
    behind = filled[hidden]
    between = (behind > 0.05) & (behind < 0.95)
    plain = inpaint(beta)[hidden]
    assert between.mean() < 0.6 * ((plain > 0.05) & (plain < 0.95)).mean()
    assert (filled[:60, 22:38] > 0.99).all() and filled[79, 30] < 0.1
    # A penumbra as wide as the figure goes on behind it as it is around it.
    soft = np.tile(np.linspace(0, 1, 60, dtype=np.float32), (90, 1))
    soft[hidden] = np.nan
    assert np.array_equal(
        fill_beta(soft, np.zeros_like(hidden), hidden, "inpaint")[hidden], inpaint(soft)[hidden]
    )
    # In even half-shade it is no lighter and no darker.
    beta[~hidden] = 0.3
    even = fill_beta(beta, np.zeros_like(hidden), hidden, "inpaint")
    assert even == pytest.approx(0.3, abs=0.01)


def test_inpainting_stays_in_range_and_knows_nothing_as_lit() -> None:
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (30, 30)).astype(np.float32)
    image[rng.uniform(size=image.shape) < 0.4] = np.nan
    filled = inpaint(image)
    assert filled.min() >= np.nanmin(image) and filled.max() <= np.nanmax(image)
    assert (inpaint(np.full((4, 4), np.nan, np.float32)) == 1).all()
