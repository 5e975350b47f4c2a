"""How near alpha and colour come to the truth, beside PyMatting's closed-form matting.

    python -m tests.benchmarks.matting

On the rendered scenes of `footage`, with camera-like noise; plates are our own. PyMatting is given
trimaps derived from the truth: what is mixed, widened by 3 pixels, is unknown. Alpha as mean
absolute error over the whole frame and in that band; colour as PSNR in dB of sRGB-encoded values of
the figure over black, green and white, in the band; shadow taken for figure as the part of the
shadow's pixels with alpha above a half. Time and memory are those of whole processes at 1920x1080.
"""

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from shadowtool.core.compositing import shade
from shadowtool.core.transfer import encode_srgb
from shadowtool.io.image import Header, read_image, write_exr, write_png
from shadowtool.steps.matte import matte
from shadowtool.steps.plate import plate
from shadowtool.steps.run import Run
from tests.benchmarks.footage import (
    SCENES,
    frame_numbers,
    frame_path,
    load,
    noisy_take,
    scene_folder,
)
from tests.benchmarks.plates import alpha_mattes

BAND = 3
STEP, KEYFRAMES = 3, 10
GROUNDS = (np.zeros(3), np.array([0.0, 1.0, 0.0]), np.ones(3))
# A 1080p shot is a scene four times as large, so many frames of it.
LARGE, LARGE_FRAMES = (1920, 1080), 8
ASKED = """asked for: alpha of the whole frame at most half of PyMatting's, a third with trimaps;
colour 40 dB; shadow below 0.1%; at 1080p 1 s and 600 MB"""


class Truth(NamedTuple):
    """What a frame shows: alpha, the figure premultiplied, β, and a trimap with its band."""

    alpha: np.ndarray
    figure: np.ndarray
    beta: np.ndarray
    trimap: np.ndarray


class Pulled(NamedTuple):
    alpha: np.ndarray
    figure: np.ndarray


def truth(scene: str, number: int) -> Truth:
    folder = scene_folder(scene) / "truth" / "source"
    alpha, beta, lit, shadow = (
        load(folder / f"{name}.exr")
        for name in (f"alpha.{number}", f"beta.{number}", "lit", "shadow")
    )
    clean = load(frame_path(scene, "source", number))
    figure = clean - (1 - alpha[..., None]) * shade(lit, shadow, beta)
    figure[alpha == 0] = 0
    mixed = ((alpha > 0) & (alpha < 1)).astype(np.uint8)
    size = 2 * BAND + 1
    band = cv2.dilate(mixed, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0
    trimap = np.where(band, 128, np.where(alpha == 1, 255, 0)).astype(np.uint8)
    return Truth(alpha, figure, beta, trimap)


def trimaps(scene: str, folder: Path, every: int) -> Path:
    """Trimaps derived from the truth, for some of the frames."""
    folder.mkdir()
    for number in frame_numbers(scene, "source")[::every]:
        write_png(folder / f"trimap.{number}.png", truth(scene, number).trimap)
    return folder


def ours(folder: Path) -> Callable[[int], Pulled]:
    def read(number: int) -> Pulled:
        colour, alpha = read_image(folder / "fg" / f"fg.{number}.exr").rgba()
        return Pulled(alpha, colour)

    return read


def closed_form(scene: str) -> Callable[[int], Pulled]:
    """Levin et al. 2008 and multi-level foreground estimation, on coded values as is usual."""
    import pymatting

    def solve(number: int) -> Pulled:
        image = load(noisy_take(scene, "source") / f"source.{number}.exr").astype(np.float64)
        trimap = truth(scene, number).trimap
        if not (trimap == 255).any():
            return Pulled(np.where(trimap > 0, 0.5, 0.0), 0 * image)
        known = np.select([trimap == 0, trimap == 255], [0.0, 1.0], 0.5)
        coded = np.clip(encode_srgb(image), 0, 1).astype(np.float64)
        alpha = pymatting.estimate_alpha_cf(coded, known)
        foreground = pymatting.estimate_foreground_ml(np.clip(image, 0, 1), alpha)
        return Pulled(alpha, alpha[..., None] * foreground)

    return solve


def figures(scene: str, numbers: Iterable[int], pull: Callable[[int], Pulled]) -> list[float]:
    """Alpha's error in the whole frame and in the band, colour in dB, shadow in percent."""
    whole, band, colour, taken = [], [], [], []
    for number in numbers:
        true, found = truth(scene, number), pull(number)
        error = np.abs(found.alpha - true.alpha)
        inside = true.trimap == 128
        whole.append(error.mean())
        band.append(error[inside])
        for ground in GROUNDS:
            shown, expected = (
                encode_srgb(np.clip(f + (1 - a[..., None]) * ground, 0, 1))[inside]
                for f, a in ((found.figure, found.alpha), (true.figure, true.alpha))
            )
            colour.append(((shown - expected) ** 2).ravel())
        taken.append(found.alpha[(true.beta < 0.5) & (true.alpha == 0)] > 0.5)
    return [
        float(np.mean(whole)),
        float(np.concatenate(band).mean()),
        float(-10 * np.log10(np.concatenate(colour).mean())),
        float(100 * np.concatenate(taken).mean()),
    ]


def measure(scene: str, work: Path) -> dict[str, list[float]]:
    """Figures by method."""
    frames = frame_numbers(scene, "source")
    numbers = frames[::STEP]
    chosen = f"{frames[0]}-{frames[-1]}x{STEP}"
    take = noisy_take(scene, "source")
    plate(take, work / "plates")
    rows: dict[str, list[float]] = {}
    if importlib.util.find_spec("pymatting"):
        rows["PyMatting, true trimaps"] = figures(scene, numbers, closed_form(scene))
    drawn = {
        "ours": None,
        f"ours, trimaps every {KEYFRAMES}": KEYFRAMES,
        "ours, true trimaps": 1,
    }
    for place, (name, every) in enumerate(drawn.items()):
        folder = work / str(place)
        trimap = None if every is None else trimaps(scene, work / f"trimaps{every}", every)
        matte(take, folder, plates=work / "plates", trimap=trimap, run=Run(frames=chosen))
        rows[name] = figures(scene, numbers, ours(folder))
    matte(
        take,
        work / "given",
        plates=work / "plates",
        alpha=alpha_mattes(scene, work),
        run=Run(frames=chosen),
    )
    rows["ours, true alpha"] = figures(scene, numbers, ours(work / "given"))
    return rows


def write_large(folder: Path) -> None:
    """A shot of 1080p: a scene with its true plates, larger, with noise of its own."""
    scene = SCENES[0]

    def large(image: np.ndarray) -> np.ndarray:
        return np.maximum(cv2.resize(image, LARGE, interpolation=cv2.INTER_CUBIC), 0)

    header = Header(*LARGE)
    for part in ("source", "plates"):
        (folder / part).mkdir()
    for name in ("lit", "shadow"):
        values = large(load(scene_folder(scene) / "truth" / "source" / f"{name}.exr"))
        write_exr(folder / "plates" / f"{name}.exr", {"RGB": values}, header)
    rng = np.random.default_rng(1)
    frames = frame_numbers(scene, "source")
    for number in frames[len(frames) // 2 :][:LARGE_FRAMES]:
        image = large(load(frame_path(scene, "source", number)))
        image = image + rng.normal(size=image.shape) * 0.003 * np.sqrt(
            np.maximum(image, 0.01) / 0.18
        )
        write_exr(
            folder / "source" / f"source.{number}.exr", {"RGB": image.astype(np.float16)}, header
        )
        trimap = cv2.resize(truth(scene, number).trimap, LARGE, interpolation=cv2.INTER_NEAREST)
        write_png(folder / f"trimap.{number}.png", trimap)


_CLOSED_FORM = """
import sys, numpy as np, pymatting
from pathlib import Path
from shadowtool.io.image import read_image
image = np.clip(read_image(Path(sys.argv[1])).rgb().astype(float), 0, 1) ** (1 / 2.2)
trimap = read_image(Path(sys.argv[2])).plane("Y").round(1).astype(float)
alpha = pymatting.estimate_alpha_cf(image, trimap)
pymatting.estimate_foreground_ml(image, alpha)
"""


def process(words: list[str]) -> tuple[float, float]:
    """Processor time in seconds and peak memory in MB of a process."""
    watched = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True);"
        " used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        " print(used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)"
    )
    done = subprocess.run(
        [sys.executable, "-c", watched, *words], check=True, capture_output=True, text=True
    )
    seconds, memory = done.stdout.split()[-2:]
    return float(seconds), float(memory)


def costs(work: Path) -> dict[str, tuple[float, float]]:
    """Seconds of processor time a frame, and MB, at 1080p."""
    write_large(work)
    numbers = sorted(path.name.split(".")[1] for path in (work / "source").iterdir())
    program = [sys.executable, "-c", "from shadowtool.cli import main; main()"]
    words = [*program, "matte", str(work / "source"), "--plates", str(work / "plates"), "-q", "-j1"]
    # What a take costs once, whatever its length, is in both.
    one, _ = process([*words, "-o", str(work / "one"), "--frames", numbers[0]])
    all_, memory = process([*words, "-o", str(work / "all")])
    rows = {"ours, with files": ((all_ - one) / (LARGE_FRAMES - 1), memory)}
    if importlib.util.find_spec("pymatting"):
        frame = work / "source" / f"source.{numbers[0]}.exr"
        words = [sys.executable, "-c", _CLOSED_FORM, str(frame)]
        rows["PyMatting"] = process([*words, str(work / f"trimap.{numbers[0]}.png")])
    return rows


def main() -> None:
    print(__doc__.partition("\n")[0])
    print(ASKED)
    if not importlib.util.find_spec("pymatting"):
        print("PyMatting is not installed and left out: python -m pip install '.[bench]'")
    for scene in SCENES:
        with tempfile.TemporaryDirectory() as name:
            rows = measure(scene, Path(name))
        print(f"\n{scene:26}{'alpha':>9}{'in band':>9}{'colour':>9}{'shadow':>9}")
        for method, (whole, band, colour, taken) in rows.items():
            print(f"  {method:24}{whole:9.5f}{band:9.4f}{colour:6.1f} dB{taken:8.3f}%")
        sys.stdout.flush()
    with tempfile.TemporaryDirectory() as name:
        print("\n1080p, a frame")
        for method, (seconds, memory) in costs(Path(name)).items():
            print(f"  {method:24}{seconds:7.2f} s{memory:8.0f} MB")


if __name__ == "__main__":
    main()
