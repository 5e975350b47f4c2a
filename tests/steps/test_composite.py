"""Figure and shadow in the target scene, from files."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shadowtool.choices import Fill
from shadowtool.core.beta import inpaint
from shadowtool.core.compositing import over, shade
from shadowtool.core.warp_map import WarpMap, identity_map
from shadowtool.errors import InputError
from shadowtool.io.image import Header, read_image, write_exr, write_png
from shadowtool.io.products import WARP, write_warp
from shadowtool.steps.composite import composite
from shadowtool.steps.run import Run
from tests.scene import Scene

SCENE = Scene(60, 90)
HEADER = Header(SCENE.width, SCENE.height)
BETA = SCENE.disk(40, 30).astype(np.float16)


def put(tmp_path: Path, figure: np.ndarray, suffix: str = ".exr") -> np.ndarray:
    """The composite with this figure, (H, W, 4)."""
    for part in ("plates", "matte/fg", "matte/beta"):
        (tmp_path / part).mkdir(parents=True)
    for name in ("lit", "shadow"):
        write_exr(tmp_path / "plates" / f"{name}.exr", {"RGB": getattr(SCENE, name)}, HEADER)
    write_exr(tmp_path / "matte" / "beta" / "beta.1001.exr", {"Y": BETA}, HEADER)
    place = tmp_path / "matte" / "fg" / f"fg.1001{suffix}"
    if suffix == ".png":
        write_png(place, figure)
    else:
        write_exr(place, {"RGBA": figure}, HEADER)
    composite(tmp_path / "matte", tmp_path / "out", plates=tmp_path / "plates")
    return read_image(tmp_path / "out" / "out.1001.exr").layers["RGB"]


def expected(figure: np.ndarray) -> np.ndarray:
    behind = shade(SCENE.lit, SCENE.shadow, BETA.astype(np.float32))
    single = figure.astype(np.float32)
    return over(single[..., :3], single[..., 3], behind).astype(np.float16)


def empty() -> np.ndarray:
    return np.zeros((SCENE.height, SCENE.width, 4), np.float16)


def spots() -> np.ndarray:
    """Two small figures far apart, and light that hides nothing."""
    figure = empty()
    figure[3:6, 80:83] = (0.2, 0.3, 0.1, 0.5)
    figure[50:55, 4:9] = (0.4, 0.4, 0.4, 1)
    figure[40, 60] = (0, 0.25, 0, 0)
    return figure


@pytest.mark.parametrize("figure", [empty(), spots(), spots().astype(np.float32)])
def test_every_pixel_is_figure_over_shaded_ground(tmp_path: Path, figure: np.ndarray) -> None:
    assert np.array_equal(put(tmp_path, figure), expected(figure))


def test_a_figure_that_is_no_number_is_nothing(tmp_path: Path) -> None:
    figure = spots()
    figure[52, 6, 1], figure[4, 81, 3], figure[20, 20, 0] = np.nan, np.inf, -np.inf
    clean = spots()
    clean[52, 6] = clean[4, 81] = clean[20, 20] = 0
    assert np.array_equal(put(tmp_path, figure), expected(clean))


def test_a_figure_of_code_values_is_found_too(tmp_path: Path) -> None:
    codes = np.zeros((SCENE.height, SCENE.width, 4), np.uint8)
    codes[30:40, 70:75] = 255
    white = empty()
    white[30:40, 70:75] = 1
    assert put(tmp_path, codes, ".png") == pytest.approx(expected(white), abs=1e-3)


@pytest.mark.parametrize("alpha", [0, 0.5, 1])
def test_beta_may_come_with_an_alpha(tmp_path: Path, alpha: float) -> None:
    plain = put(tmp_path / "plain", spots())
    folder = tmp_path / "nuke"
    folder.mkdir()
    rgba = np.repeat(BETA[..., np.newaxis], 4, axis=-1)
    rgba[..., 3] = alpha
    # Other programs keep what was written into a file of ours.
    ours = {"command": "shadowtool matte frames=a --plates=b"}
    write_exr(folder / "beta.1001.exr", {"RGBA": rgba}, HEADER, ours)
    mattes, plates = tmp_path / "plain" / "matte", tmp_path / "plain" / "plates"
    composite(mattes, tmp_path / ".out", plates=plates, beta=folder)
    # A name that begins with a dot would hide the frames.
    assert np.array_equal(read_image(tmp_path / ".out" / "out.1001.exr").layers["RGB"], plain)


def test_what_plates_in_png_are_taken_for_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(tmp_path, spots())
    (tmp_path / "coded").mkdir()
    for name in ("lit", "shadow"):
        codes = np.full((SCENE.height, SCENE.width, 3), 128, np.uint8)
        write_png(tmp_path / "coded" / f"{name}.png", codes)
    composite(tmp_path / "matte", tmp_path / "again", plates=tmp_path / "coded")
    assert "coded: PNG is taken as srgb" in caplog.text


def with_holes() -> np.ndarray:
    beta = BETA.astype(np.float32)
    beta[25:30, 38:44] = np.nan
    return beta


def again(tmp_path: Path, beta: np.ndarray, fill: Fill = "lit") -> np.ndarray:
    """The composite without a figure under this β, (H, W) or (H, W, 3)."""
    put(tmp_path, empty())
    layer = "Y" if beta.ndim == 2 else "RGB"
    half = beta.astype(np.float16)
    write_exr(tmp_path / "matte" / "beta" / "beta.1001.exr", {layer: half}, HEADER)
    result = composite(
        tmp_path / "matte", tmp_path / "again", plates=tmp_path / "plates", fill=fill
    )
    assert result.figures["unknown"] == np.isnan(with_holes()).sum()
    return read_image(tmp_path / "again" / "again.1001.exr").layers["RGB"]


FILLED: list[tuple[Fill, Callable[[np.ndarray], np.ndarray]]] = [
    ("lit", lambda beta: np.nan_to_num(beta, nan=1)),
    ("inpaint", inpaint),
    ("none", np.copy),
]


@pytest.mark.parametrize(("fill", "filled"), FILLED)
def test_what_unknown_beta_becomes(
    tmp_path: Path, fill: Fill, filled: Callable[[np.ndarray], np.ndarray]
) -> None:
    beta = with_holes()
    wanted = shade(SCENE.lit, SCENE.shadow, filled(beta)).astype(np.float16)
    assert np.array_equal(again(tmp_path, beta, fill), wanted, equal_nan=True)


@pytest.mark.parametrize(("fill", "filled"), FILLED)
def test_unknown_beta_is_filled_in_each_channel(
    tmp_path: Path, fill: Fill, filled: Callable[[np.ndarray], np.ndarray]
) -> None:
    gray = with_holes()
    beta = np.dstack([gray, np.sqrt(gray), gray**2]).astype(np.float16).astype(np.float32)
    whole = np.dstack([filled(beta[..., channel]) for channel in range(3)])
    wanted = shade(SCENE.lit, SCENE.shadow, whole).astype(np.float16)
    assert np.array_equal(again(tmp_path, beta, fill), wanted, equal_nan=True)


def test_png_holds_the_same_light(tmp_path: Path) -> None:
    light = np.minimum(put(tmp_path, spots()), 1)
    mattes, plates = tmp_path / "matte", tmp_path / "plates"
    composite(mattes, tmp_path / "coded", plates=plates, file_format="png")
    image = read_image(tmp_path / "coded" / "coded.1001.png")
    assert image.layers["RGB"].dtype == np.uint16
    assert image.rgb() == pytest.approx(light, abs=1e-3)


def test_unknown_pixels_of_plates_are_continued_from_around_and_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    whole = put(tmp_path, empty())
    lit = SCENE.lit.copy()
    lit[10:12, 20:23] = np.nan
    write_exr(tmp_path / "plates" / "lit.exr", {"RGB": lit}, HEADER)
    composite(tmp_path / "matte", tmp_path / "again", plates=tmp_path / "plates")
    assert "plates: 6 pixels of the plates are unknown" in caplog.text
    found = read_image(tmp_path / "again" / "again.1001.exr").layers["RGB"]
    hole = np.isnan(lit).any(axis=-1)
    assert np.array_equal(found[~hole], whole[~hole])
    assert found[hole] == pytest.approx(whole[hole], rel=0.5)


def test_what_a_map_takes_from_outside_the_picture_is_lit(tmp_path: Path) -> None:
    put(tmp_path, empty())
    dark = np.zeros_like(BETA)
    write_exr(tmp_path / "matte" / "beta" / "beta.1001.exr", {"Y": dark}, HEADER)
    aside = identity_map(SCENE.height, SCENE.width) + np.float32([20, 0])
    stmap = tmp_path / WARP
    write_warp(stmap, WarpMap(aside, np.zeros(dark.shape, np.float32)), HEADER, {})
    composite(tmp_path / "matte", tmp_path / "again", plates=tmp_path / "plates", warp=stmap)
    found = read_image(tmp_path / "again" / "again.1001.exr").layers["RGB"]
    assert found[:, -19:] == pytest.approx(SCENE.lit[:, -19:], rel=2e-3)
    assert found[:, :-21] == pytest.approx(SCENE.shadow[:, :-21], rel=2e-3)


@pytest.mark.parametrize("lacking", ["fg", "beta"])
def test_frames_that_only_figure_or_shadow_has_are_missing(tmp_path: Path, lacking: str) -> None:
    put(tmp_path, empty())
    other = {"fg": "beta", "beta": "fg"}[lacking]
    folder = tmp_path / "matte" / other
    shutil.copy(folder / f"{other}.1001.exr", folder / f"{other}.1002.exr")
    arguments = {"plates": tmp_path / "plates"}
    with pytest.raises(InputError, match=f"{lacking}.*no frame 1002"):
        composite(tmp_path / "matte", tmp_path / "again", **arguments)
    run = Run(missing="skip")
    result = composite(tmp_path / "matte", tmp_path / "again", run=run, **arguments)
    assert (result.frames, result.skipped) == ([1001], [1002])
