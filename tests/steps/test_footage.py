"""Frames as they are read, and as they change meanwhile."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from shadowtool.core.shadow_time import luminance_halfs
from shadowtool.errors import InputError
from shadowtool.steps.footage import open_footage
from tests.conftest import write_frames


@pytest.fixture
def shots() -> list[np.ndarray]:
    return [np.random.default_rng(n).random((20, 30, 3)).astype(np.float16) for n in range(2)]


def test_the_light_of_all_rows_is_shown_while_luminance_is_found(
    shots: list[np.ndarray], tmp_path: Path
) -> None:
    footage = open_footage(write_frames(tmp_path / "take", shots))
    shown = np.full((20, 30, 3), np.nan, np.float16)

    def look(rows: slice, *colours: np.ndarray) -> None:
        for index, colour in enumerate(colours):
            shown[rows, :, index] = colour

    for frame, shot in zip(footage.sequence.frames, shots, strict=True):
        gray, _ = footage.luminance(frame, look)
        np.testing.assert_array_equal(shown, shot)
        np.testing.assert_array_equal(gray, luminance_halfs(*np.moveaxis(shot, -1, 0)))


@pytest.mark.parametrize("size", [(24, 30), (20, 36), (10, 30), (20, 10)])
def test_a_frame_that_became_another_size_is_refused(
    size: tuple[int, int], shots: list[np.ndarray], tmp_path: Path
) -> None:
    take = write_frames(tmp_path / "take", shots)
    footage = open_footage(take)
    shutil.rmtree(take)
    write_frames(take, [np.ones((*size, 3), np.float16)] * 2)
    shown = np.empty((20, 30), np.float16)

    def look(rows: slice, red: np.ndarray, green: np.ndarray, blue: np.ndarray) -> None:
        shown[rows, : red.shape[1]] = red

    with pytest.raises(InputError, match="give pictures of one size"):
        footage.luminance(footage.sequence.frames[0], look)
