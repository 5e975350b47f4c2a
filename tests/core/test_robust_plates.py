import tracemalloc
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core import robust_plates
from shadowtool.core.half_keys import mean_of_keys
from shadowtool.core.noise import NoiseModel
from shadowtool.core.plates import ExtremePlates
from shadowtool.core.robust_plates import SAMPLES, Measured, RobustPlates, SampledLevels, keyed
from tests.scene import Scene, Sweep

# The noise of `Scene.noisy`: 0.003 at mid grey.
NOISE = NoiseModel(np.full(3, 5e-5), np.full(3, 2e-7))
SCENE = Scene(50, 80, rows=(0, 0), columns=(0, 0))
SWEEP = Sweep(angle=0.0, speed=2.5, width=30, soft=6)
FRAMES = 54
SHAPE = SCENE.lit.shape[:2]
Holdouts = list[np.ndarray | None]


@cache
def betas() -> tuple[np.ndarray, ...]:
    return tuple(SCENE.sweep_beta(SWEEP, frame) for frame in range(FRAMES))


def take() -> list[np.ndarray]:
    """A shadow with a penumbra that crosses the scene, in noise, as halfs."""
    pairs = enumerate(betas())
    return [SCENE.noisy(SCENE.image(beta), seed).astype(np.float16) for seed, beta in pairs]


def measure(frames: list[np.ndarray], holdouts: Holdouts | None = None) -> Measured:
    """Both readings of a take."""
    held = holdouts or [None] * len(frames)
    levels = SampledLevels(*frames[0].shape[:2])
    for position in np.unique(np.linspace(0, len(frames) - 1, SAMPLES).round().astype(int)):
        levels.add(keyed(frames[position], held[position]).gray)
    plates = RobustPlates(levels.levels(), NOISE)
    for frame, holdout in zip(frames, held, strict=True):
        plates.add(keyed(frame, holdout))
    return plates.measured()


def relative(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Errors in deviations of a single frame's noise."""
    return (found - truth) / NOISE.sigma(truth)


def same(one: Measured, other: Measured) -> bool:
    return all(
        np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
        for name in ("lit", "shadow", "lit_frames", "shadow_frames")
    )


def test_plates_have_not_the_bias_of_extremes() -> None:
    frames = take()
    found = measure(frames)
    extremes = ExtremePlates()
    for frame in frames:
        extremes.add(frame)
    literal = extremes.plates()
    for name in ("lit", "shadow"):
        truth = getattr(SCENE, name)
        ours = relative(getattr(found, name), truth)
        theirs = relative(getattr(literal, name), truth)
        assert abs(ours.mean()) < 0.1 * abs(theirs.mean())
        assert np.sqrt((ours**2).mean()) < 0.35 * np.sqrt((theirs**2).mean())


def test_plates_are_as_good_as_their_frames_allow() -> None:
    found = measure(take())
    lit = relative(found.lit, SCENE.lit) * np.sqrt(found.lit_frames)[..., None]
    assert np.median(np.abs(lit)) < 1.0
    shadow = relative(found.shadow, SCENE.shadow) * np.sqrt(found.shadow_frames)[..., None]
    assert np.median(np.abs(shadow)) < 1.3


def test_frames_are_counted_right() -> None:
    # Without a penumbra each frame is one or the other.
    hard = [np.rint(beta) for beta in betas()]
    pairs = enumerate(hard)
    frames = [SCENE.noisy(SCENE.image(beta), seed).astype(np.float16) for seed, beta in pairs]
    found = measure(frames)
    lit, shaded = sum(b == 1 for b in hard), sum(b == 0 for b in hard)
    assert (found.lit_frames <= lit).all() and (found.shadow_frames <= shaded).all()
    assert (found.lit_frames / lit).mean() > 0.95
    assert (found.shadow_frames / shaded).mean() > 0.97


def test_a_pixel_that_is_lit_only_in_frames_left_out_is_as_dark_as_it_is_seen() -> None:
    lit, shaded = (np.full((4, 5, 3), value, np.float16) for value in (0.5, 0.1))
    levels = SampledLevels(4, 5)
    for _ in range(3):
        levels.add(keyed(lit).gray)
    plates = RobustPlates(levels.levels(), NOISE)
    for _ in range(4):
        plates.add(keyed(shaded))
    found = plates.measured()
    assert np.array_equal(found.lit, shaded) and np.array_equal(found.shadow, shaded)
    assert (found.lit_frames == 4).all()


def bird(frames: list[np.ndarray], when: list[int], colour: float) -> list[np.ndarray]:
    for number in when:
        frames[number][20:30, 30:40] = colour
    return frames


@pytest.mark.parametrize("colour", [1.5, 0.004])
@pytest.mark.parametrize("when", [[0], [3, 4], [0, 53]])
def test_a_bird_in_one_or_two_frames_changes_next_to_nothing(
    colour: float, when: list[int]
) -> None:
    spot = slice(20, 30), slice(30, 40)
    found = measure(bird(take(), when, colour))
    for name in ("lit", "shadow"):
        error = relative(getattr(found, name), getattr(SCENE, name))[spot]
        # A lucky bird may hide among the frames of a pixel in a hundred.
        assert (np.abs(error) < 4).all(axis=-1).mean() >= 0.98
        assert np.abs(np.median(error)) < 0.3 and np.quantile(np.abs(error), 0.9) < 1


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 99))
def test_what_is_held_out_makes_no_difference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plain, figures = take(), take()
    holdouts: Holdouts = []
    for frame in figures:
        holdout = np.zeros(SHAPE, np.uint8)
        y, x = rng.integers(0, 30), rng.integers(0, 60)
        holdout[y : y + 20, x : x + 20] = 255
        frame[holdout > 0] = rng.uniform(0, 2, 3)
        holdouts.append(holdout)
    assert same(measure(plain, holdouts), measure(figures, holdouts))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_what_is_not_finite_counts_as_held_out(bad: float, dtype: type) -> None:
    plain = [frame.astype(dtype) for frame in take()]
    holdouts: Holdouts = [None] * FRAMES
    broken = [frame.copy() for frame in plain]
    for number in range(0, FRAMES, 3):
        holdout = np.zeros(SHAPE, np.uint8)
        holdout[number % 30 : number % 30 + 5, 10:60] = 1
        holdouts[number] = holdout
        broken[number][holdout > 0, number % 3] = bad
    broken_plates = measure(broken)
    assert np.isfinite(broken_plates.lit).all()
    assert same(broken_plates, measure(plain, holdouts))


def test_frames_that_are_nan_altogether_are_passed_over() -> None:
    frames = take()
    nothing = np.full_like(frames[0], np.nan)
    found = measure([nothing, *frames, nothing])
    assert abs(relative(found.lit, SCENE.lit).mean()) < 0.1
    assert found.lit_frames.max() <= FRAMES


def test_a_pixel_seen_in_no_frame_is_nan() -> None:
    holdout = np.zeros(SHAPE)
    holdout[7, 9] = 0.1
    found = measure(take(), [holdout] * FRAMES)
    assert np.isnan(found.lit[7, 9]).all() and np.isnan(found.shadow[7, 9]).all()
    assert found.lit_frames[7, 9] == 0 and found.shadow_frames[7, 9] == 0
    assert np.isfinite(found.lit).all(axis=-1).sum() == found.lit_frames.size - 1


def test_a_pixel_that_was_never_darkened_has_no_shadow() -> None:
    lit = [SCENE.noisy(SCENE.lit, seed).astype(np.float16) for seed in range(FRAMES)]
    found = measure(lit)
    assert (found.shadow_frames == 0).mean() > 0.99
    assert np.array_equal(np.isnan(found.shadow).any(axis=-1), found.shadow_frames == 0)
    assert (found.lit_frames > 0.9 * FRAMES).mean() > 0.95


def test_a_pixel_shaded_in_most_frames_has_both_plates() -> None:
    pairs = [(0.0 if number % 5 else 1.0, number) for number in range(60)]
    frames = [
        SCENE.noisy(SCENE.image(np.full(SHAPE, beta, np.float32)), seed).astype(np.float16)
        for beta, seed in pairs
    ]
    found = measure(frames)
    assert abs(relative(found.lit, SCENE.lit).mean()) < 0.4
    assert abs(relative(found.shadow, SCENE.shadow).mean()) < 0.1
    assert (found.lit_frames <= 12).all() and (found.shadow_frames <= 48).all()
    assert found.shadow_frames.mean() > 46


def test_black_with_noise_about_it_has_plates_too() -> None:
    rng = np.random.default_rng(0)
    frames = [rng.normal(0, 4.5e-4, (*SHAPE, 3)).astype(np.float16) for _ in range(FRAMES)]
    found = measure(frames)
    assert np.isfinite(found.lit).all()
    assert np.abs(found.lit).max() < 3 * 4.5e-4
    assert np.sqrt((found.lit**2).mean()) < 4.5e-4
    assert (found.lit_frames > FRAMES / 2).mean() > 0.9


def test_exact_black_is_black() -> None:
    frames = [np.zeros((*SHAPE, 3), np.float16)] * 10
    found = measure(frames)
    assert (found.lit == 0).all() and (found.lit_frames == 10).all()


def test_a_clipped_light_keeps_its_value() -> None:
    frames = take()
    for frame in frames:
        frame[5:8, 5:8] = 65504
    assert (measure(frames).lit[5:8, 5:8] == 65504).all()


@pytest.mark.parametrize("level", [0.25, 0.5, 1.0])
def test_levels_at_a_power_of_two_have_no_bias_either(level: float) -> None:
    ground = np.full((*SHAPE, 3), level, np.float32)
    frames = [SCENE.noisy(ground, seed).astype(np.float16) for seed in range(FRAMES)]
    assert abs(relative(measure(frames).lit, ground).mean()) < 0.25


def test_halfs_and_floats_may_be_mixed() -> None:
    halfs = take()
    mixed = [f.astype(np.float32) if number % 2 else f for number, f in enumerate(halfs)]
    assert same(measure(halfs), measure(mixed))


def test_floats_beyond_the_halfs_are_clipped_not_lost() -> None:
    frames = [np.full((4, 4, 3), 1e6, np.float32)] * 4
    assert (measure(frames).lit_frames == 4).all()


def test_inputs_are_left_alone() -> None:
    frames = take()
    holdout = np.zeros(SHAPE, np.uint8)
    holdout[3:9] = 255
    before = [frame.copy() for frame in frames]
    measure(frames, [holdout] * FRAMES)
    assert all(np.array_equal(f, b) for f, b in zip(frames, before, strict=True))
    assert (holdout > 0).sum() == 6 * SHAPE[1]


def test_two_readings_of_the_same_take_are_the_same_bits() -> None:
    assert same(measure(take()), measure(take()))


def test_results_may_be_asked_for_along_the_way_and_written_on() -> None:
    frames = take()
    levels = SampledLevels(*SHAPE)
    for frame in frames[::2]:
        levels.add(keyed(frame).gray)
    asked, plain = (RobustPlates(levels.levels(), NOISE) for _ in range(2))
    for frame in frames:
        asked.add(keyed(frame))
        asked.measured().lit[:] = 7
        plain.add(keyed(frame))
    assert same(asked.measured(), plain.measured())


class SlowGroup:
    """A group of frames of one pixel."""

    def __init__(self, gray: int, keys: np.ndarray) -> None:
        self.grays, self.keys = [gray], [keys]

    def join(self, gray: int, key: np.ndarray) -> None:
        self.grays.append(gray)
        self.keys.append(key)

    def above(self, gray: int) -> float:
        return gray - float(np.mean(self.grays))


def slow_darkest(
    grays: list[int],
    keys: list[np.ndarray],
    width: float,
    known: tuple[int, int] | None = None,
) -> SlowGroup | None:
    """The darkest group of a pixel's darkened frames, or the next one if it is much larger.

    Where the sample told the shadow's keys, from the first to the last of ``known``, frames
    between these are the next group, and only darker ones found another.
    """
    lowest = backup = None
    for gray, key in zip(grays, keys, strict=True):
        if known is not None and gray >= known[0]:
            if gray <= known[1] and backup is None:
                backup = SlowGroup(gray, key)
            elif gray <= known[1]:
                backup.join(gray, key)
        elif lowest is None or lowest.above(gray) < -width:
            backup = lowest if known is None else backup
            lowest = SlowGroup(gray, key)
        elif lowest.above(gray) <= width:
            lowest.join(gray, key)
        elif known is not None:
            continue
        elif backup is None or backup.above(gray) < -width:
            backup = SlowGroup(gray, key)
        elif backup.above(gray) <= width:
            backup.join(gray, key)
    if lowest and backup and len(lowest.grays) < 3 and len(backup.grays) >= 2 * len(lowest.grays):
        return backup
    return lowest or backup


@pytest.mark.parametrize("sampled", [0, 5, 24])
@settings(max_examples=5, deadline=None)
@given(st.integers(0, 999))
def test_groups_are_those_of_each_pixel_by_itself(sampled: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = 70, 3
    # Three depths of shade, and some light.
    depth = rng.choice([0.1, 0.25, 0.4, 1], (24, height, width, 1), p=[0.1, 0.5, 0.2, 0.2])
    ground = rng.uniform(0.2, 0.9, (height, width, 3))
    frames = [
        keyed(SCENE.noisy(ground * d, seed + i).astype(np.float16)) for i, d in enumerate(depth)
    ]
    sample = SampledLevels(height, width)
    sample.add(keyed(SCENE.noisy(ground, 1).astype(np.float16)).gray)
    for frame in frames[:sampled]:
        sample.add(frame.gray)
    levels = sample.levels()
    plates = RobustPlates(levels, NOISE)
    for frame in frames:
        plates.add(frame)
    found = plates.measured()
    agreed = 0
    for y in range(height):
        for x in range(width):
            dark = [f for f in frames if f.gray[y, x] < plates._dark[y, x]]
            known = int(plates._shaded_low[y, x]), int(plates._shaded_high[y, x])
            agree = known[0] <= known[1]
            agreed += agree
            if agree:
                three = sorted(int(f.gray[y, x]) for f in frames[:sampled])[:3]
                assert known[0] <= three[0] <= three[2] <= known[1] < plates._dark[y, x]
            group = slow_darkest(
                [int(f.gray[y, x]) for f in dark],
                [f.keys[y, x].astype(np.int32) for f in dark],
                plates._near[y, x],
                known if agree else None,
            )
            if group is None:
                assert found.shadow_frames[y, x] == 0
                continue
            assert found.shadow_frames[y, x] == len(group.keys)
            mean = mean_of_keys(np.sum(group.keys, axis=0), np.array(len(group.keys)))
            assert np.array_equal(found.shadow[y, x], mean)
    assert (agreed > 0) == (sampled > 0)


def peak(add: Callable[[], None], frames: int) -> int:
    tracemalloc.reset_peak()
    for _ in range(frames):
        add()
    return tracemalloc.get_traced_memory()[1]


def test_memory_does_not_grow_with_the_frames() -> None:
    levels = SampledLevels(*SHAPE)
    levels.add(keyed(SCENE.lit).gray)
    plates = RobustPlates(levels.levels(), NOISE)

    def add() -> None:
        for image in (SCENE.lit, SCENE.shadow):
            frame = keyed(image.copy())
            levels.add(frame.gray)
            plates.add(frame)

    add()
    tracemalloc.start()
    few, many = peak(add, 10), peak(add, 200)
    tracemalloc.stop()
    assert many < few + SCENE.lit.nbytes


@pytest.mark.skipif(robust_plates._compiled is None, reason="installed without a compiler")
@pytest.mark.parametrize(("bytes_each", "most"), [(1, 8), (3, 3), (5, 2), (9, 1), (100, 1)])
def test_no_more_frames_wait_than_there_is_room_for(
    bytes_each: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = keyed(SCENE.lit)
    size = frame.keys.nbytes + frame.gray.nbytes
    monkeypatch.setattr(robust_plates, "_WAITING", 10 * size // bytes_each)
    levels = SampledLevels(*SHAPE)
    levels.add(frame.gray)
    plates = RobustPlates(levels.levels(), NOISE)
    waiting = []
    for _ in range(20):
        plates.add(frame)
        waiting.append(len(plates._waiting))
    # The last of them is taken in at once with those that waited.
    assert max(waiting) == most - 1
    assert plates.measured().lit_frames.max() == 20


def test_a_frame_of_another_size_is_refused_and_changes_nothing() -> None:
    levels = SampledLevels(4, 6)
    lit = keyed(np.full((4, 6, 3), 0.5, np.float16))
    turned = keyed(np.full((6, 4, 3), 0.5, np.float16))
    levels.add(lit.gray)
    with pytest.raises(ValueError, match="among frames of"):
        levels.add(turned.gray)
    plates = RobustPlates(levels.levels(), NOISE)
    plates.add(lit)
    with pytest.raises(ValueError, match="among frames of"):
        plates.add(turned)
    assert (plates.measured().lit_frames == 1).all()


def any_take(seed: int, negative: bool) -> tuple[list[np.ndarray], Holdouts]:
    """Lit and shaded frames, birds of all brightnesses, noise, NaN, and what is held out."""
    rng = np.random.default_rng(seed)
    height, width = rng.integers(1, 40, 2)
    lit = rng.uniform(-0.01 if negative else 0.01, 1, (height, width, 3))
    frames: list[np.ndarray] = []
    holdouts: Holdouts = []
    for _ in range(rng.integers(1, 40)):
        frame = lit * rng.choice([1, 0.3, 0.1, 0.32], (height, width, 1), p=[0.5, 0.3, 0.1, 0.1])
        frame = frame + rng.normal(scale=0.002, size=frame.shape)
        frame[rng.random((height, width)) < 0.03] = rng.choice([2, 1e-3, np.nan, np.inf])
        frames.append((frame if negative else np.abs(frame)).astype(np.float16))
        holdouts.append((rng.random((height, width)) < 0.1).astype(np.uint8))
    return frames, holdouts


@pytest.mark.skipif(robust_plates._compiled is None, reason="installed without a compiler")
@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([1, 10_000, 64 << 20]))
def test_compiled_or_not_and_few_at_a_time_or_many_the_same_plates_are_found(
    seed: int, negative: bool, waiting: int
) -> None:
    frames, holdouts = any_take(seed, negative)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robust_plates, "_WAITING", waiting)
        found = measure(frames, holdouts)
        patch.setattr(robust_plates, "_compiled", None)
        assert same(found, measure(frames, holdouts))


@pytest.mark.skipif(robust_plates._compiled is None, reason="installed without a compiler")
@pytest.mark.parametrize(
    "wrong",
    [
        {"frames": 0},
        {"frames": 9},
        {"odd": True},
        {"keys": (4, 5, 2)},
        {"gray": (4, 6)},
        {"bounds": 5},
        {"bound": "f4"},
        {"near": (3, 5)},
        {"lit": 1},
        {"total": (4, 5)},
        {"groups": 5},
        {"group": "f8"},
    ],
)
def test_what_does_not_fit_together_is_not_taken_in(wrong: dict) -> None:
    def add(
        frames=2, odd=False, keys=(4, 5, 3), gray=(4, 5), bounds=6, bound="i2", near=(4, 5),
        lit=2, total=(4, 5, 3), groups=6, group="f4",
    ):  # fmt: skip
        one = np.zeros(keys, "i2"), np.zeros(gray, "i2")
        shapes = [(4, 5), (4, 5), (4, 5, 3)] * 2
        robust_plates._compiled.add(
            (one * frames)[odd:],
            tuple(np.zeros((4, 5), bound) for _ in range(bounds)),
            np.zeros(near, "f4"),
            (np.zeros((4, 5), "i4"), np.zeros(total, "f4"))[:lit],
            tuple(np.zeros(shape, group) for shape in shapes[:groups]),
            3,
        )

    add()
    with pytest.raises((ValueError, IndexError)):
        add(**wrong)


@pytest.mark.skipif(robust_plates._compiled is None, reason="installed without a compiler")
@pytest.mark.parametrize(("frames", "gray", "kept"), [(0, 4, 6), (9, 4, 6), (2, 5, 6), (2, 4, 5)])
def test_grays_that_do_not_fit_together_are_not_sampled(frames: int, gray: int, kept: int) -> None:
    with pytest.raises((ValueError, IndexError)):
        robust_plates._compiled.sample(
            (np.zeros((4, 4), "i2"), *(np.zeros((4, gray), "i2") for _ in range(frames - 1)))
            if frames
            else (),
            tuple(np.zeros((4, 4), "i2") for _ in range(kept)),
        )
