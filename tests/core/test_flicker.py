import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core.flicker import band_gains
from tests.scene import Scene, smoothstep

SCENE = Scene()
ROWS = np.arange(SCENE.height, dtype=np.float64)


def bands(amplitude: float, waves: float, phase: float, second: float = 0.0) -> np.ndarray:
    """By how much each row is brighter, (H,)."""
    angle = 2 * np.pi * (waves * ROWS / SCENE.height + phase)
    return 1 + amplitude * (np.sin(angle) + second * np.sin(2 * angle + 1))


def crossed(x: float, y: float, seed: int = 0) -> np.ndarray:
    """The scene with a large shadow and a figure in it."""
    image = SCENE.image(SCENE.disk(x, y, 30, soft=8))
    left = int(np.clip(x - 10, 0, 130))
    image[20:70, left : left + 24] = (0.1, 0.3, 0.7)
    return SCENE.noisy(image, seed)


def found(image: np.ndarray, level: float = 1.0, rows: np.ndarray = ROWS) -> np.ndarray | None:
    return band_gains(image.astype(np.float32), SCENE.lit, level, rows)


@settings(max_examples=30, deadline=None)
@given(
    st.floats(0.02, 0.1),
    st.floats(1, 6),
    st.floats(0, 1),
    st.floats(0, 0.4),
    st.floats(30, 130),
    st.floats(20, 70),
    st.floats(0.9, 1.1),
)
def test_bands_are_found_past_shadow_and_figure(
    amplitude: float, waves: float, phase: float, second: float, x: float, y: float, level: float
) -> None:
    true = bands(amplitude, waves, phase, second)
    gains = found(level * true[:, None, None] * crossed(x, y), level)
    assert gains is not None
    off = np.abs(gains - true)
    assert off.mean() < 0.05 * amplitude + 0.003
    assert off.max() < 0.25 * amplitude + 0.004


def test_gains_of_any_rows_are_told() -> None:
    true = bands(0.06, 2.3, 0.4)
    image = true[:, None, None] * crossed(80, 45)
    twice = found(image, rows=ROWS[::2])
    assert twice == pytest.approx(found(image)[::2])
    between = found(image, rows=ROWS[:-1] + 0.5)
    assert between == pytest.approx((true[:-1] + true[1:]) / 2, abs=0.01)


@settings(max_examples=30, deadline=None)
@given(st.floats(30, 130), st.floats(20, 70), st.integers(0, 99), st.floats(0.9, 1.1))
def test_steady_light_has_no_bands(x: float, y: float, seed: int, level: float) -> None:
    assert found(level * crossed(x, y, seed), level) is None


@settings(max_examples=60, deadline=None)
@given(st.floats(-20, 110), st.floats(1, 60), st.floats(0.1, 0.75), st.booleans())
def test_an_edge_of_a_shadow_from_side_to_side_is_no_band(
    y: float, soft: float, shade: float, above: bool
) -> None:
    beta = smoothstep((ROWS - y) / soft * (1 if above else -1) + 0.5)
    image = SCENE.lit * (shade + (1 - shade) * beta)[:, None, None]
    assert found(SCENE.noisy(image, 1)) is None


def test_a_shadow_in_stripes_over_half_of_the_picture_is_no_flicker() -> None:
    image = SCENE.lit.copy()
    image[:, 70:] *= bands(0.08, 3, 0.1)[:, None, None].astype(np.float32)
    assert found(SCENE.noisy(image, 2)) is None


def test_nothing_to_compare_has_no_bands() -> None:
    banded = SCENE.noisy(bands(0.06, 2, 0)[:, None, None] * SCENE.lit, 0)
    nothing = np.full_like(SCENE.lit, np.nan)
    for image, reference in ((nothing, SCENE.lit), (banded, nothing), (banded, 0 * SCENE.lit)):
        assert band_gains(image, reference, 1.0, ROWS) is None
    narrow = np.s_[:, :20]
    assert band_gains(banded[narrow], SCENE.lit[narrow], 1.0, ROWS) is None
    low = np.s_[:3]
    assert band_gains(banded[low], SCENE.lit[low], 1.0, ROWS[:3]) is None


def test_what_is_unknown_is_passed_over() -> None:
    true = bands(0.06, 2.3, 0.4)
    image = true[:, None, None] * crossed(80, 45)
    image[:, 20:50] = np.nan
    image[40] = np.inf
    assert found(image) == pytest.approx(true, abs=0.01)
