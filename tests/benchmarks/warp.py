"""How near the displacement map comes to the truth, and whether its predicted error is right.

    python -m tests.benchmarks.warp

On the rendered scenes of `footage`, three noisy sweeps each; errors in pixels over what the key
light reaches, on the reference plane and where an object displaces the shadow by more than 1.
"""

import tempfile
from pathlib import Path

import numpy as np

from shadowtool.core.warp_map import identity_map
from shadowtool.io.image import read_image
from shadowtool.io.products import WARP, read_warp
from shadowtool.steps.scan import scan
from shadowtool.steps.warp import warp
from tests.benchmarks.footage import SCENES, noisy_take, scene_folder


def measure(scene: str, work: Path) -> dict[str, float]:
    """Figures of one scene, by name."""
    mask = scene_folder(scene) / "plane.png"
    scans = []
    for take in ("sweep1", "sweep2", "sweep3"):
        scan(noisy_take(scene, take), work / take, plane=str(mask))
        scans.append(work / take)
    warp(scans, work / "warp")
    found, _, _ = read_warp(work / "warp" / WARP)
    true, _, _ = read_warp(scene_folder(scene) / "truth" / "target" / WARP)
    reached = true.error == 0
    known = reached & np.isfinite(found.error)
    error = np.linalg.norm(found.warp - true.warp, axis=-1)
    moved = np.linalg.norm(true.warp - identity_map(*reached.shape), axis=-1) > 1
    plane = known & (read_image(mask).plane("Y") > 0.5)
    objects = known & moved
    sure = known & (found.error <= 1)
    return {
        "plane, median": float(np.median(error[plane])),
        "plane, 90th percentile": float(np.percentile(error[plane], 90)),
        "objects, median": float(np.median(error[objects])),
        "objects, 90th percentile": float(np.percentile(error[objects], 90)),
        "known, of what the light reaches": float(known.sum() / reached.sum()),
        "within 1 px, of those predicted so": float((error[sure] <= 1).mean()),
    }


def main() -> None:
    print(__doc__.partition("\n")[0])
    for scene in SCENES:
        with tempfile.TemporaryDirectory() as work:
            figures = measure(scene, Path(work))
        print(f"\n{scene}")
        for name, value in figures.items():
            print(f"  {name:36}{value:8.3f}")


if __name__ == "__main__":
    main()
