from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core.backdrop import Backdrop, missing_shade
from tests.figures import BACKDROP, SCENE

SMALL = BACKDROP.at((slice(0, 4), slice(0, 5)))


def searched(image: np.ndarray, backdrop: Backdrop) -> tuple[np.ndarray, np.ndarray]:
    """β by trying every one in turn, and squared distance with any part of the sky missing, too."""
    nearest, best = (np.full(image.shape[:2], np.inf) for _ in "01")
    beta = np.zeros(image.shape[:2])
    variance = backdrop.variance(image)
    for part in np.linspace(-0.5, 1, 301):
        shown = backdrop.under(np.full(image.shape[:2], part, np.float32))
        for missing in np.linspace(0, 0.5, 51) if part >= 0 else [0.0]:
            dimmed = shown - np.float32(missing) * backdrop.shadow
            distance2 = ((image - dimmed) ** 2 / variance).sum(axis=-1) + (missing / 0.12) ** 2
            best = np.minimum(best, distance2)
            if missing == 0:
                beta = np.where(distance2 < nearest, part, beta)
                nearest = np.minimum(nearest, distance2)
    return beta, best


@settings(max_examples=20)
@given(st.integers(0, 10_000))
def test_the_nearest_background_is_that_which_a_search_finds(seed: int) -> None:
    image = np.random.default_rng(seed).uniform(0, 1, SMALL.lit.shape).astype(np.float32)
    found = SMALL.nearest(image)
    beta, distance2 = searched(image, SMALL)
    assert found.distance2 == pytest.approx(distance2, rel=2e-2, abs=0.5)
    shown, other = SMALL.under(found.beta), SMALL.under(beta.astype(np.float32))
    clear = np.abs(found.beta - beta) < 0.1
    assert clear.mean() > 0.8
    assert shown[clear] == pytest.approx(other[clear], abs=0.02)


@given(st.floats(-0.5, 1))
def test_the_background_lies_on_its_own_line(part: float) -> None:
    beta = np.full(SMALL.lit.shape[:2], part, np.float32)
    found = SMALL.nearest(SMALL.under(beta))
    assert found.distance2 == pytest.approx(0, abs=1e-2)
    assert found.beta == pytest.approx(beta, abs=1e-3)


@given(st.floats(0, 1), st.floats(0, 0.24))
def test_ground_that_misses_some_of_the_sky_is_ground_in_any_light(
    part: float, missing: float
) -> None:
    beta = np.full(SMALL.lit.shape[:2], part, np.float32)
    found = SMALL.nearest(SMALL.under(beta) - np.float32(missing) * SMALL.shadow)
    assert (found.distance2 <= (missing / 0.12) ** 2 + 0.01).all()


def test_away_from_all_shade_hardly_anything_is_darker_than_it() -> None:
    frames = np.zeros((90, 160), np.uint32)
    frames[60:80, 20:60] = 4
    # Noise that looks like shade is none.
    frames[::7, ::7] = 1
    missing = missing_shade(frames)
    assert np.isinf(missing[58:82, 18:62]).all()
    assert np.isfinite(missing[:50]).all() and np.isfinite(missing[:, 70:]).all()
    deep = (SCENE.shadow * np.float32(0.6)).astype(np.float32)
    anywhere, nowhere = (
        replace(BACKDROP, missing=np.full(SCENE.lit.shape[:2], part, np.float32)).nearest(deep)
        for part in (np.inf, 0.1)
    )
    assert np.array_equal(anywhere.distance2, BACKDROP.nearest(deep).distance2)
    assert np.median(nowhere.distance2) > np.median(anywhere.distance2) + 10


def test_zero_is_shadow_and_one_is_light() -> None:
    zeros = np.zeros(SCENE.lit.shape[:2], np.float32)
    assert np.array_equal(BACKDROP.under(zeros), SCENE.shadow)
    assert BACKDROP.under(zeros + 1) == pytest.approx(SCENE.lit, abs=1e-6)


def test_noise_alone_is_as_far_from_the_line_as_noise_is() -> None:
    lit = BACKDROP.nearest(SCENE.noisy(SCENE.lit, 3))
    # Two channels' worth off the line, three off L; the plates' own error is allowed for besides.
    assert 0.8 < lit.distance2.mean() < 2.1
    assert 1.5 < lit.from_lit2.mean() < 3.1


def test_the_distance_from_light_is_the_same_by_itself() -> None:
    image = SCENE.noisy(SCENE.image(SCENE.disk(50, 40)), 4)
    assert BACKDROP.from_lit2(image) == pytest.approx(BACKDROP.nearest(image).from_lit2, rel=1e-4)


def test_a_shadow_plate_that_is_only_guessed_is_held_to_less() -> None:
    doubt = np.full(SCENE.lit.shape[:2], 0.05, np.float32)
    guessed = Backdrop(SCENE.lit, SCENE.shadow, BACKDROP.noise, doubt)
    other_hue = SCENE.shadow * np.float32([0.95, 1, 1.05])
    sure, unsure = BACKDROP.nearest(other_hue), guessed.nearest(other_hue)
    assert np.median(unsure.distance2) < 0.5 * np.median(sure.distance2)
    # It makes little difference in the light.
    lit = SCENE.lit * np.float32([1.05, 1, 0.95])
    assert (guessed.nearest(lit).distance2 > 0.55 * BACKDROP.nearest(lit).distance2).all()
