"""The displacement map from scans, and frames seen through it."""

import logging
import math
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np

from shadowtool.choices import ITERATIONS, OUTSIDE
from shadowtool.core.bands import bands, in_all_channels
from shadowtool.core.diffusion import diffuse
from shadowtool.core.epipole import Epipole
from shadowtool.core.half_floats import LARGEST_HALF, not_finite, to_float, to_half
from shadowtool.core.inverse_map import compose, invert
from shadowtool.core.pictures import warp_picture
from shadowtool.core.shadow_lines import part_off_lines
from shadowtool.core.warp_map import (
    LEAST_ANGLE,
    Pass,
    WarpMap,
    pass_angles,
    positions,
    sample,
)
from shadowtool.errors import OptionError, ReshootError
from shadowtool.io.files import is_file, make_folder, real
from shadowtool.io.image import (
    EXR,
    PNG,
    Header,
    Image,
    decode,
    read_header,
    read_image,
    write_exr,
    write_png,
)
from shadowtool.io.products import (
    MANIFEST,
    WARP,
    map_place,
    read_record,
    read_scan,
    read_warp,
    write_json,
    write_warp,
)
from shadowtool.io.sequence import Frame, Sequence, frame_file, open_sequence
from shadowtool.steps.footage import require_size
from shadowtool.steps.run import (
    Figures,
    FrameWork,
    Recipe,
    Result,
    Run,
    refuse_existing,
    refuse_other_step,
    unchanged,
    warn_of_left,
    with_figures,
    write_manifest,
)
from shadowtool.steps.solve import marked, solve

logger = logging.getLogger(__name__)

PICTURE = "warp.png"

# Maps of which less of the frame is measured, or of which half is predicted to be off by more
# pixels, are of no use.
_LEAST_KNOWN, _WORST_ERROR = 0.05, 8.0
# Displacements of more pixels than this have a direction that can be told.
_DISPLACED = 8.0
# If displacements have none in common, and more of the plane than this lies off the edge's lines,
# it was no edge that passed.
_ASTRAY = 0.2
# More of what sweeps reached off the plane than this is filled in only if single ones reached it,
# or if it was no shadow that did; told if they reached more of the frame there than this.
_UNCONFIRMED, _LEAST_REACHED = 0.25, 0.02
# A file that takes up more than this part of its pixels' room holds grain.
_GRAIN = 0.5


def warp(
    scans: list[Path],
    output: Path,
    *,
    run: Run = Run(),
    map_file: Path | None = None,
    source_scans: list[Path] | None = None,
    apply_to: str | Path | None = None,
    outside: float = OUTSIDE,
    iterations: int = ITERATIONS,
) -> list[Result]:
    """Solve a map from scans, or take one that is there, and see frames through it.

    Solving writes ``warp.exr`` and a picture of it. Applying writes frames under
    ``NAME/NAME.1001.exr``, NAME the input's: every channel resampled bilinearly as it is stored, at
    the map's size.

    Args:
        scans: two or more folders of `scan`; none with ``map_file``.
        map_file: an ST map, or the folder in which one was solved.
        source_scans: two or more scans of the source, if that isn't flat: the map then leads on
            from the reference plane to where the source shows the shadow.
        apply_to: frames to warp.
        outside: the value where the map points outside the frame; 1 is lit.
        iterations: of the diffusion; 0 only fills.

    Returns:
        The results of solving and applying, as far as each was done.

    Raises:
        InputError: scans, map or frames are missing or don't fit.
        OptionError: neither or both of scans and map, nothing to do, or an option that would
            change nothing.
        ReshootError: the passes can't fix any point.
    """
    if bool(scans) == (map_file is not None):
        raise OptionError("give two or more SCAN folders, or --map FILE")
    if map_file is not None and apply_to is None:
        raise OptionError("--map FILE needs --apply FRAMES")
    if map_file is None and len(scans) < 2:
        raise OptionError("a map takes two scans or more, swept at different angles")
    if source_scans and map_file is not None:
        raise OptionError("--source-scan goes with SCAN folders, not with --map")
    if map_file is not None and iterations != ITERATIONS:
        raise OptionError("--iterations goes with SCAN folders, not with --map")
    if apply_to is None and run.frames is not None:
        raise OptionError("--frames says which frames --apply warps; give --apply FRAMES")
    if apply_to is None and outside != OUTSIDE:
        raise OptionError("--outside goes with --apply FRAMES")
    if not abs(outside) <= LARGEST_HALF:
        raise OptionError(f"--outside {outside}: must be a number that a half float can hold")
    if source_scans and len(source_scans) < 2:
        raise OptionError("give --source-scan twice or more, for sweeps at different angles")
    applied = None if apply_to is None else _open_frames(apply_to, output, run)
    if map_file is not None:
        assert applied is not None
        # A folder in which a map was solved keeps the record of that.
        also_in = None if is_file(output / WARP) else output
        return [_apply(map_place(map_file), applied, run, outside, also_in)]
    results = [_solve(scans, source_scans or [], output, run, iterations)]
    if not results[0].kept:
        now = {applied.folder} if applied else set()
        for folder in sorted(_applied_before(output) - now):
            warn_of_left(sorted(folder.glob(f"*{EXR}")))
    if applied is not None:
        results.append(_apply(output / WARP, applied, run, outside))
    return results


def _applied_before(output: Path) -> set[Path]:
    """The folders of frames as an earlier map saw them."""
    records = {record.parent: read_record(record) for record in output.glob(f"*/{MANIFEST}")}
    return {
        folder
        for folder, record in records.items()
        if record.get("step") == "warp" and "--apply" in str(record.get("command"))
    }


@dataclass(frozen=True)
class _Scans:
    """The passes of one set, the target's or the source's."""

    folders: list[Path]
    passes: list[Pass]
    header: Header
    marks: list[str]

    @property
    def names(self) -> list[str]:
        return [real(folder).name for folder in self.folders]

    @property
    def labels(self) -> list[str]:
        """What tells the folders apart: their names, with those above them where they need it."""
        paths = [real(folder) for folder in self.folders]
        for depth in range(1, max(len(path.parts) for path in paths) + 1):
            labels = ["/".join(path.parts[-depth:]) for path in paths]
            if len(set(labels)) == len(set(paths)):
                break
        return labels

    def require_angles(self) -> None:
        """Refuse sweeps that run in nearly the same direction."""
        one, other, widest = max(pass_angles(self.passes), key=lambda row: row[2])
        if widest < LEAST_ANGLE:
            raise ReshootError(
                f"{self.folders[one]} and {self.folders[other]}: reshoot: the sweeps are only"
                f" {math.degrees(widest):.1f} degrees apart; turn the stick by 45 or more"
            )

    def solve(self, run: Run, output: Path) -> tuple[WarpMap, Figures]:
        """W as the passes measure it, and what a crew needs to know; refused if they hardly do.

        The passes are gone afterwards: there may be a gigabyte of them.
        """
        measured, epipole, left_out = solve(self.passes, run.jobs, run.progress)
        if left_out is not None:
            logger.warning(
                "%s: does not agree with the other sweeps, and is left out; sweep it again, at an"
                " even pace, with a board whose shadow is wider than its steps",
                self.folders[left_out],
            )
        known = np.isfinite(measured.error)
        if known.mean() < _LEAST_KNOWN:
            raise ReshootError(
                f"{output}: reshoot: two sweeps reached only {known.mean():.1%} of the frame"
                f" ({', '.join(self.labels)}); let every sweep cross all of it"
            )
        error = float(np.median(measured.error[known]))
        if error > _WORST_ERROR:
            raise ReshootError(
                f"{output}: reshoot: the map would be off by {error:.1f} pixels"
                f" ({', '.join(self.labels)}); sweep more slowly, with a straighter edge"
            )
        figures = _figures(self.labels, self.passes, measured, epipole)
        self._require_shadows(figures, output)
        figures["left_out"] = None if left_out is None else self.labels[left_out]
        if figures["unconfirmed"] > _UNCONFIRMED:
            logger.warning(
                "%s: of what sweeps reached off the marked plane %.0f%% is filled in, as no two of"
                " them agree there; let two or more cross all that stands on it, and stay out of"
                " the picture",
                output,
                100 * figures["unconfirmed"],
            )
        self.passes.clear()
        return measured, figures

    def _require_shadows(self, figures: Figures, output: Path) -> None:
        """Refuse sweeps in which something else than an edge's shadow passed.

        Lines may be fitted to what hides the plane, too, but much of that doesn't lie on them, and
        what is displaced by it is displaced anywhere.
        """
        furthest = figures["displacement"]["p99"]
        if figures["light"] is not None or furthest <= _DISPLACED:
            return
        off = [
            0.0 if scan.plane is None else part_off_lines(scan.times.time, scan.plane, scan.lines)
            for scan in self.passes
        ]
        worst = max(range(len(off)), key=off.__getitem__)
        if off[worst] > _ASTRAY:
            raise ReshootError(
                f"{output}: reshoot: the shadow is displaced by up to {furthest:.0f} pixels, but"
                f" not towards one place, as by one light, and {off[worst]:.0%} of the plane lies"
                f" off the edge's lines in {self.folders[worst]}; sweep a straight stick whose"
                " shadow reaches across all of the plane, and stay out of the picture"
            )


def _open_scans(folders: list[Path], beside: tuple[Header, str] | None = None) -> _Scans:
    for position, folder in enumerate(folders):
        if any(real(folder) == real(other) for other in folders[:position]):
            raise OptionError(f"{folder}: is given twice; give each scan once")
    read = [read_scan(folder) for folder in folders]
    header, name = beside or (read[0][1], str(folders[0]))
    for folder, (_, other, _) in zip(folders, read, strict=True):
        require_size(folder, other, header, name)
    return _Scans(folders, [row[0] for row in read], read[0][1], [row[2] for row in read])


def _solve(
    scans: list[Path], source_scans: list[Path], output: Path, run: Run, iterations: int
) -> Result:
    target = _open_scans(scans)
    source = _open_scans(source_scans, (target.header, str(scans[0]))) if source_scans else None
    refuse_other_step("warp", output, run)
    refuse_existing([output / WARP, output / MANIFEST], run)
    inputs = {f"scan {i}": name for i, name in enumerate(target.names, start=1)}
    marks = list(target.marks)
    if source is not None:
        inputs |= {f"--source-scan {i}": name for i, name in enumerate(source.names, start=1)}
        marks += ["source", *source.marks]
    recipe = Recipe("warp", {"iterations": iterations}, inputs)
    mark = recipe.fingerprint(marks)
    if run.resume:
        figures = unchanged(output, [output / WARP, output / PICTURE], mark)
        if figures is not None:
            return Result("warp", output, [], 1, (), figures)
    for every in (target, source):
        if every is not None:
            every.require_angles()
    shown = _gray(target.passes)
    measured, figures = target.solve(run, output)
    result = diffuse(measured, iterations, plane_beyond=True)
    if source is not None:
        own, figures["source"] = source.solve(run, output)
        onward = invert(diffuse(own, iterations, plane_beyond=True))
        measured = compose(result, onward)
        seen = float(np.isfinite(measured.error).mean())
        if seen < _LEAST_KNOWN:
            raise ReshootError(
                f"{output}: reshoot: the source's sweeps ({', '.join(source.labels)}) show only"
                f" {seen:.1%} of the ground that the target's frame needs; let them cross the same"
            )
        # Ground that the source's camera doesn't see is filled in from around it.
        result = diffuse(measured, 0)
        figures["source"]["seen"] = round(seen, 4)
    if figures["light"] is None and figures["displacement"]["p99"] > _DISPLACED:
        logger.warning(
            "%s: the shadow is displaced by up to %.0f pixels, but not towards one place, as by one"
            " light; objects are less well known",
            output,
            figures["displacement"]["p99"],
        )
    provenance = recipe.provenance(mark)
    make_folder(output)
    write_warp(output / WARP, result, target.header, provenance)
    write_png(output / PICTURE, warp_picture(in_all_channels(shown), result), provenance)
    write_manifest(output, recipe, mark, figures)
    return Result("warp", output, [], 0, (), figures)


@dataclass(frozen=True)
class _Frames:
    """Frames to warp, and where they go."""

    sequence: Sequence
    present: list[Frame]
    absent: list[Frame]
    folder: Path

    def place(self, frame: Frame) -> Path:
        return self.folder / frame_file(self.sequence.name, frame, EXR)


def _open_frames(source: str | Path, output: Path, run: Run) -> _Frames:
    sequence = open_sequence(source, "frames to warp")
    present, absent = sequence.select(run.frames, run.missing)
    if run.missing == "error":
        for frame in present:
            read_header(sequence.path(frame))
    if any(sequence.path(frame).suffix.lower() == PNG for frame in present):
        logger.warning(
            "%s: PNG's code values are written to EXR as they are; run capture on pictures first",
            sequence.pattern,
        )
    frames = _Frames(sequence, present, absent, output / sequence.name)
    refuse_existing(map(frames.place, present), run)
    return frames


def _apply(
    map_file: Path, frames: _Frames, run: Run, outside: float, also_in: Path | None = None
) -> Result:
    """Warp frames, and record that beside them.

    Args:
        also_in: another folder that gets the same record: that of what was last warped into it.
    """
    if also_in is not None:
        refuse_other_step("warp", also_in, run)
    warp_map, header, map_mark = read_warp(map_file)
    sequence = frames.sequence
    recipe = Recipe(
        "warp",
        {"outside": outside},
        {"--map": map_file.name, "--apply": Path(sequence.pattern).name},
    )

    def products(frame: Frame) -> list[Path]:
        return [frames.place(frame)]

    places = positions(warp_map.warp)

    def make(frame: Frame, provenance: dict[str, str]) -> Figures:
        image = read_image(sequence.path(frame))
        scaled = _scaled(places, header, image.header)
        layers, bad = {}, np.zeros((), bool)
        for name, values in image.layers.items():
            edge = 0.0 if name == "confidence" else outside
            unknown = not_finite(values) if values.dtype.kind == "f" else None
            bad = bad if unknown is None else bad | unknown
            single = decode(values, "none")
            layers[name] = _warped(single, scaled, edge, unknown, values.dtype == np.float32)
        figures = {"not_finite": int(np.count_nonzero(bad))}
        marked, quick = with_figures(provenance, figures), _has_grain(image)
        write_exr(products(frame)[0], layers, image.header, marked, quick)
        return figures

    def sources(frame: Frame) -> list[Path]:
        return [sequence.path(frame)]

    work = FrameWork(recipe, frames.folder, products, sources, [map_mark], make)
    result = work.run(frames.present, run, frames.absent)
    if also_in is not None:
        write_json(also_in / MANIFEST, read_record(frames.folder / MANIFEST))
    return result


def _has_grain(image: Image) -> bool:
    """Whether a picture's own file could hardly make it smaller."""
    return image.stored > _GRAIN * sum(values.nbytes for values in image.layers.values())


def _warped(
    image: np.ndarray,
    places: np.ndarray,
    edge: float,
    unknown: np.ndarray | None,
    single: bool,
) -> np.ndarray:
    """The image at these places, as single or half floats."""
    shape = (*places.shape[:2], *image.shape[2:])
    result = np.empty(shape, np.float32 if single else np.float16)
    image = to_float(image)
    for rows in bands(shape):
        values = sample(image, places[rows], edge, unknown)
        result[rows] = values if single else to_half(values)
    return result


def _scaled(places: np.ndarray, header: Header, source: Header) -> np.ndarray:
    """Positions in a picture of another size than the map's: an ST map knows no size."""
    if source.size == header.size:
        return places
    factor = np.array(source.size, np.float32) / np.array(header.size, np.float32)
    return ((places + 0.5) * factor - 0.5).astype(np.float32)


def _figures(
    names: list[str], passes: list[Pass], measured: WarpMap, epipole: Epipole | None
) -> Figures:
    known = np.isfinite(measured.error)
    error = measured.error[known]
    y, x = np.nonzero(known)
    displacement = np.hypot(measured.warp[known, 0] - x, measured.warp[known, 1] - y)
    return {
        "reached": {
            name: round(float(np.isfinite(scan.times.time).mean()), 4)
            for name, scan in zip(names, passes, strict=True)
        },
        "known": round(float(known.mean()), 4),
        "filled": round(float(1 - known.mean()), 4),
        # Of what sweeps reached off the plane, and what is filled in all the same.
        "unconfirmed": round(_unconfirmed(passes, known), 4),
        "angles_degrees": {
            f"{names[i]} {names[j]}": round(math.degrees(angle), 1)
            for i, j, angle in pass_angles(passes)
        },
        "predicted_error": {
            "median": round(float(np.median(error)), 3),
            "p90": round(float(np.percentile(error, 90)), 3),
        },
        "light": None
        if epipole is None
        else {
            # Beyond this it may as well lie at infinity.
            "at": [round(float(v), 1) for v in np.clip(epipole.position, -1e6, 1e6)],
            "missed_by": round(epipole.miss, 3),
        },
        "displacement": {
            "median": round(float(np.median(displacement)), 3),
            "p99": round(float(np.percentile(displacement, 99)), 3),
        },
    }


def _unconfirmed(passes: list[Pass], known: np.ndarray) -> float:
    """The part of what sweeps reached off the plane where W is not known; 0 if that is little."""
    reached = reduce(np.logical_or, (np.isfinite(scan.times.time) for scan in passes))
    reached &= ~marked(passes)
    return float(1 - known[reached].mean()) if reached.mean() > _LEAST_REACHED else 0.0


def _gray(passes: list[Pass]) -> np.ndarray:
    """What the target looks like, as far as its contrasts tell, (H, W) float32."""
    contrast = reduce(np.maximum, (scan.times.contrast for scan in passes))
    return np.asarray(contrast / max(float(np.percentile(contrast, 99)), 1e-6) * 0.5, np.float32)
