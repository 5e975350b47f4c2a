import numpy as np
import pytest

from shadowtool.core.lengths import length


def test_lengths_are_those_of_pythagoras():
    x, y = np.float32([[3, -5, 0, np.inf, np.nan], [4, 12, 0, 1, 1]])
    np.testing.assert_array_equal(length(x, y), [5, 13, 0, np.inf, np.nan])
    assert length(x, y, out=x) is x
    np.testing.assert_array_equal(x, [5, 13, 0, np.inf, np.nan])


@pytest.mark.parametrize("offsets", [(4, 0, 0), (0, 12, 0), (0, 0, 4), (0, 0, 16), (8, 4, 20)])
def test_bits_do_not_depend_on_where_arrays_lie(offsets):
    rng = np.random.default_rng(1)
    values = rng.random((3, 1001), np.float32)
    expected = length(values[0], values[1])
    room = [np.zeros(1100, np.float32) for _ in range(3)]
    starts = [-part.ctypes.data % 64 // 4 for part in room]
    x, y, out = (
        part[start + offset // 4 :][:1001]
        for part, start, offset in zip(room, starts, offsets, strict=True)
    )
    x[:], y[:] = values[:2]
    np.testing.assert_array_equal(length(x, y, out), expected)
