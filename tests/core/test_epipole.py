import numpy as np
import pytest

from shadowtool.core.epipole import Epipole, find_epipole
from shadowtool.core.warp_map import identity_map

POSITIONS = identity_map(90, 160)


def displaced(
    point: tuple[float, float, float], noise: float = 0.0, part: float = 0.3
) -> tuple[np.ndarray, np.ndarray]:
    """A map whose left part is displaced towards a homogeneous point by 5 to 30 pixels."""
    rng = np.random.default_rng(0)
    x, y, w = point
    toward = np.stack([x - w * POSITIONS[..., 0], y - w * POSITIONS[..., 1]], axis=-1)
    toward /= np.linalg.norm(toward, axis=-1, keepdims=True)
    length = np.where(POSITIONS[..., 0] < part * 160, rng.uniform(5, 30, (90, 160)), 0)
    warp = POSITIONS + length[..., None] * toward
    warp += rng.normal(scale=noise, size=warp.shape)
    error = np.full((90, 160), max(noise, 0.05), np.float32)
    return warp.astype(np.float32), error


def angle_off(found: Epipole, point: tuple[float, float, float]) -> float:
    """The largest angle between found and true directions, radians, whichever way they point."""
    x, y, w = point
    true = np.stack([x - w * POSITIONS[..., 0], y - w * POSITIONS[..., 1]], axis=-1)
    true /= np.linalg.norm(true, axis=-1, keepdims=True)
    directions = found.directions(POSITIONS)
    cross = directions[..., 0] * true[..., 1] - directions[..., 1] * true[..., 0]
    return float(np.abs(cross).max())


@pytest.mark.parametrize(
    "point", [(-300.0, 400.0, 1.0), (900.0, -50.0, 1.0), (0.6, 0.8, 0.0), (80.0, -700.0, 1.0)]
)
def test_the_light_is_found_near_and_at_infinity(point: tuple[float, float, float]) -> None:
    found = find_epipole(*displaced(point), POSITIONS)
    assert found is not None
    assert angle_off(found, point) < 1e-3
    if point[2]:
        assert found.position == pytest.approx(point[:2], rel=0.01, abs=2)
    else:
        assert np.abs(found.position).max() > 1e4


def test_noise_and_a_part_that_is_wrong_do_no_harm() -> None:
    point = (-300.0, 400.0, 1.0)
    warp, error = displaced(point, noise=0.3)
    rng = np.random.default_rng(1)
    wrong = rng.uniform(size=error.shape) < 0.1
    warp[wrong] += rng.uniform(-20, 20, (int(wrong.sum()), 2)).astype(np.float32)
    found = find_epipole(warp, error, POSITIONS)
    assert found is not None
    assert angle_off(found, point) < 0.03


def test_nothing_is_made_up_where_nothing_stands_on_the_plane() -> None:
    rng = np.random.default_rng(0)
    error = np.full((90, 160), 0.3, np.float32)
    flat = (POSITIONS + rng.normal(scale=0.3, size=POSITIONS.shape)).astype(np.float32)
    assert find_epipole(flat, error, POSITIONS) is None
    assert find_epipole(np.full_like(flat, np.nan), np.full_like(error, np.inf), POSITIONS) is None


def test_displacements_without_a_common_point_have_none() -> None:
    rng = np.random.default_rng(0)
    warp = (POSITIONS + rng.uniform(-20, 20, POSITIONS.shape)).astype(np.float32)
    assert find_epipole(warp, np.full((90, 160), 0.2, np.float32), POSITIONS) is None


def test_directions_are_of_unit_length_even_at_the_point_itself() -> None:
    epipole = Epipole(np.array([0.0, 0.0, 1.0]), np.array([80.0, 40.0]), 100.0, 0.1)
    directions = epipole.directions(POSITIONS)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1)
    assert directions[40, 0] == pytest.approx([1, 0]) and directions[40, 159] == pytest.approx(
        [-1, 0]
    )
