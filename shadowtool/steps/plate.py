"""Lit and shadow plates from a take in which a shadow moves over the scene."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Estimator, Missing
from shadowtool.core.beta import shadow_contrast
from shadowtool.core.noise import NoiseModel, noise_levels, noise_model, sample_positions, thin
from shadowtool.core.partial_coverage import complete_shadow
from shadowtool.core.plates import ExtremePlates, Plates
from shadowtool.core.robust_plates import SAMPLES, Keyed, LitLevels, RobustPlates, keyed
from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.files import fingerprint_file, make_folder
from shadowtool.io.image import Image, read_image
from shadowtool.io.products import MANIFEST, plate_files, write_plates
from shadowtool.io.sequence import Frame, Sequence, open_sequence
from shadowtool.parallel import ordered_map
from shadowtool.steps.footage import Footage, open_footage, require_frames, require_size
from shadowtool.steps.plane import read_plane
from shadowtool.steps.run import (
    Figures,
    Recipe,
    Result,
    Run,
    refuse_existing,
    unchanged,
    write_manifest,
)

logger = logging.getLogger(__name__)

Bool = NDArray[np.bool_]


def plate(
    source: str | Path,
    output: Path,
    *,
    run: Run = Run(),
    holdout: str | Path | None = None,
    estimator: Estimator = "robust",
    plane: str | None = None,
    transfer: str = "auto",
) -> Result:
    """Write ``lit.exr``, ``shadow.exr`` and ``confidence.exr``.

    Memory does not depend on the number of frames. ``minmax`` reads each once; ``robust`` reads a
    fixed number of them once more.

    Args:
        holdout: a matte, roto or trimap sequence; where it is above 0 the pixel is out.
        plane: mask image or polygon of the plane that the shadow falls on, for ``robust``.

    Raises:
        InputError: frames, holdout or mask are missing or don't fit.
        DamagedFileError: a frame can't be read.
    """
    footage = open_footage(source, "frames", transfer, run.missing)
    frames, absent = footage.sequence.select(run.frames, run.missing)
    held = None if holdout is None else _open_holdout(holdout, frames, footage, run.missing)
    region, plane_mark = (None, "") if plane is None else read_plane(plane, footage.header)
    refuse_existing([*plate_files(output), output / MANIFEST], run)
    inputs = {"frames": Path(footage.sequence.pattern).name}
    if held is not None:
        inputs["holdout"] = Path(held.pattern).name
    recipe = Recipe(
        "plate",
        {"estimator": estimator, "transfer": footage.transfer, "plane": plane_mark or None},
        inputs,
    )
    take = _Take(footage, held, run)
    if run.resume:
        paths = [footage.sequence.path(f) for f in frames]
        paths += [] if held is None else [held.path(f) for f in frames]
        mark = recipe.fingerprint(ordered_map(fingerprint_file, paths, run.jobs))
        figures = unchanged(output, plate_files(output), mark)
        if figures is not None:
            return Result("plate", output, frames, len(frames), absent, figures)
    if estimator == "minmax":
        plates, noise, more = _extremes(take, frames)
    else:
        plates, noise, more = _robust(take, frames, region)
    contrast = shadow_contrast(plates, noise)
    unseen = int(np.isnan(plates.lit).any(axis=-1).sum())
    figures = {
        "frames": len(take.used),
        "pixels": int(contrast.size),
        "unseen": unseen,
        "noise_at_mid_grey": [round(float(v), 6) for v in noise.sigma(np.full(3, 0.18))],
        **more,
    }
    if unseen:
        part = 100 * unseen / contrast.size
        logger.warning("%s: %d pixels (%.2f%%) were seen in no frame", output, unseen, part)
    mark = recipe.fingerprint([*take.marks, *take.held_marks])
    make_folder(output)
    write_plates(output, plates, contrast, footage.header, recipe.provenance(mark))
    write_manifest(output, recipe, mark, figures)
    return Result("plate", output, take.used, 0, [*absent, *take.skipped], figures)


class _Estimate(NamedTuple):
    plates: Plates
    noise: NoiseModel
    figures: Figures


class _Shown(NamedTuple):
    """A frame and what is to be left out of it."""

    image: Image
    values: NDArray[np.floating]
    matte: Image | None
    holdout: NDArray[np.float32] | None
    keyed: Keyed | None


@dataclass
class _Take:
    """The frames with their holdouts, read in parallel and handed on in order."""

    footage: Footage
    held: Sequence | None
    run: Run
    used: list[Frame] = field(default_factory=list)
    skipped: list[Frame] = field(default_factory=list)
    marks: list[str] = field(default_factory=list)
    held_marks: list[str] = field(default_factory=list)

    def shown(self, frames: list[Frame], with_keys: bool) -> Iterator[_Shown | None]:
        """Each frame in turn, None for those that are skipped."""

        def read(frame: Frame) -> _Shown | None:
            try:
                image = self.footage.image(frame)
                matte = None if self.held is None else self._holdout(self.held.path(frame))
            except InputError:
                if self.run.missing == "skip":
                    return None
                raise
            values = image.rgb(self.footage.transfer)
            holdout = None if matte is None else matte.plane("A", "Y", "R")
            keys = keyed(values, holdout) if with_keys else None
            return _Shown(image, values, matte, holdout, keys)

        yield from ordered_map(read, frames, self.run.jobs)

    def all_shown(
        self, frames: list[Frame], with_keys: bool, begun: int = 0
    ) -> Iterator[tuple[int, _Shown]]:
        """All the frames that can be read, with their positions; what is used is recorded."""
        total = begun + len(frames)
        self.run.progress(begun, total)
        for position, item in enumerate(self.shown(frames, with_keys)):
            if item is None:
                self.skipped.append(frames[position])
            else:
                self.used.append(frames[position])
                self.marks.append(item.image.fingerprint)
                if item.matte is not None:
                    self.held_marks.append(item.matte.fingerprint)
                yield position, item
            self.run.progress(begun + position + 1, total)
        if not self.used:
            raise DamagedFileError(f"{self.footage.sequence.pattern}: no frame can be read")

    def _holdout(self, path: Path) -> Image:
        image = read_image(path)
        require_size(path, image.header, self.footage.header, "the footage")
        return image


def _extremes(take: _Take, frames: list[Frame]) -> _Estimate:
    """Eq. (4), in one reading."""
    extremes = ExtremePlates()
    samples: dict[int, NDArray[np.float32]] = {}
    sampled = {position: number for number, position in sample_positions(len(frames)).items()}
    for position, item in take.all_shown(frames, with_keys=False):
        extremes.add(item.values, item.holdout)
        if position in sampled:
            samples[sampled[position]] = thin(item.values)
    return _Estimate(extremes.plates(), noise_model(noise_levels(samples)), {})


def _robust(take: _Take, frames: list[Frame], region: Bool | None) -> _Estimate:
    """Means of lit and shaded frames, and the plane's ratio where the shadow fell in part."""
    sampled = {position: number for number, position in sample_positions(len(frames)).items()}
    spread = np.linspace(0, len(frames) - 1, max(SAMPLES - len(sampled), 1)).astype(int)
    positions = sorted({*sampled, *spread.tolist()})
    levels = LitLevels()
    samples: dict[int, NDArray[np.float32]] = {}
    chosen = [frames[position] for position in positions]
    total = len(positions) + len(frames)
    for count, item in enumerate(take.shown(chosen, with_keys=True)):
        take.run.progress(count, total)
        if item is None or item.keyed is None:
            continue
        levels.add(item.keyed)
        if positions[count] in sampled:
            samples[sampled[positions[count]]] = thin(item.values)
    noise = noise_model(noise_levels(samples))
    estimate: RobustPlates | None = None
    for _, item in take.all_shown(frames, with_keys=True, begun=len(positions)):
        assert item.keyed is not None
        if estimate is None:
            estimate = RobustPlates(levels.levels(), noise)
        estimate.add(item.keyed)
    assert estimate is not None
    found = estimate.measured()
    sigma = noise.sigma(np.nan_to_num(found.shadow))
    completed = complete_shadow(found.lit, found.shadow, found.shadow_frames, sigma, region)
    plates = Plates(found.lit, completed.shadow, found.lit_frames, found.shadow_frames)
    seen = found.lit_frames > 0
    figures: Figures = {
        "shaded": round(float((found.shadow_frames > 0).mean()), 4),
        "own_evidence": round(float(completed.own[seen].mean()), 4) if seen.any() else 0.0,
        "read_as": "a plane that a shadow crossed" if completed.partial else "a scene under a card",
    }
    return _Estimate(plates, noise, figures)


def _open_holdout(
    holdout: str | Path, frames: list[Frame], footage: Footage, missing: Missing
) -> Sequence:
    sequence = open_sequence(holdout, "holdout")
    require_frames(sequence, frames, footage.header, "the footage", missing)
    return sequence
