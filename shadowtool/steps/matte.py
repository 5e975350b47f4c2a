"""The shadow matte β and the figure's matte, frame by frame."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Beta, Fill, Gain, Only
from shadowtool.core import beta as shadow_beta
from shadowtool.core.compositing import shade
from shadowtool.core.exposure import frame_gain, without_gain
from shadowtool.core.holdout import grid_step, on_grid
from shadowtool.core.matting import (
    difference_alpha,
    difference_trimap,
    figure_distance,
    pull_figure,
)
from shadowtool.errors import OptionError
from shadowtool.io.image import EXR, PNG, read_image, to_half, write_exr, write_png
from shadowtool.io.products import read_plates
from shadowtool.io.sequence import Frame, frame_file, open_sequence
from shadowtool.steps.footage import open_footage, require_frames, require_size
from shadowtool.steps.run import Figures, FrameWork, Recipe, Result, Run, with_figures

logger = logging.getLogger(__name__)

Float32 = NDArray[np.float32]

# A figure larger than this part of the picture is none.
_TOO_MUCH = 0.5

TRIMAP_FOLDER, FIGURE_FOLDER, BETA_FOLDER = "trimap", "fg", "beta"


def matte(
    source: str | Path,
    output: Path,
    *,
    plates: Path,
    run: Run = Run(),
    alpha: str | Path | None = None,
    trimap: str | Path | None = None,
    only: Only | None = None,
    beta: Beta = "scalar",
    clamp: bool = True,
    fill: Fill = "inpaint",
    gain: Gain = "auto",
    transfer: str = "auto",
) -> Result:
    """Write ``trimap/``, ``fg/`` (αF and α) and ``beta/`` (β and its confidence).

    Args:
        plates: the folder of the source scene's plates.
        alpha: the figure's matte from elsewhere, used as given; no trimap is then made.
        trimap: 0, 128, 255 for every frame, used instead of one by difference.
        only: write one of the three products.
        beta: one β for all channels, or one for each, for coloured light.
        clamp: keep β within 0 and 1; caustics are above.
        fill: what unknown β becomes.
        gain: find each frame's exposure against the plates and take it out, or take it as it is.

    Raises:
        InputError: frames, plates, mattes are missing or don't fit.
    """
    footage = open_footage(source, "frames", transfer, run.missing)
    frames, absent = footage.sequence.select(run.frames, run.missing)
    stored = read_plates(plates)
    require_size(plates, stored.header, footage.header, footage.sequence.pattern)
    if alpha is not None and only == "trimap":
        raise OptionError("--only trimap makes trimaps, which --alpha replaces; give one of them")
    given = {
        role: open_sequence(path, role)
        for role, path in (("alpha", alpha), ("trimap", trimap))
        if path is not None
    }
    for sequence in given.values():
        pattern = footage.sequence.pattern
        require_frames(sequence, frames, footage.header, pattern, run.missing)
    noise = footage.measure_noise(run.jobs)
    scene = stored.plates
    never_shaded = shadow_beta.unknown_beta(
        contrast := shadow_beta.shadow_contrast(scene, noise),
        # Means have no range of extremes to allow for.
        scene.frames if scene.shadow_frames is None else None,
    )
    known_confidence = np.clip(1 - 1 / np.maximum(contrast, 1e-6), 0, 1)
    known_confidence[never_shaded] = 0
    contrasts = [contrast]
    if beta == "rgb":
        contrasts = list(np.moveaxis(shadow_beta.channel_contrast(scene, noise), -1, 0))
    step = grid_step(*footage.header.size)
    reference = on_grid(np.nan_to_num(scene.lit), step)
    recipe = Recipe(
        "matte",
        {
            "beta": beta,
            "clamp": clamp,
            "fill": fill,
            "gain": gain,
            "only": only,
            "transfer": footage.transfer,
            "noise": [[float(v) for v in row] for row in (noise.slope, noise.floor)],
        },
        {"frames": Path(footage.sequence.pattern).name}
        | {"--plates": plates.resolve().name}
        | {f"--{role}": Path(sequence.pattern).name for role, sequence in given.items()},
    )

    def wanted(product: Only) -> bool:
        if product == "trimap" and "alpha" in given:
            return False
        return only in (None, product)

    def file(folder: str, frame: Frame, suffix: str = EXR) -> Path:
        return output / folder / frame_file(folder, frame, suffix)

    def products(frame: Frame) -> list[Path]:
        files = []
        if wanted("trimap"):
            files.append(file(TRIMAP_FOLDER, frame, PNG))
        if wanted("alpha"):
            files.append(file(FIGURE_FOLDER, frame))
        if wanted("beta"):
            files.append(file(BETA_FOLDER, frame))
        return files

    def sources(frame: Frame) -> list[Path]:
        return [s.path(frame) for s in (footage.sequence, *given.values())]

    def make(frame: Frame, provenance: dict[str, str]) -> Figures:
        stored_frame = footage.image(frame)
        header = stored_frame.header
        image = stored_frame.rgb(footage.transfer).astype(np.float32)
        bad = ~np.isfinite(image).all(axis=-1)
        image[bad] = np.nan
        exposure = 1.0 if gain == "none" else frame_gain(on_grid(image, step), reference)
        image = without_gain(image, exposure).astype(np.float32)
        projected = shadow_beta.shadow_matte(image, scene.lit, scene.shadow)
        if "alpha" in given:
            coverage = np.clip(_matte_plane(given["alpha"].path(frame)), 0, 1)
        else:
            distance = figure_distance(image, projected, scene.lit, scene.shadow, noise)
            if "trimap" in given:
                regions = _trimap_plane(given["trimap"].path(frame))
            else:
                regions = difference_trimap(distance)
            if wanted("trimap"):
                write_png(file(TRIMAP_FOLDER, frame, PNG), regions, provenance)
            if only == "trimap":
                return {}
            coverage = difference_alpha(distance, regions)
        hidden = coverage > 0
        if beta == "rgb":
            planes = np.moveaxis(shadow_beta.coloured_matte(image, scene.lit, scene.shadow), -1, 0)
        else:
            planes = projected[np.newaxis]
        filled_planes = []
        unknown = np.zeros(hidden.shape, bool)
        for plane, own_contrast in zip(planes, contrasts, strict=True):
            known = np.where(never_shaded | hidden, np.float32(np.nan), plane)
            known = shadow_beta.without_noise(known, own_contrast)
            known = np.clip(known, 0, 1) if clamp else known
            unknown |= np.isnan(known)
            filled_planes.append(shadow_beta.fill_beta(known, never_shaded, hidden, fill))
        filled = filled_planes[0] if beta == "scalar" else np.stack(filled_planes, axis=-1)
        figures = {
            "unknown": int((unknown & ~hidden).sum()),
            "hidden": int(hidden.sum()),
            "not_finite": int(bad.sum()),
            "gain": round(exposure, 6),
        }
        if wanted("alpha"):
            behind = [shadow_beta.inpaint(plane) for plane in filled_planes]
            shown = shade(scene.lit, scene.shadow, np.stack(behind, axis=-1))
            figure = pull_figure(image, coverage, shown)
            rgba = np.dstack([figure.foreground, figure.alpha])
            marked = with_figures(provenance, figures)
            write_exr(file(FIGURE_FOLDER, frame), {"RGBA": to_half(rgba)}, header, marked)
        if wanted("beta"):
            confidence = np.where(unknown, np.float32(0), known_confidence)
            name = "Y" if beta == "scalar" else "RGB"
            layers = {name: to_half(filled), "confidence": to_half(confidence)}
            marked = with_figures(provenance, figures)
            write_exr(file(BETA_FOLDER, frame), layers, header, marked)
        return figures

    def summary(rows: list[Figures]) -> Figures:
        names = ("unknown", "hidden", "not_finite")
        pixels = max(len(rows), 1) * footage.header.width * footage.header.height
        parts: Figures = {
            name: round(sum(int(row.get(name, 0)) for row in rows) / pixels, 5) for name in names
        }
        gains = [float(row.get("gain", 1)) for row in rows] or [1.0]
        return parts | {"gain": {"least": min(gains), "most": max(gains)}}

    work = FrameWork(recipe, output, products, sources, [stored.fingerprint], make)
    result = work.run(frames, run, absent, summary)
    if result.figures.get("hidden", 0) > _TOO_MUCH:
        logger.warning(
            "%s: %.0f%% of the picture is taken for the figure; are these the plates of this take?",
            output,
            100 * result.figures["hidden"],
        )
    return result


def _matte_plane(path: Path) -> Float32:
    plane = read_image(path).plane("A", "Y", "R")
    return np.nan_to_num(plane, nan=0.0)


def _trimap_plane(path: Path) -> NDArray[np.uint8]:
    plane = np.nan_to_num(read_image(path).plane("Y", "G"))
    trimap = np.full(plane.shape, 128, np.uint8)
    trimap[plane < 0.25] = 0
    trimap[plane > 0.75] = 255
    return trimap
