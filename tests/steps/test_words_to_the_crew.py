"""What scan and warp say while there is time to shoot again."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from shadowtool.core.half_floats import to_half
from shadowtool.errors import ReshootError
from shadowtool.io.image import Header, write_exr
from shadowtool.io.products import read_scan, write_scan
from shadowtool.steps.run import Run
from shadowtool.steps.scan import scan
from shadowtool.steps.warp import warp
from tests.scene import Sweep
from tests.steps.test_geometry import SCENE, SWEEPS, shoot

# What is in front of the block.
PLANE = "0,61 159,61 159,89 0,89"


def test_a_hasty_sweep_is_told_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    take = shoot(tmp_path / "take", Sweep(0.3, speed=24.0, soft=1.0, width=60.0))
    scan(take, tmp_path / "scan", plane=PLANE)
    assert "the shadow moves 24 pixels a frame" in caplog.text
    assert "of the frame; what it misses" not in caplog.text


def test_a_sweep_that_stops_half_way_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    take = shoot(tmp_path / "take", SWEEPS["first"])
    last = 1001 + SCENE.frames_of(SWEEPS["first"]) // 4
    result = scan(take, tmp_path / "scan", plane=PLANE, run=Run(frames=f"1001-{last}"))
    assert f"reached only {100 * result.figures['reached']:.0f}% of the frame" in caplog.text
    assert "pixels a frame" not in caplog.text


@pytest.mark.parametrize("further", [2**22, -(2**22 + 2000)])
def test_frame_numbers_that_single_floats_hardly_hold_are_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, further: int
) -> None:
    take = shoot(tmp_path / "take", SWEEPS["first"])
    scan(take, tmp_path / "few", plane=PLANE)
    assert "few digits" not in caplog.text
    for path in sorted(take.iterdir()):
        path.rename(take / f"take.{int(path.name.split('.')[1]) + further}.exr")
    scan(take, tmp_path / "many", plane=PLANE)
    assert "frame numbers this large leave float32 times few digits" in caplog.text
    few, many = (read_scan(tmp_path / name)[0].times for name in ("few", "many"))
    # Times half a frame apart are off by so much for being rounded.
    assert many.error[np.isfinite(many.time)].min() > 0.5 / np.sqrt(12) - 0.01
    assert np.median(few.error[np.isfinite(few.time)]) < 0.05


def test_things_that_sway_are_no_camera_that_trembles(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sweep, rng = SWEEPS["first"], np.random.default_rng(3)
    (tmp_path / "take").mkdir()
    for frame in range(SCENE.frames_of(sweep)):
        image = SCENE.image(SCENE.sweep_beta(sweep, frame)).astype(np.float32)
        for first in range(0, SCENE.width, SCENE.width // 4):
            strip = image[:, first : first + SCENE.width // 4]
            move = np.hstack([np.eye(2), rng.normal(0, 0.8, (2, 1))])
            size = strip.shape[1::-1]
            strip[:] = cv2.warpAffine(strip, move, size, borderMode=cv2.BORDER_REFLECT)
        path = tmp_path / "take" / f"take.{1001 + frame}.exr"
        noisy = to_half(SCENE.noisy(image, frame))
        write_exr(path, {"RGB": noisy}, Header(SCENE.width, SCENE.height))
    scan(tmp_path / "take", tmp_path / "none", plane=PLANE, steady="none")
    assert "the camera trembles" in caplog.text and "a camera that trembles" in caplog.text
    caplog.clear()
    scan(tmp_path / "take", tmp_path / "auto", plane=PLANE)
    assert "what noise explains" in caplog.text and "camera" not in caplog.text


def test_times_that_differ_by_more_than_noise_are_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sweep, rng = SWEEPS["first"], np.random.default_rng(0)
    errors = []
    for name, part in (("even", 0.0), ("uneven", 0.15)):
        (tmp_path / name).mkdir()
        # As of a codec that sends some blocks a frame too soon.
        early = np.kron(rng.random((30, 54)) < part, np.ones((3, 3), bool))[:90, :160]
        for frame in range(SCENE.frames_of(sweep)):
            now, soon = (SCENE.sweep_beta(sweep, frame + step) for step in (0, 1))
            image = SCENE.noisy(SCENE.image(np.where(early, soon, now)), frame)
            path = tmp_path / name / f"take.{1001 + frame}.exr"
            write_exr(path, {"RGB": to_half(image)}, Header(SCENE.width, SCENE.height))
        scan(tmp_path / name, tmp_path / f"{name}-scan", plane=PLANE)
        assert ("what noise explains" in caplog.text) == (part > 0)
        found = read_scan(tmp_path / f"{name}-scan")[0].times.own_error
        errors.append(np.median(found[np.isfinite(found)]))
    assert errors[1] > 2 * errors[0]


def test_a_map_that_would_be_far_off_is_to_be_shot_again(tmp_path: Path) -> None:
    folders = []
    for name in ("first", "second"):
        folder = tmp_path / f"{name}-scan"
        scan(shoot(tmp_path / name, SWEEPS[name]), folder, plane=PLANE)
        found, header, _ = read_scan(folder)
        for error in (found.times.error, found.times.own_error):
            error[np.isfinite(error)] = 100
        write_scan(folder, found, header, {})
        folders.append(folder)
    with pytest.raises(ReshootError, match="the map would be off by"):
        warp(folders, tmp_path / "map")
    assert not (tmp_path / "map").exists()
