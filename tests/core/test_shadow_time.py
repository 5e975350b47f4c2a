import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core import shadow_time
from shadowtool.core.crossings import CrossingFinder, Crossings
from shadowtool.core.noise import NoiseModel
from shadowtool.core.shadow_time import (
    INTERVAL_ERROR,
    SHADE,
    interpolated_times,
    luminance,
    luminance_halfs,
    misled,
    own_times,
    refined_times,
    significant,
    usual_loss,
)
from tests.scene import Scene, Sweep

SCENE = Scene()
NOISE = NoiseModel(np.full(3, 4.5e-5), np.full(3, 1e-6))
NOISE_OF_12 = NoiseModel(np.full(3, 16 * 4.5e-5), np.full(3, 1e-6))


def crossings_of(frames: list[np.ndarray]) -> Crossings:
    finder = CrossingFinder()
    for frame in frames:
        finder.add(luminance(frame))
    return significant(finder.found(), NOISE)


def paper_times(frames: list[np.ndarray]) -> np.ndarray:
    return interpolated_times(crossings_of(frames))


def sweep_frames(sweep: Sweep, noise: float = 0.0) -> list[np.ndarray]:
    frames = [SCENE.image(SCENE.sweep_beta(sweep, f)) for f in range(SCENE.frames_of(sweep))]
    if noise:
        return [SCENE.noisy(frame, number, noise) for number, frame in enumerate(frames)]
    return frames


def true_times(sweep: Sweep) -> np.ndarray:
    normal, offset = SCENE.edge(sweep, 0)
    return (SCENE.warp @ normal + offset) / sweep.speed


def in_numpy(*channels: np.ndarray) -> np.ndarray:
    """As where no compiler was there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shadow_time, "_luminance", None)
        return luminance_halfs(*channels)


@given(st.integers(1, 5), st.integers(1, 40), st.integers(0, 3), st.integers(0, 999))
@pytest.mark.filterwarnings("ignore:invalid value", "ignore:overflow")
def test_luminance_of_any_halfs_is_the_same_bits_compiled_or_not(height, width, apart, seed):
    bits = np.random.default_rng(seed).integers(0, 1 << 16, (3, height, width + apart), np.uint16)
    channels = bits.view(np.float16)[..., :width]
    expected, found = in_numpy(*channels), luminance_halfs(*channels)
    same = expected.view(np.uint16) == found.view(np.uint16)
    assert (same | (np.isnan(expected) & np.isnan(found))).all()


compiled = pytest.mark.skipif(
    shadow_time._own_times is None, reason="it was installed without a compiler"
)


@compiled
@settings(deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.sampled_from([0.0, 0.001, 0.1]),
    st.sampled_from([0.0, 0.3]),
    st.integers(0, 9999),
)
@pytest.mark.filterwarnings("ignore:invalid value", "ignore:divide by zero")
def test_times_are_the_same_bits_compiled_or_not(height, width, noise, trembling, seed):
    """Sharp and soft edges, noise, what is never known, and no contrast at all."""
    rng = np.random.default_rng(seed)
    shape = height, width
    lit = rng.choice([0.0, 0.01, 0.5, 3.0], shape)
    dark = lit * rng.choice([0.0, 0.2, 0.9, 1.0], shape)
    before = lit - (lit - dark) * rng.choice([0.0, 0.1, 0.4], shape)
    after = dark + (lit - dark) * rng.choice([0.0, 0.1, 0.4], shape)
    lights = [v + noise * rng.normal(size=shape) for v in (before, after, dark, lit)]
    for light in lights:
        light[rng.random(shape) < 0.05] = np.nan
    before, after, dark, lit = (light.astype(np.float32) for light in lights)
    at = rng.integers(0, 60, shape).astype(np.int32)
    # A crossing is from light to dark.
    at[~(np.isfinite(lit + dark) & (before > after))] = 0
    # More light than a half can hold.
    lit[rng.random(shape) < 0.01] = np.inf
    crossings = Crossings(at, before, after, dark, lit, at < 0, 60)
    found = own_times(crossings, NOISE, trembling)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shadow_time, "_own_times", None)
        expected = own_times(crossings, NOISE, trembling)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_crossings_need_not_lie_one_after_the_other_in_memory():
    found = crossings_of(sweep_frames(Sweep(0.5, soft=8.0), 0.003))
    expected = own_times(found, NOISE)
    other = Crossings(*(np.asfortranarray(part) for part in found[:-1]), found.frames)
    other = other._replace(at=found.at.astype(np.int64))
    for one, two in zip(own_times(other, NOISE), expected, strict=True):
        np.testing.assert_array_equal(one, two)


@compiled
def test_arrays_that_do_not_belong_together_tell_no_times():
    def told(at=5, light=5, kind="f4", out=5, counts=50, parts=7):
        numbers = [np.zeros(light, kind) for _ in range(4)]
        crossings = (np.zeros(at, np.int32), *numbers, None, None)[:parts]
        found = tuple(np.zeros(out, np.float32) for _ in range(3))
        shadow_time._own_times.catch(
            crossings, found, np.zeros((2, counts), np.int64), 1, 1, 1, 1, 1
        )
        shadow_time._own_times.tell(crossings, found, found[:2], *[1.0] * 9)

    told()
    for wrong in (
        {"at": 4},
        {"light": 4},
        {"kind": "f8"},
        {"out": 6},
        {"counts": 49},
        {"parts": 6},
    ):
        with pytest.raises(ValueError, match=r"not as|another type"):
            told(**wrong)
    with pytest.raises(TypeError):
        shadow_time._own_times.catch((None,) * 7, (), None, 1, 1, 1, 1, 1)


@pytest.mark.parametrize("kinds", ["eee", "fff", "efe"])
def test_luminance_is_rounded_to_halfs_once(kinds):
    rng = np.random.default_rng(1)
    channels = [rng.uniform(0, 9, (30, 50)).astype("f2").astype(kind) for kind in kinds]
    expected = luminance(np.stack(channels, axis=-1).astype(np.float32))
    for made in (luminance_halfs, in_numpy):
        off = np.abs(made(*channels).astype(np.float32) - expected)
        assert (off <= np.spacing(expected.astype(np.float16)) * 0.501).all()


@compiled
def test_the_compiled_luminance_takes_nothing_but_rows_of_halfs():
    halfs = np.ones((4, 6), np.float16)
    for wrong in (halfs[:, :5], halfs[:3], halfs[:, ::2], halfs.astype("f4"), halfs.ravel()):
        with pytest.raises(ValueError, match=r"no rows|another type"):
            shadow_time._luminance.luminance(halfs, halfs, wrong, halfs.copy(), 1, 1, 1)
    frozen = halfs.copy()
    frozen.flags.writeable = False
    with pytest.raises(ValueError, match="read-only"):
        shadow_time._luminance.luminance(halfs, halfs, halfs, frozen, 1, 1, 1)


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.0, 3.5, 5.5])
@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_the_leading_edge_is_found_to_a_fraction_of_a_frame(angle: float, noise: float) -> None:
    sweep = Sweep(angle, soft=8.0)
    found = paper_times(sweep_frames(sweep, noise))
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
    assert np.array_equal(paper_times(followed), paper_times(frames), equal_nan=True)


def test_a_pixel_in_shade_from_the_first_frame_on_is_unknown() -> None:
    frames = sweep_frames(Sweep(0.0, soft=8.0))
    for frame in frames:
        frame[:20] = SCENE.shadow[:20]
    assert np.isnan(paper_times(frames)[:20]).all()


def test_a_pixel_that_starts_under_the_stick_is_unknown() -> None:
    frames = sweep_frames(Sweep(0.0, soft=8.0))[12:]
    start = luminance(frames[0]) < luminance((SCENE.lit + SCENE.shadow) / 2) * 0.9
    assert start.any()
    assert np.isnan(paper_times(frames)[start]).all()


def test_noise_alone_has_no_time() -> None:
    frames = [SCENE.noisy(SCENE.lit, number) for number in range(60)]
    assert np.isnan(paper_times(frames)).mean() > 0.999


def test_noise_in_deep_shade_has_no_time() -> None:
    rng = np.random.default_rng(0)
    finder = CrossingFinder()
    for _ in range(20):
        finder.add(luminance(rng.normal(0.004, 0.001, (40, 60, 3)).astype(np.float32)))
    found = significant(finder.found(), NoiseModel(np.zeros(3), np.full(3, 1e-6)))
    assert not found.at.any() and not found.lost.any()


def test_a_broken_pixel_does_not_spread() -> None:
    frames = sweep_frames(Sweep(0.0, soft=8.0))
    clean = paper_times(frames)
    frames[10][40, 40] = np.nan
    found = paper_times(frames)
    found[40, 40] = clean[40, 40]
    assert np.array_equal(found, clean, equal_nan=True)


def test_a_pixel_that_is_never_known_changes_nothing_elsewhere() -> None:
    frames = sweep_frames(Sweep(0.5, soft=24.0), noise=0.003)
    whole = own_times(crossings_of(frames), NOISE)
    for frame in frames:
        frame[20, 30] = np.nan
    found = own_times(crossings_of(frames), NOISE)
    assert np.isnan(found[0][20, 30])
    elsewhere = np.isfinite(whole[0])
    elsewhere[4:37, 14:47] = False
    for one, other in zip(found, whole, strict=True):
        np.testing.assert_allclose(one[elsewhere], other[elsewhere], rtol=1e-5)


def test_contrast_is_the_range_of_the_luminance() -> None:
    crossings = crossings_of(sweep_frames(Sweep(0.0)))
    found = crossings.highest - crossings.lowest
    assert found == pytest.approx(luminance(SCENE.lit) - luminance(SCENE.shadow), abs=0.01)


@pytest.mark.parametrize(("soft", "most"), [(1.0, 0.002), (8.0, 0.002), (30.0, 0.02)])
def test_one_reading_loses_hardly_a_pixel(soft: float, most: float) -> None:
    frames = sweep_frames(Sweep(0.7, soft=soft, width=40.0), 0.003)
    assert crossings_of(frames).lost.mean() <= most


SHARP = Sweep(0.4, speed=9.0, soft=1.0, width=30.0)


@pytest.mark.parametrize("angle", [0.3, 1.2, 2.5, 4.0])
def test_an_edge_sharper_than_its_step_is_told_by_those_that_caught_it(angle: float) -> None:
    sweep = Sweep(angle, speed=9.0, soft=1.0, width=30.0)
    crossings = crossings_of(sweep_frames(sweep, 0.003))
    own, error, _ = own_times(crossings, NOISE)
    refined, spread = refined_times(own, error, crossings.at)
    interpolated = interpolated_times(crossings)
    off = {
        name: np.abs(time - true_times(sweep))[SCENE.plane]
        for name, time in (("paper", interpolated), ("own", own), ("refined", refined))
    }
    caught = (error < 0.1)[SCENE.plane]
    assert 0.05 < caught.mean() < 0.4
    # A tenth of a frame is 0.9 pixels here.
    assert np.median(off["own"][caught]) < 0.02
    assert np.nanmedian(off["refined"]) < 0.1 * np.nanmedian(off["paper"])
    # What is predicted is what happens, by and large.
    assert (
        np.percentile((off["refined"] / spread[SCENE.plane])[np.isfinite(off["refined"])], 75) < 2
    )


@pytest.mark.parametrize("soft", [1.0, 4.0, 7.0, 20.0])
def test_predicted_errors_hold_for_edges_of_any_width(soft: float) -> None:
    sweep = Sweep(0.4, speed=6.0, soft=soft, width=40.0)
    crossings = crossings_of(sweep_frames(sweep, 0.003))
    own, error, _ = own_times(crossings, NOISE)
    known = np.isfinite(own) & SCENE.plane
    assert known.mean() > 0.7
    deviation = np.abs(own - true_times(sweep))[known] / error[known]
    assert np.percentile(deviation, 90) < 3


def test_noise_does_not_move_the_middle_of_a_soft_edge() -> None:
    sweep = Sweep(0.4, speed=2.0, soft=16.0, width=50.0)
    own, *_ = own_times(crossings_of(sweep_frames(sweep, 0.012)), NOISE_OF_12)
    off = (own - true_times(sweep))[SCENE.plane]
    assert abs(np.nanmedian(off)) < 0.1
    paper = paper_times(sweep_frames(sweep, 0.012)) - true_times(sweep)
    assert abs(np.nanmedian(paper[SCENE.plane])) > 0.15


def test_a_trembling_camera_does_not_move_the_middle_of_a_soft_edge() -> None:
    sweep = Sweep(0.4, speed=2.0, soft=20.0, width=50.0)
    rng = np.random.default_rng(1)
    grain = np.exp(0.9 * rng.standard_normal((*SCENE.lit.shape[:2], 1)))
    grain = cv2.GaussianBlur(grain, (0, 0), 1.0)[..., np.newaxis]
    shots, places = [], rng.normal(scale=0.25, size=(SCENE.frames_of(sweep), 2))
    for number, (x, y) in enumerate(places):
        shift = np.float32([[1, 0, x], [0, 1, y]])
        moved = cv2.warpAffine(grain, shift, grain.shape[1::-1], flags=cv2.INTER_CUBIC)
        image = SCENE.image(SCENE.sweep_beta(sweep, number)) * moved[..., np.newaxis]
        shots.append(SCENE.noisy(image, number))
    crossings = crossings_of(shots)
    away = [
        (own_times(crossings, NOISE, trembling)[0] - true_times(sweep))[SCENE.plane]
        for trembling in (0.0, float(places.std()))
    ]
    ignored, minded = (abs(float(np.nanmedian(off))) for off in away)
    assert ignored > 0.15
    assert minded < 0.6 * ignored


def test_own_times_lie_between_their_frames() -> None:
    crossings = crossings_of(sweep_frames(SHARP, 0.01))
    own, error, _ = own_times(crossings, NOISE)
    known = crossings.at > 0
    assert np.array_equal(np.isfinite(own), known) and np.array_equal(np.isfinite(error), known)
    assert (own[known] <= crossings.at[known]).all()
    assert (own[known] >= crossings.at[known] - 1).all()
    assert (error[known] > 0).all() and (error[known] <= INTERVAL_ERROR + 0.1).all()


def test_refined_times_stay_between_their_frames_and_unknown_ones_unknown() -> None:
    rng = np.random.default_rng(0)
    time = rng.uniform(10.1, 37.9, (30, 40)).astype(np.float32)
    time[rng.uniform(size=time.shape) < 0.2] = np.nan
    error = np.where(np.isfinite(time), 0.2, np.inf).astype(np.float32)
    index = np.ceil(np.nan_to_num(time)).astype(np.int32)
    before = time.copy()
    refined, _ = refined_times(time, error, index)
    assert np.array_equal(time, before, equal_nan=True)
    assert np.isnan(refined[np.isnan(before)]).all()
    known = np.isfinite(refined)
    assert known.any()
    assert (refined[known] <= index[known]).all() and (refined[known] >= index[known] - 1).all()


def test_what_loses_only_sky_to_the_stick_is_told_from_what_loses_the_key_light() -> None:
    highest = np.ones((10, 10), np.float32)
    contrast = np.full((10, 10), 0.8, np.float32)
    contrast[:3] = 0.1
    contrast[3] = 0.4
    known = np.ones((10, 10), bool)
    plane = np.zeros((10, 10), bool)
    plane[5:] = True
    loss = usual_loss(contrast, highest, known, plane)
    assert (loss[:3] < SHADE).all()
    assert loss[3] == pytest.approx(0.5)
    assert (loss[4:] == 1).all()
    assert (usual_loss(contrast, highest, known, ~known) == 1).all()


@pytest.mark.parametrize("key", [0.8, 0.4, 0.2])
def test_what_a_grazed_surface_loses_of_the_sky_is_in_its_error(key: float) -> None:
    """The sky goes from 0.2 to 0.1, most of it before the edge or after it."""
    rng = np.random.default_rng(0)
    passes = rng.uniform(15, 25, (40, 40)).astype(np.float32)
    early = rng.uniform(-12, 12, passes.shape).astype(np.float32)
    finder = CrossingFinder()
    for frame in range(40):
        edge = np.clip((frame - passes) / 2 + 0.5, 0, 1)
        sky = np.clip((frame - passes - early) / 30 + 0.5, 0, 1)
        gray = 0.2 - 0.1 * sky + key * (1 - edge)
        finder.add((gray + rng.normal(0, 0.001, gray.shape)).astype(np.float32))
    found = significant(finder.found(), NOISE)
    own, error, duration = own_times(found, NOISE)
    loss = (found.highest - found.lowest) / found.highest / 0.9
    known = np.isfinite(own)
    assert known.mean() > 0.99
    off = np.abs(own - passes)[known]
    assert np.percentile(off / np.hypot(error, misled(duration, loss))[known], 90) < 3
    assert (misled(duration, np.ones_like(loss)) == 0).all()
    # Noise alone does not explain it.
    if key == 0.2:
        assert np.percentile(off / error[known], 90) > 4
