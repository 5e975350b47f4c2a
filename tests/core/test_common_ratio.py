"""What S/L the shadows of a scene have in common, and how far points differ from it."""

import numpy as np
import pytest

from shadowtool.core.common_ratio import common_ratio, ratio_scatter, usually_bright
from shadowtool.core.noise import NoiseModel

SIZE = (90, 160)
RATIO = np.array([0.2, 0.25, 0.32])
SIGMA = 0.001
NOISE = NoiseModel(np.zeros(3), np.full(3, SIGMA**2))


def samples(scatter: float, gradient: float = 0.0) -> np.ndarray:
    """(T, 3, N) of ground that a wide shadow crosses, whose S/L scatters from point to point and
    changes across the picture; logarithms."""
    rng = np.random.default_rng(3)
    columns = np.arange(SIZE[1])
    lit = rng.uniform(0.3, 0.8, (3, *SIZE))
    rough = scatter * rng.standard_normal(SIZE) + gradient * (columns / SIZE[1] - 0.5)
    shadow = lit * RATIO[:, np.newaxis, np.newaxis] * np.exp(rough)
    taken = []
    for middle in np.linspace(-40, SIZE[1] + 40, 20):
        beta = np.clip((np.abs(columns - middle) - 25) / 6, 0, 1)
        image = beta * lit + (1 - beta) * shadow
        taken.append((image + rng.normal(0, SIGMA, image.shape)).reshape(3, -1))
    return np.stack(taken).astype(np.float32)


def brightest(stack: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What points usually are in light, and the order of their samples."""
    ascending = np.argsort(stack.sum(axis=1), axis=0)
    return usually_bright(stack, ascending), ascending


def ratio_of(stack: np.ndarray) -> np.ndarray:
    found = common_ratio(stack, *brightest(stack), NOISE, SIZE)
    assert found is not None
    return found


@pytest.mark.parametrize("scatter", [0.0, 0.03, 0.15])
def test_the_ratio_is_found_however_it_scatters(scatter: float) -> None:
    assert np.median(ratio_of(samples(scatter)), axis=1) == pytest.approx(RATIO, rel=0.06)


@pytest.mark.parametrize("scatter", [0.03, 0.08, 0.15])
@pytest.mark.parametrize("gradient", [0.0, 0.4])
def test_scatter_is_told_from_a_ratio_that_changes_across_the_picture(
    scatter: float, gradient: float
) -> None:
    stack = samples(scatter, gradient)
    found = ratio_scatter(stack, brightest(stack)[0], NOISE, ratio_of(stack), SIZE)
    assert found == pytest.approx(scatter, rel=0.25)


def test_noise_is_no_scatter() -> None:
    stack = samples(0.0)
    assert ratio_scatter(stack, brightest(stack)[0], NOISE, ratio_of(stack), SIZE) < 0.01


def test_where_nothing_is_in_shade_nothing_scatters() -> None:
    stack = np.repeat(samples(0.1)[:1], 12, axis=0)
    stack += np.random.default_rng(0).normal(0, SIGMA, stack.shape).astype(np.float32)
    ratio = np.full(stack.shape[1:], 0.25, np.float32)
    assert ratio_scatter(stack, brightest(stack)[0], NOISE, ratio, SIZE) == 0
