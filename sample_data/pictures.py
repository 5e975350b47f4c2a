"""Make the README's pictures from the folder that the Makefile fills.

python pictures.py WORK [-o pictures]
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from compare import HERE, coded, encode

from shadowtool.io.image import read_image
from shadowtool.io.products import read_plates

FRAME = 1027


def picture(image: np.ndarray) -> np.ndarray:
    """Encoded values in [0, 1], grey or colour, to (H, W, 3) uint8."""
    code = np.rint(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    return np.repeat(code[..., None], 3, axis=-1) if code.ndim == 2 else code


def rows(work: Path, truth: Path) -> dict[str, list[np.ndarray]]:
    """Pictures by name, each a list that is put side by side."""
    source, target = (read_plates(work / f"{s}_plates").plates for s in ("source", "target"))
    alpha = read_image(work / "matte" / "fg" / f"fg.{FRAME}.exr").plane("A")
    beta = read_image(work / "matte" / "beta" / f"beta.{FRAME}.exr").plane("Y")
    result = coded(work / "composite" / f"composite.{FRAME}.exr")
    return {
        "result": [
            coded(work / "source" / f"source.{FRAME}.exr"),
            result,
            coded(truth / f"reference.{FRAME}.exr"),
        ],
        "source_plates": [encode(source.lit), encode(source.shadow)],
        "target_plates": [encode(target.lit), encode(target.shadow)],
        "matte": [alpha, beta],
        "scan": [coded(work / "scan_sweep2" / "scan.png")],
        "warp": [coded(work / "warp" / "warp.png")],
        "composite": [coded(work / "unwarped" / f"unwarped.{FRAME}.exr"), result],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=HERE / "pictures")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name, images in rows(options.work, HERE / "truth").items():
        row = np.hstack([picture(image) for image in images])
        quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
        cv2.imwrite(str(options.output / f"{name}.jpg"), row[..., ::-1], quality)


if __name__ == "__main__":
    main()
