"""The shadow matte β and the figure's matte, frame by frame."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Beta, Fill, Gain, Only, Steady
from shadowtool.core import beta as shadow_beta
from shadowtool.core.backdrop import Backdrop, missing_shade
from shadowtool.core.bands import overlapping_bands
from shadowtool.core.boxes import Box, around
from shadowtool.core.camera_motion import Place, Vantage
from shadowtool.core.exposure import (
    Gains,
    flickers,
    level_of,
    of_rows,
    row_gains,
    tint_of,
    unevenness,
    without_gain,
)
from shadowtool.core.grid import exposure_rows, exposure_step, on_grid
from shadowtool.core.half_floats import not_finite, to_float, to_half
from shadowtool.core.matting import (
    HIDDEN,
    MARGIN,
    colour_figure,
    differs,
    pull_figure,
    without_figure,
)
from shadowtool.core.noise import NoiseModel, thin
from shadowtool.core.plates import Plates
from shadowtool.core.trembling import UNSTEADY, off_place, strips
from shadowtool.core.trimap import FIGURE
from shadowtool.errors import InputError, OptionError
from shadowtool.io.files import real
from shadowtool.io.image import EXR, PNG, Header, Image, read_image, write_exr, write_png
from shadowtool.io.products import BETA_FOLDER, FIGURE_FOLDER, TRIMAP_FOLDER, made_by, read_plates
from shadowtool.io.sequence import Frame, Sequence, frame_file, open_sequence
from shadowtool.steps.footage import (
    Footage,
    moved_with,
    open_footage,
    require_frames,
    require_size,
    say_assumed,
    say_flickers,
    say_mixed,
    say_taken_as,
)
from shadowtool.steps.keyframes import Keyframes
from shadowtool.steps.run import Figures, FrameWork, Recipe, Result, Run, with_figures

logger = logging.getLogger(__name__)

Float16 = NDArray[np.float16]
Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

# By how much a shadow plate may be off where no frame showed full shadow.
_GUESSED = 0.04
# The box of a figure that isn't there.
_NONE = Box(slice(0, 0), slice(0, 0))
# A figure larger than this part of the picture is none.
_TOO_MUCH = 0.5

# Each product's folder, also its files' name, and their suffix.
PRODUCTS: dict[Only, tuple[str, str]] = {
    "trimap": (TRIMAP_FOLDER, PNG),
    "alpha": (FIGURE_FOLDER, EXR),
    "beta": (BETA_FOLDER, EXR),
}


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
    steady: Steady = "auto",
    transfer: str = "auto",
) -> Result:
    """Write ``trimap/``, ``fg/`` (αF and α) and ``beta/`` (β and its confidence).

    Args:
        plates: the folder of the source scene's plates.
        alpha: the figure's matte from elsewhere, used as given; no trimap is then made.
        trimap: 0, 128, 255 for any of the frames; where one was drawn, it decides, and between
            them they are carried by optical flow.
        only: write one of the three products.
        beta: one β for all channels, or one for each, for coloured light.
        clamp: keep β within 0 and 1; caustics are above.
        fill: what unknown β becomes.
        gain: find each frame's exposure against the plates and take it out, or take it as it is.
        steady: of a camera that trembles, move frames to where the plates see the scene from, or
            take them as they are.

    Raises:
        InputError: frames, plates, mattes are missing or don't fit.
        OptionError: trimaps, given or wanted, beside an alpha.
    """
    footage = open_footage(source, "frames", transfer, run.missing)
    say_assumed(footage, transfer)
    frames, absent = footage.sequence.select(run.frames, run.missing)
    stored = read_plates(plates, transfer)
    if transfer == "auto":
        say_taken_as(plates, stored.transfer)
    require_size(plates, stored.header, footage.header, footage.sequence.pattern)
    say_mixed(plates, stored.header, footage.sequence.pattern, footage.of_codes)
    if alpha is not None and (trimap is not None or only == "trimap"):
        raise OptionError("--alpha needs no trimaps; give it without --trimap and --only trimap")
    given = {
        role: open_sequence(path, role)
        for role, path in (("alpha", alpha), ("trimap", trimap))
        if path is not None
    }
    keyframes = None
    if "trimap" in given:
        keyframes = Keyframes.of(given["trimap"], footage, run.missing)
    if "alpha" in given:
        pattern = footage.sequence.pattern
        require_frames(given["alpha"], frames, footage.header, pattern, run.missing)
    lit = stored.plates.lit
    survey = footage.survey(run.jobs)
    off = off_place(strips(lit[..., 1]), survey.rows) if steady == "auto" else 0.0
    if off > UNSTEADY:
        footage = replace(footage, vantage=Vantage.of(lit))
        survey = footage.survey(run.jobs)
    noise, banded = survey.noise, gain == "auto" and flickers(survey.thinned, thin(lit))
    del lit, survey
    recipe = Recipe(
        "matte",
        {
            "beta": beta,
            "clamp": clamp,
            "fill": fill,
            "gain": gain,
            "only": only,
            "steady": steady,
            "transfer": footage.transfer if stored.transfer == footage.transfer else transfer,
            "noise": noise.record(),
        },
        {"frames": Path(footage.sequence.pattern).name}
        | {"--plates": real(plates).name}
        | {f"--{role}": Path(sequence.pattern).name for role, sequence in given.items()},
        {"frames": footage.transfer, "--plates": stored.transfer},
    )
    wanted = tuple(product for product in PRODUCTS if only in (None, product))
    if "alpha" in given:
        wanted = tuple(product for product in wanted if product != "trimap")
    take = _Take(
        footage,
        _Scene.of(stored.plates, noise, beta),
        given.get("alpha"),
        keyframes,
        wanted,
        beta,
        clamp,
        fill,
        gain,
        banded,
        output,
    )
    shared = [stored.fingerprint, *given]
    # Plates in which something is unknown are not kept beside those that it was taken out of.
    del stored
    work = FrameWork(recipe, output, take.products, take.sources, shared, take.make, take.others)
    result = work.run(frames, run, absent, take.summary)
    if (moved := result.figures.get("moved", 0)) > 0:
        logger.warning(
            "%s: the camera trembles, or is not where the plates were taken from; frames are moved"
            " there, by up to %.2f pixels",
            footage.sequence.pattern,
            moved,
        )
    say_flickers(footage, result.figures.get("bands", 0))
    if result.figures.get("hidden", 0) > _TOO_MUCH:
        logger.warning(
            "%s: %.0f%% of the picture is taken for the figure; are these the plates of this take?",
            output,
            100 * result.figures["hidden"],
        )
    if result.figures.get("unknown", 0) > _TOO_MUCH:
        logger.warning(
            "%s: β is unknown in %.0f%% of the picture, where the plates know no shadow",
            output,
            100 * result.figures["unknown"],
        )
    return result


@dataclass(frozen=True)
class _Scene:
    """The plates, and what follows from them for all frames.

    Attributes:
        backdrop: the plates, without NaN.
        unknown: (H, W), a plate is NaN.
        never_reached: (H, W), β can't be known, nor is it a hole in what is.
        gauge: what β is measured by.
        confidence: (H, W) float16, of β where it is measured.
        step, reference: the grid and its lit colours that exposure is measured by.
    """

    backdrop: Backdrop
    unknown: Bool
    never_reached: Bool
    gauge: shadow_beta.Gauge
    confidence: Float16
    step: int
    reference: Float32

    @classmethod
    def of(cls, plates: Plates, noise: NoiseModel, beta: Beta) -> "_Scene":
        contrast = shadow_beta.shadow_contrast(plates, noise)
        # Means have no range of extremes to allow for.
        frames = plates.frames if plates.shadow_frames is None else None
        never_shaded = shadow_beta.never_shaded(contrast, frames)
        confidence = shadow_beta.confidence(contrast)
        contrasts = [contrast]
        if beta == "rgb":
            contrasts = list(np.moveaxis(shadow_beta.channel_contrast(plates, noise), -1, 0))
        unknown = np.isnan(contrast)
        lit, shadow = plates.lit, plates.shadow
        if unknown.any():
            lit, shadow = (
                np.where(unknown[..., np.newaxis], np.float32(0), plate) for plate in (lit, shadow)
            )
        gauge = shadow_beta.Gauge.of(Plates(lit, shadow), contrasts, never_shaded)
        step = exposure_step(lit.shape[1], lit.shape[0])
        doubt, missing = np.broadcast_to(np.float32(0), unknown.shape), None
        if plates.shadow_frames is not None:
            doubt = np.where(plates.shadow_frames == 0, np.float32(_GUESSED), np.float32(0))
            missing = missing_shade(plates.shadow_frames)
        backdrop = Backdrop(lit, shadow, noise, doubt, missing)
        lit_always = shadow_beta.never_reached(never_shaded)
        return cls(backdrop, unknown, lit_always, gauge, confidence, step, on_grid(lit, step))


class _Shown(NamedTuple):
    """A frame.

    Attributes:
        light: (H, W, 3), linear light as it is stored.
        header: the file's.
        bad: (H, W), where it is not finite; None for nowhere.
        gain: how much brighter than the plates it is, or its rows and channels are.
        moved: from where it was seen to where the plates see it from, (x, y) in pixels.
    """

    light: NDArray[np.floating]
    header: Header
    bad: Bool | None
    gain: Gains
    moved: Place

    def at(self, box: Box) -> Float32:
        """A part of it at gain 1, NaN where it is not finite."""
        image = to_float(self.light[box])
        if self.bad is not None:
            image = np.where(self.bad[box][..., np.newaxis], np.float32(np.nan), image)
        return without_gain(image, of_rows(self.gain, box.rows)).astype(np.float32, copy=False)


class _Figure(NamedTuple):
    """The figure in a frame.

    Attributes:
        trimap: (H, W) uint8, where one was made.
        box: what holds all of it.
        alpha: of the box, (h, w) float32 in [0, 1].
        foreground: of the box, (h, w, 3) float32, premultiplied.
        ground: of the box, (h, w, 3) float32, what is seen past the figure.
    """

    trimap: UInt8 | None
    box: Box
    alpha: Float32
    foreground: Float32
    ground: Float32

    @classmethod
    def none(cls, trimap: UInt8 | None) -> "_Figure":
        nothing = np.zeros((0, 0, 3), np.float32)
        return cls(trimap, _NONE, nothing[..., 0], nothing, nothing)


@dataclass(frozen=True)
class _Take:
    """The work on single frames."""

    footage: Footage
    scene: _Scene
    alpha: Sequence | None
    keyframes: Keyframes | None
    wanted: tuple[Only, ...]
    beta: Beta
    clamp: bool
    fill: Fill
    gain: Gain
    banded: bool
    output: Path

    def products(self, frame: Frame) -> list[Path]:
        return [self._file(product, frame) for product in self.wanted]

    def others(self, frame: Frame) -> list[Path]:
        return [] if self.alpha is None else [self._file("trimap", frame)]

    def sources(self, frame: Frame) -> list[Path]:
        files = [self.footage.sequence.path(frame)]
        if self.alpha is not None:
            return [*files, self.alpha.path(frame)]
        return files if self.keyframes is None else [*files, *self.keyframes.sources(frame)]

    def make(self, frame: Frame, provenance: dict[str, str]) -> Figures:
        """Write a frame's products."""
        shown = self._shown(frame)
        figure = self._figure(frame, shown)
        if figure.trimap is not None and "trimap" in self.wanted:
            write_png(self._file("trimap", frame), figure.trimap, provenance)
        if self.wanted == ("trimap",):
            return {}
        hidden = np.zeros(self.scene.unknown.shape, bool)
        hidden[figure.box] = figure.alpha >= HIDDEN
        beta = self._beta(shown, figure, hidden)
        unknown = np.isnan(beta)
        unknown = np.asarray(unknown.any(axis=-1)) if beta.ndim == 3 else unknown
        figures: Figures = {
            "unknown": int(np.count_nonzero(unknown & ~hidden)),
            "hidden": int(np.count_nonzero(hidden)),
            "not_finite": 0 if shown.bad is None else int(np.count_nonzero(shown.bad)),
            "gain": round(level_of(shown.gain), 6),
            "bands": round(unevenness(shown.gain), 4),
            "tint": tint_of(shown.gain),
            "moved": round(float(np.hypot(*shown.moved)), 3),
        }
        marked, header = with_figures(provenance, figures), shown.header
        # The encoder wants the room.
        del shown
        products: tuple[tuple[Only, Callable[[], dict[str, NDArray[np.float16]]]], ...] = (
            ("alpha", lambda: _figure_layers(figure, hidden.shape)),
            ("beta", lambda: self._beta_layers(beta, hidden, unknown, figure)),
        )
        # One after the other, so that no two are held at once.
        for product, layers in products:
            if product in self.wanted:
                write_exr(self._file(product, frame), layers(), header, marked)
        return figures

    def summary(self, rows: list[Figures]) -> Figures:
        """Parts of all the frames' pixels, and the range of gains; none of trimaps alone."""
        if self.wanted == ("trimap",):
            return {}
        names = ("unknown", "hidden", "not_finite")
        header = self.footage.header
        pixels = max(len(rows), 1) * header.width * header.height
        parts: Figures = {
            name: round(sum(int(row.get(name, 0)) for row in rows) / pixels, 5) for name in names
        }
        gains = [float(row.get("gain", 1)) for row in rows] or [1.0]
        bands, moved = (
            max((float(row.get(name, 0)) for row in rows), default=0.0)
            for name in ("bands", "moved")
        )
        gain = {"least": min(gains), "most": max(gains)}
        return parts | {"gain": gain, "bands": bands, "moved": moved}

    def _file(self, product: Only, frame: Frame) -> Path:
        folder, suffix = PRODUCTS[product]
        return self.output / folder / frame_file(folder, frame, suffix)

    def _shown(self, frame: Frame) -> _Shown:
        stored = self.footage.image(frame)
        light, place = self.footage.light(stored)
        bad = not_finite(light)
        gain: Gains = 1.0
        if self.gain == "auto":
            grid = on_grid(light, self.scene.step)
            rows = exposure_rows(*stored.header.size)
            with np.errstate(invalid="ignore"):
                gain = row_gains(grid, self.scene.reference, rows, self.banded)
        return _Shown(light, stored.header, bad, gain, place)

    def _figure(self, frame: Frame, shown: _Shown) -> _Figure:
        if self.alpha is not None:
            stored = read_image(self.alpha.path(frame))
            if "confidence" in stored.layers and made_by(stored.header) == "matte":
                raise InputError(
                    f"{stored.path}: is the β that matte wrote, no figure; give the frames in"
                    f" {FIGURE_FOLDER}/"
                )
            matte = moved_with(_matte_plane(stored), stored.path, stored.header, shown.moved)
            matte = np.clip(matte, 0, 1).astype(np.float32, copy=False)
            box = around(matte > 0, MARGIN) or _NONE
            alpha, image = matte[box].copy(), shown.at(box)
            backdrop, unknown = self.scene.backdrop.at(box), self.scene.unknown[box]
            figure = colour_figure(image, backdrop, unknown, alpha)
            return _Figure(None, box, alpha, figure.foreground, without_figure(image, figure))
        return self._pulled(frame, shown)

    def _pulled(self, frame: Frame, shown: _Shown) -> _Figure:
        given = None if self.keyframes is None else self.keyframes.trimap(frame, shown.moved)
        drawn = self.keyframes is not None and frame in self.keyframes.drawn.files
        mask = self._differs(shown)
        if drawn and given is not None:
            mask |= given == FIGURE
        trimap = np.zeros(mask.shape, np.uint8)
        made = given if drawn else trimap
        box = around(mask, MARGIN)
        if box is None:
            return _Figure.none(made)
        image, part = shown.at(box), None if given is None else given[box]
        figure = pull_figure(
            image,
            self.scene.backdrop.at(box),
            self.scene.unknown[box],
            drawn=part if drawn else None,
            hint=None if drawn else part,
            frame_size=mask.shape,
        )
        trimap[box] = figure.trimap
        ground = without_figure(image, figure)
        return _Figure(made, box, figure.alpha, figure.foreground, ground)

    def _differs(self, shown: _Shown) -> Bool:
        """Where a frame is not plainly lit ground, a few rows at a time."""
        height, width = self.scene.unknown.shape
        found = np.empty((height, width), bool)
        for rows, inner in overlapping_bands(height, 1):
            box = Box(rows, slice(0, width))
            backdrop, unknown = self.scene.backdrop.at(box), self.scene.unknown[box]
            part = differs(shown.at(box), backdrop, unknown)
            found[rows][inner] = part[inner]
        return found

    def _beta(self, shown: _Shown, figure: _Figure, hidden: Bool) -> Float32:
        """β (H, W) or (H, W, 3), NaN where it was not measured."""
        unseen = hidden if shown.bad is None else hidden | shown.bad
        ground = (figure.box, figure.ground)
        return self.scene.gauge.measure(shown.light, unseen, shown.gain, ground, self.clamp)

    def _beta_layers(
        self, beta: Float32, hidden: Bool, unknown: Bool, figure: _Figure
    ) -> dict[str, NDArray[np.float16]]:
        confidence = self.scene.confidence.copy()
        seen = 1 - figure.alpha
        confidence[figure.box] = to_half(to_float(confidence[figure.box]) * seen)
        confidence[unknown] = 0
        name = "Y" if self.beta == "scalar" else "RGB"
        return {name: self._filled(beta, hidden), "confidence": confidence}

    def _filled(self, beta: Float32, hidden: Bool) -> Float16:
        filled = np.empty(beta.shape, np.float16)
        lit = self.scene.never_reached
        for plane, out in zip(_planes(beta), _planes(filled), strict=True):
            out[:] = to_half(shadow_beta.fill_beta(plane, lit, hidden, self.fill))
        return filled


def _planes(image: NDArray[np.floating]) -> list[NDArray[np.floating]]:
    """Views of an image's channels, (H, W) each."""
    return [image] if image.ndim == 2 else [image[..., channel] for channel in range(3)]


def _figure_layers(figure: _Figure, shape: tuple[int, ...]) -> dict[str, NDArray[np.float16]]:
    rgba = np.zeros((*shape, 4), np.float16)
    # What is never written to takes no memory.
    part = rgba[figure.box]
    part[..., :3], part[..., 3] = to_half(figure.foreground), to_half(figure.alpha)
    return {"RGBA": rgba}


def _matte_plane(stored: Image) -> Float32:
    """Alpha from a file, (H, W) float32 in [0, 1]; 0 where it is NaN."""
    plane = stored.plane("A", "Y")
    # Of NaN and a number fmax takes the number.
    np.fmax(plane, 0, out=plane)
    return np.minimum(plane, 1, out=plane)
