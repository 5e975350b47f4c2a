"""How fast the commands are: beside OpenEXR alone, and beside other programs that do the same.

    python -m tests.benchmarks.speed [--rows plate,composite] [--runs 3] [--frames 60] [--quick]

Whole processes, start-up included, taken in turn, median of several; wall and processor time and
the largest resident memory. The floors run in the same turn with as many threads: OpenEXR decoding
what the command reads, and decoding it and encoding what the command writes.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shadowtool.core.warp_map import WarpMap, identity_map
from shadowtool.io.image import Header, read_image, write_exr, write_png
from shadowtool.io.products import write_warp
from shadowtool.parallel import ordered_map

FULL_HD, FOUR_K, SMALL = (1920, 1080), (3840, 2160), (192, 108)
FIRST = 1001
PROGRAM = (sys.executable, "-c", "from shadowtool.cli import main; main()")


class Spent(NamedTuple):
    """One process: seconds on the clock, seconds of processor, MB of memory at most."""

    wall: float
    cpu: float
    peak: float


@dataclass(frozen=True)
class Rival:
    """Something to be timed: commands for a shell, one after the other."""

    name: str
    commands: Sequence[Sequence[str]]
    output: Path | None = None
    absent: str = ""


@dataclass(frozen=True)
class Row:
    """Rivals to be timed in turn.

    Attributes:
        frames: how many frames each works through.
        asked: what the first rival's time is to be, by the floor that it is measured by.
    """

    title: str
    frames: int
    rivals: Sequence[Rival]
    asked: Mapping[str, float] = field(default_factory=dict)


def spent(command: Sequence[str]) -> Spent:
    """Run a command and ask the operating system what it took."""
    start = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert process.stderr is not None
    said = process.stderr.read()
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.monotonic() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(command)[:300]}: {process.returncode}\n{said.decode()}")
    return Spent(wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def taken(rival: Rival) -> Spent:
    """All of a rival's commands, into an empty folder."""
    if rival.output is not None:
        shutil.rmtree(rival.output, ignore_errors=True)
    rows = [spent(command) for command in rival.commands]
    return Spent(
        sum(row.wall for row in rows), sum(row.cpu for row in rows), max(row.peak for row in rows)
    )


# Footage.


def surface(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A textured ground, lit and in shadow, (H, W, 3) float32."""
    rng = np.random.default_rng(1)
    lit = np.full((height, width, 3), 0.4, np.float32)
    for size in (4, 16, 64, 256):
        coarse = rng.standard_normal((height // size + 2, width // size + 2), np.float32)
        texture = np.kron(coarse, np.ones((size, size), np.float32))[:height, :width]
        lit *= np.exp(0.06 * texture)[..., None]
    lit *= np.array([1.1, 1.0, 0.85], np.float32)
    return lit, lit * np.array([0.25, 0.3, 0.4], np.float32)


def visibility(width: int, height: int, place: float) -> np.ndarray:
    """β of a soft-edged slanting band of shadow; ``place`` 0 to 1 takes it across the picture."""
    x = np.arange(width, dtype=np.float32)
    y = np.arange(height, dtype=np.float32)[:, None]
    middle = (1.4 * place - 0.2) * width + 0.2 * (y - height / 2)
    return np.clip((np.abs(x - middle) - 0.09 * width) / (0.02 * width), 0, 1)


def coverage(width: int, height: int, place: float) -> np.ndarray:
    """α of a soft-edged upright figure beside the shadow."""
    x = np.arange(width, dtype=np.float32)
    y = np.arange(height, dtype=np.float32)[:, None]
    across = (x - (1.2 * place - 0.1) * width) / (0.05 * width)
    along = (y - 0.55 * height) / (0.3 * height)
    distance = np.sqrt(across**2 + along**2)
    return np.clip((1.02 - distance) * 0.05 * width, 0, 1)


@dataclass(frozen=True)
class Footage:
    """What the commands are given."""

    folder: Path
    size: tuple[int, int]
    frames: int

    @property
    def last(self) -> int:
        return FIRST + self.frames - 1

    def files(self, part: str) -> list[Path]:
        return [self.folder / part / f"{part}.{n}.exr" for n in range(FIRST, self.last + 1)]


def make_footage(folder: Path, size: tuple[int, int], frames: int) -> Footage:
    """``take``, its ``alpha``, ``fg`` and ``beta``; ``plates``; ``warp.exr``; ``plane.png``."""
    width, height = size
    header = Header(width, height)
    lit, shadow = surface(width, height)
    for part in ("take", "alpha", "fg", "beta", "plates"):
        (folder / part).mkdir(parents=True, exist_ok=True)

    def make(number: int) -> None:
        place = number / max(frames - 1, 1)
        rng = np.random.default_rng(number)
        beta, alpha = visibility(width, height, place), coverage(width, height, place)
        clean = beta[..., None] * lit + (1 - beta[..., None]) * shadow
        grain = rng.standard_normal(clean.shape, np.float32) * np.sqrt(2.5e-4 * clean + 1e-6)
        name = f"{FIRST + number}.exr"
        figure = alpha[..., None] * np.float32(0.3)
        write_exr(folder / "take" / f"take.{name}", {"RGB": (clean + grain).astype("f2")}, header)
        write_exr(folder / "alpha" / f"alpha.{name}", {"Y": alpha.astype("f2")}, header)
        rgba = np.dstack([figure * (1 + grain), alpha]).astype("f2")
        write_exr(folder / "fg" / f"fg.{name}", {"RGBA": rgba}, header)
        layers = {"Y": beta.astype("f2"), "confidence": np.full_like(beta, 0.97).astype("f2")}
        write_exr(folder / "beta" / f"beta.{name}", layers, header)

    for _ in ordered_map(make, range(frames)):
        pass
    write_exr(folder / "plates" / "lit.exr", {"RGB": lit}, header)
    write_exr(folder / "plates" / "shadow.exr", {"RGB": shadow}, header)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    bent = identity_map(height, width)
    bent[..., 0] += 30 * np.sin(y / 90)
    bent[..., 1] += 20 * np.sin(x / 120)
    found = WarpMap(bent, np.full((height, width), 0.2, np.float32))
    write_warp(folder / "warp.exr", found, header, {})
    write_png(folder / "plane.png", np.full((height, width), 255, np.uint8))
    return Footage(folder, size, frames)


if __name__ == "__main__":
    t = time.time()
    make_footage(Path(sys.argv[1]), tuple(map(int, sys.argv[2].split("x"))), int(sys.argv[3]))
    print(time.time() - t)
