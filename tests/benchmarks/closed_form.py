"""PyMatting's closed-form matting and foreground estimation, for `speed` to compare with.

    python closed_form.py TAKE ALPHA NUMBER ...

The trimap is what lies within a few pixels of the edge of the given alpha.
"""

import sys

import cv2
import numpy as np
import OpenEXR
from pymatting import estimate_alpha_cf, estimate_foreground_ml


def pixels(folder: str, number: str, channel: str) -> np.ndarray:
    name = folder.rstrip("/").rpartition("/")[2]
    file = OpenEXR.File(f"{folder}/{name}.{number}.exr")
    return file.channels()[channel].pixels.astype(np.float64)


def main() -> None:
    take, mattes, *numbers = sys.argv[1:]
    for number in numbers:
        alpha = pixels(mattes, number, "Y")
        band = np.ones((5, 5), np.uint8)
        sure = cv2.erode((alpha >= 1).astype(np.uint8), band)
        maybe = cv2.dilate((alpha > 0).astype(np.uint8), band)
        trimap = np.where(sure > 0, 1.0, np.where(maybe > 0, 0.5, 0.0))
        image = np.clip(pixels(take, number, "RGB"), 0, 1)
        estimate_foreground_ml(image, estimate_alpha_cf(image, trimap))


if __name__ == "__main__":
    main()
