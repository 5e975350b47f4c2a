"""Movies and cameras, decoded at the depth that they were stored with."""

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from shadowtool.core.chroma import chroma_at_luma
from shadowtool.errors import DamagedFileError, InputError

Float32 = NDArray[np.float32]

# Code points of ITU-T H.273, which every container uses.
_TRANSFERS = {1: "rec709", 6: "rec709", 14: "rec709", 15: "rec709", 13: "srgb", 8: "linear"}
_UNSPECIFIED = {0, 2}
# Red's and blue's share of luma, by matrix coefficients.
_MATRICES = {
    1: (0.2126, 0.0722),
    4: (0.3, 0.11),
    5: (0.299, 0.114),
    6: (0.299, 0.114),
    7: (0.212, 0.087),
    9: (0.2627, 0.0593),
}
_FULL_RANGE = 2


@dataclass(frozen=True)
class MovieInfo:
    """What a movie says of itself, and what had to be assumed.

    Attributes:
        frame_rate: frames per second, None if the container has none.
        pixel_aspect: width of a pixel over its height.
        bits: of each stored sample.
        transfer: the transfer function's name; None if it is one that we can't undo.
        frames: how many there are, if the container says so.
        assumed: sentences about what the file left open, apart from the transfer function.
        assumed_transfer: such a sentence about that; empty if the file names one.
    """

    width: int
    height: int
    pixel_aspect: float
    frame_rate: Fraction | None
    bits: int
    transfer: str | None
    frames: int | None
    assumed: tuple[str, ...]
    assumed_transfer: str


@dataclass(frozen=True)
class MovieFrame:
    """One decoded frame.

    Attributes:
        position: counted from 0.
        seconds: presentation time, None if unknown.
        coded: (H, W, 3) float32 RGB code values, 0 to 1 nominal.
        damaged: the decoder made up a part of it, or of a frame that it may be made from.
    """

    position: int
    seconds: float | None
    coded: Float32
    damaged: bool = False


class Movie:
    """A movie file, read from its beginning, once.

    Raises:
        InputError: there is no video in it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._container = av.open(str(path))
            self._stream = self._container.streams.video[0]
        except (FFmpegError, OSError, ValueError, IndexError):
            raise InputError(
                f"{path}: neither a movie that can be decoded nor EXR or PNG frames"
            ) from None
        kind = self._container.format.name
        # FFmpeg shows any text as a movie of a terminal.
        if kind in ("image2", "tty") or kind.endswith("_pipe"):
            raise InputError(f"{path}: a still picture or text, no movie")
        self._stream.thread_type = "AUTO"
        self.info = self._describe()

    def frames(self) -> Iterator[MovieFrame]:
        """All frames in order.

        Raises:
            DamagedFileError: decoding fails.
        """
        position, damaged = 0, False
        try:
            for frame in self._container.decode(self._stream):
                damaged = bool(frame.is_corrupt or (damaged and not frame.key_frame))
                yield MovieFrame(position, frame.time, self._coded(frame), damaged)
                position += 1
        except FFmpegError as error:
            raise DamagedFileError(
                f"{self.path}: decoding stops after {position} frames: {error.strerror}"
            ) from None
        finally:
            self._container.close()
        if position == 0:
            raise DamagedFileError(f"{self.path}: holds no frame")

    def _describe(self) -> MovieInfo:
        context = self._stream.codec_context
        pixel_format = context.format
        if pixel_format is None:
            raise InputError(f"{self.path}: no movie that can be decoded")
        assumed, assumed_transfer = [], ""
        trc = int(context.color_trc)
        transfer = _TRANSFERS.get(trc)
        if trc in _UNSPECIFIED:
            transfer = "rec709"
            assumed_transfer = "the movie names no transfer function: Rec.709 is assumed"
        self._rgb = _of_rgb(pixel_format)
        self._gray = not self._rgb and len(pixel_format.components) < 3
        matrix = int(context.colorspace)
        self._full = int(context.color_range) == _FULL_RANGE or pixel_format.name.startswith("yuvj")
        if not self._rgb and not self._gray:
            if matrix not in _MATRICES:
                said = f"matrix {matrix}, which is not known here"
                if matrix in _UNSPECIFIED:
                    said = "no colour matrix"
                high = context.width > 1024 or context.height > 576
                matrix = 1 if high else 6
                name = "Rec.709" if high else "Rec.601"
                assumed.append(f"the movie names {said}: {name} is assumed by its size")
            self._weights = _MATRICES[matrix]
        if not self._rgb and int(context.color_range) == 0 and not self._full:
            # As FFmpeg takes it: files that hold only grey come from elsewhere than video does.
            self._full = self._gray
            said = "full range, as grey has," if self._gray else "video range (16-235)"
            assumed.append(f"the movie names no range: {said} is assumed")
        bits = max(component.bits for component in pixel_format.components)
        rate = self._stream.average_rate or self._stream.guessed_rate
        return MovieInfo(
            width=context.width,
            height=context.height,
            frame_rate=Fraction(rate) if rate else None,
            pixel_aspect=float(self._stream.sample_aspect_ratio or 1),
            bits=bits,
            frames=self._stream.frames or None,
            transfer=transfer,
            assumed=tuple(assumed),
            assumed_transfer=assumed_transfer,
        )

    def _coded(self, frame: av.VideoFrame) -> Float32:
        # FFmpeg's own conversion to RGB is off by up to half a per cent, and its change of depth
        # by a code value; planes are taken as they are stored and the matrix is applied here.
        planes, white = _planes(frame)
        if self._gray:
            return np.repeat(self._luma(planes[0], white)[..., None], 3, axis=-1)
        if self._rgb:
            green, blue, red = (plane / white for plane in planes)
            return np.stack([red, green, blue], axis=-1)
        luma = self._luma(planes[0], white)
        blue_difference, red_difference = (
            chroma_at_luma(self._chroma(plane, white), luma) for plane in planes[1:]
        )
        kr, kb = self._weights
        red = luma + np.float32(2 * (1 - kr)) * red_difference
        blue = luma + np.float32(2 * (1 - kb)) * blue_difference
        green = (luma - np.float32(kr) * red - np.float32(kb) * blue) / np.float32(1 - kr - kb)
        return np.stack([red, green, blue], axis=-1)

    def _luma(self, code: Float32, white: np.float32) -> Float32:
        if self._full:
            return code / white
        step = (white + 1) / 256
        return (code - 16 * step) / (219 * step)

    def _chroma(self, code: Float32, white: np.float32) -> Float32:
        step = (white + 1) / 256
        return (code - 128 * step) / (white if self._full else 224 * step)


_PLANAR = re.compile(r"(?:yuvj?(?:420|422|440|444)|gbr|gray)p?(?:9|1[0246])?(?:le)?")


def _planes(frame: av.VideoFrame) -> tuple[list[Float32], np.float32]:
    """A frame's planes as stored, and the code of full white.

    Formats that aren't planar, big-endian or carry alpha are unpacked to the nearest that is.
    """
    if not _PLANAR.fullmatch(frame.format.name):
        bits = max(component.bits for component in frame.format.components)
        depth = "" if bits <= 8 else "10le" if bits <= 10 else "12le" if bits <= 12 else "16le"
        if _of_rgb(frame.format):
            name = f"gbrp{depth}"
        elif len(frame.format.components) < 3:
            name = f"gray{depth}"
        else:
            name = f"yuv{_subsampling(frame)}p{depth}"
        frame = frame.reformat(format=name)
    component = frame.format.components[0]
    kind = np.dtype(np.uint8 if component.bits <= 8 else "<u2")
    planes = []
    for plane in frame.planes:
        rows = np.frombuffer(
            memoryview(plane), kind, plane.height * plane.line_size // kind.itemsize
        )
        whole = rows.reshape(plane.height, plane.line_size // kind.itemsize)
        planes.append(whole[:, : plane.width].astype(np.float32))
    return planes, np.float32((1 << component.bits) - 1)


def _of_rgb(pixel_format: av.VideoFormat) -> bool:
    """Whether samples are red, green and blue, or numbers of such colours."""
    return bool(pixel_format.is_rgb or pixel_format.has_palette)


def _subsampling(frame: av.VideoFrame) -> str:
    across = frame.format.chroma_width(64)
    down = frame.format.chroma_height(64)
    return {(64, 64): "444", (32, 64): "422", (64, 32): "440"}.get((across, down), "420")


def camera_frames(device: int, seconds: float) -> Iterator[MovieFrame]:
    """Frames of a camera, as long as asked for; 8 bits, which is what OpenCV gives.

    Raises:
        InputError: no such camera, or it gives no picture.
    """
    camera = cv2.VideoCapture(device)
    try:
        if not camera.isOpened():
            raise InputError(f"--device {device}: no camera answers there")
        start = time.monotonic()
        position = 0
        while (now := time.monotonic() - start) < seconds:
            done, picture = camera.read()
            if not done:
                break
            rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB).astype(np.float32) / np.float32(255)
            yield MovieFrame(position, now, rgb)
            position += 1
        if position == 0:
            raise InputError(f"--device {device}: the camera gives no picture")
    finally:
        camera.release()
