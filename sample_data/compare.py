"""Hold the sample's composites against the rendered truth: figures and a contact sheet.

    python compare.py WORK [--sheet contact.png]

WORK is the folder that the Makefile fills. A row for each frame that has a reference; from left
to right: source, target, composite without the warp, composite, reference. PSNR is taken of
sRGB-encoded values inside the region that the true shadow touches, without the figure.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from shadowtool.core.transfer import encode_srgb
from shadowtool.core.warp_map import positions, sample
from shadowtool.io.image import read_image, write_png
from shadowtool.io.products import read_plates, read_warp

HERE = Path(__file__).parent
# A pixel is touched by the shadow where the key light is dimmed by more than this.
TOUCHED = 0.02


def coded(path: Path) -> np.ndarray:
    """A picture (H, W, 3), sRGB-encoded, in [0, 1]."""
    return encode(read_image(path).rgb())


def encode(linear: np.ndarray) -> np.ndarray:
    return np.clip(encode_srgb(linear.astype(np.float32)), 0, 1)


def psnr(one: np.ndarray, other: np.ndarray, where: np.ndarray) -> float:
    """Decibels over the pixels of a mask."""
    error = (one[where].astype(np.float64) - other[where]) ** 2
    return float(-10 * np.log10(max(error.mean(), 1e-12)))


def shadow_region(truth: Path, frame: int) -> np.ndarray:
    """Where the true shadow of a frame falls on the target, but for what the figure covers."""
    warp, _, _ = read_warp(truth / "warp.exr")
    beta = sample(
        read_image(truth / f"beta.{frame}.exr").plane("Y"), positions(warp.warp), outside=1.0
    )
    alpha = read_image(truth / f"alpha.{frame}.exr").plane("Y")
    return (beta < 1 - TOUCHED) & (alpha == 0)


def compare(work: Path, truth: Path, frame: int) -> tuple[dict[str, float], list[np.ndarray]]:
    """PSNR by name, and the pictures of a row."""
    reference = coded(truth / f"reference.{frame}.exr")
    target = encode(read_plates(work / "target_plates").plates.lit)
    unwarped = coded(work / "unwarped" / f"unwarped.{frame}.exr")
    ours = coded(work / "composite" / f"composite.{frame}.exr")
    source = coded(work / "source" / f"source.{frame}.exr")
    where = shadow_region(truth, frame)
    figures = {
        "no shadow": psnr(target, reference, where),
        "no warp": psnr(unwarped, reference, where),
        "ours": psnr(ours, reference, where),
        "whole frame": psnr(ours, reference, np.ones_like(where)),
    }
    return figures, [source, target, unwarped, ours, reference]


def sheet(rows: list[list[np.ndarray]], titles: list[str]) -> np.ndarray:
    """The pictures side by side under their titles, (H, W, 3) uint8."""
    strips = []
    for row in rows:
        pictures = [np.rint(picture * 255).astype(np.uint8) for picture in row]
        strips.append(np.hstack([np.pad(p, ((2, 2), (2, 2), (0, 0))) for p in pictures]))
    width = strips[0].shape[1] // len(titles)
    head = np.zeros((30, strips[0].shape[1], 3), np.uint8)
    for number, title in enumerate(titles):
        place = (number * width + 12, 21)
        cv2.putText(
            head, title, place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (235, 235, 235), 1, cv2.LINE_AA
        )
    return np.vstack([head, *strips])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--truth", type=Path, default=HERE / "truth")
    parser.add_argument("--sheet", type=Path)
    options = parser.parse_args()
    rows = []
    frames = sorted(int(p.name.split(".")[1]) for p in options.truth.glob("reference.*.exr"))
    print("PSNR in dB, sRGB-encoded, where the true shadow falls:")
    for frame in frames:
        figures, pictures = compare(options.work, options.truth, frame)
        rows.append(pictures)
        print(f"  frame {frame}: " + ", ".join(f"{k} {v:.2f}" for k, v in figures.items()))
    if options.sheet:
        titles = ["source", "target", "no warp", "ours", "reference"]
        write_png(options.sheet, sheet(rows, titles))
        print(f"contact sheet: {options.sheet}")


if __name__ == "__main__":
    main()
