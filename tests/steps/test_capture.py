"""What a take tells of itself when it is captured."""

import json
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from shadowtool.errors import InputError, OptionError
from shadowtool.io.image import write_png
from shadowtool.steps.capture import Crop, capture
from shadowtool.steps.run import Run
from tests.conftest import write_frames


def drifting(moment: int) -> np.ndarray:
    """A texture that moves by a pixel a frame, (32, 64, 3) half."""
    picture = 0.2 + 0.5 * np.random.default_rng(5).random((32, 64, 3))
    return np.roll(picture, moment, axis=1).astype(np.float16)


def write_movie(path: Path, moments: list[int]) -> Path:
    """A movie at 25 frames a second of which these frames are there."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 32, "bgr0"
        for moment in moments:
            codes = (255 * drifting(moment)).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(codes, format="rgb24").reformat(format="bgr0")
            frame.pts, frame.time_base = moment, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_a_frame_that_repeats_the_one_before_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    take = write_frames(tmp_path / "take", map(drifting, (0, 1, 2, 2, 3, 4)))
    assert capture(take, tmp_path / "out").figures["doubled"] == ["1004"]
    assert "doubled frames at 1004" in caplog.text


def test_a_frame_that_comes_late_by_the_clock_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = write_movie(tmp_path / "whole.mkv", [0, 1, 2, 3, 4, 5])
    assert capture(whole, tmp_path / "steady").figures["dropped"] == []
    late = write_movie(tmp_path / "late.mkv", [0, 1, 2, 4, 5, 6])
    assert capture(late, tmp_path / "out").figures["dropped"] == ["1004"]
    assert "whole.mkv: dropped" not in caplog.text
    assert "late.mkv: dropped frames at 1004" in caplog.text


def test_clipped_code_values_are_told_of_and_what_they_are_taken_for(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    codes = (200 * drifting(0).astype(np.float32)).astype(np.uint8)
    codes[:8, :16] = 255
    (tmp_path / "take").mkdir()
    for number in (1001, 1002):
        write_png(tmp_path / "take" / f"take.{number}.png", codes)
    result = capture(tmp_path / "take", tmp_path / "out")
    assert result.figures["clipped"] == pytest.approx(8 * 16 / (32 * 64))
    assert "6.2% of the pixels are clipped" in caplog.text
    assert "PNG frames are taken as srgb" in caplog.text
    below = capture(tmp_path / "take", tmp_path / "below", crop=Crop(64, 24, 0, 8))
    assert below.figures["clipped"] == 0


def test_floats_above_one_are_not_clipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    take = write_frames(tmp_path / "take", [4 * drifting(0), 4 * drifting(0)])
    assert capture(take, tmp_path / "out").figures["clipped"] == 0
    assert "clipped" not in caplog.text


def test_a_take_is_not_captured_into_its_own_folder(tmp_path: Path) -> None:
    take = write_frames(tmp_path / "take", [drifting(0)])
    with pytest.raises(OptionError, match="folder of the frames to capture"):
        capture(take, take)


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        ("990-1003", "has no frames 990-1000; its first is 1001"),
        ("1002,1009", "has no frames 1009; its last is 1006"),
    ],
)
def test_frames_that_a_movie_does_not_have_are_named(
    tmp_path: Path, frames: str, said: str
) -> None:
    movie = write_movie(tmp_path / "a.mkv", [0, 1, 2, 3, 4, 5])
    with pytest.raises(InputError, match=said):
        capture(movie, tmp_path / "out", run=Run(frames=frames))
    run = Run(frames=frames, missing="skip", overwrite=True)
    assert capture(movie, tmp_path / "out", run=run).skipped


def test_the_record_of_measurements_says_how_it_was_made(tmp_path: Path) -> None:
    take = write_frames(tmp_path / "take", [drifting(0), drifting(0)])
    capture(take, tmp_path / "out")
    record = json.loads((tmp_path / "out" / "capture.json").read_text())
    manifest = json.loads((tmp_path / "out" / "shadowtool.json").read_text())
    for key in ("version", "command", "fingerprint"):
        assert record[key] == manifest[key]
