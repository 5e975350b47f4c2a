"""A small analytic scene: L, S, β, W and every sweep are known in closed form.

A textured plane with a raised block on it. Whatever is cast on the plane at q is seen at every
pixel p with W[p] = q.
"""

from dataclasses import dataclass, field

import numpy as np

from shadowtool.core.warp_map import identity_map


def smoothstep(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)


@dataclass(frozen=True)
class Sweep:
    """A board's shadow that crosses the plane: normal angle, pixels a frame, width, softness."""

    angle: float
    speed: float = 3.3
    width: float = 14.0
    soft: float = 5.0
    turn: float = 0.0


@dataclass(frozen=True)
class Scene:
    height: int = 90
    width: int = 160
    seed: int = 1
    # The block: rows, columns, and how far W is from the identity on it.
    rows: tuple[int, int] = (30, 60)
    columns: tuple[int, int] = (60, 100)
    displacement: tuple[float, float] = (6.0, -9.0)
    lit: np.ndarray = field(init=False)
    shadow: np.ndarray = field(init=False)
    warp: np.ndarray = field(init=False)
    plane: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        coarse = rng.uniform(0.25, 0.8, (self.height // 6 + 1, self.width // 6 + 1, 3))
        albedo = np.kron(coarse, np.ones((6, 6, 1)))[: self.height, : self.width]
        albedo = albedo * rng.uniform(0.9, 1.1, albedo.shape)
        sky, key = np.array([0.10, 0.13, 0.20]), np.array([0.80, 0.74, 0.60])
        warp = identity_map(self.height, self.width)
        block = np.zeros((self.height, self.width), bool)
        block[slice(*self.rows), slice(*self.columns)] = True
        warp[block] += np.float32(self.displacement)
        object.__setattr__(self, "lit", (albedo * (sky + key)).astype(np.float32))
        object.__setattr__(self, "shadow", (albedo * sky).astype(np.float32))
        object.__setattr__(self, "warp", warp)
        object.__setattr__(self, "plane", ~block)

    def disk(self, x: float, y: float, radius: float = 12.0, soft: float = 3.0) -> np.ndarray:
        """β on the source plane of a round shadow, (H, W)."""
        position = identity_map(self.height, self.width)
        distance = np.hypot(position[..., 0] - x, position[..., 1] - y)
        return smoothstep((distance - radius) / soft + 0.5).astype(np.float32)

    def edge(self, sweep: Sweep, frame: float) -> tuple[np.ndarray, float]:
        """The leading edge of a sweep at a time: (normal, offset) with n·x + d = 0."""
        angle = sweep.angle + sweep.turn * frame
        normal = np.array([np.cos(angle), np.sin(angle)])
        middle = np.array([self.width / 2, self.height / 2])
        reach = (abs(normal) * middle).sum() + sweep.soft
        return normal, float(-normal @ middle + reach - sweep.speed * frame)

    def frames_of(self, sweep: Sweep) -> int:
        return int((self.width + self.height + 2 * sweep.width) / sweep.speed)

    def sweep_beta(self, sweep: Sweep, frame: float) -> np.ndarray:
        """β of the target in a frame of a sweep, (H, W)."""
        normal, offset = self.edge(sweep, frame)
        distance = self.warp @ normal + offset
        leading = smoothstep(distance / sweep.soft + 0.5)
        trailing = smoothstep(-(distance + sweep.width) / sweep.soft + 0.5)
        return np.maximum(leading, trailing).astype(np.float32)

    def image(self, beta: np.ndarray) -> np.ndarray:
        """The scene under β, (H, W, 3) float32."""
        return self.shadow + beta[..., None] * (self.lit - self.shadow)

    def noisy(self, image: np.ndarray, seed: int, sigma: float = 0.003) -> np.ndarray:
        """With camera-like noise: ``sigma`` at mid grey."""
        rng = np.random.default_rng(seed)
        spread = sigma * np.sqrt(np.maximum(image, 0.01) / 0.18)
        return (image + rng.normal(size=image.shape) * spread).astype(np.float32)


def waves(x: float, y: float) -> np.ndarray:
    """A texture, (240, 320), moved by any part of a pixel."""
    rng = np.random.default_rng(4)
    rows, columns = np.mgrid[:240, :320]
    total = np.zeros((240, 320))
    for _ in range(40):
        a, b, phase = rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), rng.uniform(0, 7)
        total += np.sin(a * (columns - x) + b * (rows - y) + phase)
    return 0.5 * np.exp(0.05 * total)
