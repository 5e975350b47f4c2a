"""Kill every step at random moments, again and again, and see that nothing is lost.

    python -m tests.soak [--kills 200] [--seed 1] [--jobs 2]

After each kill: what stands under its final name is whole, SIGTERM and SIGINT left nothing else
behind and ended with 143 and 130, --resume finishes, and the result is that of an undisturbed run,
byte for byte. Some runs are killed again while they resume.
"""

import argparse
import json
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shadowtool.io.image import Header, read_image, write_exr, write_png

PROGRAM = [sys.executable, "-c", "from shadowtool.cli import main; main()"]
SIGNALS = {signal.SIGTERM: 143, signal.SIGINT: 130, signal.SIGKILL: -signal.SIGKILL}
HIDDEN = ".shadowtool-*"


class LostError(AssertionError):
    """Something was lost, left behind or wrong."""


@dataclass(frozen=True)
class Fault:
    """One kill: which step, by which signal, after what part of its time; and once more?"""

    step: str
    number: signal.Signals
    moment: float
    again: float | None = None

    def __str__(self) -> str:
        return f"{self.step} {self.number.name} at {self.moment:.3f}, again at {self.again}"


def make_footage(folder: Path, width: int, height: int, frames: int) -> Mapping[str, list[str]]:
    """A small shot; the words of every step that works on it, without -o."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    rng = np.random.default_rng(1)
    lit = (0.4 + 0.2 * rng.random((height, width, 1))) * np.array([1, 0.9, 0.8])
    shadow = lit * np.array([0.25, 0.3, 0.4])
    header = Header(width, height)

    def take(name: str, across: np.ndarray, extent: int) -> None:
        target = folder / name
        target.mkdir()
        for number in range(frames):
            middle = (1.4 * number / (frames - 1) - 0.2) * extent
            beta = np.clip((np.abs(across - middle) - 0.12 * extent) / 4, 0, 1)[..., None]
            noise = rng.normal(0, 0.003, lit.shape)
            picture = (beta * lit + (1 - beta) * shadow + noise).astype(np.float16)
            write_exr(target / f"{name}.{1001 + number}.exr", {"RGB": picture}, header)

    take("take", x, width)
    take("other", y + 0.05 * x, height)
    plane = folder / "plane.png"
    write_png(plane, np.full((height, width), 255, np.uint8))
    for name in ("take", "other"):
        run(["scan", str(folder / name), "--plane", str(plane)], folder / f"scan_{name}")
    scans = [str(folder / f"scan_{name}") for name in ("take", "other")]
    run(["plate", str(folder / "take")], folder / "plates")
    run(["warp", *scans], folder / "warp")
    source, plates, matte = (str(folder / name) for name in ("take", "plates", "matte"))
    run(["matte", source, "--plates", plates], folder / "matte")
    found = str(folder / "warp" / "warp.exr")
    return {
        "capture": ["capture", source],
        "plate": ["plate", source],
        "minmax": ["plate", source, "--estimator", "minmax", "--holdout", "none"],
        "matte": ["matte", source, "--plates", plates],
        "scan": ["scan", source, "--plane", str(plane)],
        "warp": ["warp", *scans],
        "apply": ["warp", "--map", found, "--apply", f"{matte}/beta"],
        "composite": ["composite", matte, "--plates", plates, "--warp", found, "--ratio"],
    }


def run(words: list[str], output: Path) -> None:
    done = subprocess.run(
        [*PROGRAM, *words, "-o", str(output), "-q"], capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise LostError(f"{words[0]} ended with {done.returncode}: {done.stderr}")


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Soak:
    """The steps, and for each what an undisturbed run leaves and how long it takes."""

    def __init__(self, folder: Path, size: tuple[int, int], frames: int, jobs: int) -> None:
        self.folder = folder
        source = folder / "footage"
        source.mkdir()
        words = make_footage(source, *size, frames)
        self.words = {step: [*own, f"-j{jobs}"] for step, own in words.items()}
        self.whole: dict[str, dict[str, bytes]] = {}
        self.seconds: dict[str, float] = {}

    @property
    def steps(self) -> tuple[str, ...]:
        return tuple(self.words)

    def survive(self, fault: Fault) -> int:
        """Do it, and see that nothing is lost; the exit code of the killed run.

        Raises:
            LostError: something is.
        """
        output = self.folder / fault.step
        if fault.step not in self.whole:
            start = time.monotonic()
            run(self.words[fault.step], output)
            self.seconds[fault.step] = time.monotonic() - start
            self.whole[fault.step] = tree(output)
        shutil.rmtree(output, ignore_errors=True)
        code = self._kill(fault, fault.moment, output, [])
        if fault.again is not None:
            self._kill(fault, fault.again, output, ["--resume"])
        run([*self.words[fault.step], "--resume"], output)
        if tree(output) != self.whole[fault.step]:
            left, expected = tree(output), self.whole[fault.step]
            names = sorted(
                name for name in {*left, *expected} if left.get(name) != expected.get(name)
            )
            raise LostError(f"{fault}: differs from an undisturbed run in {names}")
        return code

    def _kill(self, fault: Fault, moment: float, output: Path, options: list[str]) -> int:
        process = self._struck(fault, moment, output, options)
        _, said = process.communicate(timeout=120)
        code = process.returncode
        # Until Python is up, signals are its own affair; after the last act they change nothing.
        early = not output.exists() or code == -fault.number or b"KeyboardInterrupt" in said
        if not early and (code not in (0, SIGNALS[fault.number]) or b"Traceback" in said):
            raise LostError(f"{fault}: exit code {code}: {said.decode()}")
        if fault.number != signal.SIGKILL and list(output.rglob(HIDDEN)):
            raise LostError(f"{fault}: left {list(output.rglob(HIDDEN))}")
        for path in sorted(output.rglob("*")):
            if path.is_file() and not path.match(HIDDEN):
                if path.suffix == ".json":
                    json.loads(path.read_bytes())
                else:
                    read_image(path)
        return code

    def _struck(
        self, fault: Fault, moment: float, output: Path, options: list[str]
    ) -> subprocess.Popen[bytes]:
        """A process that was still running when the signal was sent."""
        before = tree(output)
        for _ in range(40):
            process = subprocess.Popen(
                [*PROGRAM, *self.words[fault.step], "-o", str(output), "-q", *options],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                # Whoever starts this in the background ignores SIGINT.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )
            time.sleep(moment * self.seconds[fault.step])
            if process.poll() is None:
                process.send_signal(fault.number)
                return process
            process.communicate()
            # The machine has become faster since the step was timed.
            self.seconds[fault.step] *= 0.9
            shutil.rmtree(output, ignore_errors=True)
            for name, data in before.items():
                path = output / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
        raise LostError(f"{fault}: ends before it can be killed")


def random_faults(steps: tuple[str, ...], count: int, seed: int) -> Iterator[Fault]:
    """Each step by each signal in turn, at moments that the seed decides."""
    chance = random.Random(seed)
    numbers = list(SIGNALS)
    for index in range(count):
        step = steps[index % len(steps)]
        number = numbers[(index // len(steps)) % len(numbers)]
        again = chance.uniform(0.1, 1) if chance.random() < 0.25 else None
        yield Fault(step, number, chance.uniform(0.1, 1), again)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    tried, survived, codes = 0, 0, Counter[int]()
    with tempfile.TemporaryDirectory() as name:
        soak = Soak(Path(name), (256, 144), 24, options.jobs)
        for fault in random_faults(soak.steps, options.kills, options.seed):
            tried += 1 + (fault.again is not None)
            try:
                codes[soak.survive(fault)] += 1
                survived += 1 + (fault.again is not None)
            except LostError as error:
                print(f"lost: {error}", flush=True)
            if tried % 20 < 2:
                print(f"{tried} kills, {survived} survived", flush=True)
    print("exit codes of the killed: " + ", ".join(f"{c}: {n}" for c, n in sorted(codes.items())))
    print(f"faults tried: {tried}, survived: {survived}")
    sys.exit(0 if survived == tried else 1)


if __name__ == "__main__":
    main()
