import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core.exposure import (
    RunningGain,
    clipped_part,
    common_reference,
    flickers,
    frame_gain,
    is_one,
    level_of,
    of_rows,
    row_gains,
    sampled_areas,
    tint_of,
    unevenness,
    without_gain,
)
from tests.scene import Scene

SCENE = Scene()
# As large as a third of the picture.
RADIUS = 39.0


def crossed(x: float, y: float, seed: int, radius: float = RADIUS) -> np.ndarray:
    """The scene with a large shadow and a figure of several colours in it."""
    image = SCENE.image(SCENE.disk(x, y, radius, soft=8))
    left = int(np.clip(x - 10, 0, 130))
    for row, colour in ((20, (0.6, 0.4, 0.3)), (35, (0.7, 0.1, 0.1)), (55, (0.05, 0.05, 0.08))):
        image[row : row + 20, left : left + 24] = colour
    return SCENE.noisy(image, seed)


@settings(deadline=None)
@given(
    st.floats(0.9, 1.1).filter(lambda g: abs(g - 1) > 0.008),
    st.floats(40, 120),
    st.floats(30, 60),
    st.integers(0, 9),
)
def test_a_gain_is_found_past_shadow_and_figure(gain: float, x: float, y: float, seed: int) -> None:
    image = crossed(x, y, seed) * np.float32(gain)
    assert frame_gain(image, SCENE.lit) == pytest.approx(gain, rel=0.003)


@settings(deadline=None)
@given(st.floats(0.997, 1.003), st.floats(40, 120), st.integers(0, 9))
def test_a_gain_next_to_one_is_exactly_one(gain: float, x: float, seed: int) -> None:
    assert frame_gain(crossed(x, 45, seed) * np.float32(gain), SCENE.lit) == 1


def test_a_frame_without_a_gain_is_the_same_array() -> None:
    image = SCENE.lit.copy()
    assert without_gain(image, 1.0) is image
    halfs = image.astype(np.float16)
    assert without_gain(halfs, 1.0) is halfs


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_taking_a_gain_out_keeps_the_type_and_the_input(dtype: type) -> None:
    brighter = (SCENE.lit * np.float32(1.1)).astype(dtype)
    before = brighter.copy()
    corrected = without_gain(brighter, 1.1)
    assert corrected.dtype == dtype
    assert corrected == pytest.approx(SCENE.lit, rel=2e-3 if dtype == np.float16 else 1e-5)
    assert np.array_equal(brighter, before)


ROWS = np.arange(SCENE.height, dtype=float)
BANDS = 1 + 0.05 * np.sin(2 * np.pi * (1.7 * ROWS / SCENE.height + 0.2))
TINT = np.array([1.04, 1.0, 0.95])


@pytest.mark.parametrize("bands", [np.ones(SCENE.height), BANDS], ids=["steady", "flickering"])
@pytest.mark.parametrize("tint", [np.ones(3), TINT], ids=["white", "tinted"])
@pytest.mark.parametrize("level", [1.0, 0.92])
def test_bands_and_tints_are_found_beside_the_level(
    bands: np.ndarray, tint: np.ndarray, level: float
) -> None:
    true = level * bands[:, None] * tint
    gains = row_gains(crossed(80, 45, 3) * true[:, None].astype(np.float32), SCENE.lit, ROWS, True)
    if np.ptp(true) == 0:
        assert gains == frame_gain(crossed(80, 45, 3) * np.float32(level), SCENE.lit)
    assert np.broadcast_to(gains, true.shape) == pytest.approx(true, abs=0.012)


@pytest.mark.parametrize("broken", [None, 3.0, np.inf, np.nan])
def test_a_channel_that_is_clipped_has_no_tint(broken: float | None) -> None:
    brighter = np.minimum(crossed(80, 45, 1) * np.float32([1.08] * 3), np.float32([0.45, 2, 2]))
    if broken is not None:
        brighter[0, 0] = broken
    assert isinstance(row_gains(brighter, np.minimum(SCENE.lit, [0.45, 2, 2]), ROWS, True), float)


def test_gains_of_rows_are_taken_out_of_them() -> None:
    gains = BANDS[:, None] * TINT
    image = (SCENE.lit * gains[:, None]).astype(np.float32)
    assert without_gain(image, gains) == pytest.approx(SCENE.lit, rel=1e-5)
    assert without_gain(image[20:40], of_rows(gains, slice(20, 40))) == pytest.approx(
        SCENE.lit[20:40], rel=1e-5
    )
    assert of_rows(0.9, slice(20, 40)) == 0.9
    halfs = without_gain(image.astype(np.float16), gains)
    assert halfs.dtype == np.float16 and halfs == pytest.approx(SCENE.lit, rel=2e-3)


def test_what_gains_amount_to() -> None:
    gains = 0.9 * BANDS[:, None] * TINT
    assert level_of(gains) == pytest.approx(0.9 * BANDS.mean() * TINT.mean())
    assert unevenness(gains) == pytest.approx(0.05, rel=0.05)
    assert tint_of(gains) == pytest.approx(TINT / TINT.mean(), abs=1e-4)
    assert tint_of(0.9) == [1, 1, 1]
    assert (level_of(0.9), unevenness(0.9), is_one(0.9)) == (0.9, 0, False)
    assert is_one(1.0) and not is_one(np.ones((4, 3)))


def flickering_take() -> list[np.ndarray]:
    angles = [2 * np.pi * (1.7 * ROWS / SCENE.height + 0.37 * number) for number in range(24)]
    return [
        (frame * (1 + 0.06 * np.sin(angle))[:, None, None]).astype(np.float32)
        for frame, angle in zip(take(), angles, strict=True)
    ]


def card_take(soft: float = 50) -> list[np.ndarray]:
    """A card with a soft edge from side to side comes down half of the picture and goes again."""
    edges = 0.6 * SCENE.height * np.sin(np.pi * np.arange(24) / 23)
    betas = [np.clip((ROWS - edge) / soft + 0.5, 0, 1)[:, None, None] for edge in edges]
    images = [SCENE.shadow + beta * (SCENE.lit - SCENE.shadow) for beta in betas]
    return [SCENE.noisy(image, number) for number, image in enumerate(images)]


def test_the_reference_of_a_flickering_take_has_no_bands() -> None:
    reference = common_reference(flickering_take())
    rows = np.median(np.log(reference / SCENE.lit), axis=(1, 2))
    assert np.abs(rows).max() < 0.01


def test_a_take_flickers_if_most_of_its_frames_do() -> None:
    assert flickers(flickering_take(), SCENE.lit)
    assert not flickers(take(), SCENE.lit)
    assert not flickers([*take()[:14], *flickering_take()[14:]], SCENE.lit)
    assert not flickers([], SCENE.lit)


@pytest.mark.parametrize("soft", [30, 40, 50, 60])
def test_penumbrae_from_side_to_side_are_no_flicker(soft: float) -> None:
    samples = card_take(soft)
    assert not flickers(samples, SCENE.lit)
    reference = common_reference(samples)
    # Where the card hardly ever comes.
    assert np.median(reference[-15:] / SCENE.lit[-15:]) == pytest.approx(1, abs=0.01)


def test_what_is_unknown_is_passed_over() -> None:
    image, reference = crossed(80, 45, 0) * np.float32(0.92), SCENE.lit.copy()
    image[:30] = np.nan
    image[30:33] = np.inf
    reference[:, :20] = np.nan
    assert frame_gain(image, reference) == pytest.approx(0.92, rel=0.003)


def test_nothing_to_compare_is_a_gain_of_one() -> None:
    nothing = np.full_like(SCENE.lit, np.nan)
    black = np.zeros_like(SCENE.lit)
    for image, reference in ((nothing, SCENE.lit), (SCENE.lit, nothing), (black, SCENE.lit)):
        assert frame_gain(image, reference) == 1
    assert frame_gain(SCENE.lit, black) == 1


def test_another_picture_is_no_gain() -> None:
    slate = np.full_like(SCENE.lit, 8.0)
    assert frame_gain(slate, SCENE.lit) == 1


def test_a_picture_in_which_nothing_agrees_has_no_gain() -> None:
    rng = np.random.default_rng(4)
    other = SCENE.lit * np.exp(rng.uniform(-2, 2, (*SCENE.lit.shape[:2], 1))).astype(np.float32)
    assert frame_gain(other, SCENE.lit) == 1


def test_full_shadow_over_most_of_the_picture_is_no_gain() -> None:
    image = SCENE.noisy(SCENE.image(SCENE.disk(80, 45, 68, soft=6)), 0)
    assert frame_gain(image, SCENE.lit) == 1


def take() -> list[np.ndarray]:
    """Frames spread over a take in which a shadow and a figure cross the scene."""
    return [crossed(20 + 5 * i, 40 + i % 3, i, radius=22) for i in range(24)]


def test_the_reference_is_what_most_frames_show_without_their_gains() -> None:
    gains = [1.0 if i % 3 else 0.9 for i in range(24)]
    samples = [frame * np.float32(gain) for frame, gain in zip(take(), gains, strict=True)]
    reference = common_reference(samples)
    assert np.median(reference / SCENE.lit) == pytest.approx(1, abs=0.003)
    for sample, gain in zip(samples, gains, strict=True):
        assert frame_gain(sample, reference) == pytest.approx(gain, rel=0.005)


def test_a_steady_take_has_a_reference_of_its_own_level() -> None:
    samples = take()
    before = [sample.copy() for sample in samples]
    reference = common_reference(samples)
    assert np.array_equal(reference, np.median(samples, axis=0).astype(np.float32))
    assert [frame_gain(sample, reference) for sample in samples] == [1.0] * 24
    assert all(np.array_equal(s, b) for s, b in zip(samples, before, strict=True))


def test_in_a_steady_take_a_shadow_that_most_frames_share_is_no_gain() -> None:
    samples = [crossed(20 + 5 * i, 45, i) for i in range(24)]
    reference = common_reference(samples)
    assert [frame_gain(sample, reference) for sample in samples] == [1.0] * 24


def test_a_single_sample_is_its_own_reference() -> None:
    assert np.array_equal(common_reference([SCENE.lit]), SCENE.lit)


def test_long_shade_does_not_lower_the_level_of_a_steady_take() -> None:
    # A wide penumbra lies over each pixel for nearly half the frames.
    samples = []
    for i in range(24):
        x = np.arange(SCENE.width)[None, :] - (8 * i - 20)
        beta = np.broadcast_to(np.clip(np.abs(x) / 60, 0, 1), SCENE.lit.shape[:2])
        samples.append(SCENE.noisy(SCENE.image(beta.astype(np.float32)), i))
    reference = common_reference(samples)
    assert np.median([frame_gain(sample, reference) for sample in samples]) == 1.0


def sweep(
    frames: int, loss: float, width: float, gains: np.ndarray, seed: int = 0
) -> list[np.ndarray]:
    """Brightness of a texture over which a soft-edged stick is swept, under changing light."""
    rng = np.random.default_rng(seed)
    ground = rng.uniform(0.1, 0.8, (60, 240)).astype(np.float32)
    x = np.arange(240, dtype=np.float32)
    pictures = []
    for frame, gain in enumerate(gains):
        inside = (280 + width) * frame / frames - 20 - x
        shade = np.clip(inside / 8, 0, 1) * np.clip((width - inside) / 8, 0, 1)
        clean = np.float32(gain) * ground * (1 - loss * shade)
        noise = rng.normal(0, 0.004, ground.shape) * np.sqrt(clean / 0.2)
        pictures.append((clean + noise).astype(np.float32))
    return pictures


# A thin stick; a board that leaves nothing lit for a while; light that a shadow takes little of.
@pytest.mark.parametrize(("loss", "width"), [(0.8, 12), (0.8, 400), (0.15, 400), (0.3, 40)])
def test_exposure_is_followed_past_a_sweep(loss: float, width: float) -> None:
    frames = np.arange(80)
    gains = (1 + 0.12 * np.sin(frames / 9)) * (1 + 0.03 * np.sin(2.1 * frames))
    gains /= gains[0]
    running = RunningGain()
    found = [running.add(gray) for gray in sweep(80, loss, width, gains)]
    assert found[0] == 1
    assert found == pytest.approx(gains, rel=0.011)


@pytest.mark.parametrize(
    ("loss", "width"), [(0.8, 12), (0.8, 400), (0.15, 400), (0.3, 40), (0.99, 400), (1.0, 400)]
)
def test_under_steady_light_a_sweep_has_no_gain(loss: float, width: float) -> None:
    running = RunningGain()
    assert {running.add(gray) for gray in sweep(80, loss, width, np.ones(80))} == {1.0}


@pytest.mark.parametrize("jump", [0.4, 0.8, 1.6, 3.0])
def test_light_that_jumps_is_followed(jump: float) -> None:
    gains = np.where(np.arange(80) < 33, 1.0, jump)
    running = RunningGain()
    found = [running.add(gray) for gray in sweep(80, 0.8, 60, gains)]
    assert found == pytest.approx(gains, rel=0.011)


def test_a_frame_that_is_no_picture_of_the_scene_leaves_the_gain() -> None:
    running = RunningGain()
    pictures = sweep(20, 0.8, 12, np.full(20, 1.0))
    pictures[10:] = [picture * np.float32(1.1) for picture in pictures[10:]]
    pictures[5] = np.full_like(pictures[5], np.nan)
    found = [running.add(gray) for gray in pictures]
    assert found[:10] == [1.0] * 10
    assert found[10:] == pytest.approx([1.1] * 10, rel=0.005)


@pytest.mark.parametrize("shape", [(1, 1), (9, 7), (1, 400), (400, 1), (270, 480), (61, 33)])
def test_sampled_areas_are_means_of_runs(shape: tuple[int, int]) -> None:
    gray = np.random.default_rng(0).uniform(size=shape).astype(np.float32)
    areas = sampled_areas(gray)
    step = max(1, round(max(shape) / 160))
    run = min(step, shape[1])
    assert len(areas) == len(gray[::step])
    assert areas[0, 0] == pytest.approx(gray[0, :run].mean() if shape[1] >= step else gray[0, 0])
    assert areas[-1, -1] == pytest.approx(
        gray[::step][-1, (areas.shape[1] - 1) * step :][:run].mean()
        if shape[1] >= step
        else gray[::step][-1, 0]
    )


def under_a_disk(noise: bool = True) -> list[np.ndarray]:
    """A disk of shadow over the scene."""
    frames = [SCENE.image(SCENE.disk(20.0 + 20 * i, 40, 15, soft=8)) for i in range(6)]
    return [SCENE.noisy(frame, seed) for seed, frame in enumerate(frames)] if noise else frames


@pytest.mark.parametrize("noise", [False, True])
@pytest.mark.parametrize("top", [None, 1.0])
def test_light_below_the_top_is_not_clipped(noise: bool, top: float | None) -> None:
    assert (
        clipped_part([0.9 * frame / SCENE.lit.max() for frame in under_a_disk(noise)], top) < 0.01
    )


@pytest.mark.parametrize("top", [None, 1.0])
@pytest.mark.parametrize("channels", [[1], [0, 1, 2]])
@pytest.mark.parametrize("part", [0.05, 0.3, 0.6])
def test_light_that_is_cut_off_is_clipped(
    top: float | None, channels: list[int], part: float
) -> None:
    """By so much, whether all channels are or one, and a single broken pixel is brighter."""
    above = np.quantile(SCENE.lit, 1 - part, axis=(0, 1))
    expected = (SCENE.lit >= above)[..., channels].any(axis=-1).mean()
    frames = [frame / above for frame in under_a_disk()]
    for frame in frames:
        for channel in channels:
            np.minimum(frame[..., channel], 1, out=frame[..., channel])
        frame[3, 3] = 2 if top is None else 1
    others = [channel for channel in range(3) if channel not in channels]
    for frame in frames:
        frame[..., others] *= 0.5
    assert clipped_part(frames, top) == pytest.approx(expected, abs=0.05)


def test_an_even_wall_in_a_clean_picture_is_not_clipped() -> None:
    wall = np.full((30, 40, 3), 0.7, np.float32)
    shade = [wall.copy() for _ in range(6)]
    for number, frame in enumerate(shade):
        frame[:, 5 * number : 5 * number + 8] *= 0.4
    assert clipped_part(shade, None) == 0
    assert clipped_part(shade, 1.0) == 0
    assert clipped_part([frame / np.float32(0.7) for frame in shade], 1.0) == 1


def test_of_nothing_nothing_is_clipped() -> None:
    unknown = np.full((4, 5, 3), np.nan, np.float32)
    black = np.zeros((4, 5, 3), np.float32)
    for top in (None, 1.0):
        for frame in (unknown, black):
            assert clipped_part([frame] * 3, top) == 0
        assert clipped_part([], top) == clipped_part([black + 1], top) == 0
