"""The shadow matte β and the figure's matte, frame by frame."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Beta, Fill, Gain, Only
from shadowtool.core import beta as shadow_beta
from shadowtool.core.backdrop import Backdrop
from shadowtool.core.exposure import frame_gain, without_gain
from shadowtool.core.half_floats import to_float
from shadowtool.core.holdout import grid_step, on_grid
from shadowtool.core.matting import HIDDEN, Figure, colour_figure, pull_figure, without_figure
from shadowtool.core.noise import NoiseModel
from shadowtool.core.plates import Plates
from shadowtool.errors import OptionError
from shadowtool.io.image import EXR, PNG, Header, read_image, to_half, write_exr, write_png
from shadowtool.io.products import read_plates
from shadowtool.io.sequence import Frame, Sequence, frame_file, open_sequence
from shadowtool.steps.footage import Footage, open_footage, require_frames, require_size
from shadowtool.steps.keyframes import Keyframes
from shadowtool.steps.run import Figures, FrameWork, Recipe, Result, Run, with_figures

logger = logging.getLogger(__name__)

Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

# By how much a shadow plate may be off where no frame showed full shadow.
_GUESSED = 0.04
# A figure larger than this part of the picture is none.
_TOO_MUCH = 0.5

FIGURE_FOLDER, BETA_FOLDER = "fg", "beta"
# Each product's folder, also its files' name, and their suffix.
PRODUCTS: dict[Only, tuple[str, str]] = {
    "trimap": ("trimap", PNG),
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
    keyframes = None
    if "trimap" in given:
        keyframes = Keyframes.of(given["trimap"], footage, run.missing)
    if "alpha" in given:
        pattern = footage.sequence.pattern
        require_frames(given["alpha"], frames, footage.header, pattern, run.missing)
    noise = footage.measure_noise(run.jobs)
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
    wanted = tuple(product for product in PRODUCTS if only in (None, product))
    if "alpha" in given:
        wanted = tuple(product for product in wanted if product != "trimap")
    take = _Take(
        footage,
        _Scene.of(stored.plates, noise, footage.header, beta),
        given.get("alpha"),
        keyframes,
        wanted,
        beta,
        clamp,
        fill,
        gain,
        output,
    )
    work = FrameWork(recipe, output, take.products, take.sources, [stored.fingerprint], take.make)
    result = work.run(frames, run, absent, take.summary)
    if result.figures.get("hidden", 0) > _TOO_MUCH:
        logger.warning(
            "%s: %.0f%% of the picture is taken for the figure; are these the plates of this take?",
            output,
            100 * result.figures["hidden"],
        )
    return result


@dataclass(frozen=True)
class _Scene:
    """The plates, and what follows from them for all frames.

    Attributes:
        plates: as they were read.
        backdrop: the same without NaN.
        unknown: (H, W), a plate is NaN.
        never_shaded: (H, W), β can't be known.
        never_reached: (H, W), nor is it a hole in what is.
        contrasts: (H, W) for each plane of β.
        confidence: (H, W), of β where it is measured.
        step, reference: the grid and its lit colours that exposure is measured by.
    """

    plates: Plates
    backdrop: Backdrop
    unknown: Bool
    never_shaded: Bool
    never_reached: Bool
    contrasts: list[Float32]
    confidence: Float32
    step: int
    reference: Float32

    @classmethod
    def of(cls, plates: Plates, noise: NoiseModel, header: Header, beta: Beta) -> "_Scene":
        contrast = shadow_beta.shadow_contrast(plates, noise)
        # Means have no range of extremes to allow for.
        frames = plates.frames if plates.shadow_frames is None else None
        never_shaded = shadow_beta.unknown_beta(contrast, frames)
        confidence = np.asarray(np.clip(1 - 1 / np.maximum(contrast, 1e-6), 0, 1), np.float32)
        confidence[never_shaded] = 0
        contrasts = [contrast]
        if beta == "rgb":
            contrasts = list(np.moveaxis(shadow_beta.channel_contrast(plates, noise), -1, 0))
        known = np.isfinite(plates.lit) & np.isfinite(plates.shadow)
        unknown = np.asarray(~known.all(axis=-1))
        lit, shadow = (
            np.where(unknown[..., np.newaxis], np.float32(0), plate)
            for plate in (plates.lit, plates.shadow)
        )
        step = grid_step(*header.size)
        reference = on_grid(lit, step)
        doubt = np.zeros(contrast.shape, np.float32)
        if plates.shadow_frames is not None:
            doubt[plates.shadow_frames == 0] = _GUESSED
        backdrop = Backdrop(lit, shadow, noise, doubt)
        reached = shadow_beta.without_holes(never_shaded)
        return cls(
            plates, backdrop, unknown, never_shaded, reached, contrasts, confidence, step, reference
        )


class _Shown(NamedTuple):
    """A frame at gain 1, NaN where it is not finite, with its header."""

    image: Float32
    header: Header
    gain: float
    bad: int


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
    output: Path

    def products(self, frame: Frame) -> list[Path]:
        return [self._file(product, frame) for product in self.wanted]

    def sources(self, frame: Frame) -> list[Path]:
        files = [self.footage.sequence.path(frame)]
        if self.alpha is not None:
            return [*files, self.alpha.path(frame)]
        return files if self.keyframes is None else [*files, *self.keyframes.sources(frame)]

    def make(self, frame: Frame, provenance: dict[str, str]) -> Figures:
        """Write a frame's products."""
        shown = self._shown(frame)
        figure = self._figure(frame, shown.image)
        if "trimap" in self.wanted:
            write_png(self._file("trimap", frame), figure.trimap, provenance)
        if self.wanted == ("trimap",):
            return {}
        ground = without_figure(shown.image, figure)
        hidden = figure.alpha >= HIDDEN
        beta, unknown = self._beta(ground, hidden)
        figures: Figures = {
            "unknown": int((unknown & ~hidden).sum()),
            "hidden": int(hidden.sum()),
            "not_finite": shown.bad,
            "gain": round(shown.gain, 6),
        }
        marked = with_figures(provenance, figures)
        if "alpha" in self.wanted:
            rgba = np.empty((*hidden.shape, 4), np.float16)
            rgba[..., :3], rgba[..., 3] = to_half(figure.foreground), to_half(figure.alpha)
            write_exr(self._file("alpha", frame), {"RGBA": rgba}, shown.header, marked)
        if "beta" in self.wanted:
            confidence = self.scene.confidence * (1 - figure.alpha)
            confidence[unknown] = 0
            name = "Y" if self.beta == "scalar" else "RGB"
            layers = {name: to_half(beta), "confidence": to_half(confidence)}
            write_exr(self._file("beta", frame), layers, shown.header, marked)
        return figures

    def summary(self, rows: list[Figures]) -> Figures:
        """Parts of all the frames' pixels, and the range of gains."""
        names = ("unknown", "hidden", "not_finite")
        header = self.footage.header
        pixels = max(len(rows), 1) * header.width * header.height
        parts: Figures = {
            name: round(sum(int(row.get(name, 0)) for row in rows) / pixels, 5) for name in names
        }
        gains = [float(row.get("gain", 1)) for row in rows] or [1.0]
        return parts | {"gain": {"least": min(gains), "most": max(gains)}}

    def _file(self, product: Only, frame: Frame) -> Path:
        folder, suffix = PRODUCTS[product]
        return self.output / folder / frame_file(folder, frame, suffix)

    def _shown(self, frame: Frame) -> _Shown:
        stored = self.footage.image(frame)
        image = to_float(stored.rgb(self.footage.transfer))
        finite = np.isfinite(image)
        bad = ~(finite[..., 0] & finite[..., 1] & finite[..., 2])
        if bad.any():
            image = np.where(bad[..., np.newaxis], np.float32(np.nan), image)
        gain = 1.0
        if self.gain == "auto":
            gain = frame_gain(on_grid(image, self.scene.step), self.scene.reference)
        image = without_gain(image, gain).astype(np.float32, copy=False)
        return _Shown(image, stored.header, gain, int(bad.sum()))

    def _figure(self, frame: Frame, image: Float32) -> Figure:
        backdrop, unknown = self.scene.backdrop, self.scene.unknown
        if self.alpha is not None:
            alpha = np.clip(_matte_plane(self.alpha.path(frame)), 0, 1)
            return colour_figure(image, backdrop, unknown, alpha)
        if self.keyframes is None:
            return pull_figure(image, backdrop, unknown)
        trimap = self.keyframes.trimap(frame)
        if frame not in self.keyframes.drawn.files:
            return pull_figure(image, backdrop, unknown, hint=trimap)
        return pull_figure(image, backdrop, unknown, trimap)._replace(trimap=trimap)

    def _beta(self, image: Float32, hidden: Bool) -> tuple[Float32, Bool]:
        """β (H, W) or (H, W, 3), filled, and where it was not measured."""
        scene, plates = self.scene, self.scene.plates
        if self.beta == "rgb":
            coloured = shadow_beta.coloured_matte(image, plates.lit, plates.shadow)
            planes = list(np.moveaxis(coloured, -1, 0))
        else:
            planes = [shadow_beta.shadow_matte(image, plates.lit, plates.shadow)]
        filled = []
        unknown = np.zeros(hidden.shape, bool)
        for plane, contrast in zip(planes, scene.contrasts, strict=True):
            known = np.where(scene.never_shaded | hidden, np.float32(np.nan), plane)
            known = shadow_beta.without_noise(known, contrast)
            known = np.clip(known, 0, 1) if self.clamp else known
            unknown |= np.isnan(known)
            filled.append(shadow_beta.fill_beta(known, scene.never_reached, hidden, self.fill))
        return filled[0] if self.beta == "scalar" else np.stack(filled, axis=-1), unknown


def _matte_plane(path: Path) -> Float32:
    plane = read_image(path).plane("A", "Y", "R")
    return np.nan_to_num(plane, nan=0.0)
