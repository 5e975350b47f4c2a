import numpy as np
import pytest

from shadowtool.core.filling import fill_membrane


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (33, 57)])
def test_filling_works_at_any_size(shape: tuple[int, int]) -> None:
    values = np.full((*shape, 2), 3.0, np.float32)
    weight = np.zeros(shape, np.float32)
    weight[0, 0] = 1
    values[weight == 0] = 99
    assert fill_membrane(values, weight) == pytest.approx(3.0)
    assert (fill_membrane(values, np.zeros(shape, np.float32)) == 0).all()


def test_known_values_stay_and_holes_lie_between_them() -> None:
    ramp = np.tile(np.arange(40, dtype=np.float32), (30, 1))[..., None]
    weight = np.ones((30, 40), np.float32)
    weight[10:20, 12:28] = 0
    filled = fill_membrane(np.where(weight[..., None] > 0, ramp, np.float32(-99)), weight)
    assert np.array_equal(filled[weight > 0], ramp[weight > 0])
    # A ramp has no Laplacian: it is what the membrane should come to.
    assert filled == pytest.approx(ramp, abs=0.25)


def test_only_the_rim_of_a_hole_counts() -> None:
    values = np.ones((40, 60, 1), np.float32)
    values[8:32, 10:40] = 0.25
    weight = np.ones((40, 60), np.float32)
    weight[12:28, 15:36] = 0
    filled = fill_membrane(np.where(weight[..., None] > 0, values, np.float32(7)), weight)
    assert filled[12:28, 15:36] == pytest.approx(0.25, abs=0.01)
