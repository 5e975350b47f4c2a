"""What plates tell of a take, and what a marked plane decides, from files."""

from pathlib import Path

import numpy as np
import pytest

from shadowtool.choices import Estimator
from shadowtool.io.image import to_code, write_exr, write_png
from shadowtool.steps.plate import plate
from shadowtool.steps.run import Run
from tests.conftest import HEIGHT, PLANE, WIDTH, shaded, soft_band, write_frames
from tests.scene import Scene

SCENE = Scene()


def crossed() -> list[np.ndarray]:
    """A shadow that crosses the picture in twelve frames."""
    return [shaded(soft_band(6 * number - 9), number) for number in range(12)]


def test_one_frame_is_told_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    take = write_frames(tmp_path / "take", crossed()[:1])
    plate(take, tmp_path / "plates")
    assert "one frame shows no moving shadow" in caplog.text


def test_pixels_that_no_frame_shows_are_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pictures = crossed()
    for picture in pictures:
        picture[3:5, 4:8] = np.nan
    take = write_frames(tmp_path / "take", pictures)
    assert plate(take, tmp_path / "plates").figures["unseen"] == 8
    assert "8 pixels (0.52%) were seen in no frame" in caplog.text


def test_a_marked_plane_decides_how_its_pixels_are_read(tmp_path: Path) -> None:
    covered = [np.full((HEIGHT, WIDTH), float(not 6 <= number < 12)) for number in range(18)]
    take = write_frames(tmp_path / "take", (shaded(beta, n) for n, beta in enumerate(covered)))
    read = [
        plate(take, tmp_path / name, plane=plane, holdout="none").figures["read_as"]
        for name, plane in (("card", None), ("plane", PLANE))
    ]
    assert read == ["a scene under a card", "a plane that a shadow crossed"]


def test_plates_are_made_anew_with_another_plane(tmp_path: Path) -> None:
    take, mask = write_frames(tmp_path / "take", crossed()), tmp_path / "mask.png"
    kept = []
    for left in (20, 0, 0):
        marked = np.zeros((HEIGHT, WIDTH), np.uint8)
        marked[:, left:] = 255
        write_png(mask, marked)
        result = plate(take, tmp_path / "plates", plane=str(mask), run=Run(resume=True))
        kept.append(bool(result.kept))
    assert kept == [False, False, True]


@pytest.mark.parametrize("estimator", ["robust", "minmax"])
@pytest.mark.parametrize("suffix", [".exr", ".png"])
@pytest.mark.parametrize("clipped", [False, True])
def test_clipped_light_is_told_of(
    estimator: Estimator,
    suffix: str,
    clipped: bool,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder = tmp_path / "take"
    folder.mkdir()
    gain = 1 / np.quantile(SCENE.lit, 0.8 if clipped else 1) / (1 if clipped else 1.1)
    for number in range(12):
        under = SCENE.image(SCENE.disk(20.0 + 10 * number, 40, 15))
        light = np.minimum(gain * SCENE.noisy(under, number), 1)
        if suffix == ".png":
            write_png(folder / f"take.{1001 + number}.png", to_code(light))
        else:
            write_exr(folder / f"take.{1001 + number}.exr", {"RGB": light.astype(np.float16)})
    result = plate(folder, tmp_path / "plates", estimator=estimator, holdout="none")
    part = (gain * SCENE.lit >= 1).any(axis=-1).mean()
    assert result.figures["clipped"] == pytest.approx(part, abs=0.05)
    assert ("of the picture is clipped" in caplog.text) == clipped
