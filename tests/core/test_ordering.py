import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.ordering import ascending


@given(
    hnp.arrays(
        np.float32,
        hnp.array_shapes(min_dims=1, max_dims=2, min_side=0, max_side=40),
        elements=st.floats(-4, 4, width=16),
    )
)
def test_values_are_put_in_the_order_of_a_stable_sort(values: np.ndarray) -> None:
    before = values.copy()
    assert np.array_equal(ascending(values), np.argsort(values, kind="stable"))
    assert np.array_equal(values, before)
