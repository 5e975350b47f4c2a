"""How far the camera moved between two frames of a take that should be locked off."""

import cv2
import numpy as np
from numpy.typing import NDArray

# Larger frames are measured at this width; the result is in pixels of the full frame.
_WIDTH = 640


def prepare(gray: NDArray[np.float32]) -> NDArray[np.float32]:
    """Make (H, W) linear luminance ready for `shift`: small, and blind to slow shading.

    The logarithm's local contrast looks the same in light and in shadow.
    """
    height, width = gray.shape
    if width > _WIDTH:
        size = (_WIDTH, max(1, round(height * _WIDTH / width)))
        gray = np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA))
    level = np.log(np.maximum(np.nan_to_num(gray, nan=0.0, posinf=1e4, neginf=0.0), 1e-3))
    smooth = cv2.GaussianBlur(level.astype(np.float32), (0, 0), 1.0)
    detail = smooth - cv2.GaussianBlur(smooth, (0, 0), 6.0)
    # A shadow's edge stands out of the texture; bounding it keeps it from pulling the fit.
    spread = float(np.median(np.abs(detail))) * 4 + 1e-6
    return np.asarray(np.clip(detail, -spread, spread), np.float32)


def shift(reference: NDArray[np.float32], other: NDArray[np.float32], width: int) -> float | None:
    """Length of the translation from one prepared frame to another.

    Enhanced correlation coefficient maximisation (Evangelidis and Psarakis 2008).

    Args:
        reference, other: from `prepare`, of one size.
        width: that of the full frame, pixels.

    Returns:
        Pixels of the full frame; None where the picture has too little texture to tell.
    """
    matrix = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-4)
    try:
        cv2.findTransformECC(reference, other, matrix, cv2.MOTION_TRANSLATION, criteria)
    except cv2.error:
        return None
    scale = width / reference.shape[1]
    return float(np.hypot(matrix[0, 2], matrix[1, 2]) * scale)
