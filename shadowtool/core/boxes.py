"""Parts of a picture by their rows and columns."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray


class Box(NamedTuple):
    """What a picture is indexed by; none of the bounds is left open."""

    rows: slice
    columns: slice


def around(mask: NDArray[np.bool_], margin: int) -> Box | None:
    """The least box that holds all of a mask, (H, W), and a margin of so many pixels as far as the
    picture goes; None if the mask is empty."""
    if not mask.size:
        return None
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(mask).view(np.uint8))
    if not width:
        return None
    rows = slice(max(top - margin, 0), min(top + height + margin, mask.shape[0]))
    return Box(rows, slice(max(left - margin, 0), min(left + width + margin, mask.shape[1])))
