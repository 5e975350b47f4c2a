import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowtool.core import color_line
from shadowtool.core.color_line import Weighed, line_distance
from shadowtool.core.noise import NoiseModel
from tests.scene import Scene

SCENE = Scene(20, 30, rows=(0, 0), columns=(0, 0))
SIGMA = 0.01
# The same in every channel and at every brightness: distances are those of plain geometry.
EVEN = NoiseModel(np.zeros(3), np.full(3, SIGMA**2))
CAMERA = NoiseModel(np.array([4e-5, 5e-5, 8e-5]), np.full(3, 1e-6))


def distance(image: np.ndarray, noise: NoiseModel = EVEN, tolerance: float = 0.0) -> np.ndarray:
    return line_distance(image.astype(np.float32), SCENE.lit, SCENE.shadow, noise, tolerance)


def along() -> np.ndarray:
    """The unit direction from S to L of each pixel."""
    span = (SCENE.lit - SCENE.shadow).astype(np.float64)
    return span / np.linalg.norm(span, axis=-1, keepdims=True)


def across(seed: int = 0) -> np.ndarray:
    """A unit direction at right angles to that."""
    other = np.random.default_rng(seed).normal(size=SCENE.lit.shape)
    rest = other - (other * along()).sum(axis=-1, keepdims=True) * along()
    return rest / np.linalg.norm(rest, axis=-1, keepdims=True)


@given(st.floats(0, 1))
def test_what_a_shadow_can_do_is_on_the_line(beta: float) -> None:
    image = SCENE.image(np.full(SCENE.lit.shape[:2], beta, np.float32))
    for noise in (EVEN, CAMERA):
        assert distance(image, noise) == pytest.approx(0, abs=0.01)


@given(st.floats(0, 1), st.floats(0.5, 30), st.integers(0, 50))
def test_off_the_line_the_distance_is_in_deviations(beta: float, far: float, seed: int) -> None:
    image = SCENE.image(np.full(SCENE.lit.shape[:2], beta, np.float32))
    found = distance(image + far * SIGMA * across(seed))
    assert found == pytest.approx(far, rel=0.01, abs=0.01)


@given(st.floats(0.5, 30))
def test_the_line_ends_at_either_plate(far: float) -> None:
    assert distance(SCENE.lit + far * SIGMA * along()) == pytest.approx(far, rel=0.01)
    assert distance(SCENE.shadow - far * SIGMA * along()) == pytest.approx(far, rel=0.01)


def test_noise_alone_stays_within_its_deviations() -> None:
    rng = np.random.default_rng(0)
    clean = SCENE.image(np.full(SCENE.lit.shape[:2], 0.5, np.float32))
    shots = clean + rng.normal(size=(50, *clean.shape)) * CAMERA.sigma(clean)
    found = distance(shots, CAMERA)
    # Two of three directions are at right angles to the line.
    assert np.mean(found**2) == pytest.approx(2, rel=0.1)


def test_channels_with_more_noise_count_less() -> None:
    noise = NoiseModel(np.zeros(3), np.array([1, 1, 25]) * SIGMA**2)
    red, blue = SCENE.lit.copy(), SCENE.lit.copy()
    red[..., 0] += 0.2
    blue[..., 2] += 0.2
    assert (distance(red, noise) > distance(blue, noise)).all()


def test_tolerance_brings_everything_nearer_to_the_line() -> None:
    image = SCENE.lit + 10 * SIGMA * across()
    near, far = distance(image, tolerance=0.05), distance(image)
    assert (near < far).all() and (near > 0).all()


def test_unknown_pixels_are_at_no_distance() -> None:
    image = SCENE.lit + 10 * SIGMA * across()
    image[3, 4, 1] = np.nan
    lit = SCENE.lit.copy()
    lit[5, 6] = np.nan
    found = line_distance(image.astype(np.float32), lit, SCENE.shadow, EVEN, 0.01)
    assert found[3, 4] == 0 and found[5, 6] == 0
    assert (found > 1).sum() == found.size - 2


def test_without_a_shadow_the_line_is_a_point() -> None:
    image = (SCENE.lit + 7 * SIGMA * along()).astype(np.float32)
    found = line_distance(image, SCENE.lit, SCENE.lit, EVEN, 0)
    assert found == pytest.approx(7, rel=0.01)


def slow_line_distance(image: np.ndarray, lit: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    """One pixel after the other: the nearest of many points of its line, to (N,)."""
    found = []
    for colour, light, shade in zip(image, lit, shadow, strict=True):
        deviation = CAMERA.sigma(colour) + 0.02 * np.maximum(colour, 0)
        points = shade + np.linspace(0, 1, 2001)[:, None] * (light - shade)
        found.append(np.sqrt((((points - colour) / deviation) ** 2).sum(axis=-1)).min())
    return np.array(found)


@given(st.integers(0, 1000))
def test_it_is_the_distance_to_the_nearest_of_the_lines_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lit = rng.uniform(0.2, 1, (20, 3)).astype(np.float32)
    shadow = lit * rng.uniform(0.05, 0.9, 3).astype(np.float32)
    image = rng.uniform(-0.01, 1.2, (20, 3)).astype(np.float32)
    found = line_distance(image, lit, shadow, CAMERA, 0.02)
    assert found == pytest.approx(slow_line_distance(image, lit, shadow), rel=1e-3, abs=0.05)


def test_a_large_picture_is_its_pixels() -> None:
    rng = np.random.default_rng(3)
    shape = 210, 331
    lit = np.resize(SCENE.lit, (*shape, 3))
    image = rng.uniform(0, 1, (*shape, 3)).astype(np.float32)
    whole = line_distance(image, lit, 0.2 * lit, CAMERA, 0.01)
    assert whole.shape == shape and whole.dtype == np.float32
    for rows in (slice(0, 7), slice(95, 120), slice(200, 210)):
        part = line_distance(image[rows], lit[rows], 0.2 * lit[rows], CAMERA, 0.01)
        assert np.array_equal(whole[rows], part)


compiled = pytest.mark.skipif(color_line._compiled is None, reason="installed without a compiler")


@compiled
@given(
    st.integers(0, 700),
    st.integers(0, 2**32 - 1),
    st.sampled_from([slice(None), slice(1, -1), slice(None, None, 2), slice(None, None, -1)]),
    st.booleans(),
)
def test_compiled_or_not_the_same_distances_are_found(
    count: int, seed: int, some: slice, columns: bool
) -> None:
    """Colours on the line, off it, beyond its ends, and of nothing and anything; lines of no length
    and next to none; colours that don't follow each other."""
    rng = np.random.default_rng(seed)
    lit = rng.uniform(0.01, 1, (3, count)).astype(np.float32)
    shadow = lit * rng.uniform(0, 1.1, (3, 1)).astype(np.float32)
    colours = shadow + (lit - shadow) * rng.uniform(-0.5, 1.5, count).astype(np.float32)
    colours += rng.normal(scale=0.05, size=colours.shape).astype(np.float32)
    for values in (lit, shadow, colours):
        strange = rng.random(values.shape) < 0.03
        values[strange] = rng.choice([0, -1, 1e30, np.nan, np.inf, -np.inf], strange.sum())
    short = rng.random(count) < 0.1
    shadow[:, short] = lit[:, short] * rng.choice([1, 1 - 1e-6, 1 - 1e-4], short.sum())
    with np.errstate(all="ignore"):
        weighed = Weighed(colours, CAMERA, 0.02).part(some)
    lit, shadow = lit[:, some], shadow[:, some]
    if columns:
        lit, shadow = np.asfortranarray(lit), np.asfortranarray(shadow)
    found = weighed.nearest(lit, shadow)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(color_line, "_compiled", None)
        expected = weighed.nearest(lit, shadow)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@compiled
@pytest.mark.parametrize(
    "wrong", [{"lit": (3, 4)}, {"lit": (2, 5)}, {"kind": "f8"}, {"found": 4}, {"found": 6}]
)
def test_colours_and_lines_that_do_not_fit_together_are_not_compared(wrong: dict) -> None:
    def nearest(lit=(3, 5), kind="f4", found=5):
        parts = np.ones((3, 5), "f4"), np.ones((3, 5), "f4"), np.ones(lit, "f4")
        out = np.empty(found, "f4")
        color_line._compiled.nearest(*parts, np.ones((3, 5), kind), out, out.copy())

    nearest()
    with pytest.raises(ValueError):
        nearest(**wrong)


@compiled
@pytest.mark.parametrize("apart", [slice(None, None, 2), slice(None, None, -1)])
def test_colours_that_do_not_follow_each_other_are_not_compared(apart: slice) -> None:
    whole, part = np.ones((3, 5), "f4"), np.ones((3, 10), "f4")[:, apart][:, :5]
    out = np.empty(5, "f4")
    for place in range(4):
        parts = [whole] * 4
        parts[place] = part
        with pytest.raises(ValueError, match="three channels"):
            color_line._compiled.nearest(*parts, out, out.copy())
