"""Pictures to judge a scan and a warp map by, on set and in reports."""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.bands import bands
from shadowtool.core.half_floats import rounded, to_float
from shadowtool.core.shadow_lines import ShadowLines
from shadowtool.core.transfer import encode_srgb
from shadowtool.core.warp_map import WarpMap, identity_map

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

_GREEN, _RED, _BLUE = (60, 230, 90), (255, 70, 50), (90, 150, 255)
# Sub-pixel drawing: OpenCV's fixed-point coordinates.
_SHIFT = 4


def display(image: NDArray[np.floating]) -> UInt8:
    """Linear light of any shape as sRGB-encoded code values; NaN is black."""
    codes = np.ascontiguousarray(rounded(image)).view(np.uint16)
    rows = codes.reshape(len(codes), -1)
    return np.asarray(cv2.LUT(rows, _codes_of_halfs()), np.uint8).reshape(image.shape)


@cache
def _codes_of_halfs() -> UInt8:
    """The code value of each half, by its bits."""
    halfs = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    linear = np.clip(np.nan_to_num(to_float(halfs)), 0, 1)
    return np.rint(encode_srgb(linear) * 255).astype(np.uint8)


def time_picture(
    image: UInt8,
    time: Float32,
    lines: ShadowLines,
    plane: NDArray[np.bool_] | None = None,
    every: int = 5,
) -> UInt8:
    """Shadow times as coloured bands over a frame, with fitted lines and the plane's outline.

    Args:
        image: (H, W, 3) from `display`.
        time: (H, W), NaN unknown.
        lines: fitted lines are drawn green, replaced ones red.
        plane: (H, W), outlined in blue.
        every: draw the line of every so many frames.

    Returns:
        (H, W, 3) uint8 RGB, sRGB-encoded.
    """
    canvas = image.copy()
    low, high = float(np.fmin.reduce(time, axis=None)), float(np.fmax.reduce(time, axis=None))
    if np.isfinite(low):
        for rows in bands(time.shape):
            known = np.isfinite(time[rows])
            clock = np.fmax(time[rows], np.float32(low))
            colours = _colours((clock - low) / max(high - low, 1e-6))
            # A saw-tooth every few frames makes isolines visible.
            clock /= every
            strength = (0.35 + 0.3 * (clock - np.floor(clock))) * known
            canvas[rows] = cv2.blendLinear(canvas[rows], colours, 1 - strength, strength)
        _write(canvas, f"frame {low:.0f} (blue) to {high:.0f} (red)")
    if plane is not None:
        outline, _ = cv2.findContours(
            plane.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(canvas, outline, -1, _BLUE, 1, cv2.LINE_AA)
    for index in range(0, len(lines), every):
        colour = _RED if lines.origin[index] == "interpolated" else _GREEN
        _draw_line(canvas, lines.normal[index], float(lines.offset[index]), colour)
    return canvas


def warp_picture(image: NDArray[np.floating], warp_map: WarpMap, step: int = 16) -> UInt8:
    """W as a warped grid over the target, beside the length of the parallax W[p] - p.

    The grid is that of the source plane, as the target's surfaces bend it. Pixels that W knows
    nothing of by measurement are darkened.

    Args:
        image: (H, W, 3) linear light, the target.
        step: distance of the grid's lines in the source, pixels.

    Returns:
        (H, 2W, 3) uint8 RGB, sRGB-encoded.
    """
    height, width = warp_map.error.shape
    canvas = display(image)
    measured = np.isfinite(warp_map.error)
    canvas[~measured] //= 2
    warp = np.nan_to_num(warp_map.warp, nan=-1e4)
    cell = np.floor(warp / step)
    edge = np.zeros((height, width), bool)
    for axis in (0, 1):
        changed = (np.diff(cell, axis=axis) != 0).any(axis=-1)
        edge[: changed.shape[0], : changed.shape[1]] |= changed
    canvas[edge & measured] = _GREEN
    displacement = np.linalg.norm(warp - identity_map(height, width), axis=-1)
    top = max(float(np.percentile(displacement[measured], 99)), 1.0) if measured.any() else 1.0
    parallax = _colours(displacement / top)
    parallax[~measured] //= 2
    _write(parallax, f"displacement 0 (blue) to {top:.0f} px (red); dark: filled in")
    return np.hstack([canvas, parallax])


def _write(canvas: UInt8, text: str) -> None:
    font, x, y = cv2.FONT_HERSHEY_SIMPLEX, 8, canvas.shape[0] - 10
    # A wider stroke would also set the letters further apart: the outline is the text, moved.
    for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(canvas, text, (x + dx, y + dy), font, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(canvas, text, (x, y), font, 0.4, (235, 235, 235), 1, cv2.LINE_AA)


def _colours(scaled: NDArray[np.floating]) -> UInt8:
    code = np.rint(np.clip(scaled, 0, 1) * 255).astype(np.uint8)
    mapped = cv2.applyColorMap(code, cv2.COLORMAP_TURBO)
    return np.asarray(cv2.cvtColor(mapped, cv2.COLOR_BGR2RGB), np.uint8)


def _draw_line(
    canvas: UInt8, normal: NDArray[np.float64], offset: float, colour: tuple[int, int, int]
) -> None:
    height, width = canvas.shape[:2]
    foot = -offset * normal
    along = np.array([-normal[1], normal[0]])
    middle = np.array([width / 2, height / 2])
    centre = foot + along * float(along @ (middle - foot))
    reach = along * float(np.hypot(width, height))
    if not np.isfinite(centre).all() or np.abs(centre).max() > 1e5:
        return
    ends = [tuple(int(v) for v in np.rint((centre + s * reach) * 2**_SHIFT)) for s in (-1, 1)]
    cv2.line(canvas, ends[0], ends[1], colour, 1, cv2.LINE_AA, _SHIFT)
