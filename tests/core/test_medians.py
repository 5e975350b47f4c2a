"""Medians are numpy's."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core import medians
from shadowtool.core.medians import known_median, median

VALUES = st.one_of(st.floats(-1e6, 1e6, width=32), st.just(float("nan")))
PICTURES = hnp.arrays(
    np.float32, hnp.array_shapes(min_dims=1, max_dims=3, min_side=1, max_side=9), elements=VALUES
)


@pytest.mark.filterwarnings("ignore:invalid value")
@given(PICTURES, st.sampled_from([0, 4, 9]), st.data())
def test_the_median_is_numpys_along_any_axis(values, few, data):
    axis = data.draw(st.integers(0, values.ndim - 1))
    before = values.copy()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(medians, "_FEW", few)
        found = median(values, axis)
    np.testing.assert_array_equal(found, np.median(values, axis=axis))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(values, before)


@given(PICTURES)
def test_the_median_of_what_is_known_has_as_many_below_as_above(values):
    for middle, own in zip(
        known_median(values).ravel(), values.reshape(-1, values.shape[-1]), strict=True
    ):
        own = np.sort(own[~np.isnan(own)])
        if own.size:
            assert middle == own[(own.size - 1) // 2]
        else:
            assert np.isnan(middle)
