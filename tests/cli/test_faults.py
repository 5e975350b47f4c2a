"""Wrong input: the right exit code, one line that names the file or option, nothing on disk."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from shadowtool.io.image import Header, read_image, write_exr, write_png

PROGRAM = [sys.executable, "-c", "from shadowtool.cli import main; main()"]
COMMANDS = ("capture", "plate", "matte", "scan", "warp", "apply", "composite")
# The footage that each command reads, as a folder of the shot and its place among the words.
FOOTAGE = {
    "capture": ("source", 1),
    "plate": ("photometric", 1),
    "matte": ("source", 1),
    "scan": ("sweep1", 1),
    "apply": ("matte/beta", 4),
}
WIDTH, HEIGHT = 48, 32


@pytest.fixture
def refused(shot, command, tmp_path, tree) -> Callable[..., str]:
    """Run a command that must fail by our own word; returns what it said."""

    def call(words: list[Any], *options: Any, code: int = 1, output: Path | None = None) -> str:
        output = output or tmp_path / "out"
        before = tree(output)
        existed = output.exists()
        outcome = command(*words, "-o", output, *options)
        assert outcome.code == code, outcome.err
        # OpenEXR's own warnings are silenced for a whole process only.
        assert re.sub(r"^Warning: .*\n", "", outcome.out, flags=re.MULTILINE) == ""
        assert outcome.err.startswith("shadowtool: error: ")
        assert outcome.err.count("\n") == 1
        assert "Traceback" not in outcome.err
        assert "fault of shadowtool's own" not in outcome.err
        assert tree(output) == before
        assert output.exists() == existed, "an output folder was left behind"
        return outcome.err

    return call


@pytest.fixture
def misused(command, tmp_path) -> Callable[..., str]:
    """Run a command whose words make no sense; returns what it said."""

    def call(words: list[Any], *options: Any) -> str:
        outcome = command(*words, "-o", tmp_path / "out", *options)
        assert outcome.code == 2
        assert outcome.out == ""
        assert "Traceback" not in outcome.err
        assert not (tmp_path / "out").exists()
        return outcome.err

    return call


def replaced(words: list[str], position: int, value: object) -> list[str]:
    return [*words[:position], str(value), *words[position + 1 :]]


def frame(folder: Path, number: int = 1003) -> Path:
    return next(folder.rglob(f"*.{number}.exr"))


def picture(width: int = WIDTH, height: int = HEIGHT, dtype: type = np.float16) -> np.ndarray:
    return np.full((height, width, 3), 0.5, dtype)


@pytest.mark.parametrize("name", FOOTAGE)
@pytest.mark.parametrize("source", ["nowhere", "nowhere/a.####.exr", "n" * 5000, "#" * 300])
def test_no_such_footage(name, source, shot, refused, tmp_path):
    position = FOOTAGE[name][1]
    said = refused(replaced(shot.arguments(name), position, tmp_path / source))
    assert source[:20] in said


@pytest.mark.parametrize("name", FOOTAGE)
def test_an_empty_folder(name, shot, refused, tmp_path):
    (tmp_path / "empty").mkdir()
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], tmp_path / "empty"))
    assert "empty" in said


@pytest.mark.parametrize("name", ["capture", "plate", "matte", "scan"])
def test_frames_of_mixed_sizes(name, shot, copied, refused):
    copy = copied(FOOTAGE[name][0])
    write_exr(frame(copy), {"RGB": picture(40, 30)}, Header(40, 30))
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], copy))
    assert "1003.exr: is 40x30" in said
    assert "48x32" in said


@pytest.mark.parametrize("name", FOOTAGE)
def test_a_gap_in_the_frames(name, shot, copied, refused):
    copy = copied(FOOTAGE[name][0])
    frame(copy).unlink()
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], copy))
    assert "missing frames 1003" in said
    assert "--missing skip" in said


@pytest.mark.parametrize("name", FOOTAGE)
def test_two_sequences_in_a_folder(name, shot, copied, refused):
    copy = copied(FOOTAGE[name][0])
    for number in (1001, 1002):
        write_exr(copy / f"other.{number}.exr", {"RGB": picture()}, Header(WIDTH, HEIGHT))
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], copy))
    assert "other.####.exr" in said
    assert f"{copy.name}.####.exr" in said


@pytest.mark.parametrize("name", FOOTAGE)
@pytest.mark.parametrize("content", [b"this is text\n", b""])
def test_a_text_or_an_empty_file_named_exr(name, content, shot, copied, refused):
    copy = copied(FOOTAGE[name][0])
    frame(copy).write_bytes(content)
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], copy))
    assert frame(copy).name in said


@pytest.mark.parametrize("name", ["plate", "scan"])
def test_a_truncated_exr_in_the_middle(name, shot, copied, refused):
    copy = copied(FOOTAGE[name][0])
    frame(copy).write_bytes(frame(copy).read_bytes()[:-60])
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], copy))
    assert f"{frame(copy).name}: damaged or cut off" in said


@pytest.mark.parametrize("name", ["capture", "matte", "apply"])
def test_a_truncated_exr_stops_after_whole_frames(name, shot, copied, command, tmp_path):
    copy = copied(FOOTAGE[name][0])
    frame(copy).write_bytes(frame(copy).read_bytes()[:-60])
    words = replaced(shot.arguments(name), FOOTAGE[name][1], copy)
    outcome = command(*words, "-o", tmp_path / "out", "-j1")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert f"{frame(copy).name}: damaged or cut off" in outcome.err
    left = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert {path.suffix for path in left} <= {".exr", ".png"}
    for path in left:
        assert read_image(path).header.size == (WIDTH, HEIGHT)


@pytest.mark.parametrize("name", ["capture", "plate", "matte", "scan"])
def test_frames_of_half_and_float_mixed(name, shot, copied, command, tmp_path):
    copy = copied(FOOTAGE[name][0])
    values = read_image(frame(copy)).layers["RGB"].astype(np.float32)
    write_exr(frame(copy), {"RGB": values}, Header(WIDTH, HEIGHT))
    words = replaced(shot.arguments(name), FOOTAGE[name][1], copy)
    outcome = command(*words, "-o", tmp_path / "out", "--progress", "none")
    assert outcome.code == 0, outcome.err


@pytest.mark.parametrize("name", ["plate", "scan", "matte"])
def test_a_frame_without_colour(name, shot, copied, refused):
    copy = copied(FOOTAGE[name][0])
    for path in copy.glob("*.exr"):
        values = picture()[..., 0]
        write_exr(path, {"depth": values, "id": values}, Header(WIDTH, HEIGHT))
    said = refused(replaced(shot.arguments(name), FOOTAGE[name][1], copy))
    assert "has no R, G, B, only depth, id" in said


@pytest.mark.parametrize("name", FOOTAGE)
@pytest.mark.parametrize("text", ["1001-", "abc", "1e3", "", "1-9x0"])
def test_a_range_that_cannot_be_read(name, text, shot, refused):
    said = refused(shot.arguments(name), "--frames", text, code=2)
    assert "--frames" in said


@pytest.mark.parametrize("name", FOOTAGE)
def test_frames_that_are_not_there(name, shot, refused):
    assert "missing frames 7-9" in refused(shot.arguments(name), "--frames", "7-9")


@pytest.mark.parametrize("name", ["matte", "composite"])
@pytest.mark.parametrize("folder", ["nowhere", "n" * 5000])
def test_no_plates(name, folder, shot, refused, tmp_path):
    words = replaced(shot.arguments(name), 3, tmp_path / folder)
    assert folder[:20] in refused(words)


@pytest.mark.parametrize("name", ["matte", "composite"])
def test_a_folder_without_plates(name, shot, refused):
    said = refused(replaced(shot.arguments(name), 3, shot.source))
    assert "has no lit.exr; make the plates with `shadowtool plate`" in said


@pytest.mark.parametrize("name", ["matte", "composite"])
def test_plates_of_another_size(name, shot, copied, refused):
    copy = copied("plates")
    for path in copy.glob("*.exr"):
        path.unlink()
    for plate in ("lit", "shadow"):
        write_exr(copy / f"{plate}.exr", {"RGB": picture(20, 10)}, Header(20, 10))
    said = refused(replaced(shot.arguments(name), 3, copy))
    assert "20x10" in said
    assert "48x32" in said


@pytest.mark.parametrize("name", ["matte", "composite"])
def test_a_truncated_plate(name, shot, copied, refused):
    copy = copied("plates")
    (copy / "shadow.exr").write_bytes((copy / "shadow.exr").read_bytes()[:-60])
    said = refused(replaced(shot.arguments(name), 3, copy))
    assert "shadow.exr: damaged or cut off" in said


@pytest.mark.parametrize(
    ("name", "option", "fault"),
    [
        (name, option, fault)
        for name, option in (("plate", "--holdout"), ("matte", "--alpha"), ("matte", "--trimap"))
        for fault in ("nowhere", "size", "gap", "text")
        # Trimaps may be drawn for some of the frames only.
        if (option, fault) != ("--trimap", "gap")
    ],
)
def test_mattes_that_do_not_fit(name, option, fault, shot, copied, refused, tmp_path):
    mattes = tmp_path / "mattes"
    if fault != "nowhere":
        mattes.mkdir()
        size = (10, 20) if fault == "size" else (HEIGHT, WIDTH)
        for number in range(1001, 1013):
            write_png(mattes / f"m.{number}.png", np.zeros(size, np.uint8))
        if fault == "gap":
            (mattes / "m.1003.png").unlink()
        if fault == "text":
            (mattes / "m.1003.png").write_bytes(b"text\n")
    said = refused(shot.arguments(name), option, mattes)
    assert {"nowhere": "mattes", "size": "20x10", "gap": "1003", "text": "m.1003.png"}[
        fault
    ] in said


def test_trimaps_for_none_of_the_frames(shot, refused, tmp_path):
    (tmp_path / "trimaps").mkdir()
    write_png(tmp_path / "trimaps" / "t.0007.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    said = refused(shot.arguments("matte"), "--trimap", tmp_path / "trimaps")
    assert "none of the frames" in said and "number the trimaps" in said


def test_a_plane_mask_of_another_size(shot, refused, tmp_path):
    write_png(tmp_path / "mask.png", np.full((10, 20), 255, np.uint8))
    said = refused(["scan", shot.sweep1, "--plane", tmp_path / "mask.png"])
    assert "mask.png: is 20x10" in said


@pytest.mark.parametrize("content", [None, b"text", b"\x89PNG\r\n\x1a\n"])
def test_a_plane_mask_that_cannot_be_read(content, shot, refused, tmp_path):
    if content is not None:
        (tmp_path / "mask.png").write_bytes(content)
    assert "mask.png" in refused(["scan", shot.sweep1, "--plane", tmp_path / "mask.png"])


@pytest.mark.parametrize("plane", ["0,0 10,10", "0,0", "-9,-9 -5,-5 -9,-5", "99,99 120,99 99,120"])
def test_a_polygon_that_makes_no_sense(plane, shot, refused):
    assert f"--plane {plane}" in refused(["scan", shot.sweep1, f"--plane={plane}"], code=2)


@pytest.mark.parametrize(
    ("plane", "code"),
    [("0,0 10,10 abc", 1), ("1 2 3", 2), ("", 2), ("0;0 5;5 0;5", 1), ("nan,0 1,1 2,0", 1)],
)
def test_a_plane_that_is_neither_polygon_nor_mask(plane, code, shot, refused):
    said = refused(["scan", shot.sweep1, "--plane", plane], code=code)
    assert plane in said


def test_an_empty_plane_mask(shot, refused, tmp_path):
    write_png(tmp_path / "mask.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    said = refused(["scan", shot.sweep1, "--plane", tmp_path / "mask.png"], code=2)
    assert "mask.png" in said


def test_a_plane_too_small_for_any_line(shot, refused):
    said = refused(["scan", shot.sweep1, "--plane", "0,0 3,0 3,3"])
    assert "reshoot" in said
    assert "sweep1" in said


def test_a_sweep_that_shows_nothing(shot, refused, tmp_path):
    for number in range(5):
        rng = np.random.default_rng(number)
        still = (0.5 + rng.normal(0, 0.002, (HEIGHT, WIDTH, 3))).astype(np.float16)
        path = tmp_path / "still" / f"still.{number}.exr"
        path.parent.mkdir(exist_ok=True)
        write_exr(path, {"RGB": still}, Header(WIDTH, HEIGHT))
    said = refused(["scan", tmp_path / "still", "--plane", "0,0 47,0 47,31 0,31"])
    assert "reshoot" in said


@pytest.mark.parametrize("frames", ["1001", "1001-1002"])
def test_a_sweep_of_one_or_two_frames(frames, shot, refused):
    assert "make no sweep" in refused(shot.arguments("scan"), "--frames", frames)


def test_a_map_of_one_scan_only(shot, command, tmp_path):
    outcome = command("warp", shot.scan1, "-o", tmp_path / "out")
    assert outcome.code == 2
    assert "two scans or more" in outcome.err
    assert not (tmp_path / "out").exists()


def test_a_map_of_the_same_sweep_twice(shot, copied, refused):
    said = refused(["warp", shot.scan1, copied("scan1")])
    assert "only 0.0 degrees apart" in said


@pytest.mark.parametrize("bad", ["nowhere", "n" * 5000])
def test_a_scan_that_is_not_there(bad, shot, refused, tmp_path):
    assert bad[:20] in refused(["warp", shot.scan1, tmp_path / bad])


def test_scans_of_two_sizes(shot, copied, refused):
    copy = copied("scan2")
    layers = {"time": picture(20, 10)[..., 0], "contrast": picture(20, 10)[..., 0]}
    write_exr(copy / "scan.exr", layers, Header(20, 10))
    record = json.loads((copy / "lines.json").read_bytes())
    (copy / "lines.json").write_text(json.dumps({**record, "width": 20, "height": 10}))
    assert "20x10" in refused(["warp", shot.scan1, copy])


@pytest.mark.parametrize("content", [b"{}", b"", b"[1]"])
def test_a_scan_without_lines(content, shot, copied, refused):
    copy = copied("scan2")
    (copy / "lines.json").write_bytes(content)
    assert "lines.json: holds no shadow lines" in refused(["warp", shot.scan1, copy])


def test_a_solved_map_that_cannot_be_applied_is_not_solved_at_all(shot, refused, tmp_path):
    words = [*shot.arguments("warp"), "--apply", tmp_path / "nowhere"]
    assert "nowhere" in refused(words)


@pytest.mark.parametrize("content", [None, b"text", b""])
@pytest.mark.parametrize("name", ["apply", "composite"])
def test_a_map_that_cannot_be_read(content, name, shot, refused, tmp_path):
    if content is not None:
        (tmp_path / "map.exr").write_bytes(content)
    words = shot.arguments(name)
    said = refused(replaced(words, words.index(str(shot.warp / "warp.exr")), tmp_path / "map.exr"))
    assert "map.exr" in said


def test_a_map_of_another_size_than_the_plates(shot, refused, tmp_path):
    write_exr(tmp_path / "map.exr", {"RGB": picture(20, 10, np.float32)}, Header(20, 10))
    words = shot.arguments("composite")
    said = refused(replaced(words, words.index(str(shot.warp / "warp.exr")), tmp_path / "map.exr"))
    assert "map.exr: is 20x10" in said


@pytest.mark.parametrize("part", ["fg", "beta"])
def test_a_matte_without_its_parts(part, shot, copied, refused):
    copy = copied("matte")
    for path in (copy / part).iterdir():
        path.unlink()
    (copy / part).rmdir()
    said = refused(replaced(shot.arguments("composite"), 1, copy))
    assert f"has no {part}/; make it with `shadowtool matte`" in said


def test_no_matte_at_all(shot, refused, tmp_path):
    said = refused(replaced(shot.arguments("composite"), 1, tmp_path / "nowhere"))
    assert "nowhere" in said
    assert "--fg" in refused(["composite", "--plates", shot.plates], code=2)


@pytest.mark.parametrize("part", ["fg", "beta"])
def test_a_gap_in_a_matte(part, shot, copied, refused):
    copy = copied("matte")
    (copy / part / f"{part}.1003.exr").unlink()
    said = refused(replaced(shot.arguments("composite"), 1, copy))
    assert "1003" in said
    assert f"{part}.####.exr" in said


def test_a_figure_without_alpha(shot, refused):
    said = refused([*shot.arguments("composite"), "--fg", shot.source])
    assert "source.1001.exr: has no alpha channel" in said


@pytest.mark.parametrize("name", COMMANDS)
def test_an_output_that_exists(name, shot, command, refused, tmp_path):
    output = tmp_path / "out"
    assert command(*shot.arguments(name), "-o", output, "-q").code == 0
    said = refused(shot.arguments(name), output=output)
    assert str(output) in said
    assert "--overwrite" in said
    assert "--resume" in said


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("place", ["file", "file/below", "n" * 5000])
def test_an_output_folder_that_cannot_be_made(name, place, shot, command, tmp_path):
    (tmp_path / "file").write_bytes(b"mine")
    outcome = command(*shot.arguments(name), "-o", tmp_path / place)
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert place[:20] in outcome.err
    assert "fault of shadowtool's own" not in outcome.err
    assert (tmp_path / "file").read_bytes() == b"mine"


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_where_a_product_should_be(name, shot, command, tmp_path):
    product = {"plate": "lit.exr", "scan": "scan.exr", "warp": "warp.exr"}.get(name)
    product = product or {"matte": "fg/fg.1003.exr", "apply": "beta/beta.1003.exr"}.get(name)
    folder = tmp_path / "out" / (product or "out.1003.exr")
    folder.mkdir(parents=True)
    outcome = command(*shot.arguments(name), "-o", tmp_path / "out", "--overwrite")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert folder.name in outcome.err
    assert "fault of shadowtool's own" not in outcome.err
    assert not list((tmp_path / "out").rglob("*.tmp"))


@pytest.mark.parametrize("name", COMMANDS)
def test_overwrite_with_resume(name, shot, misused):
    said = misused(shot.arguments(name), "--overwrite", "--resume")
    assert "--overwrite and --resume exclude each other" in said


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize(
    "options",
    [["--nonsense"], ["--jobs", "0"], ["--jobs", "x"], ["--progress", "loud"], ["--missing", "no"]],
)
def test_options_that_are_unknown_or_out_of_range(name, options, shot, misused):
    assert options[0] in misused(shot.arguments(name), *options)


@pytest.mark.parametrize("name", [n for n in COMMANDS if n != "apply"])
def test_no_output_option(name, shot, command):
    outcome = command(*shot.arguments(name))
    assert outcome.code == 2
    assert "-o" in outcome.err


@pytest.mark.parametrize("words", [["nonsense"], [], ["plate"], ["scan", "x", "-o", "y"]])
def test_words_that_make_no_command(words, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = command(*words)
    assert outcome.code == 2
    assert "Usage" in outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words",
    [["warp"], ["warp", "a", "--map", "b"], ["warp", "--map", "b"]],
)
def test_words_that_make_no_map(words, misused):
    assert "--map" in misused(words)


@pytest.mark.parametrize("crop", ["10x10", "0x5+0+0", "axb+1+1", "10x10+0", "-5x5+0+0"])
def test_a_crop_that_cannot_be_read(crop, shot, misused):
    assert "--crop" in misused(["capture", shot.source], f"--crop={crop}")


@pytest.mark.parametrize(
    "options",
    [
        ["--crop", "49x10+0+0"],
        ["--crop", "10x10+40+0"],
        ["--scale", "0"],
        ["--scale", "-1"],
        ["--scale", "nan"],
        ["--scale", "1e9"],
        ["--device", "0"],
        ["--device", "0", "--seconds", "1"],
    ],
)
def test_capture_options_that_do_not_fit(options, shot, refused):
    assert options[0] in refused(shot.arguments("capture"), *options, code=2)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("apply", ["--outside", "nan"]),
        ("apply", ["--outside", "inf"]),
        ("matte", ["--alpha", "matte/fg", "--trimap", "matte/trimap"]),
        ("plate", ["--plane", "0,0 40,0 40,30", "--estimator", "minmax"]),
        ("capture", ["--seconds", "3"]),
    ],
)
def test_options_that_would_do_nothing(name, options, shot, refused):
    words = [str(shot.folder / word) if "/" in word else word for word in options]
    assert options[0] in refused(shot.arguments(name), *words, code=2)


@pytest.mark.parametrize("name", COMMANDS)
def test_an_empty_output_folder_is_none(name, shot, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = command(*shot.arguments(name), "-o", "")
    assert outcome.code == 2
    assert "empty" in outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "option"),
    [
        ("plate", "--holdout"),
        ("plate", "--plane"),
        ("matte", "--plates"),
        ("matte", "--trimap"),
        ("matte", "--alpha"),
        ("scan", "--plane"),
        ("warp", "--source-scan"),
        ("warp", "--apply"),
        ("apply", "--map"),
        ("composite", "--plates"),
        ("composite", "--fg"),
        ("composite", "--beta-frames"),
        ("composite", "--warp"),
    ],
)
def test_an_empty_name_is_not_as_if_nothing_had_been_named(name, option, shot, command, tmp_path):
    outcome = command(*shot.arguments(name), option, "", "-o", tmp_path / "out")
    assert outcome.code in (1, 2), outcome.err
    assert option in outcome.err or "no file or folder is named" in outcome.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["capture", "plate", "scan", "warp", "composite"])
def test_the_record_of_another_step_is_kept(name, shot, refused, copied):
    other = copied("matte")
    said = refused(shot.arguments(name), "--resume", output=other)
    assert "is the record of matte" in said


def test_a_take_in_two_formats_is_none(shot, refused, command, tmp_path):
    words = [*shot.arguments("capture"), "-o", tmp_path / "out"]
    assert command(*words, "--format", "png", "-q").code == 0
    assert "another format" in refused(shot.arguments("capture"), "--overwrite")


def test_a_step_does_not_write_over_what_it_reads(shot, command, copied, tree):
    frames = copied("source")
    before = tree(frames)
    words = ["warp", "--map", shot.warp / "warp.exr", "--apply", frames, "-o", frames.parent]
    for option in ("--resume", "--overwrite"):
        outcome = command(*words, option)
        assert outcome.code == 2
        assert "source.1001.exr: is to be read" in outcome.err
        assert tree(frames) == before


def test_nothing_given_is_written_over(shot, command, copied, tree):
    figure, beta = (copied(f"matte/{part}") for part in ("fg", "beta"))
    # Of the same names, as both come from elsewhere.
    for folder in (figure, beta):
        for file in sorted(folder.iterdir()):
            file.rename(folder / f"x.{file.name.split('.')[1]}.exr")
    plain = [figure.rename(figure.parent / "x"), beta]
    lit = copied("source")
    for number in range(1001, 1007):
        frame(lit, number).rename(lit / f"{'lit' if number == 1001 else f'lit.{number}'}.exr")
    (lit / "scan.png").write_bytes((shot.folder / "mask.png").read_bytes())
    words = ["--fg", plain[0], "--beta-frames", plain[1], "--plates", shot.plates]
    # Of a still, whose frame has no number.
    held = lit.parent / "held"
    held.mkdir()
    nothing = np.zeros((HEIGHT, WIDTH), np.float16)
    write_exr(held / "lit.exr", {"Y": nothing}, Header(WIDTH, HEIGHT))
    still = lit.parent / "still.exr"
    still.write_bytes((lit / "lit.exr").read_bytes())
    for folder, arguments in (
        (plain[0], ["composite", *words]),
        (lit, ["plate", lit / "lit.exr"]),
        (held, ["plate", still, "--holdout", held / "lit.exr"]),
        (lit, ["scan", shot.sweep1, "--plane", lit / "scan.png"]),
    ):
        before = tree(folder)
        outcome = command(*arguments, "-o", folder, "--overwrite", "-q")
        assert outcome.code == 2, outcome.err
        assert "not written over; give another -o" in outcome.err
        assert tree(folder) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_an_output_folder_that_is_a_link_to_itself(name, shot, command, tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    for output in (tmp_path / "loop", tmp_path / "loop" / "x"):
        outcome = command(*shot.arguments(name), "-o", output, "-q")
        assert outcome.code == 1
        assert outcome.err.count("\n") == 1
        assert "fault of shadowtool's own" not in outcome.err


@pytest.mark.parametrize("name", ["capture", "matte", "composite"])
def test_frame_numbers_of_too_many_digits(name, shot, refused, tmp_path):
    assert "not a frame range" in refused(shot.arguments(name), "--frames", "9" * 29, code=2)
    write_exr(tmp_path / f"a.{'9' * 40}.exr", {"RGB": picture()}, Header(WIDTH, HEIGHT))
    refused(["capture", tmp_path])


@pytest.mark.parametrize("name", ["plate", "scan", "warp", "matte", "capture"])
@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e999"])
def test_a_record_with_what_is_no_number_is_none(name, number, shot, command, tmp_path):
    output = tmp_path / "out"
    words = [*shot.arguments(name), "-o", output, "-q"]
    assert command(*words).code == 0
    record = output / "shadowtool.json"
    written = record.read_text()
    damaged = re.sub(r": \d[\d.]*(,?)\n", rf": {number}\1\n", written)
    record.write_text(damaged)
    chunk = ["--overwrite", "--frames", "1001-1002"] if name in ("matte", "capture") else []
    assert command(*words, *(chunk or ["--resume"])).code == 0
    assert json.loads(record.read_text())["step"] == name


def test_a_channel_that_is_called_like_three(shot, command, copied, tmp_path):
    alpha = copied("matte/fg")
    for file in alpha.iterdir():
        values = read_image(file).channel("A").astype(np.float16)
        write_exr(file, {"RGB": values, "x": values}, Header(WIDTH, HEIGHT))
    words = [*shot.arguments("matte"), "--alpha", alpha, "-q"]
    assert command(*words, "-o", tmp_path / "out").code == 0


@pytest.mark.parametrize("outside", ["1e39", "nan", "-70000"])
def test_a_value_outside_that_no_half_can_hold(outside, shot, refused):
    assert "--outside" in refused([*shot.arguments("apply"), "--outside", outside], code=2)


@pytest.mark.parametrize("scale", [2.0, 1.5, 0.5])
def test_a_pixel_that_is_no_number_spreads_to_none_when_resized(
    scale, shot, command, copied, tmp_path
):
    source = copied("source")
    values = read_image(frame(source)).rgb("linear").copy()
    clean = tmp_path / "clean"
    assert command("capture", source, "-o", clean, "--scale", scale, "-q").code == 0
    values[10, 20], values[20, 30] = np.nan, np.inf
    write_exr(frame(source), {"RGB": values}, Header(WIDTH, HEIGHT))
    output = tmp_path / "out"
    assert command("capture", source, "-o", output, "--scale", scale, "-q").code == 0
    made, expected = (read_image(frame(folder)).rgb("linear") for folder in (output, clean))
    bad = ~np.isfinite(made).all(axis=-1)
    assert 2 <= bad.sum() <= 2 * np.ceil(scale) ** 2
    assert np.abs(made - expected)[~bad].max() < 0.5


@pytest.mark.parametrize(
    ("name", "before", "after", "left"),
    [
        ("composite", [], None, "ratio/ratio.1001.exr and 5 more"),
        ("matte", [], ["--alpha", "matte/fg"], "trimap/trimap.1001.png and 5 more"),
        ("source plate", [], ["--holdout", "none"], "holdout/holdout.1001.png and 5 more"),
        ("source plate", [], ["--frames", "1003-1006"], "holdout/holdout.1001.png and 1 more"),
        ("warp", ["--apply", "matte/beta"], [], "beta/beta.1001.exr and 5 more"),
    ],
)
def test_what_a_run_leaves_of_another_is_named(name, before, after, left, shot, command, tmp_path):
    output = tmp_path / "out"
    words = shot.arguments(name.split()[-1])
    if name == "source plate":
        words = replaced(words, 1, shot.source)

    def given(options: list[str]) -> list[str]:
        return [str(shot.folder / word) if "/" in word else word for word in options]

    assert command(*words, *given(before), "-o", output, "-q").code == 0
    # The same again leaves nothing.
    same = command(*words, *given(before), "-o", output, "--overwrite")
    assert same.code == 0
    assert "left from" not in same.err
    if after is None:
        words, after = [word for word in words if word != "--ratio"], []
    outcome = command(*words, *given(after), "-o", output, "--overwrite")
    assert outcome.code == 0
    assert f"{left}: left from an earlier run" in outcome.err


def test_a_map_beside_other_steps_folders_leaves_none_of_them(shot, command, copied):
    root = copied("matte").parent
    copied("scan1")
    outcome = command(*shot.arguments("warp"), "-o", root)
    assert outcome.code == 0
    assert "left from" not in outcome.err


def test_holdouts_that_are_damaged_are_made_again(shot, command, tmp_path, tree):
    output = tmp_path / "out"
    words = ["plate", shot.source, "-o", output, "-q"]
    assert command(*words).code == 0
    before = tree(output)
    damaged = sorted((output / "holdout").iterdir())[2]
    damaged.write_bytes(damaged.read_bytes()[:40])
    assert command(*words, "--resume").code == 0
    assert tree(output) == before


@pytest.mark.parametrize(
    "words",
    [
        ["--device", "99999999999"],
        ["--device", "1", "--seconds", "nan"],
        ["--device", "1", "--start", "9" * 30],
    ],
)
def test_a_camera_that_none_can_be(words, command, tmp_path):
    outcome = command("capture", "--seconds", "1", *words, "-o", tmp_path / "out")
    assert outcome.code == 2


@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, []) for name in FOOTAGE), ("plate", ["--estimator", "minmax", "--holdout", "none"])],
)
def test_frames_with_pixels_that_are_not_finite_are_named(
    name, options, shot, command, copied, tmp_path
):
    folder, position = FOOTAGE[name]
    frames = copied(folder)
    path = frames / f"{frames.name}.1003.exr"
    image = read_image(path)
    layers = {layer: values.copy() for layer, values in image.layers.items()}
    pixels = np.atleast_3d(layers["Y" if name == "apply" else "RGB"])
    pixels[5, 6], pixels[7, 8, -1] = np.nan, np.inf
    write_exr(path, layers, image.header)
    words = replaced(shot.arguments(name), position, frames)
    outcome = command(*words, *options, "-o", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert "NaN or infinite in frames 1003 (2)" in outcome.err


def test_a_picture_of_eight_bits_is_no_map(shot, refused, tmp_path):
    path = tmp_path / "map.png"
    write_png(path, np.full((32, 48, 3), 128, np.uint8))
    said = refused(["warp", "--map", path, "--apply", shot.source])
    assert "map.png: 8 bits can't tell pixels apart" in said


def test_a_full_standard_output_is_named(shot, tmp_path):
    words = [*PROGRAM, *shot.arguments("plate"), "-o", str(tmp_path / "out")]
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 75
    assert "standard output: cannot write" in done.stderr


def test_capture_of_nothing(refused):
    assert "--device" in refused(["capture"], code=2)


@pytest.mark.parametrize("suffix", [".mov", ".mp4", ".mkv", ".txt", ".jpg", ""])
def test_a_movie_that_is_a_text_file(suffix, refused, tmp_path):
    path = tmp_path / f"take{suffix}"
    path.write_text("this is no movie\n" * 50)
    assert path.name in refused(["capture", path])


def test_a_camera_that_is_not_there(refused):
    assert "--device 99" in refused(["capture", "--device", "99", "--seconds", "1"])


def test_a_full_disk_is_worth_a_retry(shot, command, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no tmpfs may be mounted here")
    try:
        outcome = command(*shot.arguments("matte"), "-o", disk / "out")
        assert outcome.code == 75
        assert outcome.err.count("\n") == 1
        assert "No space left on device" in outcome.err
        assert not list(disk.rglob("*.tmp"))
        assert not list(disk.rglob("shadowtool.json"))
        for path in disk.rglob("*.exr"):
            assert read_image(path).header.size == (WIDTH, HEIGHT)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def no_memory_for_opencv():
    error = cv2.error("OpenCV: Failed to allocate 96000000 bytes")
    error.code, error.err = cv2.Error.StsNoMem, "Failed to allocate 96000000 bytes"
    return error


@pytest.mark.parametrize(
    "error", [MemoryError(), no_memory_for_opencv(), RuntimeError("can't start new thread")]
)
def test_running_out_of_memory_is_worth_a_retry(error, shot, command, tmp_path, monkeypatch):
    def starved(*args, **kwargs):
        raise error

    monkeypatch.setattr("shadowtool.steps.plate.RobustPlates.add", starved)
    outcome = command(*shot.arguments("plate"), "--holdout", "none", "-o", tmp_path / "out")
    assert outcome.code == 75
    assert outcome.err.startswith("shadowtool: error: out of memory")
    assert not (tmp_path / "out").exists()


def test_a_png_that_there_is_no_memory_for_is_not_damaged(command, tmp_path, monkeypatch):
    write_png(tmp_path / "take.1001.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))

    def starved(*args):
        raise no_memory_for_opencv()

    monkeypatch.setattr("cv2.imdecode", starved)
    words = ["capture", tmp_path / "take.1001.png", "-o", tmp_path / "out", "--missing", "skip"]
    outcome = command(*words)
    assert outcome.code == 75
    assert "out of memory" in outcome.err


def test_a_fault_of_our_own_is_one_line_and_a_traceback_only_on_request(
    shot, command, tmp_path, monkeypatch
):
    def faulty(*args, **kwargs):
        raise ZeroDivisionError("nothing to divide by")

    monkeypatch.setattr("shadowtool.steps.plate.RobustPlates.add", faulty)
    words = [*shot.arguments("plate"), "--holdout", "none", "-o", tmp_path / "out"]
    outcome = command(*words)
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "nothing to divide by" in outcome.err
    assert "Traceback" in command(*words, "-v").err


def test_messages_stay_on_one_line_whatever_a_file_is_called(refused, tmp_path):
    said = refused(["plate", tmp_path / "two\nlines\rthree"])
    assert "\r" not in said


def run(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*PROGRAM, *map(str, words)], capture_output=True, text=True, check=False, **options
    )


def test_stdout_stays_clean_when_openexr_prints_a_warning(shot, copied, tmp_path):
    copy = copied("photometric")
    frame(copy).write_bytes(frame(copy).read_bytes()[:-60])
    done = run("plate", copy, "-o", tmp_path / "out")
    assert done.returncode == 1
    assert done.stdout == ""
    assert re.fullmatch(r"shadowtool: error: .*1003\.exr: damaged or cut off.*\n", done.stderr)
    done = run("plate", copy, "-o", tmp_path / "out", "--missing", "skip", "--json")
    assert done.returncode == 3
    assert json.loads(done.stdout)["skipped"] == "1003"
    assert re.fullmatch(r"shadowtool: skipped: .*1003\.exr: damaged or cut off.*\n", done.stderr)


@pytest.mark.parametrize("values", [[3e38, -3e38], [1e30, 7e4], [np.inf, np.nan, -np.inf]])
def test_light_beyond_all_measure_is_no_reason_for_numpy_to_speak(values, shot, tmp_path):
    rng = np.random.default_rng(0)
    take = tmp_path / "take"
    take.mkdir()
    for file in sorted(shot.photometric.glob("*.exr")):
        image = read_image(file).rgb().astype(np.float32)
        strange = rng.random(image.shape[:2]) < 0.05
        image[strange] = rng.choice(values, (strange.sum(), 1))
        write_exr(take / file.name, {"RGB": image})
    steps = [
        ["plate", take, "-o", tmp_path / "plates"],
        ["plate", take, "-o", tmp_path / "extremes", "--estimator", "minmax"],
        ["matte", take, "--plates", shot.plates, "-o", tmp_path / "mattes"],
        ["scan", take, *shot.arguments("scan")[2:], "-o", tmp_path / "scan"],
    ]
    for words in steps:
        said = run(*words).stderr.splitlines()
        assert all(line.startswith("shadowtool: ") for line in said)


@pytest.mark.parametrize("name", ["plate", "matte", "scan", "capture"])
def test_what_is_skipped_is_said_in_the_order_of_the_frames(name, shot, tmp_path):
    words = shot.arguments(name)
    folder = tmp_path / "many"
    folder.mkdir()
    taken = sorted(Path(words[1]).glob("*.exr"))
    for number in range(40):
        file = folder / f"many.{number:04}.exr"
        file.write_bytes(b"" if number % 3 == 2 else taken[number % len(taken)].read_bytes())
    words[1] = str(folder)
    said = run(*words, "-o", tmp_path / "out", "--missing", "skip", "-j4").stderr
    skipped = re.findall(r"skipped: .*many\.(\d+)\.exr", said)
    assert [int(number) for number in skipped] == list(range(2, 40, 3))


def test_footage_of_which_nothing_is_seen_leaves_no_folder(shot, tmp_path):
    take = tmp_path / "take"
    take.mkdir()
    for number in range(4):
        nothing = np.full((6, 8, 3), np.nan, np.float32)
        write_exr(take / f"take.{number}.exr", {"RGB": nothing})
    done = run("plate", take, "-o", tmp_path / "out")
    assert done.returncode == 1 and "every pixel of every frame" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_program_answers_help_and_version():
    assert "Usage" in run("--help").stdout
    assert run("--version").stdout.startswith("shadowtool, version ")


@pytest.fixture
def long_run(shot, tmp_path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A matte of many frames, just after its first ones were written."""
    source = tmp_path / "long"
    source.mkdir()
    for number in range(400):
        data = frame(shot.source, 1001 + number % 6)
        (source / f"long.{number:04}.exr").symlink_to(data)
    output = tmp_path / "out"
    words = ["matte", source, "--plates", shot.plates, "-o", output, "-j2"]
    process = subprocess.Popen(
        [*PROGRAM, *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 20
    while not list(output.glob("beta/*.exr")) and time.monotonic() < deadline:
        time.sleep(0.005)
    yield process, output
    process.kill()
    process.communicate()


@pytest.mark.parametrize(
    ("number", "code", "word"),
    [(signal.SIGTERM, 143, "terminated"), (signal.SIGINT, 130, "interrupted")],
)
def test_a_signal_leaves_whole_frames_only(number, code, word, long_run):
    process, output = long_run
    process.send_signal(number)
    out, err = process.communicate(timeout=20)
    assert process.returncode == code
    assert out == ""
    assert err.startswith(f"shadowtool: error: {word}")
    assert err.count("\n") == 1
    assert not (output / "shadowtool.json").exists()
    assert not list(output.rglob("*.tmp"))
    frames = list(output.rglob("*.exr"))
    assert 0 < len(frames) < 800
    for path in frames:
        assert read_image(path).header.size == (WIDTH, HEIGHT)


def test_a_killed_runs_leftovers_are_gone_after_resuming(long_run, shot):
    process, output = long_run
    process.kill()
    process.communicate()
    for stray in output.rglob("*.tmp"):
        assert stray.name.startswith(".shadowtool-")
    words = ["matte", output.parent / "long", "--plates", shot.plates, "-o", output]
    done = run(*words, "--resume", "--frames", "0-20", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["kept"] > 0
    assert not list(output.rglob("*.tmp"))


def test_a_closed_stdout_pipe_ends_quietly_with_everything_written(shot, tmp_path, tree):
    reading, writing = os.pipe()
    os.close(reading)
    words = [*shot.arguments("plate"), "--holdout", "none", "-o", tmp_path / "out"]
    done = subprocess.run(
        [*PROGRAM, *words], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr
    assert "fault" not in done.stderr
    assert done.returncode in (0, 1, 141)
    assert set(tree(tmp_path / "out")) == {
        "lit.exr",
        "shadow.exr",
        "confidence.exr",
        "shadowtool.json",
    }


@pytest.mark.parametrize("stream", ["1", "2"])
def test_a_stream_that_is_closed_from_the_start_does_no_harm(stream, shot, tmp_path):
    words = " ".join(f"'{word}'" for word in [*PROGRAM, *shot.arguments("plate")])
    done = subprocess.run(
        ["sh", "-c", f"{words} -o '{tmp_path / 'out'}' {stream}>&-"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "shadowtool.json").is_file()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--frames", "1001"], "--frames says which frames --apply warps; give --apply FRAMES"),
        (["--outside", "0"], "--outside goes with --apply FRAMES"),
    ],
)
def test_options_of_applying_without_frames_to_apply_to(options, said, shot, misused):
    assert said in misused(shot.arguments("warp"), *options)


def test_iterations_of_a_map_that_is_there(shot, misused):
    said = misused(shot.arguments("apply"), "--iterations", 9)
    assert "--iterations goes with SCAN folders, not with --map" in said


def test_a_folder_of_a_map_is_the_map_in_it(shot, command, tmp_path):
    words = shot.arguments("apply")
    place = words.index("--map") + 1
    outcome = command(*replaced(words, place, Path(words[place]).parent), "-o", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert list((tmp_path / "out").rglob("*.1003.exr"))


def test_a_folder_without_a_map(shot, refused, tmp_path):
    words = shot.arguments("apply")
    (tmp_path / "maps").mkdir()
    said = refused(replaced(words, words.index("--map") + 1, tmp_path / "maps"))
    assert "warp.exr: no such file" in said


def test_the_figure_given_for_beta(shot, refused):
    words = shot.arguments("composite")
    said = refused(words, "--beta-frames", Path(words[1]) / "fg")
    assert "fg.1001.exr: is the figure that matte wrote, no β" in said


def test_beta_given_for_the_figures_matte(shot, refused):
    composite = shot.arguments("composite")
    said = refused(shot.arguments("matte"), "--alpha", Path(composite[1]) / "beta")
    assert "beta.1001.exr: is the β that matte wrote, no figure" in said
