import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core import beta as shadow_beta
from shadowtool.core.beta import (
    Gauge,
    channel_contrast,
    inverse_span,
    shadow_contrast,
    shadow_matte,
    weight_of,
    without_noise,
)
from shadowtool.core.boxes import Box
from shadowtool.core.compositing import shade
from shadowtool.core.noise import NoiseModel
from shadowtool.core.plates import Plates
from tests.scene import Scene, smoothstep

SCENE = Scene(rows=(0, 0), columns=(0, 0))
PLATES = Plates(SCENE.lit, SCENE.shadow)
NOISE = NoiseModel(np.full(3, 5e-5), np.full(3, 1e-6))
CONTRAST = shadow_contrast(PLATES, NOISE)
WEIGHT = weight_of(CONTRAST)
INVERSE = inverse_span(SCENE.lit, SCENE.shadow)
# The noise of β in full light: more than half-way, for which the contrast stands.
SIGMA = 1.4 / CONTRAST


def filmed(beta: np.ndarray, seed: int = 0) -> np.ndarray:
    """β as it is measured in a noisy picture of the scene."""
    clean = shade(SCENE.lit, SCENE.shadow, beta.astype(np.float32))
    noise = np.random.default_rng(seed).normal(size=clean.shape) * NOISE.sigma(clean)
    return shadow_matte((clean + noise).astype(np.float32), SCENE.shadow, INVERSE)


def coloured(image: np.ndarray, lit: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    return shadow_matte(image, shadow, inverse_span(lit, shadow, "rgb"), "rgb")


def disk_beta() -> np.ndarray:
    return SCENE.disk(70, 45, 20, soft=12)


def test_light_becomes_exactly_one() -> None:
    shape = SCENE.lit.shape[:2]
    cleared = without_noise(filmed(np.ones(shape)), WEIGHT)
    assert (cleared == 1).mean() > 0.99
    around = SCENE.disk(70, 45, 40, soft=1) == 1
    assert (without_noise(filmed(disk_beta()), WEIGHT)[around] == 1).mean() > 0.99


def test_light_that_is_no_exact_one_is_within_the_noise() -> None:
    cleared = without_noise(filmed(np.ones(SCENE.lit.shape[:2])), WEIGHT)
    assert (np.abs(cleared - 1) < 5 * SIGMA).all()


@pytest.mark.parametrize("level", [0.0, 0.2, 0.5, 0.8])
def test_shadow_of_any_depth_is_found_without_bias(level: float) -> None:
    beta = np.full(SCENE.lit.shape[:2], level)
    found = np.stack([without_noise(filmed(beta, seed), WEIGHT) for seed in range(4)])
    assert found.mean() == pytest.approx(level, abs=0.001)


def test_even_shadow_loses_most_of_its_noise() -> None:
    beta = np.full(SCENE.lit.shape[:2], 0.4)
    noisy = filmed(beta)
    assert np.std(without_noise(noisy, WEIGHT) - 0.4) < np.std(noisy - 0.4) / 2


@pytest.mark.parametrize("width", [1, 6, 25])
def test_edges_and_penumbrae_survive_within_the_noise(width: int) -> None:
    x = np.arange(SCENE.width)
    beta = np.tile(smoothstep((x - 60) / width), (SCENE.height, 1))
    errors = np.stack([without_noise(filmed(beta, seed), WEIGHT) - beta for seed in range(6)])
    assert np.abs(errors / SIGMA).max() < 6
    # Over the rows and takes the noise averages out; what is left is the filter's own doing.
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.015


def test_a_hard_edge_stays_where_it_is() -> None:
    beta = np.ones(SCENE.lit.shape[:2])
    beta[:, 70:] = 0
    cleared = without_noise(filmed(beta), WEIGHT)
    assert (cleared[:, :70] > 0.8).all() and (cleared[:, 70:] < 0.2).all()


@pytest.mark.parametrize(("level", "found"), [(0.4, 0.9), (0.65, 1.0)])
def test_a_lone_pixel_is_shaded_if_it_is_darker_than_noise_makes_it(
    level: float, found: float
) -> None:
    beta, weight = np.ones((15, 15), np.float32), np.full((15, 15), 100, np.float32)
    beta[7, 7] = level
    cleared = without_noise(beta, weight)
    assert cleared[7, 7] <= found
    cleared[7, 7] = 1
    assert (cleared == 1).all()


def test_what_is_unknown_stays_so_and_does_not_spread() -> None:
    beta = filmed(disk_beta())
    beta[30:34, 60:66] = np.nan
    weight = WEIGHT.copy()
    cleared = without_noise(beta, weight)
    assert np.array_equal(np.isnan(cleared), np.isnan(beta))
    weight[30:34, 60:66] = 0
    assert np.array_equal(without_noise(beta, weight), cleared, equal_nan=True)


def test_a_pixel_without_contrast_takes_no_part() -> None:
    beta = filmed(disk_beta())
    weight = WEIGHT.copy()
    weight[40, 70] = 0
    wild = beta.copy()
    wild[40, 70] = -50
    quiet, loud = without_noise(beta, weight), without_noise(wild, weight)
    elsewhere = np.ones(beta.shape, bool)
    elsewhere[40, 70] = False
    assert np.array_equal(quiet[elsewhere], loud[elsewhere])


def test_nothing_known_and_inputs_are_left_alone() -> None:
    nothing = np.full((9, 9), np.nan, np.float32)
    assert np.isnan(without_noise(nothing, np.full((9, 9), 1e3, np.float32))).all()
    beta, weight = filmed(disk_beta()), WEIGHT.copy()
    before = beta.copy()
    without_noise(beta, weight)
    assert np.array_equal(beta, before) and np.array_equal(weight, WEIGHT)


def slowly(beta: np.ndarray, weight: np.ndarray, y: int, x: int) -> float:
    """A pixel of `without_noise`, by the book."""
    padded = [np.pad(a.astype(np.float64), 2, mode="symmetric") for a in (beta, weight)]
    values, weights = (a[y : y + 5, x : x + 5] for a in padded)
    known = np.isfinite(values) & (weights > 0)
    values, weights = values[known], weights[known]
    total = weights.sum()
    mean = (weights * values).sum() / total
    noise = len(values) / total
    structure = max((weights * (values - mean) ** 2).sum() / total - noise, 0)
    own, precision = float(beta[y, x]), float(weight[y, x])
    lit = abs(mean - 1) * np.sqrt(total) < 3 and abs(own - 1) * np.sqrt(precision) < 4
    if lit and structure < 25 * noise:
        return 1.0
    return mean + structure / (structure + 1 / precision) * (own - mean)


@pytest.mark.parametrize("unknown", [0, 0.2])
def test_it_is_the_filter_that_it_says_it_is(unknown: float) -> None:
    rng = np.random.default_rng(4)
    part = np.s_[30:48, 40:66]
    beta = np.where(rng.random(WEIGHT.shape) < unknown, np.nan, filmed(disk_beta()))[part]
    weight = np.where(rng.random(beta.shape) < unknown / 4, 0, WEIGHT[part])
    cleared = without_noise(beta.astype(np.float32), weight.astype(np.float32))
    for y, x in np.argwhere(np.isfinite(beta) & (weight > 0)):
        assert cleared[y, x] == pytest.approx(slowly(beta, weight, y, x), abs=1e-4)


GAUGE = Gauge(SCENE.shadow, INVERSE, (WEIGHT,))


def picture(beta: np.ndarray, seed: int = 0) -> np.ndarray:
    clean = shade(SCENE.lit, SCENE.shadow, beta.astype(np.float32))
    noise = np.random.default_rng(seed).normal(size=clean.shape) * NOISE.sigma(clean)
    return (clean + noise).astype(np.float16)


@pytest.mark.parametrize("rows", [1, 7, 1000])
def test_a_frame_is_measured_alike_however_many_rows_at_a_time(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shadow_beta, "_PIXELS", rows * SCENE.width)
    image, unseen = picture(disk_beta()), SCENE.disk(90, 50, 9) < 0.5
    found = GAUGE.measure(image, unseen)
    projected = shadow_matte(image, SCENE.shadow, INVERSE)
    projected[unseen] = np.nan
    assert np.array_equal(found, without_noise(projected, WEIGHT), equal_nan=True)
    assert np.array_equal(np.isnan(found), unseen)
    clamped = GAUGE.measure(image, unseen, clamp=True)
    assert np.array_equal(clamped, np.clip(found, 0, 1), equal_nan=True)


@pytest.mark.parametrize("rows", [7, 1000])
def test_ground_that_is_given_stands_for_what_the_frame_shows_there(
    rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shadow_beta, "_PIXELS", rows * SCENE.width)
    true, other = picture(disk_beta()).astype(np.float32), picture(disk_beta() * 0)
    box = Box(slice(20, 55), slice(33, 80))
    mixed = true.copy()
    mixed[box] = other[box]
    unseen = np.zeros(WEIGHT.shape, bool)
    found = GAUGE.measure(mixed, unseen, ground=(box, true[box]))
    assert np.array_equal(found, GAUGE.measure(true, unseen))


def test_a_frames_gain_is_taken_out() -> None:
    image, unseen = picture(disk_beta()).astype(np.float32), np.zeros(WEIGHT.shape, bool)
    found = GAUGE.measure(image * np.float32(1.25), unseen, gain=1.25)
    assert found == pytest.approx(GAUGE.measure(image, unseen), abs=2e-3)


def test_channels_are_measured_each_by_itself() -> None:
    contrasts = [
        np.ascontiguousarray(c) for c in np.moveaxis(channel_contrast(PLATES, NOISE), -1, 0)
    ]
    unknown = np.zeros(WEIGHT.shape, bool)
    unknown[3, 4] = True
    gauge = Gauge.of(PLATES, contrasts, unknown)
    image = picture(disk_beta())
    found = gauge.measure(image, np.zeros(WEIGHT.shape, bool))
    planes = coloured(image, SCENE.lit, SCENE.shadow)
    planes[3, 4] = np.nan
    for channel, contrast in enumerate(contrasts):
        alone = without_noise(np.ascontiguousarray(planes[..., channel]), weight_of(contrast))
        assert np.array_equal(found[..., channel], alone, equal_nan=True)
    assert np.isnan(found).sum() == 3


@pytest.mark.parametrize("size", [1, 3, 12])
def test_caustics_well_above_the_noise_are_kept(size: int) -> None:
    beta = np.ones(SCENE.lit.shape[:2])
    beta[40 : 40 + size, 70 : 70 + size] = 1.4
    cleared = without_noise(filmed(beta), WEIGHT)
    spot = cleared[40 : 40 + size, 70 : 70 + size]
    assert (spot > 1).all()
    assert (np.abs(spot - 1.4) < 5 * 1.4 * SIGMA[40 : 40 + size, 70 : 70 + size]).all()


@given(
    hnp.arrays(np.float32, (12, 14), elements=st.floats(-1, 2, width=32)),
    st.floats(5, 200),
)
def test_the_result_is_within_the_range_of_what_went_in(beta: np.ndarray, level: float) -> None:
    cleared = without_noise(beta, np.full(beta.shape, level**2, np.float32))
    lowest, highest = min(beta.min(), 1), max(beta.max(), 1)
    assert cleared.min() >= lowest - 1e-4 and cleared.max() <= highest + 1e-4


@given(hnp.arrays(np.float32, (6, 7, 3), elements=st.floats(0, 2, width=32)), st.integers(0, 5))
def test_a_coloured_matte_of_a_composite_is_the_one_that_went_in(
    beta: np.ndarray, seed: int
) -> None:
    scene = Scene(6, 7, seed, rows=(0, 0), columns=(0, 0))
    picture = shade(scene.lit, scene.shadow, beta)
    found = coloured(picture, scene.lit, scene.shadow)
    assert found == pytest.approx(beta, abs=2e-5)
    assert shade(scene.lit, scene.shadow, found) == pytest.approx(picture, abs=1e-5)


def test_a_coloured_matte_is_exact_at_the_plates_and_is_not_clipped() -> None:
    assert coloured(SCENE.lit, SCENE.lit, SCENE.shadow) == pytest.approx(1, abs=2e-7)
    assert (coloured(SCENE.shadow, SCENE.lit, SCENE.shadow) == 0).all()
    darker = coloured(SCENE.shadow * np.float32(0.5), SCENE.lit, SCENE.shadow)
    assert (darker < 0).all()


def test_gray_light_has_the_same_matte_in_every_channel() -> None:
    beta = disk_beta()
    found = coloured(SCENE.image(beta), SCENE.lit, SCENE.shadow)
    assert found == pytest.approx(np.repeat(beta[..., None], 3, axis=-1), abs=2e-5)


def test_a_channel_without_contrast_is_unknown_by_itself() -> None:
    shadow, image = SCENE.shadow.copy(), SCENE.lit.copy()
    shadow[3, 4, 1] = SCENE.lit[3, 4, 1]
    image[5, 6, 2] = np.nan
    unknown = ~np.isfinite(coloured(image, SCENE.lit, shadow))
    assert unknown[3, 4].tolist() == [False, True, False]
    assert unknown[5, 6].tolist() == [False, False, True]
    assert unknown.sum() == 2


def test_channel_contrast_predicts_the_error_of_each_channel() -> None:
    half = SCENE.image(np.full(SCENE.lit.shape[:2], 0.5, np.float32))
    noise = np.random.default_rng(3).normal(size=half.shape) * NOISE.sigma(half)
    error = coloured(half + noise, SCENE.lit, SCENE.shadow) - 0.5
    predicted = 1 / channel_contrast(PLATES, NOISE)
    assert np.std(error / predicted, axis=(0, 1)) == pytest.approx(1, abs=0.03)


def test_channels_together_tell_more_than_each_by_itself() -> None:
    each = channel_contrast(PLATES, NOISE)
    assert (shadow_contrast(PLATES, NOISE) >= each.min(axis=-1)).all()
    assert (shadow_contrast(PLATES, NOISE) <= np.sqrt((each**2).sum(axis=-1)) * 1.0001).all()


def test_a_channel_brighter_in_shadow_has_no_contrast() -> None:
    lit, shadow = SCENE.lit.copy(), SCENE.shadow.copy()
    shadow[..., 2] = lit[..., 2] * 1.1
    assert (channel_contrast(Plates(lit, shadow), NOISE)[..., 2] == 0).all()
