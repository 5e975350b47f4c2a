import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.half_keys import (
    finite_keys,
    from_keys,
    gray_keys,
    keys_per_unit,
    mean_of_keys,
    to_keys,
)

BITS = np.arange(1 << 16, dtype=np.uint32).astype(np.uint16)
ALL = BITS.view(np.float16)
FINITE = ALL[np.isfinite(ALL)]
POSITIVE = np.sort(FINITE[FINITE > 0])
HALFS = hnp.arrays(
    np.float16,
    hnp.array_shapes(min_dims=1, max_dims=3, max_side=5),
    elements=st.floats(-65504, 65504, width=16),
)


def test_keys_are_in_the_order_of_the_halfs() -> None:
    ordered = FINITE[np.argsort(to_keys(FINITE), kind="stable")].astype(np.float32)
    assert (np.diff(ordered) >= 0).all()
    # Only the two zeros are the same number.
    assert (np.diff(ordered) == 0).sum() == 1


def test_every_half_has_a_key_of_its_own() -> None:
    assert len(np.unique(to_keys(ALL))) == len(ALL)


def test_neighbouring_halfs_have_neighbouring_keys() -> None:
    assert (np.diff(to_keys(POSITIVE).astype(int)) == 1).all()


def test_minus_zero_is_just_below_zero_and_the_ends_are_outermost() -> None:
    minus, zero, infinity, least, nan = to_keys(
        np.array([-0.0, 0.0, np.inf, -np.inf, np.nan], np.float16)
    ).astype(int)
    keys = to_keys(FINITE).astype(int)
    assert zero - minus == 1
    assert infinity == keys.max() + 1 and least == keys.min() - 1
    assert nan > infinity


def test_from_keys_gives_every_bit_back() -> None:
    assert np.array_equal(from_keys(to_keys(ALL)).view(np.uint16), BITS)


def test_to_keys_is_the_inverse_of_from_keys() -> None:
    keys = BITS.view(np.int16)
    assert np.array_equal(to_keys(from_keys(keys)), keys)


@given(HALFS)
def test_halfs_are_left_alone_in_whatever_layout(halfs: np.ndarray) -> None:
    before = halfs.copy()
    turned = to_keys(halfs.T)
    assert np.array_equal(turned, to_keys(halfs).T)
    assert np.array_equal(halfs, before)


def test_keys_are_left_alone() -> None:
    keys = to_keys(np.random.default_rng(0).uniform(-1, 1, (5, 6, 3)).astype(np.float16))
    before = keys.copy()
    gray_keys(keys)
    keys_per_unit(from_keys(keys))
    mean_of_keys(keys, np.full(keys.shape, 2))
    assert np.array_equal(keys, before)


def of_keys(values: np.ndarray) -> np.ndarray:
    """The mean of samples (N, ...) by way of their keys."""
    keys = to_keys(values).astype(np.int32)
    return mean_of_keys(keys.sum(axis=0), np.full(values.shape[1:], len(values)))


@given(st.floats(1.1, 1.9), st.integers(-10, 10), st.integers(0, 99))
def test_the_mean_of_keys_is_the_mean_within_a_factor_of_two(
    mantissa: float, exponent: int, seed: int
) -> None:
    middle = mantissa * 2.0**exponent
    spread = 0.02 * middle
    rng = np.random.default_rng(seed)
    values = (middle + rng.uniform(-1, 1, (64, 50)) * spread).astype(np.float16)
    error = of_keys(values) - values.astype(np.float64).mean(axis=0)
    assert np.abs(error).max() < 0.01 * 2 * spread


@given(st.floats(0.97, 1.03), st.integers(-10, 10), st.integers(0, 99))
def test_the_mean_is_off_by_a_tenth_of_the_range_that_straddles_a_power_of_two(
    mantissa: float, exponent: int, seed: int
) -> None:
    middle = mantissa * 2.0**exponent
    spread = 0.03 * middle
    rng = np.random.default_rng(seed)
    values = (middle + rng.uniform(-1, 1, (1000, 50)) * spread).astype(np.float16)
    error = of_keys(values) - values.astype(np.float64).mean(axis=0)
    assert np.abs(error).max() < 0.1 * 2 * spread


@given(HALFS.filter(lambda halfs: (np.abs(halfs) < 65504).all()))
def test_the_mean_of_one_is_itself(halfs: np.ndarray) -> None:
    assert np.array_equal(of_keys(halfs[None]), halfs.astype(np.float32))


@pytest.mark.parametrize("end", [-65504, 65504])
def test_the_mean_of_what_is_as_large_as_halfs_go_is_itself(end: float) -> None:
    assert of_keys(np.full((5, 1), end, np.float16)) == end


def test_the_mean_of_none_is_nan() -> None:
    found = mean_of_keys(np.array([0, 12]), np.array([0, 1]))
    assert np.isnan(found[0]) and found[1] == from_keys(np.int16([12]))[0]


def test_the_mean_keeps_fractions_of_a_key() -> None:
    pair = np.float16([[0.5], [0.5 + 2**-11]])
    assert of_keys(pair) == pytest.approx(0.5 + 2**-12, abs=1e-7)


def test_a_key_is_as_wide_as_the_spacing_of_halfs() -> None:
    finite = POSITIVE[:-1]
    expected = 1 / np.diff(POSITIVE.astype(np.float64))
    assert np.array_equal(keys_per_unit(finite.astype(np.float32)), expected)
    assert np.array_equal(keys_per_unit(-finite.astype(np.float32)), expected)


def test_zero_is_spaced_as_the_least_halfs_are() -> None:
    least = keys_per_unit(POSITIVE[:1].astype(np.float32))
    assert np.array_equal(keys_per_unit(np.zeros(1, np.float32)), least)


@given(st.floats(-65504, 65504, width=16))
def test_the_gray_key_of_gray_is_its_own(value: float) -> None:
    keys = to_keys(np.full((1, 1, 3), value, np.float16))
    assert abs(int(gray_keys(keys)[0, 0]) - int(keys[0, 0, 0])) <= 2


@given(
    hnp.arrays(np.float16, (4, 4, 3), elements=st.floats(-65504, 65504, width=16)),
    hnp.arrays(np.float16, (4, 4, 3), elements=st.floats(0, 60000, width=16)),
)
def test_gray_keys_climb_with_every_channel(one: np.ndarray, other: np.ndarray) -> None:
    low, high = np.minimum(one, other), np.maximum(one, other)
    assert (gray_keys(to_keys(low)) <= gray_keys(to_keys(high))).all()


@pytest.mark.parametrize("values", [POSITIVE, FINITE, -POSITIVE])
def test_what_is_not_finite_is_so_in_any_channel(values: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    halfs = rng.choice(values, (60, 70, 3))
    keys, signed, bad = finite_keys(halfs)
    assert np.array_equal(keys, to_keys(halfs)) and bad is None
    assert signed == (keys.min() < 0)
    assert np.array_equal(gray_keys(keys, signed), gray_keys(keys))
    for wrong in (np.nan, -np.nan, np.inf, -np.inf):
        halfs[rng.random(halfs.shape) < 0.03] = wrong
        for part in (halfs, halfs[:, ::2], halfs[::-1]):
            keys, signed, bad = finite_keys(part)
            assert signed
            assert np.array_equal(keys, to_keys(part))
            assert np.array_equal(bad, ~np.isfinite(part).all(axis=-1))


def test_the_keys_of_nothing_are_nothing() -> None:
    assert finite_keys(np.zeros((0, 5, 3), np.float16))[0].shape == (0, 5, 3)
