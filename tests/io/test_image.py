"""EXR and PNG: what is written comes back, and what is damaged is refused by name."""

import errno
import io
import os
import resource
import struct
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest

from shadowtool.core.half_floats import to_half
from shadowtool.core.transfer import TRANSFERS
from shadowtool.errors import DamagedFileError, InputError, RetryError
from shadowtool.io.files import fingerprint
from shadowtool.io.image import (
    Header,
    Image,
    _ZipLevel,
    decode,
    read_header,
    read_image,
    read_made,
    resolve_transfer,
    to_code,
    write_exr,
    write_png,
)
from tests.conftest import sum_of, write_sum

TIME_CODE = OpenEXR.TimeCode(1, 2, 3, 4, *[False] * 6, *[0] * 8)


def random(*shape: int, dtype: type = np.float32, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(dtype)


def raw_exr(path: Path, channels: dict[str, Any], **header: Any) -> Path:
    """Written by OpenEXR itself, whatever we would think of it."""
    basic = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**basic, **header}, dict(channels)).write(str(path))
    return path


def box(x: int, y: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def patched(path: Path, after: bytes, offset: int, value: bytes) -> Path:
    data = bytearray(path.read_bytes())
    at = data.index(after) + len(after) + offset
    data[at : at + len(value)] = value
    path.write_bytes(data)
    return path


def window_patched(path: Path, name: str, *corners: int) -> Path:
    return patched(path, name.encode() + b"\0box2i\0", 4, struct.pack("<4i", *corners))


@pytest.fixture
def exr(tmp_path: Path) -> Path:
    path = tmp_path / "frame.exr"
    write_exr(path, {"RGB": random(40, 30, 3)}, Header(30, 40))
    return path


@pytest.fixture
def png(tmp_path: Path) -> Path:
    path = tmp_path / "frame.png"
    write_png(path, (random(40, 30, 3) * 65535).astype(np.uint16))
    return path


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (5, 3), (17, 33), (64, 48)])
@pytest.mark.parametrize(
    ("name", "depth"), [("RGB", (3,)), ("RGBA", (4,)), ("Y", ()), ("time", ()), ("d.id", ())]
)
def test_pixels_come_back_bit_for_bit(dtype, size, name, depth, tmp_path):
    values = random(*size, *depth, dtype=dtype)
    values.flat[0] = np.nan
    write_exr(tmp_path / "a.exr", {name: values})
    image = read_image(tmp_path / "a.exr")
    assert list(image.layers) == [name]
    assert image.layers[name].dtype == dtype
    np.testing.assert_array_equal(image.layers[name], values)
    assert image.header.size == (size[1], size[0])


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_special_values_come_back(dtype, tmp_path):
    values = np.array([[np.nan, np.inf, -np.inf, -0.0, 6e-8, 65504, -65504, 1e-4]], dtype)
    write_exr(tmp_path / "a.exr", {"Y": values})
    back = read_image(tmp_path / "a.exr").layers["Y"]
    np.testing.assert_array_equal(back, values)
    assert np.signbit(back[0, 3])


def test_channels_of_different_types_keep_theirs(tmp_path):
    channels = {"Y": random(5, 4, dtype=np.float16), "confidence": random(5, 4)}
    write_exr(tmp_path / "a.exr", channels)
    layers = read_image(tmp_path / "a.exr").layers
    assert {name: values.dtype for name, values in layers.items()} == {
        "Y": np.float16,
        "confidence": np.float32,
    }
    for name, values in channels.items():
        np.testing.assert_array_equal(layers[name], values)


STRIDED = {
    "channels reversed": lambda a: a[..., ::-1],
    "rows reversed": lambda a: a[::-1],
    "columns cropped": lambda a: a[:, 3:-2],
    "every second row": lambda a: a[::2],
    "transposed": lambda a: a.transpose(1, 0, 2),
    "Fortran order": np.asfortranarray,
    "of a wider array": lambda a: np.dstack([a, a])[..., 1:4],
    "read only": lambda a: np.frombuffer(a.tobytes(), a.dtype).reshape(a.shape),
    "broadcast": lambda a: np.broadcast_to(a[:1], a.shape),
}


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("how", STRIDED)
def test_arrays_of_any_layout_are_written_right(how, dtype, tmp_path):
    values = STRIDED[how](random(16, 20, 3, dtype=dtype))
    write_exr(tmp_path / "a.exr", {"RGB": values, "Z": values[..., 0]})
    layers = read_image(tmp_path / "a.exr").layers
    np.testing.assert_array_equal(layers["RGB"], values)
    np.testing.assert_array_equal(layers["Z"], values[..., 0])


@pytest.mark.parametrize("dtype", [np.float64, np.uint8, np.uint16, np.int32, bool, ">f4"])
def test_types_that_exr_does_not_hold_are_refused(dtype, tmp_path):
    with pytest.raises(TypeError, match="not half or float"):
        write_exr(tmp_path / "a.exr", {"Y": np.zeros((2, 2), dtype)})
    assert not list(tmp_path.iterdir())


def test_what_is_given_to_be_written_is_not_changed(tmp_path):
    values = random(6, 5, 3)
    channels, provenance = {"RGB": values}, {"command": "x"}
    before = values.copy()
    header = Header(5, 6, (2, 3), 2.0, Fraction(24), TIME_CODE, {"old": "y"})
    write_exr(tmp_path / "a.exr", channels, header, provenance)
    assert list(channels) == ["RGB"]
    assert channels["RGB"] is values
    assert provenance == {"command": "x"}
    assert header == Header(5, 6, (2, 3), 2.0, Fraction(24), TIME_CODE, {"old": "y"})
    np.testing.assert_array_equal(values, before)


def test_what_was_read_does_not_change_with_the_file(exr):
    image = read_image(exr)
    before = image.layers["RGB"].copy()
    write_exr(exr, {"RGB": random(40, 30, 3, seed=9)})
    np.testing.assert_array_equal(image.layers["RGB"], before)


def test_the_same_picture_gives_the_same_bytes(tmp_path):
    for name in "ab":
        header = Header(30, 40, frame_rate=Fraction(24), time_code=TIME_CODE)
        channels = {"RGB": random(40, 30, 3), "Z": random(40, 30)}
        write_exr(tmp_path / f"{name}.exr", channels, header, {"version": "1", "command": "x"})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_the_same_picture_gives_the_same_bytes_in_another_process(tmp_path, exr):
    code = (
        "import sys, numpy as np; from pathlib import Path;"
        "from shadowtool.io.image import Header, write_exr;"
        "values = np.random.default_rng(0).random((40, 30, 3)).astype(np.float32);"
        "write_exr(Path(sys.argv[1]), {'RGB': values}, Header(30, 40))"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "b.exr"], check=True)
    assert (tmp_path / "b.exr").read_bytes() == exr.read_bytes()


def test_files_are_zip_compressed_scanlines(exr):
    with OpenEXR.File(str(exr)) as file:
        header = file.header()
        assert header["compression"] == OpenEXR.ZIP_COMPRESSION
        assert header["type"] == OpenEXR.scanlineimage


def test_a_quick_file_holds_the_same(tmp_path):
    values = np.tile(random(40, 16, 3), (1, 4, 1)).astype(np.float16)
    for name, quick in (("slow", False), ("quick", True), ("slow2", False), ("quick2", True)):
        write_exr(tmp_path / f"{name}.exr", {"RGB": values}, Header(64, 40), quick=quick)
    slow, slow2, quick, quick2 = (
        (tmp_path / f"{name}.exr").read_bytes() for name in ("slow", "slow2", "quick", "quick2")
    )
    assert slow == slow2 and quick == quick2
    assert slow != quick
    test_files_are_zip_compressed_scanlines(tmp_path / "quick.exr")
    np.testing.assert_array_equal(read_image(tmp_path / "quick.exr").layers["RGB"], values)


@pytest.mark.parametrize(
    "channels",
    [
        {"A": (6, 7), "B": (6, 5)},
        {"A": (6, 7), "B": (1, 7)},
        {"A": (6, 7), "B": (6, 1)},
        {"RGB": (6, 7, 4)},
        {"RGBA": (6, 7, 3)},
        {"Y": (6, 7, 3)},
        {"Y": (6,)},
    ],
)
def test_channels_of_other_shapes_are_not_written(channels, tmp_path):
    arrays = {name: np.ones(shape, np.float16) for name, shape in channels.items()}
    with pytest.raises((TypeError, ValueError)):
        write_exr(tmp_path / "a.exr", arrays)
    assert not list(tmp_path.iterdir())


def test_quick_and_other_writers_do_not_mix(tmp_path):
    values = np.tile(random(100, 40, 3), (1, 4, 1)).astype(np.float16)

    def write(number):
        path = tmp_path / f"{number}.exr"
        write_exr(path, {"RGB": values}, quick=number % 3 == 0)
        return path.stat().st_size

    alone = [write(number) for number in (0, 1)]
    with ThreadPoolExecutor(4) as pool:
        sizes = list(pool.map(write, range(24)))
    assert sizes == [alone[number % 3 != 0] for number in range(24)]


def test_quick_files_are_written_where_openexr_hides_the_setting(tmp_path, monkeypatch):
    def hidden(name):
        raise OSError

    monkeypatch.setattr("ctypes.CDLL", hidden)
    # What it then takes the setting for must not outlive the test.
    monkeypatch.setattr("shadowtool.io.image._zip_level", _ZipLevel())
    values = random(40, 30, 3)
    for quick in (True, False):
        write_exr(tmp_path / "a.exr", {"RGB": values}, quick=quick)
        np.testing.assert_array_equal(read_image(tmp_path / "a.exr").layers["RGB"], values)


def test_the_fingerprint_is_the_files(exr):
    assert read_image(exr).fingerprint == fingerprint(exr.read_bytes())


@pytest.mark.parametrize(
    ("rate", "aspect", "origin", "code"),
    [
        (Fraction(24), 1.0, (0, 0), None),
        (Fraction(24000, 1001), 2.0, (10, 20), TIME_CODE),
        (None, 0.5, (-16, -9), TIME_CODE),
    ],
)
def test_a_header_survives_rewriting(rate, aspect, origin, code, tmp_path):
    first = Header(5, 4, origin, aspect, rate, code)
    write_exr(tmp_path / "a.exr", {"RGB": random(4, 5, 3)}, first)
    read = read_image(tmp_path / "a.exr").header
    write_exr(tmp_path / "b.exr", {"RGB": random(4, 5, 3)}, read)
    for header in (read, read_header(tmp_path / "a.exr"), read_header(tmp_path / "b.exr")):
        assert header.frame_rate == rate
        assert header.pixel_aspect == aspect
        assert header.origin == origin
        assert header.size == (5, 4)
        assert str(header.time_code) == str(code)
    with OpenEXR.File(str(tmp_path / "b.exr")) as file:
        assert file.header().get("framesPerSecond") == rate
        np.testing.assert_array_equal(file.header()["displayWindow"][0], origin)
        np.testing.assert_array_equal(file.header()["dataWindow"][0], origin)


def test_provenance_comes_back_in_any_language(tmp_path):
    texts = {"version": "1", "command": "shadowtool matte β größe '\"\n", "figures": "{}"}
    write_exr(tmp_path / "a.exr", {"Y": random(2, 2)}, None, texts)
    assert read_image(tmp_path / "a.exr").header.provenance == texts
    assert read_header(tmp_path / "a.exr").provenance == texts


def test_a_data_window_inside_the_display_window_is_surrounded_by_black(tmp_path):
    values = 1 + random(3, 4, 3)
    path = raw_exr(
        tmp_path / "a.exr",
        {"RGB": values},
        displayWindow=box(0, 0, 10, 8),
        dataWindow=box(5, 2, 4, 3),
    )
    image = read_image(path)
    expected = np.zeros((8, 10, 3), np.float32)
    expected[2:5, 5:9] = values
    np.testing.assert_array_equal(image.layers["RGB"], expected)
    assert image.header.size == (10, 8)


def test_overscan_is_cut_off(tmp_path):
    values = random(12, 14, 3)
    path = raw_exr(
        tmp_path / "a.exr",
        {"RGB": values},
        displayWindow=box(3, 4, 10, 8),
        dataWindow=box(1, 2, 14, 12),
    )
    image = read_image(path)
    np.testing.assert_array_equal(image.layers["RGB"], values[2:10, 2:12])
    assert image.header.origin == (3, 4)


@pytest.mark.parametrize(
    ("x", "y"),
    [(-2, -1), (8, 6), (-2, 6), (8, -1), (0, -3), (10, 0), (-4, 0), (50, 60), (-50, -60)],
)
def test_a_data_window_across_the_edge_lands_where_it_should(x, y, tmp_path):
    values = 1 + random(3, 4)
    path = raw_exr(
        tmp_path / "a.exr",
        {"Y": values},
        displayWindow=box(0, 0, 10, 8),
        dataWindow=box(x, y, 4, 3),
    )
    expected = np.zeros((8, 10), np.float32)
    for row in range(3):
        for column in range(4):
            if 0 <= y + row < 8 and 0 <= x + column < 10:
                expected[y + row, x + column] = values[row, column]
    np.testing.assert_array_equal(read_image(path).layers["Y"], expected)


@pytest.mark.parametrize("kept", [0, 1, 4, 8, 100, 300, 0.5, 0.9, -4, -1])
def test_a_truncated_exr_is_damaged(kept, exr):
    data = exr.read_bytes()
    end = int(kept * len(data)) if 0 < kept < 1 else kept
    exr.write_bytes(data[:end])
    with pytest.raises(DamagedFileError, match=r"frame\.exr: .*; write the frame again"):
        read_image(exr)


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "DWAA"])
def test_other_programs_compressions_are_read_and_their_truncation_noticed(compression, tmp_path):
    values = np.full((40, 30, 3), 0.5, np.float16)
    values[20:] = random(20, 30, 3, dtype=np.float16)
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    path = raw_exr(tmp_path / "a.exr", {"RGB": values}, compression=kind)
    np.testing.assert_allclose(read_image(path).layers["RGB"], values, atol=0.2)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(DamagedFileError, match=r"a\.exr"):
        read_image(path)


def test_tiles_are_read(tmp_path):
    values = random(40, 30, 3)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    path = raw_exr(tmp_path / "a.exr", {"RGB": values}, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_array_equal(read_image(path).layers["RGB"], values)


@pytest.mark.parametrize(
    "content", [b"", b"hello, this is text\n" * 50, b"\x89PNG\r\n\x1a\n", bytes(999)]
)
@pytest.mark.parametrize("read", [read_image, read_header])
def test_what_is_no_exr_is_damaged(content, read, tmp_path):
    path = tmp_path / "frame.exr"
    path.write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"frame\.exr: "):
        read(path)


@pytest.mark.parametrize("compression", ["ZIP", "PIZ"])
@pytest.mark.parametrize("after", [0, 1])
def test_a_machine_that_fails_while_a_picture_is_decoded_is_worth_a_retry(
    after, compression, tmp_path, monkeypatch
):
    """Whether it is read at once or block by block."""
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    raw_exr(tmp_path / "large.exr", {"RGB": random(300, 400, 3)}, compression=kind)

    class Failing(io.FileIO):
        blocks = 0

        def readinto(self, buffer):
            self.blocks += 1
            if self.blocks > after:
                raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
            return super().readinto(buffer)

    def failing(path):
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    monkeypatch.setattr("io.FileIO", Failing)
    monkeypatch.setattr(Path, "read_bytes", failing)
    with pytest.raises(RetryError, match=r"large\.exr: cannot read: Stale"):
        read_image(tmp_path / "large.exr")


def test_a_png_named_exr_is_damaged(png, tmp_path):
    png.rename(tmp_path / "b.exr")
    with pytest.raises(DamagedFileError, match=r"b\.exr"):
        read_image(tmp_path / "b.exr")


def test_an_exr_named_png_is_damaged(exr, tmp_path):
    exr.rename(tmp_path / "b.png")
    for read in (read_image, read_header):
        with pytest.raises(DamagedFileError, match=r"b\.png"):
            read(tmp_path / "b.png")


def test_a_flipped_bit_in_zip_data_is_damage(exr):
    # Noise would be stored as it is, without a checksum.
    write_exr(exr, {"RGB": np.round(random(40, 30, 3), 1).astype(np.float16)})
    data = exr.read_bytes()
    for at in np.linspace(len(data) // 2, len(data) - 50, 12).astype(int):
        spoiled = bytearray(data)
        spoiled[at] ^= 0x10
        exr.write_bytes(spoiled)
        with pytest.raises(DamagedFileError, match=r"frame\.exr"):
            read_image(exr)


@pytest.mark.parametrize(
    ("after", "offset", "junk"),
    [
        (b"channels\0chlist\0", 4, b"\xff\xfe"),
        (b"compression\0compression\0", 4, b"\xc8"),
        (b"compression\0", 0, b"\xff\xfe\xfd"),
        (b"dataWindow\0", 0, b"\xff\xff\xff\xff"),
        (b"lineOrder\0lineOrder\0", 4, b"\x77"),
        (b"framesPerSecond\0rational\0", 8, b"\0\0\0\0"),
        (b"shadowtool.command\0string\0", 4, b"\xff\xfe"),
        (b"shadowtool.command\0string\0", 0, b"\xff\xff\xff\x7f"),
        (b"pixelAspectRatio\0float\0", 0, b"\xff\xff\xff\xff"),
    ],
)
@pytest.mark.parametrize("read", [read_image, read_header])
def test_junk_in_the_header_is_damage_or_does_no_harm(after, offset, junk, read, tmp_path):
    path = tmp_path / "frame.exr"
    header = Header(30, 40, frame_rate=Fraction(24))
    write_exr(path, {"RGB": random(40, 30, 3)}, header, {"command": "x y z"})
    patched(path, after, offset, junk)
    try:
        read(path)
    except InputError as error:
        assert str(path) in str(error)


@pytest.mark.parametrize("seed", range(4))
def test_no_byte_of_junk_in_a_header_gets_through_as_another_error(seed, tmp_path, capfd):
    path = tmp_path / "frame.exr"
    header = Header(30, 20, frame_rate=Fraction(24))
    write_exr(path, {"RGB": random(20, 30, 3)}, header, {"version": "1", "command": "x y"})
    data = path.read_bytes()
    rng = np.random.default_rng(seed)
    for _ in range(300):
        spoiled = bytearray(data)
        for at in rng.integers(4, 500, rng.integers(1, 5)):
            spoiled[at] = rng.choice([0, 128, 255, rng.integers(256)])
        path.write_bytes(spoiled)
        for read in (read_header, read_image):
            try:
                read(path)
            except InputError as error:
                assert "frame.exr" in str(error)
    capfd.readouterr()


@pytest.mark.parametrize("value", [b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\0\0\0\0", b"\0\0\x80\xbf"])
def test_an_impossible_pixel_aspect_is_damage(value, exr):
    patched(exr, b"pixelAspectRatio\0float\0", 4, value)
    with pytest.raises(DamagedFileError, match=r"frame\.exr"):
        read_image(exr)


@pytest.mark.parametrize("window", ["dataWindow", "displayWindow"])
@pytest.mark.parametrize(
    "corners",
    [(0, 0, 99_999, 99_999), (0, 0, 2**31 - 2, 2**31 - 2), (-(2**30), 0, 2**30, 10), (5, 5, 1, 1)],
)
@pytest.mark.parametrize("read", [read_image, read_header])
def test_a_header_with_an_impossible_window_is_refused(window, corners, read, exr):
    window_patched(exr, window, *corners)
    with pytest.raises(InputError, match=r"frame\.exr"):
        read(exr)


@pytest.mark.parametrize("corners", [(0, 0, 99_999, 99_999), (0, 0, 16_000, 16_000)])
def test_a_small_file_that_claims_a_huge_picture_asks_for_no_memory(corners, exr):
    window_patched(window_patched(exr, "dataWindow", *corners), "displayWindow", *corners)
    code = (
        "import re, sys; from pathlib import Path;"
        "from shadowtool.io.image import read_image; from shadowtool.errors import InputError\n"
        "try: read_image(Path(sys.argv[1]))\n"
        "except InputError:\n"
        "    status = Path('/proc/self/status').read_text()\n"
        "    print(re.search(r'VmHWM:\\s+(\\d+)', status)[1], end='')"
    )
    program = [sys.executable, "-c", code, str(exr)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    used = int(done.stdout.split()[-1]) * 1024
    assert used < 400e6


@pytest.mark.parametrize("corners", [(0, 0, 99_999, 0), (0, 0, 0, 99_999)])
def test_a_display_window_beyond_the_data_is_only_as_large_as_it_says(corners, exr):
    window_patched(exr, "displayWindow", *corners)
    image = read_image(exr)
    assert image.layers["RGB"].shape == (corners[3] + 1, corners[2] + 1, 3)


def multi_part(path: Path) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [
        OpenEXR.Part({**header}, {"RGB": random(40, 30, 3, seed=seed)}, f"part{seed}")
        for seed in range(3)
    ]
    OpenEXR.File(parts).write(str(path))
    return path


def test_of_many_parts_the_first_is_taken_and_said_so(tmp_path, caplog):
    image = read_image(multi_part(tmp_path / "a.exr"))
    np.testing.assert_array_equal(image.layers["RGB"], random(40, 30, 3, seed=0))
    assert "of 3 parts the first is taken" in caplog.text


@pytest.mark.parametrize("part", [0.97, 0.7, 0.5, 0.3, 0.1])
def test_a_truncated_multi_part_file_is_damaged(part, tmp_path):
    path = multi_part(tmp_path / "frame.exr")
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(DamagedFileError, match=r"frame\.exr"):
        read_image(path)


def test_luminance_and_chroma_are_refused_by_name(tmp_path):
    chroma = OpenEXR.Channel(random(4, 4, dtype=np.float16), 2, 2)
    also = OpenEXR.Channel(random(4, 4, dtype=np.float16), 2, 2)
    path = raw_exr(
        tmp_path / "a.exr", {"Y": random(4, 4, dtype=np.float16), "RY": chroma, "BY": also}
    )
    for read in (read_header, read_image):
        with pytest.raises(InputError, match=r"a\.exr: a luminance/chroma EXR; convert"):
            read(path)


def test_subsampled_channels_are_refused_by_name(tmp_path):
    half = OpenEXR.Channel(random(4, 4), 2, 2)
    path = raw_exr(tmp_path / "a.exr", {"Y": random(4, 4), "Z": half})
    with pytest.raises(InputError, match=r"a\.exr: channel Z is subsampled"):
        read_image(path)


def test_deep_pictures_are_refused_by_name(tmp_path):
    pixels = np.empty((4, 5), dtype=object)
    for index in np.ndindex(4, 5):
        pixels[index] = np.array([0.5, 0.25], np.float32)
    path = raw_exr(
        tmp_path / "a.exr",
        {"Z": pixels},
        type=OpenEXR.deepscanline,
        compression=OpenEXR.ZIPS_COMPRESSION,
    )
    for read in (read_header, read_image):
        with pytest.raises(InputError, match=r"a\.exr: a deep EXR; flatten it first"):
            read(path)


def test_colour_channels_of_different_types_are_read(tmp_path):
    channels = {"R": random(4, 5, dtype=np.float16), "G": random(4, 5), "B": random(4, 5)}
    image = read_image(raw_exr(tmp_path / "a.exr", channels))
    np.testing.assert_array_equal(image.rgb()[..., 1], channels["G"])
    np.testing.assert_array_equal(image.plane("R"), channels["R"].astype(np.float32))


@pytest.mark.parametrize("types", ["eff", "eee", "fff", "III"])
@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("transfer", ["auto", "srgb"])
def test_colours_are_those_of_rgb(types, alpha, transfer, tmp_path):
    channels = {n: (9 * random(4, 5)).astype(t) for n, t in zip("RGB", types, strict=True)}
    if alpha:
        channels["A"] = random(4, 5, dtype=np.float16)
    window = {"dataWindow": box(2, 1, 5, 4), "displayWindow": box(0, 0, 6, 7)}
    image = read_image(raw_exr(tmp_path / "a.exr", channels, **window))
    np.testing.assert_array_equal(np.stack(image.colours(transfer), axis=-1), image.rgb(transfer))


def test_colours_of_other_pictures_are_those_of_rgb(tmp_path, png):
    grey = raw_exr(tmp_path / "y.exr", {"Y": random(4, 5)})
    layer = raw_exr(tmp_path / "d.exr", {f"diffuse.{c}": random(4, 5) for c in "RGB"})
    for path in (grey, layer, png):
        image = read_image(path)
        np.testing.assert_array_equal(np.stack(image.colours(), axis=-1), image.rgb())


@pytest.mark.parametrize("types", ["eff", "eee", "fff", "III"])
@pytest.mark.parametrize("compression", ["ZIP", "PIZ"])
@pytest.mark.parametrize("transfer", ["auto", "srgb"])
@pytest.mark.parametrize("display", [(0, 0, 6, 7), (2, 1, 5, 4)])
def test_what_is_made_of_colours_is_made_of_those_of_the_picture(
    types, compression, transfer, display, tmp_path
):
    channels = {n: (9 * random(4, 5)).astype(t) for n, t in zip("RGB", types, strict=True)}
    window = {"dataWindow": box(2, 1, 5, 4), "displayWindow": box(*display)}
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    path = raw_exr(tmp_path / "a.exr", channels, compression=kind, **window)
    image = read_image(path)
    header, values, mark = read_made(path, write_sum, transfer)
    np.testing.assert_array_equal(values, sum_of(*image.colours(transfer)))
    assert (header, mark) == (image.header, image.fingerprint)


def test_of_other_pictures_the_same_is_made(tmp_path, png):
    grey = raw_exr(tmp_path / "y.exr", {"Y": random(4, 5)})
    layer = raw_exr(tmp_path / "d.exr", {f"diffuse.{c}": random(4, 5) for c in "RGB"})
    for path in (grey, layer, png):
        image = read_image(path)
        header, values, mark = read_made(path, write_sum)
        np.testing.assert_array_equal(values, sum_of(*image.colours()))
        assert (header, mark) == (image.header, image.fingerprint)


def test_of_what_has_no_colour_nothing_is_made(tmp_path):
    with pytest.raises(InputError, match="no R, G, B"):
        read_made(raw_exr(tmp_path / "a.exr", {"U": random(4, 5), "V": random(4, 5)}), write_sum)


@pytest.mark.parametrize("names", ["RG", "UV", "AB", "X", "NYX"])
def test_channels_without_a_picture_are_read_one_by_one(names, tmp_path):
    channels = {name: random(4, 5, seed=ord(name)) for name in names}
    image = read_image(raw_exr(tmp_path / "a.exr", channels))
    for name, values in channels.items():
        np.testing.assert_array_equal(image.plane(name), values)


def test_integer_channels_are_read_or_refused_by_name(tmp_path):
    path = raw_exr(tmp_path / "a.exr", {"RGB": random(4, 5, 3), "id": np.ones((4, 5), np.uint32)})
    image = read_image(path)
    np.testing.assert_array_equal(image.rgb(), random(4, 5, 3))
    np.testing.assert_array_equal(image.plane("id"), 1)


def test_a_single_channel_stands_for_grey(tmp_path):
    values = random(4, 5)
    image = read_image(raw_exr(tmp_path / "a.exr", {"Y": values}))
    np.testing.assert_array_equal(image.rgb(), np.repeat(values[..., None], 3, axis=-1))


def test_a_layer_is_taken_when_there_is_no_plain_colour_and_said_so(tmp_path, caplog):
    values = random(4, 5, 3)
    channels = {f"diffuse.{c}": values[..., i].copy() for i, c in enumerate("RGB")}
    image = read_image(raw_exr(tmp_path / "a.exr", {**channels, "Z": random(4, 5)}))
    np.testing.assert_array_equal(image.rgb(), values)
    assert "the layer diffuse is taken" in caplog.text


@pytest.mark.parametrize("what", ["layer", "part"])
def test_what_is_taken_of_all_frames_is_said_once(what, tmp_path, caplog):
    paths = [tmp_path / f"shot2.{number:04}.exr" for number in range(95, 105)]
    for path in paths:
        if what == "part":
            multi_part(path)
        else:
            layers = {f"diffuse.{c}": random(4, 5) for c in "RGB"} | {"Z": random(4, 5)}
            raw_exr(path, layers)
    with ThreadPoolExecutor(4) as pool:
        for image in pool.map(read_image, paths):
            image.rgb()
    (record,) = caplog.records
    assert record.getMessage().startswith(f"{tmp_path / 'shot2.####.exr'}: ")


def test_layers_are_written_as_they_are_read(tmp_path):
    layers = {"diffuse": random(4, 5, 3), "glow": random(4, 5, 4), "RGB": random(4, 5, 3)}
    layers["Z"] = random(4, 5)
    write_exr(tmp_path / "a.exr", layers)
    found = read_image(tmp_path / "a.exr").layers
    assert found.keys() == layers.keys()
    for name, values in layers.items():
        np.testing.assert_array_equal(found[name], values)
    with pytest.raises(TypeError, match="motion"):
        write_exr(tmp_path / "b.exr", {"motion": random(4, 5, 2)})


def test_two_layers_without_plain_colour_are_refused_with_both_named(tmp_path):
    channels = {f"{layer}.{c}": random(4, 5) for layer in ("diffuse", "specular") for c in "RGB"}
    image = read_image(raw_exr(tmp_path / "a.exr", channels))
    with pytest.raises(InputError, match=r"a\.exr: has no R, G, B, only diffuse, specular"):
        image.rgb()


def test_a_plane_is_the_first_of_the_wanted_channels(tmp_path):
    channels = {"RGBA": random(4, 5, 4), "Y": random(4, 5, seed=1)}
    write_exr(tmp_path / "a.exr", channels)
    image = read_image(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.plane("Y", "A"), channels["Y"])
    np.testing.assert_array_equal(image.plane("A", "Y"), channels["RGBA"][..., 3])
    np.testing.assert_array_equal(image.plane("G"), channels["RGBA"][..., 1])


def test_a_plane_that_is_not_there_is_refused_with_the_others_named(tmp_path):
    write_exr(tmp_path / "a.exr", {"Y": random(4, 5), "confidence": random(4, 5)})
    with pytest.raises(InputError, match=r"a\.exr: has no channel A or Z, only Y, confidence"):
        read_image(tmp_path / "a.exr").plane("A", "Z")


@pytest.mark.parametrize("opaque", [False, True])
def test_grey_in_three_channels_is_a_plane(opaque, tmp_path):
    grey = np.repeat((random(4, 5) * 255).astype(np.uint8)[..., np.newaxis], 3, axis=-1)
    alpha = np.full_like(grey[..., :1], 255)
    values = np.dstack([grey, alpha]) if opaque else grey
    write_png(tmp_path / "a.png", values)
    write_exr(tmp_path / "a.exr", {"RGBA" if opaque else "RGB": (values / 255).astype(np.float32)})
    for suffix in ("png", "exr"):
        found = read_image(tmp_path / f"a.{suffix}").plane("A", "Y")
        np.testing.assert_allclose(found, grey[..., 0] / 255, atol=1e-6)


def test_colour_is_no_plane(png):
    with pytest.raises(InputError, match=r"\.png: is coloured; give one channel"):
        read_image(png).plane("A", "Y")


@pytest.mark.parametrize("value", [0, np.nan, 1])
def test_a_matte_stays_the_alpha_in_every_frame(value, tmp_path):
    """Nothing to be seen yet, a bad pixel, or nothing else: colour never stands in for it."""
    rgba = random(4, 5, 4)
    if value == 1:
        rgba[..., 3] = 1
    elif value == 0:
        rgba[..., 3] = 0
    else:
        rgba[1, 2, 3] = value
    write_exr(tmp_path / "a.exr", {"RGBA": rgba})
    found = read_image(tmp_path / "a.exr").plane("A", "Y")
    np.testing.assert_array_equal(found, rgba[..., 3])


def test_integer_planes_are_scaled_and_not_decoded(tmp_path):
    write_png(tmp_path / "a.png", np.array([[0, 51, 255]], np.uint8))
    plane = read_image(tmp_path / "a.png").plane("Y")
    np.testing.assert_allclose(plane, [[0, 0.2, 1]], atol=1e-7)
    assert plane.dtype == np.float32


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(("depth", "layer"), [((), "Y"), ((3,), "RGB"), ((4,), "RGBA")])
@pytest.mark.parametrize("size", [(1, 1), (7, 5), (33, 64)])
def test_png_code_values_come_back(dtype, depth, layer, size, tmp_path):
    values = (random(*size, *depth) * np.iinfo(dtype).max).astype(dtype)
    before = values.copy()
    write_png(tmp_path / "a.png", values)
    image = read_image(tmp_path / "a.png")
    assert list(image.layers) == [layer]
    assert image.layers[layer].dtype == dtype
    np.testing.assert_array_equal(image.layers[layer], values)
    np.testing.assert_array_equal(values, before)
    assert image.header.size == read_header(tmp_path / "a.png").size == (size[1], size[0])


@pytest.mark.parametrize("how", ["channels reversed", "columns cropped", "transposed"])
def test_png_arrays_of_any_layout_are_written_right(how, tmp_path):
    values = STRIDED[how]((random(16, 20, 3) * 65535).astype(np.uint16))
    write_png(tmp_path / "a.png", values)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png").layers["RGB"], values)


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.int32, bool])
def test_types_that_png_does_not_hold_are_refused(dtype, tmp_path):
    with pytest.raises(TypeError, match="8 or 16 bits"):
        write_png(tmp_path / "a.png", np.zeros((2, 2), dtype))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_grainy_png_is_the_same_picture_in_hardly_more_room(dtype, tmp_path):
    values = np.random.default_rng(1).normal(90, 5, (60, 80, 3)).astype(dtype)
    for grainy in (False, True):
        write_png(tmp_path / f"{grainy}.png", values, {"command": "a"}, grainy)
        image = read_image(tmp_path / f"{grainy}.png")
        np.testing.assert_array_equal(image.layers["RGB"], values)
        assert image.header.provenance == {"command": "a"}
    plain, grainy = ((tmp_path / f"{name}.png").stat().st_size for name in (False, True))
    assert grainy < 1.05 * plain


def test_png_provenance_comes_back(tmp_path):
    texts = {"version": "0.1", "command": "shadowtool matte größe", "figures": '{"a": 1}'}
    write_png(tmp_path / "a.png", np.zeros((2, 2), np.uint8), texts)
    assert read_image(tmp_path / "a.png").header.provenance == texts
    assert read_header(tmp_path / "a.png").provenance == texts


def test_png_provenance_comes_back_in_any_language(tmp_path):
    texts = {"command": "shadowtool matte β 影"}
    write_png(tmp_path / "a.png", np.zeros((2, 2), np.uint8), texts)
    assert read_image(tmp_path / "a.png").header.provenance == texts


def test_png_provenance_is_text_that_other_programs_read(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((2, 2), np.uint8), {"version": "0.1"})
    data = (tmp_path / "a.png").read_bytes()
    content = b"shadowtool.version\x000.1"
    chunk = struct.pack(">I", len(content)) + b"tEXt" + content
    assert chunk + struct.pack(">I", zlib.crc32(b"tEXt" + content)) in data
    assert cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED).shape == (2, 2)


def test_the_same_png_gives_the_same_bytes(tmp_path, png):
    write_png(tmp_path / "b.png", (random(40, 30, 3) * 65535).astype(np.uint16))
    assert png.read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("kept", [0, 1, 8, 20, 32, 40, 0.3, 0.9, -12, -8, -1])
def test_a_truncated_png_is_damaged(kept, png, capfd):
    data = png.read_bytes()
    png.write_bytes(data[: int(kept * len(data)) if 0 < kept < 1 else kept])
    with pytest.raises(DamagedFileError, match=r"frame\.png: .*; write the frame again"):
        read_image(png)
    capfd.readouterr()


def test_a_flipped_bit_in_a_png_is_damage(png, capfd):
    data = png.read_bytes()
    for at in np.linspace(100, len(data) - 20, 12).astype(int):
        spoiled = bytearray(data)
        spoiled[at] ^= 0x10
        png.write_bytes(spoiled)
        with pytest.raises(DamagedFileError, match=r"frame\.png"):
            read_image(png)
    capfd.readouterr()


@pytest.mark.parametrize("size", [(0, 5), (1 << 20, 1 << 20), (2**31 - 1, 2**31 - 1)])
@pytest.mark.parametrize("read", [read_image, read_header])
def test_a_png_of_an_impossible_size_is_refused(size, read, png):
    data = bytearray(png.read_bytes())
    data[16:24] = struct.pack(">II", *size)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    png.write_bytes(data)
    with pytest.raises(InputError, match=r"frame\.png: claims"):
        read(png)


def test_a_png_followed_by_other_bytes_is_whole(png):
    before = read_image(png).layers["RGB"]
    png.write_bytes(png.read_bytes() + b"trailer of some camera")
    np.testing.assert_array_equal(read_image(png).layers["RGB"], before)


@pytest.mark.parametrize("read", [read_image, read_header])
@pytest.mark.parametrize("name", ["gone.exr", "gone.png"])
def test_what_is_not_there_is_named(read, name, tmp_path):
    with pytest.raises(InputError, match=f"{name}: no such file"):
        read(tmp_path / name)


@pytest.mark.parametrize("read", [read_image, read_header])
@pytest.mark.parametrize("name", ["folder.exr", "folder.png"])
def test_a_folder_is_no_picture(read, name, tmp_path):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=f"{name}: cannot read"):
        read(tmp_path / name)


def test_kinds_are_told_by_suffix_whatever_its_case(tmp_path, png, exr):
    png.rename(tmp_path / "b.PNG")
    exr.rename(tmp_path / "b.EXR")
    assert read_image(tmp_path / "b.PNG").layers["RGB"].dtype == np.uint16
    assert read_image(tmp_path / "b.EXR").layers["RGB"].dtype == np.float32


@pytest.mark.parametrize(
    ("given", "name", "result"),
    [
        ("auto", "a.exr", "linear"),
        ("auto", "a.png", "srgb"),
        ("auto", "a.PNG", "srgb"),
        ("none", "a.png", "none"),
        ("rec709", "a.exr", "rec709"),
        ("linear", "a.png", "linear"),
    ],
)
def test_auto_goes_by_the_kind_of_file_and_a_named_transfer_wins(given, name, result):
    assert resolve_transfer(given, Path(name)) == result


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("transfer", ["srgb", "rec709", "linear", "none"])
def test_code_values_are_decoded_as_their_float_value_would_be(dtype, transfer):
    top = np.iinfo(dtype).max
    codes = np.unique(np.linspace(0, top, 500).astype(dtype))
    exact = TRANSFERS[transfer].decode(codes / np.float64(top))
    decoded = decode(codes, transfer)
    np.testing.assert_allclose(decoded, exact, rtol=1e-5, atol=1e-7)
    assert decoded[0] == 0
    assert decoded[-1] == 1


def test_srgb_pngs_are_decoded_and_an_override_is_obeyed(tmp_path):
    write_png(tmp_path / "a.png", np.full((2, 2, 3), 128, np.uint8))
    image = read_image(tmp_path / "a.png")
    np.testing.assert_allclose(image.rgb(), 0.21586, atol=1e-5)
    np.testing.assert_allclose(image.rgb("none"), 128 / 255, atol=1e-7)
    np.testing.assert_allclose(image.rgb("rec709"), 0.2616, atol=2e-4)


def test_linear_halfs_are_passed_on_as_they_are(tmp_path):
    values = random(4, 5, 3, dtype=np.float16)
    write_exr(tmp_path / "a.exr", {"RGB": values})
    read = read_image(tmp_path / "a.exr").rgb()
    assert read.dtype == np.float16
    np.testing.assert_array_equal(read, values)


def test_an_encoded_exr_can_be_decoded(tmp_path):
    write_exr(tmp_path / "a.exr", {"RGB": np.full((1, 1, 3), 0.5, np.float16)})
    rgb = read_image(tmp_path / "a.exr").rgb("srgb")
    np.testing.assert_allclose(rgb, 0.21404, atol=1e-5)
    assert rgb.dtype == np.float32


def test_exr_colour_is_premultiplied_already(tmp_path):
    rgba = random(4, 5, 4)
    write_exr(tmp_path / "a.exr", {"RGBA": rgba})
    colour, alpha = read_image(tmp_path / "a.exr").rgba()
    np.testing.assert_array_equal(colour, rgba[..., :3])
    np.testing.assert_array_equal(alpha, rgba[..., 3])


def test_png_colour_is_multiplied_by_alpha_in_linear_light(tmp_path):
    write_png(tmp_path / "a.png", np.array([[[255, 128, 0, 51]]], np.uint8))
    colour, alpha = read_image(tmp_path / "a.png").rgba()
    np.testing.assert_allclose(alpha, 0.2, atol=1e-7)
    np.testing.assert_allclose(colour[0, 0], [0.2, 0.2 * 0.21586, 0], atol=1e-5)


def test_a_picture_without_alpha_is_refused_as_a_figure(exr):
    with pytest.raises(InputError, match=r"frame\.exr: has no alpha channel"):
        read_image(exr).rgba()


def test_halfs_are_clipped_and_rounded_and_nan_stays():
    values = np.array([0.1, 1e6, -1e6, np.inf, np.nan, 65519.0, 1e-9], np.float32)
    half = to_half(values)
    assert half.dtype == np.float16
    np.testing.assert_array_equal(
        half, np.array([0.1, 65504, -65504, 65504, np.nan, 65504, 0], np.float16)
    )


def test_code_values_are_rounded_clipped_and_free_of_nan():
    linear = np.array([0, 1, 2, -1, np.nan, 0.21404114, np.inf], np.float32)
    np.testing.assert_array_equal(to_code(linear), [0, 65535, 65535, 0, 0, 32768, 65535])


def test_sixteen_bit_code_values_survive_decoding_and_encoding():
    codes = np.arange(0, 65536, 7, np.uint16)
    np.testing.assert_array_equal(to_code(decode(codes, "srgb")), codes)


def test_pictures_of_many_threads_do_not_mix(tmp_path):
    from concurrent.futures import ThreadPoolExecutor

    def there_and_back(seed: int) -> bool:
        values = random(60, 50, 3, seed=seed)
        write_exr(tmp_path / f"{seed}.exr", {"RGB": values})
        return bool((read_image(tmp_path / f"{seed}.exr").layers["RGB"] == values).all())

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(there_and_back, range(24)))


def test_files_are_closed_after_reading(exr, png):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))
    try:
        for _ in range(100):
            read_header(exr), read_image(exr), read_header(png), read_image(png)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_an_image_keeps_where_it_came_from(exr):
    image = read_image(exr)
    assert isinstance(image, Image)
    assert image.path == exr
    assert io.BytesIO(exr.read_bytes()).getbuffer().nbytes == image.stored
