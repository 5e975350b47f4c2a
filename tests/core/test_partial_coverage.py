from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core.noise import NoiseModel
from shadowtool.core.partial_coverage import Completed, complete_shadow
from tests.scene import smoothstep

HEIGHT, WIDTH = 90, 160
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
RATIO = np.array([0.12, 0.15, 0.24])
SIGMA = 0.002
NOISE = NoiseModel(np.zeros(3), np.full(3, SIGMA**2))


class Take(NamedTuple):
    """What the frames of a take say, and the truth."""

    lit: np.ndarray
    measured: np.ndarray
    frames: np.ndarray
    truth: np.ndarray
    reached: np.ndarray

    def completed(
        self, plane: np.ndarray | None = None, ratio: np.ndarray | None = None
    ) -> Completed:
        return complete_shadow(self.lit, self.measured, self.frames, NOISE, plane, ratio=ratio)

    def error(self, found: np.ndarray) -> np.ndarray:
        """Of S, as a part of it, (H, W)."""
        return np.abs(np.log(found.sum(axis=-1) / self.truth.sum(axis=-1)))


def texture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.25, 0.8, (HEIGHT, WIDTH, 3))


def crossed(ratio: np.ndarray, reached: np.ndarray, seed: int = 0, frames: int = 9) -> Take:
    """A scene of which a shadow reached a part.

    Args:
        ratio: S/L, (H, W, 3) or (3,).
        reached: (H, W), the least β of each pixel in the take.
    """
    rng = np.random.default_rng(seed)
    lit = texture(seed).astype(np.float32)
    truth = (lit * ratio).astype(np.float32)
    darkest = truth + reached[..., None] * (lit - truth)
    noise = rng.normal(0, SIGMA / np.sqrt(frames), lit.shape)
    measured = np.where(reached[..., None] < 0.97, darkest + noise, np.nan).astype(np.float32)
    count = np.where(reached < 0.97, frames, 0).astype(np.uint32)
    return Take(lit, measured, count, truth, reached)


def band(soft: float = 10) -> np.ndarray:
    """β reached by a shadow that went along the middle rows."""
    return smoothstep((np.abs(ROWS - 45) - 15) / soft)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 99), st.floats(5, 10), st.sampled_from([0.5, 1.0, 2.0]))
def test_on_a_plane_the_shadow_is_near_the_truth_everywhere(
    seed: int, soft: float, depth: float
) -> None:
    take = crossed(RATIO * depth, band(soft), seed)
    found = take.completed()
    assert found.partial
    error = take.error(found.shadow)
    penumbra, beyond = (take.reached > 0) & (take.frames > 0), take.frames == 0
    assert error[take.reached == 0].mean() < 0.02
    assert error[beyond].mean() < 0.05 and np.quantile(error[beyond], 0.95) < 0.12
    assert error[penumbra].mean() < 0.06
    # As measured it would be far from the shadow there.
    assert take.error(take.measured)[penumbra].mean() > 0.4


def test_a_pixel_tells_by_itself_where_the_shadow_fell_in_full() -> None:
    take = crossed(RATIO, band())
    found = take.completed()
    assert (found.own[np.abs(ROWS - 45) < 14] == 1).all()
    assert found.own[take.frames == 0].max() == 0
    assert found.own[(take.reached > 0.3) & (take.frames > 0)].mean() < 0.2
    assert found.own.min() >= 0 and found.own.max() <= 1
    assert np.isfinite(found.shadow).all() and found.shadow.dtype == np.float32


def test_few_dark_frames_give_way_to_the_planes_ratio() -> None:
    take = crossed(RATIO, band())
    spot = slice(44, 47), slice(50, 53)
    take.measured[spot] = 0.2 * take.truth[spot]
    take.frames[spot] = 1
    found = take.completed()
    assert take.error(found.shadow)[spot].max() < take.error(take.measured)[spot].min() / 2


def test_noisy_dark_frames_lean_on_the_planes_ratio() -> None:
    take = crossed(RATIO, band(), frames=3)
    grain = np.random.default_rng(1).normal(0, 10 * SIGMA / np.sqrt(3), take.truth.shape)
    measured = (take.measured + grain).astype(np.float32)
    noise = NoiseModel(np.zeros(3), np.full(3, (10 * SIGMA) ** 2))
    found = complete_shadow(take.lit, measured, take.frames, noise)
    inside = take.reached == 0
    assert take.error(found.shadow)[inside].mean() < 0.8 * take.error(measured)[inside].mean()


@pytest.mark.parametrize("frames", [1, 2])
def test_in_a_take_of_few_frames_the_few_tell(frames: int) -> None:
    take = crossed(RATIO, band(), frames=frames)
    for plane in (None, ROWS >= 0):
        completed = take.completed(plane)
        assert completed.partial
        assert np.percentile(take.error(completed.shadow), 95) < 0.1


def test_a_region_makes_a_plane_of_what_it_marks_whatever_is_known() -> None:
    take = crossed(RATIO, np.ones((HEIGHT, WIDTH)))
    assert take.completed(ROWS > 30).partial


def test_a_slowly_varying_ratio_is_followed() -> None:
    slope = np.exp(0.35 * (COLUMNS / WIDTH - 0.5))[..., None]
    take = crossed(RATIO * slope, band())
    error = take.error(take.completed().shadow)
    beyond = take.frames == 0
    assert error[beyond].mean() < 0.06
    common = take.lit * RATIO.astype(np.float32)
    assert error[beyond].mean() < take.error(common)[beyond].mean() / 2


def test_another_surface_on_the_plane_keeps_its_own_shadow() -> None:
    ratio = np.tile(RATIO, (HEIGHT, WIDTH, 1))
    ratio[35:55, 60:90] *= 2.5
    take = crossed(ratio, band())
    inside = slice(38, 52), slice(63, 87)
    assert take.error(take.completed().shadow)[inside].max() < 0.05


def test_a_surface_keeps_its_own_shadow_through_noise() -> None:
    ratio = np.tile(RATIO, (HEIGHT, WIDTH, 1))
    ratio[35:55, 60:90] *= 1.6
    take = crossed(ratio, band(), frames=4)
    grain = np.random.default_rng(1).normal(0, 10 * SIGMA / np.sqrt(4), take.truth.shape)
    measured = (take.measured + grain).astype(np.float32)
    noise = NoiseModel(np.zeros(3), np.full(3, (10 * SIGMA) ** 2))
    found = complete_shadow(take.lit, measured, take.frames, noise)
    inside = slice(38, 52), slice(63, 87)
    assert np.median(take.error(found.shadow)[inside]) < 0.1


def test_a_thin_shadow_tells_the_ratio_too() -> None:
    """Somebody slow, under a low sun."""
    reached = np.minimum(smoothstep((np.abs(ROWS - 40) - 1.5) / 2), 1)
    take = crossed(RATIO, reached)
    found = take.completed()
    assert found.partial
    beyond = take.frames == 0
    assert np.median(take.error(found.shadow)[beyond]) < 0.1


def test_a_few_pixels_in_one_partial_shadow_are_no_surface() -> None:
    """Where a thin shadow went by in few frames some pixels darken alike, in part."""
    reached = band()
    for column in range(10, 150, 30):
        reached[37:52, column : column + 15] = 0.5
    take = crossed(RATIO, reached)
    assert np.quantile(take.error(take.completed().shadow)[36:54], 0.99) < 0.15


def surfaces() -> np.ndarray:
    """S/L of a scene of many different surfaces, (H, W, 3)."""
    levels = np.random.default_rng(5).uniform(0.08, 0.6, (6, 8))
    return np.kron(levels, np.ones((15, 20)))[..., None] * np.array([0.9, 1, 1.2])


def carded() -> Take:
    """Such a scene under a card, with a part in shade of its own that nothing darkened."""
    own_shade = (COLUMNS > 140) | ((ROWS - 20) ** 2 + (COLUMNS - 40) ** 2 < 100)
    take = crossed(surfaces(), own_shade.astype(float))
    take.lit[own_shade] *= 0.15
    return take


def test_specks_of_something_else_in_the_shadow_are_no_surface() -> None:
    take = crossed(RATIO, band())
    specks = np.zeros((HEIGHT, WIDTH), bool)
    specks[45, 20:140:17] = specks[40, 33:36] = True
    take.measured[specks] = 0.7 * take.lit[specks]
    completed = take.completed()
    assert (completed.own[specks] == 0).all()
    assert take.error(completed.shadow)[specks].max() < 0.15


def test_under_a_card_the_shadow_is_left_as_measured() -> None:
    take = carded()
    found = take.completed()
    assert not found.partial
    shaded = take.frames > 0
    assert found.shadow[shaded] == pytest.approx(take.measured[shaded], rel=1e-6)


def test_a_card_that_went_by_quickly_is_one_too() -> None:
    # Most pixels were in full shadow for a frame or two.
    take = crossed(surfaces(), np.zeros((HEIGHT, WIDTH)), frames=1)
    take = take._replace(frames=np.where(COLUMNS < 60, 4, 1).astype(np.uint32))
    found = take.completed()
    assert not found.partial
    assert np.percentile(take.error(found.shadow), 90) < 0.05


def test_under_a_card_what_was_never_darkened_stays_lit() -> None:
    take = carded()
    never = take.frames == 0
    assert np.array_equal(take.completed().shadow[never], take.lit[never])


def test_light_that_the_card_missed_is_told_from_shade_and_from_the_sky() -> None:
    missed, sky = COLUMNS > 140, ROWS < 20
    # At its rim only the card's penumbra fell.
    reached = np.maximum(smoothstep((COLUMNS - 128) / 12), sky)
    take = crossed(RATIO, reached)
    take.lit[sky] = np.float32([0.2, 0.45, 0.9])
    take.lit[missed & (ROWS > 70)] *= np.float32(0.15)
    shadow = take.completed().shadow
    ground = (COLUMNS > 120) & (ROWS > 30) & (ROWS < 60)
    assert np.percentile(take.error(shadow)[ground], 90) < 0.1
    for alone in (sky & (ROWS < 12), missed & (ROWS > 78)):
        assert np.array_equal(shadow[alone], take.lit[alone])


def test_shade_beside_something_black_is_not_taken_for_light_that_the_card_missed() -> None:
    shade, black = (np.abs(COLUMNS - 60) < 12) & (ROWS > 20), np.abs(COLUMNS - 84) < 12
    take = crossed(surfaces(), shade.astype(float))
    take.lit[shade] *= np.float32(0.2)
    take.lit[black] *= np.float32(0.02)
    take.measured[black] *= np.float32(0.02)
    assert np.array_equal(take.completed().shadow[shade], take.lit[shade])


def test_a_region_confines_what_the_plane_says() -> None:
    take = crossed(RATIO, band())
    plane = COLUMNS < 80
    found = take.completed(plane)
    outside = take.frames > 0
    outside &= ~plane
    assert found.shadow[outside] == pytest.approx(take.measured[outside], rel=1e-6)
    never = (take.frames == 0) & ~plane
    assert np.array_equal(found.shadow[never], take.lit[never])
    error = take.error(found.shadow)
    assert error[plane & (take.frames == 0)].mean() < 0.05


def test_the_region_alone_tells_the_ratio() -> None:
    left, right = RATIO, RATIO * 2.2
    ratio = np.where((COLUMNS < 40)[..., None], left, right)
    take = crossed(ratio, band())
    plane = COLUMNS < 40
    error = take.error(take.completed(plane).shadow)
    assert error[plane & (take.frames == 0)].mean() < 0.06


def test_with_a_region_a_scene_under_a_card_is_completed_there_alone() -> None:
    take = carded()
    take.truth[60:] = take.lit[60:] * RATIO.astype(np.float32)
    reached = np.where((ROWS >= 60) & (COLUMNS > 120), 1, take.reached)
    shaded = (reached == 0)[..., None]
    take = take._replace(
        measured=np.where(shaded, take.truth, np.float32(np.nan)),
        frames=np.where(reached == 0, 9, 0).astype(np.uint32),
    )
    found = take.completed(ROWS >= 60)
    assert take.error(found.shadow)[60:].mean() < 0.03
    above = (take.frames > 0) & (ROWS < 60)
    assert found.shadow[above] == pytest.approx(take.measured[above], rel=1e-6)


def test_where_nothing_was_shaded_the_shadow_is_the_light() -> None:
    take = crossed(RATIO, np.ones((HEIGHT, WIDTH)))
    found = take.completed()
    assert np.array_equal(found.shadow, take.lit)
    assert not found.partial and (found.own == 0).all()


def test_what_climbs_everywhere_tells_no_ratio() -> None:
    take = crossed(RATIO, np.clip((ROWS + 2) / 12, 0, 1))
    found = take.completed()
    assert np.isfinite(found.shadow).all()
    assert np.array_equal(found.shadow[take.frames == 0], take.lit[take.frames == 0])


@pytest.mark.parametrize("plane", [None, ROWS > 30])
def test_a_pixel_seen_in_no_frame_stays_unknown_and_alone(plane: np.ndarray | None) -> None:
    whole = crossed(RATIO, band())
    take = crossed(RATIO, band())
    for spot in ((45, 80), (5, 5)):
        take.lit[spot] = take.measured[spot] = np.nan
        take.frames[spot] = 0
    found = take.completed(plane).shadow
    assert np.isnan(found).any(axis=-1).sum() == 2
    known = np.isfinite(found)
    assert np.abs(found - whole.completed(plane).shadow)[known].max() < 0.01


def test_inputs_are_left_alone() -> None:
    take, again = crossed(RATIO, band()), crossed(RATIO, band())
    take.completed().shadow[:] = 7
    for name in ("lit", "measured", "frames"):
        assert np.array_equal(getattr(take, name), getattr(again, name), equal_nan=True)


def test_black_pixels_are_no_trouble() -> None:
    take = crossed(RATIO, band())
    for plate in (take.lit, take.measured):
        plate[40:50, 20:30] = 0
        plate[5:10, 20:30] = np.where(np.isnan(plate[5:10, 20:30]), np.nan, 0)
    take.lit[5:10, 20:30] = 0
    found = take.completed().shadow
    assert np.isfinite(found).all() and np.abs(found[5:10, 20:30]).max() < 0.01


@pytest.mark.parametrize("left", [0.95, 0.8])
def test_what_takes_some_of_the_sky_is_no_shadow(left: float) -> None:
    """Around the feet of somebody with a short shadow, level and as often as the shadow."""
    reached = np.minimum(smoothstep((np.abs(ROWS - 20) - 6) / 4), 1)
    reached[45:85, 20:140] = left
    take = crossed(RATIO, reached)
    alone, told = take.completed(), take.completed(ratio=RATIO.astype(np.float32))
    assert take.error(told.shadow).mean() < 0.05 < take.error(alone.shadow).mean()


def test_where_only_that_was_seen_the_ratio_in_common_stands_in() -> None:
    take = crossed(RATIO, np.where(np.abs(ROWS - 45) < 20, 0.85, 1.0))
    found = take.completed(ratio=RATIO.astype(np.float32))
    assert take.error(found.shadow).max() < 0.01
    assert (found.own == 0).all()


def test_shadows_that_are_hardly_darker_than_light_count_by_their_own_ratio() -> None:
    weak = np.float32([0.82, 0.84, 0.88])
    take = crossed(weak, band())
    assert take.error(take.completed(ratio=weak).shadow).mean() < 0.05
