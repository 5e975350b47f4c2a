"""What all steps share: how they are asked to run, what they leave behind, and resuming."""

import hashlib
import json
import logging
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from shadowtool import __version__
from shadowtool.choices import Missing
from shadowtool.errors import InputError, MissingError, OptionError, OutputExistsError
from shadowtool.io.files import fingerprinted, is_file, new_folders, real, size_of
from shadowtool.io.image import EXR, PNG, read_image
from shadowtool.io.products import MANIFEST, folder_lock, read_record, write_json
from shadowtool.io.sequence import Frame, frame_number, frame_range, parse_frames
from shadowtool.parallel import ordered_map

logger = logging.getLogger(__name__)

Item = TypeVar("Item")
Made = TypeVar("Made")

# Flags that are on unless they are switched off by a --no- of their own.
_SWITCHES = {"clamp"}

Progress = Callable[[int, int], None]
Figures = dict[str, Any]


def no_progress(done: int, total: int) -> None:
    """Report nothing."""


@dataclass(frozen=True)
class Run:
    """How a step is to be run, apart from what it computes.

    Attributes:
        frames: a frame range, None for all.
        missing: "error", or "skip" to go on without frames that are absent or damaged.
        jobs: threads, None for as many as the process may use.
        overwrite: replace what is there.
        resume: keep what is there and current, make the rest.
        progress: called with frames done and frames in all.
    """

    frames: str | None = None
    missing: Missing = "error"
    jobs: int | None = None
    overwrite: bool = False
    resume: bool = False
    progress: Progress = no_progress


@dataclass(frozen=True)
class Recipe:
    """Everything that decides a step's result: the same recipe gives the same bits.

    Attributes:
        step: the step's name.
        parameters: values that JSON can hold; no paths, no number of jobs.
        inputs: what was read, as a person would name it, by option (numbered, ``--scan 2``, if it
            is given more than once), or by a word of its own for an argument.
        transfers: the transfer functions that inputs were taken to have, by the same names, where
            one parameter does not say it of all.
    """

    step: str
    parameters: Mapping[str, Any]
    inputs: Mapping[str, str]
    transfers: Mapping[str, str] = field(default_factory=dict)

    @property
    def command(self) -> str:
        """How to run the step again, but for -o: names without their folders."""
        words = ["shadowtool", self.step]
        for name, value in self.inputs.items():
            words += [name.split()[0], value] if name.startswith("--") else [value]
        for name, value in self.parameters.items():
            if isinstance(value, bool):
                words += [f"--{name}"] if value else [f"--no-{name}"] * (name in _SWITCHES)
            elif isinstance(value, (str, int, float)):
                words += [f"--{name}", str(value)]
        return shlex.join(words)

    def fingerprint(self, inputs: Iterable[str]) -> str:
        """Of version, parameters and the fingerprints of what was read."""
        text = json.dumps([__version__, self.step, self.parameters, list(inputs)], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def provenance(self, fingerprint: str) -> dict[str, str]:
        """What goes into every file that the step writes."""
        return {"version": __version__, "command": self.command, "fingerprint": fingerprint}


@dataclass(frozen=True)
class Result:
    """What a step did.

    Attributes:
        output: the folder that it wrote to.
        frames: the frames that it wrote, or looked at.
        kept: how many of them were current and kept.
        skipped: frames that were missing or damaged, with `Run.missing` "skip".
        figures: numbers worth knowing, by name.
    """

    step: str
    output: Path
    frames: Sequence[Frame]
    kept: int = 0
    skipped: Sequence[Frame] = ()
    figures: Figures = field(default_factory=dict)


def refuse_existing(files: Iterable[Path], run: Run) -> None:
    """Stop before anything is replaced that nobody asked to replace.

    Raises:
        OutputExistsError: a file is there, and neither overwriting nor resuming is wanted.
    """
    if run.overwrite or run.resume:
        return
    there = [file for file in files if is_file(file)]
    if there:
        more = f" and {len(there) - 1} more" if len(there) > 1 else ""
        raise OutputExistsError(
            f"{there[0]}{more}: exists already; give --overwrite to replace or --resume to go on"
        )


def refuse_other_step(step: str, output: Path, run: Run) -> None:
    """Stop before another step's record is replaced.

    Raises:
        OutputExistsError: the folder holds one, and overwriting is not wanted.
    """
    other = read_record(output / MANIFEST).get("step", step)
    if other != step and not run.overwrite:
        raise OutputExistsError(
            f"{output / MANIFEST}: is the record of {other}; give another folder"
        )


def refuse_other_format(output: Path, name: str, suffix: str) -> None:
    """Stop before frames are put beside frames of the same name in another format: who reads the
    folder could not tell which are meant.

    Raises:
        OutputExistsError: there are some.
    """
    for file in sorted(output.iterdir()) if output.is_dir() else []:
        if file.name.startswith(f"{name}.") and file.suffix in {EXR, PNG} - {suffix}:
            raise OutputExistsError(f"{file}: a frame in another format; give another folder")


def name_of_frames(output: Path) -> str:
    """What frames that are written right into a folder are called: as it is.

    Raises:
        OptionError: it has no name that a file could have.
    """
    # Frames whose names begin with a dot would be hidden.
    name = real(output).name.lstrip(".")
    if not name.isprintable() or not name:
        raise OptionError(f"-o {str(output)!r}: frames are named after it; give a plain name")
    return name


@dataclass(frozen=True)
class FrameWork:
    """One step's work on single frames.

    Attributes:
        recipe: what decides the result.
        output: the step's folder.
        products: the files that a frame becomes.
        sources: the files that a frame is made of.
        shared: fingerprints of what all frames depend on.
        make: writes the products with the given provenance, returns the frame's figures.
        others: files that a frame becomes under other options only.
    """

    recipe: Recipe
    output: Path
    products: Callable[[Frame], list[Path]]
    sources: Callable[[Frame], list[Path]]
    shared: list[str]
    make: Callable[[Frame, dict[str, str]], Figures]
    others: Callable[[Frame], list[Path]] = lambda frame: []

    def run(
        self,
        frames: Sequence[Frame],
        run: Run,
        absent: Sequence[Frame] = (),
        summary: Callable[[list[Figures]], Figures] = lambda rows: {},
    ) -> Result:
        """Make all the frames and write the manifest.

        Args:
            absent: frames that are missing from the input.
            summary: from the figures of all the frames that the manifest knows.
        """
        refuse_other_step(self.recipe.step, self.output, run)
        refuse_existing((file for frame in frames for file in self.products(frame)), run)
        folders = {file.parent for frame in frames for file in self.products(frame)}
        rows: dict[str, Figures] = {}
        skipped, kept = list(absent), 0
        with new_folders([self.output, *sorted(folders)], shared=run.frames is not None):
            run.progress(0, len(frames))
            make = or_missing(partial(self._frame, run=run), run)
            results = ordered_map(make, frames, run.jobs)
            for number, (frame, outcome) in enumerate(zip(frames, results, strict=True), start=1):
                if isinstance(outcome, MissingError):
                    say_skipped(outcome)
                    skipped.append(frame)
                else:
                    rows[str(frame)] = outcome[0]
                    kept += outcome[1]
                run.progress(number, len(frames))
            if not rows:
                raise InputError(f"{self.output}: no frame could be made; all are skipped")
        warn_of_nan(self.output, {frame: row.get("not_finite", 0) for frame, row in rows.items()})
        warn_of_left(file for frame in frames for file in self.others(frame))
        figures = self._record(rows, summary)
        done = [frame for frame in frames if str(frame) in rows]
        return Result(self.recipe.step, self.output, done, kept, skipped, figures)

    def _frame(self, frame: Frame, run: Run) -> tuple[Figures, bool]:
        sources = self.sources(frame)
        refuse_inputs(self.products(frame), sources)
        with fingerprinted(sources) as inputs:
            mark = self.recipe.fingerprint([*self.shared, *inputs])
            read = sum(map(size_of, sources))
            if run.resume and (figures := current(self.products(frame), mark)) is not None:
                return {"fingerprint": mark, "read": read, **figures}, True
            figures = self.make(frame, self.recipe.provenance(mark))
            return {"fingerprint": mark, "read": read, **figures}, False

    def _record(
        self, rows: dict[str, Figures], summary: Callable[[list[Figures]], Figures]
    ) -> Figures:
        key = self.recipe.fingerprint(self.shared)
        with folder_lock(self.output):
            merged = with_other_chunks(self.output, key, rows, self.products, self._is_of_these)
            try:
                figures = summary(list(merged.values()))
            except (AttributeError, TypeError, ValueError, OverflowError):
                # Somebody else's hand has been in the record; what was made now is known.
                merged, figures = rows, summary(list(rows.values()))
            write_manifest(self.output, self.recipe, key, figures, merged)
        return figures

    def _is_of_these(self, frame: Frame, row: Figures) -> bool:
        """Whether a recorded frame was made of the files that are there now, by how many bytes
        they are: to read those of all other chunks would take too long."""
        try:
            return sum(map(size_of, self.sources(frame))) == row.get("read")
        except InputError:
            return False


def with_other_chunks(
    output: Path,
    key: str,
    rows: dict[str, Figures],
    products: Callable[[Frame], list[Path]],
    is_of_these: Callable[[Frame, Figures], bool],
) -> dict[str, Figures]:
    """The frames of a manifest: a run's own, and what other chunks of the same have recorded.

    Frames of an earlier run that belong to neither are named: who reads the folder next takes them
    for the same take's.

    Args:
        key: the manifest's fingerprint.
        rows: the run's own.
        is_of_these: whether a frame, by its row, is made of what is read now.
    """
    before = read_record(output / MANIFEST)
    recorded = before.get("frames")
    kept, left = dict[str, Figures](), list[Frame]()
    for name, row in recorded.items() if isinstance(recorded, dict) else ():
        frame = frame_number(name)
        if name in rows or frame is None:
            continue
        if before.get("fingerprint") == key and isinstance(row, dict) and is_of_these(frame, row):
            kept[name] = row
        elif any(map(is_file, products(frame))):
            left.append(frame)
    if left:
        logger.warning(
            "%s: frames %s are left from an earlier run, of other settings or input; remove them,"
            " or whatever reads the folder takes them too",
            output,
            frame_range(left),
        )
    return {**kept, **rows}


def refuse_inputs(products: Iterable[Path], sources: Iterable[Path]) -> None:
    """Stop before a step writes over what it reads.

    Raises:
        OptionError: a product is a source.
    """
    read: dict[str, list[Path]] = {}
    for source in sources:
        read.setdefault(source.name, []).append(source)
    for file in products:
        for source in read.get(file.name, ()):
            if is_file(file) and is_file(source) and file.samefile(source):
                raise OptionError(f"{file}: is to be read, not written over; give another -o")


def or_missing(work: Callable[[Item], Made], run: Run) -> Callable[[Item], Made | MissingError]:
    """``work`` that gives the error, instead of raising it, for what is missing and may be; it is
    for `say_skipped`, in the order of the frames."""

    def attempt(item: Item) -> Made | MissingError:
        try:
            return work(item)
        except MissingError as error:
            if run.missing == "error":
                raise
            return error

    return attempt


def say_skipped(error: MissingError) -> None:
    """Say why a frame is skipped."""
    logger.warning("skipped: %s", error)


def warn_of_left(files: Iterable[Path]) -> None:
    """Name files that an earlier run wrote and this one did not, if they are there."""
    if left := [file for file in files if is_file(file)]:
        more = f" and {len(left) - 1} more" if len(left) > 1 else ""
        logger.warning(
            "%s%s: left from an earlier run, of other settings or input; remove what is not meant",
            left[0],
            more,
        )


def warn_of_nan(output: Path, counts: Mapping[str, int]) -> None:
    """Name the frames in which so many pixels, if any, are not finite."""
    found = {frame: count for frame, count in counts.items() if count}
    if found:
        named = ", ".join(f"{frame} ({count})" for frame, count in list(found.items())[:10])
        more = f" and {len(found) - 10} more" if len(found) > 10 else ""
        logger.warning("%s: pixels that are NaN or infinite in frames %s%s", output, named, more)


def with_figures(provenance: dict[str, str], figures: Figures) -> dict[str, str]:
    """Provenance that carries a frame's figures, so that resuming finds them again."""
    return {**provenance, "figures": json.dumps(figures, sort_keys=True)}


def current(files: list[Path], mark: str) -> Figures | None:
    """The figures of products that are whole and made of the same; None if they aren't."""
    figures: Figures = {}
    for file in files:
        if not is_file(file):
            return None
        try:
            provenance = read_image(file).header.provenance
            if provenance.get("fingerprint") != mark:
                return None
            figures.update(json.loads(provenance.get("figures", "{}")))
        except (InputError, ValueError, TypeError, RecursionError):
            return None
    return figures


def unchanged(output: Path, products: Iterable[Path], mark: str) -> Figures | None:
    """For steps with one result: the figures of an earlier run that can be kept, else None."""
    manifest = read_record(output / MANIFEST)
    if manifest.get("fingerprint") != mark:
        return None
    figures = manifest.get("figures")
    if not isinstance(figures, dict):
        return None
    pictures = [file for file in products if file.suffix in (EXR, PNG)]
    records = [file for file in products if file.suffix not in (EXR, PNG)]
    if current(pictures, mark) is None:
        return None
    if any(read_record(file).get("fingerprint") != mark for file in records):
        return None
    # Written anew, so that make sees that the step has been looked after.
    write_json(output / MANIFEST, manifest)
    return figures


def left_out(figures: Figures) -> list[Frame]:
    """The frames that a step with one result recorded as skipped."""
    try:
        return parse_frames(figures["skipped"])
    except (KeyError, AttributeError, OptionError):
        return []


def write_manifest(
    output: Path,
    recipe: Recipe,
    mark: str,
    figures: Figures,
    frames: Mapping[str, Any] | None = None,
) -> None:
    """The last act of every step: the record that a Makefile can depend on."""
    record = {
        "step": recipe.step,
        "version": __version__,
        "command": recipe.command,
        "parameters": dict(recipe.parameters),
        "inputs": dict(recipe.inputs),
        **({"transfers": dict(recipe.transfers)} if recipe.transfers else {}),
        "fingerprint": mark,
        "figures": figures,
    }
    if frames is not None:
        record["frames"] = dict(frames)
    write_json(output / MANIFEST, record)
