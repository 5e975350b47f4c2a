"""Numbered frames on disk: a folder, a pattern, or one file."""

import itertools
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import NamedTuple

from fileseq import findSequencesInList
from fileseq.constants import PAD_STYLE_HASH1
from fileseq.exceptions import FileSeqException
from fileseq.filesequence import FileSequence
from fileseq.frameset import FrameSet

from shadowtool.choices import Missing
from shadowtool.errors import InputError, MissingError, OptionError
from shadowtool.io.files import is_file, leads_nowhere, real
from shadowtool.io.image import EXR, PNG

Frame = int | Decimal

# Frame numbers further apart than this are not one sequence.
_WIDEST = 1_000_000
_NUMBER = re.compile(r"-?\d{1,15}(\.\d{1,15})?")
# What stands between a name and a number.
_SEPARATORS = "._- "
_TOKEN = r"(?:[#@]|%\d*d|\$F\d*|<UDIM>)"
_TOKENS = re.compile(_TOKEN)
# A dash is a minus at a name's beginning and after a separator; else it belongs to the name.
# fileseq takes all for minuses, but none that is cut off by what no name holds.
_MINUS, _CUT = r"(?:(?<![^._-])-)?", "\0_"
_RANGE = r"\d+(?:--?\d+(?:[xy:]-?\d+)?)?"
_OF_FILE = re.compile(rf"(.*?)({_MINUS}\d+(?:\.\d+)?\.[^.]+)")
_OF_PATTERN = re.compile(rf"(.*?)((?:{_MINUS}{_RANGE}(?:,-?{_RANGE})*)?{_TOKEN}+\.[^.]+)")


@dataclass(frozen=True)
class Sequence:
    """Frames of one kind in one folder.

    Attributes:
        name: the part of the files' names before the number, without its separator.
        pattern: how a person would write it, for messages and records.
        files: path by frame number, ascending.
        gone: frames of which there is no more than a link to nothing.
        asked: frames that the pattern itself names, ascending; none for whatever is there.
    """

    name: str
    pattern: str
    files: dict[Frame, Path]
    gone: tuple[Frame, ...] = ()
    asked: tuple[Frame, ...] = ()

    @property
    def frames(self) -> tuple[Frame, ...]:
        return tuple(self.files)

    def __len__(self) -> int:
        return len(self.files)

    def path(self, frame: Frame) -> Path:
        """The frame's file.

        Raises:
            MissingError: the sequence has no such frame.
        """
        try:
            return self.files[frame]
        except KeyError:
            raise MissingError(
                f"{self.pattern}: has no frame {frame}, only {frame_range(self.files)}"
            ) from None

    def gaps(self) -> tuple[Frame, ...]:
        """Frames that are missing between the first and the last.

        A constant step of two or more over three frames or more is taken as meant so.

        Raises:
            InputError: a number is so far off that it must belong to something else.
        """
        numbers = [frame for frame in self.files if isinstance(frame, int)]
        if len(numbers) != len(self.files) or len(numbers) < 2:
            return ()
        steps = {b - a for a, b in itertools.pairwise(numbers)}
        if len(steps) == 1 and len(numbers) > 2:
            return ()
        step = min(steps) if len(numbers) > 2 else 1
        if any(s % step for s in steps):
            step = 1
        for before, after in itertools.pairwise(numbers):
            if after - before > _WIDEST:
                raise InputError(
                    f"{self.pattern}: missing frames {before + 1}-{after - 1}; put the stray frame"
                    " elsewhere"
                )
        present = set(numbers)
        return tuple(f for f in range(numbers[0], numbers[-1], step) if f not in present)

    def select(
        self, frames: str | None, missing: Missing = "error"
    ) -> tuple[list[Frame], list[Frame]]:
        """The frames to work on, and those that should be there but aren't.

        Args:
            frames: a range such as ``1001-1048x2,1100``; None for all that were asked for, or are
                there.
            missing: "error" refuses to go on without the missing ones.

        Raises:
            InputError: frames are missing, or none is left.
            OptionError: the range can't be read.
        """
        if frames is None:
            wanted: Iterable[Frame] = self.asked or sorted({*self.files, *self.gaps(), *self.gone})
        else:
            wanted = parse_frames(frames)
        present = [frame for frame in wanted if frame in self.files]
        absent = [frame for frame in wanted if frame not in self.files]
        if absent and not present:
            raise InputError(
                f"{self.pattern}: missing frames {frame_range(absent)};"
                f" it has only {frame_range(self.files)}"
            )
        if absent and missing == "error":
            raise InputError(
                f"{self.pattern}: missing frames {frame_range(absent)};"
                " restore them, or give --missing skip"
            )
        return present, absent


def open_sequence(source: str | Path, role: str = "frames") -> Sequence:
    """Find the frames that a folder, a pattern or a file name stands for.

    Args:
        source: a folder that holds one sequence; ``a/b.%04d.exr``, ``a/b.####.exr``,
            ``a/b.1001-1048#.exr``; or a single EXR or PNG.
        role: what the frames are for, used in messages.

    Raises:
        InputError: nothing there, nothing that can be read, or more than one sequence.
    """
    text = os.fspath(source)
    if not text:
        raise InputError(f"no file or folder is named for the {role}")
    path = Path(text)
    try:
        if path.is_dir():
            return _in_folder(path, role)
        if path.is_file():
            return _single(path)
    except OSError as error:
        raise InputError(f"{_short(text)}: cannot look there: {error.strerror}") from None
    if not _TOKENS.search(path.name):
        raise InputError(f"{_short(text)}: no such file or folder{_for(role)}")
    return _of_pattern(path, role)


def parse_frames(text: str) -> list[Frame]:
    """Frame numbers of a range such as ``1001-1048``, ``1001-1048x2``, ``1,5,9-20``.

    ``1-10:2`` means every second frame, as on a render farm.

    Returns:
        Ascending, each once.

    Raises:
        OptionError: it can't be read.
    """
    try:
        parts = [part.strip() for part in text.replace(":", "x").split(",")]
        whole = not any(re.search(r"\s", part) for part in parts)
        frames = _frames(FrameSet(",".join(parts))) if whole else []
    except (FileSeqException, ValueError, TypeError, ArithmeticError):
        frames = []
    if not frames or any(frame_number(str(frame)) is None for frame in frames):
        raise OptionError(
            f"--frames {_short(text)}: not a frame range; write 1001-1048, 1001-1048x2 or 1,5,9-20"
        )
    return sorted(set(frames))


def frame_range(frames: Iterable[Frame]) -> str:
    """Frame numbers as a person writes them: ``1001-1048,1100``."""
    return str(FrameSet(sorted(frames))) or "none"


def frame_number(text: str) -> Frame | None:
    """The number that a frame is recorded under; None if it is none."""
    if not _NUMBER.fullmatch(text):
        return None
    return Decimal(text) if "." in text else int(text)


def frame_file(name: str, frame: Frame, suffix: str) -> str:
    """``NAME.1001.exr``: four characters at least, a fraction kept."""
    whole, dot, part = str(frame).partition(".")
    return f"{name}.{whole.zfill(4)}{dot}{part}{suffix}"


def _in_folder(folder: Path, role: str) -> Sequence:
    found = _sequences(folder)
    if not found:
        raise InputError(
            f"{folder}: holds no EXR or PNG frames{_for(role)}; run capture on a movie, and convert"
            " other pictures first"
        )
    # One sequence and a still beside it (a reference, a slate) is one sequence.
    chosen = [sequence for sequence in found if sequence.digits] or found
    if len(chosen) > 1:
        names = " and ".join(item.sequence.pattern for item in chosen[:2])
        more = f" and {len(chosen) - 2} more" if len(chosen) > 2 else ""
        raise InputError(f"{folder}: holds {names}{more}; name the one that is meant")
    return chosen[0].sequence


class _Found(NamedTuple):
    """A sequence in a folder, and what its files' names are made of: no digits in a still's."""

    sequence: Sequence
    base: str
    suffix: str
    digits: int


def _sequences(folder: Path) -> list[_Found]:
    pictures = [
        path
        for path in folder.iterdir()
        if not path.name.startswith(".") and path.suffix.lower() in (EXR, PNG)
    ]
    names = sorted(_cut(path.name) for path in pictures if is_file(path) or leads_nowhere(path))
    try:
        found = findSequencesInList(names)
        numbered = [s for s in found if s.frameSet()]
        if len(numbered) > 1:
            # 1001.00, 1001.50, 1002.00 look like a sequence for each whole number.
            members = [name for s in numbered for name in s]
            fractional = findSequencesInList(members, allow_subframes=True)
            if len(fractional) == 1 and _fractions(_frames(fractional[0].frameSet() or ())):
                found = fractional
        return [_from_fileseq(folder, s) for s in sorted(found, key=str)]
    except (FileSeqException, ArithmeticError) as error:
        raise InputError(f"{folder}: its frames can't be numbered: {error}") from None


def _fractions(frames: list[Frame]) -> bool:
    """Whether the digits after the point are parts of a frame, not takes' own frame numbers."""
    parts = {frame % 1 for frame in frames}
    return max(len(str(part).partition(".")[2]) for part in parts) <= 3


def _from_fileseq(folder: Path, sequence: FileSequence) -> _Found:
    frame_set = sequence.frameSet()
    base, suffix = _whole(sequence.basename()), sequence.extension()
    if not frame_set:
        path = folder / _whole(str(sequence))
        return _Found(_single(path), base, suffix, digits=0)
    places = {frame: folder / _whole(sequence.frame(frame)) for frame in sorted(_frames(frame_set))}
    gone = tuple(frame for frame, path in places.items() if leads_nowhere(path))
    files = {frame: path for frame, path in places.items() if frame not in gone}
    digits = max(sequence.zfill(), 1)
    name = base.rstrip(_SEPARATORS) or real(folder).name
    pattern = os.fspath(folder / f"{base}{'#' * digits}{suffix}")
    if not files:
        raise InputError(f"{pattern}: links that lead nowhere; restore what they lead to")
    return _Found(Sequence(name, pattern, files, gone), base, suffix, digits)


def _single(path: Path) -> Sequence:
    if path.suffix.lower() not in (EXR, PNG):
        raise _unreadable(path)
    number = re.fullmatch(rf"(.*?)({_MINUS}\d+)", path.stem)
    if number is None:
        return Sequence(path.stem, os.fspath(path), {1: path})
    name = number[1].rstrip(_SEPARATORS) or real(path).parent.name
    return Sequence(name, os.fspath(path), {int(number[2]): path})


def _of_pattern(path: Path, role: str) -> Sequence:
    suffix = path.suffix
    if suffix.lower() not in (EXR, PNG):
        raise _unreadable(path)
    try:
        # One digit for each #, as we write patterns ourselves.
        wanted = FileSequence(_cut(path.name), pad_style=PAD_STYLE_HASH1)
        base, asked = _whole(wanted.basename()), sorted(_frames(wanted.frameSet() or ()))
        found = [
            item
            for item in _sequences(path.parent)
            if item.digits and (item.base, item.suffix) == (base, suffix)
        ]
    except (FileSeqException, ValueError, ArithmeticError, OSError):
        found = []
    if not found:
        raise InputError(f"{_short(os.fspath(path))}: no such frames are there{_for(role)}")
    if len(found) > 1:
        # The number of digits tells sequences apart only where there are several.
        found = [item for item in found if item.digits == max(wanted.zfill(), 1)]
    if len(found) != 1:
        raise InputError(
            f"{_short(os.fspath(path))}: frames with other numbers of digits are there;"
            " write as many # as the digits of those that are meant"
        )
    sequence = found[0].sequence
    if not asked:
        return sequence
    files = {frame: sequence.files[frame] for frame in asked if frame in sequence.files}
    if not files:
        raise InputError(
            f"{sequence.pattern}: missing frames {frame_range(asked)};"
            f" it has only {frame_range(sequence.files)}"
        )
    return replace(sequence, files=files, asked=tuple(asked))


def _cut(name: str) -> str:
    """A file's name or a pattern, so that fileseq takes no dash in it for a minus that is none."""
    parts = _OF_FILE.fullmatch(name) or _OF_PATTERN.fullmatch(name)
    return f"{parts[1]}{_CUT}{parts[2]}" if parts and parts[1].endswith("-") else name


def _whole(name: str) -> str:
    """A name as it was before `_cut`."""
    return name.replace(_CUT, "")


def _frames(frame_set: Iterable[int | float | Decimal]) -> list[Frame]:
    """Frame numbers as fileseq gives them, which is never a float for numbers read from text."""
    return [f if isinstance(f, int) else Decimal(str(f)) for f in frame_set]


def _unreadable(path: Path) -> InputError:
    return InputError(
        f"{_short(os.fspath(path))}: neither EXR nor PNG; run capture on a movie, and convert other"
        " pictures first"
    )


def _for(role: str) -> str:
    return "" if role == "frames" else f" for the {role}"


def _short(text: str) -> str:
    line = "".join(c if c.isprintable() else "?" for c in text)
    return line if len(line) <= 200 else f"{line[:100]}…{line[-60:]}"
