"""A tiny shot for the command-line tests: both shoots of a scene of 48 x 32 pixels."""

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import settings

from shadowtool.cli.process import run_command
from shadowtool.io.image import Header, write_exr, write_png

# How long an example takes says more of what else the machine does than of the code.
settings.register_profile("shared", deadline=None)
settings.load_profile("shared")

WIDTH, HEIGHT = 48, 32
PLANE = "0,0 47,0 47,31 0,31"


class Outcome(NamedTuple):
    """What a command left on its streams, and its exit code."""

    code: int
    out: str
    err: str


@dataclass(frozen=True)
class Shot:
    """Footage and the products of every step; nobody writes here."""

    folder: Path

    def __getattr__(self, name: str) -> Path:
        return self.folder / name

    def arguments(self, command: str) -> list[str]:
        """A command as a user would give it, without -o."""
        return [str(word) for word in _arguments(self)[command]]


def _arguments(shot: Shot) -> dict[str, list[Any]]:
    stmap = shot.warp / "warp.exr"
    return {
        "capture": ["capture", shot.source],
        "plate": ["plate", shot.photometric],
        "matte": ["matte", shot.source, "--plates", shot.plates],
        "scan": ["scan", shot.sweep1, "--plane", PLANE],
        "warp": ["warp", shot.scan1, shot.scan2],
        "apply": ["warp", "--map", stmap, "--apply", shot.matte / "beta"],
        "composite": ["composite", shot.matte, "--plates", shot.plates, "--ratio", "--warp", stmap],
    }


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Lit and shadow of a textured ground, (H, W, 3)."""
    rng = np.random.default_rng(1)
    lit = 0.3 + 0.3 * rng.random((HEIGHT, WIDTH, 3))
    return lit, lit * np.array([0.2, 0.25, 0.35])


def soft_band(middle: float) -> np.ndarray:
    """β of a soft vertical band of shadow, (H, W)."""
    x = np.arange(WIDTH)
    return np.tile(np.clip((np.abs(x - middle) - 4) / 6, 0, 1), (HEIGHT, 1))


def straight_edge(frame: int, angle: float, speed: float = 3.5) -> np.ndarray:
    """β of a dark band swept over the picture along ``angle``, degrees, (H, W)."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    normal = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    distance = (x - WIDTH / 2) * normal[0] + (y - HEIGHT / 2) * normal[1]
    behind = -32 + speed * frame - distance
    return 1 - np.clip(behind + 0.5, 0, 1) * np.clip(10.5 - behind, 0, 1)


def shaded(beta: np.ndarray, seed: int) -> np.ndarray:
    """A noisy picture of the scene under β, (H, W, 3) half."""
    lit, shadow = scene()
    noise = np.random.default_rng(seed).normal(0, 0.002, lit.shape)
    picture = beta[..., None] * lit + (1 - beta[..., None]) * shadow + noise
    return picture.astype(np.float16)


def write_frames(folder: Path, pictures: Iterable[np.ndarray], first: int = 1001) -> Path:
    """Write ``NAME.1001.exr`` and so on."""
    folder.mkdir(parents=True)
    for number, picture in enumerate(pictures, start=first):
        header = Header(picture.shape[1], picture.shape[0])
        write_exr(folder / f"{folder.name}.{number}.exr", {"RGB": picture}, header)
    return folder


def with_figure(picture: np.ndarray, x: int) -> np.ndarray:
    """The picture with a bright block standing in it."""
    picture[8:20, x : x + 6] = (2.0, 0.1, 0.1)
    return picture


@pytest.fixture(scope="session")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Shot:
    """The whole shot, made by the commands themselves."""
    folder = tmp_path_factory.mktemp("shot")
    shot = Shot(folder)
    write_frames(shot.photometric, (shaded(soft_band(6 * i - 9), i) for i in range(12)))
    write_frames(
        shot.source, (with_figure(shaded(soft_band(10 + 3 * i), 50 + i), 4 + i) for i in range(6))
    )
    for name, angle in (("sweep1", 20), ("sweep2", 110)):
        pictures = (shaded(straight_edge(i, angle), 100 + angle + i) for i in range(22))
        write_frames(folder / name, pictures)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    write_png(folder / "mask.png", mask)
    for command, output in (
        ("plate", "plates"),
        ("matte", "matte"),
        ("scan", "scan1"),
        ("warp", "warp"),
    ):
        if command == "warp":
            second = ["scan", str(shot.sweep2), "--plane", PLANE]
            assert run_command([*second, "-o", str(shot.scan2), "-q"]) == 0
        words = [*shot.arguments(command), "-o", str(folder / output), "-q"]
        assert run_command(words) == 0
    return shot


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run ``shadowtool`` with the given words inside this process."""

    def call(*words: object) -> Outcome:
        capsys.readouterr()
        code = run_command([str(word) for word in words])
        return Outcome(code, *capsys.readouterr())

    return call


@pytest.fixture
def copied(shot: Shot, tmp_path: Path) -> Callable[[str], Path]:
    """A copy of a part of the shot that a test may spoil."""

    def copy(name: str) -> Path:
        target = tmp_path / "copies" / name
        shutil.copytree(shot.folder / name, target)
        return target

    return copy


@pytest.fixture
def tree() -> Callable[[Path], dict[str, bytes]]:
    """Every file below a folder with its content, hidden ones too."""
    return lambda folder: {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def narrow_bands(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """From the call on, even small pictures are worked through in many bands."""

    def narrow() -> None:
        for name in ("bands._VALUES", "beta._PIXELS", "crossings._BLOCK"):
            monkeypatch.setattr(f"shadowtool.core.{name}", 1000)

    return narrow


def write_sum(
    rows: slice, red: np.ndarray, green: np.ndarray, blue: np.ndarray, made: np.ndarray
) -> None:
    """Something to be made of a picture's channels, and of where they are."""
    made[:] = red + 2 * green + 4 * blue + np.arange(rows.start, rows.stop)[:, np.newaxis]


def sum_of(*channels: np.ndarray) -> np.ndarray:
    """What `write_sum` writes of three channels (H, W)."""
    made = np.empty(channels[0].shape, np.float16)
    write_sum(slice(0, len(made)), *channels, made)
    return made
