"""Pixels of the commonest EXR files, decoded in four fifths of the time that OpenEXR takes, and
encoded in three fifths to nine tenths of it.

OpenEXR inflates and deflates them; their bytes are put in order here (`_zip.c`), which takes
OpenEXR, as it is built for Python, a quarter of its time. Whatever is unusual about a file is left
to OpenEXR, and so is every verdict on a damaged one. What is encoded is the same to the last bit.
"""

import contextlib
import struct
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.io.openexr_core import deflating, inflating

try:
    from shadowtool.io import _zip
except ImportError:
    # No compiler was there when this was installed.
    _zip = None  # type: ignore[assignment]

Bytes = NDArray[np.uint8]
# What makes something of some rows' R, G and B, (N, W) each, and writes it to halfs (N, W).
Make = Callable[[slice, NDArray[Any], NDArray[Any], NDArray[Any], NDArray[np.float16]], object]

_MAGIC = b"v/1\x01"
# The version, and a flag that says nothing but that names may be long: one part, in scanlines.
_VERSION, _LONG_NAMES = 2, 0x400
# What a header must have beside its channels, with type and size.
_WANTED = {
    b"compression": (b"compression", 1),
    b"dataWindow": (b"box2i", 16),
    b"displayWindow": (b"box2i", 16),
    b"lineOrder": (b"lineOrder", 1),
}
# Rows of a chunk, by compression: none, ZIP of single rows and of sixteen.
_ROWS = {b"\x00": 1, b"\x02": 1, b"\x03": 16}
_TYPES = (np.dtype(np.uint32), np.dtype(np.float16), np.dtype(np.float32))
# Names by which OpenEXR makes several channels one array, beside R, G, B and A.
_JOINED = frozenset("rgba")
# Rows of so many bytes are decoded, and then worked on while they are close at hand.
_BAND = 3 << 19
# The name of what is made of the channels; no channel has none.
MADE = ""
# No deflated byte stands for more.
_MOST_INFLATED = 1032


class _Place(NamedTuple):
    """Where in the bytes of a row a channel starts, and its type."""

    start: int
    kind: np.dtype[Any]


@dataclass(frozen=True)
class _Layout:
    """How pixels lie in a file.

    Attributes:
        top: the first row's number.
        packed: whether chunks are compressed.
        rows: of a chunk.
        length: bytes of a row.
        channels: by name.
        table: where the chunks' places start.
    """

    top: int
    width: int
    height: int
    packed: bool
    rows: int
    length: int
    channels: Mapping[str, _Place]
    table: int

    def colour(self) -> str:
        """The letters RGB or RGBA if these are all channels, and of one type; else none."""
        names = "".join(name for name in "RGBA" if name in self.channels)
        kinds = {place.kind for place in self.channels.values()}
        return names if len(kinds) == 1 and 2 < len(names) == len(self.channels) else ""

    def together(self) -> int:
        """How many chunks are worked on together."""
        return max(1, _BAND // (self.rows * self.length))

    def values(self, rows: Bytes, name: str) -> NDArray[Any]:
        """A channel's part of rows, (N, bytes of a row): (N, W)."""
        start, kind = self.channels[name]
        values = rows[:, start : start + self.width * kind.itemsize]
        if start % kind.itemsize or self.length % kind.itemsize:
            # What straddles words can't be looked at where it is.
            values = np.ascontiguousarray(values)
        return values.view(kind)


def decodes(compression: int) -> bool:
    """Whether scanlines of this compression, by OpenEXR's number, are decoded here at all."""
    return bytes([compression]) in _ROWS and _inflate() is not None


def encodes() -> bool:
    """Whether files are encoded here at all."""
    return _deflate() is not None


def _deflate() -> int | None:
    """The address of what deflates; else as `_inflate`."""
    return deflating() if _at_hand() else None


def _inflate() -> int | None:
    """The address of what inflates; None where that, or what goes with it, is missing."""
    return inflating() if _at_hand() else None


def _at_hand() -> bool:
    return _zip is not None and sys.byteorder == "little"


def decode(
    data: bytes | bytearray, apart: bool = False, make: Make | None = None
) -> dict[str, NDArray[Any]] | None:
    """Channels by name, of the data window's size; float16, float32 or uint32.

    Args:
        data: a whole file.
        apart: leave R, G, B and A each for itself.
        make: what is wanted instead of R, G and B; it is given some rows of these at a time.

    Returns:
        With ``make``, if there are R, G and B: what was made of them, under `MADE`, and no more.
        Arrays (H, W), whose rows lie apart from each other in memory. Unless ``apart``, R, G and B,
        or R, G, B and A, if they are of one type and nothing is beside them, are one array
        (H, W, C) under these letters. None for a file that isn't whole, or isn't of one part in
        scanlines, uncompressed or ZIP, with all channels at full size.
    """
    inflate = _inflate()
    version = int.from_bytes(data[4:8], "little")
    if inflate is None or data[:4] != _MAGIC or version & ~_LONG_NAMES != _VERSION:
        return None
    try:
        layout = _layout(data)
    except (struct.error, ValueError, LookupError):
        return None
    with contextlib.suppress(_DamagedError, MemoryError):
        chunks = _Chunks(data, layout, inflate if layout.packed else 0)
        if make is not None and set("RGB") <= layout.channels.keys():
            return {MADE: _made(chunks, layout, make)}
        colour = layout.colour()
        if colour and not apart:
            return {colour: _joined(chunks, layout, colour)}
        rows = np.empty((layout.height, layout.length), np.uint8)
        chunks.fill(rows)
        return {name: layout.values(rows, name) for name in layout.channels}
    return None


def encode(one_pixel: bytes, channels: Mapping[str, NDArray[Any]], level: int) -> memoryview | None:
    """A whole file, as OpenEXR writes it.

    Args:
        one_pixel: a file with the wanted header, but whose data window ends where it starts.
        channels: by name, (H, W) all of them, of the types that the header says.
        level: how hard ZIP searches.

    Returns:
        None where the file can't be encoded here.
    """
    deflate = _deflate()
    if deflate is None:
        return None
    height, width = next(iter(channels.values())).shape
    try:
        parts, end = _attributes(one_pixel)
        head = bytearray(one_pixel[:end])
        left, top = struct.unpack_from("<2i", head, parts[b"dataWindow"].start)
        corner = left + width - 1, top + height - 1
        struct.pack_into("<2i", head, parts[b"dataWindow"].start + 8, *corner)
        layout = _layout(bytes(head))
    except (struct.error, ValueError, LookupError):
        return None
    size = layout.rows * layout.length
    if not layout.packed or size >= 1 << 31 or layout.channels.keys() != channels.keys():
        return None
    count = -(-height // layout.rows)
    table = np.empty(count, np.uint64)
    place = end + table.nbytes
    # No chunk becomes longer by being deflated, but while it is, the last may need more room.
    target = np.empty(place + height * layout.length + 8 * count + size // 16 + 256, np.uint8)
    target[:end] = np.frombuffer(head, np.uint8)
    together = layout.together()
    band = np.empty((min(together * layout.rows, height), layout.length), np.uint8)
    for first in range(0, count, together):
        start = first * layout.rows
        rows = band[: height - start]
        for name, values in channels.items():
            own = np.ascontiguousarray(values[start : start + len(rows)]).view(np.uint8)
            at = layout.channels[name].start
            rows[:, at : at + own.shape[1]] = own
        places = table[first : first + together]
        numbers = layout.top + start, layout.rows, layout.length
        place = _zip.zip(deflate, level, rows, target, place, places, *numbers)
        if place < 0:
            return None
    target[end : end + table.nbytes] = table.view(np.uint8)
    return target.data[:place]


def _attributes(data: bytes | bytearray) -> tuple[dict[bytes, slice], int]:
    """Where in a file the attributes' contents lie, by name, and where the header ends.

    Raises:
        ValueError, LookupError, struct.error: it makes no sense, or is not for here.
    """
    found = dict[bytes, slice]()
    at = 8
    while data[at]:
        # Name, type, size and content.
        middle = data.index(0, at)
        end = data.index(0, middle + 1)
        name, kind = bytes(data[at:middle]), bytes(data[middle + 1 : end])
        (size,) = struct.unpack_from("<I", data, end + 1)
        at = end + 5 + size
        if name in found or _WANTED.get(name, (kind, size)) != (kind, size):
            raise ValueError(f"{name!r} stands there twice, or is none")
        found[name] = slice(end + 5, at)
    if not _WANTED.keys() <= found.keys():
        raise ValueError("something is missing")
    return found, at + 1


def _layout(data: bytes | bytearray) -> _Layout:
    """What the header says. Raises as `_attributes`."""
    parts, end = _attributes(data)
    left, top, right, bottom = struct.unpack("<4i", data[parts[b"dataWindow"]])
    width, height = right - left + 1, bottom - top + 1
    if width < 1 or height < 1:
        raise ValueError("no pixels")
    channels, length = _channels(bytes(data[parts[b"channels"]]), width)
    compression = bytes(data[parts[b"compression"]])
    rows, packed = _ROWS[compression], compression != b"\x00"
    return _Layout(top, width, height, packed, rows, length, channels, end)


def _channels(listed: bytes, width: int) -> tuple[dict[str, _Place], int]:
    """Channels as they follow each other in a row, and the bytes of a row.

    Raises:
        ValueError: a channel is subsampled, or of those that OpenEXR joins, or they are not in the
            order of their names, by which OpenEXR goes.
    """
    channels: dict[str, _Place] = {}
    at = length = 0
    before = b""
    while listed[at]:
        end = listed.index(0, at)
        if listed[at:end] <= before:
            raise ValueError("channels are out of order")
        before = listed[at:end]
        name = listed[at:end].decode()
        kind, *sampling = struct.unpack_from("<I4xii", listed, end + 1)
        if sampling != [1, 1] or "." in name or name in _JOINED:
            raise ValueError(f"channel {name}")
        channels[name] = _Place(length, _TYPES[kind])
        length += width * _TYPES[kind].itemsize
        at = end + 17
    return channels, length


class _DamagedError(Exception):
    """A file isn't whole."""


class _Chunks:
    """A file's chunks, each of them some rows.

    Raises:
        _DamagedError: the file isn't whole.
    """

    def __init__(self, data: bytes | bytearray, layout: _Layout, inflate: int) -> None:
        if layout.height * layout.length > _MOST_INFLATED * len(data):
            raise _DamagedError("more pixels than the file has room for")
        self.count = -(-layout.height // layout.rows)
        # Where each starts.
        self._table = memoryview(data)[layout.table : layout.table + 8 * self.count]
        self._data, self._layout, self._inflate = data, layout, inflate

    def fill(self, rows: Bytes, first: int = 0) -> None:
        """Decode rows, (N, bytes of a row), from a chunk on. Raises as the class does."""
        layout = self._layout
        count = -(-len(rows) // layout.rows)
        table = self._table[8 * first : 8 * (first + count)]
        top = layout.top + first * layout.rows
        arguments = self._data, table, rows, top, layout.rows, layout.length
        if _zip.unzip(self._inflate, *arguments) != count:
            raise _DamagedError("a chunk is damaged, or missing")


def _by_bands(chunks: _Chunks, layout: _Layout) -> Iterator[tuple[slice, Bytes]]:
    """Which rows, and their bytes (N, bytes of a row), which the next ones overwrite. Raises as
    `_Chunks` does."""
    together = layout.together()
    band = np.empty((min(together * layout.rows, layout.height), layout.length), np.uint8)
    for first in range(0, chunks.count, together):
        start = first * layout.rows
        rows = band[: layout.height - start]
        chunks.fill(rows, first)
        yield slice(start, start + len(rows)), rows


def _made(chunks: _Chunks, layout: _Layout, make: Make) -> NDArray[np.float16]:
    """What is made of R, G and B, (H, W). Raises as `_Chunks` does."""
    made = np.empty((layout.height, layout.width), np.float16)
    for rows, stored in _by_bands(chunks, layout):
        red, green, blue = (layout.values(stored, name) for name in "RGB")
        make(rows, red, green, blue, made[rows])
    return made


def _joined(chunks: _Chunks, layout: _Layout, names: str) -> NDArray[Any]:
    """Channels of one type as one array (H, W, C). Raises as `_Chunks` does."""
    kind = layout.channels[names[0]].kind
    joined = np.empty((layout.height, layout.width, len(names)), kind)
    # What only moves channels about takes halfs as integers of their size.
    bits: NDArray[np.integer[Any]]
    bits = joined.view(np.uint16 if kind.itemsize == 2 else np.int32)
    for rows, stored in _by_bands(chunks, layout):
        channels = [layout.values(stored, name).view(bits.dtype) for name in names]
        cv2.merge(channels, dst=bits[rows])
    return joined
