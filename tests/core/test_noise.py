from dataclasses import replace

import cv2
import numpy as np
import pytest

from shadowtool.core.noise import (
    NoiseLevel,
    NoiseModel,
    NoiseSamples,
    extreme_range,
    noise_levels,
    noise_model,
    sample_positions,
    thin,
)
from shadowtool.core.transfer import decode_srgb, encode_srgb

SLOPE, FLOOR = 4.5e-5, 1e-6


def take(frames: int, seed: int = 0, moving: bool = False) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    clean = rng.uniform(0.02, 0.9, (120, 160, 3))
    shots = []
    for number in range(frames):
        image = clean.copy()
        if moving:
            image[:, 5 * number : 5 * number + 30] *= 0.2
        shots.append(image + rng.normal(size=image.shape) * np.sqrt(SLOPE * image + FLOOR))
    return shots


def model_of(shots: list[np.ndarray]) -> NoiseModel:
    positions = sample_positions(len(shots))
    return noise_model(noise_levels({n: thin(shots[p]) for n, p in positions.items()}))


@pytest.mark.parametrize("moving", [False, True])
def test_photon_and_read_noise_are_found_from_the_take(moving: bool) -> None:
    model = model_of(take(24, moving=moving))
    for value in (0.05, 0.18, 0.6):
        true = np.sqrt(SLOPE * value + FLOOR)
        assert model.sigma(np.full(3, value)) == pytest.approx([true] * 3, rel=0.15)


@pytest.mark.parametrize("tint", [1.0, np.array([1.1, 1.0, 0.9])])
def test_a_lamp_that_flickers_makes_no_noise(tint: np.ndarray | float) -> None:
    shots = take(24)
    waves = np.sin(2 * np.pi * np.arange(120) / 70)[:, None, None]
    for number in range(1, 24, 2):
        shots[number] = shots[number] * (tint - 0.06 * waves)
    true = np.sqrt(SLOPE * 0.18 + FLOOR)
    assert model_of(shots).sigma(np.full(3, 0.18)) == pytest.approx([true] * 3, rel=0.2)


def test_noise_that_a_codec_freezes_is_found_between_distant_frames() -> None:
    shots = take(24)
    frozen = [shots[4 * (number // 4)] for number in range(24)]
    true = np.sqrt(SLOPE * 0.18 + FLOOR)
    assert model_of(frozen).sigma(np.full(3, 0.18)) == pytest.approx([true] * 3, rel=0.2)


def test_clean_or_single_frames_have_the_least_noise() -> None:
    still = take(1)
    for shots in (still, still * 5):
        assert model_of(shots).sigma(np.full(3, 0.5)) == pytest.approx([2e-4] * 3, rel=0.05)


def test_eight_bits_are_not_taken_for_a_codec_that_freezes() -> None:
    # Something moves through, which is what frames that are far apart would show.
    shots = [
        decode_srgb(np.round(encode_srgb(np.maximum(shot, 0)) * 255) / 255)
        for shot in take(24, moving=True)
    ]
    true = np.sqrt(SLOPE * 0.18 + FLOOR)
    assert model_of(shots).sigma(np.full(3, 0.18)) == pytest.approx([true] * 3, rel=0.25)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_a_black_shadow_is_not_taken_for_a_codec_that_freezes(noise: float) -> None:
    shots = []
    for number, (clean, shot) in enumerate(zip(take(1) * 24, take(24), strict=True)):
        image = clean + noise * (shot - clean)
        image[:, : 7 * number] = 0
        shots.append(decode_srgb(np.round(encode_srgb(np.maximum(image, 0)) * 255) / 255))
    true = max(noise * np.sqrt(SLOPE * 0.18 + FLOOR), 1e-3)
    assert (model_of(shots).sigma(np.full(3, 0.18)) < 1.6 * true).all()


def test_noise_that_a_codec_makes_rare_and_large_is_as_large_as_it_is_far_off() -> None:
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(size=(240, 320, 3)), (0, 0), 2)
    smooth = 0.3 * np.exp(0.5 * texture / texture.std())
    shots = []
    for _ in range(16):
        noisy = smooth + rng.normal(size=smooth.shape) * np.sqrt(SLOPE * smooth + FLOOR)
        code = np.round(encode_srgb(np.clip(noisy, 0, 1)) * 255).astype(np.uint8)
        done, stored = cv2.imencode(".jpg", code, [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        shots.append(decode_srgb(cv2.imdecode(stored, cv2.IMREAD_COLOR) / 255))
    middle = np.median(shots, axis=0)
    off = np.abs(np.array(shots) - middle) / model_of(shots).sigma(middle)
    # Of normal noise it would be 1 in 370.
    assert (off > 3).mean() < 1 / 100


def passed_by(frames: int, error: float, noise: float, light: float) -> list[np.ndarray]:
    """Ground past a quarter of which a shadow moves, sent anew with another error whenever it
    changes; meanwhile the light grows by a part of itself."""
    rng = np.random.default_rng(5)
    clean = rng.uniform(0.2, 0.5, (240, 320, 3))
    sent, before, shots = clean.copy(), np.full((240, 320), -1), []
    for number in range(frames):
        shaded = np.zeros((240, 320), int)
        shaded[:60, 9 * number : 9 * number + 40] = 1
        anew = (shaded != before)[..., np.newaxis]
        image = clean * np.where(shaded, 0.25, 1)[..., np.newaxis]
        sent = np.where(anew, image + error * rng.normal(size=image.shape), sent)
        before = shaded
        grown = 1 + light * number / frames
        shots.append(sent * grown + noise * rng.normal(size=image.shape))
    return shots


def test_what_a_codec_sends_anew_only_where_something_passed_is_off_by_as_much() -> None:
    model = model_of(passed_by(40, error=0.01, noise=0.0, light=0.0))
    for value in (0.22, 0.3):
        assert model.sigma(np.full(3, value)) == pytest.approx([0.01] * 3, rel=0.25)


def test_darker_than_all_that_was_measured_noise_falls_with_the_light() -> None:
    rng = np.random.default_rng(3)
    clean = rng.uniform(0.2, 0.5, (240, 320, 3))
    model = model_of([clean + 0.01 * rng.normal(size=clean.shape) for _ in range(12)])
    assert model.sigma(np.full(3, 0.4)) == pytest.approx([0.01] * 3, rel=0.1)
    dark = model.variance(np.array([[0.1] * 3, [0.02] * 3, [0.0] * 3], np.float32))
    for variance, part in zip(dark, (0.67, 0.42, 0.35), strict=True):
        assert variance == pytest.approx([part * 1e-4] * 3, rel=0.3)
    # Noise that falls by itself with the light, as photons' does, stands in light and dark.
    photons = [clean + np.sqrt(4e-4 * clean) * rng.normal(size=clean.shape) for _ in range(12)]
    for value in (1.0, 0.3, 0.05):
        found = model_of(photons).variance(np.full(3, value))
        assert found == pytest.approx([4e-4 * value] * 3, rel=0.3)
    # What was measured in the dark stands.
    clean = rng.uniform(0.01, 0.5, (240, 320, 3))
    model = model_of([clean + 0.01 * rng.normal(size=clean.shape) for _ in range(12)])
    assert model.sigma(np.full(3, 0.06)) == pytest.approx([0.01] * 3, rel=0.15)


@pytest.mark.parametrize("light", [0.0, 0.15])
def test_what_passes_makes_no_noise(light: float) -> None:
    model = model_of(passed_by(40, error=0.0, noise=0.005, light=light))
    assert model.sigma(np.full(3, 0.3)) == pytest.approx([0.005] * 3, rel=0.25)


@pytest.mark.parametrize("pace", [0.8, 1.5])
def test_a_soft_shadow_that_passes_slowly_makes_no_noise(pace: float) -> None:
    rng = np.random.default_rng(5)
    clean = rng.uniform(0.2, 0.5, (240, 320, 3))
    shots = []
    for number in range(12):
        # Narrow stripes over a quarter of the picture; most of each is penumbra.
        away = np.abs((np.arange(320) - pace * number) % 20 - 10)
        light = np.ones((240, 320, 1))
        light[:60] = 1 - 0.75 * np.clip(1.5 - away / 4, 0, 1)[:, np.newaxis]
        shots.append(clean * light + 0.005 * rng.normal(size=clean.shape))
    assert model_of(shots).sigma(np.full(3, 0.3)) == pytest.approx([0.005] * 3, rel=0.25)


@pytest.mark.parametrize("moving", [False, True])
def test_normal_noise_is_not_taken_for_rare_and_large(moving: bool) -> None:
    shots = take(24, moving=moving)
    samples = {n: thin(shots[p]) for n, p in sample_positions(24).items()}
    levels = noise_levels(samples)
    assert {type(level.sigma) for level in levels} == {float}
    sigmas = np.array([level.sigma for level in levels])
    values = np.array([level.value for level in levels])
    wanted = np.sqrt(SLOPE * values + FLOOR)
    assert np.median(sigmas / wanted) == pytest.approx(1, abs=0.12)


def test_rounding_to_code_values_counts_as_noise() -> None:
    step = 1 / 255
    coarse = [np.round(shot / step) * step for shot in take(24)]
    true = np.sqrt(SLOPE * 0.02 + FLOOR + step**2 / 12)
    assert model_of(coarse).sigma(np.full(3, 0.02)) == pytest.approx([true] * 3, rel=0.2)


def test_frames_with_nothing_finite_are_passed_over() -> None:
    shots = [np.full((40, 40, 3), np.nan)] * 4
    assert np.isfinite(model_of(shots).sigma(np.ones(3))).all()


@pytest.mark.parametrize("frames", [0, 1, 2, 3, 9, 1000])
def test_sample_positions_are_pairs_inside_the_take(frames: int) -> None:
    positions = sample_positions(frames)
    assert all(0 <= p < frames for p in positions.values())
    assert all(positions[n + 1] == p + 1 for n, p in positions.items() if n % 2 == 0)
    assert bool(positions) == (frames >= 2)


@pytest.mark.parametrize("frames", [2, 5, 100, 777])
def test_samples_of_a_take_of_unknown_length_stay_few_and_spread(frames: int) -> None:
    kept = NoiseSamples()
    for number in range(frames):
        kept.add(np.full((2, 2, 3), number, np.float32))
    samples = kept.samples()
    numbers = [int(image[0, 0, 0]) for _, image in sorted(samples.items())]
    assert 2 <= len(numbers) <= 36
    assert all(b == a + 1 for a, b in zip(numbers[::2], numbers[1::2], strict=False))
    assert numbers[-1] >= frames * 0.7 - 2


def test_pure_noise_stays_within_the_range_of_extremes() -> None:
    rng = np.random.default_rng(0)
    for count in (10, 100, 400):
        ranges = np.ptp(rng.normal(size=(count, 4000)), axis=0)
        assert (ranges < extreme_range(count)).mean() > 0.995


def test_dark_levels_in_which_all_moved_do_not_raise_the_noise() -> None:
    clean = [
        NoiseLevel(channel, value, 0.01 * np.sqrt(value + 0.02))
        for channel in range(3)
        for value in np.linspace(0.05, 0.9, 12)
    ]
    moved = [
        replace(level, sigma=0.06) if level.value < 0.3 else level  # a soft shadow's flank
        for level in clean
    ]
    dark = np.full((1, 3), 0.05, np.float32)
    sigma, wrong = (noise_model(levels).sigma(dark) for levels in (clean, moved))
    assert sigma == pytest.approx(0.01 * np.sqrt(0.07), rel=0.02)
    assert (wrong < 4 * sigma).all()
    # Clipped lights without noise do not lower it either.
    clipped = [replace(level, sigma=0.0) if level.value > 0.85 else level for level in clean]
    assert noise_model(clipped).sigma(dark) == pytest.approx(sigma, rel=0.3)


@pytest.mark.parametrize("shape", [(3,), (0, 3), (5, 7, 3), (4096, 3), (3, 1366, 3), (2, 9000, 3)])
@pytest.mark.parametrize("dark", [None, (np.array([1e-3, 2e-3, 0]), np.array([1e-6, 0, 1e-5]))])
def test_variance_is_that_of_the_lower_line(shape: tuple[int, ...], dark: tuple | None) -> None:
    model = NoiseModel(np.array([1e-4, 2e-4, 3e-4]), np.array([1e-5, 2e-5, 3e-5]), dark)
    image = np.random.default_rng(0).uniform(-0.1, 1, shape).astype(np.float32)
    image[image > 0.98] = np.nan
    before = image.copy()
    value = np.maximum(image, 0)
    lines = [(model.slope, model.floor), *([dark] if dark else [])]
    each = [value * slope.astype("f4") + floor.astype("f4") for slope, floor in lines]
    expected = each[0] if len(each) == 1 else np.minimum(*each)
    for own in (image, np.asfortranarray(image)):
        np.testing.assert_array_equal(model.variance(own), expected)
    channel = model.channel_variance(np.ascontiguousarray(value[..., 1]), 1)
    np.testing.assert_array_equal(channel, expected[..., 1])
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pixel_that_is_no_number_changes_next_to_nothing(value: float) -> None:
    shots = take(24)
    clean = model_of(shots)
    shots[0][0, 0] = value
    spoilt = model_of(shots)
    assert spoilt.slope == pytest.approx(clean.slope, rel=0.02)
    assert spoilt.floor == pytest.approx(clean.floor, rel=0.2)
