"""Where captured frames come from: a movie, a sequence, or a camera."""

import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Missing
from shadowtool.errors import DamagedFileError, InputError, OptionError
from shadowtool.io.files import fingerprint_file, fingerprint_movie, size_of
from shadowtool.io.image import EXR, PNG, Header
from shadowtool.io.sequence import Frame, frame_range, parse_frames
from shadowtool.io.video import Movie, MovieFrame, camera_frames
from shadowtool.parallel import ordered_map
from shadowtool.steps.footage import open_footage

FIRST_FRAME = 1001
# How long a camera is recorded at most, seconds.
_LONGEST = 86_400
_LAST_FRAME = 10**9


@dataclass(frozen=True)
class Loaded:
    """A frame.

    Attributes:
        values: (H, W, 3) code values.
        header: the file's, or what stands for it.
        fingerprint: of what it is made of.
    """

    values: NDArray[np.floating]
    header: Header
    fingerprint: str


@dataclass(frozen=True)
class Arriving:
    """A frame on its way in.

    Attributes:
        frame: the number that it gets.
        seconds: when it was taken, None if unknown.
        load: reads it; raises DamagedFileError.
    """

    frame: Frame
    seconds: float | None
    load: Callable[[], Loaded]


@dataclass(frozen=True)
class Source:
    """Frames to capture, and what is known of them beforehand.

    Attributes:
        name: as a person would say it.
        fingerprint: of a source that is one file; empty for a sequence.
        header: the first frame's.
        transfer: the transfer function that was found or assumed.
        assumed: sentences about what the source left open.
        bits: of each sample; None for floating point.
        wanted: the numbers of the frames that were asked for; None for whatever comes.
        total: how many frames there will be, 0 if unknown.
        arriving: the frames, in order; to be gone through once.
        earliest: reads the first frame of all that can be read, wanted or not; None for none.
        absent: frames that are known to be missing.
        folder: where a sequence's files are.
        marks: reads the fingerprint of each wanted frame, on so many threads, where a frame is a
            file of its own; else empty.
        last: the number of the last frame that has arrived, wanted or not; None unknown.
        size_of: how many bytes the file of this frame, wanted or not, has; 0 where frames have no
            files of their own. Raises InputError if there is none.
    """

    name: str
    fingerprint: str
    header: Header
    transfer: str
    assumed: list[str]
    bits: int | None
    wanted: list[Frame] | None
    total: int
    arriving: Iterator[Arriving]
    earliest: Callable[[], Loaded | None]
    absent: list[Frame] = field(default_factory=list)
    folder: Path | None = None
    marks: Callable[[int | None], dict[Frame, str]] = lambda jobs: {}
    last: Callable[[], Frame | None] = lambda: None
    size_of: Callable[[Frame], int] = lambda frame: 0


def open_source(
    source: str | Path | None,
    *,
    device: int | None,
    seconds: float | None,
    frames: str | None,
    missing: Missing,
    transfer: str,
    start: int | None,
) -> Source:
    """Find out what a source is and open it.

    Raises:
        InputError: there is nothing usable.
        OptionError: neither or both of a source and a camera are given.
    """
    if start is not None and abs(start) > _LAST_FRAME:
        raise OptionError(f"--start {start}: no frame has such a number")
    if device is not None:
        if source is not None or seconds is None or not 0 < seconds < _LONGEST:
            raise OptionError("--device N takes --seconds T, up to a day, and no INPUT")
        return _camera(device, seconds, transfer, FIRST_FRAME if start is None else start)
    if seconds is not None:
        raise OptionError("--seconds T goes with --device N, not with an INPUT")
    if source is None:
        raise OptionError("give a movie, a sequence, or --device N --seconds T")
    path = Path(source)
    if path.is_file() and path.suffix.lower() not in (EXR, PNG):
        return _movie(path, frames, missing, transfer, FIRST_FRAME if start is None else start)
    return _sequence(source, frames, missing, transfer, start)


def _movie(path: Path, frames: str | None, missing: Missing, transfer: str, start: int) -> Source:
    movie = Movie(path)
    info = movie.info
    if info.transfer is None and transfer == "auto":
        raise InputError(f"{path}: its transfer function can't be undone here; give --transfer")
    assumed = list(info.assumed)
    if transfer == "auto" and info.assumed_transfer:
        assumed.append(info.assumed_transfer)
    wanted = None if frames is None else parse_frames(frames)
    chosen = None if wanted is None else set(wanted)
    early = [frame for frame in wanted or () if frame < start]
    if early and missing == "error":
        raise InputError(
            f"{path}: has no frames {frame_range(early)}; its first is {start}, or give --start"
        )
    last = start - 1
    mark = fingerprint_movie(path)
    header = Header(
        info.width, info.height, pixel_aspect=info.pixel_aspect, frame_rate=info.frame_rate
    )

    def load(item: MovieFrame) -> Loaded:
        if item.damaged:
            raise DamagedFileError(
                f"{path}: its frame at position {item.position} is damaged; copy the movie again,"
                " or go on without it by --missing skip"
            )
        return Loaded(item.coded, header, f"{mark} {item.position}")

    def arriving() -> Iterator[Arriving]:
        nonlocal last
        for item in movie.frames():
            frame = last = start + item.position
            if chosen is None or frame in chosen:
                yield Arriving(frame, item.seconds, partial(load, item))
            if chosen is not None and frame >= max(chosen):
                return

    def earliest() -> Loaded | None:
        whole = (item for item in Movie(path).frames() if not item.damaged)
        with suppress(DamagedFileError):
            return next((load(item) for item in whole), None)
        return None

    return Source(
        name=path.name,
        fingerprint=mark,
        header=header,
        transfer=info.transfer or transfer,
        assumed=assumed,
        bits=info.bits,
        wanted=wanted,
        total=len(wanted) if wanted is not None else info.frames or 0,
        arriving=arriving(),
        earliest=earliest,
        last=lambda: last,
    )


def _sequence(
    source: str | Path, frames: str | None, missing: Missing, transfer: str, start: int | None
) -> Source:
    footage = open_footage(source, "input", transfer, missing)
    present, absent = footage.sequence.select(frames, missing)
    first = footage.sequence.frames[0]
    offset = 0 if start is None else start - first
    png = footage.sequence.path(present[0]).suffix.lower() == PNG

    def marks(jobs: int | None) -> dict[Frame, str]:
        files = [footage.sequence.path(frame) for frame in present]
        found = ordered_map(fingerprint_file, files, jobs)
        return {frame + offset: mark for frame, mark in zip(present, found, strict=True)}

    def load(frame: Frame) -> Loaded:
        image = footage.image(frame)
        return Loaded(image.rgb("none"), image.header, image.fingerprint)

    def arriving() -> Iterator[Arriving]:
        for frame in present:
            yield Arriving(frame + offset, None, partial(load, frame))

    def earliest() -> Loaded | None:
        for frame in footage.sequence.frames:
            with suppress(InputError):
                return load(frame)
        return None

    return Source(
        name=Path(footage.sequence.pattern).name,
        fingerprint="",
        header=footage.header,
        transfer=footage.transfer,
        assumed=[f"{'PNG' if png else 'EXR'} frames are taken as {footage.transfer}"],
        bits=footage.header.bits,
        wanted=[frame + offset for frame in present],
        total=len(present),
        arriving=arriving(),
        earliest=earliest,
        absent=[frame + offset for frame in absent],
        folder=Path(footage.sequence.pattern).parent,
        marks=marks,
        size_of=lambda frame: size_of(footage.sequence.path(frame - offset)),
    )


def _camera(device: int, seconds: float, transfer: str, start: int) -> Source:
    frames = camera_frames(device, seconds)
    first = next(frames)
    header = Header(first.coded.shape[1], first.coded.shape[0])
    # A recording is never the same twice.
    mark = uuid.uuid4().hex

    def load(item: MovieFrame) -> Loaded:
        return Loaded(item.coded, header, mark)

    def arriving() -> Iterator[Arriving]:
        for item in chain([first], frames):
            yield Arriving(start + item.position, item.seconds, partial(load, item))

    return Source(
        name=f"camera {device}",
        fingerprint=mark,
        header=header,
        transfer="srgb",
        assumed=["cameras are taken as sRGB-encoded, 8 bit"] if transfer == "auto" else [],
        bits=8,
        wanted=None,
        total=0,
        arriving=arriving(),
        earliest=lambda: load(first),
    )
