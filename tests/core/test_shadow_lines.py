import numpy as np
import pytest

from shadowtool.core.shadow_lines import (
    Bend,
    ShadowLines,
    fit_shadow_lines,
    interpolate_lines,
    line_bend,
    line_pace,
    off_lines,
    zero_crossings,
)
from shadowtool.core.warp_map import identity_map
from shadowtool.errors import NoLinesError
from tests.scene import Scene, Sweep

SCENE = Scene()


def edge_times(sweep: Sweep) -> np.ndarray:
    """When the edge of a sweep that may turn reaches each pixel, by bisection."""
    low = np.zeros((SCENE.height, SCENE.width))
    high = np.full(low.shape, float(SCENE.frames_of(sweep)))
    for _ in range(40):
        middle = (low + high) / 2
        angle = sweep.angle + sweep.turn * middle
        centre = np.array([SCENE.width / 2, SCENE.height / 2])
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        reach = (abs(normal) * centre).sum(axis=-1) + sweep.soft
        distance = (normal * (SCENE.warp - centre)).sum(axis=-1) + reach - sweep.speed * middle
        low, high = np.where(distance > 0, middle, low), np.where(distance > 0, high, middle)
    return low.astype(np.float32)


def lines_of(time: np.ndarray, plane: np.ndarray, frames: np.ndarray) -> ShadowLines:
    return fit_shadow_lines(zero_crossings(time, plane, frames), frames)


def fitted(sweep: Sweep, time: np.ndarray | None = None) -> ShadowLines:
    frames = np.arange(SCENE.frames_of(sweep), dtype=np.float64)
    return lines_of(edge_times(sweep) if time is None else time, SCENE.plane, frames)


def errors(lines: ShadowLines, sweep: Sweep) -> np.ndarray:
    """The largest distance within the picture between each line and the true one."""
    worst = []
    for frame, normal, offset in zip(lines.frame, lines.normal, lines.offset, strict=True):
        true_normal, true_offset = SCENE.edge(sweep, frame)
        along = np.array([-true_normal[1], true_normal[0]])
        middle = np.array([SCENE.width / 2, SCENE.height / 2])
        foot = middle - (true_normal @ middle + true_offset) * true_normal
        ends = foot + np.array([[-1.0], [1.0]]) * along * 60
        worst.append(np.abs(ends @ normal + offset).max())
    return np.array(worst)


@pytest.mark.parametrize("angle", np.linspace(0.05, 6.2, 9))
def test_lines_of_any_direction_are_found(angle: float) -> None:
    sweep = Sweep(angle)
    lines = fitted(sweep)
    assert np.percentile(errors(lines, sweep), 90) < 0.05
    assert np.hypot(*lines.normal.T) == pytest.approx(1)
    assert (np.diff(lines.frame) == 1).all()
    assert (np.abs(np.diff(lines.angle)) < 0.1).all()


def test_a_turning_stick_is_followed() -> None:
    sweep = Sweep(1.0, turn=0.004)
    lines = fitted(sweep)
    assert np.percentile(errors(lines, sweep), 90) < 0.1


def test_times_before_the_first_frame_and_after_the_last_make_no_crossing() -> None:
    ramp = np.tile(np.arange(20, dtype=np.float32) / 2 - 1.3, (5, 1)) + 1001
    points = zero_crossings(ramp, np.ones(ramp.shape, bool), 1001 + np.arange(6.0))
    assert sorted(points) == list(range(6))


def test_crossings_lie_where_time_equals_the_frame() -> None:
    ramp = np.tile(np.arange(20, dtype=np.float32) / 2 + 0.3, (5, 1))
    points = zero_crossings(ramp, np.ones(ramp.shape, bool), np.arange(11.0))
    for frame, found in points.items():
        assert found[:, 0] == pytest.approx((frame - 0.3) * 2, abs=1e-4)
    assert sorted(points) == list(range(1, 10))


def test_each_crossing_is_counted_once_where_times_are_whole() -> None:
    ramp = np.tile(np.arange(8, dtype=np.float32), (3, 1))
    points = zero_crossings(ramp, np.ones(ramp.shape, bool), np.arange(8.0))
    assert all(len(found) == 3 for found in points.values())


def test_frames_need_not_be_one_apart() -> None:
    sweep = Sweep(0.4)
    whole = fitted(sweep)
    count = SCENE.frames_of(sweep)
    frames = np.arange(count, dtype=np.float64)
    time = (edge_times(sweep) * 2 + 1001).astype(np.float32)
    doubled = lines_of(time, SCENE.plane, frames * 2 + 1001)
    assert doubled.offset == pytest.approx(whole.offset, abs=1e-2)


def test_pixels_outside_the_plane_do_not_count() -> None:
    sweep = Sweep(0.7)
    time = edge_times(sweep)
    spoilt = np.where(SCENE.plane, time, np.float32(3.0))
    assert np.array_equal(fitted(sweep, spoilt).offset, fitted(sweep, time).offset)


def test_bad_samples_do_not_pull_the_lines() -> None:
    sweep = Sweep(0.3)
    time = edge_times(sweep)
    # A patch of the plane in which the times are nonsense for two frames' worth of the sweep.
    patch = (slice(5, 25), slice(110, 150))
    spoilt = time.copy()
    spoilt[patch] = np.where(np.abs(time[patch] - 40) < 3, time[patch] - 9, time[patch])
    lines = fitted(sweep, spoilt)
    assert np.percentile(errors(lines, sweep), 97) < 0.1


@pytest.mark.parametrize("part", [0.02, 0.2])
def test_specks_do_not_pull_the_lines(part: float) -> None:
    sweep = Sweep(0.3)
    rng = np.random.default_rng(0)
    time = edge_times(sweep)
    specks = rng.uniform(size=time.shape) < part
    spoilt = np.where(specks, rng.uniform(0, 60, time.shape), time).astype(np.float32)
    assert np.percentile(errors(fitted(sweep, spoilt), sweep), 90) < 0.5


def test_a_line_whose_direction_jumps_is_replaced_by_its_neighbours() -> None:
    sweep = Sweep(0.0)
    time = edge_times(sweep)
    frame = 30
    near = np.abs(time - frame) < 0.5
    rows = np.arange(SCENE.height)[:, None] - SCENE.height / 2
    tilted = time + np.where(near, 0.012 * rows, 0).astype(np.float32)
    lines = fitted(sweep, tilted)
    at = int(np.nonzero(lines.frame == frame)[0][0])
    assert lines.origin[at] == "interpolated"
    assert errors(lines, sweep)[at] < 0.3


@pytest.mark.parametrize("pause", [3, 12])
def test_a_hand_that_pauses_does_not_make_a_turning_stick_jump(pause: int) -> None:
    sweep, at = Sweep(0.2, speed=5.0, turn=0.03), 25.0
    time = edge_times(sweep)
    paused = np.interp(time, [at, at + 0.2], [0, pause]).astype(np.float32)
    frames = np.arange(SCENE.frames_of(sweep) + pause, dtype=np.float64)
    lines = lines_of(time + paused, SCENE.plane, frames)
    near = np.abs(lines.frame - at - pause / 2) < pause / 2 + 3
    assert {origin for origin, own in zip(lines.origin, near, strict=True) if own} == {"fit"}


@pytest.mark.parametrize(("frames", "replaced"), [(3, True), (15, False)])
def test_poor_lines_are_replaced_unless_they_are_all_that_there_is(
    frames: int, replaced: bool
) -> None:
    sweep = Sweep(0.0)
    time = edge_times(sweep)
    rows = np.arange(SCENE.height)[:, None] / SCENE.height - 0.5
    bent = (time > 20 - 0.5) & (time < 20 + frames - 0.5)
    sagging = time + np.where(bent, 3 * (rows**2 - 1 / 12), 0).astype(np.float32)
    lines = fitted(sweep, sagging)
    middle = int(np.nonzero(lines.frame == 20 + frames // 2)[0][0])
    assert (lines.origin[middle] == "interpolated") == replaced
    assert errors(lines, sweep)[middle] < 1


def test_what_passes_the_plane_off_its_lines_is_counted() -> None:
    sweep = Sweep(0.3)
    time = edge_times(sweep)
    lines = fitted(sweep, time)
    assert np.percentile(off_lines(time, SCENE.plane, lines), 99) < 0.2
    late = time.copy()
    late[:9] += 2
    off = off_lines(late, SCENE.plane, lines)
    rows = (np.nonzero(SCENE.plane)[0] < 9).mean()
    assert (off > 5).mean() == pytest.approx(rows, abs=0.02)
    assert off_lines(np.full_like(time, np.nan), SCENE.plane, lines).size == 0


def test_interpolated_lines_lie_between_and_keep_their_length() -> None:
    sweep = Sweep(1.0, turn=0.004)
    lines = fitted(sweep)
    between = interpolate_lines(lines, np.array([lines.frame[5] + 0.5]))
    assert errors(between, sweep)[0] < 0.1
    assert np.hypot(*between.normal.T) == pytest.approx(1)


def test_a_board_that_gains_speed_in_perspective_is_followed_between_the_frames() -> None:
    def at(time: np.ndarray) -> ShadowLines:
        nothing = np.zeros(len(time))
        angle = 0.3 + 0.02 * (20 - time) ** 0.5
        normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        fit = ("fit",) * len(time)
        return ShadowLines(time, normal, -2000 / (20 - time), nothing, nothing.astype(int), fit)

    lines, between = at(np.arange(16.0)), np.linspace(1, 14, 80)
    found, true = interpolate_lines(lines, between), at(between)
    straight = np.interp(between, lines.frame, lines.offset)
    assert np.abs(found.offset - true.offset).max() < 0.2 * np.abs(straight - true.offset).max()
    assert np.abs(found.angle - true.angle).max() < 1e-3


@pytest.mark.parametrize("every", [1, 3])
def test_lines_that_fan_out_pass_what_is_far_from_their_middle_faster(every: int) -> None:
    frame = np.arange(0.0, 12, every)
    normal = np.stack([np.cos(0.1 * frame), np.sin(0.1 * frame)], axis=-1)
    nothing = np.zeros(len(frame))
    fan = ShadowLines(frame, normal, nothing, nothing, nothing.astype(int), ("fit",) * len(frame))
    times = np.float64([0, 3.5, 9, 11])
    along = np.stack([-np.sin(0.1 * times), np.cos(0.1 * times)], axis=-1)
    for far in (10, 300):
        pace = line_pace(fan, times, far * along)
        assert pace == pytest.approx(np.full(4, 0.1 * far), rel=0.07)


def test_times_outside_the_sweep_have_no_line() -> None:
    lines = fitted(Sweep(1.0))
    outside = interpolate_lines(lines, np.array([lines.frame[0] - 1, lines.frame[-1] + 1, np.nan]))
    assert np.isnan(outside.offset).all()


def test_a_plane_that_no_edge_crosses_is_refused() -> None:
    nothing = np.full((SCENE.height, SCENE.width), np.nan, np.float32)
    with pytest.raises(NoLinesError):
        lines_of(nothing, SCENE.plane, np.arange(30.0))
    tiny = np.zeros_like(SCENE.plane)
    tiny[10:12, 10:12] = True
    with pytest.raises(NoLinesError):
        lines_of(edge_times(Sweep(0.3)), tiny, np.arange(60.0))


def bowed(sweep: Sweep, strength: float) -> np.ndarray:
    """Times of a sweep as a lens sees them that takes a point at x from the middle to
    x(1 + strength |x|²), x in units of half the width."""
    half = SCENE.width / 2
    middle = np.array([(SCENE.width - 1) / 2, (SCENE.height - 1) / 2])
    seen = identity_map(SCENE.height, SCENE.width) - middle
    # The undistorted place of each pixel, to first order.
    place = seen * (1 - strength * ((seen / half) ** 2).sum(axis=-1, keepdims=True)) + middle
    normal, offset = SCENE.edge(sweep, 0)
    return ((place @ normal + offset) / sweep.speed).astype(np.float32)


def bend_of(time: np.ndarray, plane: np.ndarray, frames: np.ndarray) -> Bend:
    points = zero_crossings(time, plane, frames)
    return line_bend(points, frames, fit_shadow_lines(points, frames), (SCENE.width, SCENE.height))


@pytest.mark.parametrize("angle", [0.2, 1.4, 2.6])
@pytest.mark.parametrize("strength", [-0.03, 0.02])
def test_a_lens_that_bows_lines_is_found(angle: float, strength: float) -> None:
    sweep = Sweep(angle)
    frames = np.arange(SCENE.frames_of(sweep), dtype=np.float64)
    everywhere = np.ones_like(SCENE.plane)
    time = bowed(sweep, strength)
    bend = bend_of(time, everywhere, frames)
    # At half the height from the middle and half the width along: strength · ρ · u².
    assert bend.pixels == pytest.approx(-strength * SCENE.height / 2, rel=0.25)
    assert bend.certainty > 10


def test_straight_lines_do_not_bend() -> None:
    for angle in (0.2, 1.4, 2.6):
        sweep = Sweep(angle)
        frames = np.arange(SCENE.frames_of(sweep), dtype=np.float64)
        rng = np.random.default_rng(0)
        time = edge_times(sweep) + rng.normal(scale=0.05, size=SCENE.plane.shape)
        bend = bend_of(time.astype(np.float32), SCENE.plane, frames)
        assert abs(bend.pixels) < 0.1


def test_inputs_are_left_alone() -> None:
    time = edge_times(Sweep(0.3))
    before = time.copy()
    fitted(Sweep(0.3), time)
    assert np.array_equal(time, before)
