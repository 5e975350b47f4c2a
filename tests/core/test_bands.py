"""Bands cover a picture, each row once, whatever its size."""

import numpy as np
import pytest

from shadowtool.core.bands import bands, blocks, in_all_channels, overlapping_bands


@pytest.mark.parametrize(
    "shape", [(1, 1), (1, 100_000), (7, 200_000), (1080, 1920, 3), (2160, 3840), (5000, 1), (0, 4)]
)
@pytest.mark.parametrize("channels", [1, 3])
def test_every_row_is_in_one_band(shape, channels):
    rows = [row for band in bands(shape, channels) for row in range(shape[0])[band]]
    assert rows == list(range(shape[0]))


def test_bands_hold_about_as_many_values_whatever_the_width():
    for width in (1920, 3840):
        band = next(iter(bands((2160, width))))
        assert 200_000 < (band.stop - band.start) * width * 3 < 400_000


def test_a_plane_is_the_same_in_all_channels():
    plane = np.random.default_rng(0).random((4, 5), np.float32)
    spread = in_all_channels(plane)
    assert spread.shape == (4, 5, 3)
    assert all(np.array_equal(spread[..., c], plane) for c in range(3))


@pytest.mark.parametrize("count", [0, 1, 4, 5, 9])
def test_every_value_is_in_one_block(count):
    parts = [range(count)[part] for part in blocks(count, together=4)]
    assert [place for part in parts for place in part] == list(range(count))
    assert all(len(part) == 4 for part in parts[:-1])


@pytest.mark.parametrize("height", [0, 1, 15, 191, 192, 1080, 1081, 2160])
@pytest.mark.parametrize("reach", [0, 1, 60, 5000])
def test_bands_with_what_lies_around_them_make_up_the_picture(height: int, reach: int) -> None:
    seen = np.zeros(height, int)
    for rows, own in overlapping_bands(height, reach):
        seen[rows][own] += 1
        first, last = rows.start + own.start, rows.start + own.stop
        assert first % 16 == 0
        assert rows.start == max(first - reach, 0)
        assert rows.stop == min(last + reach, height)
    assert (seen == 1).all()


@pytest.mark.parametrize(("height", "reach"), [(1080, 8), (1080, 60), (2160, 60), (2160, 84)])
def test_less_is_read_twice_than_once_and_bands_are_alike(height: int, reach: int) -> None:
    bands = overlapping_bands(height, reach)
    read = sum(rows.stop - rows.start for rows, _ in bands)
    assert read < 1.5 * height
    own = [inner.stop - inner.start for _, inner in bands]
    assert max(own) - min(own) < max(own) / 2
