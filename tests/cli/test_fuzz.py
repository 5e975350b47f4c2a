"""Damaged files of every kind that is read: refused by name, or harmless; never another error."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from shadowtool.io.image import Header, read_image, write_exr, write_png

PLANE = "0,0 47,0 47,31 0,31"
FRAMES = ["--frames", "1001-1003"]
SCAN = ["scan", "sweep1", "--plane"]
MATTE = ["matte", "source", "--plates", "plates", *FRAMES]
COMPOSITE = ["composite", "matte", "--plates", "plates", *FRAMES]
# What is damaged, of a copy of the shot, and a command that reads it there.
TARGETS = {
    "a frame of a capture": ("source/source.1003.exr", ["capture", "source"]),
    "a frame of plates": ("photometric/photometric.1003.exr", ["plate", "photometric"]),
    "a frame of a sweep": ("sweep1/sweep1.1005.exr", [*SCAN, PLANE]),
    "a mask": ("mask.png", [*SCAN, "mask.png"]),
    "a lit plate": ("plates/lit.exr", COMPOSITE),
    "a confidence": ("plates/confidence.exr", MATTE),
    "a figure": ("matte/fg/fg.1003.exr", COMPOSITE),
    "a trimap": ("matte/trimap/trimap.1003.png", [*MATTE, "--trimap", "matte/trimap"]),
    "a β": ("matte/beta/beta.1003.exr", COMPOSITE),
    "a map": ("warp/warp.exr", [*COMPOSITE, "--warp", "warp/warp.exr"]),
    "a scan": ("scan1/scan.exr", ["warp", "scan1", "scan2"]),
    "lines": ("scan1/lines.json", ["warp", "scan1", "scan2"]),
}
DAMAGES = 10


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut off, emptied, bits flipped, runs of bytes overwritten or left out; header or pixels."""
    kind = rng.integers(6)
    if kind == 0:
        return data[: rng.integers(len(data))]
    if kind == 1:
        return b""
    changed = bytearray(data)
    # Half of the damage goes to the header, which is small.
    reach = len(data) if rng.random() < 0.5 else min(len(data), 600)
    at = int(rng.integers(reach))
    if kind == 2:
        changed[at] ^= 1 << rng.integers(8)
    elif kind == 3:
        length = int(rng.integers(1, 40))
        changed[at : at + length] = rng.bytes(length)
    elif kind == 4:
        del changed[at : at + int(rng.integers(1, 40))]
    else:
        changed[at : at + 4] = b"\xff\xff\xff\x7f"
    return bytes(changed)


@pytest.fixture(scope="module")
def footage(shot, tmp_path_factory) -> Path:
    """A copy of the shot whose files are damaged one after the other."""
    folder = tmp_path_factory.mktemp("fuzz") / "shot"
    shutil.copytree(shot.folder, folder)
    return folder


@pytest.mark.parametrize("what", TARGETS)
def test_damage_is_refused_by_name_or_harmless(what, footage, command, tmp_path, monkeypatch):
    monkeypatch.chdir(footage)
    name, words = TARGETS[what]
    path = footage / name
    whole = path.read_bytes()
    rng = np.random.default_rng(sum(map(ord, what)))
    refused = 0
    try:
        for number in range(DAMAGES):
            path.write_bytes(damaged(whole, rng))
            output = tmp_path / str(number)
            outcome = command(*words, "-o", output, "-q", "-j1")
            assert outcome.code in (0, 1), outcome.err
            assert "fault of shadowtool's own" not in outcome.err
            assert not list(tmp_path.rglob("*.tmp"))
            if outcome.code == 1:
                refused += 1
                assert outcome.err.count("\n") == 1
                assert path.name in outcome.err or path.parent.name in outcome.err
                assert not (output / "shadowtool.json").exists()
    finally:
        path.write_bytes(whole)
    assert refused > 0


def test_a_damaged_movie_is_refused_by_name_or_gives_whole_frames(footage, command, tmp_path):
    av = pytest.importorskip("av")
    path = tmp_path / "take.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=24)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv444p"
        for number in range(4):
            picture = np.full((32, 48, 3), 40 * number, np.uint8)
            picture[::2] += 9
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    for number in range(20):
        path.write_bytes(damaged(whole, rng))
        output = tmp_path / str(number)
        outcome = command("capture", path, "-o", output, "-q")
        assert outcome.code in (0, 1), outcome.err
        assert "fault of shadowtool's own" not in outcome.err
        for frame in output.glob("*.exr"):
            assert read_image(frame).header.size[0] > 0


@pytest.mark.parametrize("name", ["plate", "matte", "scan", "composite", "capture"])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 7), (7, 1), (3, 5), (17, 2)])
def test_pictures_of_a_few_pixels(name, width, height, command, tmp_path):
    header = Header(width, height)
    rng = np.random.default_rng(width)
    for number in range(1001, 1005):
        values = rng.random((height, width, 4))
        for part, layer in (("take", "RGB"), ("fg", "RGBA"), ("beta", "Y")):
            folder = tmp_path / part
            folder.mkdir(exist_ok=True)
            own = {"RGB": values[..., :3], "RGBA": values, "Y": values[..., 0]}[layer]
            write_exr(folder / f"{part}.{number}.exr", {layer: own.astype(np.float16)}, header)
    plates = tmp_path / "plates"
    plates.mkdir()
    for plate, level in (("lit", 0.8), ("shadow", 0.2)):
        values = np.full((height, width, 3), level, np.float32)
        write_exr(plates / f"{plate}.exr", {"RGB": values}, header)
    write_png(tmp_path / "mask.png", np.full((height, width), 255, np.uint8))
    words = {
        "capture": ["capture", tmp_path / "take"],
        "plate": ["plate", tmp_path / "take"],
        "matte": ["matte", tmp_path / "take", "--plates", plates],
        "scan": ["scan", tmp_path / "take", "--plane", tmp_path / "mask.png"],
        "composite": ["composite", tmp_path, "--plates", plates],
    }
    outcome = command(*words[name], "-o", tmp_path / "out", "-q")
    assert outcome.code in (0, 1)
    assert "fault of shadowtool's own" not in outcome.err
    if name in ("capture", "matte", "composite"):
        assert outcome.code == 0, outcome.err


@pytest.mark.parametrize("name", ["capture", "plate", "matte", "apply", "composite"])
def test_a_take_of_one_frame(name, shot, command, tmp_path):
    outcome = command(*shot.arguments(name), "-o", tmp_path / "out", "-q", "--frames", "1003")
    assert outcome.code == 0, outcome.err
    assert "fault" not in outcome.err


@pytest.mark.parametrize("first", ["Y", "RGB"])
@pytest.mark.parametrize("name", ["capture", "plate", "matte"])
def test_a_take_that_changes_its_channels_half_way(name, first, command, shot, tmp_path):
    take = tmp_path / "take"
    take.mkdir()
    for number in range(1001, 1005):
        layer = first if number < 1003 else {"Y": "RGB", "RGB": "Y"}[first]
        values = np.full((32, 48, 3) if layer == "RGB" else (32, 48), 0.5, np.float16)
        write_exr(take / f"take.{number}.exr", {layer: values}, Header(48, 32))
    words = [name, take, *(["--plates", shot.plates] if name == "matte" else [])]
    outcome = command(*words, "-o", tmp_path / "out")
    assert outcome.code == 1
    assert "take.1003.exr: has " in outcome.err
    assert not (tmp_path / "out").exists()


def test_a_take_without_a_finite_pixel_is_refused_for_that(copied, command, tmp_path):
    copy = copied("photometric")
    for path in copy.glob("*.exr"):
        write_exr(path, {"RGB": np.full((32, 48, 3), np.nan, np.float16)}, Header(48, 32))
    for options in (["--estimator", "minmax"], []):
        outcome = command("plate", copy, "-o", tmp_path / "out", "--holdout", "none", *options)
        assert outcome.code == 1
        assert "every pixel of every frame is NaN or infinite" in outcome.err


@pytest.mark.parametrize("picture", ["plates/lit.exr", "matte/fg/fg.1003.exr", "scan1/scan.exr"])
def test_a_picture_of_another_step_is_no_map(picture, shot, command, tmp_path):
    words = ["warp", "--map", shot.folder / picture, "--apply", shot.matte / "beta"]
    outcome = command(*words, "-o", tmp_path / "out")
    assert outcome.code == 1
    assert Path(picture).name in outcome.err


def test_a_map_in_pixels_is_no_st_map(shot, command, tmp_path):
    y, x = np.mgrid[:32, :48].astype(np.float32)
    layers = {"RGB": np.dstack([x, y, 0 * x])}
    write_exr(tmp_path / "pixels.exr", layers, Header(48, 32))
    words = ["composite", shot.matte, "--plates", shot.plates, "--warp", tmp_path / "pixels.exr"]
    outcome = command(*words, "-o", tmp_path / "out")
    assert outcome.code == 1
    assert "pixels.exr: is no ST map" in outcome.err
