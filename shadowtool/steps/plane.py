"""The region of a plane in the picture, as a user marks it."""

import re
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.errors import OptionError
from shadowtool.io.files import is_file
from shadowtool.io.image import Header, read_image
from shadowtool.steps.footage import require_size

_POINT = re.compile(r"-?\d+(?:\.\d+)?,-?\d+(?:\.\d+)?")


class Plane(NamedTuple):
    """The reference plane region.

    Attributes:
        region: (H, W) bool, where it is.
        name: what a person would call it: the polygon, or the mask's file.
        mark: a fingerprint of it.
    """

    region: NDArray[np.bool_]
    name: str
    mark: str


def read_plane(plane: str, header: Header) -> Plane:
    """The reference plane region.

    Raises:
        InputError: no such mask, or of another size.
        OptionError: a polygon of fewer than three points, or outside the picture.
    """
    words = plane.split()
    if words and all(_POINT.fullmatch(word) for word in words):
        if len(words) < 3:
            raise OptionError(f"--plane {plane}: a polygon takes three points or more")
        points = np.array([[float(v) for v in word.split(",")] for word in words])
        region = np.zeros((header.height, header.width), np.uint8)
        corners = np.rint(np.clip(points, -1e6, 1e6)).astype(np.int32)
        cv2.fillPoly(region, [corners], 255)
        name = mark = " ".join(words)
    elif not words or (re.fullmatch(r"[-\d.,\s]+", plane) and not is_file(Path(plane))):
        raise OptionError(f"--plane {plane!r}: neither a mask image nor a polygon x,y x,y x,y ...")
    else:
        image = read_image(Path(plane))
        require_size(image.path, image.header, header, "the footage")
        region = (image.plane("A", "Y") > 0.5).astype(np.uint8)
        name, mark = image.path.name, image.fingerprint
    if not region.any():
        raise OptionError(f"--plane {plane}: no pixel of the picture lies inside")
    return Plane(region > 0, name, mark)
