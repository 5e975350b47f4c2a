"""The crossing of the half-way threshold is the one that a second reading would find."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shadowtool.core import crossings
from shadowtool.core.crossings import LEAST_CONTRAST, CrossingFinder, Crossings, SecondLook
from shadowtool.core.half_floats import rounded
from shadowtool.core.half_keys import to_keys

_crossings = crossings._crossings
compiled = pytest.mark.skipif(_crossings is None, reason="it was installed without a compiler")


@pytest.fixture(params=["compiled", "numpy"])
def either(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "numpy":
        monkeypatch.setattr(crossings, "_crossings", None)
    elif _crossings is None:
        pytest.skip("it was installed without a compiler")


def looked_at(grays: list[np.ndarray], *in_hand: int | None) -> Crossings:
    finder = CrossingFinder(*in_hand)
    for gray in grays:
        finder.add(gray)
    return finder.found()


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


@pytest.mark.usefixtures("either")
@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
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
    found = looked_at(grays, *in_hand)
    at, before, after = crossings_in_two_readings(grays)
    with np.errstate(invalid="ignore"):
        seen = found.highest - found.lowest > LEAST_CONTRAST * np.abs(found.highest)
    known = ~found.lost & seen
    assert np.array_equal(found.at[known], at[known])
    told = known & (at > 0)
    assert np.array_equal(found.before[told], before[told])
    assert np.array_equal(found.after[told], after[told])
    assert (found.at[found.lost] == 0).all()


@pytest.mark.usefixtures("either")
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


@pytest.mark.usefixtures("either")
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


@pytest.mark.usefixtures("either")
def test_a_second_look_finds_what_the_first_lost() -> None:
    rng = np.random.default_rng(0)
    arrival = rng.uniform(-20, 220, (12, 15))
    grays = []
    for number in range(200):
        lit = 1 - np.clip((number - arrival) / 60 + 0.5, 0, 1)
        gray = 0.15 + 0.85 * lit + rng.normal(scale=0.03, size=lit.shape)
        gray[rng.uniform(size=gray.shape) < 0.02] = np.nan
        grays.append(gray.astype(np.float32))
    first = looked_at(grays)
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


@compiled
@settings(max_examples=60, deadline=None)
@given(
    st.integers(2, 60),
    st.sampled_from([(None, None), (3, 1), (12, 5), (12, 11), (30, 9)]),
    st.sampled_from([0.0, 0.01, 0.2, 3.0]),
    st.sampled_from([1e-7, 1e-4, 1.0, 6e4]),
    st.integers(0, 2**32 - 1),
)
def test_compiled_or_not_the_same_is_found(
    count: int, in_hand: tuple[int | None, int | None], noise: float, scale: float, seed: int
) -> None:
    """Of anything: steps and noise, negative, not normal, infinite and unknown."""
    rng = np.random.default_rng(seed)
    levels = rng.choice([1.0, 1.0, 0.97, 0.9, 0.5, 0.1, 0.0], (count, 3001))
    grays = levels[np.arange(count) // 3 * 3] * scale
    grays += scale * noise * rng.normal(size=grays.shape)
    grays[rng.uniform(size=grays.shape) < 0.01] = np.nan
    grays[rng.uniform(size=grays.shape) < 0.01] = np.inf
    frames = list(rounded(grays.astype(np.float32))[:, np.newaxis])
    with pytest.MonkeyPatch.context() as patch:
        found = looked_at(frames, *in_hand)
        patch.setattr(crossings, "_crossings", None)
        expected = looked_at(frames, *in_hand)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def state_of(pixels: int) -> tuple[np.ndarray, ...]:
    keys = [np.zeros(pixels, np.int16) for _ in range(8)]
    return *keys[:3], np.zeros(pixels, np.int32), *keys[3:7], np.zeros(pixels, bool)


@compiled
@pytest.mark.parametrize("seen, count", [(2, 4), (4, 4), (5, 4), (0, 0), (-1, 4)])
def test_without_frames_before_or_new_ones_nothing_is_looked_at(seen: int, count: int) -> None:
    frames = [np.zeros(7, np.int16)] * count
    with pytest.raises(ValueError, match="no state"):
        _crossings.settle(state_of(7), frames, seen, 0, 0.96, 41)


@compiled
@pytest.mark.parametrize("part", range(9))
def test_a_state_of_another_size_is_not_written_to(part: int) -> None:
    state = list(state_of(7))
    state[part] = state[part][:6]
    with pytest.raises(ValueError, match="too small"):
        _crossings.settle(tuple(state), [np.zeros(7, np.int16)] * 4, 3, 0, 0.96, 41)


@compiled
def test_a_state_that_is_ahead_of_its_frames_reads_nothing_beyond_them() -> None:
    state = state_of(7)
    for part in state:
        part[...] = np.iinfo(np.int32).max if part.dtype == np.int32 else 1
    state[0][:], state[1][:], state[4][:] = 0x3800, 0x3C00, 0x3C00
    frames = [np.full(7, 0x3C00, np.int16)] * 3 + [np.full(7, 0x3000, np.int16)]
    before = [part.copy() for part in state]
    _crossings.settle(state, frames, 3, 0, 0.96, 41)
    assert np.array_equal(state[3], before[3])


@compiled
def test_what_is_no_array_is_refused() -> None:
    frames = [np.zeros(7, np.int16)] * 3
    for state, frame in (
        (state_of(7), np.zeros(6, np.int16)),
        (state_of(7), None),
        (state_of(7)[:8], frames[0]),
        (("low",) * 9, frames[0]),
    ):
        with pytest.raises((ValueError, TypeError, BufferError)):
            _crossings.settle(state, [*frames, frame], 3, 0, 0.96, 41)


@compiled
def test_values_are_rounded_as_halfs_are() -> None:
    """A threshold between two keys, for all halfs and what lies between them."""
    halfs = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    halfs = np.sort(halfs[np.isfinite(halfs)]).astype(np.float32)
    rng = np.random.default_rng(0)
    lit = np.maximum(halfs, rng.permutation(halfs))
    frames = [lit, lit, np.minimum(halfs, lit), np.minimum(rng.permutation(halfs), lit)]
    found = looked_at([frame[np.newaxis] for frame in frames])
    low = np.minimum(frames[2], frames[3])
    threshold = to_keys(rounded((low + lit) / np.float32(2)))
    second, third = (to_keys(rounded(frame)) < threshold for frame in frames[2:])
    expected = np.where(second, 2, np.where(third, 3, 0))
    plain = (lit > 0) & (lit - low > LEAST_CONTRAST * lit) & (low > -lit)
    assert np.array_equal(found.at[0][plain], expected[plain])
