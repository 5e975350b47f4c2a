"""The figure from footage on disk, alone and with trimaps drawn for some frames."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shadowtool.core.trimap import BACKGROUND, FIGURE
from shadowtool.core.trimap_flow import Link, links
from shadowtool.errors import InputError
from shadowtool.io.image import Header, decode, read_image, write_exr, write_png
from shadowtool.io.sequence import open_sequence
from shadowtool.steps.composite import composite
from shadowtool.steps.footage import open_footage
from shadowtool.steps.keyframes import Keyframes
from shadowtool.steps.matte import matte
from shadowtool.steps.run import Run
from tests.figures import SCENE, Shot, disk, shot

NUMBERS = range(1001, 1009)
HEADER = Header(SCENE.width, SCENE.height)


def figure(number: int) -> Shot:
    """A disk on its way to the right, its shadow beside it."""
    x = 40 + 4 * (number - 1001)
    return shot(disk(x, 45, 18), SCENE.disk(x + 25, 60, radius=20, soft=3), seed=number)


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Footage, true plates and two trimaps."""
    folder = tmp_path_factory.mktemp("take")
    for part in ("source", "plates", "trimaps"):
        (folder / part).mkdir()
    for number in NUMBERS:
        image = figure(number).image.astype(np.float16)
        write_exr(folder / "source" / f"source.{number}.exr", {"RGB": image}, HEADER)
    for name in ("lit", "shadow"):
        write_exr(folder / "plates" / f"{name}.exr", {"RGB": getattr(SCENE, name)}, HEADER)
    for number in (1002, 1007):
        write_png(folder / "trimaps" / f"trimap.{number}.png", drawn(number))
    return folder


def drawn(number: int) -> np.ndarray:
    """A trimap with a mark in the corner that nobody would find."""
    alpha = figure(number).alpha
    trimap = np.where(alpha == 1, 255, np.where(alpha > 0, 128, 0)).astype(np.uint8)
    trimap[2:4, 2:4] = 255
    return trimap


@pytest.fixture
def pull(take: Path, tmp_path: Path) -> Callable[..., Path]:
    """Run the step into a folder of this name."""

    def call(name: str, **options: object) -> Path:
        matte(take / "source", tmp_path / name, plates=take / "plates", **options)
        return tmp_path / name

    return call


def trimap_of(folder: Path, number: int) -> np.ndarray:
    return read_image(folder / "trimap" / f"trimap.{number}.png").layers["Y"]


def test_alpha_trimap_and_colour_of_a_take(pull: Callable[..., Path]) -> None:
    out = pull("out")
    for number in NUMBERS:
        true = figure(number)
        _, alpha = read_image(out / "fg" / f"fg.{number}.exr").rgba()
        mixed = (true.alpha > 0) & (true.alpha < 1)
        assert np.abs(alpha - true.alpha).sum() < 0.12 * mixed.sum()
        trimap = trimap_of(out, number)
        assert (trimap[(true.alpha > 0.02) & (true.alpha < 0.98)] == 128).mean() > 0.97


def test_over_its_own_plates_the_take_is_itself_again(
    pull: Callable[..., Path], take: Path, tmp_path: Path
) -> None:
    composite(pull("out"), tmp_path / "again", plates=take / "plates")
    for number in NUMBERS:
        true = figure(number)
        again = read_image(tmp_path / "again" / f"again.{number}.exr").rgb().astype(np.float32)
        sigma = 0.003 * np.sqrt(np.maximum(true.image, 0.01) / 0.18)
        off = np.abs(again - true.image) / sigma
        assert off.mean() < 1.2
        assert off[true.alpha > 0].mean() < 1.5


def test_a_trimap_that_was_drawn_is_used_as_it_is(pull: Callable[..., Path], take: Path) -> None:
    out = pull("out", trimap=take / "trimaps")
    for number in (1002, 1007):
        assert np.array_equal(trimap_of(out, number), drawn(number))
        _, alpha = read_image(out / "fg" / f"fg.{number}.exr").rgba()
        assert (alpha[2:4, 2:4] == 1).all() and alpha[0, 0] == 0
    for number in (1001, 1004, 1008):
        _, alpha = read_image(out / "fg" / f"fg.{number}.exr").rgba()
        assert np.abs(alpha - figure(number).alpha).mean() < 0.004


def test_only_trimaps_are_written_when_only_they_are_wanted(
    pull: Callable[..., Path], take: Path
) -> None:
    out = pull("out", trimap=take / "trimaps", only="trimap")
    assert sorted(path.name for path in out.iterdir()) == ["shadowtool.json", "trimap"]
    assert len(list((out / "trimap").iterdir())) == len(NUMBERS)


def test_keyframes_give_the_same_bits_whatever_the_jobs_and_the_split(
    pull: Callable[..., Path], take: Path, tree: Callable[[Path], dict[str, bytes]]
) -> None:
    options = {"trimap": take / "trimaps"}
    whole = pull("whole", run=Run(jobs=1), **options)
    for frames in ("1005-1008", "1003", "1001-1004"):
        pull("parts", run=Run(frames=frames, jobs=2, overwrite=True), **options)
    parts = whole.parent / "parts"
    for folder in ("trimap", "fg", "beta"):
        assert tree(parts / folder) == tree(whole / folder)


@pytest.mark.parametrize("spacing", [5, 40])
def test_each_flow_between_keyframes_is_found_once(
    take: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spacing: int
) -> None:
    for folder in ("source", "drawn"):
        (tmp_path / folder).mkdir()
    numbers = range(1001, 1002 + spacing)
    for number in numbers:
        shutil.copy(take / "source" / "source.1001.exr", tmp_path / f"source/source.{number}.exr")
    for number in (numbers[0], numbers[-1]):
        write_png(tmp_path / "drawn" / f"trimap.{number}.png", drawn(1002))
    found = []

    def counted(here: np.ndarray, there: np.ndarray) -> tuple[Link, Link]:
        found.append(1)
        return links(here, there)

    monkeypatch.setattr("shadowtool.steps.keyframes.links", counted)
    options = {"plates": take / "plates", "trimap": tmp_path / "drawn", "only": "trimap"}
    matte(tmp_path / "source", tmp_path / "out", run=Run(jobs=1), **options)
    assert len(found) == spacing


def test_trimaps_are_carried_past_a_damaged_frame(take: Path, tmp_path: Path) -> None:
    shutil.copytree(take / "source", tmp_path / "source")
    bad = tmp_path / "source" / "source.1004.exr"
    bad.write_bytes(bad.read_bytes()[:-500])
    options = {"plates": take / "plates", "trimap": take / "trimaps"}
    run = Run(missing="skip")
    result = matte(tmp_path / "source", tmp_path / "out", run=run, **options)
    assert result.skipped == [1004]
    for number in (1003, 1005):
        _, alpha = read_image(tmp_path / "out" / "fg" / f"fg.{number}.exr").rgba()
        assert np.abs(alpha - figure(number).alpha).mean() < 0.004


@pytest.mark.parametrize("number", [1002, 1006])
def test_a_keyframe_is_carried_forwards_and_backwards(
    take: Path, tmp_path: Path, number: int
) -> None:
    (tmp_path / "drawn").mkdir()
    write_png(tmp_path / "drawn" / "trimap.1004.png", drawn(1004))
    drawings = open_sequence(tmp_path / "drawn")
    keyframes = Keyframes.of(drawings, open_footage(take / "source"), "error")
    # Without the mark in the corner.
    trimap, alpha = keyframes.trimap(number, (0.0, 0.0))[8:], figure(number).alpha[8:]
    assert (alpha[trimap == FIGURE] > 0).mean() > 0.97
    assert (alpha[trimap == BACKGROUND] < 1).mean() > 0.99
    assert (trimap == FIGURE).sum() > 0.5 * alpha.sum()


def test_what_was_drawn_helps_in_the_frames_between(take: Path, tmp_path: Path) -> None:
    for folder in ("source", "drawn"):
        (tmp_path / folder).mkdir()
    alpha = disk(60, 45, 18)
    # Cloth of nearly the ground's own texture and colour.
    cloth = 0.63 * SCENE.lit + 0.07 * SCENE.lit.mean(axis=(0, 1))
    image = alpha[..., None] * cloth + (1 - alpha[..., None]) * SCENE.lit
    for number in (1001, 1002, 1003):
        noisy = SCENE.noisy(image, number).astype(np.float16)
        write_exr(tmp_path / "source" / f"source.{number}.exr", {"RGB": noisy}, HEADER)
    trimap = np.where(alpha == 1, 255, np.where(alpha > 0, 128, 0)).astype(np.uint8)
    for number in (1001, 1003):
        write_png(tmp_path / "drawn" / f"trimap.{number}.png", trimap)
    off = []
    for name, given in (("alone", None), ("helped", tmp_path / "drawn")):
        matte(tmp_path / "source", tmp_path / name, plates=take / "plates", trimap=given)
        _, found = read_image(tmp_path / name / "fg" / "fg.1002.exr").rgba()
        off.append(np.abs(found - alpha).mean())
    assert off[1] < 0.5 * off[0]


def test_bands_change_no_bit(pull: Callable[..., Path], tree, narrow_bands) -> None:
    whole = pull("whole")
    narrow_bands()
    assert tree(pull("narrow")) == tree(whole)


def test_frames_far_from_any_keyframe_do_without(
    pull: Callable[..., Path],
    take: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("shadowtool.steps.keyframes._FURTHEST", 1)
    out, free = pull("out", trimap=take / "trimaps"), pull("free")
    for number in (1004, 1005):
        one, other = (
            read_image(folder / "fg" / f"fg.{number}.exr").layers["RGBA"] for folder in (out, free)
        )
        assert np.array_equal(one, other)


def test_an_edge_of_a_given_alpha_is_coloured_without_the_ground(
    pull: Callable[..., Path], tmp_path: Path
) -> None:
    mattes = tmp_path / "alpha"
    mattes.mkdir()
    for number in NUMBERS:
        write_exr(mattes / f"a.{number}.exr", {"Y": figure(number).alpha}, HEADER)
    out = pull("out", alpha=mattes)
    true = figure(1003)
    colour, alpha = read_image(out / "fg" / "fg.1003.exr").rgba()
    assert alpha == pytest.approx(true.alpha, abs=1e-3)
    rim = (true.alpha > 0.3) & (true.alpha < 1)
    found = colour[rim] / true.alpha[rim][:, None]
    assert np.abs(found - true.foreground[rim]).mean() < 0.02


def test_beta_is_relied_on_as_far_as_the_figure_shows_the_ground(
    pull: Callable[..., Path],
) -> None:
    out = pull("out")
    confidence = read_image(out / "beta" / "beta.1004.exr").plane("confidence")
    _, alpha = read_image(out / "fg" / "fg.1004.exr").rgba()
    whole = np.median(confidence[alpha == 0])
    assert whole > 0.9
    edge = (alpha > 0.1) & (alpha < 0.5)
    assert confidence[edge] == pytest.approx((1 - alpha[edge]) * whole, abs=0.05)
    assert (confidence[alpha >= 0.5] == 0).all()


def test_beta_is_not_relied_on_where_the_plates_know_no_shadow(take: Path, tmp_path: Path) -> None:
    (tmp_path / "plates").mkdir()
    shadow = SCENE.shadow.copy()
    shadow[:30, :40] = SCENE.lit[:30, :40]
    for name, plate in (("lit", SCENE.lit), ("shadow", shadow)):
        write_exr(tmp_path / "plates" / f"{name}.exr", {"RGB": plate}, HEADER)
    matte(take / "source", tmp_path / "out", plates=tmp_path / "plates", run=Run(frames="1008"))
    image = read_image(tmp_path / "out" / "beta" / "beta.1008.exr")
    assert (image.plane("confidence")[:30, :40] == 0).all()
    assert np.isfinite(image.plane("Y")).all()


def test_a_trimap_that_was_made_linear_keeps_its_edge(
    pull: Callable[..., Path], take: Path, tmp_path: Path
) -> None:
    (tmp_path / "linear").mkdir()
    for number in (1002, 1007):
        light = decode(drawn(number), "srgb")
        write_exr(tmp_path / "linear" / f"trimap.{number}.exr", {"Y": light}, HEADER)
    options = {"run": Run(frames="1002"), "only": "trimap"}
    coded = pull("coded", trimap=take / "trimaps", **options)
    linear = pull("linear-out", trimap=tmp_path / "linear", **options)
    assert np.array_equal(trimap_of(linear, 1002), trimap_of(coded, 1002))


def test_what_a_trimap_made_is_not_kept_as_what_an_alpha_makes(
    pull: Callable[..., Path], take: Path
) -> None:
    run = Run(frames="1002", resume=True)
    pull("out", trimap=take / "trimaps", only="alpha", run=run)
    fresh = pull("fresh", alpha=take / "trimaps", only="alpha", run=run)
    again = pull("out", alpha=take / "trimaps", only="alpha", run=run)
    one, other = (
        read_image(folder / "fg" / "fg.1002.exr").layers["RGBA"] for folder in (fresh, again)
    )
    assert np.array_equal(one, other)


def test_an_empty_take_gives_empty_mattes(take: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for number in NUMBERS:
        image = shot(np.zeros(SCENE.lit.shape[:2]), figure(number).beta, seed=number).image
        write_exr(tmp_path / "empty" / f"e.{number}.exr", {"RGB": image}, HEADER)
    matte(tmp_path / "empty", tmp_path / "out", plates=take / "plates")
    for number in NUMBERS:
        assert not trimap_of(tmp_path / "out", number).any()
        assert not read_image(tmp_path / "out" / "fg" / f"fg.{number}.exr").layers["RGBA"].any()


def test_trimaps_of_another_size_are_refused(pull: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "wrong").mkdir()
    write_png(tmp_path / "wrong" / "t.1003.png", np.zeros((10, 20), np.uint8))
    with pytest.raises(InputError, match=r"t\.1003\.png: is 20x10"):
        pull("out", trimap=tmp_path / "wrong")
