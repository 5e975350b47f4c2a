import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowtool.core.chroma import chroma_at_luma

SIZES = [(1, 1), (1, 2), (2, 1), (2, 2)]


def sampled(chroma: np.ndarray, down: int, across: int) -> np.ndarray:
    """Every second column, smoothed, and the mean of two rows."""
    if across == 2:
        beside = np.pad(chroma, ((0, 0), (1, 1)), mode="edge")
        chroma = ((beside[:, :-2] + 2 * chroma + beside[:, 2:]) / 4)[:, ::2]
    if down == 2:
        chroma = (chroma[::2] + chroma[1::2]) / 2
    return chroma.astype(np.float32)


@pytest.mark.parametrize("down, across", SIZES)
def test_a_shadows_edge_is_as_sharp_in_chroma_as_in_luma(down: int, across: int) -> None:
    rows, columns = np.mgrid[:60, :80]
    texture = np.random.default_rng(0).uniform(0.9, 1.1, (60, 80))
    luma = (texture * np.where(columns + rows / 3 < 43, 0.6, 0.2)).astype(np.float32)
    chroma = 0.3 * luma
    coarse = sampled(chroma, down, across)
    found = chroma_at_luma(coarse, luma)
    plain = np.repeat(np.repeat(coarse, down, axis=0), across, axis=1)
    assert np.abs(found - chroma).max() < 0.01
    if (down, across) != (1, 1):
        assert np.abs(plain - chroma).max() > 0.03


@pytest.mark.parametrize("down, across", SIZES)
def test_colour_of_even_brightness_is_drawn_between_the_samples(down: int, across: int) -> None:
    rows, columns = np.mgrid[:40, :60]
    chroma = np.sin(rows / 9) * np.cos(columns / 11)
    found = chroma_at_luma(sampled(chroma, down, across), np.full((40, 60), 0.5, np.float32))
    assert np.abs(found - chroma)[3:-3, 3:-3].max() < 0.02


@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from(SIZES), st.integers(0, 2**32 - 1))
def test_pictures_of_any_size_get_as_much_chroma_as_luma(
    height: int, width: int, factors: tuple[int, int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    luma = rng.random((height, width), np.float32)
    shape = [-(-size // factor) for size, factor in zip(luma.shape, factors, strict=True)]
    chroma = rng.uniform(-0.5, 0.5, shape).astype(np.float32)
    before = chroma.copy(), luma.copy()
    found = chroma_at_luma(chroma, luma)
    assert found.shape == luma.shape and found.dtype == np.float32
    assert np.isfinite(found).all()
    assert np.array_equal(before[0], chroma) and np.array_equal(before[1], luma)
    level = np.full(shape, 0.25, np.float32)
    assert chroma_at_luma(level, luma) == pytest.approx(0.25, abs=1e-5)
