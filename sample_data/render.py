"""Render the sample footage: a walking figure, a scene to put it in, and the scans of that scene.

    python render.py [-o DIR] [--take NAME ...] [--spp N]

Two scenes share one locked-off camera, one low sun and one flat ground (z = 0, metres, z up). In
the *source* scene a figure walks over bare brick paving. The *target* scene has other paving and
things standing on it; there a card is waved through the sunlight (``photometric``) and a long board
is swept through it three times (``sweep1`` to ``sweep3``). Each of them becomes a 10 bit movie in
``footage/``, with the noise of a camera and the BT.709 curve.

What a shoot cannot deliver is written to ``truth/``: the figure rendered in the target scene
(``reference``), its coverage (``alpha``), the sun's visibility on the source ground (``beta``), the
target with the sun and without it (``lit``, ``shadow``) and where every shadow comes from
(``warp``, an ST map). ``plane.png`` and ``trimaps/`` stand for what an artist draws by hand.

The parts (camera, key light, figure, hand-held board) do not know each other: a lamp instead of the
sun is another `KeyLight`, a second board another `Sweep`.

Needs mitsuba, numpy, opencv, OpenEXR and av, and libLLVM for mitsuba's ``llvm`` variants. The whole
set takes about 15 minutes on two cores at the default of 64 samples per pixel.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import mitsuba as mi
import numpy as np
import OpenEXR
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

mi.set_variant("llvm_ad_rgb")

Array = np.ndarray
Vector = tuple[float, float, float]

FIRST_FRAME = 1001
FPS = 24
SAMPLES = 64
# The stills of truth/ are to be free of noise, and are few: they can afford to be rendered often.
TRUTH_PASSES = 8
SEED = 2003
# Colours below are as bright as the exposure makes them look. The surfaces themselves reflect half
# of that, as paving and cloth do: brighter ones would throw too much light into the shadows.
ALBEDO = 0.5


# Geometry in numpy


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with its material; without normals it is shaded flat."""

    vertices: Array
    faces: Array
    material: str
    normals: Array | None = None
    uv: Array | None = None

    def placed(self, position: Vector, yaw: float = 0.0) -> Mesh:
        """Turn by ``yaw`` degrees about the vertical through the origin, then move."""
        c, s = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        normals = None if self.normals is None else self.normals @ turn
        return Mesh(
            self.vertices @ turn + np.asarray(position), self.faces, self.material, normals, self.uv
        )


def unit(v: Array) -> Array:
    """The vector(s) scaled to length 1 along the last axis."""
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def grid_faces(rows: int, columns: int) -> Array:
    """Triangles of a (rows, columns) lattice of vertices, whose columns do not wrap."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    quads = np.stack([a, d, c, a, c, b], axis=-1)
    return quads.reshape(-1, 3)


def frame_along(axis: Array) -> tuple[Array, Array]:
    """Two unit vectors that make a right-handed frame with the unit vector ``axis``."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    u = unit(np.cross(axis, helper))
    return u, np.cross(axis, u)


def turned(profile: Array, start: Array, axis: Array, material: str, sides: int = 32) -> Mesh:
    """Turn a profile of (radius, height, normal radius, normal height) rows about an axis."""
    u, v = frame_along(axis)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    around = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    radius, height, normal_r, normal_h = (column[:, None, None] for column in profile.T)
    vertices = start + radius * around + height * axis
    normals = normal_r * around + normal_h * axis
    uv = np.stack(np.meshgrid(angle / (2.0 * np.pi), profile[:, 1]), axis=-1)
    faces = grid_faces(len(profile), sides + 1)[:, ::-1]
    return Mesh(vertices.reshape(-1, 3), faces, material, normals.reshape(-1, 3), uv.reshape(-1, 2))


def capsule(
    start: Array, end: Array, radius: float, material: str, end_radius: float | None = None
) -> Mesh:
    """A rounded limb from ``start`` to ``end``, tapered if ``end_radius`` is given."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    other = radius if end_radius is None else end_radius
    length = float(np.linalg.norm(end - start))
    # The sides of a tapered capsule touch its two spheres at this angle off the equator.
    tilt = math.asin(np.clip((radius - other) / length, -0.9, 0.9))
    low = np.linspace(-np.pi / 2, tilt, 9)
    high = np.linspace(tilt, np.pi / 2, 9)
    profile = np.concatenate(
        [
            np.stack([radius * np.cos(low), radius * np.sin(low), np.cos(low), np.sin(low)], 1),
            np.stack(
                [other * np.cos(high), length + other * np.sin(high), np.cos(high), np.sin(high)], 1
            ),
        ]
    )
    return turned(profile, start, (end - start) / length, material, sides=24)


def drum(start: Array, end: Array, radius: float, material: str, bevel: float = 0.0) -> Mesh:
    """A closed cylinder with flat ends and bevelled rims."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    inner = radius - bevel
    profile = np.array(
        [
            [0.0, 0.0, 0.0, -1.0],
            [inner, 0.0, 0.0, -1.0],
            [radius, bevel, 1.0, 0.0],
            [radius, length - bevel, 1.0, 0.0],
            [inner, length, 0.0, 1.0],
            [0.0, length, 0.0, 1.0],
        ]
    )
    return turned(profile, start, (end - start) / length, material, sides=96)


def ellipsoid(centre: Array, radii: Vector, material: str, rows: int = 24) -> Mesh:
    """An ellipsoid with its axes along x, y and z."""
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    c, s = np.cos(latitude), np.sin(latitude)
    ball = turned(
        np.stack([c, s, c, s], 1), np.zeros(3), np.array([0.0, 0.0, 1.0]), material, 2 * rows
    )
    scale = np.asarray(radii)
    return Mesh(
        ball.vertices * scale + np.asarray(centre),
        ball.faces,
        material,
        unit(ball.vertices / scale),
        ball.uv,
    )


def slab(centre: Array, axes: Array, size: Vector, material: str) -> Mesh:
    """A box of full ``size`` along three orthonormal ``axes`` (rows), shaded flat."""
    corners, faces, uv = [], [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            base = len(corners)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                local = np.zeros(3)
                local[axis], local[i], local[j] = side, a, b
                local = local * np.asarray(size) / 2.0
                corners.append(np.asarray(centre) + local @ np.asarray(axes))
                uv.append((local[i], local[j]))
            ring = [(0, 1, 2), (0, 2, 3)] if side > 0 else [(0, 2, 1), (0, 3, 2)]
            faces += [[base + k for k in triangle] for triangle in ring]
    return Mesh(np.array(corners), np.array(faces), material, None, np.array(uv))


def box(centre: Vector, size: Vector, material: str, yaw: float = 0.0) -> Mesh:
    """A box that stands upright."""
    return slab(np.zeros(3), np.eye(3), size, material).placed(centre, yaw)


def rock(centre: Vector, radius: float, material: str, rng: np.random.Generator) -> Mesh:
    """A boulder: a sphere displaced by a few smooth waves of falling size."""
    ball = ellipsoid(np.zeros(3), (1.0, 1.0, 1.0), material, rows=96)
    p = ball.vertices
    height = np.zeros(len(p))
    for octave in range(5):
        for _ in range(6):
            wave = unit(rng.normal(size=3)) * 1.9 * 1.75**octave
            height += 0.62**octave * np.sin(p @ wave + rng.uniform(0, 2 * np.pi))
    p = p * (1.0 + 0.062 * height[:, None]) * radius * np.array([1.15, 0.95, 0.85])
    normals = np.zeros_like(p)
    a, b, c = (p[ball.faces[:, k]] for k in range(3))
    for k in range(3):
        np.add.at(normals, ball.faces[:, k], np.cross(b - a, c - a))
    # The seam and the poles of the lattice hold several vertices at one place: share their normals.
    _, same = np.unique(np.round(ball.vertices, 6), axis=0, return_inverse=True)
    shared = np.zeros((same.max() + 1, 3))
    np.add.at(shared, same.ravel(), normals)
    normals = unit(shared[same.ravel()])
    return Mesh(p + np.asarray(centre), ball.faces, material, normals, ball.uv)


# Camera and light


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; pixel centres lie at whole numbers, y points down."""

    position: Vector
    target: Vector
    width: int = 640
    height: int = 360
    fov: float = 32.0

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return self.width / 2.0 / math.tan(math.radians(self.fov) / 2.0)

    @property
    def axes(self) -> Array:
        """Rows: right, down and forward in the world."""
        forward = unit(np.subtract(self.target, self.position))
        right = unit(np.cross(forward, (0.0, 0.0, 1.0)))
        return np.stack([right, np.cross(forward, right), forward])

    def directions(self, x: Array, y: Array) -> Array:
        """Unit directions of the rays through image points."""
        local = np.stack(
            [
                (x + 0.5 - self.width / 2.0) / self.focal,
                (y + 0.5 - self.height / 2.0) / self.focal,
                np.ones(np.broadcast(x, y).shape),
            ],
            axis=-1,
        )
        return unit(local @ self.axes)

    def on_ground(self, x: Array, y: Array) -> Array:
        """Where the rays through image points meet z = 0."""
        d = self.directions(np.asarray(x, float), np.asarray(y, float))
        return np.asarray(self.position) - d * (self.position[2] / d[..., 2:])

    def project(self, points: Array) -> Array:
        """Image points (..., 2) of world points."""
        local = (points - np.asarray(self.position)) @ self.axes.T
        centre = np.array([self.width / 2.0 - 0.5, self.height / 2.0 - 0.5])
        return local[..., :2] / local[..., 2:] * self.focal + centre

    def pixels(self, dx: float = 0.0, dy: float = 0.0) -> tuple[Array, Array]:
        """Coordinates x, y of all pixels, moved by a part of a pixel."""
        x, y = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return x + dx, y + dy

    def sensor(self, spp: int) -> dict:
        """The same camera for the renderer, with the box filter: a pixel is the mean of its area,
        and the noise of one pixel is no neighbour's."""
        look = mi.ScalarTransform4f().look_at(
            list(self.position), list(self.target), [0.0, 0.0, 1.0]
        )
        return {
            "type": "perspective",
            "fov": self.fov,
            "fov_axis": "x",
            "to_world": look,
            "near_clip": 0.1,
            "far_clip": 1000.0,
            "film": {
                "type": "hdrfilm",
                "width": self.width,
                "height": self.height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "multijitter", "sample_count": spp},
        }


@dataclass(frozen=True)
class KeyLight:
    """A round, flat light that faces ``target``: far away and small it is the sun, near a lamp."""

    centre: Vector
    target: Vector
    radius: float
    radiance: Vector

    def towards(self, points: Array, fraction: float) -> Array:
        """The points moved by a fraction of their way to the light's centre."""
        return points + (np.asarray(self.centre) - points) * fraction

    def emitter(self) -> dict:
        """The light for the renderer."""
        look = mi.ScalarTransform4f().look_at(list(self.centre), list(self.target), [0.0, 0.0, 1.0])
        return {
            "type": "disk",
            "to_world": look @ mi.ScalarTransform4f().scale([self.radius, self.radius, 1.0]),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(self.radiance)}},
        }

    def points(self, count: int) -> Array:
        """Points spread evenly over the disk (a sunflower's spiral)."""
        u, v = frame_along(unit(np.subtract(self.target, self.centre)))
        k = np.arange(count)
        r = self.radius * np.sqrt((k + 0.5) / count)
        angle = k * np.pi * (3.0 - math.sqrt(5.0))
        offsets = (r * np.cos(angle))[:, None] * u + (r * np.sin(angle))[:, None] * v
        return np.asarray(self.centre) + offsets


def sun(azimuth: float, elevation: float, irradiance: Vector, distance: float = 200.0) -> KeyLight:
    """The sun; ``azimuth`` is where its shadows point, in degrees from x to y."""
    a, e = math.radians(azimuth), math.radians(elevation)
    direction = np.array([-math.cos(a) * math.cos(e), -math.sin(a) * math.cos(e), math.sin(e)])
    radius = distance * math.tan(math.radians(0.53 / 2.0))
    radiance = np.asarray(irradiance) * distance**2 / (math.pi * radius**2)
    return KeyLight(tuple(direction * distance), (0.0, 0.0, 0.0), radius, tuple(radiance))


def sky(zenith: Vector, horizon: Vector) -> dict:
    """A sky that grows paler towards the horizon; the camera never sees it, glossy things do."""
    elevation = np.linspace(np.pi / 2, -np.pi / 2, 32)[:, None, None]
    mix = np.clip(np.sin(elevation), 0.0, 1.0) ** 0.5
    rows = np.asarray(horizon) * (1.0 - mix) + np.asarray(zenith) * mix
    image = np.ascontiguousarray(np.broadcast_to(rows, (32, 64, 3)), dtype=np.float32)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(image),
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
    }


# Textures and materials


def noise(rng: np.random.Generator, size: int, cell: float, octaves: int) -> Array:
    """Smooth noise of several octaves about 0, within about +-1; ``cell`` is in texels."""
    total = np.zeros((size, size), np.float32)
    for octave in range(octaves):
        count = max(2, int(size / cell * 2**octave))
        if count > size:
            break
        lattice = rng.uniform(-1.0, 1.0, (count, count)).astype(np.float32)
        total += 0.6**octave * cv2.resize(lattice, (size, size), interpolation=cv2.INTER_CUBIC)
    return total / 1.6


def paving(
    rng: np.random.Generator,
    stone: tuple[float, float],
    palette: Sequence[Vector],
    joint: Vector,
    turn: float,
    extent: float = 20.0,
    size: int = 2560,
) -> Array:
    """Paving in running bond: every stone has its own colour, the surface is weathered.

    ``stone`` is the size of a stone and ``extent`` the side of the texture in metres. It is worked
    out at twice the resolution and averaged down, so that joints do not alias.
    """
    fine = 2 * size
    metres = (np.arange(fine, dtype=np.float32) + 0.5) / fine * extent - extent / 2
    x, y = np.meshgrid(metres, metres)
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    sway = 0.012 * cv2.resize(noise(rng, size, 90, 3), (fine, fine))
    u, v = (c * x + s * y + sway) / stone[0], (c * y - s * x + sway) / stone[1]
    row = np.floor(v).astype(np.int64)
    u = u + 0.5 * (row % 2)
    column = np.floor(u).astype(np.int64)
    key = (column * 73856093 ^ row * 19349663) % 4096
    colours = np.asarray(palette, np.float32)[rng.integers(len(palette), size=4096)]
    colours = colours * rng.uniform(0.8, 1.15, (4096, 1)).astype(np.float32)
    to_edge = np.minimum(
        np.minimum(u - column, 1 - (u - column)) * stone[0],
        np.minimum(v - row, 1 - (v - row)) * stone[1],
    )
    inside = np.clip((to_edge - 0.006) / 0.008, 0.0, 1.0)[..., None].astype(np.float32)
    image = inside * colours[key] + (1.0 - inside) * np.asarray(joint, np.float32)
    image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
    worn = 1.0 + 0.16 * noise(rng, size, 300, 4) + 0.26 * noise(rng, size, 14, 3)
    tint = 1.0 + 0.08 * np.stack([noise(rng, size, 60, 3) for _ in range(3)], -1)
    return np.clip(image * worn[..., None] * tint, 0.03, 0.85).astype(np.float32)


def mottled(
    rng: np.random.Generator, colour: Vector, depth: float, stretch: int = 1, size: int = 512
) -> Array:
    """One colour with noise, drawn out along u if ``stretch`` > 1 (grain of wood)."""
    grain = noise(rng, size, 60, 5)
    if stretch > 1:
        grain = cv2.resize(grain[:, : size // stretch], (size, size))
    return np.clip(np.asarray(colour) * (1.0 + depth * grain[..., None]), 0.02, 0.9)


def diffuse(colour: Vector) -> dict:
    """A matt colour, seen from both sides."""
    value = [ALBEDO * c for c in colour]
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}
    return {"type": "twosided", "bsdf": bsdf}


def painted(image: Array, scale: float = 1.0) -> dict:
    """A matt texture; ``scale`` repeats it per unit of uv."""
    texture = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(ALBEDO * image, dtype=np.float32)),
        "raw": True,
        "to_uv": mi.ScalarTransform4f().scale([scale, scale, 1.0]),
    }
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture}}


def glazed(colour: Vector, roughness: float) -> dict:
    """A coloured ground under a clear glaze: it has highlights, which a shadow must dim."""
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "alpha": roughness,
        "diffuse_reflectance": {"type": "rgb", "value": [ALBEDO * c for c in colour]},
    }


BRICKS = (
    (0.60, 0.27, 0.17),
    (0.66, 0.45, 0.20),
    (0.62, 0.37, 0.31),
    (0.31, 0.38, 0.47),
    (0.70, 0.61, 0.46),
    (0.55, 0.31, 0.20),
)
SLABS = (
    (0.40, 0.49, 0.37),
    (0.62, 0.57, 0.45),
    (0.42, 0.46, 0.53),
    (0.55, 0.48, 0.36),
    (0.50, 0.52, 0.50),
)


@cache
def material(name: str) -> mi.BSDF:
    """The material of this name, made once."""
    rng = np.random.default_rng([SEED, *name.encode()])
    table: dict[str, Callable[[], dict]] = {
        "brick paving": lambda: painted(
            paving(
                rng,
                (0.42, 0.21),
                BRICKS,
                (0.50, 0.47, 0.43),
                turn=24.0,
            )
        ),
        "slab paving": lambda: painted(
            paving(
                rng,
                (0.78, 0.52),
                SLABS,
                (0.27, 0.26, 0.24),
                turn=-17.0,
            )
        ),
        "wood": lambda: painted(mottled(rng, (0.66, 0.44, 0.20), 0.45, stretch=8), 1.3),
        "stone": lambda: painted(mottled(rng, (0.52, 0.47, 0.43), 0.35), 3.0),
        "teal glaze": lambda: glazed((0.05, 0.36, 0.40), 0.2),
        "red glaze": lambda: glazed((0.55, 0.06, 0.05), 0.18),
        "white paint": lambda: diffuse((0.72, 0.71, 0.68)),
        "sign paint": lambda: diffuse((0.14, 0.26, 0.55)),
        "card": lambda: diffuse((0.10, 0.10, 0.10)),
        "skin": lambda: diffuse((0.62, 0.38, 0.27)),
        "hair": lambda: diffuse((0.13, 0.07, 0.04)),
        "jacket": lambda: diffuse((0.70, 0.16, 0.10)),
        "shirt": lambda: diffuse((0.75, 0.70, 0.58)),
        "trousers": lambda: diffuse((0.16, 0.25, 0.48)),
        "shoes": lambda: diffuse((0.30, 0.17, 0.09)),
    }
    return mi.load_dict(table[name]())


# The figure


def knee(hip: Array, ankle: Array, upper: float, lower: float, bend: Array) -> Array:
    """The joint between two bones of given lengths that bends towards ``bend``."""
    reach = ankle - hip
    distance = min(float(np.linalg.norm(reach)), 0.999 * (upper + lower))
    axis = unit(reach)
    along = (upper**2 - lower**2 + distance**2) / (2.0 * distance)
    side = unit(bend - axis * (bend @ axis))
    return hip + axis * along + side * math.sqrt(max(upper**2 - along**2, 0.0))


@dataclass(frozen=True)
class Walk:
    """A straight walk on the ground from ``start`` to ``end`` in ``frames`` frames."""

    start: tuple[float, float]
    end: tuple[float, float]
    frames: int
    # A stride is two steps; for this share of it a foot rests on the ground.
    stride: float = 1.34
    stance: float = 0.58

    def figure(self, frame: int) -> list[Mesh]:
        """The figure at a frame counted from 0, 1.8 m tall, its feet on z = 0."""
        path = np.subtract(self.end, self.start)
        done = frame / (self.frames - 1)
        place = np.asarray(self.start) + path * done
        travelled = float(np.linalg.norm(path)) * done
        yaw = math.degrees(math.atan2(path[1], path[0]))
        position = (float(place[0]), float(place[1]), 0.0)
        return [part.placed(position, yaw) for part in self.parts(travelled / self.stride + 0.15)]

    def ankle(self, phase: float) -> tuple[Array, float]:
        """The ankle (x forward, z up, from the point under the hip) and the foot's pitch."""
        phase %= 1.0
        half = self.stance * self.stride / 2.0
        if phase < self.stance:
            share = phase / self.stance
            roll = max(0.0, share - 0.65) / 0.35
            return np.array([half * (1 - 2 * share) + 0.05 * roll, 0.085 + 0.09 * roll**2]), (
                38.0 * roll**1.5 - 14.0 * max(0.0, 1 - share / 0.12)
            )
        share = (phase - self.stance) / (1.0 - self.stance)
        ease = share * share * (3 - 2 * share)
        lift = 0.085 + 0.09 * (1 - share) ** 2 + 0.07 * math.sin(math.pi * share)
        return np.array([-half + 0.05 + (2 * half - 0.05) * ease, lift]), (
            38.0 * (1 - share) ** 1.2 - 14.0 * share**3
        )

    def parts(self, phase: float) -> Iterator[Mesh]:
        """The parts of the body at a phase of the stride, walking along +x from the origin."""
        step = math.sin(2.0 * np.pi * phase)
        # The body is highest while one leg passes under it.
        bob = 0.04 * math.cos(4.0 * np.pi * (phase - 0.04))
        forward = np.array([1.0, 0.0, 0.0])
        hips = np.array([0.0, 0.0, 0.927 + bob])
        chest = hips + np.array([0.05, 0.0, 0.44])
        head = chest + np.array([0.045, 0.0, 0.285])
        for side in (-1.0, 1.0):
            ankle, pitch = self.ankle(phase + (0.25 if side < 0 else 0.75))
            hip = hips + np.array([0.0, 0.095 * side, -0.01])
            foot = np.array([ankle[0], 0.085 * side, ankle[1]])
            bend = knee(hip, foot, 0.45, 0.44, forward)
            yield capsule(hip, bend, 0.092, "trousers", 0.066)
            yield capsule(bend, foot, 0.066, "trousers", 0.05)
            tilt = math.radians(pitch)
            toe = np.array([math.cos(tilt), 0.0, -math.sin(tilt)])
            down = np.array([-math.sin(tilt), 0.0, -math.cos(tilt)])
            heel = foot + 0.035 * down - 0.03 * toe
            yield capsule(heel, heel + 0.19 * toe + 0.008 * down, 0.05, "shoes", 0.042)
            # Arms swing against the legs.
            swing = math.radians(30.0 * -side * step + 4.0)
            fold = math.radians(22.0 + 14.0 * -side * step)
            shoulder = chest + np.array([0.0, 0.205 * side, 0.03])
            away = np.array([0.0, 0.10 * side, 0.0])
            elbow = shoulder + 0.29 * unit(
                np.array([math.sin(swing), 0.0, -math.cos(swing)]) + away
            )
            low = swing + fold
            wrist = elbow + 0.25 * unit(np.array([math.sin(low), 0.0, -math.cos(low)]) + 0.3 * away)
            yield capsule(shoulder, elbow, 0.062, "jacket", 0.05)
            yield capsule(elbow, wrist, 0.05, "jacket", 0.042)
            hand = wrist + 0.07 * unit(wrist - elbow)
            yield capsule(wrist, hand, 0.04, "skin", 0.036)
        yield ellipsoid(hips + np.array([0.0, 0.0, 0.03]), (0.13, 0.17, 0.14), "trousers")
        yield ellipsoid(hips + np.array([0.025, 0.0, 0.27]), (0.135, 0.185, 0.27), "jacket")
        yield ellipsoid(chest + np.array([0.0, 0.0, -0.03]), (0.125, 0.225, 0.15), "jacket")
        yield capsule(chest + np.array([0.01, 0, 0.09]), head, 0.058, "shirt", 0.05)
        yield ellipsoid(head + np.array([0.012, 0.0, 0.0]), (0.098, 0.08, 0.125), "skin")
        yield ellipsoid(head + np.array([-0.018, 0.0, 0.03]), (0.10, 0.092, 0.115), "hair")


# The hand-held board and card


def unsteady(count: int, seed: int) -> Array:
    """A smooth curve within +-1, as a hand wavers: a few slow waves of random phase."""
    rng = np.random.default_rng([SEED, seed])
    t = np.linspace(0.0, 1.0, count)
    waves = (1.3, 2.2, 3.4)
    curve = sum(
        rng.uniform(0.5, 1.0) / k**0.5 * np.sin(2 * np.pi * (k * t + rng.uniform())) for k in waves
    )
    return curve / np.abs(curve).max()


@dataclass(frozen=True)
class Sweep:
    """A board moved through the light so that its shadow crosses the picture.

    The path is planned where it matters, in the picture: a straight line at ``angle`` (degrees,
    counter-clockwise as seen) that travels to its right if ``angle`` is below 180. The board is
    then held up ``height`` metres above that line's place on the ground, towards the light.
    """

    angle: float
    frames: int
    seed: int
    width: float
    # Above the camera, which looks down, the board is never in the picture.
    height: float = 7.3
    length: float = 21.0
    margin: float = 34.0
    waver: float = 4.0
    uneven: float = 0.3
    body: bool = False

    @property
    def travel(self) -> Array:
        """The direction in the picture in which the shadow goes."""
        theta = math.radians(self.angle)
        return np.array([math.sin(theta), math.cos(theta)])

    def line(self, camera: Camera, frame: int) -> tuple[Array, Array]:
        """A point in the picture and the direction of the shadow's middle line."""
        theta, travel = math.radians(self.angle), self.travel
        half = (abs(travel[0]) * camera.width + abs(travel[1]) * camera.height) / 2.0 + self.margin
        speed = 1.0 + self.uneven * unsteady(self.frames - 1, self.seed)
        path = np.concatenate([[0.0], np.cumsum(speed)]) / speed.sum()
        centre = np.array([camera.width / 2.0 - 0.5, camera.height / 2.0 - 0.5])
        now = theta + math.radians(self.waver) * unsteady(self.frames, self.seed + 1)[frame]
        return (
            centre + travel * half * (2.0 * path[frame] - 1.0),
            np.array([math.cos(now), -math.sin(now)]),
        )

    def shapes(self, camera: Camera, light: KeyLight, frame: int) -> list[Mesh]:
        """The board at a frame counted from 0, and the one who holds it."""
        point, direction = self.line(camera, frame)
        a, b = camera.on_ground(*np.stack([point - 50 * direction, point + 50 * direction]).T)
        along = unit(b - a)
        # Hold the board opposite the middle of the scene, not of the part of the line in view.
        middle = a + along * ((np.array([0.0, 0.5, 0.0]) - a) @ along)
        centre = light.towards(middle, self.height / light.centre[2])
        to_light = unit(np.asarray(light.centre) - centre)
        across = unit(np.cross(along, to_light))
        axes = np.stack([along, across, np.cross(along, across)])
        shapes = [slab(centre, axes, (self.length, self.width, 0.025), "card")]
        if self.body:
            # Whoever holds the board follows it: nothing may go before the board's edge.
            ahead = np.cross((0.0, 0.0, 1.0), along)
            ahead = ahead * np.sign(ahead @ (camera.on_ground(*(point + 50 * self.travel)) - a))
            at = centre - 0.6 * along
            shapes += [
                capsule(at - 1.85 * ahead, at - 0.85 * ahead, 0.27, "card", 0.22),
                capsule(at - 0.6 * ahead, at - 0.55 * ahead, 0.12, "card"),
                capsule(at - 0.9 * ahead + 0.2 * along, at + 0.45 * along, 0.05, "card"),
                capsule(at - 0.9 * ahead - 0.2 * along, at - 0.45 * along, 0.05, "card"),
            ]
        return shapes


@dataclass(frozen=True)
class Card:
    """A large card carried once through the light, high above the camera.

    It is farther off than the board, so that it hides hardly any of the sky.
    """

    frames: int
    seed: int
    size: tuple[float, float] = (3.0, 15.0)
    height: float = 14.0

    def shapes(self, camera: Camera, light: KeyLight, frame: int) -> list[Mesh]:
        """The card at a frame counted from 0."""
        corners = camera.on_ground(
            np.array([0.0, 1.0, 0.0, 1.0]) * (camera.width - 1),
            np.array([0.0, 0.0, 1.0, 1.0]) * (camera.height - 1),
        )
        fraction = self.height / light.centre[2]
        to_light = unit(np.asarray(light.centre))
        across = unit(np.cross((0.0, 0.0, 1.0), to_light))
        held = light.towards(corners, fraction)
        reach = held @ across
        clear = self.size[0] / 2.0 + 0.7
        speed = 1.0 + 0.25 * unsteady(self.frames - 1, self.seed)
        path = np.concatenate([[0.0], np.cumsum(speed)])[frame] / speed.sum()
        centre = held.mean(axis=0)
        at = reach.min() - clear + (np.ptp(reach) + 2 * clear) * path
        centre = centre + across * (at - centre @ across)
        turn = math.radians(3.0) * unsteady(self.frames, self.seed + 1)[frame]
        up = np.cross(to_light, across)
        axes = np.stack(
            [
                math.cos(turn) * across + math.sin(turn) * up,
                math.cos(turn) * up - math.sin(turn) * across,
                to_light,
            ]
        )
        return [slab(centre, axes, (*self.size, 0.01), "card")]


# The two scenes

CAMERA = Camera(position=(0.0, -13.2, 6.9), target=(0.0, -0.35, 0.2), fov=32.0)
# Lit paving comes out near 0.4 and about five times as bright as shaded paving.
SUN = sun(azimuth=35.0, elevation=30.0, irradiance=(9.8, 8.7, 7.0))
SKY = {"zenith": (0.26, 0.335, 0.47), "horizon": (0.355, 0.395, 0.44)}
WALK = Walk(start=(-3.0, -1.75), end=(0.75, -1.75), frames=60)


def target_objects() -> list[Mesh]:
    """What stands on the target's ground, all of it behind the line of the walk."""
    rng = np.random.default_rng([SEED, 1])
    upright = np.array([0.0, 0.0, 1.0])
    post = np.array([-0.62, -1.0, 0.0])
    return [
        box((-1.55, -0.62, 0.19), (1.15, 0.75, 0.38), "wood", yaw=14.0),
        box((-1.72, -0.42, 0.48), (0.5, 0.3, 0.2), "white paint", yaw=30.0),
        drum((0.05, -0.15, 0.27), (1.2, -0.75, 0.27), 0.27, "teal glaze", bevel=0.02),
        drum(post, post + 1.5 * upright, 0.028, "white paint"),
        box((-0.62, -1.04, 1.3), (0.52, 0.03, 0.36), "sign paint", yaw=-14.0),
        rock((2.05, -0.45, 0.27), 0.43, "stone", rng),
        ellipsoid((1.42, -1.18, 0.17), (0.17, 0.17, 0.17), "red glaze", rows=48),
    ]


@dataclass
class Set:
    """A scene that stands still, to which the moving things of each frame are added."""

    ground: str
    objects: list[Mesh] = field(default_factory=list)
    camera: Camera = CAMERA
    light: KeyLight = SUN

    def __post_init__(self) -> None:
        """Hand what stands still to the renderer once."""
        plane = np.array([[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]])
        ground = Mesh(
            np.pad(plane, ((0, 0), (0, 1))),
            np.array([[0, 1, 2], [0, 2, 3]]),
            self.ground,
            uv=plane / 20.0 + 0.5,
        )
        self.still = [shape(mesh) for mesh in [ground, *self.objects]]

    def scene(self, moving: Iterable[Mesh] = (), lit: bool = True) -> mi.Scene:
        """The scene with the moving things in it, with or without the key light."""
        shapes = [*self.still, *map(shape, moving)]
        parts: dict = {f"shape{i:03d}": part for i, part in enumerate(shapes)}
        if lit:
            parts["key"] = self.light.emitter()
        return mi.load_dict({"type": "scene", "sky": sky(**SKY), **parts})

    def render(
        self, spp: int, moving: Iterable[Mesh] = (), lit: bool = True, passes: int = 1
    ) -> Array:
        """The picture (H, W, 3) in linear light, the mean of ``passes`` renderings.

        The seeds are the same in all frames: what remains of the sampling noise is a texture that
        stands still, not a flicker that a filmed scene would not have.
        """
        scene = self.scene(moving, lit)
        sensor = mi.load_dict(self.camera.sensor(spp))
        integrator = mi.load_dict({"type": "path", "max_depth": 3})
        total = np.zeros((self.camera.height, self.camera.width, 3))
        for seed in range(passes):
            picture = mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
            total += np.array(picture)
        return total / passes


def shape(mesh: Mesh) -> mi.Mesh:
    """The mesh for the renderer."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = material(mesh.material)
    made = mi.Mesh(
        mesh.material,
        len(mesh.vertices),
        len(mesh.faces),
        has_vertex_normals=mesh.normals is not None,
        has_vertex_texcoords=mesh.uv is not None,
        props=properties,
    )
    values = mi.traverse(made)
    values["vertex_positions"] = np.ravel(mesh.vertices).astype(np.float32)
    values["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    if mesh.normals is not None:
        values["vertex_normals"] = np.ravel(mesh.normals).astype(np.float32)
    if mesh.uv is not None:
        values["vertex_texcoords"] = np.ravel(mesh.uv).astype(np.float32)
    values.update()
    return made


# Known answers, by rays of our own


def rays(origins: Array, directions: Array) -> mi.Ray3f:
    """Rays for the renderer from (N, 3) arrays."""
    o, d = (np.ascontiguousarray(v.T, dtype=np.float32) for v in (origins, directions))
    return mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))


def meets(scene: mi.Scene, origins: Array, directions: Array, reach: float = 1e6) -> Array:
    """Whether each ray meets anything within ``reach`` times its direction's length."""
    ray = rays(origins, directions)
    ray.maxt = reach
    return np.array(scene.ray_test(ray))


def subpixels(count: int) -> list[tuple[float, float]]:
    """A regular grid of ``count`` x ``count`` places in a pixel, from its centre."""
    offsets = (np.arange(count) + 0.5) / count - 0.5
    return [(dx, dy) for dy in offsets for dx in offsets]


def coverage(camera: Camera, figure: list[Mesh], grid: int = 8) -> Array:
    """Alpha: the part of each pixel's area that the figure covers."""
    scene = mi.load_dict({"type": "scene", **{f"s{i}": shape(m) for i, m in enumerate(figure)}})
    total = np.zeros((camera.height, camera.width))
    for dx, dy in subpixels(grid):
        directions = camera.directions(*camera.pixels(dx, dy)).reshape(-1, 3)
        origins = np.broadcast_to(np.asarray(camera.position), directions.shape)
        total += meets(scene, origins, directions).reshape(total.shape)
    return total / grid**2


def visibility(
    camera: Camera, light: KeyLight, figure: list[Mesh], grid: int = 8, points: int = 256
) -> Array:
    """Beta: how much of the light's disk the bare ground in each pixel sees past the figure."""
    scene = mi.load_dict({"type": "scene", **{f"s{i}": shape(m) for i, m in enumerate(figure)}})
    places = subpixels(grid)
    disk = light.points(points)
    total = np.zeros(camera.height * camera.width)
    for k, (dx, dy) in enumerate(places):
        ground = camera.on_ground(*camera.pixels(dx, dy)).reshape(-1, 3)
        # Each place in the pixel takes its own share of the disk's points: together they see all.
        for point in disk[k :: len(places)]:
            total += ~meets(scene, ground, point - ground, reach=1.0)
    return (total / points).reshape(camera.height, camera.width)


def shadow_warp(target: Set) -> Array:
    """The ST map (H, W, 4): for each pixel's surface point, where the ground behind it in the
    light's direction is seen; A tells whether the surface point sees the light's centre."""
    camera, light = target.camera, target.light
    scene = target.scene(lit=False)
    directions = camera.directions(*camera.pixels()).reshape(-1, 3)
    origins = np.broadcast_to(np.asarray(camera.position), directions.shape)
    hit = scene.ray_intersect(rays(origins, directions))
    distance = np.array(hit.t, dtype=float)
    valid = np.isfinite(distance)
    surface = origins + directions * np.where(valid, distance, 0.0)[:, None]
    normal = np.array(hit.n, dtype=float).T
    facing = np.sum(normal * directions, axis=-1) > 0
    raised = surface + 1e-3 * np.where(facing[:, None], -normal, normal)
    centre = np.asarray(light.centre)
    seen = valid & ~meets(scene, raised, centre - raised, reach=1.0)
    # The ray that leaves the light through the surface point goes on to z = 0.
    ray = surface - centre
    ground = centre - ray * (centre[2] / ray[:, 2:])
    x, y = camera.project(ground).T
    st = np.stack(
        [
            (x + 0.5) / camera.width,
            1.0 - (y + 0.5) / camera.height,
            np.zeros_like(x),
            seen.astype(float),
        ],
        axis=-1,
    )
    st[~valid] = 0.0
    return st.reshape(camera.height, camera.width, 4).astype(np.float32)


def trimap(alpha: Array, band: int = 3) -> Array:
    """0 outside, 255 inside, 128 within ``band`` pixels of the figure's edge."""
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * band + 1, 2 * band + 1))
    inside = cv2.erode((alpha >= 1.0).astype(np.uint8), disk)
    outside = cv2.dilate((alpha > 0.0).astype(np.uint8), disk)
    return np.where(inside == 1, 255, np.where(outside == 1, 128, 0)).astype(np.uint8)


# Files


def write_exr(path: Path, channels: dict[str, Array]) -> None:
    """Write a ZIP compressed EXR. Its library writes rubbish for arrays that are not contiguous."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    arrays = {name: np.ascontiguousarray(values) for name, values in channels.items()}
    with OpenEXR.File(header, arrays) as file:
        file.write(str(path))


def write_png(path: Path, image: Array) -> None:
    """Write an 8 bit PNG, or say so if that fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image):
        raise OSError(f"cannot write {path}")


def film(image: Array, rng: np.random.Generator) -> Array:
    """Add a camera's noise in linear light: variance a*I + b, SNR 60 at mid grey."""
    read, grey = 0.001, 0.18
    slope = ((grey / 60.0) ** 2 - read**2) / grey
    sigma = np.sqrt(slope * np.clip(image, 0.0, None) + read**2)
    return image + sigma * rng.standard_normal(image.shape)


def encode_709(image: Array) -> Array:
    """The BT.709 curve from linear light 0..1 to code values 0..1."""
    x = np.clip(image, 0.0, 1.0)
    return np.where(x < 0.018, 4.5 * x, 1.099 * np.maximum(x, 0.018) ** 0.45 - 0.099)


def planes_422(code: Array) -> list[Array]:
    """Y, Cb and Cr in 10 bit limited range, colour at every second column (sited left)."""
    r, g, b = np.moveaxis(code, -1, 0)
    y = 0.2126 * r + 0.7152 * g + 0.0722 * b
    planes = [np.round(64.0 + 876.0 * y)]
    for colour, scale in ((b, 1.8556), (r, 1.5748)):
        chroma = np.pad((colour - y) / scale, ((0, 0), (1, 1)), mode="edge")
        chroma = 0.25 * chroma[:, :-2] + 0.5 * chroma[:, 1:-1] + 0.25 * chroma[:, 2:]
        planes.append(np.round(512.0 + 896.0 * chroma[:, ::2]))
    return [np.clip(plane, 4, 1019).astype("<u2") for plane in planes]


def planes_420(code: Array) -> list[Array]:
    """Y, Cb and Cr in 8 bit limited range, colour at every second column and between rows."""
    y, *chroma = (plane.astype(float) / 4.0 for plane in planes_422(code))
    planes = [y, *((c[::2] + c[1::2]) / 2.0 for c in chroma)]
    return [np.round(plane).astype("u1") for plane in planes]


def write_movie(path: Path, frames: Iterable[Array], crf: float, small: bool = False) -> None:
    """Encode linear frames as H.264, tagged BT.709 and limited range: High 4:2:2 of 10 bit, or
    small, 4:2:0 of 8 bit."""
    layout, code_of, kind = (
        ("yuv420p", planes_420, "u1") if small else ("yuv422p10le", planes_422, "<u2")
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.pix_fmt = layout
        stream.time_base = Fraction(1, FPS)
        stream.options = {
            "crf": f"{crf:g}",
            "preset": "veryslow",
            # Nearness to the input counts here, not the looks that psychovisual tuning keeps.
            "tune": "psnr",
            "chroma_sample_location": "left",
        }
        context = stream.codec_context
        context.color_primaries = ColorPrimaries.BT709
        context.color_trc = ColorTrc.BT709
        context.colorspace = Colorspace.ITU709
        context.color_range = ColorRange.MPEG
        for number, image in enumerate(frames):
            height, width = image.shape[:2]
            if number == 0:
                stream.width, stream.height = width, height
            frame = av.VideoFrame(width, height, layout)
            for plane, values in zip(frame.planes, code_of(encode_709(image)), strict=True):
                # The rows of a plane may be padded.
                rows = np.zeros((plane.height, plane.line_size // np.dtype(kind).itemsize), kind)
                rows[:, : plane.width] = values
                plane.update(rows)
            frame.color_primaries = ColorPrimaries.BT709
            frame.color_trc = ColorTrc.BT709
            frame.colorspace = Colorspace.ITU709
            frame.color_range = ColorRange.MPEG
            # Not the stream's time base: the container changes that one when it writes its header.
            frame.pts, frame.time_base = number, Fraction(1, FPS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


# The takes

CARD = Card(frames=44, seed=10)
SWEEPS = {
    "sweep1": Sweep(
        angle=95.0, frames=88, seed=20, width=0.46, height=5.0, margin=58.0, length=17.0
    ),
    "sweep2": Sweep(angle=35.0, frames=84, seed=30, width=0.62, margin=40.0),
    "sweep3": Sweep(angle=155.0, frames=80, seed=40, width=0.56, margin=50.0, body=True),
}
TRUTH_FRAMES = (1010, 1027, 1052)
KEYFRAMES = (1002, 1016, 1030, 1044, 1058)
CRF = 5.0
# Drawn over the target by hand: flat ground on several sides of the things that stand there.
PLANE = (
    "5,6 634,4 632,132 470,134 330,130 310,90 230,88 215,132 138,138 132,222 4,226",
    "4,240 150,236 290,232 415,240 480,228 574,205 580,150 635,148 634,355 6,354",
)


def source_set() -> Set:
    """The bare ground that the figure walks over."""
    return Set("brick paving")


def target_set() -> Set:
    """The scene that is to receive the figure's shadow."""
    return Set("slab paving", target_objects())


def takes() -> dict[str, tuple[Callable[[], Set], int, Callable[[int], list[Mesh]]]]:
    """Each movie: its set, its number of frames, and what moves in a frame counted from 0."""
    table = {
        "source": (source_set, WALK.frames, WALK.figure),
        "photometric": (target_set, CARD.frames, lambda f: CARD.shapes(CAMERA, SUN, f)),
    }
    for name, sweep in SWEEPS.items():
        table[name] = (
            target_set,
            sweep.frames,
            lambda f, sweep=sweep: sweep.shapes(CAMERA, SUN, f),
        )
    return table


def shoot(name: str, folder: Path, spp: int) -> None:
    """Render one take and write its movie."""
    make_set, count, moving = takes()[name]
    stage = make_set()
    rng = np.random.default_rng([SEED, *name.encode()])
    frames = (film(stage.render(spp, moving(f)), rng) for f in range(count))
    write_movie(folder / "footage" / f"{name}.mov", frames, CRF)


def write_truth(folder: Path, spp: int) -> None:
    """Write the stills that the footage is judged against."""
    target = target_set()
    truth = folder / "truth"

    def picture(moving: Iterable[Mesh] = (), lit: bool = True) -> dict[str, Array]:
        image = target.render(spp, moving, lit, TRUTH_PASSES)
        return {"RGB": np.clip(image, 0.0, 65504.0).astype(np.float16)}

    write_exr(truth / "lit.exr", picture())
    write_exr(truth / "shadow.exr", picture(lit=False))
    write_exr(truth / "warp.exr", {"RGBA": shadow_warp(target)})
    for number in TRUTH_FRAMES:
        figure = WALK.figure(number - FIRST_FRAME)
        alpha = coverage(CAMERA, figure)
        beta = visibility(CAMERA, SUN, figure)
        write_exr(truth / f"reference.{number}.exr", picture(figure))
        write_exr(truth / f"alpha.{number}.exr", {"Y": alpha.astype(np.float16)})
        write_exr(truth / f"beta.{number}.exr", {"Y": beta.astype(np.float16)})


def write_drawings(folder: Path) -> None:
    """Write what an artist draws by hand: the plane's region and the trimaps of a few frames."""
    plane = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    for polygon in PLANE:
        points = [[int(value) for value in point.split(",")] for point in polygon.split()]
        cv2.fillPoly(plane, [np.array(points, np.int32)], 255)
    write_png(folder / "plane.png", plane)
    for number in KEYFRAMES:
        alpha = coverage(CAMERA, WALK.figure(number - FIRST_FRAME))
        write_png(folder / "trimaps" / f"trimap.{number}.png", trimap(alpha))


def main(arguments: Sequence[str] | None = None) -> None:
    """Render the takes that the command line names, by default all."""
    names = ["drawings", "truth", *takes()]
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "-o", "--output", type=Path, default=Path(__file__).parent, help="folder to write into"
    )
    parser.add_argument(
        "--take", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names)
    )
    parser.add_argument("--spp", type=int, default=SAMPLES, help="samples per pixel and frame")
    options = parser.parse_args(arguments)
    for name in options.take:
        print(name, flush=True)
        if name == "drawings":
            write_drawings(options.output)
        elif name == "truth":
            write_truth(options.output, options.spp)
        else:
            shoot(name, options.output, options.spp)


if __name__ == "__main__":
    main()
