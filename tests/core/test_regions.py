"""What is connected, what is large, and what is near."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.regions import (
    closed,
    grown,
    large_parts,
    opened,
    parts,
    parts_with,
    shrunk,
)

MASKS = hnp.arrays(np.bool_, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12))


def drawn(*rows: str) -> np.ndarray:
    return np.array([[place == "#" for place in row] for row in rows])


def flooded(mask: np.ndarray, start: tuple[int, int], corners: bool) -> np.ndarray:
    """The connected part of a mask that holds a pixel of it, found step by step."""
    found = np.zeros_like(mask)
    found[start] = True
    while True:
        padded = np.pad(found, 1)
        more = found.copy()
        for y, x in np.ndindex(3, 3):
            if corners or 1 in (y, x):
                more |= padded[y : y + mask.shape[0], x : x + mask.shape[1]]
        more &= mask
        if np.array_equal(more, found):
            return found
        found = more


@given(MASKS, st.integers(0, 8), st.sampled_from([4, 8]))
def test_large_parts_are_the_connected_ones_of_so_many_pixels(mask, least, connectivity):
    before = mask.copy()
    kept = large_parts(mask, least, connectivity)
    for place in zip(*np.nonzero(mask), strict=True):
        assert kept[place] == (flooded(mask, place, connectivity == 8).sum() >= least)
    assert not kept[~mask].any()
    assert np.array_equal(mask, before)


@given(MASKS, st.data())
def test_parts_with_a_seed_are_whole_and_the_others_go(mask, data):
    seeds = data.draw(hnp.arrays(np.bool_, mask.shape))
    kept = parts_with(mask, seeds)
    for place in zip(*np.nonzero(mask), strict=True):
        assert kept[place] == (flooded(mask, place, corners=True) & seeds).any()
    assert not kept[~mask].any()


@given(MASKS)
def test_parts_are_the_mask_each_pixel_once(mask):
    found = list(parts(mask))
    assert np.array_equal(sum(found, np.zeros(mask.shape, int)), mask)
    for part in found:
        start = tuple(np.argwhere(part)[0])
        assert np.array_equal(part, flooded(mask, start, corners=True))


@given(MASKS, st.integers(0, 3))
def test_growing_and_shrinking_go_by_the_farther_of_down_and_across(mask, radius):
    y, x = np.nonzero(mask)
    for place in np.ndindex(mask.shape):
        away = np.maximum(np.abs(y - place[0]), np.abs(x - place[1]))
        assert grown(mask, radius)[place] == (away <= radius).any()
    assert np.array_equal(shrunk(mask, radius), ~grown(~mask, radius))


@pytest.mark.parametrize(("width", "kept"), [(1, True), (2, True), (3, False)])
def test_opening_takes_away_what_is_narrower(width, kept):
    mask = drawn("......", ".##...", ".##...", "......")
    assert opened(mask, width).any() == kept


def test_closing_fills_gaps_of_twice_the_radius():
    assert closed(drawn("#..#...#"), 1).tolist() == drawn("####...#").tolist()
