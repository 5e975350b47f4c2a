import cv2
import numpy as np
import pytest

from shadowtool.core.camera_motion import Vantage, displaced, prepare, shift
from tests.scene import waves


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


@pytest.mark.parametrize("seed", range(4))
def test_another_picture_is_no_movement(seed: int) -> None:
    assert shift(prepare(ground(seed)), prepare(ground(seed + 10)), 320) is None


def test_a_picture_without_texture_tells_nothing() -> None:
    blank = np.full((100, 100), 0.5, np.float32)
    assert shift(prepare(blank), prepare(blank), 100) is None


def test_next_to_no_texture_tells_nothing() -> None:
    """What a codec makes of it goes with whatever passes."""
    faint = (0.5 * np.exp(0.02 * (ground() - 0.5))).astype(np.float32)
    dragged = moved(faint, 0.6, 0.0)
    assert shift(prepare(faint), prepare(dragged), 320) is None
    assert Vantage.of(faint).off(dragged) == (0.0, 0.0)


def test_what_moves_in_a_corner_of_a_plain_picture_is_not_the_camera() -> None:
    corner = (slice(4, 78), slice(4, 78))
    plain = [0.5 * np.exp(0.18 * (ground(seed) - 0.5)).astype(np.float32) for seed in (1, 2)]
    plain[0][corner] *= np.exp(ground(3))[corner]
    plain[1][corner] *= np.exp(moved(ground(3), 0.6, 0.0))[corner]
    assert shift(prepare(plain[0]), prepare(plain[1]), 320) is None
    assert Vantage.of(plain[0]).off(plain[1]) == (0.0, 0.0)


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


def colours(gray: np.ndarray) -> np.ndarray:
    return (gray[..., None] * np.float32([1.0, 0.8, 0.6])).astype(np.float32)


@pytest.mark.parametrize("x, y", [(0.05, 0.0), (-0.1, 0.3), (0.7, -0.5), (4.0, 2.5)])
def test_a_place_is_found_past_what_moves_and_past_noise(x: float, y: float) -> None:
    shot = waves(x, y)
    shot[60:200, 100:220] *= 0.3
    shot += np.random.default_rng(0).normal(scale=0.005, size=shot.shape)
    for image in (shot.astype(np.float32), colours(shot)):
        assert Vantage.of(waves(0, 0)).off(image) == pytest.approx((x, y), abs=0.02)


def test_frames_that_are_in_place_are_left_alone() -> None:
    rng = np.random.default_rng(1)
    image = colours(waves(0, 0)).astype(np.float16)
    noisy = (image + rng.normal(scale=0.003, size=image.shape)).astype(np.float16)
    for other in (image, noisy, image[::-1], np.full_like(image, 0.5), image * np.float16(np.nan)):
        assert Vantage.of(image).off(other) == (0.0, 0.0)
    assert displaced(image, (0.0, 0.0)) is image


@pytest.mark.parametrize("period", [4.0, 6.0, 9.0])
def test_what_repeats_itself_is_not_followed_to_the_next_period(period: float) -> None:
    columns = np.arange(320.0)
    stripes = 0.5 + 0.3 * np.sin(2 * np.pi * columns / period)
    moved = 0.5 + 0.3 * np.sin(2 * np.pi * (columns - 0.2) / period)
    faint = 0.02 * waves(0, 0)
    one, other = (np.tile(s, (240, 1)) + faint for s in (stripes, moved))
    found = Vantage.of(one.astype(np.float32)).off(other.astype(np.float32))
    assert np.abs(found).max() < 0.5 * period


def test_a_vantage_amid_places_is_where_most_of_them_are() -> None:
    places = [(0.1, 0.0), (0.3, -0.2), (0.2, -0.1)]
    amid = Vantage.of(waves(0, 0)).amid(places)
    assert amid.off(waves(0.2, -0.1)) == (0.0, 0.0)
    assert amid.off(waves(0, 0)) == pytest.approx((-0.2, 0.1), abs=0.02)
    assert amid.amid([]) == amid


@pytest.mark.parametrize("x, y", [(0.1, -0.3), (0.5, 0.5), (-1.4, 0.0)])
def test_a_frame_is_seen_as_from_elsewhere(x: float, y: float) -> None:
    inner = slice(8, -8), slice(8, -8)
    for there, here in ((waves(x, y), waves(0, 0)), (colours(waves(x, y)), colours(waves(0, 0)))):
        seen = displaced(there.astype(np.float32), (x, y))
        assert np.abs(seen - here)[inner].max() < 0.05 * np.abs(there - here)[inner].max()


def test_rows_at_a_time_are_the_same_as_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    image = colours(waves(0, 0)).astype(np.float16)
    image[100, 50] = np.nan
    some = displaced(image, (0.3, -0.7))
    monkeypatch.setattr("shadowtool.core.camera_motion._ROWS", 1000)
    np.testing.assert_array_equal(displaced(image, (0.3, -0.7)), some)


def test_what_is_not_finite_stays_where_it_is() -> None:
    image = colours(waves(0, 0))
    image[120, 160, 1], image[40, 30] = np.nan, np.inf
    seen = displaced(image, (0.4, 0.2))
    assert np.array_equal(~np.isfinite(seen), ~np.isfinite(image))
    whole = displaced(np.nan_to_num(image, nan=0.5, posinf=0.5), (0.4, 0.2))
    changed = (seen != whole).any(axis=-1)
    rows, columns = np.nonzero(changed)
    assert rows.min() >= 36 and columns.min() >= 26 and changed.sum() <= 2 * 81


def test_a_highlight_leaves_no_dark_ring() -> None:
    image = np.full((40, 40, 3), 0.2, np.float32)
    image[20, 20] = 100.0
    seen = displaced(image, (0.3, 0.3))
    assert seen.min() >= 0.1 and seen.max() > 50
