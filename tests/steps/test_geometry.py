"""From swept frames on disk to W, on the analytic scene."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from shadowtool.core.half_floats import to_half
from shadowtool.core.warp_map import identity_map
from shadowtool.errors import OptionError, ReshootError
from shadowtool.io.image import Header, write_exr, write_png
from shadowtool.io.products import WARP, read_scan, read_warp, write_scan
from shadowtool.steps.run import Run
from shadowtool.steps.scan import scan
from shadowtool.steps.warp import warp
from tests.scene import Scene, Sweep

SCENE = Scene()
IDENTITY = identity_map(SCENE.height, SCENE.width)
SWEEPS = {
    "first": Sweep(0.3, speed=8.0, soft=1.0, width=30.0),
    "second": Sweep(1.3, speed=9.0, soft=1.0, width=30.0),
    "third": Sweep(2.5, speed=8.0, soft=1.0, width=30.0),
}


def shoot(folder: Path, sweep: Sweep, swing: float = 0.0, uneven: float = 0.0) -> Path:
    """The noisy frames of a sweep, under light that swings by a part of itself, by a hand whose
    pace does."""
    header = Header(SCENE.width, SCENE.height)
    folder.mkdir(parents=True)
    count = SCENE.frames_of(sweep)
    pace = 1 + uneven * np.sin(np.arange(count) / 2.5)
    for frame, moment in enumerate(np.cumsum(pace) - pace[0]):
        image = SCENE.noisy(SCENE.image(SCENE.sweep_beta(sweep, moment)), frame)
        image *= np.float32(1 + swing * np.sin(frame / 3))
        write_exr(folder / f"take.{1001 + frame}.exr", {"RGB": to_half(image)}, header)
    return folder


@pytest.fixture(scope="module")
def mask(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("mask") / "plane.png"
    write_png(path, SCENE.plane.astype(np.uint8) * np.uint8(255))
    return str(path)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory, mask: str) -> list[Path]:
    work = tmp_path_factory.mktemp("sweeps")
    made = []
    for name, sweep in SWEEPS.items():
        scan(shoot(work / "frames" / name, sweep), work / name, plane=mask)
        made.append(work / name)
    return made


def test_lines_lie_within_a_fraction_of_a_pixel(scans: list[Path]) -> None:
    for folder, sweep in zip(scans, SWEEPS.values(), strict=True):
        lines = read_scan(folder)[0].lines
        assert np.median(lines.residual) < 0.1
        normal, offset = SCENE.edge(sweep, lines.frame[len(lines) // 2] - 1001)
        found = lines.normal[len(lines) // 2], lines.offset[len(lines) // 2]
        side = np.sign(found[0] @ normal)
        assert side * found[0] == pytest.approx(normal, abs=0.003)
        assert side * found[1] == pytest.approx(offset, abs=0.3)


@pytest.mark.parametrize("count", [2, 3])
def test_w_is_found_to_a_fraction_of_a_pixel(scans: list[Path], tmp_path: Path, count: int) -> None:
    (result,) = warp(scans[:count], tmp_path)
    found, _, _ = read_warp(tmp_path / WARP)
    known = np.isfinite(found.error)
    error = np.linalg.norm(found.warp - SCENE.warp, axis=-1)
    assert known.mean() > 0.85
    assert np.median(error[known & SCENE.plane]) < 0.1
    assert np.median(error[known & ~SCENE.plane]) < 0.3
    assert np.percentile(error[known], 90) < 0.6
    sure = known & (found.error < 1)
    assert (error[sure] < 1).mean() > 0.9
    # The block's displacement is the same everywhere: its light is infinitely far away.
    assert np.abs(result.figures["light"]["at"]).max() > 1000


def test_a_sweep_that_does_not_agree_with_the_others_is_left_out_and_named(
    scans: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bad, header, _ = read_scan(scans[0])
    # On the block alone by up to two frames early or late.
    bad.times.time[~SCENE.plane] += 2 * np.sin(IDENTITY[..., 1] / 3)[~SCENE.plane]
    (tmp_path / "bad").mkdir()
    write_scan(tmp_path / "bad", bad, header, {})
    (result,) = warp([tmp_path / "bad", *scans[1:]], tmp_path / "map")
    assert f"{tmp_path / 'bad'}: does not agree with the other sweeps" in caplog.text
    assert result.figures["left_out"] == "bad"
    found, _, _ = read_warp(tmp_path / "map" / WARP)
    error = np.linalg.norm(found.warp - SCENE.warp, axis=-1)
    assert np.median(error[np.isfinite(found.error) & ~SCENE.plane]) < 0.4


def test_displacements_towards_no_one_place_are_told_of(
    scans: list[Path],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    warp(scans, tmp_path / "one")
    assert "not towards one place" not in caplog.text
    monkeypatch.setattr("shadowtool.steps.solve.find_epipole", lambda *args: None)
    (result,) = warp(scans, tmp_path / "none")
    assert "not towards one place" in caplog.text
    assert result.figures["light"] is None
    # Much of the plane passed by something else.
    bad, header, _ = read_scan(scans[1])
    bad.times.time[:30] += 3
    (tmp_path / "bad").mkdir()
    write_scan(tmp_path / "bad", bad, header, {})
    with pytest.raises(ReshootError, match=r"off the edge's lines in .*bad; sweep a straight"):
        warp([scans[0], tmp_path / "bad"], tmp_path / "refused")
    assert not (tmp_path / "refused").exists()


@pytest.mark.parametrize(("last", "told"), [(100, False), (90, False), (66, True)])
def test_what_stands_where_no_two_sweeps_agree_is_told_of(
    scans: list[Path], tmp_path: Path, caplog: pytest.LogCaptureFixture, last: int, told: bool
) -> None:
    folders = [scans[0]]
    for folder in scans[1:]:
        found, header, _ = read_scan(folder)
        missed = ~SCENE.plane
        missed[:, :last] = False
        found.times.time[missed] = found.times.own_time[missed] = np.nan
        folders.append(tmp_path / folder.name)
        folders[-1].mkdir()
        write_scan(folders[-1], found, header, {})
    (result,) = warp(folders, tmp_path / "map")
    unconfirmed = f"marked plane {100 * result.figures['unconfirmed']:.0f}% is filled in"
    assert (unconfirmed in caplog.text) == told == (result.figures["unconfirmed"] > 0.5)


def test_a_hand_may_be_now_fast_and_now_slow(tmp_path: Path, mask: str) -> None:
    folders = [
        scan(shoot(tmp_path / "frames" / name, sweep, uneven=0.75), tmp_path / name, plane=mask)
        for name, sweep in SWEEPS.items()
    ]
    warp([result.output for result in folders], tmp_path / "map")
    found, _, _ = read_warp(tmp_path / "map" / WARP)
    known = np.isfinite(found.error)
    error = np.linalg.norm(found.warp - SCENE.warp, axis=-1)
    assert np.median(error[known & SCENE.plane]) < 0.3
    assert np.percentile(error[known & SCENE.plane], 90) < 0.8
    sure = known & (found.error < 1)
    assert (error[sure] < 1).mean() > 0.9


def test_light_that_changes_moves_no_time(scans: list[Path], tmp_path: Path, mask: str) -> None:
    frames = shoot(tmp_path / "frames", SWEEPS["first"], swing=0.1)
    result = scan(frames, tmp_path / "corrected", plane=mask)
    assert result.figures["gain"]["least"] < 0.92 < 1.08 < result.figures["gain"]["most"]
    scan(frames, tmp_path / "as-is", plane=mask, gain="none")
    steady = read_scan(scans[0])[0].times.time
    off = {}
    for name in ("corrected", "as-is"):
        change = np.abs(read_scan(tmp_path / name)[0].times.time - steady)
        off[name] = np.nanpercentile(change, 90)
    assert off["corrected"] < 0.05
    assert off["corrected"] < off["as-is"] / 3


@pytest.mark.parametrize(("speed", "soft"), [(0.5, 2.0), (0.8, 30.0)])
def test_a_slow_sweep_of_a_soft_edge_is_followed(
    tmp_path: Path, mask: str, speed: float, soft: float
) -> None:
    sweep = Sweep(0.3, speed=speed, soft=soft, width=30.0)
    scan(shoot(tmp_path / "frames", sweep), tmp_path / "scan", plane=mask)
    found = read_scan(tmp_path / "scan")[0]
    assert np.isfinite(found.times.time).mean() > 0.95
    normal, offset = SCENE.edge(sweep, 0)
    true = (SCENE.warp @ normal + offset) / speed + 1001
    late = (found.times.time - true)[SCENE.plane]
    # Noise makes all pixels cross a little early, and the lines with them.
    early = np.nanmedian(late)
    assert -0.3 < early * speed < 0.1
    assert np.nanpercentile(np.abs(late - early), 90) * speed < 0.15


def test_what_a_shadow_passed_unseen_is_unknown(
    tmp_path: Path, mask: str, caplog: pytest.LogCaptureFixture
) -> None:
    frames = shoot(tmp_path / "frames", SWEEPS["first"])
    scan(frames, tmp_path / "whole", plane=mask)
    for number in range(1010, 1015):
        (frames / f"take.{number}.exr").unlink()
    scan(frames, tmp_path / "holed", plane=mask, run=Run(missing="skip"))
    assert "no frames between 1009 and 1015" in caplog.text
    whole, holed = (read_scan(tmp_path / name)[0].times for name in ("whole", "holed"))
    missed = (whole.time > 1009.5) & (whole.time < 1014.5)
    assert np.isnan(holed.time[missed]).mean() > 0.99
    seen = ((whole.time < 1008) | (whole.time > 1016)) & np.isfinite(holed.time)
    assert np.median(np.abs(holed.time - whole.time)[seen]) < 0.01


def test_a_source_that_stands_like_the_target_needs_no_map(
    scans: list[Path], tmp_path: Path
) -> None:
    warp(scans, tmp_path, source_scans=scans)
    found, _, _ = read_warp(tmp_path / WARP)
    known = np.isfinite(found.error)
    assert 0.7 < known.mean() < 1
    error = np.linalg.norm(found.warp - IDENTITY, axis=-1)
    assert np.median(error[known]) < 0.1
    assert np.percentile(error[known], 90) < 1
    assert np.isfinite(found.warp).all()


def test_threads_and_bands_change_no_bit(
    scans: list[Path], mask: str, tmp_path: Path, tree, narrow_bands
) -> None:
    warp(scans, tmp_path / "map", run=Run(jobs=3))
    narrow_bands()
    warp(scans, tmp_path / "again", run=Run(jobs=1))
    assert tree(tmp_path / "again") == tree(tmp_path / "map")
    scan(scans[0].parent / "frames" / "first", tmp_path / "scan", plane=mask, run=Run(jobs=1))
    # Lines rest on sums, over points in the order of the bands.
    narrow, whole = (tree(folder)["scan.exr"] for folder in (tmp_path / "scan", scans[0]))
    assert narrow == whole


def test_a_single_source_scan_is_refused(scans: list[Path], tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="source-scan twice"):
        warp(scans, tmp_path, source_scans=scans[:1])
    assert not any(tmp_path.iterdir())


def test_parallel_source_scans_are_to_be_shot_again(scans: list[Path], tmp_path: Path) -> None:
    again = shutil.copytree(scans[0], tmp_path / "again")
    with pytest.raises(ReshootError, match="degrees apart"):
        warp(scans, tmp_path / "out", source_scans=[scans[0], again])
    assert not (tmp_path / "out").exists()


def test_a_source_that_shows_none_of_the_targets_ground_is_to_be_shot_again(
    scans: list[Path], tmp_path: Path
) -> None:
    halves = {"left": slice(0, 70), "right": slice(90, None)}
    sets: dict[str, list[Path]] = {}
    for name, kept in halves.items():
        for folder in scans:
            seen, header, _ = read_scan(folder)
            hidden = np.ones(seen.times.time.shape, bool)
            hidden[:, kept] = False
            for times in (seen.times.time, seen.times.own_time):
                times[hidden] = np.nan
            for errors in (seen.times.error, seen.times.own_error):
                errors[hidden] = np.inf
            part = tmp_path / name / folder.name
            part.mkdir(parents=True)
            write_scan(part, seen, header, {})
            sets.setdefault(name, []).append(part)
    with pytest.raises(ReshootError, match="source's sweeps"):
        warp(sets["left"], tmp_path / "warp", source_scans=sets["right"])
    assert not (tmp_path / "warp").exists()


def test_sweeps_that_hardly_meet_are_to_be_shot_again(tmp_path: Path, mask: str) -> None:
    made = []
    for name, region in (("left", slice(0, 80)), ("right", slice(78, None))):
        sweep = SWEEPS["first" if name == "left" else "second"]
        folder = tmp_path / "frames" / name
        folder.mkdir(parents=True)
        for frame in range(SCENE.frames_of(sweep)):
            beta = np.ones((SCENE.height, SCENE.width), np.float32)
            beta[:, region] = SCENE.sweep_beta(sweep, frame)[:, region]
            image = to_half(SCENE.noisy(SCENE.image(beta), frame))
            header = Header(SCENE.width, SCENE.height)
            write_exr(folder / f"take.{1001 + frame}.exr", {"RGB": image}, header)
        scan(folder, tmp_path / name, plane=mask)
        made.append(tmp_path / name)
    with pytest.raises(ReshootError, match="reshoot: two sweeps reached only"):
        warp(made, tmp_path / "warp")
    assert not (tmp_path / "warp").exists()


def test_a_lens_that_bows_the_lines_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sweep = SWEEPS["second"]
    seen = IDENTITY - np.float32([SCENE.width / 2, SCENE.height / 2])
    # Pincushion distortion, 5% at half the width.
    radius = ((seen / (SCENE.width / 2)) ** 2).sum(axis=-1, keepdims=True)
    normal, offset = SCENE.edge(sweep, 0)
    place = seen * (1 - 0.05 * radius) + np.float32([SCENE.width / 2, SCENE.height / 2])
    distance = place @ normal + offset
    folder = tmp_path / "frames"
    folder.mkdir()
    for frame in range(SCENE.frames_of(sweep)):
        beta = np.clip(distance - sweep.speed * frame + 0.5, 0, 1)
        image = to_half(SCENE.noisy(SCENE.image(beta), frame))
        path = folder / f"take.{1001 + frame}.exr"
        write_exr(path, {"RGB": image}, Header(SCENE.width, SCENE.height))
    everything = f"0,0 {SCENE.width},0 {SCENE.width},{SCENE.height} 0,{SCENE.height}"
    result = scan(folder, tmp_path / "scan", plane=everything)
    assert result.figures["bend"]["pixels"] == pytest.approx(-0.05 * SCENE.height / 2, rel=0.3)
    assert "as a lens bends them" in caplog.text


def test_an_edge_that_is_not_straight_is_told_of(
    tmp_path: Path, mask: str, caplog: pytest.LogCaptureFixture
) -> None:
    frames = shoot(tmp_path / "frames", SWEEPS["first"])
    straight = scan(frames, tmp_path / "straight", plane=mask)
    assert "off the edge's lines" not in caplog.text
    for frame, path in enumerate(sorted(frames.iterdir())):
        image = SCENE.image(SCENE.sweep_beta(SWEEPS["first"], frame))
        # As if the board stood out at one end.
        image[:14] = SCENE.image(SCENE.sweep_beta(SWEEPS["first"], frame + 1.5))[:14]
        write_exr(path, {"RGB": to_half(SCENE.noisy(image, frame))}, Header(160, 90))
    bent = scan(frames, tmp_path / "bent", plane=mask)
    assert "off the edge's lines" in caplog.text
    assert straight.figures["off_lines"] < 0.02 < 0.1 < bent.figures["off_lines"]


def test_a_camera_that_trembles_is_told_by_times_that_differ_by_more_than_noise(
    tmp_path: Path, mask: str, caplog: pytest.LogCaptureFixture
) -> None:
    sweep = SWEEPS["second"]
    rng = np.random.default_rng(0)
    raised = []
    for tremble in (0.0, 0.5):
        folder = tmp_path / f"{tremble}"
        folder.mkdir()
        for frame in range(SCENE.frames_of(sweep)):
            image = SCENE.image(SCENE.sweep_beta(sweep, frame))
            move = np.eye(2, 3, dtype=np.float32)
            move[:, 2] = rng.normal(0, tremble, 2)
            size = (SCENE.width, SCENE.height)
            image = cv2.warpAffine(image, move, size, borderMode=cv2.BORDER_REPLICATE)
            path = folder / f"take.{1001 + frame}.exr"
            write_exr(path, {"RGB": to_half(SCENE.noisy(image, frame))}, Header(*size))
        out = tmp_path / "scan" / folder.name
        raised.append(scan(folder, out, plane=mask, steady="none").figures)
        assert ("the camera trembles" in caplog.text) == (tremble > 0)
    assert raised[0]["trembling"] < 0.02 < 0.2 < raised[1]["trembling"]
    steady, trembling = (figures["errors_raised"] for figures in raised)
    assert steady < 1.1
    assert trembling > 1.3 * steady
    moved = scan(folder, tmp_path / "moved", plane=mask).figures
    assert moved["trembling"] == raised[1]["trembling"]
    assert moved["errors_raised"] < trembling
    assert moved["off_lines"] < raised[1]["off_lines"]
    assert "frames are moved to one place" in caplog.text


def test_a_plane_marked_too_small_is_told_of(
    tmp_path: Path, mask: str, caplog: pytest.LogCaptureFixture
) -> None:
    frames = shoot(tmp_path / "frames", SWEEPS["first"])
    whole = scan(frames, tmp_path / "whole", plane=mask).figures
    assert "mark a larger plane" not in caplog.text
    part = scan(frames, tmp_path / "part", plane="0,0 60,0 60,89 0,89").figures
    assert "mark a larger plane" in caplog.text
    assert whole["beyond_lines"] < 0.1 < 0.5 < part["beyond_lines"]


def test_a_take_that_is_no_sweep_is_to_be_shot_again(tmp_path: Path, mask: str) -> None:
    folder = tmp_path / "walk"
    folder.mkdir()
    figure = np.random.default_rng(0).uniform(0, 0.6, (50, 14, 3))
    for frame in range(50):
        left, top = 2 * frame, 25 + round(6 * np.sin(frame / 2))
        image = SCENE.image(SCENE.disk(left + 30, 60 + 8 * np.sin(frame / 3), 16.0))
        image[top : top + 50, left : left + 14] = figure
        path = folder / f"walk.{1001 + frame}.exr"
        write_exr(path, {"RGB": to_half(SCENE.noisy(image, frame))})
    with pytest.raises(ReshootError, match=r"reshoot: of what moves .* only \d+% lies on straight"):
        scan(folder, tmp_path / "scan", plane=mask)
    assert not (tmp_path / "scan").exists()
