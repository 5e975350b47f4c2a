"""Footage: a sequence whose frames are known to fit together, read as linear light."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Missing
from shadowtool.core.noise import (
    NoiseModel,
    noise_levels,
    noise_model,
    sample_positions,
    thin,
)
from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.image import Header, Image, read_header, read_image, resolve_transfer
from shadowtool.io.products import StoredPlates
from shadowtool.io.sequence import Frame, Sequence, open_sequence
from shadowtool.parallel import ordered_map

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Footage:
    """A sequence of pictures of one size.

    Attributes:
        sequence: the frames' files.
        header: the first frame's.
        transfer: the transfer function's name.
    """

    sequence: Sequence
    header: Header
    transfer: str

    def image(self, frame: Frame, apart: bool = False) -> Image:
        """Read a frame.

        Args:
            apart: as of `read_image`.

        Raises:
            InputError, DamagedFileError: it can't be read, or is of another size.
        """
        image = read_image(self.sequence.path(frame), apart)
        _require_same(image.path, image.header, self.header, self.sequence.pattern)
        return image

    def read(self, frame: Frame) -> NDArray[np.floating]:
        """(H, W, 3) linear light; float16 where the file holds linear halfs."""
        return self.image(frame).rgb(self.transfer)

    def measure_noise(self, jobs: int | None = None) -> NoiseModel:
        """The take's noise, from pairs of neighbouring frames spread over the whole of it.

        It does not depend on which frames a run is asked for.
        """
        frames = self.sequence.frames
        positions = sample_positions(len(frames))
        wanted = [frames[position] for position in positions.values()]
        thinned = ordered_map(self._sample, wanted, jobs)
        samples = {number: t for number, t in zip(positions, thinned, strict=True) if t is not None}
        return noise_model(noise_levels(samples))

    def _sample(self, frame: Frame) -> NDArray[np.float32] | None:
        try:
            return thin(self.read(frame))
        except DamagedFileError:
            # Said where the frame itself is worked on.
            return None


def open_footage(
    source: str | Path, role: str = "frames", transfer: str = "auto", missing: Missing = "error"
) -> Footage:
    """Open a sequence and look at every header, so that misfits are found before any work.

    Raises:
        InputError: nothing there, two sequences, mixed sizes or kinds, or files that are refused.
        DamagedFileError: a header is damaged and ``missing`` is "error".
    """
    sequence = open_sequence(source, role)
    first: Header | None = None
    for path in sequence.files.values():
        try:
            header = read_header(path)
        except DamagedFileError:
            if missing == "error":
                raise
            continue
        if first is None:
            first = header
        _require_same(path, header, first, sequence.pattern)
    if first is None:
        raise DamagedFileError(f"{sequence.pattern}: no frame can be read")
    return Footage(sequence, first, resolve_transfer(transfer, next(iter(sequence.files.values()))))


def say_assumed(footage: Footage, transfer: str) -> None:
    """Say what code values are taken for, if that was not given and is not light itself."""
    if transfer == "auto" and footage.transfer != "linear":
        logger.warning(
            "%s: PNG is taken as %s; give --transfer if it is not",
            footage.sequence.pattern,
            footage.transfer,
        )


def say_plates_assumed(folder: Path, stored: StoredPlates, transfer: str = "auto") -> None:
    """The same of plates."""
    if transfer == "auto" and stored.transfer != "linear":
        logger.warning(
            "%s: PNG is taken as %s; write the plates as EXR if they are not",
            folder,
            stored.transfer,
        )


def _require_same(path: Path, header: Header, first: Header, of: str) -> None:
    require_size(path, header, first, of)
    if header.coloured != first.coloured:
        kinds = ("a single channel", "colour")
        raise InputError(
            f"{path}: has {kinds[header.coloured]}, but {of} has {kinds[first.coloured]};"
            " give frames of one kind"
        )


def require_frames(
    sequence: Sequence, frames: Iterable[Frame], expected: Header, of: str, missing: Missing
) -> None:
    """Raise InputError unless a sequence has all these frames, as large as they should be.

    With ``missing`` "skip", frames that are absent or damaged pass; they are skipped in their turn.
    """
    for frame in frames:
        try:
            path = sequence.path(frame)
            header = read_header(path)
        except InputError:
            if missing == "error":
                raise
            continue
        require_size(path, header, expected, of)


def require_size(path: Path, header: Header, expected: Header, of: str) -> None:
    """Raise InputError unless the picture is as large as it should be."""
    if header.size != expected.size:
        raise InputError(
            f"{path}: is {header.width}x{header.height}, but {of} is"
            f" {expected.width}x{expected.height}; give pictures of one size"
        )
