"""Footage: a sequence whose frames are known to fit together, read as linear light."""

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Missing
from shadowtool.core.camera_motion import Place, Vantage, displaced, prepared
from shadowtool.core.noise import (
    NoiseModel,
    noise_levels,
    noise_model,
    sample_positions,
    thin,
)
from shadowtool.core.shadow_time import luminance_halfs
from shadowtool.core.trembling import UNSTEADY, strips
from shadowtool.errors import DamagedFileError, InputError
from shadowtool.io.image import (
    PNG,
    Header,
    Image,
    decode,
    read_header,
    read_image,
    read_made,
    resolve_transfer,
)
from shadowtool.io.products import holds_codes, in_place
from shadowtool.io.sequence import Frame, Sequence, open_sequence
from shadowtool.parallel import ordered_map

logger = logging.getLogger(__name__)

Float16 = NDArray[np.float16]
Float32 = NDArray[np.float32]
Look = Callable[[slice, NDArray[Any], NDArray[Any], NDArray[Any]], object]


class Survey(NamedTuple):
    """What a few frames spread over a take tell of it: its noise, their rows as of `strips`, and
    themselves, thinned."""

    noise: NoiseModel
    rows: list[Float32]
    thinned: list[Float32]


@dataclass(frozen=True)
class Footage:
    """A sequence of pictures of one size.

    Attributes:
        sequence: the frames' files.
        header: the first frame's.
        transfer: the transfer function's name.
        vantage: where all frames are seen from; None for each from its own place.
    """

    sequence: Sequence
    header: Header
    transfer: str
    vantage: Vantage | None = None

    @property
    def of_codes(self) -> bool:
        """Whether a PNG's code values are taken as they are."""
        first = next(iter(self.sequence.files.values()))
        return self.transfer == "none" and first.suffix.lower() == PNG

    @property
    def top(self) -> float | None:
        """The most light that a frame can hold; None for floats, which have no such bound."""
        if self.header.bits is None:
            return None
        return float(decode(np.ones(1, np.float32), self.transfer)[0])

    def image(self, frame: Frame) -> Image:
        """Read a frame.

        Raises:
            InputError, DamagedFileError: it can't be read, or is of another size.
        """
        image = read_image(self.sequence.path(frame))
        _require_same(image.path, image.header, self.header, self.sequence.pattern)
        return image

    def luminance(self, frame: Frame, look: Look | None = None) -> tuple[Float16, str]:
        """(H, W) as of `luminance_halfs`, where the camera saw it, and the file's fingerprint.

        Args:
            look: is shown the frame's linear light as it is read, before it is moved: some rows'
                R, G and B, (N, W) each; some rows perhaps again.

        Raises:
            InputError, DamagedFileError: as `image`.
        """

        def make(
            rows: slice,
            red: NDArray[Any],
            green: NDArray[Any],
            blue: NDArray[Any],
            made: Float16,
        ) -> None:
            luminance_halfs(red, green, blue, made)
            # Of another size it is refused below.
            fits = rows.stop <= self.header.height and red.shape[1] == self.header.width
            if look is not None and fits:
                look(rows, red, green, blue)

        path = self.sequence.path(frame)
        header, gray, mark = read_made(path, make, self.transfer)
        _require_same(path, header, self.header, self.sequence.pattern)
        return gray, mark

    def read(self, frame: Frame) -> NDArray[np.floating]:
        """(H, W, 3) linear light, from the vantage; float16 where the file holds linear halfs."""
        return self.light(self.image(frame))[0]

    def light(self, image: Image) -> tuple[NDArray[np.floating], Place]:
        """The same of a frame that was read, and where it was moved from, as of `off`."""
        values = image.rgb(self.transfer)
        place = self.off(values)
        return displaced(values, place), place

    def off(self, light: NDArray[np.floating]) -> Place:
        """How far a frame's light, (H, W) or (H, W, 3), is off what the vantage sees, as of
        `Vantage.off`."""
        return (0.0, 0.0) if self.vantage is None else self.vantage.off(light)

    def steadied(self, frames: list[Frame], jobs: int | None = None) -> "Footage":
        """The same take seen from one place, the middle of those that these frames, all of which
        can be read, are seen from; as it is if they are all seen from one.

        What most of them show stands for the scene, lest somebody in front of it be followed.
        """
        pictures = list(ordered_map(lambda frame: prepared(self.read(frame)), frames, jobs))
        usual = np.asarray(np.median(pictures, axis=0), np.float32)
        vantage = Vantage(usual, self.header.width)
        places = [vantage.off_prepared(picture) for picture in pictures]
        if np.std(places, axis=0).mean() < UNSTEADY:
            return self
        return replace(self, vantage=vantage.amid(places))

    def survey(self, jobs: int | None = None) -> Survey:
        """What frames spread over the whole take tell; it does not depend on which of them a run
        is asked for."""
        frames = self.sequence.frames
        positions = sample_positions(len(frames))
        wanted = [frames[position] for position in positions.values()]
        samples: dict[int, Float32] = {}
        rows = []
        for number, sample in zip(positions, ordered_map(self._sample, wanted, jobs), strict=True):
            if sample is not None:
                samples[number], own_rows = sample
                rows.append(own_rows)
        return Survey(noise_model(noise_levels(samples)), rows, list(samples.values()))

    def _sample(self, frame: Frame) -> tuple[Float32, Float32] | None:
        try:
            light = self.read(frame)
        except DamagedFileError:
            # Said where the frame itself is worked on.
            return None
        return thin(light), strips(light[..., 1])


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


def moved_with(
    values: NDArray[np.floating], path: Path, header: Header, place: Place
) -> NDArray[np.floating]:
    """A frame's matte, moved as the frame is: mattes from elsewhere lie where the camera saw the
    frame. Those of our own steps were made of frames that had been moved.

    Args:
        values: (H, W).
        path, header: the matte's file.
        place: as of `Footage.off`.
    """
    return values if in_place(path, header) else displaced(values, place)


def say_assumed(footage: Footage, transfer: str) -> None:
    """Say what code values are taken for, if that was not given and is not light itself."""
    if transfer == "auto":
        say_taken_as(footage.sequence.pattern, footage.transfer, "give --transfer if it is not")


def say_taken_as(name: object, transfer: str, remedy: str = "write it as EXR if it is not") -> None:
    """The same of any picture for which no transfer function was given."""
    if transfer != "linear":
        logger.warning("%s: PNG is taken as %s; %s", name, transfer, remedy)


def say_mixed(plates: object, header: Header, name: object, codes: bool | None) -> None:
    """Say that plates hold light and frames code values, or the other way round.

    Args:
        header: of the plates.
        name, codes: of what is put together with them; None unknown, and then nothing is said.
    """
    own = holds_codes(header)
    if codes is not None and own is not None and codes != own:
        kinds = "light", "code values (--transfer none)"
        logger.warning(
            "%s: holds %s, but %s is taken as %s; make both with the same --transfer",
            plates,
            kinds[own],
            name,
            kinds[codes],
        )


def say_flickers(footage: Footage, bands: float) -> None:
    """Say that the light flickers, if it does.

    Args:
        bands: by what part rows are brighter or darker than their frame, at most.
    """
    if bands > 0:
        logger.warning(
            "%s: the light flickers, in bands of up to %.1f%% more light or less; they are taken"
            " out, but expose for whole periods of the mains, 1/50 s or 1/60 s",
            footage.sequence.pattern,
            100 * bands,
        )


def _require_same(path: Path, header: Header, first: Header, of: str) -> None:
    require_size(path, header, first, of)
    if header.coloured != first.coloured:
        kinds = ("a single channel", "colour")
        raise InputError(
            f"{path}: has {kinds[header.coloured]}, but {of} has {kinds[first.coloured]};"
            " give frames of one kind"
        )


def select_from(
    sequences: Iterable[Sequence], frames: str | None, missing: Missing
) -> tuple[list[Frame], list[Frame]]:
    """`Sequence.select` from sequences that belong together: a frame that any of them has, or
    should have, is wanted, and present if it is in one. Raises as that does."""
    chosen = [sequence.select(frames, missing) for sequence in sequences]
    present = {frame for own, _ in chosen for frame in own}
    absent = {frame for _, own in chosen for frame in own}
    return sorted(present), sorted(absent - present)


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
