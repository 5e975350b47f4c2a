import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from shadowtool.core.boxes import around

SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))


@given(hnp.arrays(bool, SIZES), st.integers(0, 4))
def test_a_box_holds_the_mask_and_its_margin_and_no_more(mask: np.ndarray, margin: int) -> None:
    box = around(mask, margin)
    places = np.argwhere(mask)
    if box is None:
        assert not len(places)
        return
    first = np.maximum(places.min(axis=0) - margin, 0)
    last = np.minimum(places.max(axis=0) + margin + 1, mask.shape)
    assert box == (slice(first[0], last[0]), slice(first[1], last[1]))


def test_a_picture_without_pixels_has_none() -> None:
    assert around(np.zeros((0, 5), bool), 2) is None
