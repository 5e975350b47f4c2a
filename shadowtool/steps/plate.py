"""Lit and shadow plates from a take in which a shadow moves over the scene."""

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Estimator, Missing
from shadowtool.core.beta import shadow_contrast
from shadowtool.core.noise import noise_levels, noise_model, sample_positions, thin
from shadowtool.core.plates import ExtremePlates
from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.files import fingerprint_file, make_folder
from shadowtool.io.image import Image, read_image
from shadowtool.io.products import MANIFEST, plate_files, write_plates
from shadowtool.io.sequence import Frame, Sequence, open_sequence
from shadowtool.parallel import ordered_map
from shadowtool.steps.footage import Footage, open_footage, require_frames, require_size
from shadowtool.steps.run import Recipe, Result, Run, refuse_existing, unchanged, write_manifest

logger = logging.getLogger(__name__)


def plate(
    source: str | Path,
    output: Path,
    *,
    run: Run = Run(),
    holdout: str | Path | None = None,
    estimator: Estimator = "minmax",
    transfer: str = "auto",
) -> Result:
    """Write ``lit.exr``, ``shadow.exr`` and ``confidence.exr``.

    Each frame is read once, and memory does not depend on their number.

    Args:
        holdout: a matte, roto or trimap sequence; where it is above 0 the pixel is out.

    Raises:
        InputError: frames or holdout are missing or don't fit.
        DamagedFileError: a frame can't be read.
    """
    footage = open_footage(source, "frames", transfer, run.missing)
    frames, absent = footage.sequence.select(run.frames, run.missing)
    held = None if holdout is None else _open_holdout(holdout, frames, footage, run.missing)
    refuse_existing([*plate_files(output), output / MANIFEST], run)
    inputs = {"frames": Path(footage.sequence.pattern).name}
    if held is not None:
        inputs["holdout"] = Path(held.pattern).name
    recipe = Recipe("plate", {"estimator": estimator, "transfer": footage.transfer}, inputs)
    jobs = run.jobs
    if run.resume:
        paths = [footage.sequence.path(f) for f in frames]
        paths += [] if held is None else [held.path(f) for f in frames]
        mark = recipe.fingerprint(_fingerprints(paths, jobs))
        figures = unchanged(output, plate_files(output), mark)
        if figures is not None:
            return Result("plate", output, frames, len(frames), absent, figures)

    def read(frame: Frame) -> tuple[Image, NDArray[np.floating], Image | None] | None:
        try:
            image = footage.image(frame)
            matte = None if held is None else _read_holdout(held.path(frame), footage)
        except InputError:
            if run.missing == "skip":
                return None
            raise
        return image, image.rgb(footage.transfer), matte

    extremes = ExtremePlates()
    samples: dict[int, NDArray[np.float32]] = {}
    sampled = sample_positions(len(frames))
    marks, held_marks, skipped, used = [], [], list(absent), []
    run.progress(0, len(frames))
    for number, (frame, item) in enumerate(
        zip(frames, ordered_map(read, frames, jobs), strict=True), start=1
    ):
        run.progress(number, len(frames))
        if item is None:
            skipped.append(frame)
            continue
        image, values, matte = item
        marks.append(image.fingerprint)
        if matte is not None:
            held_marks.append(matte.fingerprint)
        used.append(frame)
        extremes.add(values, None if matte is None else matte.plane("A", "Y", "R"))
        for key, position in sampled.items():
            if position == number - 1:
                samples[key] = thin(values)
    if not used:
        raise DamagedFileError(f"{footage.sequence.pattern}: no frame can be read")
    plates = extremes.plates()
    noise = noise_model(noise_levels(samples))
    contrast = shadow_contrast(plates, noise)
    unseen = 0 if plates.frames is None else int((plates.frames == 0).sum())
    figures = {
        "frames": len(used),
        "pixels": int(contrast.size),
        "unseen": unseen,
        "noise_at_mid_grey": [round(float(v), 6) for v in noise.sigma(np.full(3, 0.18))],
    }
    if unseen:
        logger.warning(
            "%s: %d pixels (%.2f%%) were seen in no frame; they are NaN",
            output,
            unseen,
            100 * unseen / contrast.size,
        )
    mark = recipe.fingerprint([*marks, *held_marks])
    make_folder(output)
    write_plates(output, plates, contrast, footage.header, recipe.provenance(mark))
    write_manifest(output, recipe, mark, figures)
    return Result("plate", output, used, 0, skipped, figures)


def _open_holdout(
    holdout: str | Path, frames: list[Frame], footage: Footage, missing: Missing
) -> Sequence:
    sequence = open_sequence(holdout, "holdout")
    require_frames(sequence, frames, footage.header, "the footage", missing)
    return sequence


def _read_holdout(path: Path, footage: Footage) -> Image:
    image = read_image(path)
    require_size(path, image.header, footage.header, "the footage")
    return image


def _fingerprints(paths: list[Path], jobs: int | None) -> list[str]:
    return list(ordered_map(fingerprint_file, paths, jobs))
