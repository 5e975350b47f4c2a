"""Plates and β from footage on disk: a take of a small scene whose truth is known."""

import json
import shutil
from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from shadowtool.choices import Estimator, Steady
from shadowtool.core.beta import inverse_span, shadow_matte
from shadowtool.core.plates import ExtremePlates, Plates
from shadowtool.errors import InputError, OptionError
from shadowtool.io.image import Header, Image, read_image, write_exr, write_png
from shadowtool.io.products import MANIFEST, read_plates
from shadowtool.steps.composite import composite
from shadowtool.steps.matte import matte
from shadowtool.steps.plate import plate
from shadowtool.steps.run import Run
from tests.scene import Scene, smoothstep, waves

HEIGHT, WIDTH, FRAMES, FIRST = 54, 96, 30, 1001
SCENE = Scene(HEIGHT, WIDTH, rows=(0, 0), columns=(0, 0))
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(float)
NUMBERS = range(FIRST, FIRST + FRAMES)
DIP = range(FIRST + 10, FIRST + 20)


def band_beta(number: int) -> np.ndarray:
    """β of a shadow that passes over the lower half of the picture."""
    middle = -22 + 4.8 * (number - FIRST)
    beside = smoothstep((np.abs(COLUMNS - middle) - 12) / 3 + 0.5)
    above = smoothstep((32 - ROWS) / 3 + 0.5)
    return np.maximum(beside, above).astype(np.float32)


def figure_alpha(number: int) -> np.ndarray:
    left = 4 + 2.7 * (number - FIRST)
    return ((left <= COLUMNS) & (left + 9 > COLUMNS) & (ROWS >= 6) & (ROWS < 32)).astype(np.float32)


def picture(number: int, figure: bool = False, gain: float = 1.0) -> np.ndarray:
    """A frame of the take, (H, W, 3) half."""
    image = SCENE.image(band_beta(number))
    if figure:
        colour = np.where((ROWS < 15)[..., None], (0.9, 0.05, 0.05), (0.02, 0.3, 0.9))
        image = np.where(figure_alpha(number)[..., None] > 0, colour, image)
    return (SCENE.noisy(image, number) * np.float32(gain)).astype(np.float16)


def write_frames(folder: Path, pictures: Iterable[np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    for number, image in enumerate(pictures, start=FIRST):
        write_exr(folder / f"{folder.name}.{number}.exr", {"RGB": image}, Header(WIDTH, HEIGHT))
    return folder


def write_mattes(folder: Path, mattes: Iterable[np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    for number, alpha in enumerate(mattes, start=FIRST):
        write_png(folder / f"{folder.name}.{number}.png", (alpha * 255).astype(np.uint8))
    return folder


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The take with a figure, without one, and without one but with a dip in exposure."""
    folder = tmp_path_factory.mktemp("takes")
    write_frames(folder / "walk", (picture(n, figure=True) for n in NUMBERS))
    write_frames(folder / "plain", (picture(n) for n in NUMBERS))
    dipped = (picture(n, gain=0.9 if n in DIP else 1.0) for n in NUMBERS)
    write_frames(folder / "dip", dipped)
    return folder


@pytest.fixture(scope="module")
def walk_plates(takes: Path) -> Path:
    """The plates of the take with a figure; nobody writes here."""
    folder = takes / "walk-plates" / "plates"
    plate(takes / "walk", folder, run=Run(jobs=3))
    return folder


@pytest.fixture(scope="module")
def level_plates(takes: Path) -> Path:
    """The plates of the takes without and with a dip in exposure; nobody writes here."""
    for name in ("plain", "dip"):
        plate(takes / name, takes / "level" / name, holdout="none", read_as="plane")
    return takes / "level"


def plates_of(folder: Path) -> Plates:
    return read_plates(folder).plates


def figures_of(folder: Path) -> dict:
    return json.loads((folder / MANIFEST).read_text())["figures"]


def error(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """As a part of the true value, (H, W)."""
    return np.abs(np.log(found.sum(axis=-1) / truth.sum(axis=-1)))


def held_out(folder: Path) -> list[np.ndarray]:
    return [read_image(folder / "holdout" / f"holdout.{n}.png").plane("Y") > 0 for n in NUMBERS]


def beta_of(folder: Path, number: int) -> np.ndarray:
    image = read_image(folder / "beta" / f"beta.{number}.exr")
    colour = image.layers.get("RGB")
    return image.plane("Y") if colour is None else colour.astype(np.float32)


def test_plates_keep_the_figure_out_and_find_the_shadow(takes: Path, tmp_path: Path) -> None:
    result = plate(takes / "walk", tmp_path / "plates")
    found = plates_of(tmp_path / "plates")
    assert error(found.lit, SCENE.lit).mean() < 0.005
    assert error(found.lit, SCENE.lit).max() < 0.05
    swept = ROWS > 35
    assert error(found.shadow, SCENE.shadow)[swept].mean() < 0.02
    assert error(found.shadow, SCENE.shadow).mean() < 0.06
    masks = held_out(tmp_path / "plates")
    assert len(list((tmp_path / "plates" / "holdout").iterdir())) == FRAMES
    for number, mask in zip(NUMBERS, masks, strict=True):
        assert mask[figure_alpha(number) > 0].mean() >= 0.98
    assert np.mean(masks) < 0.2
    assert result.figures["held_out"] == "holdout"
    assert result.figures["read_as"] == "a plane that a shadow crossed"


def test_what_was_held_out_can_be_given_back(
    takes: Path, walk_plates: Path, tmp_path: Path
) -> None:
    plate(takes / "walk", tmp_path / "given", holdout=walk_plates / "holdout")
    auto, given = plates_of(walk_plates), plates_of(tmp_path / "given")
    assert np.array_equal(auto.lit, given.lit)
    assert np.array_equal(auto.shadow, given.shadow)
    assert not (tmp_path / "given" / "holdout").exists()


def test_a_take_without_a_figure_holds_nothing_out(
    takes: Path, level_plates: Path, tmp_path: Path
) -> None:
    plate(takes / "plain", tmp_path / "auto", read_as="plane")
    assert not np.any(held_out(tmp_path / "auto"))
    auto, none = plates_of(tmp_path / "auto"), plates_of(level_plates / "plain")
    assert np.array_equal(auto.lit, none.lit) and np.array_equal(auto.shadow, none.shadow)
    assert not (level_plates / "plain" / "holdout").exists()


def test_the_matte_of_a_take_is_the_shadow_that_fell(
    takes: Path, walk_plates: Path, tmp_path: Path
) -> None:
    matte(takes / "walk", tmp_path / "matte", plates=walk_plates)
    for number in NUMBERS[::6]:
        beta, truth = beta_of(tmp_path / "matte", number), band_beta(number)
        visible = figure_alpha(number) == 0
        assert np.abs(beta - truth)[visible].mean() < 0.01
        assert beta.min() >= 0 and beta.max() <= 1
        # At its rim the figure may be taken to reach a little further than it does.
        near = cv2.dilate(figure_alpha(number), np.ones((9, 9))) > 0
        assert (beta[~near & (truth == 1)] == 1).mean() > 0.98


def test_minmax_is_the_extremes_bit_for_bit(takes: Path, tmp_path: Path) -> None:
    # A change of exposure is no business of Eq. (4).
    plate(takes / "dip", tmp_path / "plates", estimator="minmax", holdout="none", gain="auto")
    frames = np.stack([read_image(p).rgb() for p in sorted((takes / "dip").iterdir())])
    lit, shadow = frames.max(axis=0), frames.min(axis=0)
    found = plates_of(tmp_path / "plates")
    assert np.array_equal(found.lit, lit.astype(np.float32))
    assert np.array_equal(found.shadow, shadow.astype(np.float32))
    assert (found.frames == FRAMES).all()


def test_threads_and_bands_change_no_bit(
    takes: Path, walk_plates: Path, tmp_path: Path, tree, narrow_bands
) -> None:
    narrow_bands()
    plate(takes / "walk", tmp_path / "plates", run=Run(jobs=1))
    assert tree(tmp_path / "plates") == tree(walk_plates)


@pytest.mark.parametrize("budget", [0, 3 * HEIGHT * WIDTH * 6])
def test_what_is_kept_in_memory_changes_no_bit(
    budget: int,
    takes: Path,
    walk_plates: Path,
    level_plates: Path,
    tmp_path: Path,
    tree,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("shadowtool.steps.plate._KEPT", budget)
    plate(takes / "walk", tmp_path / "walk")
    assert tree(tmp_path / "walk") == tree(walk_plates)
    plate(takes / "dip", tmp_path / "dip", holdout="none", read_as="plane")
    assert tree(tmp_path / "dip") == tree(level_plates / "dip")


def test_what_code_values_are_taken_for_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for number in range(1001, 1004):
        picture = np.full((HEIGHT, WIDTH, 3), number % 7, np.uint8)
        (tmp_path / "take").mkdir(exist_ok=True)
        write_png(tmp_path / "take" / f"take.{number}.png", picture)
    plate(tmp_path / "take", tmp_path / "told", transfer="srgb")
    assert "taken as" not in caplog.text
    plate(tmp_path / "take", tmp_path / "assumed")
    assert "PNG is taken as srgb" in caplog.text


def test_light_and_code_values_are_not_mixed_without_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "take").mkdir()
    for number in range(1001, 1007):
        picture = np.full((HEIGHT, WIDTH, 3), 40 * (number % 3) + 60, np.uint8)
        write_png(tmp_path / "take" / f"take.{number}.png", picture)
    taken = ("none", "srgb")
    for plates_as in taken:
        plate(tmp_path / "take", tmp_path / plates_as, transfer=plates_as)
    for plates_as, frames_as in product(taken, taken):
        caplog.clear()
        out = tmp_path / f"{plates_as}-{frames_as}"
        matte(tmp_path / "take", out, plates=tmp_path / plates_as, transfer=frames_as)
        assert ("the same --transfer" in caplog.text) == (plates_as != frames_as)
    for mattes_as, plates_as in product(taken, taken):
        caplog.clear()
        out = tmp_path / f"composite-{mattes_as}-{plates_as}"
        composite(tmp_path / f"{mattes_as}-{mattes_as}", out, plates=tmp_path / plates_as)
        assert ("the same --transfer" in caplog.text) == (plates_as != mattes_as)


def test_a_take_without_shadow_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, takes: Path
) -> None:
    first = next(iter(sorted((takes / "dip").iterdir())))
    (tmp_path / "still").mkdir()
    for number in range(1001, 1009):
        shutil.copyfile(first, tmp_path / "still" / f"still.{number}.exr")
    plate(tmp_path / "still", tmp_path / "plates")
    assert "no shadow moves over the scene" in caplog.text
    matte(tmp_path / "still", tmp_path / "matte", plates=tmp_path / "plates")
    assert "β is unknown in 100% of the picture" in caplog.text


def passing_beta(number: int, x: float = 0.0) -> np.ndarray:
    """β of a shadow that crosses the ground of `waves`, from a camera's place."""
    off = np.abs(np.arange(320) - x - 20 * number - 10) - 30
    return np.tile(np.clip(off / 8 + 0.5, 0, 1), (240, 1))


def trembling_take(folder: Path, amount: float) -> tuple[Path, np.ndarray]:
    """A shadow that crosses textured ground before a camera that trembles, and its places."""
    places = np.random.default_rng(0).normal(0, amount, (16, 2))
    places -= np.median(places, axis=0)
    colour = np.float32([1, 0.8, 0.6])
    shots = [
        (waves(x, y) * (0.3 + 0.7 * passing_beta(number, x)))[..., None] * colour
        for number, (x, y) in enumerate(places)
    ]
    return write_frames(folder / "take", (shot.astype(np.float16) for shot in shots)), places


@pytest.mark.parametrize("amount", [0.0, 0.2])
def test_a_camera_that_trembles_is_told_of_and_taken_out(
    amount: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    take, _ = trembling_take(tmp_path, amount)
    off, moved = dict[str, float](), dict[str, float]()
    choices: tuple[Steady, ...] = ("auto", "none")
    for steady in choices:
        caplog.clear()
        plates, out = tmp_path / f"{steady}-plates", tmp_path / steady
        figures = plate(take, plates, holdout="none", steady=steady).figures
        assert figures["trembling"] == pytest.approx(amount, rel=0.4, abs=0.01)
        assert ("the camera trembles" in caplog.text) == (amount > 0)
        figures = matte(take, out, plates=plates, only="beta", steady=steady).figures
        assert ("where the plates were taken from" in caplog.text) == (
            amount > 0 and steady == "auto"
        )
        moved[steady] = figures["moved"]
        betas = (beta_of(out, FIRST + n) - passing_beta(n) for n in range(16))
        off[steady] = float(np.mean([np.abs(beta)[4:-4, 4:-4].mean() for beta in betas]))
    assert moved["none"] == 0
    if amount:
        assert moved["auto"] > 0.2 and off["auto"] < 0.1 * off["none"]
    else:
        assert moved["auto"] == 0 and off["auto"] == off["none"]


def test_somebody_large_who_sways_is_no_camera(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    shots = []
    for number in range(16):
        shot = waves(0, 0) * (0.3 + 0.7 * passing_beta(number))
        # Waves of their own, in front of two fifths of the picture.
        front = waves(40 + rng.normal(0, 1.5), 70 + rng.normal(0, 1.5))[::-1]
        shot[30:210, 70:240] = front[30:210, 70:240] * 0.8
        shots.append((shot[..., None] * np.float32([1, 0.8, 0.6])).astype(np.float16))
    take = write_frames(tmp_path / "take", shots)
    auto, none = (
        plate(take, tmp_path / f"plates-{steady}", holdout="none", read_as="plane", steady=steady)
        for steady in ("auto", "none")
    )
    assert auto.figures["trembling"] in (0.0, none.figures["trembling"])
    one, other = (plates_of(result.output).lit[:, :50] for result in (auto, none))
    assert np.abs(one - other).max() < 0.01


def test_a_matte_that_is_given_is_moved_with_its_frame(tmp_path: Path) -> None:
    take, places = trembling_take(tmp_path, 0.2)
    columns = np.arange(320.0)

    def post(x: float) -> np.ndarray:
        return np.tile(np.clip(10.5 - np.abs(columns - x - 160), 0, 1), (240, 1))

    roto = write_mattes(tmp_path / "roto", (post(x) for x, _ in places))
    plate(take, tmp_path / "plates", holdout="none")
    matte(take, tmp_path / "matte", plates=tmp_path / "plates", alpha=roto)
    off = []
    for n, (x, _) in enumerate(places):
        alpha = read_image(tmp_path / f"matte/fg/fg.{FIRST + n}.exr").channel("A")
        off.append([np.abs(alpha - post(place)).max() for place in (0, x)])
        assert alpha.max() <= 1
    still, trembling = np.mean(off, axis=0)
    assert still < 0.5 * trembling


def test_our_own_mattes_lie_where_the_plates_do_and_are_not_moved_again(tmp_path: Path) -> None:
    take, places = trembling_take(tmp_path, 0.2)
    columns = np.arange(320.0)
    roto = write_mattes(
        tmp_path / "roto",
        (np.tile(np.clip(10.5 - np.abs(columns - x - 160), 0, 1), (240, 1)) for x, _ in places),
    )
    plates = tmp_path / "plates"
    plate(take, plates, holdout="none")
    matte(take, tmp_path / "one", plates=plates, alpha=roto)
    matte(take, tmp_path / "two", plates=plates, alpha=tmp_path / "one" / "fg")
    for n in range(len(places)):
        one, two = (
            read_image(tmp_path / f"{name}/fg/fg.{FIRST + n}.exr").channel("A")
            for name in ("one", "two")
        )
        assert np.array_equal(one, two)


def test_a_trimap_that_is_drawn_is_moved_with_its_frame(tmp_path: Path) -> None:
    """A camera that is knocked; trimaps are drawn on what it saw."""
    columns = np.arange(320.0)
    places = [0.0] * 10 + [4.0] * 6
    colour = np.float32([1, 0.8, 0.6])
    shots, drawn = [], []
    for number, x in enumerate(places):
        shot = (waves(x, 0) * (0.3 + 0.7 * passing_beta(number, x)))[..., None] * colour
        away = np.abs(columns - x - 160)
        shot[:, away < 10] = (0.1, 0.6, 0.1)
        shots.append(shot.astype(np.float16))
        level = np.select([away < 7, away < 14], [255, 128], 0)
        drawn.append(np.tile(level / 255, (240, 1)))
    take = write_frames(tmp_path / "take", iter(shots))
    trimaps = write_mattes(tmp_path / "drawn", drawn)
    plates, out = tmp_path / "plates", tmp_path / "matte"
    plate(take, plates)
    assert matte(take, out, plates=plates, trimap=trimaps).figures["moved"] > 3
    # The plates are where the camera was most of the time.
    for number in (FIRST, FIRST + 15):
        trimap = read_image(out / f"trimap/trimap.{number}.png").plane("Y")[120]
        middle = np.mean(np.flatnonzero(trimap == 1))
        assert abs(middle - 160) < 0.8
        assert set(np.round(255 * np.unique(trimap))) == {0, 128, 255}


def test_a_holdout_that_is_given_is_moved_with_its_frame(tmp_path: Path) -> None:
    """A camera that is knocked, and then something is held out where it saw it."""
    columns = np.arange(320.0)
    places = [0.0] * 10 + [4.0] * 6
    shots, held = [], []
    for x in places:
        shots.append(np.repeat(waves(x, 0)[..., None], 3, axis=-1).astype(np.float16))
        inside = (np.abs(columns - x - 160) < 20) & (x > 0)
        held.append(np.tile(inside.astype(float), (240, 1)))
    take = write_frames(tmp_path / "take", iter(shots))
    plate(take, tmp_path / "plates", holdout=write_mattes(tmp_path / "roto", held))
    frames = read_image(tmp_path / "plates/confidence.exr").channel("frames")[120]
    inside = np.abs(columns - 160)
    assert frames[inside < 18].max() == 10
    assert np.median(frames[(inside > 22) & (inside < 26)]) == 16


def test_a_trimap_of_ours_that_was_corrected_lies_where_it_was_written(tmp_path: Path) -> None:
    """A paint program drops what the file said of itself; its folder still tells."""
    take, _ = trembling_take(tmp_path, 0.2)
    plates, out = tmp_path / "plates", tmp_path / "matte"
    plate(take, plates)
    matte(take, out, plates=plates, only="trimap")
    corrected = np.zeros((240, 320), np.uint8)
    corrected[100:140, 150:170] = 255
    path = out / f"trimap/trimap.{FIRST + 3}.png"
    assert cv2.imwrite(str(path), corrected)
    matte(take, tmp_path / "again", plates=plates, trimap=out / "trimap", only="trimap")
    again = read_image(tmp_path / f"again/trimap/{path.name}").layers["Y"]
    assert np.array_equal(again, corrected)


def test_a_moved_frame_is_the_same_in_any_chunk(tmp_path: Path) -> None:
    take, _ = trembling_take(tmp_path, 0.2)
    plate(take, tmp_path / "plates")
    matte(take, tmp_path / "whole", plates=tmp_path / "plates", only="beta")
    some = Run(frames="1004,1009", jobs=1)
    matte(take, tmp_path / "some", plates=tmp_path / "plates", only="beta", run=some)
    for number in (1004, 1009):
        assert np.array_equal(*(beta_of(tmp_path / n, number) for n in ("whole", "some")))


def test_sampled_frames_are_read_once_as_far_as_they_are_kept(
    takes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []

    def counting(path: Path) -> Image:
        read.append(path)
        return read_image(path)

    monkeypatch.setattr("shadowtool.steps.footage.read_image", counting)
    plate(takes / "walk", tmp_path / "kept")
    assert sorted(read) == sorted((takes / "walk").iterdir())


@pytest.mark.parametrize("estimator", ["robust", "minmax"])
@pytest.mark.parametrize("holdout", ["none", "auto", "given"])
def test_a_take_without_a_pixel_is_refused_for_what_it_is(
    estimator: Estimator, holdout: str, takes: Path, tmp_path: Path
) -> None:
    nothing = np.full((HEIGHT, WIDTH, 3), np.nan, np.float16)
    hollow = write_frames(tmp_path / "hollow", [nothing] * 4)
    if holdout == "given":
        holdout = str(write_mattes(tmp_path / "roto", [np.ones((HEIGHT, WIDTH))] * 4))
        shown = write_frames(tmp_path / "shown", [picture(FIRST + i) for i in range(4)])
        with pytest.raises(InputError, match="the holdout leaves nothing"):
            plate(shown, tmp_path / "plates", holdout=holdout, estimator=estimator)
    with pytest.raises(InputError, match="every pixel of every frame is NaN or infinite"):
        plate(hollow, tmp_path / "plates", holdout=holdout, estimator=estimator)


def test_a_dip_in_exposure_changes_next_to_nothing(
    takes: Path, level_plates: Path, tmp_path: Path
) -> None:
    for name in ("plain", "dip"):
        matte(takes / name, tmp_path / f"{name}-matte", plates=level_plates / name, only="beta")
    plain, dip = plates_of(level_plates / "plain"), plates_of(level_plates / "dip")
    assert error(dip.lit, plain.lit).mean() < 0.003
    assert error(dip.shadow, plain.shadow)[ROWS > 35].mean() < 0.01
    betas = [
        [beta_of(tmp_path / f"{name}-matte", number) for number in NUMBERS]
        for name in ("plain", "dip")
    ]
    assert np.abs(np.subtract(*betas)).mean() < 0.003
    assert np.abs(np.subtract(*betas)).max(axis=0).mean() < 0.02


def test_gains_are_recorded(takes: Path, level_plates: Path, tmp_path: Path) -> None:
    gains = figures_of(level_plates / "dip")["gains"]
    assert set(gains) == {str(number) for number in DIP}
    assert list(gains.values()) == pytest.approx([0.9] * len(DIP), rel=0.005)
    matte(takes / "dip", tmp_path / "matte", plates=level_plates / "dip", only="beta")
    gain = figures_of(tmp_path / "matte")["gain"]
    assert gain["least"] == pytest.approx(0.9, rel=0.005) and gain["most"] == 1
    rows = json.loads((tmp_path / "matte" / MANIFEST).read_text())["frames"]
    assert [n for n in NUMBERS if rows[str(n)]["gain"] != 1] == list(DIP)


def test_what_flickers_is_level_and_is_said(
    level_plates: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    waves = 2 * np.pi * 1.5 * ROWS / HEIGHT
    bands = {n: 1 + 0.06 * np.sin(waves + 2.3 * n)[..., None] for n in NUMBERS}
    flickering = (picture(n) * bands[n].astype(np.float16) for n in NUMBERS)
    take = write_frames(tmp_path / "flickering", flickering)
    plate(take, tmp_path / "plates", holdout="none", read_as="plane")
    matte(take, tmp_path / "matte", plates=tmp_path / "plates", only="beta")
    assert sum("flickers" in record.message for record in caplog.records) == 2
    found, plain = plates_of(tmp_path / "plates"), plates_of(level_plates / "plain")
    assert error(found.lit, plain.lit).mean() < 0.01
    for folder in ("plates", "matte"):
        assert figures_of(tmp_path / folder)["bands"] == pytest.approx(0.06, abs=0.02)
    off = [beta_of(tmp_path / "matte", n)[:25] - 1 for n in NUMBERS]
    assert np.abs(off).mean() < 0.005
    matte(take, tmp_path / "as-is", plates=tmp_path / "plates", only="beta", gain="none")
    off = [beta_of(tmp_path / "as-is", n)[:25] - 1 for n in NUMBERS]
    assert np.abs(off).mean() > 0.01


def test_a_white_balance_that_drifts_is_level_and_recorded(
    level_plates: Path, tmp_path: Path
) -> None:
    tints = {
        n: np.float16([1.05, 1, 0.96]) if n % 3 == 0 else np.float16([1, 1, 1]) for n in NUMBERS
    }
    take = write_frames(tmp_path / "drifting", (picture(n) * tints[n] for n in NUMBERS))
    plate(take, tmp_path / "plates", holdout="none", read_as="plane")
    matte(take, tmp_path / "matte", plates=tmp_path / "plates", only="beta")
    found, plain = plates_of(tmp_path / "plates"), plates_of(level_plates / "plain")
    assert error(found.lit, plain.lit).mean() < 0.005
    drifted = [n for n in NUMBERS if n % 3 == 0]
    assert set(figures_of(tmp_path / "plates")["tints"]) == {str(n) for n in drifted}
    rows = json.loads((tmp_path / "matte" / MANIFEST).read_text())["frames"]
    for n in NUMBERS:
        expected = tints[n].astype(float) / tints[n].astype(float).mean()
        assert rows[str(n)]["tint"] == pytest.approx(expected, abs=0.006)


def test_a_steady_take_has_no_gains(takes: Path, level_plates: Path, tmp_path: Path) -> None:
    plate(takes / "plain", tmp_path / "none", holdout="none", read_as="plane", gain="none")
    assert figures_of(level_plates / "plain")["gains"] == {}
    one, other = plates_of(level_plates / "plain"), plates_of(tmp_path / "none")
    assert np.array_equal(one.lit, other.lit) and np.array_equal(one.shadow, other.shadow)


def test_without_gains_plates_are_those_of_the_frames_as_they_are(
    takes: Path, tmp_path: Path
) -> None:
    plate(takes / "dip", tmp_path / "plates", holdout="none", gain="none")
    assert figures_of(tmp_path / "plates")["gains"] == {}


def test_without_gains_a_dip_is_shadow(takes: Path, tmp_path: Path) -> None:
    truth = tmp_path / "truth"
    write_plates(truth)
    alpha = write_mattes(tmp_path / "alpha", [np.zeros((HEIGHT, WIDTH))] * FRAMES)
    for gain in ("auto", "none"):
        out = tmp_path / gain
        matte(takes / "dip", out, plates=truth, alpha=alpha, only="beta", gain=gain)
    dark = DIP[5]
    lit = band_beta(dark) == 1
    assert beta_of(tmp_path / "none", dark)[lit].mean() == pytest.approx(0.88, abs=0.02)
    assert beta_of(tmp_path / "auto", dark)[lit].mean() == pytest.approx(1, abs=0.003)


def write_plates(folder: Path) -> Path:
    """The true plates as another program would give them."""
    folder.mkdir()
    for name in ("lit", "shadow"):
        values = getattr(SCENE, name)
        write_exr(folder / f"{name}.exr", {"RGB": values}, Header(WIDTH, HEIGHT))
    return folder


def coloured_light(number: int) -> np.ndarray:
    """β of a coloured filter's soft shadow with a caustic beside it, (H, W, 3)."""
    middle = 30 + 4 * (number - FIRST)
    filtered = 1 - smoothstep((14 - np.hypot(COLUMNS - middle, ROWS - 27)) / 4 + 0.5)
    beta = 1 - (1 - filtered[..., None]) * (1 - np.array([0.85, 0.45, 0.15]))
    caustic = smoothstep((6 - np.hypot(COLUMNS - middle - 28, ROWS - 27)) / 3 + 0.5)
    return (beta + 0.4 * caustic[..., None]).astype(np.float32)


class Coloured(NamedTuple):
    frames: Path
    plates: Path
    alpha: Path
    clean: list[np.ndarray]


@pytest.fixture
def coloured(tmp_path: Path) -> Coloured:
    betas = [coloured_light(FIRST + i) for i in range(4)]
    clean = [SCENE.shadow + beta * (SCENE.lit - SCENE.shadow) for beta in betas]
    noisy = (SCENE.noisy(image, seed).astype(np.float16) for seed, image in enumerate(clean))
    frames = write_frames(tmp_path / "glass", noisy)
    alpha = write_mattes(tmp_path / "alpha", [np.zeros((HEIGHT, WIDTH))] * 4)
    return Coloured(frames, write_plates(tmp_path / "truth"), alpha, clean)


def test_coloured_light_and_caustics_go_through_the_chain(
    coloured: Coloured, command, tmp_path: Path
) -> None:
    out, final = tmp_path / "matte", tmp_path / "final"
    words = ["--plates", coloured.plates, "--alpha", coloured.alpha, "--beta", "rgb", "--no-clamp"]
    outcome = command("matte", coloured.frames, "-o", out, *words)
    assert outcome.code == 0, outcome.err
    outcome = command("composite", out, "-o", final, "--plates", coloured.plates)
    assert outcome.code == 0, outcome.err
    for index, clean in enumerate(coloured.clean):
        truth, found = coloured_light(FIRST + index), beta_of(out, FIRST + index)
        assert found.shape == (HEIGHT, WIDTH, 3)
        assert np.abs(found - truth).mean(axis=(0, 1)).max() < 0.015
        caustic = truth.min(axis=-1) > 1.39
        assert found[caustic].mean() == pytest.approx(1.4, abs=0.01)
        assert (found[(truth == 1).all(axis=-1)] == 1).mean() > 0.95
        back = read_image(final / f"final.{FIRST + index}.exr").rgb().astype(np.float32)
        noise = 0.003 * np.sqrt(np.maximum(clean, 0.01) / 0.18)
        assert np.sqrt(np.mean(((back - clean) / noise) ** 2)) < 1.2


def test_without_a_given_matte_the_picture_comes_back_too(
    coloured: Coloured, tmp_path: Path
) -> None:
    matte(coloured.frames, tmp_path / "matte", plates=coloured.plates, beta="rgb", clamp=False)
    composite(tmp_path / "matte", tmp_path / "final", plates=coloured.plates)
    for index, clean in enumerate(coloured.clean):
        back = read_image(tmp_path / "final" / f"final.{FIRST + index}.exr").rgb()
        noise = 0.003 * np.sqrt(np.maximum(clean, 0.01) / 0.18)
        assert np.abs((back.astype(np.float32) - clean) / noise).mean() < 1.2


def test_clamped_light_stays_between_shadow_and_light(coloured: Coloured, tmp_path: Path) -> None:
    common = {"plates": coloured.plates, "alpha": coloured.alpha, "only": "beta"}
    matte(coloured.frames, tmp_path / "rgb", beta="rgb", **common)
    matte(coloured.frames, tmp_path / "free", beta="scalar", clamp=False, **common)
    clamped, free = beta_of(tmp_path / "rgb", FIRST), beta_of(tmp_path / "free", FIRST)
    assert clamped.min() >= 0 and clamped.max() == 1
    assert free.shape == (HEIGHT, WIDTH) and free.max() > 1.3


def test_two_lights_add_up() -> None:
    sky = SCENE.shadow
    keys = [
        SCENE.lit - SCENE.shadow,
        0.6 * np.random.default_rng(7).uniform(0.2, 0.6, SCENE.lit.shape).astype(np.float32),
    ]
    shadows = [
        [band_beta(n) for n in NUMBERS],
        [SCENE.disk(90 - 3.6 * i, 20 + i, radius=14) for i in range(FRAMES)],
    ]
    both = [
        sky + sum(beta[..., None] * key for beta, key in zip(pair, keys, strict=True))
        for pair in zip(*shadows, strict=True)
    ]
    chains = []
    for key, betas in zip(keys, shadows, strict=True):
        alone = [sky + beta[..., None] * key for beta in betas]
        extremes = ExtremePlates()
        for frame in alone:
            extremes.add(frame)
        extremes.add(sky)
        plates = extremes.plates()
        inverse = inverse_span(plates.lit, plates.shadow)
        matted = [shadow_matte(frame, plates.shadow, inverse) for frame in alone]
        chains.append((plates, matted))
    shadow = chains[0][0].shadow
    for index, truth in enumerate(both):
        total = shadow + sum(
            matted[index][..., None] * (plates.lit - plates.shadow) for plates, matted in chains
        )
        assert np.abs(total - truth).max() < 1e-4


def stamps(folder: Path) -> dict[str, int]:
    """When each file but the manifest was written."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != MANIFEST]
    return {str(path.relative_to(folder)): path.stat().st_mtime_ns for path in files}


def test_resuming_keeps_what_is_current(takes: Path, tmp_path: Path) -> None:
    first = plate(takes / "walk", tmp_path / "plates")
    before = stamps(tmp_path / "plates")
    second = plate(takes / "walk", tmp_path / "plates", run=Run(resume=True))
    assert stamps(tmp_path / "plates") == before
    assert second.kept == FRAMES and first.kept == 0
    assert second.figures == first.figures


def test_resuming_makes_anew_what_rests_on_a_changed_frame(
    takes: Path, walk_plates: Path, tmp_path: Path
) -> None:
    take = shutil.copytree(takes / "walk", tmp_path / "walk")
    shutil.copytree(walk_plates, tmp_path / "plates")
    changed = picture(FIRST + 3, figure=True)
    changed[40:50, 60:80] = SCENE.lit[40:50, 60:80] * 0.9
    frame = take / f"walk.{FIRST + 3}.exr"
    write_exr(frame, {"RGB": changed}, Header(WIDTH, HEIGHT))
    again = plate(take, tmp_path / "plates", run=Run(resume=True))
    assert again.kept == 0
    plate(take, tmp_path / "fresh")
    for name in ("lit", "shadow", "confidence"):
        files = [tmp_path / folder / f"{name}.exr" for folder in ("plates", "fresh")]
        assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("options", [{"estimator": "minmax"}, {"gain": "none"}])
def test_resuming_with_another_option_makes_anew(
    takes: Path, level_plates: Path, tmp_path: Path, options: dict[str, str]
) -> None:
    shutil.copytree(level_plates / "dip", tmp_path / "plates")
    again = plate(
        takes / "dip", tmp_path / "plates", holdout="none", run=Run(resume=True), **options
    )
    assert again.kept == 0


def test_resuming_brings_back_a_holdout_that_is_gone(
    takes: Path, walk_plates: Path, tmp_path: Path
) -> None:
    shutil.copytree(walk_plates, tmp_path / "plates")
    gone = tmp_path / "plates" / "holdout" / f"holdout.{FIRST + 4}.png"
    before = gone.read_bytes()
    gone.unlink()
    plate(takes / "walk", tmp_path / "plates", run=Run(resume=True))
    assert gone.read_bytes() == before


def test_a_holdout_that_someone_corrected_is_not_replaced_unasked(
    takes: Path, walk_plates: Path, tmp_path: Path
) -> None:
    shutil.copytree(walk_plates, tmp_path / "plates")
    corrected = tmp_path / "plates" / "holdout" / f"holdout.{FIRST + 4}.png"
    write_png(corrected, np.full((HEIGHT, WIDTH), 255, np.uint8))
    before = corrected.read_bytes()
    shutil.copytree(tmp_path / "plates" / "holdout", tmp_path / "roto")
    plate(takes / "walk", tmp_path / "plates", run=Run(resume=True))
    assert corrected.read_bytes() == before
    plate(takes / "walk", tmp_path / "again", holdout=tmp_path / "roto")
    assert plates_of(tmp_path / "again").frames.max() <= FRAMES - 1


@pytest.mark.parametrize("holdout", ["auto", "none"])
def test_a_scene_half_of_which_no_card_darkens_keeps_its_own_shade(
    holdout: str, tmp_path: Path
) -> None:
    """There is a backdrop that the light never reaches, and on the ground a wall's shade."""
    rng = np.random.default_rng(2)
    lit = rng.uniform(0.2, 0.8, (80, 120, 3))
    shade = np.ones((80, 120, 1))
    shade[:36], shade[50:, 80:] = 0.9, 0.25
    frames = []
    for right in np.linspace(0, 160, 40):
        x = np.arange(120)
        beta = 1 - ((x < right) & (x >= right - 30))[np.newaxis, :, np.newaxis]
        light = np.where(shade < 1, shade, 0.25 + 0.75 * beta)
        frames.append((lit * light + 0.003 * rng.normal(size=lit.shape)).astype(np.float32))
    take = write_frames(tmp_path / "take", frames)
    result = plate(take, tmp_path / "plates", holdout=holdout)
    assert result.figures["read_as"] == "a scene under a card"
    assert result.figures["held_out"] == "nothing"
    assert (
        error(plates_of(tmp_path / "plates").shadow[50:, 80:], lit[50:, 80:] * 0.25).mean() < 0.05
    )
    result = plate(take, tmp_path / "plane", holdout=holdout, read_as="plane")
    assert result.figures["read_as"] == "a plane that a shadow crossed"
    assert plates_of(tmp_path / "plane").shadow[50:, 80:].mean() < 0.1 * lit.mean()


@pytest.mark.parametrize("holdout", ["auto", "given"])
def test_somebody_in_dark_clothes_is_no_card(holdout: str, tmp_path: Path) -> None:
    """Who fills an eighth of the picture."""
    rng = np.random.default_rng(2)
    lit = rng.uniform(0.2, 0.8, (80, 120, 3))
    frames, roto = [], []
    for left in np.linspace(-40, 120, 40):
        x = np.arange(120)
        figure = np.zeros((80, 120), bool)
        figure[:60] = (x >= left) & (x < left + 20)
        shade = np.zeros((80, 120), bool)
        shade[60:] = (x >= left) & (x < left + 30)
        image = lit * np.where(shade, 0.25, 1)[..., None]
        image[figure] = (0.04 * lit * rng.uniform(0.5, 2, lit.shape))[figure]
        frames.append((image + 0.003 * rng.normal(size=lit.shape)).astype(np.float32))
        roto.append(figure.astype(float))
    take = write_frames(tmp_path / "take", frames)
    held = write_mattes(tmp_path / "roto", roto)
    result = plate(take, tmp_path / "plates", holdout="auto" if holdout == "auto" else str(held))
    assert result.figures["read_as"] == "a plane that a shadow crossed"


def test_a_reading_is_for_means_and_for_takes_without_a_plane(takes: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="--read-as"):
        plate(takes / "walk", tmp_path / "out", read_as="card", estimator="minmax")
    with pytest.raises(OptionError, match="--read-as"):
        plate(takes / "walk", tmp_path / "out", read_as="card", plane="0,0 9,0 9,9")


def test_a_card_that_stops_half_way_is_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rng = np.random.default_rng(2)
    lit = rng.uniform(0.2, 0.8, (80, 120, 3))
    for name, last in (("whole", 220), ("half", 100)):
        frames = []
        for right in np.linspace(0, last, 40):
            x = np.arange(120)
            beta = 1 - ((x < right) & (x >= right - 90))[np.newaxis, :, np.newaxis]
            image = lit * (0.25 + 0.75 * beta) + 0.003 * rng.normal(size=lit.shape)
            frames.append(image.astype(np.float32))
        write_frames(tmp_path / name, frames)
        result = plate(tmp_path / name, tmp_path / f"plates-{name}")
        assert result.figures["read_as"] == "a scene under a card"
        assert ("never got darker" in caplog.text) == (name == "half")
