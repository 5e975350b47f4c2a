"""The crossing of the half-way threshold is the one that a second reading would find."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core.crossings import LEAST_CONTRAST, CrossingFinder, SecondLook


def crossings_in_two_readings(grays: list[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Position, value before and value after the first crossing, by the definition."""
    stack = np.stack(grays).astype(np.float16).astype(np.float32)
    for number in range(1, len(stack)):
        stack[number] = np.where(np.isfinite(stack[number]), stack[number], stack[number - 1])
    threshold = (np.fmin.reduce(stack) + np.fmax.reduce(stack)) / 2
    threshold = threshold.astype(np.float16).astype(np.float32)
    at = (stack < threshold).argmax(axis=0)
    at[~(stack < threshold).any(axis=0)] = 0
    before = np.take_along_axis(stack, np.maximum(at - 1, 0)[None], axis=0)[0]
    after = np.take_along_axis(stack, at[None], axis=0)[0]
    at[~np.isfinite(before)] = 0
    return at, before, after


@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 40),
    st.sampled_from([0.0, 1.0, 4.0, 9.0]),
    st.floats(0, 0.1),
    st.sampled_from([0.0, 0.02]),
    st.sampled_from([(None, None), (12, 1), (12, 5), (12, 11)]),
    st.integers(0, 2**32 - 1),
)
def test_one_reading_finds_what_two_find(
    count: int,
    width: float,
    noise: float,
    broken: float,
    in_hand: tuple[int | None, int | None],
    seed: int,
) -> None:
    """Edges up to 9 frames wide, light that drifts, a second shadow, noise, broken pixels; however
    many frames are looked at together."""
    rng = np.random.default_rng(seed)
    arrival = rng.uniform(-5, count + 5, (6, 7))
    again = arrival + rng.uniform(8, 15, arrival.shape)
    grays = []
    for number in range(count):
        dark = [np.clip((number - t) / max(width, 1e-3) + 0.5, 0, 1) for t in (arrival, again)]
        light = 1 - dark[0] * (number < arrival + 6 + width) - 0.9 * dark[1]
        gray = np.maximum(light, 0.05) * (1 + 0.01 * number) + rng.normal(scale=noise, size=(6, 7))
        gray[rng.uniform(size=gray.shape) < broken] = np.nan
        grays.append(gray.astype(np.float32))
    finder = CrossingFinder(*in_hand)
    for gray in grays:
        finder.add(gray)
    found = finder.found()
    at, before, after = crossings_in_two_readings(grays)
    with np.errstate(invalid="ignore"):
        seen = found.highest - found.lowest > LEAST_CONTRAST * np.abs(found.highest)
    known = ~found.lost & seen
    assert np.array_equal(found.at[known], at[known])
    told = known & (at > 0)
    assert np.array_equal(found.before[told], before[told])
    assert np.array_equal(found.after[told], after[told])
    assert (found.at[found.lost] == 0).all()


@pytest.mark.parametrize("frames", [20, 40])
def test_edges_that_pass_slowly_are_followed_among_the_frames_in_hand(frames: int) -> None:
    rng = np.random.default_rng(0)
    arrival = rng.uniform(frames / 2, 100, (30, 40))
    finder = CrossingFinder()
    for number in range(100 + frames):
        lit = 1 - np.clip((number - arrival) / frames + 0.5, 0, 1)
        finder.add(0.15 + 0.85 * lit + rng.normal(scale=0.003, size=lit.shape))
    found = finder.found()
    known = found.at > 0
    assert known.mean() > 0.8 and (known | found.lost).all()
    assert np.median(np.abs(found.at - 0.5 - arrival)[known]) < 1


@pytest.mark.parametrize("start", range(50, 56))
def test_what_noise_darkened_before_an_edge_creeps_in_is_lost(start: int) -> None:
    dark = np.concatenate([np.full(start, 1.0), np.linspace(1, 0.1, 38), np.full(9, 0.1)])
    lost = {}
    for dip in (1.0, 0.955):
        finder = CrossingFinder(27)
        for number, gray in enumerate(dark):
            finder.add(np.full((1, 1), dip if number == 3 else gray))
        lost[dip] = bool(finder.found().lost.all())
    assert lost == {1.0: False, 0.955: True}


def test_a_second_look_finds_what_the_first_lost() -> None:
    rng = np.random.default_rng(0)
    arrival = rng.uniform(-20, 220, (12, 15))
    grays = []
    for number in range(200):
        lit = 1 - np.clip((number - arrival) / 60 + 0.5, 0, 1)
        gray = 0.15 + 0.85 * lit + rng.normal(scale=0.03, size=lit.shape)
        gray[rng.uniform(size=gray.shape) < 0.02] = np.nan
        grays.append(gray.astype(np.float32))
    finder = CrossingFinder()
    for gray in grays:
        finder.add(gray)
    first = finder.found()
    assert first.lost.mean() > 0.5
    look = SecondLook(first, first.lost)
    for gray in grays:
        look.add(gray)
    found = look.found()
    at, before, after = crossings_in_two_readings(grays)
    assert not found.lost.any()
    assert np.array_equal(found.at, at)
    assert np.array_equal(found.before[at > 0], before[at > 0])
    assert np.array_equal(found.after[at > 0], after[at > 0])
    # The first's own answer is left as it was.
    assert (first.at[first.lost] == 0).all()
