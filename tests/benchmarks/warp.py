"""How near the displacement map comes to the truth, and whether its predicted error is right.

    python -m tests.benchmarks.warp

On the rendered scenes of `footage`: the paper's method beside ours, three noisy sweeps each; the
worst two of them; and the three as 8-bit H.264. Errors in pixels over what the key light reaches,
on the reference plane and where an object displaces the shadow by more than 1.
"""

import sys
import tempfile
from itertools import combinations
from pathlib import Path

import numpy as np

from shadowtool.core.crossings import CrossingFinder
from shadowtool.core.diffusion import diffuse
from shadowtool.core.shadow_lines import fit_shadow_lines, zero_crossings
from shadowtool.core.shadow_time import (
    ShadowTimes,
    interpolated_times,
    luminance,
)
from shadowtool.core.warp_map import Pass, WarpMap, identity_map, intersect
from shadowtool.io.image import read_image
from shadowtool.io.products import WARP, read_warp
from shadowtool.steps.capture import capture
from shadowtool.steps.scan import scan
from shadowtool.steps.warp import warp
from tests.benchmarks.footage import (
    SCENES,
    frame_numbers,
    load,
    movie,
    noisy_take,
    scene_folder,
)

SWEEPS = ("sweep1", "sweep2", "sweep3")
# What is asked of three sweeps, what of two and of 8 bits, and whether more is better.
REACH = {
    "plane, median": (0.15, 0.30, False),
    "plane, 90th percentile": (0.6, 1.2, False),
    "objects, median": (0.4, 0.8, False),
    "objects, 90th percentile": (1.5, 3.0, False),
    "known, of what the light reaches": (0.97, 0.97, True),
    "within 1 px, of those predicted so": (0.90, 0.90, True),
    "  the same on objects alone": (0.0, 0.0, True),
}


def paper_map(scene: str) -> WarpMap:
    """Interpolated times, the lines through them, their intersections, and diffusion."""
    region = read_image(scene_folder(scene) / "plane.png").plane("Y") > 0.5
    passes = []
    for take in SWEEPS:
        folder = noisy_take(scene, take)
        numbers = frame_numbers(scene, take)
        finder = CrossingFinder()
        for number in numbers:
            finder.add(luminance(load(folder / f"{take}.{number:04d}.exr")))
        crossings = finder.found()
        contrast = crossings.highest - crossings.lowest
        # The paper leaves out pixels of low contrast: here, below a tenth of the usual.
        low = contrast < 0.1 * np.median(contrast)
        time = np.where(low, np.float32(np.nan), interpolated_times(crossings))
        count = np.arange(len(numbers), dtype=np.float64)
        lines = fit_shadow_lines(zero_crossings(time, region, count), count)
        passes.append(Pass(ShadowTimes.alone(time, contrast), lines))
    return diffuse(intersect(passes, identity_map(*region.shape)), 40)


def figures(scene: str, found: WarpMap) -> dict[str, float]:
    """Errors against the truth, by name."""
    true, _, _ = read_warp(scene_folder(scene) / "truth" / "target" / WARP)
    reached = true.error == 0
    known = reached & np.isfinite(found.error)
    error = np.linalg.norm(found.warp - true.warp, axis=-1)
    moved = np.linalg.norm(true.warp - identity_map(*reached.shape), axis=-1) > 1
    plane = known & (read_image(scene_folder(scene) / "plane.png").plane("Y") > 0.5)
    objects = known & moved
    sure = known & (found.error <= 1)
    values = (
        np.median(error[plane]),
        np.percentile(error[plane], 90),
        np.median(error[objects]),
        np.percentile(error[objects], 90),
        known.sum() / reached.sum(),
        within(error[sure]),
        within(error[sure & moved]),
    )
    return dict(zip(REACH, map(float, values), strict=True))


def within(error: np.ndarray) -> float:
    """How many of these errors are at most 1 px; of the paper's map none is predicted to be."""
    return float((error <= 1).mean()) if error.size else float("nan")


def scanned(scene: str, takes: dict[str, Path], work: Path) -> dict[str, Path]:
    """The folders of the scans of takes."""
    plane = str(scene_folder(scene) / "plane.png")
    for take, frames in takes.items():
        scan(frames, work / take, plane=plane)
    return {take: work / take for take in takes}


def solved(scene: str, scans: list[Path], work: Path) -> dict[str, float]:
    warp(scans, work)
    return figures(scene, read_warp(work / WARP)[0])


def measure(scene: str, work: Path) -> dict[str, dict[str, float]]:
    """Figures by method."""
    scans = scanned(scene, {t: noisy_take(scene, t) for t in SWEEPS}, work / "frames")
    captured = {}
    for take in SWEEPS:
        captured[take] = work / "captured" / take
        capture(movie(scene, take, small=True), captured[take])
    small = scanned(scene, captured, work / "small")
    pairs = [
        solved(scene, [scans[t] for t in pair], work / "-".join(pair))
        for pair in combinations(SWEEPS, 2)
    ]
    worst = {name: (min if row[2] else max)(p[name] for p in pairs) for name, row in REACH.items()}
    return {
        "paper": figures(scene, paper_map(scene)),
        "ours": solved(scene, list(scans.values()), work / "ours"),
        "two": worst,
        "8 bit": solved(scene, list(small.values()), work / "eight"),
    }


def main() -> None:
    print(__doc__.partition("\n")[0])
    for scene in SCENES:
        with tempfile.TemporaryDirectory() as work:
            columns = measure(scene, Path(work))
        print(f"\n{scene:36}" + "".join(f"{name:>9}" for name in columns) + "   asked for")
        for name, (three, fewer, more) in REACH.items():
            row = "".join(f"{column[name]:9.3f}" for column in columns.values())
            missed = [
                method
                for method, bound in (("ours", three), ("two", fewer), ("8 bit", fewer))
                if (columns[method][name] < bound) == more and columns[method][name] != bound
            ]
            asked = "" if not three else f"{'≥' if more else '≤'} {three:g}"
            if three and fewer != three:
                asked += f" ({fewer:g})"
            verdict = f": missed by {', '.join(missed)}" if missed else ""
            print(f"  {name:36}{row[2:]}   {asked}{verdict}")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
