import numpy as np
import pytest

from shadowtool.core.noise import NoiseModel
from shadowtool.core.shadow_time import (
    CrossingTimes,
    LuminanceRange,
    ShadowTimes,
    least_contrast,
    luminance,
    refine_times,
    without_shade,
)
from tests.scene import Scene, Sweep

SCENE = Scene()
NOISE = NoiseModel(np.full(3, 4.5e-5), np.full(3, 1e-6))


def times_of(frames: list[np.ndarray], first: int = 1001) -> ShadowTimes:
    span = LuminanceRange()
    for frame in frames:
        span.add(luminance(frame))
    assert span.lowest is not None and span.highest is not None
    least = least_contrast(span.highest, len(frames), NOISE)
    crossings = CrossingTimes(span.lowest, span.highest, least)
    for number, frame in enumerate(frames, start=first):
        crossings.add(float(number), luminance(frame))
    return crossings.times()


def sweep_frames(sweep: Sweep, noise: float = 0.0) -> list[np.ndarray]:
    frames = [SCENE.image(SCENE.sweep_beta(sweep, f)) for f in range(SCENE.frames_of(sweep))]
    if noise:
        return [SCENE.noisy(frame, number, noise) for number, frame in enumerate(frames)]
    return frames


def true_times(sweep: Sweep, first: int = 1001) -> np.ndarray:
    normal, offset = SCENE.edge(sweep, 0)
    return (SCENE.warp @ normal + offset) / sweep.speed + first


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.0, 3.5, 5.5])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_the_leading_edge_is_found_to_a_fraction_of_a_frame(angle: float, noise: float) -> None:
    sweep = Sweep(angle, soft=8.0)
    found = times_of(sweep_frames(sweep, noise)).time
    error = np.abs(found - true_times(sweep))
    assert np.isfinite(found).mean() > 0.99
    assert np.nanmedian(error) < 0.1
    assert np.nanpercentile(error, 99) < 0.4


def test_what_follows_the_leading_edge_makes_no_difference() -> None:
    sweep = Sweep(0.5, soft=8.0)
    frames = sweep_frames(sweep)
    followed = []
    for number, frame in enumerate(frames):
        body = SCENE.sweep_beta(Sweep(0.5, width=40.0), number - 8)
        followed.append(np.minimum(frame, SCENE.image(np.maximum(body, 0.0))))
    assert np.array_equal(times_of(followed).time, times_of(frames).time, equal_nan=True)


def test_a_pixel_in_shade_from_the_first_frame_on_is_unknown() -> None:
    frames = sweep_frames(Sweep(0.0, soft=8.0))
    for frame in frames:
        frame[:20] = SCENE.shadow[:20]
    assert np.isnan(times_of(frames).time[:20]).all()


def test_a_pixel_that_starts_under_the_stick_is_unknown() -> None:
    frames = sweep_frames(Sweep(0.0, soft=8.0))[12:]
    start = luminance(frames[0]) < luminance((SCENE.lit + SCENE.shadow) / 2) * 0.9
    assert start.any()
    assert np.isnan(times_of(frames).time[start]).all()


def test_noise_alone_has_no_time() -> None:
    frames = [SCENE.noisy(SCENE.lit, number) for number in range(60)]
    assert np.isnan(times_of(frames).time).mean() > 0.999


def test_a_broken_pixel_does_not_spread() -> None:
    frames = sweep_frames(Sweep(0.0, soft=8.0))
    clean = times_of(frames).time
    frames[10][40, 40] = np.nan
    found = times_of(frames).time
    found[40, 40] = clean[40, 40]
    assert np.array_equal(found, clean, equal_nan=True)


def test_contrast_is_the_range_of_the_luminance() -> None:
    found = times_of(sweep_frames(Sweep(0.0))).contrast
    assert found == pytest.approx(luminance(SCENE.lit) - luminance(SCENE.shadow), abs=0.01)


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.5, 4.0])
def test_an_edge_sharper_than_its_step_is_told_apart_by_the_neighbours(angle: float) -> None:
    sweep = Sweep(angle, speed=9.0, soft=1.0, width=30.0)
    found = times_of(sweep_frames(sweep, 0.003)).time
    frames = np.arange(1001.0, 1001.0 + SCENE.frames_of(sweep))
    refined = refine_times(found, frames, np.ones_like(found))
    error, before = (np.abs(t - true_times(sweep))[SCENE.plane] for t in (refined, found))
    assert np.nanmedian(error) < 0.3 * np.nanmedian(before)


def test_refined_times_stay_between_their_frames_and_unknown_ones_unknown() -> None:
    rng = np.random.default_rng(0)
    frames = np.arange(10.0, 40.0, 2.0)
    time = rng.uniform(10.1, 37.9, (30, 40)).astype(np.float32)
    time[rng.uniform(size=time.shape) < 0.2] = np.nan
    before = time.copy()
    refined = refine_times(time, frames, np.ones_like(time))
    assert np.array_equal(np.isnan(refined), np.isnan(before))
    assert np.array_equal(time, before, equal_nan=True)
    known = np.isfinite(time)
    last = np.searchsorted(frames, time[known])
    assert (refined[known] <= frames[last] + 1e-4).all()
    assert (refined[known] >= frames[last - 1] - 1e-4).all()


def test_times_are_not_drawn_over_the_step_of_an_object() -> None:
    time = np.tile(np.linspace(1001, 1006, 60, dtype=np.float32), (20, 1))
    time[:, 30:] += 4
    error = np.abs(refine_times(time, np.arange(1001.0, 1030.0), np.ones_like(time)) - time)
    # A ramp ends flat where there is nothing beyond; nothing of the other side comes over.
    assert error.max() < 0.3
    assert error[:, 10:20].max() < 0.01 and error[:, 40:50].max() < 0.01


def test_what_loses_only_sky_to_the_stick_has_no_time() -> None:
    highest = np.ones((10, 10), np.float32)
    contrast = np.full((10, 10), 0.8, np.float32)
    contrast[:3] = 0.1
    times = ShadowTimes(np.full((10, 10), 5, np.float32), contrast)
    plane = np.zeros((10, 10), bool)
    plane[5:] = True
    lit = without_shade(times, highest, plane)
    assert np.isnan(lit.time[:3]).all() and np.isfinite(lit.time[3:]).all()
    assert np.array_equal(without_shade(times, highest, ~plane & False).time, times.time)


def test_of_soft_edges_interpolation_stands() -> None:
    time = np.random.default_rng(0).uniform(1001, 1020, (20, 30)).astype(np.float32)
    soft = np.full_like(time, 0.3)
    assert refine_times(time, np.arange(1001.0, 1030.0), soft) == pytest.approx(time, abs=1e-3)
