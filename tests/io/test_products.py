"""Plates, scans, maps and manifests: what the steps hand to each other."""

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shadowtool.core.plates import Plates
from shadowtool.core.shadow_lines import ShadowLines
from shadowtool.core.shadow_time import ShadowTimes
from shadowtool.core.warp_map import Pass, WarpMap, identity_map
from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.image import Header, read_image, write_exr, write_png
from shadowtool.io.products import (
    LINES,
    MANIFEST,
    SCAN,
    confidence_layers,
    folder_lock,
    plate_files,
    read_plates,
    read_record,
    read_scan,
    read_warp,
    write_json,
    write_scan,
    write_warp,
)

WIDTH, HEIGHT = 7, 5
HEADER = Header(WIDTH, HEIGHT)
MADE = {"version": "1", "command": "shadowtool warp", "fingerprint": "f"}


def write_plates(folder, plates, contrast, header, provenance):
    colours = ({"RGB": plates.lit}, {"RGB": plates.shadow})
    layers_of = [*colours, confidence_layers(plates, contrast)]
    for path, layers in zip(plate_files(folder), layers_of, strict=True):
        write_exr(path, layers, header, provenance)


def random(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def example_plates() -> Plates:
    frames = np.arange(HEIGHT * WIDTH, dtype=np.uint32).reshape(HEIGHT, WIDTH)
    return Plates(random(HEIGHT, WIDTH, 3), random(HEIGHT, WIDTH, 3, seed=1), frames)


def example_lines(count: int = 4) -> ShadowLines:
    angle = np.linspace(0.3, 0.4, count)
    return ShadowLines(
        frame=np.arange(count) + 1001.5,
        normal=np.stack([np.cos(angle), np.sin(angle)], axis=-1),
        offset=np.linspace(-1, -4, count),
        residual=np.full(count, 0.125),
        points=np.arange(count) + 12,
        origin=("fit", "refit", "interpolated", "fit")[:count],
    )


def example_scan() -> Pass:
    time = 1001 + random(HEIGHT, WIDTH)
    time[0, 0] = np.nan
    own = np.round(time, 1).astype(np.float32)
    error, own_error = (
        np.where(np.isfinite(time), values + np.float32(0.1), np.inf).astype(np.float32)
        for values in (random(HEIGHT, WIDTH, seed=3), random(HEIGHT, WIDTH, seed=4))
    )
    contrast = random(HEIGHT, WIDTH, seed=2)
    plane = random(HEIGHT, WIDTH, seed=5) > 0.5
    return Pass(ShadowTimes(time, error, contrast, own, own_error), example_lines(), plane)


@pytest.fixture
def scan_folder(tmp_path: Path) -> Path:
    write_scan(tmp_path, example_scan(), HEADER, MADE)
    return tmp_path


def edited(folder: Path, **changes: Any) -> None:
    """Change fields of every line in lines.json."""
    record = json.loads((folder / LINES).read_bytes())
    for row in record["lines"]:
        row.update(changes)
    (folder / LINES).write_text(json.dumps(record))


def test_plates_come_back(tmp_path):
    plates = example_plates()
    plates.lit[0, 0] = np.nan
    write_plates(tmp_path, plates, random(HEIGHT, WIDTH, seed=3), HEADER, MADE)
    stored = read_plates(tmp_path)
    np.testing.assert_array_equal(stored.plates.lit, plates.lit)
    np.testing.assert_array_equal(stored.plates.shadow, plates.shadow)
    np.testing.assert_array_equal(stored.plates.frames, plates.frames)
    assert stored.header.size == (WIDTH, HEIGHT)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        path.name for path in plate_files(tmp_path)
    )


def test_the_plates_confidence_has_contrast_and_frames(tmp_path):
    contrast = random(HEIGHT, WIDTH, seed=3)
    write_plates(tmp_path, example_plates(), contrast, HEADER, MADE)
    image = read_image(tmp_path / "confidence.exr")
    assert set(image.layers) == {"contrast", "frames"}
    np.testing.assert_allclose(image.plane("contrast"), contrast, rtol=1e-3)
    assert image.layers["contrast"].dtype == np.float16
    assert image.header.provenance == MADE


def test_plates_from_a_paint_program_need_no_confidence(tmp_path):
    write_exr(tmp_path / "lit.exr", {"RGB": random(HEIGHT, WIDTH, 3)}, HEADER)
    write_png(tmp_path / "shadow.png", np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    plates = read_plates(tmp_path).plates
    assert plates.frames is None
    np.testing.assert_allclose(plates.shadow, 0.21586, atol=1e-5)


@pytest.mark.parametrize(("transfer", "value"), [("auto", 0.21586), ("none", 128 / 255)])
def test_plates_in_png_are_decoded_as_the_footage_is(transfer, value, tmp_path):
    for name in ("lit", "shadow"):
        write_png(tmp_path / f"{name}.png", np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    stored = read_plates(tmp_path, transfer)
    np.testing.assert_allclose(stored.plates.lit, value, atol=1e-5)
    assert stored.transfer == ("srgb" if transfer == "auto" else transfer)


def test_a_plate_in_exr_beside_one_in_png_is_what_it_is(tmp_path):
    light = random(HEIGHT, WIDTH, 3)
    write_exr(tmp_path / "lit.exr", {"RGB": light}, HEADER)
    write_png(tmp_path / "shadow.png", np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    stored = read_plates(tmp_path, "rec709")
    np.testing.assert_array_equal(stored.plates.lit, light)
    np.testing.assert_allclose(stored.plates.shadow, 0.2616, atol=2e-4)
    assert stored.transfer == "rec709"


def test_plates_in_exr_are_what_they_are(tmp_path):
    write_plates(tmp_path, example_plates(), random(HEIGHT, WIDTH), HEADER, MADE)
    stored = read_plates(tmp_path, "srgb")
    np.testing.assert_array_equal(stored.plates.lit, example_plates().lit)
    assert stored.transfer == "linear"


@pytest.mark.parametrize("missing", ["lit", "shadow"])
def test_a_missing_plate_is_named(missing, tmp_path):
    write_plates(tmp_path, example_plates(), random(HEIGHT, WIDTH), HEADER, MADE)
    (tmp_path / f"{missing}.exr").unlink()
    with pytest.raises(InputError, match=rf"has no {missing}\.exr; make the plates with"):
        read_plates(tmp_path)


def test_a_coarse_map_is_told_of(tmp_path, caplog):
    st_map = np.full((HEIGHT, WIDTH, 4), 0.5, np.float16)
    write_exr(tmp_path / "warp.exr", {"RGBA": st_map}, HEADER)
    read_warp(tmp_path / "warp.exr")
    assert "half floats are too coarse for an ST map" in caplog.text


@pytest.mark.parametrize("folder", ["nowhere", "n" * 10_000])
def test_a_folder_of_plates_that_is_not_there_is_refused(folder, tmp_path):
    with pytest.raises(InputError, match=r"has no lit\.exr"):
        read_plates(tmp_path / folder)


def test_plates_of_two_sizes_are_refused_with_both_sizes(tmp_path):
    write_exr(tmp_path / "lit.exr", {"RGB": random(5, 7, 3)})
    write_exr(tmp_path / "shadow.exr", {"RGB": random(6, 8, 3)})
    with pytest.raises(InputError, match="lit is 7x5, shadow is 8x6"):
        read_plates(tmp_path)


@pytest.mark.parametrize(
    "channels",
    [
        {"contrast": random(HEIGHT, WIDTH), "other": random(HEIGHT, WIDTH)},
        {"contrast": random(4, 4), "frames": random(4, 4)},
    ],
)
def test_a_confidence_that_does_not_fit_is_refused(channels, tmp_path):
    write_plates(tmp_path, example_plates(), random(HEIGHT, WIDTH), HEADER, MADE)
    write_exr(tmp_path / "confidence.exr", channels)
    with pytest.raises(InputError, match=r"confidence\.exr"):
        read_plates(tmp_path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -5.0, 1e30])
def test_impossible_counts_of_frames_do_no_harm(value, tmp_path):
    write_plates(tmp_path, example_plates(), random(HEIGHT, WIDTH), HEADER, MADE)
    frames = np.full((HEIGHT, WIDTH), value, np.float32)
    write_exr(tmp_path / "confidence.exr", {"contrast": frames, "frames": frames}, HEADER)
    try:
        frames = read_plates(tmp_path).plates.frames
    except InputError as error:
        assert "confidence.exr" in str(error)
    else:
        assert len(np.unique(frames)) == 1
        assert value > 0 or frames[0, 0] == 0


def test_the_fingerprint_changes_with_any_plate(tmp_path):
    marks = set()
    for changed in (None, *plate_files(Path())):
        write_plates(tmp_path, example_plates(), random(HEIGHT, WIDTH), HEADER, MADE)
        if changed is not None:
            path = tmp_path / changed
            layers = {name: values + 1 for name, values in read_image(path).layers.items()}
            write_exr(path, layers, HEADER)
        marks.add(read_plates(tmp_path).fingerprint)
    assert len(marks) == 4


def test_a_scan_comes_back(scan_folder):
    scan, header, _ = read_scan(scan_folder)
    expected = example_scan()
    np.testing.assert_array_equal(scan.times.time, expected.times.time)
    np.testing.assert_array_equal(scan.times.own_time, expected.times.own_time)
    for name in ("contrast", "error", "own_error"):
        found, given = getattr(scan.times, name), getattr(expected.times, name)
        # A half's rounding.
        np.testing.assert_allclose(found, given, rtol=2**-11, atol=2**-25)
    assert header.size == (WIDTH, HEIGHT)
    for name in ("frame", "normal", "offset", "residual", "points"):
        np.testing.assert_array_equal(getattr(scan.lines, name), getattr(expected.lines, name))
    assert scan.lines.origin == expected.lines.origin
    np.testing.assert_array_equal(scan.plane, expected.plane)


def test_a_scan_need_not_say_what_was_marked(tmp_path):
    write_scan(tmp_path, replace(example_scan(), plane=None), HEADER, MADE)
    assert read_scan(tmp_path)[0].plane is None


def test_a_scan_says_how_it_was_made(scan_folder):
    record = json.loads((scan_folder / LINES).read_bytes())
    assert MADE.items() <= record.items()
    assert (record["width"], record["height"]) == (WIDTH, HEIGHT)
    assert read_image(scan_folder / SCAN).header.provenance == MADE


def test_the_same_scan_gives_the_same_bytes(tmp_path):
    for name in "ab":
        (tmp_path / name).mkdir()
        write_scan(tmp_path / name, example_scan(), HEADER, MADE)
    for file in (SCAN, LINES):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_values_that_are_not_finite_are_unknown(scan_folder):
    time = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    contrast = np.full((HEIGHT, WIDTH), -1, np.float32)
    contrast[0] = np.nan
    write_exr(scan_folder / SCAN, {"time": time, "contrast": contrast}, HEADER)
    times = read_scan(scan_folder)[0].times
    assert np.isnan(times.time).all()
    assert (times.contrast == 0).all()


@pytest.mark.parametrize("missing", [SCAN, LINES])
def test_a_missing_file_of_a_scan_is_named(missing, scan_folder):
    (scan_folder / missing).unlink()
    with pytest.raises(InputError, match=missing):
        read_scan(scan_folder)


def test_a_scan_without_times_is_refused(scan_folder):
    write_exr(scan_folder / SCAN, {"a": random(HEIGHT, WIDTH), "b": random(HEIGHT, WIDTH)}, HEADER)
    with pytest.raises(InputError, match=r"scan\.exr: has no channel time"):
        read_scan(scan_folder)


@pytest.mark.parametrize("layer", [{"RGB": (3,)}, {"Y": ()}])
def test_a_picture_is_no_scan(layer, scan_folder):
    channels = {name: random(HEIGHT, WIDTH, *depth) for name, depth in layer.items()}
    write_exr(scan_folder / SCAN, channels, HEADER)
    with pytest.raises(InputError, match=r"scan\.exr"):
        read_scan(scan_folder)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"text",
        b"{",
        b"null",
        b"[]",
        b"{}",
        b"3",
        b'"lines"',
        b'{"lines": null}',
        b'{"lines": 3}',
        b'{"lines": {}}',
        b'{"lines": {"a": 1}}',
        b'{"lines": [1, 2, 3]}',
        b'{"lines": [[], []]}',
        b'{"lines": [{}, {}]}',
        b"\xff\xfe\x00",
        b"\x89PNG",
        b"[" * 100_000,
        b'{"lines": ' * 50_000,
        b"1" * 10_000,
        b'{"lines": [], "width": 7, "height": 5}',
    ],
)
def test_what_holds_no_lines_is_refused(content, scan_folder):
    (scan_folder / LINES).write_bytes(content)
    with pytest.raises(InputError, match=r"lines\.json: holds no shadow lines; run .* again"):
        read_scan(scan_folder)


MALFORMED = [None, "x", [], {}, [1], [[1]], [1, 2, 3], [1.0, [0.0]], [None, None]]
MALFORMED += [[1e308, 1.7e308], [float("nan"), 1.0], [0.0, 0.0], [5.0, 5.0]]
MALFORMED += [float("nan"), float("inf"), 10**400]


@pytest.mark.parametrize("field", ["frame", "normal", "offset", "residual"])
@pytest.mark.parametrize("value", MALFORMED, ids=repr)
def test_a_malformed_field_is_refused_and_never_gets_through(field, value, scan_folder):
    edited(scan_folder, **{field: value})
    with pytest.raises(InputError, match=r"lines\.json"):
        read_scan(scan_folder)


@pytest.mark.parametrize("value", [None, "x", [], [1], {}, 10**30, float("inf"), float("nan")])
def test_malformed_counts_are_refused(value, scan_folder):
    edited(scan_folder, points=value)
    with pytest.raises(InputError, match=r"lines\.json"):
        read_scan(scan_folder)


def test_counts_and_origins_may_be_left_out(scan_folder):
    record = json.loads((scan_folder / LINES).read_bytes())
    for row in record["lines"]:
        del row["points"], row["origin"]
    (scan_folder / LINES).write_text(json.dumps(record))
    assert len(read_scan(scan_folder)[0].lines) == 4


@pytest.mark.parametrize("field", ["frame", "normal", "offset", "residual"])
def test_a_missing_field_is_refused(field, scan_folder):
    record = json.loads((scan_folder / LINES).read_bytes())
    del record["lines"][2][field]
    (scan_folder / LINES).write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"lines\.json"):
        read_scan(scan_folder)


def test_negative_residuals_are_refused(scan_folder):
    edited(scan_folder, residual=-1.0)
    with pytest.raises(InputError, match=r"lines\.json"):
        read_scan(scan_folder)


@pytest.mark.parametrize("order", [[1, 0, 2, 3], [0, 0, 1, 2], [3, 2, 1, 0], [0]])
def test_lines_out_of_order_or_alone_are_refused(order, scan_folder):
    record = json.loads((scan_folder / LINES).read_bytes())
    record["lines"] = [record["lines"][i] for i in order]
    (scan_folder / LINES).write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"lines\.json"):
        read_scan(scan_folder)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 8),
        ("height", 0),
        ("width", -7),
        ("width", None),
        ("height", "x"),
        ("width", 1e309),
        ("width", [7]),
        ("height", 10**30),
        ("width", float("nan")),
    ],
)
def test_lines_for_another_size_are_refused(field, value, scan_folder):
    record = json.loads((scan_folder / LINES).read_bytes())
    record[field] = value
    (scan_folder / LINES).write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"lines\.json"):
        read_scan(scan_folder)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=6,
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(field=st.sampled_from(["frame", "normal", "offset", "residual", "points"]), value=JSON)
def test_whatever_json_stands_in_a_line_it_is_lines_or_an_input_error(scan_folder, field, value):
    write_scan(scan_folder, example_scan(), HEADER, MADE)
    record = json.loads((scan_folder / LINES).read_bytes())
    record["lines"][1][field] = value
    (scan_folder / LINES).write_text(json.dumps(record))
    try:
        lines = read_scan(scan_folder)[0].lines
    except InputError:
        return
    assert lines.frame.shape == lines.offset.shape == lines.residual.shape == (4,)
    assert lines.points.shape == (4,)
    assert lines.normal.shape == (4, 2)


def test_the_scans_fingerprint_changes_with_either_file(scan_folder):
    marks = {read_scan(scan_folder)[2]}
    edited(scan_folder, offset=3.0)
    marks.add(read_scan(scan_folder)[2])
    scan = example_scan()
    layers = {"time": scan.times.time + 1, "contrast": scan.times.contrast}
    write_exr(scan_folder / SCAN, layers, HEADER)
    marks.add(read_scan(scan_folder)[2])
    assert len(marks) == 3


@pytest.mark.parametrize(("width", "height"), [(7, 5), (48, 32), (1, 1), (1920, 4), (3, 1081)])
def test_the_identity_is_u_and_v_at_pixel_centres(width, height, tmp_path):
    identity = WarpMap(identity_map(height, width), np.zeros((height, width), np.float32))
    write_warp(tmp_path / "warp.exr", identity, Header(width, height), MADE)
    with OpenEXR.File(str(tmp_path / "warp.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels.copy() for name, channel in file.channels().items()}
    y, x = np.mgrid[:height, :width]
    np.testing.assert_array_equal(channels["R"], ((x + 0.5) / width).astype(np.float32))
    np.testing.assert_array_equal(channels["G"], (1 - (y + 0.5) / height).astype(np.float32))
    np.testing.assert_array_equal(channels["B"], 0)
    np.testing.assert_array_equal(channels["A"], 1)
    assert {values.dtype for values in channels.values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize(("width", "height"), [(7, 5), (2048, 16), (4096, 8)])
def test_a_map_comes_back_to_a_thousandth_of_a_pixel(width, height, tmp_path):
    warp = identity_map(height, width) + 20 * random(height, width, 2) - 10
    error = 5 * random(height, width, seed=1)
    error[0, 0] = np.inf
    write_warp(tmp_path / "warp.exr", WarpMap(warp, error), Header(width, height), MADE)
    stored, header, mark = read_warp(tmp_path / "warp.exr")
    np.testing.assert_allclose(stored.warp, warp, atol=1e-3)
    np.testing.assert_allclose(stored.error, error, rtol=1e-4, atol=1e-5)
    assert header.size == (width, height)
    assert mark == read_image(tmp_path / "warp.exr").fingerprint


def test_unknown_places_of_a_map_stay_unknown(tmp_path):
    warp = identity_map(HEIGHT, WIDTH)
    warp[2, 3] = np.nan
    error = np.zeros((HEIGHT, WIDTH), np.float32)
    error[2, 3] = np.inf
    write_warp(tmp_path / "warp.exr", WarpMap(warp, error), HEADER, MADE)
    stored = read_warp(tmp_path / "warp.exr")[0]
    assert np.isnan(stored.warp[2, 3]).all()
    assert np.isinf(stored.error[2, 3])


@pytest.mark.parametrize("names", ["RG", "RGB"])
def test_maps_of_other_programs_need_no_alpha(names, tmp_path):
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    values = {"R": (x + 0.5) / WIDTH, "G": 1 - (y + 0.5) / HEIGHT, "B": np.zeros_like(x)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path = tmp_path / "map.exr"
    OpenEXR.File(header, {name: values[name] for name in names}).write(str(path))
    stored = read_warp(path)[0]
    np.testing.assert_allclose(stored.warp, identity_map(HEIGHT, WIDTH), atol=1e-5)
    assert (stored.error == 0).all()


def test_the_confidence_of_a_map_in_png_is_read_as_in_exr(tmp_path):
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    st_map = [(x + 0.5) / WIDTH, 1 - (y + 0.5) / HEIGHT, 0 * x, 0.25 + 0 * x]
    write_png(tmp_path / "a.png", np.rint(65535 * np.dstack(st_map)).astype(np.uint16))
    np.testing.assert_allclose(read_warp(tmp_path / "a.png")[0].error, 3, rtol=1e-3)


def test_a_picture_of_one_channel_is_no_map(tmp_path):
    write_exr(tmp_path / "a.exr", {"Y": random(HEIGHT, WIDTH)})
    with pytest.raises(InputError, match=r"a\.exr"):
        read_warp(tmp_path / "a.exr")


@pytest.mark.parametrize("content", [None, b"", b"text"])
def test_a_map_that_cannot_be_read_is_named(content, tmp_path):
    if content is not None:
        (tmp_path / "warp.exr").write_bytes(content)
    with pytest.raises(InputError, match=r"warp\.exr") as caught:
        read_warp(tmp_path / "warp.exr")
    assert isinstance(caught.value, DamagedFileError) == (content is not None)


def test_a_manifest_comes_back(tmp_path):
    record = {"step": "plate", "figures": {"β": 1.5}, "frames": {"1001": {}}, "none": None}
    write_json(tmp_path / MANIFEST, record)
    assert read_record(tmp_path / MANIFEST) == record


def test_the_order_of_a_records_keys_makes_no_difference(tmp_path):
    write_json(tmp_path / "a", {"x": 1, "y": {"p": 2, "q": 3}})
    write_json(tmp_path / "b", {"y": {"q": 3, "p": 2}, "x": 1})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert (tmp_path / "a").read_bytes().endswith(b"}\n")


def test_records_hold_no_number_that_json_lacks(tmp_path):
    write_json(tmp_path / "a", {"x": float("nan"), "y": [1.5, {"z": (float("-inf"), 2)}]})
    assert read_record(tmp_path / "a") == {"x": None, "y": [1.5, {"z": [None, 2]}]}


@pytest.mark.parametrize(
    "content",
    [None, b"", b"[]", b"3", b"{", b'{"x": NaN}', b'{"x": 1e999}', b"\xff", b"[" * 100_000],
)
def test_a_manifest_that_cannot_be_read_counts_as_none(content, tmp_path):
    if content is not None:
        (tmp_path / MANIFEST).write_bytes(content)
    assert read_record(tmp_path / MANIFEST) == {}


def test_the_folder_lock_lets_one_in_at_a_time(tmp_path):
    inside, most = [], []

    def work() -> None:
        for _ in range(20):
            with folder_lock(tmp_path):
                inside.append(1)
                most.append(len(inside))
                inside.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1


def test_the_folder_lock_does_not_need_the_folder(tmp_path):
    with folder_lock(tmp_path / "nowhere"):
        pass
