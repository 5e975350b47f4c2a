"""EXR scanlines decoded and encoded here: as OpenEXR does it, or not at all."""

import contextlib
import os
import struct
import tracemalloc
import zlib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.errors import ShadowtoolError
from shadowtool.io import scanlines
from shadowtool.io.image import Header, encode_exr, read_image
from shadowtool.io.openexr_core import deflating, inflating
from tests.conftest import sum_of, write_sum

_zip = scanlines._zip
pytestmark = pytest.mark.skipif(_zip is None, reason="it was installed without a compiler")

KINDS = {"e": np.float16, "f": np.float32, "I": np.uint32}
NONE, ZIPS, ZIP = OpenEXR.NO_COMPRESSION, OpenEXR.ZIPS_COMPRESSION, OpenEXR.ZIP_COMPRESSION


def encoded(path: Path, channels: dict[str, Any], **header: Any) -> bytes:
    basic = {"compression": ZIP, "type": OpenEXR.scanlineimage}
    OpenEXR.File({**basic, **header}, dict(channels)).write(os.fspath(path))
    return path.read_bytes()


def of_openexr(path: Path) -> dict[str, np.ndarray]:
    channels = OpenEXR.File(os.fspath(path), separate_channels=True).channels()
    return {name: channel.pixels for name, channel in channels.items()}


def same(found: np.ndarray, expected: np.ndarray) -> bool:
    return found.dtype == expected.dtype and found.tobytes() == expected.tobytes()


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    path = tmp_path / "plain.exr"
    encoded(path, {"RGB": (rng.integers(0, 90, (40, 30, 3)) / 90).astype("f2")})
    return path


@pytest.fixture
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Work on four chunks, or a few more, at a time, not on all of so small a picture."""
    monkeypatch.setattr(scanlines, "_BAND", 64 * 21 * 8)


@given(
    size=st.tuples(st.integers(1, 50), st.integers(1, 40)),
    kinds=st.dictionaries(
        st.sampled_from(["R", "G", "B", "A", "Y", "confidence", "Z"]),
        st.sampled_from("efI"),
        min_size=1,
    ),
    compression=st.sampled_from([NONE, ZIPS, ZIP]),
    corner=st.tuples(st.integers(-70, 70), st.integers(-70, 70)),
    levels=st.sampled_from([1, 3, 1 << 15]),
    seed=st.integers(0, 99),
)
def test_channels_are_those_of_openexr(
    size, kinds, compression, corner, levels, seed, tmp_path_factory
):
    height, width = size
    rng = np.random.default_rng(seed)
    channels = {
        name: rng.integers(0, levels, size).astype(KINDS[kind]) for name, kind in kinds.items()
    }
    first = np.array(corner, np.int32)
    window = first, first + np.array([width - 1, height - 1], np.int32)
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    data = encoded(path, channels, compression=compression, dataWindow=window, displayWindow=window)
    found = scanlines.decode(data, apart=True)
    assert found is not None
    expected = of_openexr(path)
    assert found.keys() == expected.keys()
    assert all(same(found[name], expected[name]) for name in found)


@pytest.mark.parametrize("kind", "efI")
@pytest.mark.parametrize("names", ["RGB", "RGBA"])
@pytest.mark.parametrize("height", [1, 16, 63, 64, 65, 200])
def test_colour_of_one_type_is_one_array(kind, names, height, few_rows, tmp_path):
    rng = np.random.default_rng(height)
    pixels = rng.integers(0, 1000, (height, 21, len(names))).astype(KINDS[kind])
    channels = {name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(names)}
    found = scanlines.decode(encoded(tmp_path / "a.exr", channels))
    assert found is not None
    assert list(found) == [names]
    assert same(found[names], pixels)


def test_colour_with_something_beside_it_is_left_apart(tmp_path):
    one = np.ones((5, 4), np.float16)
    found = scanlines.decode(encoded(tmp_path / "a.exr", dict.fromkeys("RGBZ", one)))
    assert found is not None
    assert sorted(found) == ["B", "G", "R", "Z"]


@pytest.mark.parametrize("kinds", ["eee", "fff", "efI"])
@pytest.mark.parametrize("compression", [NONE, ZIPS, ZIP])
@pytest.mark.parametrize("height", [1, 63, 64, 65, 200])
@pytest.mark.parametrize("beside", ["", "A", "AZ"])
def test_what_is_made_some_rows_at_a_time_is_what_is_made_of_all(
    kinds, compression, height, beside, few_rows, tmp_path
):
    rng = np.random.default_rng(height)
    channels = {
        name: rng.integers(0, 99, (height, 21)).astype(KINDS[kind])
        for name, kind in zip("RGB", kinds, strict=True)
    }
    more = dict.fromkeys(beside, np.ones((height, 21), np.float32))
    data = encoded(tmp_path / "a.exr", channels | more, compression=compression)
    found = scanlines.decode(data, make=write_sum)
    assert found is not None
    assert list(found) == [scanlines.MADE]
    assert same(found[scanlines.MADE], sum_of(*channels.values()))


def test_where_there_is_no_colour_nothing_is_made(tmp_path):
    one = np.ones((5, 4), np.float16)
    found = scanlines.decode(encoded(tmp_path / "a.exr", {"Y": one, "R": one}), make=write_sum)
    assert found is not None
    assert sorted(found) == ["R", "Y"]


def test_of_a_damaged_chunk_nothing_is_made(plain):
    assert scanlines.decode(plain.read_bytes()[:-1], make=write_sum) is None


def test_values_that_no_arithmetic_may_touch_come_back(tmp_path):
    every = np.arange(1 << 16, dtype=np.uint16).view(np.float16).reshape(256, 256)
    for channels in ({"Y": every}, dict.fromkeys("RGB", every)):
        found = scanlines.decode(encoded(tmp_path / "a.exr", channels), apart=True)
        assert found is not None
        assert all(same(values, every) for values in found.values())


@pytest.mark.parametrize("compression", ["RLE", "PIZ", "PXR24", "B44", "DWAA"])
def test_other_compressions_are_left_to_openexr(compression, tmp_path):
    kind = getattr(OpenEXR, f"{compression}_COMPRESSION")
    pixels = np.ones((20, 20), np.float16)
    assert scanlines.decode(encoded(tmp_path / "a.exr", {"Y": pixels}, compression=kind)) is None


@pytest.mark.parametrize("names", [("r", "g", "b"), ("left.R", "left.G", "left.B"), ("a",)])
def test_names_that_openexr_joins_are_left_to_it(names, tmp_path):
    pixels = np.ones((20, 20), np.float16)
    assert scanlines.decode(encoded(tmp_path / "a.exr", dict.fromkeys(names, pixels))) is None


def test_tiles_parts_and_subsampled_channels_are_left_to_openexr(tmp_path):
    pixels = np.ones((64, 64), np.float16)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 32
    data = encoded(tmp_path / "a.exr", {"Y": pixels}, type=OpenEXR.tiledimage, tiles=tiles)
    assert scanlines.decode(data) is None
    parts = [OpenEXR.Part({"compression": ZIP}, {"Y": pixels}, name) for name in "ab"]
    OpenEXR.File(parts).write(os.fspath(tmp_path / "b.exr"))
    assert scanlines.decode((tmp_path / "b.exr").read_bytes()) is None
    sparse = OpenEXR.Channel(pixels[:32, :32].copy(), 2, 2)
    data = encoded(tmp_path / "c.exr", {"X": pixels[:32, :32].copy(), "Y": sparse})
    assert scanlines.decode(data) is None


def test_a_file_cut_off_anywhere_is_not_decoded(plain):
    data = plain.read_bytes()
    assert scanlines.decode(data) is not None
    assert all(scanlines.decode(data[:length]) is None for length in range(len(data)))


@contextlib.contextmanager
def left_to_openexr() -> Iterator[None]:
    """As where no compiler was there."""
    here, scanlines._zip = scanlines._zip, None
    try:
        yield
    finally:
        scanlines._zip = here


def outcome(path: Path) -> Any:
    """What comes of reading: the layers, or what is wrong."""
    try:
        layers = read_image(path).layers
    except ShadowtoolError as error:
        return repr(error)
    return {name: (str(v.dtype), v.shape, v.tobytes()) for name, v in layers.items()}


@settings(max_examples=400)
@given(
    place=st.floats(0, 1, exclude_max=True),
    bit=st.integers(0, 7),
    compression=st.sampled_from([NONE, ZIPS, ZIP]),
)
def test_a_flipped_bit_anywhere_comes_to_what_openexr_makes_of_it(
    place, bit, compression, tmp_path_factory
):
    path = tmp_path_factory.mktemp("exr") / "a.exr"
    pixels = np.random.default_rng(1).integers(0, 90, (33, 5)).astype("f2")
    data = bytearray(encoded(path, dict.fromkeys("YZ", pixels), compression=compression))
    data[int(place * len(data))] ^= 1 << bit
    path.write_bytes(data)
    with left_to_openexr():
        expected = outcome(path)
    assert outcome(path) == expected


def test_without_a_compiler_everything_is_left_to_openexr(plain):
    expected = outcome(plain)
    with left_to_openexr():
        assert scanlines.decode(plain.read_bytes()) is None
        assert outcome(plain) == expected


@given(
    size=st.tuples(st.integers(1, 70), st.integers(1, 40)),
    names=st.sets(st.sampled_from(["RGB", "A", "Y", "confidence", "Z"]), min_size=1),
    kinds=st.lists(st.sampled_from("ef"), min_size=5, max_size=5),
    corner=st.tuples(st.integers(-70, 70), st.integers(-70, 70)),
    levels=st.sampled_from([1, 3, 1 << 15]),
    quick=st.booleans(),
    seed=st.integers(0, 99),
)
def test_a_file_is_openexrs_to_the_last_bit(size, names, kinds, corner, levels, quick, seed):
    rng = np.random.default_rng(seed)
    arrays = {}
    for name, kind in zip(sorted(names), kinds, strict=False):
        shape = (*size, len(name)) if name == "RGB" else size
        arrays[name] = rng.integers(0, levels, shape).astype(KINDS[kind])
    arguments = Path("a.exr"), arrays, Header(*size[::-1], corner), {"command": "é"}, quick
    with left_to_openexr():
        assert not scanlines.encodes()
        expected = bytes(encode_exr(*arguments))
    assert scanlines.encodes()
    assert bytes(encode_exr(*arguments)) == expected


def test_some_rows_at_a_time_are_encoded_as_all_are(few_rows):
    pixels = np.random.default_rng(1).integers(0, 90, (200, 21, 4)).astype("f2")
    with left_to_openexr():
        expected = bytes(encode_exr(Path("a.exr"), {"RGBA": pixels}))
    assert bytes(encode_exr(Path("a.exr"), {"RGBA": pixels})) == expected


def one_pixel(path: Path, **channels: np.ndarray) -> bytes:
    return encoded(path, {name: values[:1, :1].copy() for name, values in channels.items()})


def test_what_is_not_decoded_is_not_encoded(tmp_path):
    channels = {"r": np.ones((3, 4), np.float16)}
    assert scanlines.encode(one_pixel(tmp_path / "a.exr", **channels), channels, 4) is None
    channels = {"R": channels["r"]}
    head = one_pixel(tmp_path / "a.exr", **channels)
    assert scanlines.encode(head, channels, 4) is not None
    assert scanlines.encode(head[:50], channels, 4) is None


def test_an_openexr_that_hides_its_deflating_does_it_all(tmp_path, monkeypatch):
    pixels = np.random.default_rng(1).integers(0, 90, (20, 21, 3)).astype("f2")
    expected = bytes(encode_exr(Path("a.exr"), {"RGB": pixels}))
    (tmp_path / "none").touch()
    monkeypatch.setattr(OpenEXR, "__file__", os.fspath(tmp_path / "none"))
    assert deflating() is None
    assert not scanlines.encodes()
    assert bytes(encode_exr(Path("a.exr"), {"RGB": pixels})) == expected


def test_an_openexr_that_hides_its_inflating_does_it_all(plain, monkeypatch):
    expected = outcome(plain)
    monkeypatch.setattr(OpenEXR, "__file__", os.fspath(plain))
    assert inflating() is None
    assert scanlines.decode(plain.read_bytes()) is None
    assert outcome(plain) == expected


def predicted(rows: bytes) -> bytes:
    """The bytes as OpenEXR deflates them, slowly."""
    ordered = rows[::2] + rows[1::2]
    return ordered[:1] + bytes((b - a + 128) & 255 for a, b in pairwise(ordered))


def chunk(number: int, stored: bytes) -> bytes:
    return struct.pack("<ii", number, len(stored)) + stored


def table(*places: int) -> memoryview:
    return memoryview(np.array(places, np.uint64).tobytes())


@pytest.mark.parametrize("size", [*range(1, 70), 1000, 1001])
def test_a_chunk_of_any_size_is_put_in_order(size):
    rows = np.random.default_rng(size).integers(0, 4, size, np.uint8).tobytes()
    # What is as long as the rows counts as stored as it is.
    levels = (zlib.compress(predicted(rows), level) for level in (9, 0))
    stored = next(data for data in levels if len(data) != size)
    target = np.zeros(size, np.uint8)
    inflate = inflating()
    assert inflate is not None
    assert _zip.unzip(inflate, chunk(7, stored), table(0), target, 7, 1, size) == 1
    assert target.tobytes() == rows


@pytest.mark.parametrize("place", [1, 2, 4, 12, 13, 21, 2**31, 2**63, 2**64 - 1, 2**64 - 8])
def test_a_chunk_that_is_not_where_it_should_be_is_not_taken(place):
    data = chunk(0, b"1234") + chunk(2, b"5678")[:-1]
    target = np.zeros(16, np.uint8)
    assert _zip.unzip(0, data, table(0, place), target, 0, 2, 2) == 1
    assert target.tobytes() == b"1234" + bytes(12)


@pytest.mark.parametrize("number, stored", [(1, 4), (0, 0), (0, -4), (0, 5), (0, 2**31 - 1)])
def test_a_chunk_that_says_something_else_of_itself_is_not_taken(number, stored):
    data = struct.pack("<ii", number, stored) + b"1234"
    assert _zip.unzip(0, data, table(0), np.zeros(4, np.uint8), 0, 1, 4) == 0
    assert _zip.unzip(0, chunk(0, b"1234"), table(0), np.zeros(4, np.uint8), 0, 1, 4) == 1


@pytest.mark.parametrize("length", range(8))
def test_a_file_shorter_than_a_chunk_begins_has_none(length):
    assert _zip.unzip(0, bytes(length), table(0), np.zeros(4, np.uint8), 0, 1, 4) == 0


def test_chunks_for_which_there_is_no_room_are_not_taken():
    memory = np.full(8, 7, np.uint8)
    data = b"".join(chunk(number, b"12") for number in range(9))
    places = table(*range(0, 90, 10))
    assert _zip.unzip(0, data, places, memory[:3], 0, 1, 2) == 1
    assert memory.tobytes() == b"12" + bytes([7] * 6)
    # The last one is what is left.
    data = chunk(0, b"12") + chunk(1, b"3")
    assert _zip.unzip(0, data, table(0, 10), memory[:3], 0, 1, 2) == 2
    assert memory.tobytes() == b"123" + bytes([7] * 5)


def test_what_inflates_to_more_or_less_is_damaged():
    inflate = inflating()
    assert inflate is not None
    stored = chunk(0, zlib.compress(bytes(100)))
    for size, done in ((99, 0), (100, 1), (101, 0)):
        memory = np.zeros(size, np.uint8)
        assert _zip.unzip(inflate, stored, table(0), memory, 0, 1, size) == done


@pytest.mark.parametrize("rows, length", [(0, 4), (4, 0), (-1, 4), (4, -1)])
def test_chunks_of_nothing_are_an_error(rows, length):
    with pytest.raises(ValueError, match="without"):
        _zip.unzip(0, b"", table(), np.zeros(4, np.uint8), 0, rows, length)


@pytest.mark.parametrize("size", [*range(1, 70), 1000, 1001])
def test_a_chunk_of_any_size_is_deflated_in_order(size):
    rows = np.random.default_rng(size).integers(0, 4, size, np.uint8)
    deflate = deflating()
    assert deflate is not None
    target, places = np.zeros(2 * size + 300, np.uint8), np.zeros(1, np.uint64)
    end = _zip.zip(deflate, 9, rows, target, 5, places, 7, 1, size)
    assert places[0] == 5
    number, stored = struct.unpack_from("<ii", target, 5)
    assert (number, end) == (7, 13 + stored)
    data = target[13:end].tobytes()
    if stored == size:
        assert data == rows.tobytes()
    else:
        assert zlib.decompress(data) == predicted(rows.tobytes())
    assert not target[end + 256 :].any()


@pytest.mark.parametrize("room", [0, 7, 8, 100, 1007, 1008])
def test_chunks_for_which_there_is_no_room_are_not_deflated(room):
    deflate = deflating()
    assert deflate is not None
    rows = np.random.default_rng(1).integers(0, 256, 1000, np.uint8)
    memory, places = np.full(1100, 7, np.uint8), np.zeros(1, np.uint64)
    assert _zip.zip(deflate, 4, rows, memory[:room], 0, places, 0, 1, 1000) == -1
    assert (memory[room:] == 7).all()


def test_chunks_for_whose_places_there_is_no_room_are_not_deflated():
    deflate = deflating()
    assert deflate is not None
    rows, target = np.zeros(20, np.uint8), np.zeros(900, np.uint8)
    for count, done in ((0, False), (4, False), (5, True), (6, True)):
        places = np.zeros(count, np.uint64)
        assert (_zip.zip(deflate, 4, rows, target, 0, places, 0, 1, 4) > 0) == done


def test_chunks_of_more_bytes_than_there_are_are_an_error():
    deflate, target = deflating(), np.zeros(8, np.uint8)
    assert deflate is not None
    with pytest.raises(ValueError, match="more bytes than there are"):
        _zip.zip(deflate, 4, target, target, 0, target, 0, 1 << 40, 1 << 40)
    with pytest.raises(ValueError, match="more bytes than there are"):
        _zip.unzip(0, b"", table(), target, 0, 1 << 40, 1 << 40)


@pytest.mark.parametrize("place", [-1, 9, 1 << 62])
def test_a_place_outside_the_target_is_an_error(place):
    deflate = deflating()
    assert deflate is not None
    rows, target, places = np.zeros(4, np.uint8), np.zeros(8, np.uint8), np.zeros(1, np.uint64)
    with pytest.raises(ValueError, match="no place"):
        _zip.zip(deflate, 4, rows, target, place, places, 0, 1, 4)
    with pytest.raises(ValueError, match="nothing that deflates"):
        _zip.zip(0, 4, rows, target, 0, places, 0, 1, 4)
    with pytest.raises(ValueError, match="without"):
        _zip.zip(deflate, 4, rows, target, 0, places, 0, 0, 4)


def test_an_attribute_that_stands_there_twice_is_left_to_openexr(plain):
    data = plain.read_bytes()
    again = b"dataWindow\0box2i\0" + struct.pack("<5i", 16, 0, 0, 1, 1)
    assert scanlines.decode(data[:8] + again + data[8:]) is None


def test_a_header_that_claims_more_than_the_file_can_hold_asks_for_no_memory(plain):
    data = bytearray(plain.read_bytes())
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[at : at + 16] = struct.pack("<4i", 0, 0, 19_999, 11_999)
    tracemalloc.start()
    try:
        assert scanlines.decode(bytes(data)) is None
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_channels_out_of_order_are_left_to_openexr(tmp_path):
    """It sorts them by name, and takes what follows for theirs."""
    one = np.ones((5, 4), np.float16)
    data = encoded(tmp_path / "a.exr", {"X": one, "Y": 2 * one})
    assert scanlines.decode(data) is not None
    assert scanlines.decode(data.replace(b"X\0", b"Z\0", 1)) is None


def test_what_goes_wrong_in_the_making_is_no_damage(plain):
    def fail(rows, red, green, blue, made):
        raise ValueError("of its own")

    with pytest.raises(ValueError, match="of its own"):
        scanlines.decode(plain.read_bytes(), make=fail)
