"""EXR and PNG images: the only place that opens either.

EXR pixels are taken as linear light, PNG as sRGB-encoded, unless the caller names a transfer
function.
"""

import contextlib
import io
import logging
import re
import struct
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import cv2
import numpy as np
import OpenEXR
from numpy.typing import NDArray

from shadowtool.core.half_floats import to_float
from shadowtool.core.transfer import TRANSFERS
from shadowtool.errors import DamagedFileError, InputError, RetryError, ShadowtoolError
from shadowtool.io import scanlines
from shadowtool.io.files import (
    Content,
    File,
    read_content,
    require_readable,
    unchanging,
    write_bytes,
)
from shadowtool.io.openexr_core import set_zip_level

logger = logging.getLogger(__name__)
_said: set[tuple[Path, str]] = set()
_saying = threading.Lock()

Float32 = NDArray[np.float32]

EXR, PNG = ".exr", ".png"
# The largest picture that is opened: a header that claims more is broken, or not for this tool.
_MOST_PIXELS = 1 << 28
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_ATTRIBUTE = "shadowtool."
# Of a PNG with grain: differences to the row above, each by its own frequency.
_GRAINY = (
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
)
# Names of several channels together that are in no layer; and names that no layer has.
_COLOURS, _CHANNELS = ("RGB", "RGBA"), frozenset("RGBAXYZ")
# Of a grey picture R, G and B differ by no more than this, which rounding explains.
_COLOURED = 1 / 32
# ZIP levels: what OpenEXR takes by itself, and the least that compresses.
_USUAL, _QUICK = 4, 1
# What OpenEXR raises for headers that make no sense; ZeroDivisionError is a rational number's.
_EXR_FAULTS = (RuntimeError, ValueError, TypeError, ArithmeticError)


@dataclass(frozen=True)
class Header:
    """What a file says about its picture apart from the pixels.

    Attributes:
        width, height: the display window's size, pixels.
        origin: the display window's upper left corner.
        pixel_aspect: width of a pixel over its height.
        frame_rate: frames per second, if the file says so.
        time_code: OpenEXR's TimeCode, if the file has one.
        coloured: whether there is more than one channel.
        bits: of each integer sample; None for floating point.
        provenance: how a file of ours was made: our attributes without their prefix.
    """

    width: int
    height: int
    origin: tuple[int, int] = (0, 0)
    pixel_aspect: float = 1.0
    frame_rate: Fraction | None = None
    time_code: Any = None
    coloured: bool = True
    bits: int | None = None
    provenance: Mapping[str, str] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


@dataclass(frozen=True)
class Image:
    """A picture as it is stored: code values are not decoded yet.

    Attributes:
        path: where it came from.
        header: see `Header`.
        layers: arrays by name, (H, W) or (H, W, C), of the display window's size; float16 or
            float32, PNG's 8 and 16 bit as uint8 and uint16. Colour stands under "RGB" or "RGBA",
            or in channels "R", "G" and "B" of their own for `read_made`.
        fingerprint: of the file's content.
    """

    path: Path
    header: Header
    layers: Mapping[str, NDArray[Any]]
    fingerprint: str

    @property
    def stored(self) -> int:
        """How many bytes its file takes."""
        return int(self.fingerprint.partition(":")[0])

    def rgb(self, transfer: str = "auto") -> NDArray[np.floating]:
        """(H, W, 3) linear light; float16 where the file has halfs and needs no decoding.

        A single-channel picture is taken as grey. Of a file without R, G and B the one layer that
        has three channels is taken.

        Raises:
            InputError: there is no colour that could be meant.
        """
        values = _three_channels(self.layers[self._colour_layer()])
        return decode(values, resolve_transfer(transfer, self.path))

    def colours(self, transfer: str = "auto") -> tuple[NDArray[np.floating], ...]:
        """The three channels of `rgb`, (H, W) each."""
        if set("RGB") <= self.layers.keys():
            stored = [self.layers[name] for name in "RGB"]
        else:
            values = _three_channels(self.layers[self._colour_layer()])
            stored = [_one_channel(values, index) for index in range(3)]
        return tuple(decode(values, resolve_transfer(transfer, self.path)) for values in stored)

    def rgba(self, transfer: str = "auto") -> tuple[Float32, Float32]:
        """Premultiplied colour (H, W, 3) and alpha (H, W), linear light.

        EXR is premultiplied by custom; PNG is not by its standard, and is multiplied here.

        Raises:
            InputError: the file has no alpha.
        """
        name = self._colour_layer()
        values = self.layers[name]
        if values.ndim == 2 or values.shape[-1] < 4:
            raise InputError(f"{self.path}: has no alpha channel; give frames with R, G, B and A")
        alpha = _unit(_one_channel(values, 3))
        colour = to_float(self.rgb(transfer))
        if self.path.suffix.lower() == PNG:
            colour = colour * alpha[..., None]
        return colour, alpha

    def plane(self, *names: str) -> Float32:
        """One channel (H, W) as float32, integer formats scaled to [0, 1], never decoded.

        Args:
            names: the channels to look for, first choice first; failing them a picture of a
                single channel, or R, G and B that stand for grey, give it. These come before an
                alpha that is opaque everywhere.

        Raises:
            InputError: no such channel, or R, G and B differ.
        """
        opaque: Float32 | None = None
        for name in names:
            with contextlib.suppress(InputError):
                values = self.channel(name)
                # Paint programs add an opaque alpha, which says nothing of what was painted.
                if name != "A" or not (values >= 1).all():
                    return values
                opaque = values
        only = list(self.layers.values())
        if len(only) == 1 and only[0].ndim == 2:
            return _unit(only[0])
        colour = self.layers.get("RGB", self.layers.get("RGBA"))
        if colour is not None and colour.ndim == 2:
            return _unit(colour)
        grey = None if colour is None else _grey(colour)
        if grey is not None:
            return grey
        if opaque is not None:
            return opaque
        if colour is not None:
            raise InputError(
                f"{self.path}: is coloured; give one channel, an alpha, or a grey picture"
            )
        raise InputError(
            f"{self.path}: has no channel {' or '.join(names)}, only {', '.join(self.layers)}"
        )

    def channel(self, name: str) -> Float32:
        """One channel (H, W) as float32, by its exact name.

        Raises:
            InputError: the file has no channel of that name.
        """
        for layer, values in self.layers.items():
            if layer == name and values.ndim == 2:
                return _unit(values)
            if layer in ("RGB", "RGBA") and values.ndim == 3 and len(name) == 1 and name in layer:
                return _unit(_one_channel(values, layer.index(name)))
        raise InputError(f"{self.path}: has no channel {name}, only {', '.join(self.layers)}")

    def _colour_layer(self) -> str:
        for name in ("RGB", "RGBA"):
            if name in self.layers:
                return name
        if len(self.layers) == 1 or "Y" in self.layers:
            return "Y" if "Y" in self.layers else next(iter(self.layers))
        colours = [n for n, v in self.layers.items() if v.ndim == 3]
        if len(colours) != 1:
            raise InputError(
                f"{self.path}: has no R, G, B, only {', '.join(self.layers)};"
                " write the wanted layer as R, G, B first"
            )
        _say_once(self.path, f"no R, G, B; the layer {colours[0]} is taken")
        return colours[0]


def _say_once(path: Path, message: str) -> None:
    """Warn of what is most likely the same in all frames of a sequence once for all of them."""
    frames = path.with_name(re.sub(r"\d(?=\d*\.[^.]*$)", "#", path.name))
    with _saying:
        known = (frames, message) in _said
        _said.add((frames, message))
    if not known:
        logger.warning("%s: %s", frames, message)


def resolve_transfer(transfer: str, path: Path) -> str:
    """The name of the transfer function that "auto" stands for: by the file's kind."""
    if transfer != "auto":
        return transfer
    return "srgb" if path.suffix.lower() == PNG else "linear"


def decode(values: NDArray[Any], transfer: str) -> NDArray[np.floating]:
    """Code values of any stored type to linear light; halfs that are linear stay as they are."""
    if values.dtype in (np.uint8, np.uint16):
        return np.asarray(cv2.LUT(values, _table(transfer, values.dtype.name)))
    if values.dtype == np.uint32:
        values = values.astype(np.float32)
    if transfer in ("linear", "none"):
        return values
    return TRANSFERS[transfer].decode(values)


@cache
def _table(transfer: str, dtype: str) -> Float32:
    top = np.iinfo(dtype).max
    return TRANSFERS[transfer].decode(np.arange(top + 1, dtype=np.float32) / top)


def _three_channels(values: NDArray[Any]) -> NDArray[Any]:
    """(H, W), (H, W, 3) or (H, W, 4) as (H, W, 3) without the alpha; grey in each channel."""
    bits = _for_opencv(values)
    if values.ndim == 2:
        return cv2.merge([bits, bits, bits]).view(values.dtype)
    return values if values.shape[2] == 3 else cv2.merge(cv2.split(bits)[:3]).view(values.dtype)


def _joined(channels: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Channels (H, W) as (H, W, C): of their type, or single floats if they are of several."""
    kinds = {values.dtype for values in channels}
    kind = kinds.pop() if len(kinds) == 1 else np.dtype(np.float32)
    whole = [_for_opencv(values.astype(kind, copy=False)) for values in channels]
    return cv2.merge(whole).view(kind)


def _by_channel(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Each channel (H, W) by its own name."""
    channels = {}
    for name, values in arrays.items():
        if values.ndim == 2:
            channels[name] = values
            continue
        letters = name if name in _COLOURS else [f"{name}.{letter}" for letter in "RGBA"]
        # A layer may have no alpha.
        for index, letter in zip(range(values.shape[2]), letters, strict=False):
            channels[letter] = values[..., index]
    return channels


def _one_channel(values: NDArray[Any], index: int) -> NDArray[Any]:
    """(H, W) of (H, W, C)."""
    return cv2.extractChannel(_for_opencv(values), index).view(values.dtype)


def _grey(values: NDArray[Any]) -> Float32 | None:
    """(H, W) of (H, W, 3) or (H, W, 4) whose first three channels are alike, else None."""
    red, green, blue = (_unit(_one_channel(values, index)) for index in range(3))
    with np.errstate(invalid="ignore", over="ignore"):
        coloured = any((np.abs(other - green) > _COLOURED).any() for other in (red, blue))
    return None if coloured else green


def _for_opencv(values: NDArray[Any]) -> NDArray[Any]:
    # What only moves channels about takes halfs fastest as integers of their size.
    kind = {np.dtype(np.float16): np.uint16, np.dtype(np.uint32): np.float32}
    return values.view(kind.get(values.dtype, values.dtype))


def _unit(values: NDArray[Any]) -> Float32:
    if values.dtype in (np.uint8, np.uint16):
        return values.astype(np.float32) / np.float32(np.iinfo(values.dtype).max)
    return to_float(values)


def read_header(path: Path) -> Header:
    """Size and properties without the pixels. A picture that is cut off later passes.

    Raises:
        InputError: no such file, or of a kind that is refused: deep, luminance and chroma, too
            large, no EXR or PNG.
        DamagedFileError: not even the header can be read.
    """
    try:
        with path.open("rb") as file:
            if path.suffix.lower() == PNG:
                return _png_header(path, file.read(4096))
            return _exr_header(path, _open_exr(path, file, header_only=True))
    except OSError:
        # The same again for its message.
        return read_image(path).header


def read_image(path: Path) -> Image:
    """Read a picture whole.

    Raises:
        InputError: as `read_header`.
        DamagedFileError: cut off, or the pixels don't decode.
    """
    if path.suffix.lower() == PNG:
        return _decode_png(path, read_content(path))
    with unchanging(path) as file:
        return _decode_exr(path, file)


class Made(NamedTuple):
    """What was made of a picture's colours: `Header`, values (H, W), and the file's fingerprint."""

    header: Header
    values: NDArray[np.float16]
    fingerprint: str


def read_made(path: Path, make: scanlines.Make, transfer: str = "auto") -> Made:
    """Read a picture of which only something made of its colours is wanted. Of scanlines it is made
    while these are close at hand, and no more is kept of them.

    Args:
        make: is given some rows, their three channels as `Image.colours` gives them, (N, W) each,
            and what it is to write to, (N, W) halfs; some rows perhaps again.

    Raises:
        InputError, DamagedFileError: as `read_image`; InputError also if there is no colour.
    """
    if path.suffix.lower() == PNG:
        image = read_image(path)
    else:
        taken = resolve_transfer(transfer, path)

        def of_stored(rows: slice, *stored: NDArray[Any]) -> None:
            *channels, made = stored
            red, green, blue = (decode(channel, taken) for channel in channels)
            make(rows, red, green, blue, made)

        with unchanging(path) as file:
            image = _decode_exr(path, file, of_stored)
    if scanlines.MADE in image.layers:
        values = image.layers[scanlines.MADE]
    else:
        red, green, blue = image.colours(transfer)
        values = np.empty(red.shape, np.float16)
        make(slice(0, len(values)), red, green, blue, values)
    return Made(image.header, values, image.fingerprint)


def write_exr(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    header: Header | None = None,
    provenance: Mapping[str, str] | None = None,
    quick: bool = False,
) -> None:
    """Write a scanline EXR with ZIP compression, whole or not at all.

    Args:
        channels: arrays by name, (H, W), or (H, W, 3) and (H, W, 4) under "RGB" and "RGBA", or
            under the name of a layer that has these; float16 or float32.
        header: where display window's origin, pixel aspect, frame rate and time code come from.
        provenance: how the file was made; becomes string attributes.
        quick: search less for what repeats. A picture with grain takes half the time and up to
            a twentieth more room; a clean matte takes longer.

    Raises:
        RetryError, ShadowtoolError: as `write_bytes`.
    """
    write_bytes(path, encode_exr(path, channels, header, provenance, quick))


def encode_exr(
    path: Path,
    channels: Mapping[str, NDArray[Any]],
    header: Header | None = None,
    provenance: Mapping[str, str] | None = None,
    quick: bool = False,
) -> memoryview:
    """The bytes that `write_exr` writes.

    Args:
        path: what they are for, to be named if they can't be made.

    Raises:
        RetryError: there is no memory for it.
    """
    arrays = {}
    height, width = next(iter(channels.values())).shape[:2]
    for name, values in channels.items():
        if values.dtype not in (np.float16, np.float32):
            raise TypeError(f"channel {name} of {path} is {values.dtype}, not half or float")
        together = (len(name),) if name in _COLOURS else () if name in _CHANNELS else (3, 4)
        if values.shape not in [(height, width), *((height, width, own) for own in together)]:
            raise TypeError(f"channel {name} of {path} is of another shape, {values.shape}")
        arrays[name] = np.ascontiguousarray(values)
    first = np.array((0, 0) if header is None else header.origin, np.int32)
    window = first, first + np.array([width - 1, height - 1], np.int32)
    attributes: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "displayWindow": window,
        "dataWindow": window,
    }
    if header is not None:
        attributes["pixelAspectRatio"] = header.pixel_aspect
        if header.frame_rate is not None:
            attributes["framesPerSecond"] = header.frame_rate
        if header.time_code is not None:
            attributes["timeCode"] = header.time_code
    for key, value in (provenance or {}).items():
        attributes[_ATTRIBUTE + key] = value.encode("utf-8", "replace").decode()
    level = _QUICK if quick else _USUAL
    try:
        if scanlines.encodes():
            head = bytes(_one_pixel(attributes, arrays))
            encoded = scanlines.encode(head, _by_channel(arrays), level)
            if encoded is not None:
                return encoded
        with _zip_level.at(level):
            return _encoded(attributes, arrays)
    except (RuntimeError, MemoryError) as error:
        # Arrays are as they have to be: what fails is most likely memory.
        raise RetryError(f"{path}: cannot be encoded: {error}; give a smaller --jobs") from None


def _one_pixel(attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> memoryview:
    """A file with the header of a whole one, and a data window that ends where it starts."""
    corner, _ = attributes["dataWindow"]
    pixels = {name: np.ascontiguousarray(values[:1, :1]) for name, values in arrays.items()}
    return _encoded(dict(attributes) | {"dataWindow": (corner, corner)}, pixels)


def _encoded(attributes: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> memoryview:
    buffer = io.BytesIO()
    OpenEXR.File(dict(attributes), dict(arrays)).write(buffer)
    return buffer.getbuffer()


class _ZipLevel:
    """How hard ZIP searches: one setting of OpenEXR's for all threads.

    Who wants it otherwise waits till nobody writes, so that a file's bytes are always the same.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._now: int | None = None
        self._writers = 0

    @contextlib.contextmanager
    def at(self, level: int) -> Iterator[None]:
        with self._changed:
            self._changed.wait_for(lambda: self._now == level or not self._writers)
            if self._now != level:
                self._set(level)
            self._writers += 1
        try:
            yield
        finally:
            with self._changed:
                self._writers -= 1
                self._changed.notify_all()

    def _set(self, level: int) -> None:
        set_zip_level(level)
        self._now = level


_zip_level = _ZipLevel()


def write_png(
    path: Path,
    values: NDArray[Any],
    provenance: Mapping[str, str] | None = None,
    grainy: bool = False,
) -> None:
    """Write a PNG, whole or not at all.

    Args:
        values: (H, W), (H, W, 3) RGB or (H, W, 4) RGBA; uint8 or uint16 code values.
        provenance: how the file was made; becomes text chunks.
        grainy: don't look for what repeats. A photograph takes three quarters of the time and less
            room; a clean matte takes many times as much.
    """
    if values.dtype not in (np.uint8, np.uint16):
        raise TypeError(f"{path}: PNG holds 8 or 16 bits, not {values.dtype}")
    order = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    if values.ndim == 3:
        values = cv2.cvtColor(np.ascontiguousarray(values), order[values.shape[2]])
    settings = _GRAINY if grainy else ()
    done, buffer = cv2.imencode(PNG, np.ascontiguousarray(values), settings)
    if not done:
        raise ShadowtoolError(f"{path}: cannot be encoded as PNG")
    data = buffer.tobytes()
    # Text chunks may stand anywhere between the header (33 bytes with the signature) and the end.
    texts = b"".join(
        _png_text(_ATTRIBUTE + key, value) for key, value in (provenance or {}).items()
    )
    write_bytes(path, data[:33] + texts + data[33:])


def to_code(linear: NDArray[np.floating], transfer: str = "srgb") -> NDArray[np.uint16]:
    """Linear light to 16-bit code values; NaN becomes 0."""
    coded = TRANSFERS[transfer].encode(linear)
    return np.rint(np.clip(np.nan_to_num(coded), 0, 1) * 65535).astype(np.uint16)


def _open_exr(
    path: Path, source: str | BinaryIO, header_only: bool = False, separate: bool = False
) -> Any:
    try:
        if not isinstance(source, str):
            source.seek(0)
        return OpenEXR.File(source, separate_channels=separate, header_only=header_only)
    except _EXR_FAULTS as error:
        # It says the same of a file that it can't open.
        require_readable(path)
        raise DamagedFileError(
            f"{path}: no EXR, or its header is damaged; write the frame again"
        ) from error


def _exr_header(path: Path, file: Any) -> Header:
    try:
        if not file.parts:
            raise DamagedFileError(f"{path}: the EXR holds no picture; write the frame again")
        raw = file.header(0)
        names = {channel.name for channel in raw.get("channels", [])}
    except _EXR_FAULTS as error:
        raise DamagedFileError(
            f"{path}: the EXR header is damaged; write the frame again"
        ) from error
    if raw.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise InputError(f"{path}: a deep EXR; flatten it first")
    if {"RY", "BY"} & names:
        raise InputError(f"{path}: a luminance/chroma EXR; convert it to R, G, B first")
    first, last = _window(path, raw, "displayWindow")
    _window(path, raw, "dataWindow")
    aspect = float(raw.get("pixelAspectRatio", 1.0))
    rate = raw.get("framesPerSecond")
    return Header(
        width=last[0] - first[0] + 1,
        height=last[1] - first[1] + 1,
        origin=first,
        pixel_aspect=aspect if np.isfinite(aspect) and aspect > 0 else 1.0,
        frame_rate=rate if isinstance(rate, Fraction) else None,
        time_code=raw.get("timeCode"),
        coloured=len(names) > 1,
        provenance={
            key.removeprefix(_ATTRIBUTE): value
            for key, value in raw.items()
            if key.startswith(_ATTRIBUTE) and isinstance(value, str)
        },
    )


Corner = tuple[int, int]


def _window(path: Path, raw: Mapping[str, Any], name: str) -> tuple[Corner, Corner]:
    first, last = (tuple(int(v) for v in corner) for corner in raw[name])
    width, height = last[0] - first[0] + 1, last[1] - first[1] + 1
    if width < 1 or height < 1 or width * height > _MOST_PIXELS:
        raise InputError(f"{path}: its {name} is {width}x{height} pixels; that can't be right")
    return (first[0], first[1]), (last[0], last[1])


def _decode_exr(path: Path, file: File, make: scanlines.Make | None = None) -> Image:
    """A picture; if something is to be made of its colours that alone, or its R, G and B each for
    itself."""
    apart = make is not None
    # The header first: a picture that is refused must not be decoded, and a damaged part of a
    # multi-part file vanishes without a word when the pixels are read.
    listed = _open_exr(path, file.source, header_only=True)
    header = _exr_header(path, listed)
    raw = listed.header(0)
    channels: Mapping[str, NDArray[Any] | None] | None = None
    first, last = window = _window(path, raw, "dataWindow")
    if window != _window(path, raw, "displayWindow"):
        # Rows of the file are not the picture's.
        make = None
    # What is left to OpenEXR need not be in memory.
    if len(listed.parts) == 1 and scanlines.decodes(int(raw["compression"])):
        channels = scanlines.decode(file.content, apart, make)
    if channels is None:
        channels = _channels(path, file.source, listed, apart)
    layers = {}
    for name, values in channels.items():
        if values is None or values.shape[:2] != (last[1] - first[1] + 1, last[0] - first[0] + 1):
            raise InputError(f"{path}: channel {name} is subsampled; write it at full size")
        layers[name] = _placed(values, first, header)
    if not layers:
        raise InputError(f"{path}: has no channels")
    if not apart and set("RGB") <= layers.keys():
        names = [name for name in "RGBA" if name in layers]
        layers["".join(names)] = _joined([layers.pop(name) for name in names])
    return Image(path, header, layers, file.fingerprint())


def _channels(
    path: Path, source: str | BinaryIO, listed: Any, apart: bool
) -> Mapping[str, NDArray[Any] | None]:
    """A file's channels as OpenEXR decodes them, some of them joined unless ``apart``."""
    apart = apart and set("RGB") <= {channel.name for channel in listed.header(0)["channels"]}
    try:
        file = _open_exr(path, source, separate=apart)
    except DamagedFileError:
        # OpenEXR joins R, G, B to one array only where they are of one type.
        file = _open_exr(path, source, separate=True)
    if len(file.parts) != len(listed.parts):
        raise DamagedFileError(f"{path}: damaged or cut off; write the frame again")
    if len(file.parts) > 1:
        _say_once(path, f"of {len(file.parts)} parts the first is taken")
    return {name: channel.pixels for name, channel in file.channels(0).items()}


def _placed(values: NDArray[Any], first: tuple[int, int], header: Header) -> NDArray[Any]:
    """A data window's pixels in the display window: black where there are none, overscan cut."""
    x, y = first[0] - header.origin[0], first[1] - header.origin[1]
    height, width = values.shape[:2]
    if (x, y) == (0, 0) and (width, height) == header.size:
        return values
    canvas = np.zeros((header.height, header.width, *values.shape[2:]), values.dtype)
    target = (
        slice(max(y, 0), max(min(y + height, header.height), 0)),
        slice(max(x, 0), max(min(x + width, header.width), 0)),
    )
    source = (
        slice(max(-y, 0), max(-y, 0) + canvas[target].shape[0]),
        slice(max(-x, 0), max(-x, 0) + canvas[target].shape[1]),
    )
    canvas[target] = values[source]
    return canvas


def _png_header(path: Path, data: bytes) -> Header:
    if not data.startswith(_PNG_SIGNATURE) or len(data) < 33:
        raise DamagedFileError(f"{path}: no PNG, or cut off; write the frame again")
    width, height = struct.unpack(">II", data[16:24])
    if not 0 < width * height <= _MOST_PIXELS:
        raise InputError(f"{path}: claims {width}x{height} pixels; that can't be right")
    # Fewer than 8 bits are decoded to 8. A colour type of 0 is grey alone.
    bits, kind = max(data[24], 8), data[25]
    return Header(width, height, coloured=kind != 0, bits=bits, provenance=_png_texts(data))


def _png_texts(data: bytes) -> dict[str, str]:
    texts = {}
    for kind, content in _png_chunks(data):
        key, _, value = content.partition(b"\0")
        name = key.decode("latin-1")
        if kind == b"IDAT":
            break
        if name.startswith(_ATTRIBUTE) and kind == b"tEXt":
            texts[name.removeprefix(_ATTRIBUTE)] = value.decode("latin-1")
        elif name.startswith(_ATTRIBUTE) and kind == b"iTXt":
            texts[name.removeprefix(_ATTRIBUTE)] = value[4:].decode("utf-8", "replace")
    return texts


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each chunk, as far as the data goes."""
    position = len(_PNG_SIGNATURE)
    while position + 8 <= len(data):
        length, kind = struct.unpack(">I4s", data[position : position + 8])
        yield kind, data[position + 8 : position + 8 + length]
        position += length + 12


def _png_chunk(kind: bytes, content: bytes) -> bytes:
    check = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", check)


def _png_text(key: str, value: str) -> bytes:
    """A tEXt chunk, or iTXt where Latin-1 can't say it."""
    try:
        return _png_chunk(b"tEXt", key.encode("latin-1") + b"\0" + value.encode("latin-1"))
    except UnicodeEncodeError:
        # Not compressed, and no language is named.
        text = value.encode("utf-8", "replace")
        return _png_chunk(b"iTXt", key.encode("ascii") + b"\0\0\0\0\0" + text)


def _decode_png(path: Path, content: Content) -> Image:
    data = content.data
    header = _png_header(path, data)
    # A cut-off PNG decodes to a picture that is grey from there on; its end marker is missing.
    whole = any(kind == b"IEND" for kind, _ in _png_chunks(data))
    try:
        values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from None
        raise DamagedFileError(f"{path}: the PNG can't be decoded: {error.err}") from None
    if values is None or not whole:
        raise DamagedFileError(f"{path}: damaged or cut off; write the frame again")
    if values.ndim == 2:
        layers = {"Y": values}
    elif values.shape[2] == 4:
        layers = {"RGBA": cv2.cvtColor(values, cv2.COLOR_BGRA2RGBA)}
    else:
        layers = {"RGB": cv2.cvtColor(values, cv2.COLOR_BGR2RGB)}
    return Image(path, header, layers, content.fingerprint)
