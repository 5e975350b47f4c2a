"""Runs that are killed, pulled out from under or raced: nothing half done, nothing lost."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shadowtool.errors import ShadowtoolError
from shadowtool.io.files import write_bytes
from shadowtool.io.image import read_image
from shadowtool.io.products import read_record
from shadowtool.steps.capture import capture
from shadowtool.steps.composite import composite
from shadowtool.steps.matte import matte
from shadowtool.steps.plate import plate
from shadowtool.steps.run import Run
from shadowtool.steps.warp import warp
from tests.soak import PROGRAM, Soak, random_faults

PER_FRAME = ["capture", "matte", "apply", "composite"]


@pytest.fixture(scope="module")
def soak(tmp_path_factory: pytest.TempPathFactory) -> Soak:
    return Soak(tmp_path_factory.mktemp("soak"), (96, 64), 10, 2)


@pytest.mark.parametrize("index", range(8))
def test_a_killed_run_loses_nothing(index, soak):
    soak.survive(list(random_faults(soak.steps, 8, seed=index))[index])


def test_random_faults_are_the_same_for_the_same_seed_and_reach_every_step_and_signal():
    steps = ("a", "b")
    faults = list(random_faults(steps, 60, seed=3))
    assert faults == list(random_faults(steps, 60, seed=3))
    assert faults != list(random_faults(steps, 60, seed=4))
    assert len({(fault.step, fault.number) for fault in faults}) == 6
    assert any(fault.again is not None for fault in faults)


@pytest.mark.parametrize("name", [*PER_FRAME, "plate"])
def test_an_output_folder_that_is_deleted_meanwhile(name, shot, tmp_path):
    output = tmp_path / "out"

    def vanish(done: int, total: int) -> None:
        # Not at the first try where another file is being written.
        while done == 2 and output.exists():
            shutil.rmtree(output, ignore_errors=True)

    run = Run(jobs=1, progress=vanish)
    steps = {
        "capture": lambda: capture(shot.source, output, run=run),
        "matte": lambda: matte(shot.source, output, plates=shot.plates, run=run),
        "plate": lambda: plate(shot.photometric, output, run=run, holdout="none"),
        "apply": lambda: warp(
            [], output, map_file=shot.warp / "warp.exr", apply_to=shot.matte / "beta", run=run
        ),
        "composite": lambda: composite(shot.matte, output, plates=shot.plates, run=run),
    }
    with pytest.raises(ShadowtoolError, match=r"out.*cannot write: No such file or directory"):
        steps[name]()
    assert not list(tmp_path.rglob("*.tmp"))
    assert not (output / "shadowtool.json").exists()


@pytest.mark.parametrize("name", PER_FRAME)
@pytest.mark.parametrize("chunks", [("1001-1003", "1004-1006"), ("1001-1006", "1001-1006")])
def test_two_processes_at_once_make_the_union(name, chunks, shot, command, tmp_path, tree):
    whole, shared = tmp_path / "whole" / "out", tmp_path / "shared" / "out"
    words = shot.arguments(name)
    assert command(*words, "-o", whole, "-q").code == 0
    running = [
        subprocess.Popen([*PROGRAM, *words, "-o", str(shared), "-q", "--resume", "--frames", chunk])
        for chunk in chunks
    ]
    assert [process.wait(timeout=60) for process in running] == [0, 0]
    frames = [path for path in tree(whole) if path not in ("capture.json", "shadowtool.json")]
    left = tree(shared)
    assert {path: left[path] for path in frames} == {path: tree(whole)[path] for path in frames}
    assert not [path for path in left if path.endswith(".tmp")]
    record = read_record(shared / "shadowtool.json")
    assert sorted(record["frames"]) == [str(frame) for frame in range(1001, 1007)]


@pytest.mark.parametrize("name", ["capture", "plate", "matte", "scan", "warp", "composite"])
def test_another_version_keeps_nothing(name, shot, command, tmp_path, monkeypatch):
    output = tmp_path / "out"
    words = [*shot.arguments(name), "-o", output, "-q"]
    assert command(*words).code == 0
    before = {path: path.stat().st_mtime_ns for path in output.rglob("*.exr")}
    monkeypatch.setattr("shadowtool.steps.run.__version__", "99")
    assert command(*words, "--resume").code == 0
    for path in before:
        assert path.stat().st_mtime_ns > before[path]
        assert read_image(path).header.provenance["version"] == "99"


@pytest.mark.parametrize("frames", [5, [1], {"1001": 7}, {"1001": {"unknown": "x", "hidden": []}}])
def test_a_record_that_was_tampered_with_does_no_harm(frames, shot, command, tmp_path):
    output = tmp_path / "out"
    words = [*shot.arguments("matte"), "-o", output, "-q"]
    assert command(*words).code == 0
    whole = (output / "shadowtool.json").read_bytes()
    record = read_record(output / "shadowtool.json")
    from shadowtool.io.products import write_json

    write_json(output / "shadowtool.json", record | {"frames": frames})
    outcome = command(*words, "--resume")
    assert outcome.code == 0, outcome.err
    assert (output / "shadowtool.json").read_bytes() == whole


def test_a_file_that_says_nonsense_of_itself_is_made_again(shot, command, tmp_path, tree):
    output = tmp_path / "out"
    words = [*shot.arguments("composite"), "-o", output, "-q"]
    assert command(*words).code == 0
    whole = tree(output)
    path = output / "out.1003.exr"
    data = path.read_bytes()
    at = data.index(b'{"not_finite": 0')
    write_bytes(path, data[:at] + b"[" + b'"t_finite": 0' + data[at + 14 :])
    assert command(*words, "--resume").code == 0
    assert tree(output) == whole


def test_links_that_lead_in_a_circle_are_no_frames(shot, command, tmp_path):
    (tmp_path / "a.1001.exr").symlink_to(tmp_path / "a.1002.exr")
    (tmp_path / "a.1002.exr").symlink_to(tmp_path / "a.1001.exr")
    outcome = command("plate", tmp_path, "-o", tmp_path / "out")
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1


def test_the_disk_fills_up_in_any_write(shot, tmp_path):
    """RLIMIT_FSIZE stops every file at a size, as a quota does."""
    program = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000));"
        "from shadowtool.cli import main; main()"
    )
    output = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, "-c", program, *shot.arguments("composite"), "-o", str(output)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "File too large" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_nothing_is_shared_between_the_words_of_a_command_and_a_shell(shot, command, tmp_path):
    trap = tmp_path / "a; touch owned #$(touch owned)`touch owned`"
    shutil.copytree(shot.source, trap)
    assert command("capture", trap, "-o", tmp_path / "$(touch owned)", "-q").code == 0
    assert not list(tmp_path.rglob("owned"))
    assert not Path("owned").exists()


def spoilt(folder: Path, value: float) -> tuple[int, int]:
    """Put a value into one pixel of one frame."""
    from shadowtool.io.image import write_exr

    path = next(folder.glob("*.1003.exr"))
    image = read_image(path)
    layers = {name: values.copy() for name, values in image.layers.items()}
    next(iter(layers.values()))[16, 20] = value
    write_exr(path, layers, image.header)
    return 16, 20


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -5.0])
def test_a_bad_pixel_stays_where_it_is(value, shot, copied, command, tmp_path):
    clean, bad = tmp_path / "clean", tmp_path / "bad"
    copy = copied("photometric")
    row, column = spoilt(copy, value)
    words = ["--estimator", "minmax", "--holdout", "none", "-q"]
    assert command("plate", shot.photometric, "-o", clean, *words).code == 0
    assert command("plate", copy, "-o", bad, *words).code == 0
    for name in ("lit", "shadow"):
        one, other = (read_image(f / f"{name}.exr").layers["RGB"] for f in (clean, bad))
        differs = (one != other).any(axis=-1)
        differs[row, column] = False
        assert not differs.any()
        assert np.isfinite(other).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_pixels_that_are_no_numbers_are_counted_and_their_frames_named(
    value, shot, copied, command, tmp_path
):
    copy = copied("source")
    spoilt(copy, value)
    outcome = command("matte", copy, "--plates", shot.plates, "-o", tmp_path / "out")
    assert outcome.code == 0
    assert "NaN or infinite in frames 1003 (1)" in outcome.err
    record = read_record(tmp_path / "out" / "shadowtool.json")
    assert [row["not_finite"] for row in record["frames"].values()] == [0, 0, 1, 0, 0, 0]
    for path in (tmp_path / "out").rglob("*.exr"):
        assert all(np.isfinite(values).all() for values in read_image(path).layers.values())


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_bad_pixel_of_a_figure_is_no_figure_there(value, shot, copied, command, tmp_path):
    copy = copied("matte")
    row, column = spoilt(copy / "fg", value)
    for source, name in ((shot.matte, "clean"), (copy, "bad")):
        outcome = command(
            "composite", source, "--plates", shot.plates, "-o", tmp_path / name / "out"
        )
        assert outcome.code == 0
    assert "NaN or infinite in frames 1003 (1)" in outcome.err
    for frame in range(1001, 1007):
        one, other = (
            read_image(tmp_path / name / "out" / f"out.{frame}.exr").layers["RGB"]
            for name in ("clean", "bad")
        )
        differs = (one != other).any(axis=-1)
        assert np.isfinite(other).all()
        differs[row, column] = False
        assert not differs.any()
