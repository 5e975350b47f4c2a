"""W and the light's image from passes that are known in closed form."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from shadowtool.core.shadow_time import ShadowTimes
from shadowtool.core.warp_map import Pass, identity_map
from shadowtool.steps.solve import Solved, solve
from tests.core.test_shadow_lines import SCENE, lines_of
from tests.scene import Sweep

HERE = identity_map(SCENE.height, SCENE.width)
SWEEPS = [Sweep(angle) for angle in (0.2, 1.3, 2.4)]


def passed(sweep: Sweep, warp: np.ndarray) -> np.ndarray:
    """When the edge passes W[p], frames, (H, W) float32."""
    normal, offset = SCENE.edge(sweep, 0)
    return ((warp @ normal + offset) / sweep.speed).astype(np.float32)


def pass_of(sweep: Sweep, warp: np.ndarray, error: float = 0.02, marked: bool = True) -> Pass:
    """What a scan would make of a scene with this map; its lines are those of the plane."""
    frames = np.arange(SCENE.frames_of(sweep), dtype=np.float64)
    lines = lines_of(passed(sweep, HERE), SCENE.plane, frames)
    time = passed(sweep, warp)
    times = ShadowTimes.alone(time, np.ones_like(time), error)
    return Pass(times, lines, SCENE.plane if marked else None)


def off_block(solved: Solved) -> float:
    error = np.linalg.norm(solved.warp_map.warp - SCENE.warp, axis=-1)
    return float(np.nanmedian(error[~SCENE.plane]))


def towards(x: float, y: float, by: float) -> np.ndarray:
    """The scene's map with errors on the plane, all of them towards a point."""
    away = np.float32([x, y]) - HERE
    errors = by * away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1)
    return np.where(SCENE.plane[..., np.newaxis], HERE + errors, SCENE.warp)


@pytest.mark.parametrize("marked", [True, False])
def test_what_the_plane_errs_in_common_says_nothing_of_the_light(marked: bool) -> None:
    wrong = towards(130, 70, by=6)
    solved = solve([pass_of(sweep, wrong, marked=marked) for sweep in SWEEPS])
    assert solved.epipole is not None and solved.left_out is None
    inside = (np.abs(solved.epipole.position - [80, 45]) < [80, 45]).all()
    assert inside != marked
    assert (off_block(solved) < 0.2) == marked


# The third runs along the displacement, and does not turn it.
@pytest.mark.parametrize("bad", [0, 1])
def test_a_pass_that_does_not_agree_with_the_others_is_left_out(bad: int) -> None:
    waves = 8 * np.sin(HERE[..., 1:] / 3) * np.float32([1, 0.3])
    wrong = np.where(SCENE.plane[..., np.newaxis], SCENE.warp, SCENE.warp + waves)
    passes = [
        pass_of(sweep, wrong if number == bad else SCENE.warp)
        for number, sweep in enumerate(SWEEPS)
    ]
    solved = solve(passes)
    assert solved.left_out == bad
    assert off_block(solved) < 0.2


def test_where_the_others_say_nothing_a_pass_that_was_left_out_is_used() -> None:
    waves = 8 * np.sin(HERE[..., 1:] / 3) * np.float32([1, 0.3])
    wrong = np.where(SCENE.plane[..., np.newaxis], SCENE.warp, SCENE.warp + waves)
    passes = [
        pass_of(sweep, wrong if number == 0 else SCENE.warp) for number, sweep in enumerate(SWEEPS)
    ]
    passes[1].times.time[:, 110:] = passes[1].times.own_time[:, 110:] = np.nan
    solved = solve(passes)
    assert solved.left_out == 0
    assert np.isfinite(solved.warp_map.error[:, 120:150]).mean() > 0.95
    assert off_block(solved) < 0.2


def test_a_part_of_a_block_that_one_pass_reached_is_measured() -> None:
    passes = [pass_of(sweep, SCENE.warp) for sweep in SWEEPS]
    for scan in passes[1:]:
        scan.times.time[:, 85:] = scan.times.own_time[:, 85:] = np.nan
    found = solve(passes).warp_map
    part = ~SCENE.plane
    part[:, :85] = False
    assert np.isfinite(found.error[part]).mean() > 0.99
    assert np.nanmax(np.linalg.norm(found.warp - SCENE.warp, axis=-1)[part]) < 0.5


def test_a_mark_that_is_drawn_over_everything_hides_no_light() -> None:
    passes = [pass_of(sweep, SCENE.warp) for sweep in SWEEPS]
    everything = np.ones_like(SCENE.plane)
    solved = solve([replace(scan, plane=everything) for scan in passes])
    assert solved.epipole is not None
    assert off_block(solved) < 0.2


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_all_passes_are_no_ones_fault(seed: int) -> None:
    """Flat ground that nobody marked, and errors that neighbours have in common."""
    rng = np.random.default_rng(seed)
    passes = []
    for sweep in SWEEPS:
        scan = pass_of(sweep, HERE, marked=False)
        errors = cv2.GaussianBlur(rng.normal(size=SCENE.plane.shape), (0, 0), 6)
        for times in (scan.times.time, scan.times.own_time):
            times += (0.5 * errors / errors.std()).astype(np.float32)
        passes.append(scan)
    assert solve(passes).left_out is None


def test_passes_that_agree_are_all_used() -> None:
    solved = solve([pass_of(sweep, SCENE.warp) for sweep in SWEEPS])
    assert solved.left_out is None
    two = solve([pass_of(sweep, SCENE.warp) for sweep in SWEEPS[:2]])
    assert two.left_out is None
    assert np.isfinite(solved.warp_map.error).mean() >= np.isfinite(two.warp_map.error).mean()


def wavy_pass(sweep: Sweep, waves: float) -> Pass:
    """A pass whose edge is off the straight by waves, pixels, too long for windows to see."""
    normal, _ = SCENE.edge(sweep, 0)

    def off(warp: np.ndarray) -> np.ndarray:
        return (waves / sweep.speed * np.sin(warp @ [-normal[1], normal[0]] / 9)).astype(np.float32)

    frames = np.arange(SCENE.frames_of(sweep), dtype=np.float64)
    lines = lines_of(passed(sweep, HERE) + off(HERE), SCENE.plane, frames)
    time = passed(sweep, SCENE.warp) + off(SCENE.warp)
    return Pass(ShadowTimes.alone(time, np.ones_like(time), 0.02), lines, SCENE.plane)


def test_what_edges_are_off_the_straight_is_predicted_off_the_plane() -> None:
    straight, wavy = (
        solve([wavy_pass(sweep, waves) for sweep in SWEEPS]).warp_map for waves in (0.0, 0.4)
    )
    for found in (straight, wavy):
        off = np.linalg.norm(found.warp - SCENE.warp, axis=-1)
        within = (off < 2 * found.error)[~SCENE.plane & np.isfinite(found.error)]
        assert within.mean() > 0.7
    assert np.median(straight.error[~SCENE.plane]) < 0.1
    assert np.median(wavy.error[SCENE.plane]) < 0.1


def test_where_nothing_stands_on_the_plane_there_is_no_light_and_no_pass_is_wrong() -> None:
    passes = [pass_of(sweep, HERE) for sweep in SWEEPS]
    rng = np.random.default_rng(0)
    for scan in passes:
        scan.times.time[:] += rng.normal(scale=0.02, size=scan.times.time.shape)
    solved = solve([replace(scan, plane=None) for scan in passes])
    assert solved.epipole is None and solved.left_out is None
