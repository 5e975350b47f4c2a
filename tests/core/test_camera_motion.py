import cv2
import numpy as np
import pytest

from shadowtool.core.camera_motion import prepare, shift, strips, tremble


def ground(seed: int = 0, size: tuple[int, int] = (240, 320)) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0.1, 0.9, size).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), 2.0)


def moved(image: np.ndarray, x: float, y: float) -> np.ndarray:
    matrix = np.float32([[1, 0, x], [0, 1, y]])
    return cv2.warpAffine(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("x, y", [(0.0, 0.0), (0.3, 0.0), (-0.7, 1.1), (3.0, -2.0)])
def test_a_moved_camera_is_measured_below_a_tenth_of_a_pixel(x: float, y: float) -> None:
    image = ground()
    found = shift(prepare(image), prepare(moved(image, x, y)), image.shape[1])
    assert found == pytest.approx(np.hypot(x, y), abs=0.1)


def test_large_frames_are_measured_in_their_own_pixels() -> None:
    image = cv2.resize(ground(), (1600, 1200), interpolation=cv2.INTER_CUBIC)
    found = shift(prepare(image), prepare(moved(image, 2.0, 0.0)), 1600)
    assert found == pytest.approx(2.0, abs=0.2)


def test_a_shadow_that_moves_is_not_the_camera() -> None:
    image = ground()
    shaded = image.copy()
    shaded[60:200, 100:220] *= 0.2
    assert shift(prepare(image), prepare(shaded), image.shape[1]) == pytest.approx(0, abs=0.05)


def test_a_picture_without_texture_tells_nothing() -> None:
    blank = np.full((100, 100), 0.5, np.float32)
    assert shift(prepare(blank), prepare(blank), 100) is None


def test_grain_that_shows_one_direction_only_is_no_movement() -> None:
    rng = np.random.default_rng(3)
    rows = np.repeat(rng.uniform(0.2, 0.6, (120, 1)), 200, axis=1)
    grain = cv2.GaussianBlur(rows, (0, 0), 1.5)
    # A little else along the grain, drowned in the noise of each frame.
    grain = grain + cv2.GaussianBlur(rng.normal(scale=0.05, size=grain.shape), (0, 0), 2.0)
    frames = [
        (grain + cv2.GaussianBlur(rng.normal(scale=0.08, size=grain.shape), (0, 0), 1.5)).astype(
            "f4"
        )
        for _ in range(8)
    ]
    first = prepare(frames[0])
    found = [shift(first, prepare(frame), 200) for frame in frames[1:]]
    assert max(value for value in found if value is not None) < 0.3


def waves(x: float, y: float) -> np.ndarray:
    """A texture that can be moved by any part of a pixel, (240, 320)."""
    rng = np.random.default_rng(4)
    rows, columns = np.mgrid[:240, :320]
    total = np.zeros((240, 320))
    for _ in range(40):
        a, b, phase = rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), rng.uniform(0, 7)
        total += np.sin(a * (columns - x) + b * (rows - y) + phase)
    return 0.5 * np.exp(0.05 * total)


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


def test_where_nothing_tells_the_camera_stands_still() -> None:
    flat = np.full((30, 40), 0.5, np.float16)
    unknown = np.full((30, 40), np.nan, np.float16)
    small = flat[:1, :2]
    for shots in ([], [flat], [flat, flat], [unknown, flat], [unknown, unknown], [small, small]):
        assert tremble([strips(shot) for shot in shots]) < 1e-3
