"""Render benchmark footage whose answers are known: two more scenes beside the sample shot.

    python -m tests.benchmarks.footage [-o DIR] [--scene NAME ...] [--spp N]

``sun`` is outdoors, with other things, textures, light and camera than the sample; ``lamp`` is a
room lit by one lamp, whose light falls off across the floor and whose shadows have wide edges. Both
are filmed as a shoot would: a figure walks through the source scene; in the target scene a card is
waved through the light (``photometric``) and a board swept through it (``sweep1`` to ``sweep3``).

What is rendered obeys the compositing equation exactly, up to what a pixel's area mixes: light
comes from the key light and the sky alone, and nothing that moves hides the sky from the ground.
So whatever a method makes of the footage, its distance from ``truth`` is its own error. For the
same reason the card and the board are never in the picture, however near to the ground they are.

A scene's folder holds ``clean/TAKE.####.exr`` (linear light, without noise), ``plane.png``,
``source_plane.png`` and ``truth``:

- ``truth/source``: ``lit.exr``, ``shadow.exr``; for every frame ``alpha.####.exr`` and
  ``beta.####.exr``, the light's visibility on the ground, behind the figure too;
- ``truth/target``: ``lit.exr``, ``shadow.exr``, ``warp.exr`` (ST map; A is 1 where the light's
  centre is visible); for every tenth frame ``reference.####.exr`` (the same figure in this scene)
  and ``reference_alpha.####.exr``.

Noise and movies are made from that at first use, by `noisy_take` and `movie`.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import ModuleType

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

ROOT = Path(__file__).parents[2]
BENCH = ROOT / ".bench"


def _sample_renderer() -> ModuleType:
    """The sample's renderer, whose cameras, lights, figures and file writers are used here."""
    name = "sample_data_render"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / "sample_data" / "render.py")
        assert spec and spec.loader
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


render = _sample_renderer()
Array = np.ndarray
Vector = tuple[float, float, float]

# Footage of another version is rendered again.
VERSION = 1
SEED = 1983
SAMPLES = 100
FIRST_FRAME = render.FIRST_FRAME
WIDTH, HEIGHT = 480, 270
REFERENCE_STEP = 10
CRF, SMALL_CRF = 5.0, 18.0


# Materials


def gravel(
    rng: np.random.Generator, palette: Sequence[Vector], size: int = 2560, extent: float = 20.0
) -> Array:
    """Loose ground: coarse patches of several colours under grains of all sizes."""
    metre = size / extent
    image = np.broadcast_to(np.asarray(palette[0], np.float32), (size, size, 3)).copy()
    for colour in palette[1:]:
        amount = np.clip(0.5 + 2.2 * render.noise(rng, size, 0.9 * metre, 5), 0.0, 1.0)[..., None]
        image = image * (1.0 - 0.7 * amount) + np.asarray(colour, np.float32) * 0.7 * amount
    grain = 1.0 + 0.35 * render.noise(rng, size, 0.12 * metre, 4)
    grain += 0.22 * render.noise(rng, size, 0.03 * metre, 2)
    return np.clip(image * grain[..., None], 0.04, 0.85).astype(np.float32)


def rug(
    rng: np.random.Generator, palette: Sequence[Vector], size: int = 2560, extent: float = 20.0
) -> Array:
    """A woven floor: stripes both ways in several colours, with a pile that is not even."""
    metre = size / extent
    x, y = np.meshgrid(np.arange(size, dtype=np.float32), np.arange(size, dtype=np.float32))
    sway = 0.02 * metre * render.noise(rng, size, 0.4 * metre, 3)
    c, s = math.cos(0.35), math.sin(0.35)
    u, v = (c * x + s * y + sway) / metre, (c * y - s * x + sway) / metre
    image = np.broadcast_to(np.asarray(palette[0], np.float32), (size, size, 3)).copy()
    for k, colour in enumerate(palette[1:]):
        along = u if k % 2 else v
        wave = np.sin(2.0 * np.pi * along / (0.55 + 0.31 * k) + k)
        amount = 0.65 * np.clip(0.5 + 3.0 * wave, 0.0, 1.0)[..., None]
        image = image * (1.0 - amount) + np.asarray(colour, np.float32) * amount
    pile = 1.0 + 0.22 * render.noise(rng, size, 0.05 * metre, 3)
    pile += 0.12 * render.noise(rng, size, 1.5 * metre, 3)
    return np.clip(image * pile[..., None], 0.04, 0.85).astype(np.float32)


@cache
def material(name: str) -> mi.BSDF:
    """The material of this name, made once; what is not of this bench is the sample's."""
    rng = np.random.default_rng([SEED, *name.encode()])
    table: dict[str, Callable[[], dict]] = {
        "cobbles": lambda: render.painted(
            render.paving(
                rng,
                (0.24, 0.16),
                ((0.46, 0.44, 0.42), (0.58, 0.52, 0.44), (0.34, 0.37, 0.42), (0.52, 0.42, 0.36)),
                (0.30, 0.33, 0.22),
                turn=-38.0,
            )
        ),
        "gravel": lambda: render.painted(
            gravel(rng, ((0.56, 0.50, 0.42), (0.40, 0.45, 0.28), (0.62, 0.42, 0.30)))
        ),
        "floorboards": lambda: render.painted(
            render.paving(
                rng,
                (1.7, 0.15),
                ((0.62, 0.42, 0.24), (0.54, 0.34, 0.18), (0.66, 0.49, 0.30), (0.48, 0.31, 0.19)),
                (0.20, 0.13, 0.08),
                turn=63.0,
            )
        ),
        "rug": lambda: render.painted(
            rug(rng, ((0.62, 0.55, 0.46), (0.50, 0.20, 0.16), (0.28, 0.36, 0.46)))
        ),
        "concrete": lambda: render.painted(
            render.mottled(rng, (0.56, 0.55, 0.52), 0.25).astype(np.float32), 1.5
        ),
        "basalt": lambda: render.painted(
            render.mottled(rng, (0.40, 0.38, 0.40), 0.45).astype(np.float32), 3.0
        ),
        "ochre glaze": lambda: render.glazed((0.66, 0.44, 0.08), 0.22),
        "blue glaze": lambda: render.glazed((0.10, 0.20, 0.50), 0.18),
        "green paint": lambda: render.diffuse((0.22, 0.46, 0.26)),
        "pale paint": lambda: render.diffuse((0.68, 0.64, 0.58)),
        "plum cloth": lambda: render.diffuse((0.46, 0.20, 0.36)),
        "mustard cloth": lambda: render.diffuse((0.72, 0.52, 0.12)),
        "olive cloth": lambda: render.diffuse((0.34, 0.36, 0.20)),
        "black cloth": lambda: render.diffuse((0.05, 0.05, 0.06)),
        "grey cloth": lambda: render.diffuse((0.42, 0.43, 0.46)),
    }
    return mi.load_dict(table[name]()) if name in table else render.material(name)


def shape(mesh: render.Mesh) -> mi.Mesh:
    """The mesh for the renderer, in a material of this bench."""
    made = render.shape(replace(mesh, material="card"))
    made.set_bsdf(material(mesh.material))
    return made


def scene_of(meshes: Iterable[render.Mesh]) -> mi.Scene:
    """A scene without lights: it answers rays, and knows the materials."""
    return mi.load_dict({"type": "scene", **{f"s{i:03d}": shape(m) for i, m in enumerate(meshes)}})


# What moves through the light


def lifted(outline: Array, light: render.KeyLight, height: float) -> render.Mesh:
    """A flat thing at ``height``, whose shadow on z = 0, by the light's centre, is the convex
    ``outline`` (N, 3)."""
    vertices = light.towards(outline, height / light.centre[2])
    fan = np.arange(1, len(outline) - 1)
    faces = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    return render.Mesh(vertices, faces, "card")


def rectangle(centre: Array, along: Array, across: Array, size: tuple[float, float]) -> Array:
    """The corners (4, 3) of a rectangle of full ``size`` along two unit vectors."""
    a, b = along * size[0] / 2.0, across * size[1] / 2.0
    return centre + np.stack([-a - b, a - b, a + b, -a + b])


def ellipse(centre: Array, a: Array, b: Array, count: int = 24) -> Array:
    """Points (count, 3) on the ellipse with these half axes."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)[:, None]
    return centre + np.cos(angle) * a + np.sin(angle) * b


def swept(
    sweep: render.Sweep, camera: render.Camera, light: render.KeyLight, frame: int
) -> list[render.Mesh]:
    """The board of a sweep, of the given width as its shadow on the ground, and its holder.

    It lies flat in the air: then its shadow is as straight on the ground as it is, and all of it
    is equally sharp.
    """
    point, direction = sweep.line(camera, frame)
    a, b = camera.on_ground(*np.stack([point - 50 * direction, point + 50 * direction]).T)
    along = render.unit(b - a)
    ahead = np.cross((0.0, 0.0, 1.0), along)
    ahead = ahead * np.sign(ahead @ (camera.on_ground(*(point + 50 * sweep.travel)) - a))
    middle = a + along * (-a @ along)
    outlines = [rectangle(middle, along, ahead, (2.0 * sweep.length, sweep.width))]
    if sweep.body:
        # All behind the board's leading edge.
        rear = -sweep.width / 2.0
        outlines += [
            ellipse(middle + (rear - 0.75) * ahead, 0.25 * along, 0.42 * ahead),
            ellipse(middle + (rear - 0.22) * ahead, 0.12 * along, 0.14 * ahead),
            rectangle(middle + 0.24 * along + (rear - 0.25) * ahead, along, ahead, (0.08, 0.6)),
            rectangle(middle - 0.24 * along + (rear - 0.25) * ahead, along, ahead, (0.08, 0.6)),
        ]
    return [lifted(outline, light, sweep.height) for outline in outlines]


@dataclass(frozen=True)
class Card:
    """A card carried once through the light, unevenly and not held straight."""

    frames: int
    seed: int
    height: float
    # Of its shadow on the ground; the other way it reaches over all that is in the picture.
    width: float
    # The way that its shadow goes, in degrees from x to y.
    heading: float

    def shapes(
        self, camera: render.Camera, light: render.KeyLight, frame: int
    ) -> list[render.Mesh]:
        """The card at a frame counted from 0."""
        corners = camera.on_ground(
            np.array([0.0, 1.0, 0.0, 1.0]) * (camera.width - 1),
            np.array([0.0, 0.0, 1.0, 1.0]) * (camera.height - 1),
        )
        turn = math.radians(self.heading)
        ahead = np.array([math.cos(turn), math.sin(turn), 0.0])
        along = np.cross((0.0, 0.0, 1.0), ahead)
        reach, side = corners @ ahead, corners @ along
        # Things that stand up lie, in the light's direction, beyond the ground in the picture.
        low, high = reach.min() - 1.2 - self.width, reach.max() + 1.2 + self.width
        speed = 1.0 + 0.25 * render.unsteady(self.frames - 1, self.seed)
        path = np.concatenate([[0.0], np.cumsum(speed)])[frame] / speed.sum()
        centre = ahead * (low + (high - low) * path) + along * (side.min() + side.max()) / 2.0
        tilt = math.radians(4.0) * render.unsteady(self.frames, self.seed + 1)[frame]
        a = math.cos(tilt) * along - math.sin(tilt) * ahead
        b = math.cos(tilt) * ahead + math.sin(tilt) * along
        outline = rectangle(centre, a, b, (np.ptp(side) + 6.0, self.width))
        return [lifted(outline, light, self.height)]


# The scenes


@dataclass(frozen=True)
class Shoot:
    """A camera and a light that stay, the source's and the target's ground, and what moves."""

    camera: render.Camera
    light: render.KeyLight
    # The sky's colours at the zenith and the horizon.
    sky: tuple[Vector, Vector]
    source_ground: str
    target_ground: str
    objects: Callable[[], list[render.Mesh]]
    walk: render.Walk
    frames: int
    # Which frame of the walk is seen in a frame of the take; it need not be whole.
    pace: Callable[[int], float]
    clothes: dict[str, str]
    card: Card
    sweeps: dict[str, render.Sweep]

    def figure(self, frame: int) -> list[render.Mesh]:
        """The dressed figure at a frame counted from 0."""
        parts = self.walk.figure(self.pace(frame))
        return [replace(m, material=self.clothes.get(m.material, m.material)) for m in parts]

    def blockers(self, take: str, frame: int) -> list[render.Mesh]:
        """What is moved through the light in a take of the target, at a frame counted from 0."""
        if take == "photometric":
            return self.card.shapes(self.camera, self.light, frame)
        return swept(self.sweeps[take], self.camera, self.light, frame)

    def length(self, take: str) -> int:
        """How many frames a take has."""
        if take == "source":
            return self.frames
        return self.card.frames if take == "photometric" else self.sweeps[take].frames


def sun_objects() -> list[render.Mesh]:
    """Steps, a dome, a leaning rod and its post, a boulder, and a crate that shades the steps."""
    rng = np.random.default_rng([SEED, 1])
    post, upright = np.array([-1.32, -0.62, 0.0]), np.array([0.0, 0.0, 1.0])
    return [
        render.box((0.42, -0.22, 0.08), (1.05, 0.85, 0.16), "concrete", yaw=-14.0),
        render.box((0.47, -0.03, 0.16), (1.05, 0.45, 0.32), "concrete", yaw=-14.0),
        render.box((1.45, -0.72, 0.36), (0.42, 0.42, 0.72), "green paint", yaw=20.0),
        render.ellipsoid((-0.72, -0.2, 0.0), (0.44, 0.38, 0.36), "ochre glaze", rows=48),
        render.drum(post, post + 1.15 * upright, 0.026, "pale paint"),
        render.drum(np.array([-2.05, -0.45, 0.0]), post + 1.1 * upright, 0.024, "pale paint"),
        render.rock((-1.75, 0.3, 0.2), 0.37, "basalt", rng),
    ]


def lamp_objects() -> list[render.Mesh]:
    """Boxes, a bolster, a stool, a heap, a vase, and a cabinet that shades what is behind it."""
    rng = np.random.default_rng([SEED, 2])
    seat = np.array([-0.42, -0.45, 0.44])
    spread = [np.array([x, y, 0.0]) for x in (-1.0, 1.0) for y in (-1.0, 1.0)]
    floor = seat * (1.0, 1.0, 0.0)
    legs = [render.drum(floor + 0.17 * d, seat + 0.12 * d, 0.018, "wood") for d in spread]
    return [
        render.box((-1.35, -0.3, 0.36), (0.36, 0.36, 0.72), "green paint", yaw=-10.0),
        *legs,
        render.box(tuple(seat), (0.34, 0.34, 0.03), "wood", yaw=0.0),
        render.box((0.45, -0.1, 0.1), (0.75, 0.55, 0.2), "pale paint", yaw=22.0),
        render.box((0.5, 0.0, 0.27), (0.4, 0.34, 0.14), "plum cloth", yaw=5.0),
        render.drum(
            np.array([1.0, 0.42, 0.2]), np.array([1.75, 0.0, 0.2]), 0.2, "mustard cloth", bevel=0.03
        ),
        render.drum(
            np.array([-0.35, 0.35, 0.0]), np.array([-0.35, 0.35, 0.5]), 0.14, "blue glaze", 0.02
        ),
        render.rock((1.3, -0.62, 0.12), 0.27, "grey cloth", rng),
    ]


def lamp_light(centre: Vector, target: Vector, radius: float, intensity: Vector) -> render.KeyLight:
    """A lamp of this radius; ``intensity`` over the distance squared is the light that arrives."""
    radiance = np.asarray(intensity) / (math.pi * radius**2)
    return render.KeyLight(centre, target, radius, tuple(radiance))


def pause(start: float, stop: float, ease: float = 4.0) -> Callable[[int], float]:
    """A pace that comes to a halt from frame ``start`` to ``stop``, easing in and out of it."""

    def speed(frame: int) -> float:
        return float(np.clip(max(start - frame, frame - stop) / ease + 0.5, 0.0, 1.0))

    return lambda frame: sum(speed(k) for k in range(frame))


# The figure walks for as many frames as it does not rest.
_LAMP_PACE = pause(20.0, 40.0)

SHOOTS = {
    "sun": Shoot(
        camera=render.Camera((1.6, -10.8, 5.4), (0.05, -0.25, 0.3), WIDTH, HEIGHT, fov=31.0),
        light=render.sun(azimuth=140.0, elevation=38.0, irradiance=(8.3, 7.5, 6.3)),
        sky=((0.24, 0.31, 0.44), (0.32, 0.36, 0.41)),
        source_ground="cobbles",
        target_ground="gravel",
        objects=sun_objects,
        walk=render.Walk(start=(2.55, -1.95), end=(-0.3, -1.3), frames=60, stride=1.2),
        frames=60,
        pace=float,
        clothes={"jacket": "mustard cloth", "trousers": "olive cloth"},
        card=Card(frames=40, seed=110, height=5.0, width=2.4, heading=20.0),
        sweeps={
            "sweep1": render.Sweep(
                80.0, 64, 120, width=0.46, height=1.7, margin=60.0, uneven=0.2, length=17.0
            ),
            "sweep2": render.Sweep(
                28.0, 60, 130, width=0.7, height=1.7, margin=60.0, uneven=0.2, length=17.0
            ),
            "sweep3": render.Sweep(
                140.0, 66, 140, 0.6, height=1.7, margin=64.0, uneven=0.2, length=17.0, body=True
            ),
        },
    ),
    "lamp": Shoot(
        camera=render.Camera((-0.9, -7.7, 4.4), (0.1, -0.3, 0.35), WIDTH, HEIGHT, fov=38.0),
        light=lamp_light((-2.4, -3.4, 4.4), (0.2, 0.2, 0.0), 0.07, (220.0, 166.0, 105.0)),
        sky=((0.13, 0.14, 0.16), (0.09, 0.09, 0.10)),
        source_ground="floorboards",
        target_ground="rug",
        objects=lamp_objects,
        walk=render.Walk(
            start=(-1.95, -1.55), end=(0.15, -1.25), frames=round(_LAMP_PACE(59)) + 1, stride=1.25
        ),
        frames=60,
        pace=_LAMP_PACE,
        clothes={"jacket": "plum cloth", "trousers": "black cloth", "shoes": "black cloth"},
        card=Card(frames=40, seed=210, height=2.1, width=2.2, heading=170.0),
        sweeps={
            "sweep1": render.Sweep(
                100.0, 64, 220, width=0.42, height=1.3, margin=60.0, uneven=0.2, length=17.0
            ),
            "sweep2": render.Sweep(
                38.0, 72, 230, 0.55, height=1.3, margin=112.0, uneven=0.2, length=17.0, body=True
            ),
            "sweep3": render.Sweep(
                150.0, 60, 240, width=0.6, height=1.3, margin=60.0, uneven=0.2, length=17.0
            ),
        },
    ),
}
SCENES = ("sun", "lamp")
TAKES = ("source", "photometric", "sweep1", "sweep2", "sweep3")


# Light, sample by sample


def _points(values: Array) -> mi.Point3f:
    """(N, 3) values for the renderer."""
    return mi.Point3f(np.ascontiguousarray(values.T, dtype=np.float32))


def _rows(values: mi.Vector3f) -> Array:
    """(N, 3) values from the renderer."""
    return np.ascontiguousarray(np.array(values, dtype=np.float32).T)


@dataclass
class Stage:
    """A scene that stands still, as samples of its pixels that each frame only sums up anew.

    Every pixel has ``count`` samples: a ray through a cell of it and a point on the light's disk.
    What the sample gets from the key light and from the sky is worked out once. A frame asks for
    each sample whether something that moves is in the way, and adds up. So the frames, the plates
    and β are exactly consistent with each other, and nothing flickers.
    """

    shoot: Shoot
    ground: str
    objects: list[render.Mesh] = field(default_factory=list)
    count: int = SAMPLES

    def __post_init__(self) -> None:
        """Trace and shade all samples of what stands still."""
        self.camera, self.light = self.shoot.camera, self.shoot.light
        self.pixels = self.camera.width * self.camera.height
        plane = np.array([[-30.0, -30.0], [30.0, -30.0], [30.0, 30.0], [-30.0, 30.0]])
        faces = np.array([[0, 1, 2], [0, 2, 3]])
        uv = plane / 20.0 + 0.5
        floor = render.Mesh(np.pad(plane, ((0, 0), (0, 1))), faces, self.ground, uv=uv)
        self.still = scene_of([floor, *self.objects])
        rng = np.random.default_rng([SEED, *self.ground.encode()])
        self.directions = self._directions(rng)
        self.lights = self._light_points(rng)
        origins = np.broadcast_to(np.asarray(self.camera.position), self.directions.shape)
        hit = self.still.ray_intersect(render.rays(origins, self.directions))
        self.distance = np.array(hit.t, dtype=np.float32)
        assert np.isfinite(self.distance).all(), "the camera sees past the ground"
        self.surface = _rows(hit.spawn_ray_to(_points(self.lights)).o)
        self.on_ground = np.array(hit.p.z) < 1e-4
        key, sky, passes = 0.0, 0.0, 4
        for _ in range(passes):
            some_key, some_sky = self.shade(
                self.still, [self.still], [self.still], self.directions, self.lights, rng
            )
            key, sky = key + some_key / passes, sky + some_sky / passes
        self.key = key.reshape(self.pixels, self.count, 3)
        self.sky = sky.reshape(self.pixels, self.count, 3)
        self.key_mean, self.sky_mean = self.key.mean(axis=1), self.sky.mean(axis=1)

    def _directions(self, rng: np.random.Generator) -> Array:
        """A ray through a random place in each cell of each pixel, (pixels * count, 3)."""
        side = math.isqrt(self.count)
        assert side**2 == self.count, "the samples of a pixel fill a square"
        row, column = np.divmod(np.arange(self.count), side)
        jitter = rng.random((2, self.pixels, self.count))
        x, y = (values.reshape(-1, 1) for values in self.camera.pixels())
        return (
            self.camera.directions(
                x + (column + jitter[0]) / side - 0.5, y + (row + jitter[1]) / side - 0.5
            )
            .reshape(-1, 3)
            .astype(np.float32)
        )

    def _light_points(self, rng: np.random.Generator) -> Array:
        """Each sample's point on the light, (pixels * count, 3): each pixel's cover the disk."""
        u, v = render.frame_along(render.unit(np.subtract(self.light.target, self.light.centre)))
        # Which of the disk's places goes with which cell of the pixel is shuffled.
        shuffled = rng.permutation(self.count)
        k = (shuffled + rng.integers(self.count, size=(self.pixels, 1))) % self.count
        r = self.light.radius * np.sqrt((k + rng.random((self.pixels, 1))) / self.count)
        angle = k * np.pi * (3.0 - math.sqrt(5.0)) + 2.0 * np.pi * rng.random((self.pixels, 1))
        offsets = (r * np.cos(angle))[..., None] * u + (r * np.sin(angle))[..., None] * v
        return (np.asarray(self.light.centre) + offsets).reshape(-1, 3).astype(np.float32)

    def shade(
        self,
        scene: mi.Scene,
        hide_key: Iterable[mi.Scene],
        hide_sky: Iterable[mi.Scene],
        directions: Array,
        lights: Array,
        rng: np.random.Generator,
    ) -> tuple[Array, Array]:
        """What rays (N, 3) from the camera bring back from ``scene``: of the key light and of the
        sky, (N, 3) each, where neither is hidden."""
        origins = np.broadcast_to(np.asarray(self.camera.position), directions.shape)
        ray = render.rays(origins, directions)
        hit = scene.ray_intersect(ray)
        bsdf, context = hit.bsdf(ray), mi.BSDFContext()
        place = _points(lights)
        way = place - hit.p
        distance = dr.norm(way)
        way = mi.Vector3f(way / distance)
        facing = render.unit(np.subtract(self.light.target, self.light.centre))
        cosine = dr.maximum(-dr.dot(way, mi.Vector3f(*map(float, facing))), 0.0)
        area = math.pi * self.light.radius**2
        power = mi.Color3f(*(float(area * c) for c in self.light.radiance))
        key = bsdf.eval(context, hit, hit.to_local(way)) * power * cosine / dr.square(distance)
        seen = mi.Bool(True)
        for other in hide_key:
            seen &= ~other.ray_test(hit.spawn_ray_to(mi.Point3f(place)))
        key = dr.select(seen, key, 0.0)
        first, second, third = (mi.Float(rng.random(len(directions))) for _ in range(3))
        chosen, weight = bsdf.sample(context, hit, first, mi.Point2f(second, third))
        out = hit.to_world(chosen.wo)
        mix = dr.sqrt(dr.maximum(out.z, 0.0))
        zenith, horizon = (mi.Color3f(*colour) for colour in self.shoot.sky)
        sky = weight * (horizon * (1.0 - mix) + zenith * mix)
        seen = mi.Bool(True)
        for other in hide_sky:
            seen &= ~other.ray_test(hit.spawn_ray(out))
        sky = dr.select(seen, sky, 0.0)
        dr.eval(key, sky)
        return _rows(key), _rows(sky)

    def picture(self, values: Array) -> Array:
        """Values per pixel as an image."""
        return values.reshape(self.camera.height, self.camera.width, *values.shape[1:])

    def scene(self, lit: bool = False) -> mi.Scene:
        """What stands still, for the sample's ways to ask for known answers."""
        assert not lit
        return self.still

    def plates(self) -> tuple[Array, Array]:
        """The scene with the key light and without it."""
        return self.picture(self.key_mean + self.sky_mean), self.picture(self.sky_mean)

    def visible(self, blocker: mi.Scene) -> Array:
        """Which samples see their point of the light past the blocker, (pixels, count)."""
        way = self.lights - self.surface
        seen = ~render.meets(blocker, self.surface, way, reach=0.9999)
        return seen.reshape(self.pixels, self.count)

    def covered(self, blocker: mi.Scene, figure: list[render.Mesh]) -> Array:
        """Which samples show the figure and not what stands still, (pixels, count)."""
        x, y = self.camera.project(np.concatenate([m.vertices for m in figure])).T
        column, row = np.tile(np.arange(WIDTH), HEIGHT), np.repeat(np.arange(HEIGHT), WIDTH)
        near = (column > x.min() - 2) & (column < x.max() + 2)
        near &= (row > y.min() - 2) & (row < y.max() + 2)
        chosen = np.repeat(near, self.count)
        directions = self.directions[chosen]
        origins = np.broadcast_to(np.asarray(self.camera.position), directions.shape)
        ray = render.rays(origins, directions)
        ray.maxt = mi.Float(self.distance[chosen])
        covered = np.zeros(self.pixels * self.count, bool)
        covered[chosen] = np.array(blocker.ray_test(ray))
        return covered.reshape(self.pixels, self.count)

    def frame(
        self, moving: list[render.Mesh], in_picture: bool = False
    ) -> tuple[Array, Array, Array]:
        """A frame (H, W, 3) with its α and β (H, W); β is that of the samples of what stands
        still."""
        blocker = scene_of(moving)
        seen = self.visible(blocker)
        beta = seen.mean(axis=1, dtype=np.float32)
        light = np.where(beta[:, None] > 0.0, self.key_mean, 0.0)
        part = (beta > 0.0) & (beta < 1.0)
        light[part] = np.einsum("pk,pkc->pc", seen[part], self.key[part]) / self.count
        image = self.sky_mean + light
        alpha = np.zeros(self.pixels, np.float32)
        if in_picture:
            covered = self.covered(blocker, moving)
            alpha = covered.mean(axis=1, dtype=np.float32)
            part = alpha > 0.0
            samples = self.sky[part] + self.key[part] * seen[part][..., None]
            samples[covered[part]] = self._figure(blocker, covered.ravel())
            image[part] = samples.mean(axis=1)
        return self.picture(image), self.picture(alpha), self.picture(beta)

    def _figure(self, figure: mi.Scene, covered: Array) -> Array:
        """The colours (N, 3) of the samples that show the figure; the ground does not keep the
        sky's light from it, as if it threw some back."""
        # The same numbers in every frame.
        rng = np.random.default_rng(SEED)
        key, sky = 0.0, 0.0
        for _ in range(2):
            key, some = self.shade(
                figure,
                [figure, self.still],
                [figure],
                self.directions[covered],
                self.lights[covered],
                rng,
            )
            sky = sky + some / 2.0
        return key + sky


# Files


def scene_folder(name: str, bench: Path | None = None) -> Path:
    """Where a scene's files are."""
    return (BENCH if bench is None else bench) / name


def load(path: Path) -> Array:
    """An EXR as float32: (H, W, 3), (H, W, 4) with alpha, or (H, W) of a single channel."""
    with OpenEXR.File(os.fspath(path)) as file:
        (channel,) = file.channels().values()
        return channel.pixels.astype(np.float32)


def frame_path(name: str, take: str, number: int, bench: Path | None = None) -> Path:
    """A clean frame's file."""
    return scene_folder(name, bench) / "clean" / f"{take}.{number:04d}.exr"


def frame_numbers(name: str, take: str) -> range:
    """The numbers of a take's frames."""
    return range(FIRST_FRAME, FIRST_FRAME + SHOOTS[name].length(take))


def noisy_frames(name: str, take: str, bench: Path | None = None) -> Iterable[Array]:
    """A take's frames as a camera sees them: variance a*I + b, SNR 60 at mid grey."""
    for number in frame_numbers(name, take):
        rng = np.random.default_rng([SEED, number, *name.encode(), *take.encode()])
        yield render.film(load(frame_path(name, take, number, bench)), rng).astype(np.float32)


def noisy_take(name: str, take: str, bench: Path | None = None) -> Path:
    """The folder of a take's noisy frames, made at first use."""
    folder = scene_folder(name, bench) / "noisy" / take
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".") as temporary:
            made = Path(temporary) / take
            for number, image in zip(
                frame_numbers(name, take), noisy_frames(name, take, bench), strict=True
            ):
                render.write_exr(made / f"{take}.{number:04d}.exr", {"RGB": image.astype("f2")})
            try:
                made.rename(folder)
            except OSError:
                # Somebody else was faster.
                if not folder.exists():
                    raise
    return folder


def movie(name: str, take: str, bench: Path | None = None, small: bool = False) -> Path:
    """A take's noisy frames as a 10 bit 4:2:2 movie, or small, of 8 bit and 4:2:0, made at first
    use."""
    path = scene_folder(name, bench) / "movies" / f"{take}{'.small' if small else ''}.mov"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as temporary:
            made = Path(temporary) / path.name
            render.write_movie(
                made, noisy_frames(name, take, bench), SMALL_CRF if small else CRF, small
            )
            made.rename(path)
    return path


def _write(path: Path, image: Array, precision: str = "f2") -> None:
    """Write an EXR, whole or not at all."""
    name = {2: "Y"}.get(image.ndim) or {3: "RGB", 4: "RGBA"}[image.shape[2]]
    temporary = path.with_name(f".{path.name}.part")
    render.write_exr(temporary, {name: image.astype(precision)})
    temporary.replace(path)


# Rendering


def write_plane(folder: Path, stage: Stage, margin: float = 9.0) -> None:
    """Write masks of the reference plane: bare ground, with a margin around what stands on it."""
    ground = stage.picture(stage.on_ground.reshape(stage.pixels, -1).all(axis=1)).astype(np.uint8)
    away = cv2.distanceTransform(ground, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    render.write_png(folder / "plane.png", np.where(away > margin, 255, 0).astype(np.uint8))
    render.write_png(folder / "source_plane.png", np.full(ground.shape, 255, np.uint8))


def render_source(name: str, bench: Path, spp: int) -> None:
    """Write the source take and all that is known about it."""
    shoot, truth = SHOOTS[name], scene_folder(name, bench) / "truth" / "source"
    stage = Stage(shoot, shoot.source_ground, count=spp)
    for plate, image in zip(("lit", "shadow"), stage.plates(), strict=True):
        _write(truth / f"{plate}.exr", image, "f4")
    for frame, number in enumerate(frame_numbers(name, "source")):
        image, alpha, beta = stage.frame(shoot.figure(frame), in_picture=True)
        _write(truth / f"alpha.{number}.exr", alpha)
        _write(truth / f"beta.{number}.exr", beta)
        _write(frame_path(name, "source", number, bench), image)


def render_target(name: str, bench: Path, spp: int, takes: Sequence[str]) -> None:
    """Write takes of the target, and with the photometric one all that is known about it."""
    shoot, folder = SHOOTS[name], scene_folder(name, bench)
    truth = folder / "truth" / "target"
    stage = Stage(shoot, shoot.target_ground, shoot.objects(), count=spp)
    if "photometric" in takes:
        for plate, image in zip(("lit", "shadow"), stage.plates(), strict=True):
            _write(truth / f"{plate}.exr", image, "f4")
        _write(truth / "warp.exr", render.shadow_warp(stage), "f4")
        write_plane(folder, stage)
        for number in frame_numbers(name, "source")[::REFERENCE_STEP]:
            figure = shoot.figure(number - FIRST_FRAME)
            image, alpha, _ = stage.frame(figure, in_picture=True)
            _write(truth / f"reference_alpha.{number}.exr", alpha)
            _write(truth / f"reference.{number}.exr", image)
    for take in takes:
        for frame, number in enumerate(frame_numbers(name, take)):
            image, _, _ = stage.frame(shoot.blockers(take, frame))
            _write(frame_path(name, take, number, bench), image)


def prepare(folder: Path, settings: dict[str, int]) -> bool:
    """Make a scene's folder; whether anything is left to render into it.

    Footage made with other settings goes, and with it the noisy frames and movies made from it.
    """
    made_with = folder / "settings.json"
    if made_with.exists() and json.loads(made_with.read_text()) != settings:
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    made_with.write_text(json.dumps(settings))
    return not (folder / "done.json").exists()


def main(arguments: Sequence[str] | None = None) -> None:
    """Render the scenes that the command line names, by default all, as far as they are missing."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=BENCH, help="folder to write into")
    parser.add_argument("--scene", nargs="+", choices=SCENES, default=SCENES, metavar="NAME")
    parser.add_argument("--spp", type=int, default=SAMPLES, help="samples per pixel, a square")
    options = parser.parse_args(arguments)
    bench, spp = options.output, options.spp
    bench.mkdir(parents=True, exist_ok=True)
    (bench / ".gitignore").write_text("*\n")
    settings = {"version": VERSION, "seed": SEED, "spp": spp}
    todo = [name for name in options.scene if prepare(scene_folder(name, bench), settings)]

    def missing(name: str, take: str) -> bool:
        return not frame_path(name, take, frame_numbers(name, take)[-1], bench).exists()

    began = time.monotonic()

    def say(*words: str) -> None:
        print(f"{time.monotonic() - began:6.0f} s", *words, flush=True)

    # The sweeps come last: much can be measured without them.
    for name in todo:
        if missing(name, "source"):
            say(name, "source")
            render_source(name, bench, spp)
        if missing(name, "photometric"):
            say(name, "photometric")
            render_target(name, bench, spp, ["photometric"])
    for name in todo:
        sweeps = [take for take in SHOOTS[name].sweeps if missing(name, take)]
        if sweeps:
            say(name, *sweeps)
            render_target(name, bench, spp, sweeps)
        (scene_folder(name, bench) / "done.json").write_text(json.dumps(settings))
    say("done")


if __name__ == "__main__":
    main()
