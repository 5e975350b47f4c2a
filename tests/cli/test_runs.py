"""Every command on a tiny shot: the same bytes however it is run, and nothing lost on a rerun."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import av
import click
import cv2
import numpy as np
import pytest

from shadowtool.cli.commands import shadowtool
from shadowtool.cli.options import PROGRESS
from shadowtool.io.image import read_image, write_exr, write_png
from shadowtool.io.products import read_warp, write_warp
from tests.conftest import PLANE, write_frames

COMMANDS = ("capture", "plate", "matte", "scan", "warp", "apply", "composite")
PER_FRAME = ("capture", "matte", "apply", "composite")
# A product of each per-frame command that belongs to frame 1003.
PRODUCT = {
    "capture": "out.1003.exr",
    "matte": "beta/beta.1003.exr",
    "apply": "beta/beta.1003.exr",
    "composite": "out.1003.exr",
}
# What each command reads for frame 1003, as a folder of the shot and the option that names it.
FRAMES_READ = {
    "capture": ("source", 1),
    "matte": ("source", 1),
    "apply": ("matte/beta", 4),
    "composite": ("matte", 1),
}
CHANGED_OPTION = {
    "matte": ("--fill", "lit"),
    "plate": ("--transfer", "none"),
    "scan": ("--transfer", "rec709"),
    "warp": ("--iterations", "3"),
    "apply": ("--outside", "0.5"),
    "composite": ("--fill", "inpaint"),
    "capture": ("--crop", "40x30+1+1"),
}


@pytest.fixture
def make(shot, command, tmp_path) -> Callable:
    """Run a command of the table into ``tmp_path/PLACE/out``; its outcome must be the code."""

    def call(name: str, place: str, *options: object, code: int = 0, words=None) -> Path:
        output = tmp_path / place / "out"
        outcome = command(*(words or shot.arguments(name)), "-o", output, *options)
        assert outcome.code == code, outcome.err
        return output

    return call


def write_movie(path: Path, frames: int = 5) -> Path:
    rng = np.random.default_rng(3)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "bgr0"
        for _ in range(frames):
            picture = rng.integers(0, 256, (32, 48, 3)).astype(np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="bgr0")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.fixture
def movie(tmp_path: Path) -> Path:
    return write_movie(tmp_path / "take.mkv")


def replaced(words: list[str], position: int, value: object) -> list[str]:
    return [*words[:position], str(value), *words[position + 1 :]]


def times(folder: Path) -> dict[str, int]:
    return {str(p): p.stat().st_mtime_ns for p in folder.rglob("*") if p.is_file()}


def age(folder: Path) -> None:
    for path in folder.rglob("*"):
        os.utime(path, (1e9, 1e9))


@pytest.mark.parametrize("name", COMMANDS)
def test_two_threads_write_the_same_bytes_as_one(name, make, tree):
    one, two = make(name, "one", "-j1"), make(name, "two", "-j2")
    assert tree(one) == tree(two)
    assert "shadowtool.json" in tree(one)


@pytest.mark.parametrize("name", COMMANDS)
def test_two_runs_write_the_same_bytes(name, make, tree):
    assert tree(make(name, "first")) == tree(make(name, "second"))


@pytest.mark.parametrize("name", ["matte", "apply", "composite"])
@pytest.mark.parametrize("chunks", [("1001-1003", "1004-1006"), ("1002-1006x2", "1001-1006x2")])
def test_chunks_written_into_one_folder_equal_the_whole(name, chunks, make, tree):
    whole = make(name, "whole")
    for chunk in chunks:
        parts = make(name, "parts", "--frames", chunk)
    assert tree(parts) == tree(whole)


def test_chunks_of_a_capture_are_the_same_frames_and_one_record(make, tree):
    whole = make("capture", "whole")
    for chunk in ("1001-1003", "1004-1006"):
        parts = make("capture", "parts", "--frames", chunk)
    frames = {path: data for path, data in tree(whole).items() if path.endswith(".exr")}
    assert {path: data for path, data in tree(parts).items() if path.endswith(".exr")} == frames
    assert tree(parts)["shadowtool.json"] == tree(whole)["shadowtool.json"]


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_run_is_refused_and_changes_nothing(name, make, command, shot, tree):
    output = make(name, "once")
    before, stamps = tree(output), times(output)
    outcome = command(*shot.arguments(name), "-o", output)
    assert outcome.code == 1
    assert outcome.err.startswith("shadowtool: error: ")
    assert "--overwrite" in outcome.err
    assert (tree(output), times(output)) == (before, stamps)


@pytest.mark.parametrize("name", COMMANDS)
def test_overwrite_replaces_what_is_there(name, make, tree):
    output = make(name, "once")
    before = tree(output)
    for path in before:
        (output / path).write_bytes(b"spoiled")
    make(name, "once", "--overwrite")
    assert tree(output) == before


def test_overwrite_replaces_the_record_of_another_step(shot, copied, command):
    folder = copied("scan1")
    outcome = command(*shot.arguments("plate"), "-o", folder, "--overwrite")
    assert outcome.code == 0, outcome.err
    assert json.loads((folder / "shadowtool.json").read_text())["step"] == "plate"


@pytest.mark.parametrize("name", COMMANDS)
def test_resume_writes_no_product_again_that_is_current(name, make, tree):
    output = make(name, "once")
    before = tree(output)
    age(output)
    make(name, "once", "--resume")
    assert tree(output) == before
    fresh = {p for p, t in times(output).items() if t > 1e18 + 1}
    assert {Path(p).name for p in fresh} <= {"shadowtool.json"}


@pytest.mark.parametrize("name", PER_FRAME)
def test_resume_makes_a_deleted_frame_again_and_leaves_the_others_alone(name, make, tree):
    output = make(name, "once")
    before = tree(output)
    age(output)
    (output / PRODUCT[name]).unlink()
    make(name, "once", "--resume")
    assert tree(output) == before
    fresh = {Path(p).name for p, t in times(output).items() if t > 1e18 + 1}
    assert {p for p in fresh if "1003" not in p} <= {"shadowtool.json", "capture.json"}


@pytest.mark.parametrize("name", PER_FRAME)
def test_resume_makes_a_truncated_frame_again(name, make, tree):
    output = make(name, "once")
    before = tree(output)
    product = output / PRODUCT[name]
    product.write_bytes(before[PRODUCT[name]][:-40])
    make(name, "once", "--resume")
    assert tree(output) == before


@pytest.mark.parametrize(
    ("name", "product"),
    [
        ("plate", "lit.exr"),
        ("plate", "confidence.exr"),
        ("scan", "scan.exr"),
        ("scan", "lines.json"),
        ("warp", "warp.exr"),
    ],
)
def test_resume_makes_a_truncated_product_again(name, product, make, tree):
    output = make(name, "once")
    before = tree(output)
    (output / product).write_bytes(before[product][:-40])
    make(name, "once", "--resume")
    assert tree(output) == before


@pytest.mark.parametrize(("name", "picture"), [("scan", "scan.png"), ("warp", "warp.png")])
def test_resume_makes_a_lost_picture_again(name, picture, make, tree):
    output = make(name, "once")
    before = tree(output)
    (output / picture).unlink()
    make(name, "once", "--resume")
    assert tree(output) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_resume_after_the_manifest_was_lost_writes_it_again(name, make, tree):
    output = make(name, "once")
    before = tree(output)
    (output / "shadowtool.json").unlink()
    make(name, "once", "--resume")
    assert tree(output) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_resume_starts_anew_when_a_parameter_changed(name, make, tree):
    wanted = make(name, "wanted", *CHANGED_OPTION[name])
    output = make(name, "once")
    assert tree(output) != tree(wanted)
    make(name, "once", "--resume", *CHANGED_OPTION[name])
    assert tree(output) == tree(wanted)


@pytest.mark.parametrize("name", PER_FRAME)
def test_resume_makes_a_frame_again_whose_input_changed(name, make, shot, copied, tree):
    folder, position = FRAMES_READ[name]
    copy = copied(folder)
    words = replaced(shot.arguments(name), position, copy)
    output = make(name, "once", words=words)
    before = tree(output)
    changed = next(p for p in sorted(copy.rglob("*.1003.exr")) if "fg" not in p.parts)
    changed.write_bytes(changed.with_name(changed.name.replace("1003", "1005")).read_bytes())
    make(name, "once", "--resume", words=words)
    after = tree(output)
    assert after[PRODUCT[name]] != before[PRODUCT[name]]
    assert after == tree(make(name, "anew", words=words))


@pytest.mark.parametrize(
    ("name", "part", "file", "position"),
    [
        ("plate", "photometric", "photometric.1004.exr", 1),
        ("scan", "sweep1", "sweep1.1004.exr", 1),
        ("warp", "scan1", "lines.json", 1),
        ("matte", "plates", "lit.exr", 3),
        ("composite", "plates", "lit.exr", 3),
    ],
)
def test_resume_starts_anew_when_an_input_changed(
    name, part, file, position, make, shot, copied, tree
):
    copy = copied(part)
    words = replaced(shot.arguments(name), position, copy)
    output = make(name, "once", words=words)
    manifest = tree(output)["shadowtool.json"]
    path = copy / file
    if path.suffix == ".json":
        record = json.loads(path.read_bytes())
        record["lines"][3]["offset"] += 0.25
        path.write_text(json.dumps(record))
    elif name in ("matte", "composite"):
        path.write_bytes((copy / "shadow.exr").read_bytes())
    else:
        path.write_bytes((copy / file.replace("1004", "1006")).read_bytes())
    make(name, "once", "--resume", words=words)
    assert tree(output)["shadowtool.json"] != manifest
    assert tree(output) == tree(make(name, "anew", words=words))


@pytest.mark.parametrize("name", ["apply", "composite"])
def test_resume_starts_anew_with_another_map(name, make, shot, copied, tree):
    stmap = copied("warp") / "warp.exr"
    arguments = shot.arguments(name)
    words = replaced(arguments, arguments.index(str(shot.warp / "warp.exr")), stmap)
    before = tree(make(name, "once", words=words))
    found, header, _ = read_warp(stmap)
    found.warp[..., 0] += 3
    write_warp(stmap, found, header, {})
    after = tree(make(name, "once", "--resume", words=words))
    assert after != before
    assert after == tree(make(name, "anew", words=words))


def test_resume_starts_anew_with_another_plane(make, shot, tree):
    before = tree(make("scan", "once"))
    words = replaced(shot.arguments("scan"), 3, PLANE.replace("31", "20"))
    after = tree(make("scan", "once", "--resume", words=words))
    assert after["lines.json"] != before["lines.json"]
    assert after == tree(make("scan", "anew", words=words))


def test_resume_starts_anew_with_another_source(make, shot, copied, tree):
    copy = copied("scan2")
    words = [*shot.arguments("warp"), "--source-scan", shot.scan1, "--source-scan", copy]
    before = tree(make("warp", "once", words=words))
    record = json.loads((copy / "lines.json").read_text())
    for line in record["lines"]:
        line["offset"] += 2
    (copy / "lines.json").write_text(json.dumps(record))
    after = tree(make("warp", "once", "--resume", words=words))
    assert after["warp.exr"] != before["warp.exr"]


@pytest.mark.parametrize(
    ("name", "folder", "position"),
    [
        ("capture", "source", 1),
        ("plate", "photometric", 1),
        ("matte", "source", 1),
        ("scan", "sweep1", 1),
        ("apply", "matte/beta", 4),
        ("composite", "matte", 1),
    ],
)
@pytest.mark.parametrize("fault", ["deleted", "truncated", "empty", "text"])
def test_missing_skip_goes_on_without_a_bad_frame(
    name, folder, position, fault, command, shot, copied, tmp_path
):
    copy = copied(folder)
    for path in copy.rglob("*.1003.exr"):
        data = path.read_bytes()
        path.unlink()
        if fault != "deleted":
            kept = {"truncated": data[:-60], "empty": b"", "text": b"hello\n"}[fault]
            path.write_bytes(kept)
    words = replaced(shot.arguments(name), position, copy)
    outcome = command(*words, "-o", tmp_path / "out", "--missing", "skip")
    assert outcome.code == 3, outcome.err
    assert "SKIPPED 1003" in outcome.out
    assert (tmp_path / "out" / "shadowtool.json").is_file()
    assert not [p for p in (tmp_path / "out").rglob("*") if "1003" in p.name]


@pytest.mark.parametrize(("name", "option"), [("matte", "--alpha"), ("plate", "--holdout")])
@pytest.mark.parametrize("fault", ["deleted", "empty"])
def test_missing_skip_goes_on_without_a_bad_matte(
    name, option, fault, command, shot, copied, tmp_path
):
    mattes = copied("matte") / "fg"
    if name == "plate":
        for number in range(1007, 1013):
            (mattes / f"fg.{number}.exr").write_bytes((mattes / "fg.1001.exr").read_bytes())
    bad = mattes / "fg.1003.exr"
    bad.unlink()
    if fault == "empty":
        bad.write_bytes(b"")
    words = [*shot.arguments(name), option, mattes, "-o", tmp_path / "out", "--missing", "skip"]
    outcome = command(*words)
    assert outcome.code == 3, outcome.err
    assert "SKIPPED 1003" in outcome.out


@pytest.mark.parametrize("name", COMMANDS)
def test_json_prints_one_valid_document(name, shot, command, tmp_path):
    outcome = command(*shot.arguments(name), "-o", tmp_path / "out", "--json")
    assert outcome.code == 0
    record = json.loads(outcome.out)
    assert record["step"] == ("warp" if name == "apply" else name)
    assert record["skipped"] == ""


def test_json_of_a_solved_and_applied_map_is_a_list_of_both(shot, command, tmp_path):
    words = [*shot.arguments("warp"), "--apply", shot.matte / "beta", "-o", tmp_path / "out"]
    outcome = command(*words, "--json")
    assert [row["frames"] for row in json.loads(outcome.out)] == ["", "1001-1006"]


@pytest.mark.parametrize("name", COMMANDS)
def test_quiet_prints_nothing(name, shot, command, tmp_path):
    outcome = command(*shot.arguments(name), "-o", tmp_path / "out", "-q")
    assert outcome == (0, "", "")


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("kind", PROGRESS)
def test_progress_never_goes_to_stdout(name, kind, shot, command, tmp_path):
    outcome = command(*shot.arguments(name), "-o", tmp_path / "out", "--progress", kind, "--json")
    assert outcome.code == 0
    json.loads(outcome.out)


@pytest.mark.parametrize("name", COMMANDS)
def test_openjd_progress_climbs_from_zero_to_a_hundred(name, shot, command, tmp_path):
    outcome = command(*shot.arguments(name), "-o", tmp_path / "out", "--progress", "openjd")
    lines = [line for line in outcome.err.splitlines() if line.startswith("openjd_progress: ")]
    parts = [float(line.removeprefix("openjd_progress: ")) for line in lines]
    assert parts[0] == 0.0
    assert parts[-1] == 100.0
    assert parts == sorted(parts)


@pytest.mark.parametrize("kind", ["none", "plain"])
def test_a_short_run_without_a_terminal_says_nothing_on_stderr(kind, shot, command, tmp_path):
    words = [*shot.arguments("matte"), "-o", tmp_path / "out", "--progress", kind]
    assert command(*words).err == ""


def test_plain_progress_prints_a_line_every_few_seconds(shot, command, tmp_path, monkeypatch):
    clock = iter(range(0, 1000, 4))
    monkeypatch.setattr("shadowtool.cli.progress.time.monotonic", lambda: next(clock))
    outcome = command(*shot.arguments("matte"), "-o", tmp_path / "out", "--progress", "plain")
    lines = outcome.err.splitlines()
    assert lines
    assert all(line.startswith("matte: ") and line.endswith(" of 6") for line in lines)


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("folder", ["with a space", "Schatten größer", "take[1]", "100% #1"])
def test_output_folders_may_have_any_name(name, folder, make, tree):
    plain, odd = make(name, "plain"), make(name, folder)
    assert tree(odd) == tree(plain)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_working_directory_makes_no_difference(name, make, shot, tmp_path, tree, monkeypatch):
    absolute = make(name, "absolute")
    monkeypatch.chdir(shot.folder)
    words = [
        os.path.relpath(word) if word.startswith(str(shot.folder)) else word
        for word in shot.arguments(name)
    ]
    relative = tmp_path / "relative" / "out"
    make(name, os.path.relpath(relative.parent, tmp_path), words=words)
    assert tree(relative) == tree(absolute)


@pytest.mark.parametrize("name", COMMANDS)
def test_input_folders_may_be_named_in_no_encoding(name, shot, tmp_path):
    odd = os.fsencode(tmp_path) + b"/sh\xe9t"
    Path(os.fsdecode(odd)).symlink_to(shot.folder)
    words = [word.replace(str(shot.folder), os.fsdecode(odd)) for word in shot.arguments(name)]
    program = [sys.executable, "-c", "from shadowtool.cli import main; main()"]
    done = subprocess.run(
        [*program, *words, "-o", tmp_path / "out"], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["matte", "capture"])
def test_folders_and_frames_may_be_named_in_no_encoding(name, command, shot, tmp_path):
    odd = Path(os.fsdecode(os.fsencode(tmp_path) + b"/pl\xe2t"))
    odd.symlink_to(shot.plates if name == "matte" else shot.source)
    position = 3 if name == "matte" else 1
    words = replaced(shot.arguments(name), position, odd)
    if name == "capture":
        words[1] = os.fsdecode(os.fsencode(tmp_path) + b"/t\xe9ke.mkv")
        shutil.copy(write_movie(tmp_path / "take.mkv"), words[1])
    assert command(*words, "-o", tmp_path / "out", "-q").code == 0


def test_the_manifest_is_newer_than_every_product(make):
    for name in COMMANDS:
        stamps = times(make(name, name))
        last = max(stamps, key=lambda path: stamps[path])
        assert stamps[last] == next(t for p, t in stamps.items() if p.endswith("shadowtool.json"))


def test_time_codes_stay_with_their_frames(make, shot, copied):
    import OpenEXR

    copy = copied("source")
    for path in sorted(copy.glob("*.exr")):
        number = int(path.stem[-2:])
        with OpenEXR.File(str(path)) as file:
            code = OpenEXR.TimeCode(1, 2, 3, number, *[False] * 6, *[0] * 8)
            header = {**file.header(), "timeCode": code, "framesPerSecond": 24}
            header = {k: v for k, v in header.items() if k in ("timeCode", "compression", "type")}
            pixels = file.channels()["RGB"].pixels.copy()
        OpenEXR.File(header, {"RGB": pixels}).write(str(path))
    products = {"capture": "out", "matte": "beta/beta"}
    for name, stem in products.items():
        output = make(name, name, words=replaced(shot.arguments(name), 1, copy))
        for number in (1001, 1004):
            with OpenEXR.File(f"{output / stem}.{number}.exr") as file:
                assert file.header()["timeCode"].frame == number % 100


def test_a_movie_becomes_frames_from_1001_on(movie, command, tmp_path):
    assert command("capture", movie, "-o", tmp_path / "take").code == 0
    names = {path.name for path in (tmp_path / "take").glob("*.exr")}
    assert names == {f"take.{number}.exr" for number in range(1001, 1006)}


@pytest.mark.parametrize("name", ["take", "take[1]", "take*"])
def test_a_movie_captured_twice_is_refused(name, movie, command, tmp_path, tree):
    output = tmp_path / name
    assert command("capture", movie, "-o", output, "-q").code == 0
    before = times(output)
    assert command("capture", movie, "-o", output, "-q", "--start", "1003").code == 1
    assert times(output) == before


def test_chunks_of_a_movie_equal_the_whole(movie, command, tmp_path, tree):
    whole, parts = tmp_path / "whole/take", tmp_path / "parts/take"
    assert command("capture", movie, "-o", whole, "-q").code == 0
    for chunk in ("1001-1002", "1003-1005"):
        assert command("capture", movie, "-o", parts, "-q", "--frames", chunk).code == 0
    frames = {path: data for path, data in tree(whole).items() if path.endswith(".exr")}
    assert {path: data for path, data in tree(parts).items() if path.endswith(".exr")} == frames
    assert tree(parts)["shadowtool.json"] == tree(whole)["shadowtool.json"]


def test_resume_makes_the_rest_of_a_movie(movie, command, tmp_path, tree):
    whole, part = tmp_path / "whole/take", tmp_path / "part/take"
    assert command("capture", movie, "-o", whole, "-q").code == 0
    assert command("capture", movie, "-o", part, "-q", "--frames", "1002-1003").code == 0
    outcome = command("capture", movie, "-o", part, "--resume", "--json")
    assert json.loads(outcome.out)["kept"] == 2
    assert tree(part) == tree(whole)


@pytest.fixture
def jolted(tmp_path) -> Path:
    """A take whose camera moves from frame 1004 on."""
    texture = np.random.default_rng(2).random((80, 120, 3), np.float32)
    texture = cv2.GaussianBlur(texture, (0, 0), 2).astype(np.float16)
    views = (texture[:64, x : x + 96] for x in (8, 8, 8, 4, 4, 4))
    return write_frames(tmp_path / "jolted", map(np.ascontiguousarray, views))


def test_an_edited_record_of_a_capture_does_no_harm(make, tree):
    whole = make("capture", "take")
    before = tree(whole)
    record = json.loads((whole / "shadowtool.json").read_text())
    record["frames"] = dict.fromkeys(record["frames"], "edited")
    (whole / "shadowtool.json").write_text(json.dumps(record))
    (whole / "capture.json").write_text(json.dumps({"camera_motion": "edited"}))
    assert tree(make("capture", "take", "--resume")) == before


def test_a_camera_that_moved_is_refused_again(jolted, command, tmp_path):
    words = ["capture", jolted, "-o", tmp_path / "out", "--strict", "--resume"]
    for _ in range(2):
        outcome = command(*words)
        assert outcome.code == 1
        assert "the camera moved, first seen in frame 1004" in outcome.err
        assert not (tmp_path / "out" / "shadowtool.json").exists()
    assert command(*words[:-2], "--resume", "-q").code == 0
    assert command(*words).code == 1


def test_every_chunk_is_held_against_the_first_frame_of_all(jolted, command, tmp_path):
    words = ["capture", jolted, "-o", tmp_path / "out", "--strict"]
    assert command(*words, "--frames", "1001-1003").code == 0
    outcome = command(*words, "--frames", "1004-1006")
    assert outcome.code == 1
    assert "first seen in frame 1004" in outcome.err


@pytest.mark.parametrize(("name", "bad"), [("plate", 1004), ("scan", 1020)])
def test_a_result_without_a_damaged_frame_is_kept_and_says_so(name, bad, shot, command, tmp_path):
    words = shot.arguments(name)
    take = tmp_path / Path(words[1]).name
    shutil.copytree(words[1], take)
    file = take / f"{take.name}.{bad}.exr"
    file.write_bytes(file.read_bytes()[:-30])
    words = [*replaced(words, 1, take), "-o", tmp_path / "out", "--missing", "skip"]
    for again in ([], ["--resume"]):
        outcome = command(*words, *again)
        assert outcome.code == 3, outcome.err
        assert f"SKIPPED {bad}" in outcome.out
    assert "up to date" in outcome.out
    record = json.loads((tmp_path / "out" / "shadowtool.json").read_text())
    assert record["figures"]["skipped"] == str(bad)
    # Another damaged file is another input.
    file.write_bytes(file.read_bytes()[:-30])
    assert "up to date" not in command(*words, "--resume").out


def test_resume_of_plates_without_a_holdout_that_is_missing(shot, command, copied, tmp_path):
    mattes = copied("matte") / "fg"
    for number in range(1007, 1013):
        (mattes / f"fg.{number}.exr").write_bytes((mattes / "fg.1001.exr").read_bytes())
    (mattes / "fg.1003.exr").unlink()
    words = [*shot.arguments("plate"), "--holdout", mattes, "--missing", "skip"]
    for again in ([], ["--resume"]):
        outcome = command(*words, "-o", tmp_path / "out", *again)
        assert outcome.code == 3, outcome.err
    assert "up to date" in outcome.out


def test_a_damaged_first_picture_is_skipped_like_any(command, tmp_path):
    folder = tmp_path / "take"
    folder.mkdir()
    for number in range(1001, 1005):
        write_png(folder / f"a.{number}.png", np.full((32, 48, 3), 9 * number % 256, np.uint8))
    first = folder / "a.1001.png"
    first.write_bytes(first.read_bytes()[:-30])
    outcome = command("capture", folder, "-o", tmp_path / "out", "--missing", "skip")
    assert outcome.code == 3, outcome.err
    assert "SKIPPED 1001" in outcome.out


def test_the_record_says_how_to_run_the_step_again(shot, make):
    recorded = {
        ("matte", "--no-clamp"): "--no-clamp",
        ("scan", "--plane", shot.folder / "mask.png"): "--plane mask.png",
        ("warp", "--source-scan", shot.scan1, "--source-scan", shot.scan2): (
            "scan1 scan2 --source-scan scan1 --source-scan scan2"
        ),
    }
    for place, ((name, *options), said) in enumerate(recorded.items()):
        words = shot.arguments(name)
        words = [*words[: words.index("--plane")], *options] if name == "scan" else words + options
        output = make(name, str(place), words=words)
        assert said in json.loads((output / "shadowtool.json").read_text())["command"]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_recorded_command_can_be_read(shot, make, name):
    plain = [word for word in shot.arguments(name) if word != "--ratio"]
    record = json.loads((make(name, name, words=plain) / "shadowtool.json").read_text())
    program, step, *words = shlex.split(record["command"])
    assert program == "shadowtool"
    command = shadowtool.get_command(click.Context(shadowtool), step)
    command.make_context(step, [*words, "-o", "again"])


@pytest.mark.parametrize("name", ["capture", "matte", "apply"])
def test_frames_left_from_a_longer_take_are_named_and_not_recorded(name, shot, command, tmp_path):
    read, position = FRAMES_READ[name]
    source = tmp_path / Path(read).name
    shutil.copytree(shot.folder / read, source)
    words = replaced(shot.arguments(name), position, source)
    output = tmp_path / "out"
    assert command(*words, "-o", output).code == 0
    for number in (1005, 1006):
        (file,) = source.glob(f"*.{number}.exr")
        file.unlink()
    outcome = command(*words, "-o", output, "--resume")
    assert outcome.code == 0
    assert "frames 1005-1006 are left from an earlier run" in outcome.err
    record = json.loads((output / "shadowtool.json").read_text())
    assert sorted(record["frames"]) == ["1001", "1002", "1003", "1004"]


@pytest.mark.parametrize("name", ["capture", "matte", "composite"])
def test_frames_of_another_take_under_the_same_names_are_no_chunk_of_this_one(
    name, shot, command, copied, tmp_path
):
    read, position = FRAMES_READ[name]
    words = replaced(shot.arguments(name), position, shot.folder / read)
    assert command(*words, "-o", tmp_path / "out").code == 0
    # Same names and size, other pictures.
    other = copied(read)
    for file in other.rglob("*.exr"):
        layers = read_image(file).layers
        noise = np.random.default_rng(1).normal(1, 0.01, (32, 48))
        for values in layers.values():
            values[:] = values * (noise if values.ndim == 2 else noise[..., np.newaxis])
        write_exr(file, layers)
    words = replaced(words, position, other)
    outcome = command(*words, "-o", tmp_path / "out", "--frames", "1001-1003", "--overwrite")
    assert outcome.code == 0, outcome.err
    assert "frames 1004-1006 are left from an earlier run" in outcome.err
    record = json.loads((tmp_path / "out" / "shadowtool.json").read_text())
    assert sorted(record["frames"]) == ["1001", "1002", "1003"]


def test_each_sequence_that_one_map_is_applied_to_has_its_own_record(shot, command, tmp_path):
    for part, frames in (("beta", "1001-1006"), ("fg", "1001-1003")):
        words = ["warp", "--map", shot.warp / "warp.exr", "--apply", shot.matte / part]
        assert command(*words, "-o", tmp_path, "--frames", frames).code == 0
    known = {
        part: sorted(json.loads((tmp_path / part / "shadowtool.json").read_text())["frames"])
        for part in ("beta", "fg", "")
    }
    assert known["beta"] == [str(number) for number in range(1001, 1007)]
    assert known["fg"] == known[""] == ["1001", "1002", "1003"]


def test_frames_of_another_movie_are_named(movie, command, tmp_path):
    output = tmp_path / "take"
    assert command("capture", movie, "-o", output).code == 0
    write_movie(movie, frames=3)
    outcome = command("capture", movie, "-o", output, "--overwrite")
    assert outcome.code == 0
    assert "frames 1004-1005 are left from an earlier run" in outcome.err


@pytest.mark.parametrize("again", ["--overwrite", "--resume"])
def test_frames_under_their_former_numbers_are_named(movie, command, tmp_path, again):
    output = tmp_path / "take"
    assert command("capture", movie, "-o", output).code == 0
    outcome = command("capture", movie, "-o", output, "--start", "1", again)
    assert outcome.code == 0
    assert "frames 1001-1005 are left from an earlier run" in outcome.err
    record = json.loads((output / "shadowtool.json").read_text())
    assert sorted(record["frames"]) == ["1", "2", "3", "4", "5"]


@pytest.mark.parametrize("name", ["plate", "scan"])
def test_a_record_says_of_which_frames_the_result_is(name, shot, command, tmp_path, monkeypatch):
    words = shot.arguments(name)
    folder = Path(words[1])
    if name == "plate":
        # The pattern itself may say which files are meant.
        words[1] = f"{folder}/{folder.name}.1001-1005#.exr"
    else:
        words += ["--frames", "1001-1018"]
    assert command(*words, "-o", tmp_path / "out").code == 0
    record = json.loads((tmp_path / "out" / "shadowtool.json").read_text())
    _, *again = shlex.split(record["command"])
    monkeypatch.chdir(folder)
    assert command(*again, "-o", tmp_path / "again").code == 0
    for file in sorted((tmp_path / "out").glob("*.exr")):
        assert file.read_bytes() == (tmp_path / "again" / file.name).read_bytes()


def test_a_composite_in_another_format_is_not_put_beside_the_first(shot, command, tmp_path):
    """Whoever reads the folder next could not tell which of the two is meant."""
    words = [*shot.arguments("composite"), "-o", tmp_path / "out"]
    assert command(*words, "--format", "png").code == 0
    for option in ("--overwrite", "--resume"):
        outcome = command(*words, "--format", "exr", option)
        assert outcome.code == 1
        assert "another format" in outcome.err
    assert not list((tmp_path / "out").glob("out.*.exr"))


def test_a_frame_that_is_skipped_is_named_with_the_reason(shot, command, tmp_path):
    damaged = tmp_path / "source"
    shutil.copytree(shot.source, damaged)
    file = damaged / "source.1003.exr"
    file.write_bytes(file.read_bytes()[:-30])
    words = ["matte", damaged, "--plates", shot.plates, "-o", tmp_path / "matte"]
    outcome = command(*words, "--missing", "skip")
    assert outcome.code == 3
    assert "source.1003.exr: damaged or cut off" in outcome.err


@pytest.mark.parametrize(
    "words",
    [
        ("composite", "{matte}", "--fg", "{matte}/trimap", "--plates", "{plates}"),
        ("plate", "{source}", "--holdout", "{source}"),
        ("matte", "{source}", "--plates", "{plates}", "--alpha", "{source}"),
    ],
)
def test_what_can_never_do_is_not_skipped(words, shot, command, tmp_path):
    """Absent and damaged frames are; a wrong input is wrong in every frame."""
    words = [
        word.format(matte=shot.matte, plates=shot.plates, source=shot.source) for word in words
    ]
    plain = command(*words, "-o", tmp_path / "plain")
    skipping = command(*words, "-o", tmp_path / "skipping", "--missing", "skip")
    assert plain.code == skipping.code == 1
    assert plain.err == skipping.err


@pytest.mark.parametrize("name", ["plate", "matte", "scan", "warp", "composite"])
def test_another_steps_folder_is_not_offered_to_be_written_over(name, shot, command, tmp_path):
    output = tmp_path / "out"
    assert command("capture", shot.source, "-o", output).code == 0
    # As if products of this step were there, too.
    for file in ("lit.exr", "scan.exr", "warp.exr", "trimap/trimap.1001.png"):
        (output / file).parent.mkdir(exist_ok=True)
        (output / file).write_bytes(b"")
    outcome = command(*shot.arguments(name), "-o", output)
    assert outcome.code == 1
    assert "is the record of capture; give another folder" in outcome.err


def test_a_scan_given_twice_is_refused(shot, command, tmp_path):
    scans = [shot.scan1, shot.scan2, tmp_path / "linked"]
    scans[2].symlink_to(shot.scan1)
    outcome = command("warp", *scans, "-o", tmp_path / "out")
    assert outcome.code == 2
    assert f"{scans[2]}: is given twice" in outcome.err


def test_holdouts_of_other_frames_are_not_kept(shot, command, tmp_path):
    output = tmp_path / "out"
    words = ["plate", shot.source, "-o", output]
    assert command(*words).code == 0
    holdouts = sorted((output / "holdout").iterdir())
    before = [file.read_bytes() for file in holdouts]
    assert before[0] != before[-1]
    holdouts[0].write_bytes(before[-1])
    assert command(*words, "--resume").code == 0
    assert [file.read_bytes() for file in holdouts] == before


def test_chunks_of_the_same_leave_nothing(shot, command, tmp_path):
    words = [*shot.arguments("matte"), "-o", tmp_path / "out"]
    for frames in ("1001-1003", "1004-1006"):
        assert "left from" not in command(*words, "--frames", frames).err


def test_a_chunk_that_stood_still_does_not_speak_for_the_others(command, tmp_path):
    rng = np.random.default_rng(5)
    picture = cv2.GaussianBlur(rng.random((60, 80, 3)).astype(np.float32), (0, 0), 2)
    moved = [np.roll(picture, 3 * (4 <= number < 7), axis=1) for number in range(10)]
    write_frames(tmp_path / "source", moved)
    words = ["capture", tmp_path / "source", "-o", tmp_path / "take"]
    for frames in ("1001-1007", "1008-1010"):
        assert command(*words, "--frames", frames).code == 0
    assert command(*words, "--resume", "--strict").code == 1


def test_sweeps_of_one_name_are_told_apart(shot, make, tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
    shutil.copytree(shot.scan1, tmp_path / "one" / "scan")
    shutil.copytree(shot.scan2, tmp_path / "two" / "scan")
    words = ["warp", tmp_path / "one" / "scan", tmp_path / "two" / "scan"]
    figures = json.loads((make("warp", "map", words=words) / "shadowtool.json").read_text())[
        "figures"
    ]
    assert list(figures["reached"]) == ["one/scan", "two/scan"]
    assert list(figures["angles_degrees"]) == ["one/scan two/scan"]


def test_a_renumbered_sweep_is_scanned_anew(shot, command, tmp_path):
    shutil.copytree(shot.scan1, tmp_path / "scan")
    (tmp_path / "sweep1").mkdir()
    for number, file in enumerate(sorted(shot.sweep1.iterdir()), start=1):
        shutil.copy(file, tmp_path / "sweep1" / f"sweep1.{number:04d}.exr")
    words = replaced(shot.arguments("scan"), 1, tmp_path / "sweep1")
    outcome = command(*words, "-o", tmp_path / "scan", "--resume", "--json")
    assert json.loads(outcome.out)["kept"] == 0
    lines = json.loads((tmp_path / "scan" / "lines.json").read_text())["lines"]
    assert lines[0]["frame"] < 100


def test_openjd_progress_of_a_movie_reaches_a_hundred_only_at_its_end(movie, command, tmp_path):
    outcome = command("capture", movie, "-o", tmp_path / "take", "--progress", "openjd")
    lines = [line for line in outcome.err.splitlines() if line.startswith("openjd_progress: ")]
    assert lines.count("openjd_progress: 100.0") == 1
    assert lines[-1] == "openjd_progress: 100.0"


def test_frames_that_a_movie_does_not_have_are_named(movie, command, tmp_path):
    outcome = command("capture", movie, "-o", tmp_path / "take", "--frames", "1004-1008")
    assert outcome.code == 1
    assert "1006-1008" in outcome.err
