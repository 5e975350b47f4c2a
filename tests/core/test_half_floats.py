"""Half and single floats: numpy's casts are the slow and obvious version."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.half_floats import (
    all_finite,
    not_finite,
    rounded,
    shortened,
    to_float,
    to_half,
)

EVERY_HALF = np.arange(1 << 16, dtype=np.uint32).astype(np.uint16).view(np.float16)
SHAPES = [(1,), (4,), (1, 1), (4, 1), (1, 4), (4, 1, 3), (2, 2, 4), (3, 3, 7), (0, 3), (2, 3, 2, 2)]


def same_bits(one: np.ndarray, other: np.ndarray) -> bool:
    """Equal, the signs of zeros too; any NaN equals any other."""
    unknown = np.isnan(other)
    return (
        one.dtype == other.dtype
        and one.shape == other.shape
        and np.array_equal(np.isnan(one), unknown)
        and one[~unknown].tobytes() == other[~unknown].tobytes()
    )


def clipped(values: np.ndarray) -> np.ndarray:
    return np.clip(values, -65504, 65504).astype(np.float16)


@pytest.mark.parametrize(
    "shape", [(1 << 16,), (256, 256), (4, 1 << 14), (1 << 14, 4), (64, 256, 4)]
)
def test_every_half_becomes_the_float_that_it_is(shape):
    halfs = EVERY_HALF.reshape(shape)
    assert same_bits(to_float(halfs), halfs.astype(np.float32))


def test_every_half_survives_the_way_there_and_back():
    finite = EVERY_HALF[np.isfinite(EVERY_HALF)]
    assert same_bits(to_half(to_float(finite)), finite)


def test_half_way_between_two_halfs_rounds_to_even():
    finite = np.sort(EVERY_HALF[np.isfinite(EVERY_HALF) & (EVERY_HALF >= 0)]).astype(np.float64)
    middles = ((finite[1:] + finite[:-1]) / 2).astype(np.float32)
    for values in (middles, -middles, np.nextafter(middles, np.float32(np.inf))):
        assert same_bits(to_half(values), clipped(values))


@given(hnp.arrays(np.uint32, st.sampled_from(SHAPES)))
def test_any_float_rounds_as_numpy_rounds_it(bits):
    values = bits.view(np.float32)
    assert same_bits(to_half(values), clipped(values))


@given(hnp.arrays(np.uint16, st.sampled_from(SHAPES)))
def test_halfs_of_any_shape(bits):
    halfs = bits.view(np.float16)
    assert same_bits(to_float(halfs), halfs.astype(np.float32))
    assert all_finite(halfs) == np.isfinite(halfs).all()


@pytest.mark.parametrize("view", [np.s_[::2, ::3], np.s_[:, ::-1], np.s_[..., 1]])
def test_parts_of_a_larger_picture(view):
    values = np.random.default_rng(0).random((8, 9, 3), np.float32)[view]
    assert same_bits(to_half(values), values.astype(np.float16))
    assert same_bits(to_float(values.astype(np.float16)), values.astype(np.float16).astype("f4"))


def test_what_is_too_large_becomes_the_largest_half_and_nan_stays():
    values = np.array([1e9, -1e9, np.inf, -np.inf, np.nan, 65519, 65520], np.float32)
    expected = [65504, -65504, 65504, -65504, np.nan, 65504, 65504]
    np.testing.assert_array_equal(to_half(values), np.array(expected, np.float16))


@example(np.array([0x7F800001], np.uint32))
@given(hnp.arrays(np.uint32, st.sampled_from(SHAPES)))
def test_rounding_alone_makes_infinities(bits):
    values = bits.view(np.float32)
    # Widening says so where NaN is a signalling one.
    with np.errstate(invalid="ignore"):
        double = values.astype(np.float64)
    with np.errstate(over="ignore"):
        assert same_bits(rounded(values), values.astype(np.float16))
        assert same_bits(rounded(double), values.astype(np.float16))


def test_single_floats_are_not_copied():
    values = np.ones((2, 2), np.float32)
    assert to_float(values) is values


@given(hnp.arrays(np.float32, st.sampled_from(SHAPES), elements=st.floats(-1e4, 1e4, width=32)))
def test_what_is_shortened_is_off_by_an_eighth_of_a_halfs_step(values):
    normal = np.where(np.abs(values) < 1e-30, np.float32(0), values)
    short = shortened(normal)
    assert (np.abs(short - normal) <= 2.0**-13 * np.abs(normal)).all()
    assert not (short.view(np.uint32) & 0x7FF).any()


def test_every_half_stays_as_it_is_when_shortened():
    assert same_bits(shortened(to_float(EVERY_HALF)), to_float(EVERY_HALF))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_pixels_with_a_channel_that_is_not_finite_are_found(dtype: type) -> None:
    image = np.zeros((3, 4, 3), dtype)
    assert not_finite(image) is None
    image[0, 1, 2], image[2, 3, 0], image[1, 0] = np.nan, -np.inf, (np.inf, np.nan, 0)
    bad = not_finite(image)
    assert bad is not None
    assert np.argwhere(bad).tolist() == [[0, 1], [1, 0], [2, 3]]
