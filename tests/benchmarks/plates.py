"""How near plates and β come to the truth: the paper's literal method beside ours.

    python -m tests.benchmarks.plates

On the rendered scenes of `footage`, with camera-like noise, as clean frames, as 10-bit H.264, and
as a consumer's 8-bit H.264.
PSNR in dB of sRGB-encoded values; β as mean absolute error where the figure does not hide it.
"""

import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from shadowtool.core.beta import inverse_span, shadow_matte
from shadowtool.core.transfer import encode_srgb
from shadowtool.io.image import read_image, write_png
from shadowtool.io.products import read_plates
from shadowtool.io.sequence import open_sequence
from shadowtool.steps.capture import capture
from shadowtool.steps.matte import matte
from shadowtool.steps.plate import plate
from shadowtool.steps.run import Run
from tests.benchmarks.footage import (
    SCENES,
    frame_numbers,
    load,
    movie,
    noisy_take,
    scene_folder,
)

# How far around the shadow its neighbourhood reaches, pixels.
NEAR = 15
REACH = {
    "lit dB": ("≥ 47", 47.0, 1),
    "shadow dB": ("≥ 43", 43.0, 1),
    "β near": ("≤ 0.020", 0.020, -1),
    "β near, auto": ("≤ 0.030", 0.030, -1),
    "β elsewhere": ("≤ 0.005", 0.005, -1),
    "β elsewhere, auto": ("≤ 0.005", 0.005, -1),
}


def psnr(one: np.ndarray, other: np.ndarray, where: np.ndarray) -> float:
    """Of sRGB-encoded values over the pixels of a mask; unknown pixels count as black."""
    coded = [np.clip(encode_srgb(np.nan_to_num(i)), 0, 1)[where] for i in (one, other)]
    return float(-10 * np.log10(np.mean((coded[0] - coded[1]) ** 2)))


def plate_figures(scene: str, take: Path, work: Path, **options: str) -> dict[str, float]:
    """The target's plates: PSNR of lit everywhere, and of shadow where the key light reaches."""
    truth = scene_folder(scene) / "truth" / "target"
    lit, shadow = load(truth / "lit.exr"), load(truth / "shadow.exr")
    plate(take, work / "target", run=Run(overwrite=True), **options)
    found = read_plates(work / "target").plates
    covered = (lit - shadow).sum(axis=-1) > 0.1 * lit.sum(axis=-1)
    everywhere = np.ones(covered.shape, bool)
    return {
        "lit dB": psnr(found.lit, lit, everywhere),
        "shadow dB": psnr(found.shadow, shadow, covered),
    }


def beta_figures(
    scene: str, take: Path, work: Path, alpha: Path | None, suffix: str, **options: str
) -> dict[str, float]:
    """β of the source, near the shadow and elsewhere, over every third frame."""
    truth = scene_folder(scene) / "truth" / "source"
    holdout = {} if alpha is None else {"holdout": alpha}
    plate(take, work / "source", run=Run(overwrite=True), **holdout, **options)
    frames = frame_numbers(scene, "source")
    chosen = f"{frames[0]}-{frames[-1]}x3"
    literal = options.get("estimator") == "minmax"
    scene_plates = read_plates(work / "source").plates
    if not literal:
        matte(
            take,
            work / "matte",
            plates=work / "source",
            alpha=alpha,
            run=Run(overwrite=True, frames=chosen),
        )
    near, elsewhere = [], []
    for frame in frames[::3]:
        if literal:
            image = load(frame_file_of(take, frame))
            inverse = inverse_span(scene_plates.lit, scene_plates.shadow)
            projected = shadow_matte(image, scene_plates.shadow, inverse)
            found = np.clip(np.nan_to_num(projected, nan=1.0), 0, 1)
        else:
            found = read_image(work / "matte" / "beta" / f"beta.{frame}.exr").plane("Y")
        true, cover = load(truth / f"beta.{frame}.exr"), load(truth / f"alpha.{frame}.exr")
        shaded = (true < 0.98).astype(np.uint8)
        around = cv2.dilate(shaded, np.ones((2 * NEAR + 1, 2 * NEAR + 1))) > 0
        visible = cover == 0
        error = np.abs(found - true)
        near.append(error[around & visible])
        elsewhere.append(error[~around & visible])
    return {
        f"β near{suffix}": float(np.concatenate(near).mean()),
        f"β elsewhere{suffix}": float(np.concatenate(elsewhere).mean()),
    }


def frame_file_of(take: Path, frame: int) -> Path:
    return open_sequence(take).path(frame)


def alpha_mattes(scene: str, folder: Path) -> Path:
    """The true alpha as a sequence of mattes."""
    mattes = folder / "alpha"
    mattes.mkdir()
    for frame in frame_numbers(scene, "source"):
        alpha = load(scene_folder(scene) / "truth" / "source" / f"alpha.{frame}.exr")
        write_png(mattes / f"alpha.{frame}.png", np.rint(alpha * 65535).astype(np.uint16))
    return mattes


def measure(scene: str, source: Path, target: Path, work: Path) -> dict[str, dict[str, float]]:
    """Figures by method."""
    mattes = alpha_mattes(scene, work)
    literal = plate_figures(scene, target, work, estimator="minmax", holdout="none")
    literal |= beta_figures(scene, source, work, mattes, "", estimator="minmax")
    ours = plate_figures(scene, target, work)
    ours |= beta_figures(scene, source, work, mattes, "")
    ours |= beta_figures(scene, source, work, None, ", auto")
    return {"paper": literal, "ours": ours}


def main() -> None:
    print(__doc__.partition("\n")[0])
    for scene in SCENES:
        for kind in ("frames", "movie", "small movie"):
            start = time.monotonic()
            with tempfile.TemporaryDirectory() as name:
                work = Path(name)
                takes = []
                for take in ("source", "photometric"):
                    if kind == "frames":
                        takes.append(noisy_take(scene, take))
                    else:
                        capture(movie(scene, take, small=kind == "small movie"), work / take)
                        takes.append(work / take)
                rows = measure(scene, takes[0], takes[1], work)
            print(f"\n{scene}, {kind} ({time.monotonic() - start:.0f} s)")
            print(f"  {'':20}{'paper':>10}{'ours':>10}   asked for")
            for figure, (asked, bound, sign) in REACH.items():
                ours = rows["ours"][figure]
                paper = rows["paper"].get(figure)
                met = sign * (ours - bound) >= 0
                digits = 2 if sign > 0 else 4
                shown = f"{paper:10.{digits}f}" if paper is not None else f"{'':>10}"
                asked = asked if kind == "frames" else f"({asked} of clean frames)"
                verdict = "" if met else ": missed"
                print(f"  {figure:20}{shown}{ours:10.{digits}f}   {asked}{verdict}")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
