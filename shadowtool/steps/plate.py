"""Lit and shadow plates from a take in which a shadow moves over the scene."""

import contextlib
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shadowtool.choices import Estimator, Gain, Missing, Reading, Steady
from shadowtool.core.beta import shadow_contrast
from shadowtool.core.camera_motion import Place
from shadowtool.core.exposure import (
    Gains,
    clipped_part,
    common_reference,
    flickers,
    is_one,
    level_of,
    of_rows,
    row_gains,
    tint_of,
    unevenness,
    without_gain,
)
from shadowtool.core.grid import exposure_rows, exposure_step, full_size, grid_step, on_grid
from shadowtool.core.half_floats import not_finite, shortened
from shadowtool.core.holdout import (
    Background,
    figure_mask,
    find_background,
)
from shadowtool.core.noise import NoiseModel, noise_levels, noise_model, sample_positions, thin
from shadowtool.core.partial_coverage import complete_shadow
from shadowtool.core.plates import ExtremePlates, Plates
from shadowtool.core.robust_plates import (
    SAMPLES,
    Keyed,
    Levels,
    RobustPlates,
    SampledLevels,
    hide,
    keyed,
)
from shadowtool.core.trembling import UNSTEADY, strips, tremble
from shadowtool.errors import DamagedFileError, InputError, MissingError, OptionError
from shadowtool.io.files import fingerprint_file, make_folder, new_folders, real
from shadowtool.io.image import PNG, Image, read_image, write_exr, write_png
from shadowtool.io.products import HOLDOUT_FOLDER, MANIFEST, confidence_layers, plate_files
from shadowtool.io.sequence import Frame, Sequence, frame_file, frame_range, open_sequence
from shadowtool.parallel import ordered_map
from shadowtool.steps.footage import (
    Footage,
    moved_with,
    open_footage,
    require_frames,
    require_size,
    say_assumed,
    say_flickers,
)
from shadowtool.steps.plane import read_plane
from shadowtool.steps.run import (
    Figures,
    Recipe,
    Result,
    Run,
    left_out,
    or_missing,
    refuse_existing,
    refuse_inputs,
    refuse_other_step,
    say_skipped,
    unchanged,
    warn_of_left,
    warn_of_nan,
    write_manifest,
)

logger = logging.getLogger(__name__)

Bool = NDArray[np.bool_]

UNDER_A_CARD = "a scene under a card"
# Of a scene under a card less than this part in its shadow is worth a word.
_WELL_SHADED = 0.9
# So is clipped light in more than this part of the picture.
_CLIPPED = 0.01
_MID_GREY = np.full(3, 0.18)
# Sampled frames are kept for the second reading up to so many bytes, as far as these with what the
# estimate takes for each pixel stay below a gigabyte.
_KEPT, _WITH_ESTIMATE, _PER_PIXEL = 500 << 20, 1000 << 20, 100
_NOTHING = np.zeros((0, 0, 3), np.float16)
_NO_GRID = np.zeros((0, 0, 3), np.float32)


def plate(
    source: str | Path,
    output: Path,
    *,
    run: Run = Run(),
    holdout: str | Path = "auto",
    estimator: Estimator = "robust",
    plane: str | None = None,
    read_as: Reading = "auto",
    gain: Gain = "auto",
    steady: Steady = "auto",
    transfer: str = "auto",
) -> Result:
    """Write ``lit.exr``, ``shadow.exr`` and ``confidence.exr``.

    Memory does not depend on the number of frames. All are read once; for ``robust``, or to find
    the figure, a fixed number of them once more, before that.

    Args:
        holdout: a matte, roto or trimap sequence; where it is above 0 the pixel is out. "auto"
            finds what isn't background and writes it to ``holdout/``, "none" leaves nothing out.
        gain: find each frame's exposure and take it out, or take frames as they are. Always as
            they are with ``minmax``.
        plane: mask image or polygon of the plane that the shadow falls on, for ``robust``.
        read_as: whether a shadow crossed a plane or a card was waved over a scene, for ``robust``.
        steady: of a camera that trembles, move frames to one place, or take them as they are.
            Always as they are with ``minmax``.

    Raises:
        InputError: frames, holdout or mask are missing or don't fit.
        OptionError: a plane or a reading for ``minmax``, both of them, or a polygon that can't be
            read.
        DamagedFileError: a frame can't be read.
    """
    footage = open_footage(source, "frames", transfer, run.missing)
    say_assumed(footage, transfer)
    frames, absent = footage.sequence.select(run.frames, run.missing)
    automatic = holdout == "auto"
    held = (
        None
        if holdout in ("auto", "none")
        else _open_holdout(holdout, frames, footage, run.missing)
    )
    if plane is not None and estimator == "minmax":
        raise OptionError("--plane is for --estimator robust; Eq. (4) knows no plane")
    if read_as != "auto" and (plane is not None or estimator == "minmax"):
        raise OptionError(
            "--read-as goes neither with --plane, which says it already, nor with minmax"
        )
    marked = None if plane is None else read_plane(plane, footage.header)

    written = [_place(output / HOLDOUT_FOLDER, frame) for frame in frames] if automatic else []
    refuse_other_step("plate", output, run)
    refuse_existing([*plate_files(output), output / MANIFEST, *written], run)
    read = [Path(plane)] if plane else []
    for sequence in filter(None, (footage.sequence, held)):
        read += sequence.files.values()
    refuse_inputs([*plate_files(output), *written], read)
    inputs = {"frames": Path(footage.sequence.pattern).name}
    shared = list[str]()
    if marked is not None:
        inputs["--plane"] = marked.name
        shared = [marked.mark]
    parameters = {
        "frames": frame_range(frames),
        "estimator": estimator,
        "read-as": read_as,
        "transfer": footage.transfer,
        "gain": gain if estimator == "robust" else "none",
        "steady": steady if estimator == "robust" else "none",
        "holdout": Path(held.pattern).name if held is not None else str(holdout),
    }
    recipe = Recipe("plate", parameters, inputs)
    if run.resume:
        known = list(ordered_map(partial(_marks, footage.sequence, held, run), frames, run.jobs))
        figures = _kept(output, recipe, shared, dict(zip(frames, known, strict=True)), run.jobs)
        if figures is not None:
            skipped = left_out(figures)
            used = [frame for frame in frames if frame not in skipped]
            return Result("plate", output, used, len(used), [*absent, *skipped], figures)
    take = _Take(
        footage,
        run,
        held,
        parameters["gain"] == "auto",
        parameters["steady"] == "auto",
        {"card": True, "plane": False}.get(read_as),
        output / HOLDOUT_FOLDER,
        recipe,
    )
    with new_folders([output]):
        if estimator == "minmax":
            estimate = _extremes(take, frames, automatic)
        else:
            region = None if marked is None else marked.region
            estimate = _robust(take, frames, automatic, region)
        missed = not_finite(estimate.lit)
        unseen = 0 if missed is None else int(np.count_nonzero(missed))
        pixels = estimate.lit.shape[0] * estimate.lit.shape[1]
        if unseen == pixels:
            why = _nothing_seen(take)
            take.remove_holdouts()
            raise InputError(why)
    if len(take.used) < 2:
        logger.warning("%s: one frame shows no moving shadow", footage.sequence.pattern)
    warn_of_nan(output, take.not_finite)
    if unseen:
        part = 100 * unseen / pixels
        logger.warning("%s: %d pixels (%.2f%%) were seen in no frame", output, unseen, part)
    marks = {frame: _marks(footage.sequence, held, run, frame) for frame in take.skipped}
    marks |= take.marks
    mark = recipe.fingerprint([*shared, *chain.from_iterable(marks[frame] for frame in frames)])
    provenance = recipe.provenance(mark)
    figures = {
        "frames": len(take.used),
        "skipped": frame_range(take.skipped),
        "held_out": take.held_out(),
        "pixels": pixels,
        "unseen": unseen,
    }

    def products() -> Iterator[tuple[Path, dict[str, NDArray[np.floating]]]]:
        # Each is encoded while the next one is made.
        lit, shadow, confidence = plate_files(output)
        yield lit, {"RGB": estimate.lit}
        plates, noise, clipped, more = estimate.complete()
        figures["clipped"] = round(clipped, 4)
        figures["noise_at_mid_grey"] = [round(float(v), 6) for v in noise.sigma(_MID_GREY)]
        figures.update(more)
        contrast = shadow_contrast(plates, noise)
        yield shadow, {"RGB": plates.shadow}
        yield confidence, confidence_layers(plates, contrast)

    def write(item: tuple[Path, dict[str, NDArray[np.floating]]]) -> None:
        write_exr(item[0], item[1], footage.header, provenance, quick=True)

    for _ in ordered_map(write, products(), run.jobs):
        pass
    if take.trembling is not None:
        figures["trembling"] = round(take.trembling, 3)
    _advise(figures, take, estimator)
    warn_of_left(_other_holdouts(output / HOLDOUT_FOLDER, take, held))
    write_manifest(output, recipe, mark, figures)
    return Result("plate", output, take.used, 0, [*absent, *take.skipped], figures)


def _marks(sequence: Sequence, held: Sequence | None, run: Run, frame: Frame) -> list[str]:
    """Fingerprints of a frame and its holdout; none for one that is missing and may be."""
    try:
        return [fingerprint_file(each.path(frame)) for each in (sequence, held) if each]
    except MissingError:
        if run.missing == "skip":
            return []
        raise


def _kept(
    output: Path, recipe: Recipe, shared: list[str], known: dict[Frame, list[str]], jobs: int | None
) -> Figures | None:
    """The figures of an earlier run, if all that it wrote is there and up to date.

    Args:
        shared, known: fingerprints of what all frames depend on, and of the frames, as of `_marks`.
    """
    mark = recipe.fingerprint([*shared, *chain.from_iterable(known.values())])
    figures = unchanged(output, plate_files(output), mark)
    if figures is None or figures.get("held_out") != HOLDOUT_FOLDER:
        return figures

    def held_out(frame: Frame) -> bool:
        try:
            header = read_image(_place(output / HOLDOUT_FOLDER, frame)).header
        except InputError:
            return False
        # What has no mark somebody has corrected.
        own = recipe.fingerprint(known[frame][:1])
        return header.provenance.get("fingerprint", own) == own

    skipped = left_out(figures)
    used = [frame for frame in known if frame not in skipped]
    return figures if all(ordered_map(held_out, used, jobs)) else None


def _advise(figures: Figures, take: "_Take", estimator: Estimator) -> None:
    """Say what a crew should know of its take."""
    name = take.footage.sequence.pattern
    if take.trembling is not None and take.trembling > UNSTEADY:
        cure = "--steady auto" if estimator == "robust" else "--estimator robust"
        logger.warning(
            "%s: the camera trembles by %.2f pixels; %s",
            name,
            take.trembling,
            "frames are moved to one place"
            if take.footage.vantage is not None
            else f"plates are off where texture is strong; hold it firmly, or give {cure}",
        )
    say_flickers(take.footage, take.bands)
    if figures["clipped"] > _CLIPPED:
        logger.warning(
            "%s: %.1f%% of the picture is clipped: lit.exr is darker there than the light was, and"
            " shadows are too light; expose less",
            name,
            100 * figures["clipped"],
        )
    if figures.get("shaded") == 0:
        logger.warning("%s: no shadow moves over the scene", name)
    elif figures.get("own_evidence") == 0:
        logger.warning(
            "%s: no shadow fell anywhere in full; how dark it would be is guessed from single"
            " frames, look at shadow.exr",
            name,
        )
    elif figures.get("read_as") == UNDER_A_CARD and figures["shaded"] < _WELL_SHADED:
        logger.warning(
            "%s: %.0f%% of the picture never got darker; what is as bright as lit ground counts as"
            " missed by the card, the rest as in shade; if there was no card, give --read-as plane",
            name,
            100 * (1 - figures["shaded"]),
        )


def _nothing_seen(take: "_Take") -> str:
    """Why there is no pixel that any frame shows."""
    finite = (np.isfinite(take.footage.read(f)).all(axis=-1).any() for f in take.used)
    if any(finite):
        return (
            f"{take.footage.sequence.pattern}: the holdout leaves nothing of any frame; give a"
            " smaller one, or --holdout none"
        )
    return (
        f"{take.footage.sequence.pattern}: every pixel of every frame is NaN or infinite;"
        " write the frames again"
    )


class _Completed(NamedTuple):
    """Both plates, the take's noise, how much of it is clipped, and what else is to be recorded."""

    plates: Plates
    noise: NoiseModel
    clipped: float
    figures: Figures


class _Estimate(NamedTuple):
    """The lit plate, and how to come by the rest."""

    lit: NDArray[np.float32]
    complete: Callable[[], _Completed]


class _Shown(NamedTuple):
    """A frame and what is to be left out of it.

    ``keys`` is for the robust estimator alone: with no ``values`` in its last reading, with the
    gray keys only before. ``grid`` is empty where nobody asks for it.
    """

    values: NDArray[np.floating]
    grid: NDArray[np.float32]
    holdout: NDArray[np.number] | None
    keys: Keyed | None
    marks: list[str]
    gain: Gains
    place: Place


class _Kept(NamedTuple):
    """A frame as it was read, its grid, and where it was moved."""

    values: NDArray[np.floating]
    grid: NDArray[np.float32]
    mark: str
    place: Place


@dataclass
class _Take:
    """The frames with their holdouts, read in parallel and handed on in order.

    Attributes:
        held: a holdout that was given.
        background: what the automatic one goes by, once it is known; None for none.
        level: whether changes of exposure are taken out.
        steady: whether frames are moved to one place if the camera trembles.
        card: whether it is that of a card waved over a scene; None while that isn't known.
        reference: what exposure is measured against, on its grid; None until it is known.
        flickers: whether its light does.
        kept: sampled frames that need not be read again.
        known_gains: of the sampled frames.
        masks: their automatic holdouts on the grid, once they are known.
        gains: of the frames that were used, where they are not 1.
        bands: by what part their rows differ in brightness, at most.
        tints: by how much their channels are brighter than they are, where that is not 1.
        trembling: by how much the camera's place varies, pixels; None where it wasn't measured.
        not_finite: how many of their pixels are NaN or infinite.
        folder: where the automatic one is written.
        recipe: what decides the result.
    """

    footage: Footage
    run: Run
    held: Sequence | None
    level: bool
    steady: bool
    card: bool | None
    folder: Path
    recipe: Recipe
    background: Background | None = None
    reference: NDArray[np.float32] | None = None
    flickers: bool = False
    kept: dict[Frame, _Kept] = field(default_factory=dict)
    known_gains: dict[Frame, Gains] = field(default_factory=dict)
    masks: dict[Frame, Bool] = field(default_factory=dict)
    gains: dict[str, float] = field(default_factory=dict)
    bands: float = 0.0
    tints: dict[str, list[float]] = field(default_factory=dict)
    trembling: float | None = None
    not_finite: dict[str, int] = field(default_factory=dict)
    used: list[Frame] = field(default_factory=list)
    skipped: list[Frame] = field(default_factory=list)
    marks: dict[Frame, list[str]] = field(default_factory=dict)

    def held_out(self) -> str:
        """What was left out, in a word or two."""
        if self.held is not None:
            return Path(self.held.pattern).name
        return "nothing" if self.background is None else HOLDOUT_FOLDER

    @property
    def step(self) -> int:
        return grid_step(*self.footage.header.size)

    def grid(self, values: NDArray[np.floating]) -> NDArray[np.float32]:
        """What the automatic holdout looks at of a frame."""
        return on_grid(values, self.step)

    def gain(self, frame: Frame, grid: NDArray[np.float32]) -> Gains:
        """A frame's exposure, from its grid."""
        if self.reference is None:
            return 1.0
        known = self.known_gains.get(frame)
        if known is not None:
            return known
        rows = exposure_rows(*self.footage.header.size)
        return row_gains(self.sparse(grid), self.reference, rows, self.flickers)

    def sparse(self, grid: NDArray[np.float32]) -> NDArray[np.float32]:
        """What exposure takes of a grid."""
        thinning = exposure_step(*self.footage.header.size) // self.step
        return grid[::thinning, ::thinning]

    def shown(self, frames: list[Frame], with_keys: bool, last: bool) -> Iterator[_Shown | None]:
        """Each frame in turn, None for those that are skipped.

        Args:
            last: it is the last reading: holdouts are written, and no frame is kept any longer.
        """

        def read(frame: Frame) -> _Shown:
            if frame in self.kept:
                values, grid, mark, place = self.kept.pop(frame) if last else self.kept[frame]
            else:
                image = self.footage.image(frame)
                values, place = self.footage.light(image)
                mark = image.fingerprint
                needed = not last or self.reference is not None or self.background is not None
                grid = self.grid(values) if needed else _NO_GRID
            gain = self.gain(frame, grid)
            if not is_one(gain):
                values = without_gain(values, gain)
                grid = self.grid(values)
            marks = [mark]
            holdout: NDArray[np.number] | None = None
            if self.held is not None:
                matte = self._given(self.held.path(frame))
                marks.append(matte.fingerprint)
                holdout = moved_with(matte.plane("A", "Y"), matte.path, matte.header, place)
            elif self.background is not None:
                holdout = self.automatic(frame, grid, last)
                if last:
                    own = self.recipe.provenance(self.recipe.fingerprint([mark]))
                    write_png(_place(self.folder, frame), holdout, own)
            keys = keyed(values, holdout) if with_keys else None
            if keys is not None:
                # What nobody asks for any more must not wait in memory.
                if last:
                    values = _NOTHING
                else:
                    keys = keys._replace(keys=_NOTHING.view(np.int16))
            return _Shown(values, grid, holdout, keys, marks, gain, place)

        for item in ordered_map(or_missing(read, self.run), frames, self.run.jobs):
            if isinstance(item, MissingError):
                if last:
                    say_skipped(item)
                yield None
            else:
                yield item

    def automatic(self, frame: Frame, grid: NDArray[np.float32], last: bool) -> NDArray[np.uint8]:
        """The automatic holdout, (H, W) uint8, of a frame's pixels on the grid."""
        assert self.background is not None
        mask = self.masks.pop(frame, None)
        if mask is None:
            mask = figure_mask(grid, self.background)
        if not last:
            self.masks[frame] = mask
        return full_size(mask, *self.footage.header.size, self.step)

    def remove_holdouts(self) -> None:
        """Remove what the last reading wrote, which is of no use."""
        if self.background is not None:
            for frame in self.used:
                _place(self.folder, frame).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.folder.rmdir()

    def all_shown(
        self, frames: list[Frame], with_keys: bool, begun: int
    ) -> Iterator[tuple[int, _Shown]]:
        """All the frames that can be read, with their positions; what is used is recorded."""
        total = begun + len(frames)
        self.run.progress(begun, total)
        for position, item in enumerate(self.shown(frames, with_keys, last=True)):
            if item is None:
                self.skipped.append(frames[position])
            else:
                self.used.append(frames[position])
                self.marks[frames[position]] = item.marks
                if not is_one(item.gain):
                    self.gains[str(frames[position])] = round(level_of(item.gain), 6)
                    self.bands = max(self.bands, round(unevenness(item.gain), 4))
                    if (tint := tint_of(item.gain)) != [1, 1, 1]:
                        self.tints[str(frames[position])] = tint
                yield position, item
            self.run.progress(begun + position + 1, total)
        if not self.used:
            raise DamagedFileError(f"{self.footage.sequence.pattern}: no frame can be read")

    def _given(self, path: Path) -> Image:
        image = read_image(path)
        require_size(path, image.header, self.footage.header, "the footage")
        return image


class _Samples(NamedTuple):
    """What a first reading of some of the frames tells: noise, background, lit levels, and how
    much of them is clipped."""

    noise: NoiseModel
    clipped: float
    levels: Levels
    read: int


def _sample(take: _Take, frames: list[Frame], automatic: bool, with_levels: bool) -> _Samples:
    """Read a few frames; find the automatic holdout's background in them if that is wanted."""
    numbers = {position: number for number, position in sample_positions(len(frames)).items()}
    # The same frames whether the figure is found or given: what was found can be given back.
    positions = sorted({*numbers, *_spread(len(frames))})
    chosen = [frames[position] for position in positions]
    spread = {frames[position] for position in _spread(len(frames))}
    thinned: dict[int, NDArray[np.float32]] = {}
    grids: dict[Frame, NDArray[np.float32]] = {}
    grays: dict[Frame, NDArray[np.int16]] = {}
    rows: list[NDArray[np.float32]] = []
    width, height = take.footage.header.size
    free = min(_KEPT, _WITH_ESTIMATE - _PER_PIXEL * width * height)
    for count, item in enumerate(take.shown(chosen, with_keys=False, last=False)):
        take.run.progress(count, len(positions) + len(frames))
        if item is None:
            continue
        frame, position = chosen[count], positions[count]
        if position in numbers:
            thinned[numbers[position]] = thin(item.values)
        if frame in spread:
            rows.append(strips(item.values[..., 1]))
        grids[frame] = item.grid
        if item.values.nbytes <= free:
            free -= item.values.nbytes
            take.kept[frame] = _Kept(item.values, item.grid, item.marks[0], item.place)
        elif with_levels:
            grays[frame] = keyed(item.values, item.holdout).gray
    noise = noise_model(noise_levels(thinned))
    clipped = clipped_part(list(thinned.values()), take.footage.top)
    apart = [frame for frame in grids if frame in spread]
    if take.footage.vantage is None:
        take.trembling = tremble(rows)
        if take.steady and take.trembling > UNSTEADY:
            moved = take.footage.steadied(apart, take.run.jobs)
            if moved.vantage is not None:
                # What is known of the frames as they were makes room for what they become.
                for known in (take.kept, thinned, grids, grays):
                    known.clear()
                take.footage = moved
                return _sample(take, frames, automatic, with_levels)
            # Somebody large moved, not the camera.
            take.trembling = 0.0
    if take.level and apart:
        sparse = [take.sparse(grids[frame]) for frame in apart]
        take.reference = common_reference(sparse)
        take.flickers = flickers(sparse, take.reference)
    gains = {frame: take.gain(frame, grid) for frame, grid in grids.items()}
    take.known_gains = gains
    # Where a figure is held out by what was given it is a source.
    undecided = take.held is None and take.card is None
    if apart and (undecided or (automatic and not take.card)):
        on_grid_rows = slice(None, None, take.step)
        level = [without_gain(grids[frame], of_rows(gains[frame], on_grid_rows)) for frame in apart]
        background = find_background(level, noise)
        if take.card is None and background.under_card:
            take.card = True
        if automatic and not take.card:
            take.background = background
    if take.background is not None:
        make_folder(take.folder)
    levels = SampledLevels(height, width)
    if with_levels:
        # The others, that were kept or whose exposure is off, are keyed now that all is known.
        ready = [frame for frame in grays if is_one(gains[frame])]
        for frame in ready:
            if take.background is not None:
                hide(grays[frame], take.automatic(frame, grids[frame], last=False) > 0)
            levels.add(grays.pop(frame))
        others = [frame for frame in grids if frame not in ready]
        for item in take.shown(others, with_keys=True, last=False):
            if item is not None and item.keys is not None:
                levels.add(item.keys.gray)
    return _Samples(noise, clipped, levels.levels(), len(positions))


def _spread(frames: int) -> list[int]:
    """Positions of some two dozen frames spread over a take, among them all those by which its
    noise is measured that are first of their pair."""
    starts = sorted(p for number, p in sample_positions(frames).items() if number % 2 == 0)
    if frames <= SAMPLES or len(starts) < 2:
        return list(range(frames))
    each = SAMPLES // (len(starts) - 1)
    places = np.arange(each * (len(starts) - 1) + 1) / each
    between = np.interp(places, np.arange(len(starts)), starts)
    return sorted({*between.round().astype(int).tolist(), frames - 1})


def _extremes(take: _Take, frames: list[Frame], automatic: bool) -> _Estimate:
    """Eq. (4), in one reading of all the frames; only a figure to find takes another."""
    begun = _sample(take, frames, automatic, with_levels=False).read if automatic else 0
    numbers = {position: number for number, position in sample_positions(len(frames)).items()}
    thinned: dict[int, NDArray[np.float32]] = {}
    extremes = ExtremePlates()
    for position, item in take.all_shown(frames, with_keys=False, begun=begun):
        take.not_finite[str(frames[position])] = extremes.add(item.values, item.holdout)
        if position in numbers:
            thinned[numbers[position]] = thin(item.values)
    plates = extremes.plates()

    def complete() -> _Completed:
        noise = noise_model(noise_levels(thinned))
        return _Completed(plates, noise, clipped_part(list(thinned.values()), take.footage.top), {})

    return _Estimate(plates.lit, complete)


def _robust(take: _Take, frames: list[Frame], automatic: bool, region: Bool | None) -> _Estimate:
    """Means of lit and shaded frames, and the plane's ratio where the shadow fell in part."""
    noise, clipped, levels, begun = _sample(take, frames, automatic, with_levels=True)
    estimate = RobustPlates(levels, noise)
    # What has been looked up in them is larger than they are.
    del levels
    for position, item in take.all_shown(frames, with_keys=True, begun=begun):
        assert item.keys is not None
        take.not_finite[str(frames[position])] = item.keys.not_finite
        estimate.add(item.keys)
    found = estimate.measured()
    del estimate
    lit = shortened(found.lit)

    ratio = None if take.background is None else take.background.ratio

    def complete() -> _Completed:
        completed = complete_shadow(
            lit, found.shadow, found.shadow_frames, noise, region, take.card, ratio
        )
        shadow = shortened(completed.shadow)
        plates = Plates(lit, shadow, found.lit_frames, found.shadow_frames)
        seen = found.lit_frames > 0
        shaded = found.shadow_frames > 0
        reading = "a plane that a shadow crossed" if completed.partial else UNDER_A_CARD
        figures: Figures = {
            "gains": take.gains,
            "bands": take.bands,
            "tints": take.tints,
            "shaded": round(float(shaded.mean()), 4),
            "own_evidence": round(float(completed.own[seen].mean()), 4) if seen.any() else 0.0,
            "read_as": reading if shaded.any() else "a scene without shadow",
        }
        return _Completed(plates, noise, clipped, figures)

    return _Estimate(lit, complete)


def _other_holdouts(folder: Path, take: "_Take", given: Sequence | None) -> list[Path]:
    """Holdouts that are neither of this run nor what it was given."""
    if given is not None and real(Path(given.pattern).parent) == real(folder):
        return []
    written = [] if take.background is None else [_place(folder, frame) for frame in take.used]
    return sorted(set(folder.glob(f"*{PNG}")) - set(written))


def _place(folder: Path, frame: Frame) -> Path:
    return folder / frame_file(HOLDOUT_FOLDER, frame, PNG)


def _open_holdout(
    holdout: str | Path, frames: list[Frame], footage: Footage, missing: Missing
) -> Sequence:
    sequence = open_sequence(holdout, "holdout")
    require_frames(sequence, frames, footage.header, "the footage", missing)
    return sequence
