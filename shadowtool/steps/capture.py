"""Footage from a movie, a sequence or a camera to numbered linear frames, and what it is worth."""

import itertools
import logging
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Format
from shadowtool.core import camera_motion
from shadowtool.core.half_floats import LARGEST_HALF, not_finite, to_half
from shadowtool.core.noise import NoiseSamples, noise_levels, thin
from shadowtool.core.resizing import resized
from shadowtool.core.shadow_time import luminance
from shadowtool.core.transfer import TRANSFERS
from shadowtool.errors import (
    InputError,
    MissingError,
    OptionError,
    ReshootError,
)
from shadowtool.io.files import new_folders, real
from shadowtool.io.image import EXR, PNG, Header, to_code, write_exr, write_png
from shadowtool.io.products import MANIFEST, folder_lock, read_record, write_json
from shadowtool.io.sequence import Frame, frame_file, frame_range
from shadowtool.parallel import ordered_map
from shadowtool.steps.intake import Arriving, Source, open_source
from shadowtool.steps.run import (
    Figures,
    Recipe,
    Result,
    Run,
    current,
    name_of_frames,
    or_missing,
    refuse_existing,
    refuse_other_format,
    refuse_other_step,
    say_skipped,
    warn_of_nan,
    with_other_chunks,
    write_manifest,
)

logger = logging.getLogger(__name__)

Float32 = NDArray[np.float32]

RECORD = "capture.json"
# A camera counts as moved from here on, pixels.
_MOVED = 0.25
# Neighbouring frames this much more alike than those around are the same picture twice.
_DOUBLED = 0.05
_GRID = 8
# Integer code values from here on are clipped; floating point ends only where halfs do.
_CLIPPED_CODE = 0.999
# The part of the record that is shown when the step is done.
_FIGURES = ("transfer", "bits", "frame_rate", "camera_motion", "clipped", "dropped", "doubled")


@dataclass(frozen=True)
class Crop:
    """A part of the picture, pixels from the upper left corner."""

    width: int
    height: int
    x: int
    y: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}+{self.x}+{self.y}"


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
        InputError: nothing usable at ``source``, or wanted frames are not in it.
        OptionError: options that make no sense with the picture or each other.
        ReshootError: with ``strict``, the camera moved.
    """
    opened = open_source(
        source,
        device=device,
        seconds=seconds,
        frames=run.frames,
        missing=run.missing,
        transfer=transfer,
        start=start,
    )
    if transfer == "auto":
        transfer = opened.transfer
    size = _size(opened.header, crop, scale)
    recipe = Recipe(
        "capture",
        {
            "transfer": transfer,
            "start": start,
            "crop": None if crop is None else str(crop),
            "scale": scale,
            "format": file_format,
        },
        {"input": opened.name},
    )
    suffix = EXR if file_format == "exr" else PNG
    name = name_of_frames(output)
    taking = _Taking(opened, recipe, output, name, suffix, transfer, crop, size, run)
    mark = recipe.fingerprint([opened.fingerprint])
    refuse_other_step("capture", output, run)
    if opened.folder is not None and real(output) == real(opened.folder):
        raise OptionError(f"{output}: is the folder of the frames to capture; give another -o")
    if run.resume and (kept := taking.kept(mark)) is not None:
        if strict:
            _require_still(opened.name, kept.figures["camera_motion"])
        return kept
    refuse_other_format(output, name, suffix)
    if opened.wanted is not None:
        refuse_existing(map(taking.place, opened.wanted), run)
    else:
        refuse_existing(sorted(output.glob(f"*{suffix}")), run)
    with new_folders([output], shared=run.frames is not None):
        frames, skipped, report = taking.take()
        if not frames:
            raise InputError(f"{opened.name}: no frame of the wanted range is in it")
    absent = [f for f in opened.wanted or () if f not in frames and f not in skipped]
    if absent and run.missing == "error":
        raise InputError(
            f"{opened.name}: has no frames {frame_range(absent)}; its last is {opened.last()}"
        )
    if opened.wanted is None and len(frames) + len(skipped) < opened.total:
        logger.warning(
            "%s: says that it has %d frames, but %d are in it; it may be cut off",
            opened.name,
            opened.total,
            len(frames),
        )
    record = recipe.provenance(mark) | _record(opened, report, frames, transfer, size)
    write_json(output / RECORD, record)
    _warn(record, output)
    warn_of_nan(output, report.not_finite)
    motion = record["camera_motion"]
    if strict:
        _require_still(opened.name, motion)
    elif motion["moved_at"] != "never":
        logger.warning("%s", _moved(opened.name, motion))
    taking.finish(mark, report.marks)
    return Result(
        "capture",
        output,
        frames,
        report.kept,
        [*opened.absent, *skipped, *absent],
        _figures(record),
    )


class _Measured(NamedTuple):
    """What is kept of a frame once it is written.

    Attributes:
        mark: the fingerprint in its file.
        thinned: as of `thin`.
        grid: a few of its pixels, to be compared with the next frame's.
    """

    frame: Frame
    seconds: float | None
    mark: str
    thinned: Float32
    grid: Float32
    shift: float | None
    clipped: float
    not_finite: int
    kept: bool


@dataclass
class _Report:
    """Collects, frame by frame in order, what `capture.json` says."""

    noise: NoiseSamples = field(default_factory=NoiseSamples)
    shifts: dict[str, float | None] = field(default_factory=dict)
    likeness: list[tuple[Frame, float]] = field(default_factory=list)
    seconds: list[tuple[Frame, float]] = field(default_factory=list)
    clipped: list[float] = field(default_factory=list)
    marks: dict[Frame, str] = field(default_factory=dict)
    not_finite: dict[str, int] = field(default_factory=dict)
    kept: int = 0
    before: Float32 | None = None

    def add(self, measured: _Measured) -> None:
        frame, seconds = measured.frame, measured.seconds
        self.noise.add(measured.thinned)
        if self.before is not None:
            self.likeness.append((frame, float(np.abs(measured.grid - self.before).mean())))
        self.before = measured.grid
        self.marks[frame] = measured.mark
        self.shifts[str(frame)] = measured.shift
        self.clipped.append(measured.clipped)
        self.not_finite[str(frame)] = measured.not_finite
        self.kept += measured.kept
        if seconds is not None:
            self.seconds.append((frame, seconds))

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
        late = []
        for (before, then), (frame, now) in itertools.pairwise(self.seconds):
            if (now - then) * float(rate) - float(frame - before) > 0.5:
                late.append(frame)
        return late


@dataclass(frozen=True)
class _Taking:
    """One run: from the source's frames to files."""

    source: Source
    recipe: Recipe
    output: Path
    name: str
    suffix: str
    transfer: str
    crop: Crop | None
    size: tuple[int, int]
    run: Run

    def place(self, frame: Frame) -> Path:
        return self.output / frame_file(self.name, frame, self.suffix)

    def take(self) -> tuple[list[Frame], list[Frame], _Report]:
        """Write all frames; those written, those skipped, and what was measured."""
        report, frames, skipped = _Report(), list[Frame](), list[Frame]()
        # The camera's motion is measured from the first frame of all, whichever are wanted.
        first = self.source.earliest()
        reference = None if first is None else self._prepared(self._linear(first.values))

        write = or_missing(partial(self._write, reference=reference), self.run)

        def work(arriving: Arriving) -> tuple[Frame, _Measured | MissingError]:
            return arriving.frame, write(arriving)

        total = self.source.total
        self.run.progress(0, total)
        for number, (frame, done) in enumerate(
            ordered_map(work, self.source.arriving, self.run.jobs), start=1
        ):
            if isinstance(done, MissingError):
                say_skipped(done)
                skipped.append(frame)
            else:
                frames.append(frame)
                report.add(done)
            self.run.progress(number, max(total, number) if total else 0)
        if frames:
            self.run.progress(len(frames), len(frames))
        return frames, skipped, report

    def _write(self, arriving: Arriving, reference: Float32 | None) -> _Measured:
        loaded = arriving.load()
        linear = self._linear(loaded.values)
        path, mark = self.place(arriving.frame), self.recipe.fingerprint([loaded.fingerprint])
        kept = self.run.resume and current([path], mark) is not None
        if not kept:
            provenance = self.recipe.provenance(mark)
            if self.suffix == EXR:
                width, height = self.size
                origin = loaded.header.origin if self.size == loaded.header.size else (0, 0)
                header = replace(loaded.header, width=width, height=height, origin=origin)
                write_exr(path, {"RGB": to_half(linear)}, header, provenance)
            else:
                write_png(path, to_code(linear), provenance)
        gray = self._prepared(linear)
        shift = None if reference is None else camera_motion.shift(reference, gray, self.size[0])
        top = LARGEST_HALF if self.source.bits is None else _CLIPPED_CODE
        clipped = float((self._cropped(loaded.values) >= top).any(axis=-1).mean())
        bad = not_finite(linear)
        count = 0 if bad is None else int(np.count_nonzero(bad))
        grid = np.clip(np.nan_to_num(linear[::_GRID, ::_GRID]), -1e4, 1e4)
        seen = arriving.frame, arriving.seconds, mark, thin(linear), grid
        return _Measured(*seen, shift, clipped, count, kept)

    @staticmethod
    def _prepared(linear: Float32) -> Float32:
        return camera_motion.prepare(luminance(linear))

    def _cropped(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        if (crop := self.crop) is None:
            return values
        return values[crop.y : crop.y + crop.height, crop.x : crop.x + crop.width]

    def _linear(self, coded: NDArray[np.floating]) -> Float32:
        """A picture's light, cropped and at the size that is written."""
        values = TRANSFERS[self.transfer].decode(self._cropped(coded))
        if (values.shape[1], values.shape[0]) != self.size:
            values = resized(values, self.size)
        return values

    def kept(self, mark: str) -> Result | None:
        """The result of an earlier run of the same, if all that is wanted is there and whole; what
        a movie has without being asked for certain frames is known only when it has been read."""
        manifest = read_record(self.output / MANIFEST)
        rows, record = manifest.get("frames"), read_record(self.output / RECORD)
        frames = self.source.wanted
        if frames is None or manifest.get("fingerprint") != mark or not isinstance(rows, dict):
            return None
        # What was measured of other frames says nothing of these.
        if record.get("frames") != frame_range(frames):
            return None
        if not isinstance(record.get("camera_motion"), dict):
            return None
        marks = self.source.marks(self.run.jobs)
        for frame in frames:
            row = rows.get(str(frame))
            mark = str(row.get("fingerprint")) if isinstance(row, dict) else ""
            if marks:
                mark = self.recipe.fingerprint([marks[frame]])
            if current([self.place(frame)], mark) is None:
                return None
        # Written anew, so that make sees that the step has been looked after.
        write_json(self.output / MANIFEST, manifest)
        return Result(
            "capture", self.output, frames, len(frames), self.source.absent, _figures(record)
        )

    def _is_of_this(self, frame: Frame, row: Figures) -> bool:
        try:
            return self.source.size_of(frame) == row.get("read")
        except InputError:
            return False

    def finish(self, mark: str, marks: dict[Frame, str]) -> None:
        """Write the manifest, together with what other chunks of the same wrote."""
        rows: dict[str, Any] = {
            str(frame): {"fingerprint": own, "read": self.source.size_of(frame)}
            for frame, own in marks.items()
        }
        with folder_lock(self.output):
            rows = with_other_chunks(
                self.output, mark, rows, lambda frame: [self.place(frame)], self._is_of_this
            )
            write_manifest(self.output, self.recipe, mark, {}, rows)


def _size(header: Header, crop: Crop | None, scale: float) -> tuple[int, int]:
    width, height = header.size
    if crop is not None:
        if crop.x + crop.width > width or crop.y + crop.height > height:
            raise OptionError(f"--crop {crop}: reaches outside the picture of {width}x{height}")
        width, height = crop.width, crop.height
    if not 0 < scale <= 16:
        raise OptionError(f"--scale {scale}: must be above 0 and at most 16")
    return max(1, round(width * scale)), max(1, round(height * scale))


def _record(
    source: Source, report: _Report, frames: list[Frame], transfer: str, size: tuple[int, int]
) -> dict[str, Any]:
    measured = {f: s for f, s in report.shifts.items() if s is not None}
    most = max(measured, key=lambda f: measured[f]) if measured else None
    moved = next((f for f, s in measured.items() if s > _MOVED), None)
    rate = source.header.frame_rate
    return {
        "input": source.name,
        "frames": frame_range(frames),
        "width": size[0],
        "height": size[1],
        "bits": source.bits,
        "transfer": transfer,
        "assumed": source.assumed,
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
            "moved_at": "never" if moved is None else moved,
            "unmeasured": len(report.shifts) - len(measured),
        },
    }


def _figures(record: dict[str, Any]) -> Figures:
    return {key: record.get(key) for key in _FIGURES}


def _warn(record: dict[str, Any], output: Path) -> None:
    for sentence in record["assumed"]:
        logger.warning("%s: %s", record["input"], sentence)
    for what in ("dropped", "doubled"):
        if record[what]:
            logger.warning("%s: %s frames at %s", record["input"], what, ", ".join(record[what]))
    if record["clipped"] > 0.001:
        logger.warning("%s: %.1f%% of the pixels are clipped", output, 100 * record["clipped"])


def _require_still(name: str, motion: dict[str, Any]) -> None:
    if motion.get("moved_at", "never") != "never":
        raise ReshootError(_moved(name, motion))


def _moved(name: str, motion: dict[str, Any]) -> str:
    return (
        f"{name}: the camera moved, first seen in frame {motion.get('moved_at')}, by up to"
        f" {motion.get('largest')} pixels in frame {motion.get('largest_at')};"
        " stabilise the take or shoot it again"
    )
