import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.plates import ExtremePlates

STACKS = hnp.arrays(
    np.float16,
    hnp.array_shapes(min_dims=3, max_dims=3, min_side=1, max_side=4).map(lambda s: (*s, 3)),
    elements=st.floats(-100, 100, width=16),
)


@given(STACKS)
def test_plates_are_the_extremes_of_the_frames_bit_for_bit(frames: np.ndarray) -> None:
    extremes = ExtremePlates()
    for frame in frames:
        extremes.add(frame)
    plates = extremes.plates()
    # +0 and -0 are the same light.
    assert np.array_equal(plates.shadow, frames.min(axis=0).astype(np.float32))
    assert np.array_equal(plates.lit, frames.max(axis=0).astype(np.float32))


@given(STACKS)
def test_halfs_and_floats_give_the_same(frames: np.ndarray) -> None:
    halfs, floats = ExtremePlates(), ExtremePlates()
    for frame in frames:
        halfs.add(frame)
        floats.add(frame.astype(np.float32))
    assert np.array_equal(halfs.plates().lit, floats.plates().lit)
    assert np.array_equal(halfs.plates().shadow, floats.plates().shadow)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_held_out_pixels_do_not_count(dtype: type) -> None:
    extremes = ExtremePlates()
    frame = np.full((2, 2, 3), 0.5, dtype)
    figure = np.full((2, 2, 3), 9, dtype)
    holdout = np.array([[0, 255], [1, 0]], np.uint8)
    extremes.add(frame)
    extremes.add(np.where(holdout[..., None] > 0, figure, frame), holdout)
    plates = extremes.plates()
    assert (plates.lit == 0.5).all()
    assert plates.frames.tolist() == [[2, 1], [1, 2]]


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_a_pixel_seen_in_no_frame_is_nan(dtype: type) -> None:
    extremes = ExtremePlates()
    holdout = np.zeros((2, 3))
    holdout[1, 2] = 0.1
    for _ in range(3):
        extremes.add(np.ones((2, 3, 3), dtype), holdout)
    plates = extremes.plates()
    assert np.isnan(plates.lit[1, 2]).all() and np.isnan(plates.shadow[1, 2]).all()
    assert np.isfinite(plates.lit).sum() == 5 * 3
    assert plates.frames[1, 2] == 0


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_does_not_spread(dtype: type, bad: float) -> None:
    extremes = ExtremePlates()
    good = np.full((2, 2, 3), 0.25, dtype)
    broken = good.copy()
    broken[0, 0, 1] = bad
    for frame in (good, broken, good):
        extremes.add(frame)
    plates = extremes.plates()
    assert (plates.lit == 0.25).all() and (plates.shadow == 0.25).all()
    assert plates.frames.tolist() == [[2, 3], [3, 3]]


def test_the_order_of_frames_makes_no_difference() -> None:
    frames = np.random.default_rng(0).normal(size=(9, 4, 5, 3)).astype(np.float16)
    results = []
    for order in (frames, frames[::-1]):
        extremes = ExtremePlates()
        for frame in order:
            extremes.add(frame)
        results.append(extremes.plates())
    assert results[0].lit.tobytes() == results[1].lit.tobytes()
    assert results[0].shadow.tobytes() == results[1].shadow.tobytes()


def test_inputs_are_left_alone() -> None:
    frame = np.random.default_rng(0).normal(size=(4, 5, 3)).astype(np.float16)
    before = frame.copy()
    extremes = ExtremePlates()
    extremes.add(frame)
    extremes.plates().lit[:] = 7
    assert np.array_equal(frame, before)
    assert not (extremes.plates().lit == 7).any()


def test_memory_does_not_grow_with_the_frames() -> None:
    frame = np.ones((64, 64, 3), np.float16)
    extremes = ExtremePlates()
    extremes.add(frame)
    tracemalloc.start()
    extremes.add(frame)
    _, few = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    for _ in range(200):
        extremes.add(frame)
    _, many = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert many < few + frame.nbytes


def test_misuse_is_refused() -> None:
    extremes = ExtremePlates()
    with pytest.raises(ValueError):
        extremes.plates()
    extremes.add(np.zeros((2, 2, 3), np.float16))
    with pytest.raises(ValueError):
        extremes.add(np.zeros((2, 3, 3), np.float16))


def test_halfs_and_floats_may_be_mixed() -> None:
    extremes = ExtremePlates()
    holdout = np.array([[1, 0]])
    extremes.add(np.full((1, 2, 3), 0.25, np.float16), holdout)
    extremes.add(np.full((1, 2, 3), 0.1, np.float32), holdout)
    extremes.add(np.full((1, 2, 3), 0.5, np.float16))
    plates = extremes.plates()
    assert plates.lit[0, :, 0].tolist() == [0.5, 0.5]
    assert plates.shadow[0, :, 0] == pytest.approx([0.5, 0.1])
