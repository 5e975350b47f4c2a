import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core.color_line import Weighed, channels
from shadowtool.core.noise import NoiseModel
from shadowtool.core.standing import Sampled

SIZE = HEIGHT, WIDTH = 40, 60
SAMPLES = 20
NOISE = NoiseModel(np.full(3, 5e-5), np.full(3, 2e-7))
RATIO = np.float32([0.3, 0.35, 0.4])
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
PLACE = (np.hypot((COLUMNS - 30) / 7, (ROWS - 20) / 11) < 1)[..., np.newaxis]
COAT = np.float32([0.1, 0.3, 0.7])


def ground(grain: float = 0.1) -> np.ndarray:
    texture = np.exp(grain * np.random.default_rng(3).normal(size=(*SIZE, 1)))
    return (0.4 * texture * np.array([1.1, 1.0, 0.8])).astype(np.float32)


def sampled(frames: list[np.ndarray], lit: np.ndarray) -> Sampled:
    """What is known of frames if ``lit``, (h, w, 3), is taken for ground in light."""
    rng = np.random.default_rng(5)
    noisy = [f + NOISE.sigma(f) * rng.normal(size=f.shape).astype(np.float32) for f in frames]
    stack = np.stack([channels(frame) for frame in noisy])
    weighed = [Weighed(colours, NOISE, 0.01) for colours in stack]
    light = channels(lit)
    ratio = np.repeat(RATIO[:, np.newaxis], light.shape[1], axis=1)
    return Sampled(stack, weighed, light, ratio, SIZE)


def uncovered(frames: list[np.ndarray], lit: np.ndarray) -> np.ndarray:
    return sampled(frames, lit).uncovered().lit.T.reshape(*SIZE, 3)


def from_the(middle: int, before: np.ndarray, after: np.ndarray) -> list[np.ndarray]:
    return [before if time < middle else after for time in range(SAMPLES)]


@settings(max_examples=20, deadline=None)
@given(st.integers(4, 16), st.booleans(), st.booleans(), st.floats(0, 1))
def test_ground_is_what_goes_on_around_a_figure_whichever_was_seen_more_often(
    middle: int, comes: bool, mistaken: bool, part: float
) -> None:
    """What is taken for lit ground is the figure in some of its pixels, in all, or in none."""
    lit = ground()
    figure = np.where(PLACE, COAT, lit)
    frames = from_the(middle, lit, figure) if comes else from_the(middle, figure, lit)
    wrong = PLACE & (np.random.default_rng(1).random((*SIZE, 1)) < part) & mistaken
    found = uncovered(frames, np.where(wrong, COAT, lit))
    assert found == pytest.approx(lit, rel=0.05)


@pytest.mark.parametrize("mistaken", [False, True])
def test_a_figure_in_two_colours_is_one_figure(mistaken: bool) -> None:
    lit = ground()
    colours = np.where((ROWS < 20)[..., np.newaxis], COAT, np.float32([0.02, 0.02, 0.03]))
    figure = np.where(PLACE, colours, lit).astype(np.float32)
    found = uncovered(from_the(7, lit, figure), figure if mistaken else lit)
    assert found == pytest.approx(lit, rel=0.05)


def test_ground_in_shade_when_the_figure_comes_is_still_found_in_its_light() -> None:
    lit = ground()
    figure = np.where(PLACE, COAT, lit)
    shaded = np.where(PLACE, lit * RATIO, lit)
    frames = [lit] * 4 + [shaded] * 5 + [figure] * 11
    assert uncovered(frames, figure) == pytest.approx(lit, rel=0.05)


def test_what_was_seen_but_twice_is_uncovered_beside_what_was_seen_for_longer() -> None:
    """Of a figure's legs, before whom ground is seen for a moment, and his coat."""
    lit = ground()
    figure = np.where(PLACE, COAT, lit)
    legs = np.where(ROWS[..., np.newaxis] >= 20, figure, lit)
    found = uncovered([lit] * 2 + [legs] * 4 + [figure] * 14, figure)
    assert found == pytest.approx(lit, rel=0.05)


def test_lasting_shade_that_looks_like_what_is_around_is_no_ground() -> None:
    """A bright tile among dark ones, in shade deeper than the common one."""
    dark = ground()
    lit = np.where(PLACE, dark / 0.2, dark).astype(np.float32)
    frames = from_the(8, lit, dark)
    assert not sampled(frames, lit).on_line.all()
    given_lit = sampled(frames, lit)
    assert np.array_equal(given_lit.uncovered().lit, given_lit.lit)


def test_somebody_who_only_passes_is_put_nowhere() -> None:
    """Hardly two points show him at the same times; some have been taken for ground."""
    lit = ground()
    bars = [np.abs(COLUMNS - 20 - time) < 3 for time in range(SAMPLES)]
    frames = [np.where(PLACE & bar[..., np.newaxis], COAT, lit) for bar in bars]
    wrong = PLACE & (np.random.default_rng(1).random((*SIZE, 1)) < 0.3)
    found = uncovered(frames, np.where(wrong, COAT, lit).astype(np.float32))
    off = np.abs(np.log(found / lit)).max(axis=-1)
    assert not (off > 0.1)[~wrong[..., 0]].any()
    assert (off > 0.1).sum() < wrong.sum()


@pytest.mark.parametrize("grain", [0.1, 0.25, 0.4])
def test_somebody_who_passes_in_the_grounds_mean_colour_is_no_ground(grain: float) -> None:
    """His plain coat goes better with what is around than textured ground does."""
    lit = ground(grain)
    coat = np.broadcast_to(np.float32([0.44, 0.4, 0.32]), lit.shape)
    places = [
        np.hypot((COLUMNS - 4 - 3 * time) / 12, (ROWS - 20) / 14) < 1 for time in range(SAMPLES)
    ]
    frames = [np.where(place[..., np.newaxis], coat, lit) for place in places]
    known = sampled(frames, lit)
    assert np.array_equal(known.uncovered().lit, known.lit)


def test_where_neither_goes_on_nothing_is_changed() -> None:
    lit = np.where(PLACE, np.float32([0.7, 0.1, 0.1]), ground()).astype(np.float32)
    figure = np.where(PLACE, COAT, lit)
    known = sampled(from_the(10, lit, figure), figure)
    assert np.array_equal(known.uncovered().lit, known.lit)


def test_a_place_that_fills_the_picture_has_nothing_around_it() -> None:
    lit = ground()
    known = sampled(from_the(12, np.broadcast_to(COAT, lit.shape), lit), lit)
    assert np.array_equal(known.uncovered().lit, known.lit)


def test_nobody_is_looked_for_where_all_is_ground() -> None:
    lit = ground()
    known = sampled([lit, lit * RATIO] * 10, lit)
    assert np.array_equal(known.uncovered().lit, known.lit)


def test_what_is_known_stays_as_it_was() -> None:
    lit = ground()
    figure = np.where(PLACE, COAT, lit)
    known = sampled(from_the(6, lit, figure), figure)
    before = [known.stack.copy(), known.lit.copy(), known.ratio.copy()]
    known.uncovered()
    after = [known.stack, known.lit, known.ratio]
    assert all(np.array_equal(a, b) for a, b in zip(after, before, strict=True))
