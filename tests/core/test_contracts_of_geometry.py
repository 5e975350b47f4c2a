"""The contracts of the functions on shadow times, lines and the warp."""

import numpy as np
import pytest
from hypothesis import strategies as st

from shadowtool.core import color_line, diffusion, pictures, shadow_time, warp_map
from shadowtool.core.crossings import CrossingFinder, Crossings
from shadowtool.core.half_floats import rounded
from shadowtool.core.noise import NoiseModel
from shadowtool.core.shadow_lines import ShadowLines, interpolate_lines, line_pace
from shadowtool.core.warp_map import WarpMap
from tests.core.contracts import TAME, UNIT, WILD, Contract, array, is_kept, picture, plane

MODEL = NoiseModel(np.full(3, 1e-3), np.full(3, 1e-6))
SOME = st.one_of(st.floats(-3, 12, width=16), st.just(np.nan))
ERROR = st.one_of(st.floats(0, 4, width=16), st.just(np.inf))


def seen(image: np.ndarray, warp: np.ndarray) -> np.ndarray:
    return warp_map.sample(image, warp_map.positions(warp), 1.0)


def is_single(result, *shape) -> bool:
    return result.dtype == np.float32 and result.shape == shape


def is_rounded(result, value) -> bool:
    """To halfs, whichever of the two next to it."""
    return result.dtype == np.float16 and np.allclose(
        result.astype("f4"), rounded(value).astype("f4"), rtol=1e-3, atol=1e-6, equal_nan=True
    )


def warp(h, w, elements=SOME):
    return array(h, w, 2, elements=elements)


def diffused(values, error):
    known = np.isfinite(values).all(axis=-1)
    return diffusion.diffuse(WarpMap(values, np.where(known, error, np.inf).astype("f4")), 3)


def stays_within(result, values) -> bool:
    """Diffusion makes no displacement that lies outside of those that are known."""
    known = np.isfinite(values).all(axis=-1)
    if not known.any():
        return True
    own = warp_map.identity_map(*known.shape)
    before, after = (values - own)[known], result.warp - own
    return bool(
        np.isfinite(after).all()
        and (after >= before.min(axis=0) - 1e-3).all()
        and (after <= before.max(axis=0) + 1e-3).all()
    )


def mapped(displacement: np.ndarray) -> WarpMap:
    """W with so much displacement, (H, W, 2), unknown where that is."""
    unknown = np.isnan(displacement).any(axis=-1)
    warp = warp_map.identity_map(*unknown.shape) + displacement
    warp[unknown] = np.nan
    return WarpMap(warp, np.where(unknown, np.inf, 0.1).astype(np.float32))


def crossed(*grays) -> Crossings:
    finder = CrossingFinder()
    for gray in grays:
        finder.add(gray)
    return finder.found()


def interval(time):
    return np.ceil(np.nan_to_num(time)).astype(np.int32)


def lines(angles, offsets) -> ShadowLines:
    count = len(angles)
    return ShadowLines(
        frame=np.arange(count, dtype=float),
        normal=np.stack([np.cos(angles), np.sin(angles)], axis=-1),
        offset=offsets,
        residual=np.full(count, 0.1),
        points=np.full(count, 9),
        origin=("fit",) * count,
    )


def turning(h, w):
    # A stick turns little from frame to frame.
    turns = array(5, elements=st.floats(-0.2, 0.2), dtype=np.float64).map(np.cumsum)
    offsets = array(5, elements=st.floats(-50, 50), dtype=np.float64)
    times = array(h, elements=st.floats(-2, 7), dtype=np.float64)
    return st.tuples(st.builds(lines, turns, offsets), times)


CONTRACTS = {
    "sample": Contract(
        lambda image, places: seen(image, places),
        lambda h, w: st.tuples(plane(h, w, UNIT), warp(h, w)),
        lambda r, image, places: (
            is_single(r, *places.shape[:2])
            and (r >= 0).all()
            and (r <= 1).all()
            and (r[np.isnan(places).any(axis=-1)] == 1).all()
        ),
    ),
    "sample of several channels": Contract(
        lambda image, places: seen(image, places),
        lambda h, w: st.tuples(picture(h, w, UNIT), warp(h, w)),
        lambda r, image, places: all(
            np.array_equal(r[..., c], seen(image[..., c], places)) for c in range(3)
        ),
    ),
    "positions": Contract(
        warp_map.positions,
        lambda h, w: st.tuples(warp(h, w, WILD)),
        lambda r, places: (
            is_single(r, *places.shape)
            and np.isfinite(r).all()
            and np.array_equal(
                r[np.isfinite(places).all(axis=-1)], places[np.isfinite(places).all(axis=-1)]
            )
        ),
    ),
    "ST map there and back": Contract(
        lambda a: warp_map.from_st_map(warp_map.to_st_map(a, 640, 360), 640, 360),
        lambda h, w: st.tuples(warp(h, w)),
        lambda r, a: is_single(r, *a.shape) and np.allclose(r, a, atol=1e-3, equal_nan=True),
    ),
    "identity_map": Contract(
        warp_map.identity_map,
        lambda h, w: st.just((h, w)),
        lambda r, h, w: is_single(r, h, w, 2) and (r[-1, -1] == (w - 1, h - 1)).all(),
    ),
    "confidence there and back": Contract(
        lambda e: warp_map.error_of_confidence(WarpMap(np.zeros((*e.shape, 2)), e).confidence),
        lambda h, w: st.tuples(plane(h, w, ERROR)),
        lambda r, e: is_single(r, *e.shape) and np.allclose(r, e, atol=1e-4),
    ),
    "diffuse": Contract(
        diffused,
        lambda h, w: st.tuples(warp(h, w), plane(h, w, TAME)),
        lambda r, values, error: is_single(r.warp, *values.shape) and stays_within(r, values),
    ),
    "luminance": Contract(
        shadow_time.luminance,
        lambda h, w: st.tuples(picture(h, w)),
        lambda r, a: is_single(r, *a.shape[:2]),
    ),
    "luminance_halfs": Contract(
        shadow_time.luminance_halfs,
        lambda h, w: st.tuples(*(plane(h, w) for _ in range(3))),
        lambda r, *c: is_rounded(r, shadow_time.luminance(np.stack(c, axis=-1))),
    ),
    "luminance of grey": Contract(
        lambda a: shadow_time.luminance(np.repeat(a[..., None], 3, axis=-1)),
        lambda h, w: st.tuples(plane(h, w, TAME)),
        lambda r, a: np.allclose(r, a, rtol=1e-5),
    ),
    "own_times": Contract(
        lambda *grays: shadow_time.own_times(crossed(*grays), MODEL),
        lambda h, w: st.tuples(*(plane(h, w, TAME) for _ in range(4))),
        lambda r, *grays: (
            is_single(r[0], *grays[0].shape)
            and is_single(r[1], *grays[0].shape)
            and np.array_equal(np.isfinite(r[0]), crossed(*grays).at > 0)
            and np.array_equal(np.isfinite(r[0]), np.isfinite(r[1]))
            and (np.nan_to_num(r[0]) <= 3).all()
            and (r[1] > 0).all()
        ),
    ),
    "own_times of a camera that trembles": Contract(
        lambda *grays: shadow_time.own_times(crossed(*grays), MODEL, 0.3),
        lambda h, w: st.tuples(*(plane(h, w, TAME) for _ in range(4))),
        lambda r, *grays: (
            np.array_equal(np.isfinite(r[0]), crossed(*grays).at > 0)
            and np.array_equal(np.isfinite(r[0]), np.isfinite(r[1]))
            and (np.nan_to_num(r[0]) <= 3).all()
            and (r[1] > 0).all()
        ),
    ),
    "without_slips": Contract(
        lambda displacement: warp_map.without_slips(mapped(displacement)),
        lambda h, w: st.tuples(array(h, w, 2, elements=st.sampled_from([0.0, 0.5, 3.0, np.nan]))),
        lambda r, displacement: (
            np.array_equal(r.error, mapped(displacement).error)
            and np.array_equal(np.isnan(r.warp), np.isnan(mapped(displacement).warp))
            and np.abs(np.nan_to_num(r.warp)).max() < 20
        ),
    ),
    "refined_times": Contract(
        lambda time: shadow_time.refined_times(
            time, np.where(np.isnan(time), np.inf, 0.2).astype("f4"), interval(time)
        ),
        lambda h, w: st.tuples(plane(h, w, st.one_of(st.floats(0.1, 12), st.just(np.nan)))),
        lambda r, time: (
            is_single(r[0], *time.shape)
            and np.array_equal(np.isfinite(r[0]), np.isfinite(r[1]))
            and np.isnan(r[0][np.isnan(time)]).all()
            and (np.abs(r[0] - interval(time) + 0.5)[np.isfinite(r[0])] <= 0.5).all()
        ),
    ),
    "interpolate_lines": Contract(
        interpolate_lines,
        turning,
        lambda r, found, times: (
            np.array_equal(np.isfinite(r.offset), (times >= 0) & (times <= 4))
            and np.allclose(np.hypot(*r.normal[np.isfinite(r.offset)].T), 1)
        ),
    ),
    "line_pace": Contract(
        lambda found, times: line_pace(found, times, np.ones((len(times), 2))),
        turning,
        lambda r, found, times: r.shape == times.shape and (r >= 0).all(),
    ),
    "line_distance": Contract(
        lambda c, lit, s: color_line.line_distance(c, lit, s, MODEL, 0.01),
        lambda h, w: st.tuples(picture(h, w), picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, c, lit, s: (
            is_single(r, *c.shape[:2])
            and (r >= 0).all()
            and (r[np.isnan(c).any(axis=-1)] == 0).all()
        ),
    ),
    "warp_picture": Contract(
        lambda image, values, error: pictures.warp_picture(image, WarpMap(values, error)),
        lambda h, w: st.tuples(picture(h, w), warp(h, w), plane(h, w, ERROR)),
        lambda r, image, values, error: (
            r.dtype == np.uint8 and r.shape == (image.shape[0], 2 * image.shape[1], 3)
        ),
    ),
    "time_picture": Contract(
        lambda image, time, turned: pictures.time_picture(pictures.display(image), time, turned[0]),
        lambda h, w: st.tuples(picture(h, w), plane(h, w, SOME), turning(h, w)),
        lambda r, image, *others: r.dtype == np.uint8 and r.shape == image.shape,
    ),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", CONTRACTS)
def test_a_contract_is_kept(name):
    is_kept(CONTRACTS[name])
