"""How fast the commands are: beside OpenEXR alone, and beside other programs that do the same.

    python -m tests.benchmarks.speed [--rows minmax,composite] [--runs 3] [--frames 60]

Whole processes, start-up included, taken in turn, median of several; wall and processor time and
the largest resident memory. The floors run in the same turn with as many threads: OpenEXR decoding
what the command reads, and decoding it and encoding what the command writes.
"""

import argparse
import importlib.util
import json
import multiprocessing
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shadowtool.cli.commands import COMMANDS
from shadowtool.core.warp_map import WarpMap, identity_map
from shadowtool.io.image import Header, write_exr, write_png
from shadowtool.io.products import write_warp
from shadowtool.parallel import ordered_map

FULL_HD, FOUR_K, QUARTER, SMALL = (1920, 1080), (3840, 2160), (480, 270), (192, 108)
FIRST = 1001
PROGRAM = (sys.executable, "-c", "from shadowtool.cli import main; main()")


class Spent(NamedTuple):
    """One process: seconds on the clock, seconds of processor, MB of memory at most."""

    wall: float
    cpu: float
    peak: float


@dataclass(frozen=True)
class Rival:
    """Something to be timed.

    Attributes:
        output: a folder that it writes to, made anew.
        absent: why it can't be timed.
        peer: another program; it is slow, and timed in the first turn only.
    """

    name: str
    command: Sequence[str]
    output: Path
    absent: str = ""
    peer: bool = False


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
    """Run a rival, into an empty folder."""
    shutil.rmtree(rival.output, ignore_errors=True)
    if rival.peer:
        rival.output.mkdir()
    return spent(rival.command)


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
    """``take``, the shadow alone; ``acted``, the figure in front of it; its ``alpha``, ``fg`` and
    ``beta``; ``plates``; ``warp.exr``; ``plane.png``."""
    width, height = size
    header = Header(width, height)
    lit, shadow = surface(width, height)
    for part in ("take", "acted", "alpha", "fg", "beta", "plates"):
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
        acted = (clean * (1 - alpha[..., None]) + figure + grain).astype("f2")
        write_exr(folder / "acted" / f"acted.{name}", {"RGB": acted}, header)
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


# What is timed.


@dataclass(frozen=True)
class Stage:
    """Footage, a folder to work in, and the number of threads."""

    footage: Footage
    work: Path
    jobs: int

    def path(self, name: str) -> str:
        return str(self.footage.folder / name)

    def pattern(self, part: str) -> str:
        return self.path(f"{part}/{part}.#.exr")

    def ours(self, words: Sequence[str], name: str = "shadowtool") -> Rival:
        output = self.work / "ours"
        common = ("-o", str(output), "-q", f"-j{self.jobs}")
        return Rival(name, [*PROGRAM, *words, *common], output)

    def floor(self, name: str, parts: Sequence[str], models: Sequence[Path] = ()) -> Rival:
        """OpenEXR decoding these parts of each frame, and encoding the models for each."""
        files = [self.footage.files(part) for part in parts]
        frames = [[str(file) for file in row] for row in zip(*files, strict=True)]
        output = self.work / "floor"
        spec = {
            "jobs": self.jobs,
            "frames": frames,
            "models": [str(model) for model in models],
            "into": str(output),
        }
        script = str(Path(__file__).with_name("codec.py"))
        return Rival(name, [sys.executable, script, json.dumps(spec)], output)

    def oiiotool(self, words: Sequence[str], name: str = "oiiotool") -> Rival:
        """A command line for each frame of the take, in one process; ``words`` end in -o NAME."""
        output = self.work / "oiiotool"
        frames = ("--frames", f"{FIRST}-{self.footage.last}")
        threads = ("--threads", str(self.jobs))
        target = ("-d", "half", "--compression", "zip", "-o", str(output / "out.#.exr"))
        return self.program(name, ["oiiotool", *threads, *frames, *words, *target], output)

    def program(self, name: str, command: Sequence[str], output: Path) -> Rival:
        missing = "" if shutil.which(command[0]) else f"{command[0]} is not installed"
        return Rival(name, command, output, missing, peer=True)

    def model(self, words: Sequence[str], product: str) -> Path:
        """A file such as the command writes, for the floor to encode."""
        kept = self.work / "models" / f"{words[0]}.{product.replace('/', '.')}"
        if not kept.exists():
            middle = FIRST + self.footage.frames // 2
            rival = self.ours([*words, "--frames", str(middle)])
            taken(rival)
            kept.parent.mkdir(exist_ok=True)
            shutil.copy(rival.output / product.replace("#", str(middle)), kept)
        return kept


def plate_words(stage: Stage, *options: str) -> list[str]:
    return ["plate", stage.path("take"), *options]


def minmax(stage: Stage) -> Row:
    output = stage.work / "peer"
    take = [str(file) for file in stage.footage.files("take")]
    maximum = [take[0]]
    for file in take[1:]:
        maximum += [file, "--max"]
    into = str(output / "max.exr")
    oiiotool = ["oiiotool", "--threads", str(stage.jobs), *maximum, "-o", into]
    magick = ["convert", *take, "-evaluate-sequence", "max", into]
    pattern = stage.path("take/take.%d.exr")
    number = ("-start_number", str(FIRST))
    running = ("-vf", "lagfun=decay=1", "-update", "1")
    ffmpeg = ["ffmpeg", "-v", "error", "-y", *number, "-i", pattern, *running, into]
    return Row(
        "plate --estimator minmax --holdout none",
        stage.footage.frames,
        [
            stage.ours(plate_words(stage, "--estimator", "minmax", "--holdout", "none")),
            stage.floor("decode", ["take"]),
            stage.program("oiiotool --max", oiiotool, output),
            stage.program("ImageMagick max", magick, output),
            stage.program("ffmpeg lagfun", ffmpeg, output),
        ],
        {"decode": 1.25, "oiiotool --max": 1 / 2.5},
    )


def robust(stage: Stage) -> Row:
    return Row(
        "plate",
        stage.footage.frames,
        [stage.ours(plate_words(stage)), stage.floor("decode", ["take"])],
        {"decode": 2.5},
    )


def given_alpha(stage: Stage) -> Row:
    words = ["matte", stage.path("take"), "--plates", stage.path("plates")]
    words += ["--alpha", stage.path("alpha"), "--only", "beta"]
    product = stage.model(words, "beta/beta.#.exr")
    projected = ["--sub", stage.path("span.exr"), "--mul", "--chsum"]
    projected += [stage.path("length.exr"), "--div", "--clamp:min=0:max=1"]
    return Row(
        "matte --alpha --only beta",
        stage.footage.frames,
        [
            stage.ours(words),
            stage.floor("take decoded, encoded", ["take"], [stage.footage.files("take")[0]]),
            stage.floor("own decoded, encoded", ["take", "alpha"], [product]),
            stage.oiiotool([stage.pattern("take"), stage.path("plates/shadow.exr"), *projected]),
        ],
        {"take decoded, encoded": 1.3, "oiiotool": 1 / 3},
    )


def figure(stage: Stage) -> Row:
    # Where the figure is all in the picture.
    first = FIRST + stage.footage.frames // 2
    numbers = [str(first + i) for i in range(6)]
    words = ["matte", stage.path("acted"), "--plates", stage.path("plates")]
    script = str(Path(__file__).with_name("closed_form.py"))
    peer = [sys.executable, script, stage.path("acted"), stage.path("alpha"), *numbers]
    absent = "" if importlib.util.find_spec("pymatting") else "pymatting is not installed"
    return Row(
        "matte, all of it",
        len(numbers),
        [
            stage.ours([*words, "--frames", f"{numbers[0]}-{numbers[-1]}"]),
            Rival("PyMatting closed form", peer, stage.work / "peer", absent, peer=True),
        ],
    )


def composite(stage: Stage) -> Row:
    words = ["composite", "--fg", stage.path("fg"), "--beta-frames", stage.path("beta")]
    words += ["--plates", stage.path("plates"), "--warp", stage.path("warp.exr")]
    product = stage.model(words, "ours.#.exr")
    visibility = [stage.pattern("beta"), "--ch", "Y,Y,Y", "--chnames", "R,G,B"]
    visibility += [stage.path("warp.exr"), "--st_warp:flip_t=1:filter=triangle"]
    shade = [stage.path("span.exr"), "--mul", stage.path("plates/shadow.exr"), "--add"]
    over = ["--ch", "R,G,B,A=1", stage.pattern("fg"), "--swap", "--over", "--ch", "R,G,B"]
    return Row(
        "composite --warp",
        stage.footage.frames,
        [
            stage.ours(words),
            stage.floor("take decoded, encoded", ["take"], [stage.footage.files("take")[0]]),
            stage.floor("own decoded, encoded", ["fg", "beta"], [product]),
            stage.oiiotool([*visibility, *shade, *over]),
        ],
        {"take decoded, encoded": 1.3, "oiiotool": 1 / 3},
    )


def applied(stage: Stage) -> Row:
    words = ["warp", "--map", stage.path("warp.exr"), "--apply"]
    warp = [stage.path("warp.exr"), "--st_warp:flip_t=1:filter=triangle"]
    product = stage.model([*words, stage.path("take")], "take/take.#.exr")
    return Row(
        "warp --apply",
        stage.footage.frames,
        [
            stage.ours([*words, stage.path("take")]),
            stage.floor("own decoded, encoded", ["take"], [product]),
            stage.oiiotool([stage.pattern("take"), *warp]),
        ],
        {"own decoded, encoded": 1.3, "oiiotool": 1 / 3},
    )


def scan(stage: Stage) -> Row:
    return Row(
        "scan",
        stage.footage.frames,
        [
            stage.ours(["scan", stage.path("take"), "--plane", stage.path("plane.png")]),
            stage.floor("decode", ["take"]),
        ],
        {"decode": 1.5},
    )


ROWS: Mapping[str, Callable[[Stage], Row]] = {
    "minmax": minmax,
    "robust": robust,
    "matte": given_alpha,
    "figure": figure,
    "composite": composite,
    "apply": applied,
    "scan": scan,
    "sweep": scan,
}
# How many frames a board takes over a picture of this width at ten pixels a frame.
SWEEP = 200
OTHERS = ("start-up", "growth", "4k")


def prepare_for_oiiotool(footage: Footage) -> None:
    """What does not change from frame to frame: L - S and its squared length."""
    lit, shadow = surface(*footage.size)
    span = lit - shadow
    header = Header(*footage.size)
    write_exr(footage.folder / "span.exr", {"RGB": span}, header)
    write_exr(footage.folder / "length.exr", {"Y": (span**2).sum(axis=-1)}, header)


def show(row: Row, runs: int) -> None:
    """Time a row's rivals in turn, and print their medians beside what is asked."""
    present = [rival for rival in row.rivals if not rival.absent]
    times: dict[str, list[Spent]] = {rival.name: [] for rival in present}
    failed: dict[str, str] = {}
    for turn in range(runs):
        for rival in present:
            if turn > 0 and rival.peer:
                continue
            try:
                times[rival.name].append(taken(rival))
            except RuntimeError as error:
                if not rival.peer:
                    raise
                failed[rival.name] = str(error).splitlines()[-1]
    print(f"\n{row.title}, {row.frames} frames")
    heads = ("", "wall s", "cpu s", "peak MB", "our wall", "our cpu", "asked")
    print(f"  {heads[0]:24}" + "".join(f"{head:>10}" for head in heads[1:]))
    ours = times[present[0].name]
    for rival in row.rivals:
        if absent := rival.absent or failed.get(rival.name):
            print(f"  {rival.name:24}  {absent}")
            continue
        own = times[rival.name]
        middle = [statistics.median(values) for values in zip(*own, strict=True)]
        line = f"  {rival.name:24}{middle[0]:10.2f}{middle[1]:10.2f}{middle[2]:10.0f}"
        if rival is not present[0]:
            # Pair by pair: what else the machine does drifts from turn to turn.
            pairs = list(zip(ours, own, strict=False))
            ratios = [statistics.median(a[i] / b[i] for a, b in pairs) for i in (0, 1)]
            line += f"{ratios[0]:9.2f}x{ratios[1]:9.2f}x"
            if (asked := row.asked.get(rival.name)) is not None:
                verdict = "" if min(ratios) <= asked else " missed"
                line += f"{'≤ ' + format(asked, '.2f'):>9}x{verdict}"
        print(line)
    sys.stdout.flush()


def show_start_up(runs: int) -> None:
    print("\nstart-up, median seconds")
    for words, asked in (("", 0.25), *((name, 0.4) for name in COMMANDS)):
        command = [*PROGRAM, *words.split(), "--help"]
        wall = statistics.median(spent(command).wall for _ in range(2 * runs + 1))
        verdict = "" if wall < asked else " missed"
        print(f"  shadowtool {words + ' --help':20}{wall:6.2f}  < {asked}{verdict}")
    sys.stdout.flush()


def show_peaks(title: str, stages: Sequence[Stage], names: Sequence[str], limit: float = 0) -> None:
    """Time and peak memory of our command alone, for each set of footage."""
    print(f"\n{title}")
    for name in names:
        parts = []
        for stage in stages:
            mine = taken(ROWS[name](stage).rivals[0])
            frames = stage.footage.frames
            milliseconds = 1000 * mine.cpu / frames
            verdict = " missed" if limit and mine.peak > limit else ""
            parts.append(
                f"{frames} frames: {mine.peak:5.0f} MB, {milliseconds:6.1f} ms of cpu a frame"
                + verdict
            )
        print(f"  {name:12}" + "; ".join(parts))
    sys.stdout.flush()


def main() -> None:
    choices = (*ROWS, *OTHERS)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=_Formatter)
    parser.add_argument("--rows", default=",".join(choices), help=f"of {', '.join(choices)}")
    parser.add_argument("--runs", type=int, default=3, help="of each rival; the median counts")
    parser.add_argument("--frames", type=int, default=60, help="of 1920x1080")
    parser.add_argument("--jobs", type=int, default=2, help="threads of all rivals")
    parser.add_argument("--footage", type=Path, help="a folder to keep footage in, made if absent")
    options = parser.parse_args()
    wanted = options.rows.split(",")
    if unknown := set(wanted) - set(choices):
        parser.error(f"no such rows: {', '.join(sorted(unknown))}")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)

        def stage(size: tuple[int, int], frames: int) -> Stage:
            folder = (options.footage or work) / f"{size[0]}x{size[1]}-{frames}"
            footage = Footage(folder, size, frames)
            if not (folder / "length.exr").exists():
                # In a process of its own: what this one has held counts as held by its children.
                apart = multiprocessing.get_context("spawn")
                with ProcessPoolExecutor(1, apart) as pool:
                    pool.submit(make_footage, folder, size, frames).result()
                    pool.submit(prepare_for_oiiotool, footage).result()
            own = work / f"work-{size[0]}-{frames}"
            own.mkdir(exist_ok=True)
            return Stage(footage, own, options.jobs)

        print(f"{options.jobs} threads, {len(os.sched_getaffinity(0))} CPUs, {options.runs} runs")
        if shutil.which("oiiotool") is None:
            print("oiiotool is not installed (Debian: openimageio-tools): its rows are left out")
        if "start-up" in wanted:
            show_start_up(options.runs)
        for row in ROWS:
            if row in wanted:
                size = QUARTER if row == "figure" else FULL_HD
                frames = SWEEP if row == "sweep" else options.frames
                show(ROWS[row](stage(size, frames)), options.runs)
        if "growth" in wanted:
            small = [stage(SMALL, frames) for frames in (50, 1000)]
            names = [name for name in ROWS if name not in ("figure", "sweep")]
            show_peaks("growth, 192x108: memory is to stay flat", small, names)
        if "4k" in wanted:
            large = [stage(FOUR_K, 12)]
            names = [name for name in ROWS if name != "sweep"]
            show_peaks("3840x2160: below 1200 MB", large, names, 1200)


class _Formatter(argparse.RawDescriptionHelpFormatter, argparse.ArgumentDefaultsHelpFormatter):
    pass


if __name__ == "__main__":
    main()
