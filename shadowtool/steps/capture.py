"""Footage from a movie, a sequence or a camera to numbered linear frames, and what it is worth."""

import logging
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Format
from shadowtool.core import camera_motion
from shadowtool.core.noise import NoiseSamples, noise_levels
from shadowtool.core.shadow_time import luminance
from shadowtool.core.transfer import TRANSFERS
from shadowtool.errors import InputError, OptionError, ReshootError
from shadowtool.io.files import fingerprint_file, fingerprint_movie, make_folder
from shadowtool.io.image import (
    EXR,
    PNG,
    Header,
    read_image,
    to_code,
    to_half,
    write_exr,
    write_png,
)
from shadowtool.io.products import MANIFEST, read_manifest, write_json
from shadowtool.io.sequence import Frame, frame_file, frame_range, parse_frames
from shadowtool.io.video import Movie, MovieFrame, camera_frames, is_movie
from shadowtool.parallel import ordered_map
from shadowtool.steps.footage import Footage, open_footage
from shadowtool.steps.run import Recipe, Result, Run, current, refuse_existing, write_manifest

logger = logging.getLogger(__name__)

Float32 = NDArray[np.float32]

RECORD = "capture.json"
FIRST_FRAME = 1001
# A camera counts as moved from here on, pixels.
_MOVED = 0.25
# Neighbouring frames this much more alike than those around are the same picture twice.
_DOUBLED = 0.05
_GRID = 8
# The part of the record that is shown when the step is done.
_FIGURES = ("transfer", "bits", "frame_rate", "camera_motion", "clipped", "dropped", "doubled")


@dataclass(frozen=True)
class Crop:
    """A part of the picture, pixels from the upper left corner."""

    width: int
    height: int
    x: int
    y: int


@dataclass(frozen=True)
class _Taken:
    """A frame on its way in."""

    frame: Frame
    seconds: float | None
    values: NDArray[np.floating]
    linear: bool
    fingerprint: str


@dataclass
class _Source:
    """Where frames come from, and what is known of it beforehand."""

    name: str
    fingerprint: str
    header: Header
    transfer: str
    assumed: list[str]
    bits: int | None
    frames: list[Frame] | None
    taken: Iterator[_Taken]
    absent: list[Frame] = field(default_factory=list)


@dataclass
class _Report:
    """Collects, frame by frame in order, what `capture.json` says."""

    noise: NoiseSamples = field(default_factory=NoiseSamples)
    shifts: dict[str, float | None] = field(default_factory=dict)
    likeness: list[tuple[Frame, float]] = field(default_factory=list)
    seconds: list[tuple[Frame, float]] = field(default_factory=list)
    clipped: list[float] = field(default_factory=list)
    before: Float32 | None = None

    def add(self, taken: _Taken, values: NDArray[np.floating], shift: float | None) -> None:
        self.noise.add(values)
        grid = values[::_GRID, ::_GRID].astype(np.float32)
        if self.before is not None:
            self.likeness.append((taken.frame, float(np.nanmean(np.abs(grid - self.before)))))
        self.before = grid
        self.shifts[str(taken.frame)] = shift
        if taken.seconds is not None:
            self.seconds.append((taken.frame, taken.seconds))

    def doubled(self) -> list[Frame]:
        """Frames that repeat the one before, while before and after something moves."""
        differences = [difference for _, difference in self.likeness]
        repeated = []
        for number, (frame, difference) in enumerate(self.likeness):
            around = differences[max(number - 1, 0) : number] + differences[number + 1 : number + 2]
            if around and min(around) > 0 and difference <= _DOUBLED * min(around):
                repeated.append(frame)
        return repeated

    def dropped(self, rate: Fraction | None) -> list[Frame]:
        """Frames before which at least one is missing by the clock."""
        if rate is None:
            return []
        pairs = zip(self.seconds, self.seconds[1:], strict=False)
        return [now[0] for before, now in pairs if (now[1] - before[1]) * float(rate) > 1.5]


def capture(
    source: str | Path | None,
    output: Path,
    *,
    run: Run = Run(),
    transfer: str = "auto",
    start: int | None = None,
    crop: Crop | None = None,
    scale: float = 1.0,
    file_format: Format = "exr",
    strict: bool = False,
    device: int | None = None,
    seconds: float | None = None,
) -> Result:
    """Write linear EXR (or sRGB-encoded 16-bit PNG) frames and ``capture.json``.

    Args:
        source: a movie or a sequence; None with ``device``.
        start: number of the first frame; None keeps a sequence's own and starts movies at 1001.
        crop: applied before ``scale``.
        strict: a camera that moved is an error.
        device, seconds: a camera's number and how long to record it.

    Raises:
        InputError: nothing usable at ``source``.
        OptionError: options that make no sense with the picture or each other.
        ReshootError: with ``strict``, the camera moved.
    """
    opened = _open(source, device, seconds, run, transfer, start)
    if transfer == "auto":
        transfer = opened.transfer
    size = _size(opened.header, crop, scale)
    suffix = EXR if file_format == "exr" else PNG
    name = output.resolve().name
    header = replace(opened.header, width=size[0], height=size[1], origin=(0, 0), provenance={})
    recipe = Recipe(
        "capture",
        {
            "transfer": transfer,
            "crop": None if crop is None else f"{crop.width}x{crop.height}+{crop.x}+{crop.y}",
            "scale": scale,
            "format": file_format,
        },
        {"input": opened.name},
    )
    mark = recipe.fingerprint([opened.fingerprint, str(run.frames), str(start)])

    def place(frame: Frame) -> Path:
        return output / frame_file(name, frame, suffix)

    if run.resume and (kept := _kept(output, mark, place)) is not None:
        return kept
    if opened.frames is not None:
        refuse_existing(map(place, opened.frames), run)
    elif output.is_dir():
        refuse_existing(sorted(output.glob(f"{name}.*{suffix}")), run)
    reference: list[Float32] = []

    def prepared() -> Iterator[_Taken]:
        for taken in opened.taken:
            if not reference:
                make_folder(output)
                linear = _linear(taken, transfer, crop, size)
                reference.append(camera_motion.prepare(luminance(linear)))
            yield taken

    def work(taken: _Taken) -> tuple[_Taken, NDArray[np.floating], float | None, float]:
        linear = _linear(taken, transfer, crop, size)
        path, own = place(taken.frame), recipe.fingerprint([taken.fingerprint])
        if run.resume and current([path], own) is not None:
            pass
        elif suffix == EXR:
            write_exr(path, {"RGB": to_half(linear)}, header, recipe.provenance(own))
        else:
            write_png(path, to_code(linear), recipe.provenance(own))
        gray = camera_motion.prepare(luminance(linear))
        shift = camera_motion.shift(reference[0], gray, size[0])
        top = 1.0 if taken.linear else 0.999
        clipped = float((taken.values >= top).any(axis=-1).mean())
        return taken, linear, shift, clipped

    report = _Report()
    frames: list[Frame] = []
    rows: dict[str, Any] = {}
    total = len(opened.frames) if opened.frames is not None else 0
    run.progress(0, total)
    for taken, linear, shift, clipped in ordered_map(work, prepared(), run.jobs):
        frames.append(taken.frame)
        rows[str(taken.frame)] = {"fingerprint": recipe.fingerprint([taken.fingerprint])}
        report.add(taken, linear, shift)
        report.clipped.append(clipped)
        run.progress(len(frames), max(total, len(frames)))
    if not frames:
        raise InputError(f"{opened.name}: no frame of the wanted range is in it")
    record = _record(opened, report, frames, transfer, header)
    write_json(output / RECORD, record)
    figures = {
        key: record[key]
        for key in (
            "transfer",
            "bits",
            "frame_rate",
            "camera_motion",
            "clipped",
            "dropped",
            "doubled",
        )
    }
    write_manifest(output, recipe, mark, figures, rows)
    _warn(record, strict, output)
    return Result("capture", output, frames, 0, opened.absent, figures)


def _open(
    source: str | Path | None,
    device: int | None,
    seconds: float | None,
    run: Run,
    transfer: str,
    start: int | None,
) -> _Source:
    if device is not None:
        if source is not None or seconds is None or seconds <= 0:
            raise OptionError("--device N takes --seconds T and no INPUT")
        return _from_camera(device, seconds, FIRST_FRAME if start is None else start)
    if source is None:
        raise OptionError("give a movie, a sequence, or --device N --seconds T")
    path = Path(source)
    if path.is_file() and path.suffix.lower() not in (EXR, PNG):
        if not is_movie(path):
            raise InputError(f"{path}: neither a movie that can be decoded nor EXR or PNG frames")
        return _from_movie(path, run, transfer, FIRST_FRAME if start is None else start)
    footage = open_footage(source, "input", transfer, run.missing)
    return _from_sequence(footage, run, start)


def _from_movie(path: Path, run: Run, transfer: str, start: int) -> _Source:
    movie = Movie(path)
    info = movie.info
    if info.transfer is None and transfer == "auto":
        raise InputError(f"{path}: its transfer function can't be undone here; give --transfer")
    wanted = None if run.frames is None else set(parse_frames(run.frames))
    mark = fingerprint_movie(path)

    def taken() -> Iterator[_Taken]:
        for item in movie.frames():
            frame = start + item.position
            if wanted is None or frame in wanted:
                yield _Taken(frame, item.seconds, item.coded, False, f"{mark} {item.position}")

    return _Source(
        name=path.name,
        fingerprint=mark,
        header=Header(info.width, info.height, frame_rate=info.frame_rate),
        transfer=info.transfer or transfer,
        assumed=list(info.assumed),
        bits=info.bits,
        frames=None if wanted is None else sorted(wanted),
        taken=taken(),
    )


def _from_sequence(footage: Footage, run: Run, start: int | None) -> _Source:
    frames, absent = footage.sequence.select(run.frames, run.missing)
    first = footage.sequence.frames[0]
    offset = 0 if start is None else start - first
    rate = footage.header.frame_rate
    image = read_image(footage.sequence.path(frames[0]))
    integer = next(iter(image.layers.values())).dtype
    bits = {"uint8": 8, "uint16": 16}.get(integer.name)
    kind = "PNG" if bits else "EXR"
    marks = [fingerprint_file(footage.sequence.path(frame)) for frame in frames]

    def taken() -> Iterator[_Taken]:
        for frame in frames:
            stored = footage.image(frame)
            values = stored.rgb("none")
            seconds = None if rate is None else float(Fraction(frame - first) / rate)
            yield _Taken(frame + offset, seconds, values, bits is None, stored.fingerprint)

    return _Source(
        name=Path(footage.sequence.pattern).name,
        fingerprint=" ".join(marks),
        header=footage.header,
        transfer=footage.transfer,
        assumed=[f"{kind} frames are taken as {footage.transfer}"],
        bits=bits,
        frames=[frame + offset for frame in frames],
        taken=taken(),
        absent=absent,
    )


def _from_camera(device: int, seconds: float, start: int) -> _Source:
    frames = camera_frames(device, seconds)
    first = next(frames)
    height, width = first.coded.shape[:2]
    # A recording is never the same twice.
    mark = uuid.uuid4().hex

    def taken() -> Iterator[_Taken]:
        def all_frames() -> Iterator[MovieFrame]:
            yield first
            yield from frames

        for item in all_frames():
            yield _Taken(start + item.position, item.seconds, item.coded, False, mark)

    return _Source(
        name=f"camera {device}",
        fingerprint=mark,
        header=Header(width, height),
        transfer="srgb",
        assumed=["cameras are taken as sRGB-encoded, 8 bit"],
        bits=8,
        frames=None,
        taken=taken(),
    )


def _kept(output: Path, mark: str, place: Callable[[Frame], Path]) -> Result | None:
    """The result of an earlier run of the same, if all that it wrote is still there and whole."""
    manifest = read_manifest(output)
    rows, figures = manifest.get("frames"), manifest.get("figures")
    if manifest.get("fingerprint") != mark or not isinstance(rows, dict) or figures is None:
        return None
    try:
        frames = parse_frames(",".join(rows))
    except OptionError:
        return None
    whole = (output / RECORD).is_file() and all(
        current([place(frame)], rows[str(frame)]["fingerprint"]) is not None for frame in frames
    )
    if not whole:
        return None
    write_json(output / MANIFEST, manifest)
    return Result("capture", output, frames, len(frames), (), figures)


def _size(header: Header, crop: Crop | None, scale: float) -> tuple[int, int]:
    width, height = header.size
    if crop is not None:
        if crop.x + crop.width > width or crop.y + crop.height > height:
            raise OptionError(
                f"--crop {crop.width}x{crop.height}+{crop.x}+{crop.y} reaches outside the"
                f" picture of {width}x{height}"
            )
        width, height = crop.width, crop.height
    if not 0 < scale <= 16:
        raise OptionError(f"--scale {scale}: must be above 0 and at most 16")
    return max(1, round(width * scale)), max(1, round(height * scale))


def _linear(taken: _Taken, transfer: str, crop: Crop | None, size: tuple[int, int]) -> Float32:
    values = TRANSFERS[transfer].decode(taken.values)
    if crop is not None:
        values = values[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]
    if (values.shape[1], values.shape[0]) != size:
        smaller = size[0] < values.shape[1]
        method = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
        values = np.asarray(cv2.resize(np.ascontiguousarray(values), size, interpolation=method))
    return np.asarray(values, np.float32)


def _record(
    opened: _Source, report: _Report, frames: list[Frame], transfer: str, header: Header
) -> dict[str, Any]:
    measured = {f: s for f, s in report.shifts.items() if s is not None}
    most = max(measured, key=lambda f: measured[f]) if measured else None
    moved = next((f for f, s in measured.items() if s > _MOVED), None)
    rate = opened.header.frame_rate
    return {
        "input": opened.name,
        "frames": frame_range(frames),
        "width": header.width,
        "height": header.height,
        "bits": opened.bits,
        "transfer": transfer,
        "assumed": opened.assumed,
        "frame_rate": None if rate is None else str(rate),
        "dropped": [str(f) for f in report.dropped(rate)],
        "doubled": [str(f) for f in report.doubled()],
        "clipped": round(float(np.mean(report.clipped)), 6),
        "noise": [
            {"channel": "RGB"[n.channel], "value": round(n.value, 6), "sigma": round(n.sigma, 7)}
            for n in noise_levels(report.noise.samples())
        ],
        "camera_motion": {
            "largest": None if most is None else round(measured[most], 4),
            "largest_at": most,
            "moved_at": moved,
            "unmeasured": len(report.shifts) - len(measured),
        },
    }


def _warn(record: dict[str, Any], strict: bool, output: Path) -> None:
    for sentence in record["assumed"]:
        logger.warning("%s: %s", record["input"], sentence)
    for what in ("dropped", "doubled"):
        if record[what]:
            logger.warning("%s: %s frames at %s", record["input"], what, ", ".join(record[what]))
    if record["clipped"] > 0.001:
        logger.warning("%s: %.1f%% of the pixels are clipped", output, 100 * record["clipped"])
    motion = record["camera_motion"]
    if motion["moved_at"] is not None:
        message = (
            f"{record['input']}: the camera moved, first seen in frame {motion['moved_at']}, by up"
            f" to {motion['largest']:.2f} pixels in frame {motion['largest_at']};"
            " stabilise the take or shoot it again"
        )
        if strict:
            raise ReshootError(message)
        logger.warning("%s", message)
