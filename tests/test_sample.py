"""The sample shot, made with the README's commands as they are written there."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "sample_data"
# Decibels by which ours must be nearer to the reference than what it is held against.
LEAST_GAIN = 3.0


def commands() -> list[str]:
    """The shell blocks of the README's walk through a shot."""
    text = (ROOT / "README.md").read_text()
    walk = re.search(r"\n## A shot, step by step\n(.*?)\n## ", text, re.DOTALL)
    assert walk
    return re.findall(r"```sh\n(.*?)```", walk[1], re.DOTALL)


def compare_module() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compare", SAMPLE / "compare.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def shot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("a shot")
    for name in ("footage", "plane.png"):
        (folder / name).symlink_to(SAMPLE / name)
    program = shutil.which("shadowtool", path=str(Path(sys.executable).parent))
    assert program, "the package is not installed"
    path = f"{Path(program).parent}{os.pathsep}{os.environ['PATH']}"
    for block in commands():
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block],
            cwd=folder,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{block}\n{done.stderr}"
    return folder


@pytest.mark.parametrize("frame", sorted(SAMPLE.glob("truth/reference.*.exr")))
def test_the_composite_is_nearer_to_the_truth_than_without_shadow_or_warp(
    shot: Path, frame: Path
) -> None:
    number = int(frame.name.split(".")[1])
    figures, _ = compare_module().compare(shot, SAMPLE / "truth", number)
    assert figures["ours"] > figures["no shadow"] + LEAST_GAIN
    assert figures["ours"] > figures["no warp"] + LEAST_GAIN


def test_ten_bits_stay_ten(shot: Path) -> None:
    import numpy as np

    from shadowtool.core.transfer import encode_rec709
    from shadowtool.io.image import read_image

    pixels = read_image(shot / "source" / "source.1001.exr").rgb().astype(np.float32)
    levels = np.unique(np.rint(encode_rec709(pixels) * 876))
    assert len(levels) > 400
