"""The figure and its shadow in the target scene."""

import contextlib
import logging
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Fill, Format
from shadowtool.core.bands import bands
from shadowtool.core.beta import inpaint
from shadowtool.core.boxes import Box
from shadowtool.core.compositing import over, shade, shadow_ratio
from shadowtool.core.filling import fill_membrane
from shadowtool.core.half_floats import not_finite, to_float, to_half
from shadowtool.core.warp_map import positions, sample
from shadowtool.errors import InputError, OptionError
from shadowtool.io.files import real
from shadowtool.io.image import (
    EXR,
    PNG,
    Header,
    Image,
    read_header,
    read_image,
    resolve_transfer,
    to_code,
    write_exr,
    write_png,
)
from shadowtool.io.products import (
    BETA_FOLDER,
    FIGURE_FOLDER,
    holds_codes,
    made_by,
    map_place,
    read_plates,
    read_warp,
)
from shadowtool.io.sequence import Frame, Sequence, frame_file, open_sequence
from shadowtool.steps.footage import (
    require_frames,
    require_size,
    say_mixed,
    say_taken_as,
    select_from,
)
from shadowtool.steps.run import (
    Figures,
    FrameWork,
    Recipe,
    Result,
    Run,
    name_of_frames,
    refuse_other_format,
    with_figures,
)

logger = logging.getLogger(__name__)

Float32 = NDArray[np.float32]
RATIO_FOLDER = "ratio"
_PIXEL = Box(slice(0, 1), slice(0, 1))


def composite(
    mattes: Path | None,
    output: Path,
    *,
    plates: Path,
    run: Run = Run(),
    warp: Path | None = None,
    foreground: str | Path | None = None,
    beta: str | Path | None = None,
    ratio: bool = False,
    fill: Fill = "lit",
    file_format: Format = "exr",
) -> Result:
    """Write the composite C' = αF + (1 - α)(β[W]·L' + (1 - β[W])·S').

    Args:
        mattes: a folder of `matte`, with ``fg/`` and ``beta/``; None if both are given apart.
        plates: the folder of the target scene's plates.
        warp: an ST map; without it the shadow stays as it fell in the source.
        foreground: frames with R, G, B, A, premultiplied, instead of ``fg/``.
        beta: frames instead of ``beta/``.
        ratio: write C'/L' without the figure too.
        fill: what unknown β becomes; "none" leaves NaN.

    Raises:
        InputError: an input is missing, or pictures differ in size.
    """
    figure_frames, beta_frames = (
        open_sequence(_part(mattes, folder) if given is None else given, role)
        for given, folder, role in (
            (foreground, FIGURE_FOLDER, "figure"),
            (beta, BETA_FOLDER, "β"),
        )
    )
    frames, absent = select_from((figure_frames, beta_frames), run.frames, run.missing)
    stored = read_plates(plates)
    say_taken_as(plates, stored.transfer)
    figure_transfer = resolve_transfer("auto", figure_frames.path(figure_frames.frames[0]))
    say_taken_as(figure_frames.pattern, figure_transfer)
    with contextlib.suppress(InputError):
        # A damaged one is skipped, or refused, in its turn.
        first = read_header(next(iter(figure_frames.files.values())))
        say_mixed(plates, stored.header, figure_frames.pattern, holds_codes(first))
    lit, shadow, repaired = _complete(stored.plates.lit, stored.plates.shadow)
    header = stored.header
    for sequence in (figure_frames, beta_frames):
        require_frames(sequence, frames, header, f"the plates in {plates}", run.missing)
    places: Float32 | None = None
    shared = [stored.fingerprint]
    if warp is not None:
        warp = map_place(warp)
        places, mark = _places(warp, header, f"the plates in {plates}")
        shared.append(mark)
    suffix = EXR if file_format == "exr" else PNG
    name = name_of_frames(output)
    refuse_other_format(output, name, suffix)
    recipe = Recipe(
        "composite",
        {"fill": fill, "format": file_format, "ratio": ratio},
        {
            "--fg": Path(figure_frames.pattern).name,
            "--beta-frames": Path(beta_frames.pattern).name,
            "--plates": real(plates).name,
        }
        | ({} if warp is None else {"--warp": warp.name}),
        {"--fg": figure_transfer, "--plates": stored.transfer},
    )
    if repaired:
        logger.warning(
            "%s: %d pixels of the plates are unknown and continued from around", plates, repaired
        )

    def products(frame: Frame) -> list[Path]:
        files = [output / frame_file(name, frame, suffix)]
        if ratio:
            files.append(output / RATIO_FOLDER / frame_file(RATIO_FOLDER, frame, EXR))
        return files

    def sources(frame: Frame) -> list[Path]:
        return [figure_frames.path(frame), beta_frames.path(frame)]

    def make(frame: Frame, provenance: dict[str, str]) -> Figures:
        visibility, unknown = _visibility(beta_frames, frame, fill)
        figure = read_image(figure_frames.path(frame))
        if places is not None:
            holes = not_finite(visibility) if unknown else None
            visibility = sample(visibility, places, outside=1.0, unknown=holes)
        result = np.empty(lit.shape, np.float16 if suffix == EXR else np.uint16)
        ratios = np.empty(lit.shape, np.float16) if ratio else None
        box = _figure_box(figure)
        bad = 0
        for rows in bands(lit.shape):
            coded = shade(lit[rows], shadow[rows], visibility[rows])
            if ratios is not None:
                ratios[rows] = to_half(shadow_ratio(coded, lit[rows]))
            if (part := _in_rows(box, rows)) is not None:
                colour, alpha, own = _figure(figure, part)
                bad += own
                first, last = part.rows.start - rows.start, part.rows.stop - rows.start
                coded[first:last, part.columns] = over(
                    colour, alpha, coded[first:last, part.columns]
                )
            result[rows] = to_half(coded) if suffix == EXR else to_code(coded)
        figures = {"unknown": unknown, "not_finite": bad}
        marked = with_figures(provenance, figures)
        target, *more = products(frame)
        if suffix == EXR:
            write_exr(target, {"RGB": result}, figure.header, marked)
        else:
            write_png(target, result, marked)
        if ratios is not None:
            write_exr(more[0], {"RGB": ratios}, figure.header, marked)
        return figures

    def summary(rows: list[Figures]) -> Figures:
        names = ("unknown", "not_finite")
        return {name: sum(int(row.get(name, 0)) for row in rows) for name in names}

    def others(frame: Frame) -> list[Path]:
        return [] if ratio else [output / RATIO_FOLDER / frame_file(RATIO_FOLDER, frame, EXR)]

    work = FrameWork(recipe, output, products, sources, shared, make, others)
    return work.run(frames, run, absent, summary)


def _part(mattes: Path | None, folder: str) -> Path:
    if mattes is None:
        raise OptionError("give the folder of a matte, or --fg and --beta-frames")
    if not mattes.is_dir():
        raise InputError(f"{mattes}: no such folder for the matte")
    part = mattes / folder
    if not part.is_dir():
        raise InputError(f"{mattes}: has no {folder}/; make it with `shadowtool matte`")
    return part


def _places(warp: Path, header: Header, of: str) -> tuple[Float32, str]:
    """Where an ST map takes β from, and its fingerprint."""
    warp_map, warp_header, mark = read_warp(warp)
    require_size(warp, warp_header, header, of)
    return positions(warp_map.warp), mark


def _visibility(sequence: Sequence, frame: Frame, fill: Fill) -> tuple[Float32, int]:
    """β of a frame, (H, W) or (H, W, 3), and how many of its pixels are unknown."""
    image = read_image(sequence.path(frame))
    if "RGBA" in image.layers and made_by(image.header) == "matte" and _is_figure(image):
        raise InputError(
            f"{image.path}: is the figure that matte wrote, no β; give the frames in {BETA_FOLDER}/"
        )
    coloured = not image.layers.keys().isdisjoint({"RGB", "RGBA"})
    values = to_float(image.rgb("none")) if coloured else image.plane("Y")
    holes = ~np.isfinite(values)
    if holes.any():
        values = np.where(holes, np.float32(np.nan), values)
        if fill == "lit":
            values = np.where(holes, np.float32(1), values)
        elif fill == "inpaint" and values.ndim == 2:
            values = inpaint(values)
        elif fill == "inpaint":
            values = np.dstack([inpaint(values[..., c]) for c in range(3)])
    return values, int(holes.any(axis=-1).sum() if holes.ndim == 3 else holes.sum())


def _is_figure(image: Image) -> bool:
    """Whether a picture with alpha is premultiplied: β that another program gave an alpha, of
    whatever kind, is light where that is 0."""
    colour, outside = image.rgb("none"), image.channel("A") <= 0
    return bool(outside.any()) and not colour[outside].any()


def _figure_box(image: Image) -> Box:
    """What holds all that is not 0 in any channel; a single pixel if nothing is."""
    boxes = []
    for values in image.layers.values():
        height, width = values.shape[:2]
        # Integers are compared many times faster than halfs.
        bits = np.ascontiguousarray(values).view(f"u{values.itemsize}").reshape(height, -1)
        rows = np.flatnonzero(bits.max(axis=1))
        if rows.size:
            there = slice(int(rows[0]), int(rows[-1]) + 1)
            columns = np.flatnonzero(bits[there].max(axis=0).reshape(width, -1).max(axis=1))
            boxes.append(Box(there, slice(int(columns[0]), int(columns[-1]) + 1)))
    return Box(*(_hull(parts) for parts in zip(*boxes, strict=True))) if boxes else _PIXEL


def _hull(parts: Iterable[slice]) -> slice:
    starts, stops = zip(*((part.start, part.stop) for part in parts), strict=True)
    return slice(min(starts), max(stops))


def _in_rows(box: Box, rows: slice) -> Box | None:
    """The part of a box that lies in some rows."""
    first, last = max(box.rows.start, rows.start), min(box.rows.stop, rows.stop)
    return Box(slice(first, last), box.columns) if first < last else None


def _figure(image: Image, box: Box) -> tuple[Float32, Float32, int]:
    """Of a part of the picture premultiplied colour (h, w, 3), alpha (h, w) in [0, 1], and in how
    many pixels there is NaN or infinity, which becomes nothing."""
    part = {name: np.ascontiguousarray(values[box]) for name, values in image.layers.items()}
    colour, alpha = replace(image, layers=part).rgba()
    count = 0
    if not (np.isfinite(colour).all() and np.isfinite(alpha).all()):
        bad = ~(np.isfinite(colour).all(axis=-1) & np.isfinite(alpha))
        count = int(bad.sum())
        alpha[bad] = 0
        colour[bad] = 0
    return colour, np.clip(alpha, 0, 1), count


def _complete(lit: Float32, shadow: Float32) -> tuple[Float32, Float32, int]:
    """Plates without NaN: where one is unknown, both are continued from around."""
    holes = np.asarray(~(np.isfinite(lit) & np.isfinite(shadow)).all(axis=-1))
    if not holes.any():
        return lit, shadow, 0
    known = (~holes).astype(np.float32)
    whole = [
        fill_membrane(np.where(holes[..., np.newaxis], np.float32(0), p), known)
        for p in (lit, shadow)
    ]
    return whole[0], whole[1], int(holes.sum())
