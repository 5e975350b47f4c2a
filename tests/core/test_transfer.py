import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowtool.choices import TRANSFER_NAMES
from shadowtool.core.transfer import TRANSFERS, decode_srgb, encode_rec709

NAMES = sorted(TRANSFERS)


@pytest.mark.parametrize("name", NAMES)
@given(value=st.floats(-4, 4, width=32))
def test_encode_undoes_decode(name: str, value: float) -> None:
    curve = TRANSFERS[name]
    assert curve.encode(curve.decode(np.float32([value])))[0] == pytest.approx(value, abs=2e-5)


@pytest.mark.parametrize("name", NAMES)
def test_black_white_and_order_are_kept(name: str) -> None:
    for curve in TRANSFERS[name]:
        ramp = curve(np.linspace(-0.5, 2, 1001, dtype=np.float32))
        assert (np.diff(ramp) > 0).all()
        assert curve(np.float32([0, 1])) == pytest.approx([0, 1], abs=1e-6)
        assert ramp.dtype == np.float32


@pytest.mark.parametrize("name", NAMES)
def test_nan_and_shape_pass_through(name: str) -> None:
    values = np.full((2, 3, 4), np.nan, np.float32)
    for curve in TRANSFERS[name]:
        assert np.isnan(curve(values)).all()
        assert curve(values).shape == values.shape


def test_published_values() -> None:
    # IEC 61966-2-1: code 0.5 in linear light. BT.709: mid grey is coded as 0.409.
    assert decode_srgb(np.float32([0.5]))[0] == pytest.approx(0.21404114, abs=1e-6)
    assert encode_rec709(np.float32([0.18]))[0] == pytest.approx(0.409, abs=3e-4)


def test_every_choice_but_auto_has_a_curve() -> None:
    assert set(TRANSFER_NAMES) - {"auto"} == set(TRANSFERS)
