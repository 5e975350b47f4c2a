"""Frames seen through a map that is there."""

import json
from pathlib import Path

import numpy as np
import pytest

from shadowtool.core.warp_map import WarpMap, identity_map
from shadowtool.io.image import Header, read_image, write_exr, write_png
from shadowtool.io.products import write_warp
from shadowtool.steps.warp import warp

WIDTH, HEIGHT = 64, 40
HEADER = Header(WIDTH, HEIGHT)


@pytest.fixture
def identity(tmp_path: Path) -> Path:
    found = WarpMap(identity_map(HEIGHT, WIDTH), np.zeros((HEIGHT, WIDTH), np.float32))
    write_warp(tmp_path / "map.exr", found, HEADER, {})
    return tmp_path / "map.exr"


def grain() -> np.ndarray:
    return np.random.default_rng(0).random((HEIGHT, WIDTH, 3)).astype(np.float16)


def smooth() -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), 0.5, np.float16)


def test_a_pictures_alpha_is_warped_with_it(
    identity: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8)
    (tmp_path / "take").mkdir()
    write_png(tmp_path / "take" / "take.1001.png", picture)
    warp([], tmp_path / "out", map_file=identity, apply_to=tmp_path / "take")
    found = read_image(tmp_path / "out" / "take" / "take.1001.exr").layers["RGBA"]
    assert np.abs(found - picture / 255).max() < 1e-3
    assert "code values are written to EXR as they are" in caplog.text


@pytest.mark.parametrize("picture", [grain(), smooth()])
def test_the_identity_leaves_all_as_it_is(
    identity: Path, tmp_path: Path, picture: np.ndarray
) -> None:
    (tmp_path / "take").mkdir()
    write_exr(tmp_path / "take" / "take.1001.exr", {"RGB": picture}, HEADER)
    warp([], tmp_path / "out", map_file=identity, apply_to=tmp_path / "take")
    found = read_image(tmp_path / "out" / "take" / "take.1001.exr").layers["RGB"]
    assert found.dtype == np.float16
    assert found == pytest.approx(picture, abs=1e-3)


def test_bad_pixels_stay_where_they_are_and_are_counted(identity: Path, tmp_path: Path) -> None:
    picture = smooth()
    picture[10, 20, 1], picture[30, 5] = np.nan, np.inf
    (tmp_path / "take").mkdir()
    write_exr(tmp_path / "take" / "take.1001.exr", {"RGB": picture}, HEADER)
    (result,) = warp([], tmp_path / "out", map_file=identity, apply_to=tmp_path / "take")
    found = read_image(tmp_path / "out" / "take" / "take.1001.exr").layers["RGB"]
    bad = np.argwhere(~np.isfinite(found).all(axis=-1))
    assert bad.tolist() == [[10, 20], [30, 5]]
    record = json.loads((tmp_path / "out" / "shadowtool.json").read_text())
    assert record["frames"]["1001"]["not_finite"] == 2
    assert result.frames == [1001]


@pytest.mark.parametrize(("picture", "expected"), [(grain(), True), (smooth(), False)])
def test_grain_is_written_without_a_long_search(
    identity: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    picture: np.ndarray,
    expected: bool,
) -> None:
    said: list[bool] = []

    def write(path, channels, header, provenance, quick):
        said.append(quick)
        write_exr(path, channels, header, provenance, quick)

    (tmp_path / "take").mkdir()
    # Without attributes, which take up most of so small a file.
    write_exr(tmp_path / "take" / "take.1001.exr", {"RGB": picture})
    monkeypatch.setattr("shadowtool.steps.warp.write_exr", write)
    warp([], tmp_path / "out", map_file=identity, apply_to=tmp_path / "take")
    assert said == [expected]


def test_a_map_fits_pictures_of_any_size(tmp_path: Path) -> None:
    aside = identity_map(HEIGHT, WIDTH) + np.float32([2, 0])
    found = WarpMap(aside, np.zeros((HEIGHT, WIDTH), np.float32))
    write_warp(tmp_path / "map.exr", found, HEADER, {})
    (tmp_path / "take").mkdir()
    y, x = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH].astype(np.float32)
    write_exr(tmp_path / "take" / "take.1001.exr", {"x": x, "y": y})
    options = {"map_file": tmp_path / "map.exr", "apply_to": tmp_path / "take"}
    warp([], tmp_path / "out", outside=-1, **options)
    layers = read_image(tmp_path / "out" / "take" / "take.1001.exr").layers
    # A pixel of the map, two to the right, is the middle of four pixels of the picture.
    inside = np.s_[:, : WIDTH - 2]
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    assert layers["x"][inside] == pytest.approx(2 * (x + 2)[inside] + 0.5, abs=1e-4)
    assert layers["y"][inside] == pytest.approx(2 * y[inside] + 0.5, abs=1e-4)
    assert (layers["x"][:, WIDTH - 2 :] == -1).all()
