"""Figures whose alpha is known in closed form, before shadowed and textured ground, with noise."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shadowtool.core.backdrop import Backdrop
from shadowtool.core.noise import NoiseModel
from tests.scene import Scene

SCENE = Scene(100, 160, rows=(0, 0), columns=(0, 0))
# That of `Scene.noisy`.
NOISE = NoiseModel(np.full(3, 5e-5), np.full(3, 5e-7))
KNOWN = np.zeros(SCENE.lit.shape[:2], bool)
BACKDROP = Backdrop(SCENE.lit, SCENE.shadow, NOISE, KNOWN.astype(np.float32))
ROWS, COLUMNS = np.mgrid[: SCENE.height, : SCENE.width].astype(float)
BLUE, DARK = np.float32([0.05, 0.1, 0.6]), np.float32([0.02, 0.02, 0.03])
# Exposures of a moving figure that make up its blur.
_EXPOSURES = 16


@dataclass(frozen=True)
class Shot:
    """A frame (H, W, 3) and what it was made of."""

    image: np.ndarray
    alpha: np.ndarray
    foreground: np.ndarray
    beta: np.ndarray

    @property
    def background(self) -> np.ndarray:
        return SCENE.image(self.beta)


def disk(x: float, y: float, radius: float) -> np.ndarray:
    """Alpha of a disk, sharp but for what a pixel's area mixes."""
    return np.clip(radius + 0.5 - np.hypot(COLUMNS - x, ROWS - y), 0, 1)


def strand(start: tuple[float, float], end: tuple[float, float], width: float) -> np.ndarray:
    """Alpha of a straight hair from one (x, y) to another."""
    along = np.subtract(end, start)
    length = float(np.hypot(*along))
    x, y = COLUMNS - start[0], ROWS - start[1]
    place = np.clip((x * along[0] + y * along[1]) / length, 0, length)
    distance = np.hypot(x - place * along[0] / length, y - place * along[1] / length)
    return np.clip((width + 1) / 2 - distance, 0, min(width, 1))


def in_motion(alpha: Callable[[float], np.ndarray]) -> np.ndarray:
    """Alpha over an exposure: the mean over times from 0 to 1."""
    times = (np.arange(_EXPOSURES) + 0.5) / _EXPOSURES
    return np.mean([alpha(time) for time in times], axis=0)


def shot(
    alpha: np.ndarray,
    beta: np.ndarray | None = None,
    colour: np.ndarray = BLUE,
    seed: int = 1,
    noise: float = 0.003,
) -> Shot:
    """A figure of one colour, shaded from left to right, before ground under β (lit by default)."""
    alpha = alpha.astype(np.float32)
    beta = np.ones_like(alpha) if beta is None else beta.astype(np.float32)
    shading = (0.8 + 0.4 * COLUMNS / SCENE.width).astype(np.float32)
    foreground = shading[..., None] * colour
    cover = alpha[..., None]
    image = cover * foreground + (1 - cover) * SCENE.image(beta)
    return Shot(SCENE.noisy(image, seed, noise), alpha, foreground, beta)
