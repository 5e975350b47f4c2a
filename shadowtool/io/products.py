"""What the steps hand to each other: plates, scans, warp maps, and the record of how each was made.

Whatever is read here may have been edited by hand or by another program, so it is checked.
"""

import contextlib
import fcntl
import json
import logging
import math
import os
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shadowtool.core.half_floats import rounded, to_float, to_half
from shadowtool.core.plates import Plates
from shadowtool.core.shadow_lines import ShadowLines
from shadowtool.core.shadow_time import ShadowTimes
from shadowtool.core.warp_map import (
    Pass,
    WarpMap,
    error_of_confidence,
    from_st_map,
    to_st_map,
)
from shadowtool.errors import InputError
from shadowtool.io.files import fingerprint, is_file, read_bytes, write_bytes
from shadowtool.io.image import (
    EXR,
    PNG,
    Header,
    Image,
    encode_exr,
    read_image,
    resolve_transfer,
    write_exr,
)

logger = logging.getLogger(__name__)

MANIFEST = "shadowtool.json"
LINES = "lines.json"
SCAN = "scan.exr"
WARP = "warp.exr"
# Folders of frames, and what their files are called.
HOLDOUT_FOLDER, TRIMAP_FOLDER, FIGURE_FOLDER, BETA_FOLDER = "holdout", "trimap", "fg", "beta"
# Those that lie where the plates see the scene from, by the step that writes them.
_IN_PLACE = {"plate": (HOLDOUT_FOLDER,), "matte": (TRIMAP_FOLDER, FIGURE_FOLDER)}

# In pictures' widths or heights, from the middle.
_FAR_OUTSIDE = 2.0

Provenance = Mapping[str, str]


@dataclass(frozen=True)
class StoredPlates:
    """Plates from a folder, with what their files say of themselves.

    Attributes:
        transfer: how their code values were decoded, "linear" if they are light already.
    """

    plates: Plates
    header: Header
    fingerprint: str
    transfer: str


def plate_files(folder: Path) -> list[Path]:
    """The files under which `plate` writes."""
    return [folder / f"{name}{EXR}" for name in ("lit", "shadow", "confidence")]


def read_plates(folder: Path, transfer: str = "auto") -> StoredPlates:
    """Read ``lit`` and ``shadow`` (EXR or PNG), and ``confidence.exr`` if it is there.

    Args:
        transfer: of plates in PNG; those in EXR are taken as they are.

    Raises:
        InputError: a plate is missing, or their sizes differ.
    """
    images = [read_image(_plate(folder, name)) for name in ("lit", "shadow")]
    lit, shadow = images
    if lit.header.size != shadow.header.size:
        raise InputError(
            f"{folder}: lit is {_size(lit.header)}, shadow is {_size(shadow.header)};"
            " plates must be of one size"
        )
    frames = shadow_frames = None
    confidence = folder / f"confidence{EXR}"
    if is_file(confidence):
        image = read_image(confidence)
        images.append(image)
        frames = _counts(image.channel("frames"))
        if "shadow_frames" in image.layers:
            shadow_frames = _counts(image.channel("shadow_frames"))
        if image.header.size != lit.header.size:
            raise InputError(f"{confidence}: is not of the plates' size")
    coded = [
        resolve_transfer(transfer, image.path) if image.path.suffix.lower() == PNG else "linear"
        for image in (lit, shadow)
    ]
    light, shade = (to_float(i.rgb(own)) for i, own in zip((lit, shadow), coded, strict=True))
    plates = Plates(light, shade, frames, shadow_frames)
    mark = " ".join(image.fingerprint for image in images)
    # One in EXR may stand beside one in PNG, of which there is more to say.
    said = next((own for own in coded if own != "linear"), "linear")
    return StoredPlates(plates, lit.header, mark, said)


def _counts(values: NDArray[np.float32]) -> NDArray[np.uint32]:
    counts = np.clip(np.nan_to_num(values, posinf=0, neginf=0), 0, 2**31)
    return np.asarray(counts, np.uint32)


def _plate(folder: Path, name: str) -> Path:
    for suffix in (EXR, PNG):
        if is_file(folder / f"{name}{suffix}"):
            return folder / f"{name}{suffix}"
    raise InputError(f"{folder}: has no {name}{EXR}; make the plates with `shadowtool plate`")


def confidence_layers(
    plates: Plates, contrast: NDArray[np.float32]
) -> dict[str, NDArray[np.floating]]:
    """What ``confidence.exr`` holds: contrast, frames, and shadow_frames for plates that are not
    extremes.

    The contrast becomes a half: further digits of it say nothing, and take up most of the room.
    """
    counts = {"frames": plates.frames, "shadow_frames": plates.shadow_frames}
    layers: dict[str, NDArray[np.floating]] = {"contrast": to_half(contrast)}
    layers |= {name: n.astype(np.float32) for name, n in counts.items() if n is not None}
    return layers


def encode_times(
    folder: Path,
    times: ShadowTimes,
    plane: NDArray[np.bool_] | None,
    header: Header,
    provenance: Provenance,
) -> memoryview:
    """The bytes of the folder's ``scan.exr``, which take a while and don't depend on the lines.

    Of errors and contrast a half keeps all digits that say something; contrast stays a single
    float, as other programs expect it.
    """
    layers = {part.name: getattr(times, part.name) for part in fields(times)}
    layers |= {name: rounded(layers[name]) for name in ("error", "own_error")}
    layers["contrast"] = to_float(rounded(times.contrast))
    if plane is not None:
        layers["plane"] = plane.astype(np.float16)
    return encode_exr(folder / SCAN, layers, header, provenance, quick=True)


def write_scan(
    folder: Path,
    scan: Pass,
    header: Header,
    provenance: Provenance,
    encoded: memoryview | None = None,
) -> None:
    """Write ``scan.exr`` and ``lines.json``.

    Args:
        encoded: what `encode_times` made of the pass's times, if it was called before.
    """
    if encoded is None:
        encoded = encode_times(folder, scan.times, scan.plane, header, provenance)
    write_bytes(folder / SCAN, encoded)
    lines = scan.lines
    rows = [
        {
            "frame": float(lines.frame[i]),
            "normal": [float(v) for v in lines.normal[i]],
            "offset": float(lines.offset[i]),
            "residual": float(lines.residual[i]),
            "points": int(lines.points[i]),
            "origin": lines.origin[i],
        }
        for i in range(len(lines))
    ]
    height, width = scan.times.time.shape
    record = {"width": width, "height": height, **provenance, "lines": rows}
    write_json(folder / LINES, record)


def read_scan(folder: Path) -> tuple[Pass, Header, str]:
    """Read what `write_scan` wrote: the pass, its header, and its fingerprint.

    Raises:
        InputError: a file is missing, or does not hold what it should.
    """
    if not is_file(folder / SCAN):
        raise InputError(f"{folder}: has no {SCAN}; make it with `shadowtool scan`")
    image = read_image(folder / SCAN)
    data = read_bytes(folder / LINES)
    lines = _parse_lines(folder / LINES, data, image)
    plane = image.channel("plane") > 0.5 if "plane" in image.layers else None
    scan = Pass(_parse_times(image), lines, plane)
    return scan, image.header, f"{image.fingerprint} {fingerprint(data)}"


def _parse_times(image: Image) -> ShadowTimes:
    """Times and errors; a scan of time and contrast alone knows each time to the interval."""
    time, contrast = _time(image.channel("time")), image.channel("contrast")
    contrast = np.where(np.isfinite(contrast), np.maximum(contrast, 0), np.float32(0))
    if not {"error", "own_time", "own_error"} <= image.layers.keys():
        return ShadowTimes.alone(time, contrast)
    own_time = _time(image.channel("own_time"))
    error, own_error = (
        np.where((values := image.channel(name)) > 0, values, np.float32(np.inf))
        for name in ("error", "own_error")
    )
    time[~np.isfinite(error)] = np.nan
    own_time[~np.isfinite(own_error)] = np.nan
    error[np.isnan(time)] = np.inf
    own_error[np.isnan(own_time)] = np.inf
    return ShadowTimes(time, error, contrast, own_time, own_error)


def _time(values: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(np.isfinite(values), values, np.float32(np.nan))


def _parse_lines(path: Path, data: bytes, image: Image) -> ShadowLines:
    try:
        record = json.loads(data)
        rows = record["lines"]
        lines = ShadowLines(
            frame=np.array([row["frame"] for row in rows], np.float64),
            normal=np.array([row["normal"] for row in rows], np.float64),
            offset=np.array([row["offset"] for row in rows], np.float64),
            residual=np.array([row["residual"] for row in rows], np.float64),
            points=np.array([_count(row.get("points", 0)) for row in rows], np.int64),
            origin=tuple(str(row.get("origin", "fit")) for row in rows),  # type: ignore[misc]
        )
        size = (int(record["width"]), int(record["height"]))
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
        raise InputError(f"{path}: holds no shadow lines; run `shadowtool scan` again") from None
    count = len(lines)
    columns = (lines.frame, lines.offset, lines.residual)
    if count < 2 or lines.normal.shape != (count, 2) or any(c.shape != (count,) for c in columns):
        raise InputError(f"{path}: holds no shadow lines; run `shadowtool scan` again")
    # Beyond this a number is no position in a picture, and squares of it would overflow.
    sane = all((np.abs(column) < 1e9).all() for column in (*columns, lines.normal))
    if (
        not sane
        or not (np.abs(np.hypot(*lines.normal.T) - 1) < 1e-3).all()
        or not (np.diff(lines.frame) > 0).all()
        or (lines.residual < 0).any()
    ):
        raise InputError(f"{path}: its lines are no lines; run `shadowtool scan` again")
    if size != image.header.size:
        raise InputError(f"{path}: is for {size[0]}x{size[1]}, {SCAN} is {_size(image.header)}")
    return lines


def _count(value: Any) -> int:
    if not isinstance(value, int) or not 0 <= value < 2**53:
        raise ValueError
    return value


def write_warp(path: Path, warp_map: WarpMap, header: Header, provenance: Provenance) -> None:
    """Write an ST map: R, G = u, v, B = 0, A = confidence; float32."""
    height, width = warp_map.error.shape
    layers = np.zeros((height, width, 4), np.float32)
    layers[..., :2] = to_st_map(warp_map.warp, width, height)
    layers[..., 3] = warp_map.confidence
    write_exr(path, {"RGBA": layers}, header, provenance)


def map_place(path: Path) -> Path:
    """The ST map that a path stands for: the one in a folder of `warp`, or the file itself."""
    with contextlib.suppress(OSError):
        if path.is_dir():
            return path / WARP
    return path


def made_by(header: Header) -> str:
    """The step of ours that wrote a file; nothing if it doesn't say."""
    return "".join(header.provenance.get("command", "").split()[1:2])


def holds_codes(header: Header) -> bool | None:
    """Whether a step of ours wrote code values for light, as it was told to take a PNG's as they
    are; None if the file doesn't say."""
    try:
        words = shlex.split(header.provenance.get("command", ""))
        taken = words[words.index("--transfer") + 1]
    except (ValueError, IndexError):
        return None
    return taken == "none" and any(word.lower().endswith(PNG) for word in words)


def in_place(image: Path, header: Header) -> bool:
    """Whether a matte is one of ours, which lie where the plates see the scene from: by what the
    file says of itself, or, as a paint program drops that, by the folder that it lies in."""
    step = made_by(header) or read_record(image.parent.parent / MANIFEST).get("step")
    return step in _IN_PLACE and (bool(made_by(header)) or image.parent.name in _IN_PLACE[step])


def read_warp(path: Path) -> tuple[WarpMap, Header, str]:
    """Read an ST map as W in pixels of a source picture of the map's own size.

    Raises:
        InputError: it has no R and G, or is plainly another kind of picture.
    """
    image = read_image(path)
    st_map = np.stack([image.channel("R"), image.channel("G")], axis=-1)
    _require_st_map(image, st_map)
    height, width = st_map.shape[:2]
    error = np.zeros((height, width), np.float32)
    if "RGBA" in image.layers:
        error = error_of_confidence(image.channel("A"))
    return WarpMap(from_st_map(st_map, width, height), error), image.header, image.fingerprint


def _require_st_map(image: Image, st_map: NDArray[np.float32]) -> None:
    if (step := made_by(image.header)) not in ("", "warp"):
        raise InputError(f"{image.path}: was made by `shadowtool {step}`, is no ST map")
    if image.header.bits == 8:
        raise InputError(f"{image.path}: 8 bits can't tell pixels apart; give an ST map in EXR")
    if any(values.dtype == np.float16 for values in image.layers.values()):
        logger.warning(
            "%s: half floats are too coarse for an ST map, by up to half a pixel at 2K; write it as"
            " 32 bit float",
            image.path,
        )
    known = st_map[np.isfinite(st_map).all(axis=-1)]
    # A map in pixels, or of displacements, has most of its values elsewhere.
    if not known.size or np.median(np.abs(known - 0.5)) > _FAR_OUTSIDE:
        raise InputError(
            f"{image.path}: is no ST map: R and G are to be u and v, 0 to 1 across the picture"
        )


def read_record(path: Path) -> dict[str, Any]:
    """A JSON record of ours; empty if there is none, or none that can be read."""
    try:
        record = json.loads(path.read_bytes(), parse_constant=_finite, parse_float=_finite)
    except (OSError, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _finite(number: str) -> float:
    """A number of a record; what is no number makes the record one that can't be read."""
    value = float(number)
    if not math.isfinite(value):
        raise ValueError(f"{number} is no number")
    return value


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record so that the same content gives the same bytes; what is no number, null."""
    text = json.dumps(_plain(record), indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)
    write_bytes(path, text.encode("utf-8", "replace") + b"\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(own) for key, own in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(own) for own in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Keep other processes of ours from rewriting the folder's manifest meanwhile."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        yield
        return
    try:
        # Some network file systems lock no folders; there the rename alone has to do.
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _size(header: Header) -> str:
    return f"{header.width}x{header.height}"
