import numpy as np
import pytest

from shadowtool.core.trembling import off_place, strips, tremble
from tests.scene import waves


def trembling(
    amount: float, noise: float = 0.003, frames: int = 16, brighter: float = 0.0
) -> tuple[list[np.ndarray], float]:
    """A camera that trembles while a board's shadow crosses, and by how much it did."""
    rng = np.random.default_rng(2)
    places = rng.normal(scale=amount, size=(frames, 2)) if amount else np.zeros((frames, 2))
    shots = []
    for number, (x, y) in enumerate(places):
        shot = waves(x, y)
        shot[:, 18 * number : 18 * number + 50] *= 0.3
        shot *= 1 + brighter * number
        shots.append((shot + rng.normal(scale=noise, size=shot.shape)).astype(np.float16))
    return shots, float(np.sqrt(np.var(places, axis=0).mean()))


@pytest.mark.parametrize("amount", [0.05, 0.1, 0.3])
@pytest.mark.parametrize("brighter", [0.0, 0.01])
def test_a_trembling_camera_is_measured_past_what_moves(amount: float, brighter: float) -> None:
    shots, true = trembling(amount, brighter=brighter)
    assert tremble([strips(shot) for shot in shots]) == pytest.approx(true, rel=0.15)


@pytest.mark.parametrize("noise", [0.0005, 0.003, 0.02])
def test_a_camera_that_stands_still_does_not_tremble(noise: float) -> None:
    shots, _ = trembling(0.0, noise)
    assert tremble([strips(shot) for shot in shots]) < 0.01


@pytest.mark.parametrize("noise", [0.05, 0.1])
def test_much_noise_is_no_trembling(noise: float) -> None:
    shots, _ = trembling(0.0, noise)
    assert tremble([strips(shot) for shot in shots]) < 0.03


def test_where_nothing_tells_the_camera_stands_still() -> None:
    flat = np.full((30, 40), 0.5, np.float16)
    unknown = np.full((30, 40), np.nan, np.float16)
    small = flat[:1, :2]
    for shots in ([], [flat], [flat, flat], [unknown, flat], [unknown, unknown], [small, small]):
        assert tremble([strips(shot) for shot in shots]) < 1e-3


def test_a_camera_that_was_bumped_stands_still_elsewhere() -> None:
    shots, _ = trembling(0.0)
    bumped = [strips(shot.astype(np.float16)) for shot in (waves(0.2, -0.2), waves(0.2, -0.2))]
    assert off_place(strips(shots[0]), bumped) == pytest.approx(0.2, rel=0.15)
    assert tremble(bumped) == 0
    assert off_place(strips(shots[0]), []) == 0
