import numpy as np
import pytest

from shadowtool.core.noise import NoiseModel
from shadowtool.core.shadow_time import (
    CrossingTimes,
    LuminanceRange,
    ShadowTimes,
    least_contrast,
    luminance,
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
