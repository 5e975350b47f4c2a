"""The contracts of the functions on light: plates, β, noise, compositing, filling."""

import numpy as np
import pytest
from hypothesis import strategies as st

from shadowtool.core import (
    beta,
    camera_motion,
    compositing,
    exposure,
    filling,
    flicker,
    half_keys,
    noise,
    trembling,
)
from shadowtool.core.grid import grid_step
from shadowtool.core.half_floats import all_finite, to_float, to_half
from shadowtool.core.plates import ExtremePlates, Plates
from shadowtool.core.resizing import resized
from shadowtool.core.transfer import TRANSFERS
from tests.core.contracts import (
    SIZES,
    TAME,
    UNIT,
    WILD,
    Contract,
    array,
    halfs,
    is_kept,
    mask,
    picture,
    plane,
)

MODEL = noise.NoiseModel(np.full(3, 1e-3), np.full(3, 1e-6))


def is_single(result: np.ndarray, *shape: int) -> bool:
    return result.dtype == np.float32 and result.shape == shape


def within(result: np.ndarray, low: float, high: float) -> bool:
    known = result[~np.isnan(result)]
    return bool((known >= low).all() and (known <= high).all())


def unknown(*pictures: np.ndarray) -> np.ndarray:
    """Where any channel of any of them isn't finite."""
    return np.any([~np.isfinite(p).all(axis=-1) for p in pictures], axis=0)


def extremes(frames: list[np.ndarray], holdout: np.ndarray) -> Plates:
    running = ExtremePlates()
    for frame in frames:
        running.add(frame, holdout)
    return running.plates()


def plates_are_extremes(result: Plates, frames: list[np.ndarray], holdout: np.ndarray) -> bool:
    stack = np.stack(frames).astype(np.float32)
    seen = np.isfinite(stack).all(axis=-1) & ~(holdout > 0)
    high = np.where(seen[..., None], stack, -np.inf).max(axis=0)
    low = np.where(seen[..., None], stack, np.inf).min(axis=0)
    none = ~seen.any(axis=0)
    high[none] = low[none] = np.nan
    assert result.frames is not None
    return (
        np.array_equal(result.lit, high, equal_nan=True)
        and np.array_equal(result.shadow, low, equal_nan=True)
        and np.array_equal(result.frames, seen.sum(axis=0))
    )


def contrast_of(lit: np.ndarray, shadow: np.ndarray) -> np.ndarray:
    return beta.shadow_contrast(Plates(lit, shadow), MODEL)


def matte_of(image: np.ndarray, lit: np.ndarray, shadow: np.ndarray, kind="scalar") -> np.ndarray:
    return beta.shadow_matte(image, shadow, beta.inverse_span(lit, shadow, kind), kind)


def three(h, w):
    return st.tuples(picture(h, w), picture(h, w, TAME), picture(h, w, TAME))


CONTRACTS = {
    "to_float": Contract(
        to_float, lambda h, w: st.tuples(halfs(h, w)), lambda r, a: is_single(r, *a.shape)
    ),
    "to_half": Contract(
        to_half,
        lambda h, w: st.tuples(picture(h, w)),
        lambda r, a: r.dtype == np.float16 and (np.isnan(r) == np.isnan(a)).all(),
    ),
    "all_finite": Contract(
        all_finite, lambda h, w: st.tuples(halfs(h, w)), lambda r, a: r == np.isfinite(a).all()
    ),
    "to_keys and back": Contract(
        lambda a: half_keys.from_keys(half_keys.to_keys(a)),
        lambda h, w: st.tuples(halfs(h, w)),
        lambda r, a: np.array_equal(r, a, equal_nan=True),
    ),
    "to_keys": Contract(
        half_keys.to_keys,
        lambda h, w: st.tuples(array(h * w, elements=TAME, dtype=np.float16)),
        lambda r, a: (np.diff(r[np.argsort(a, kind="stable")].astype(int)) >= 0).all(),
    ),
    "keys_per_unit": Contract(
        half_keys.keys_per_unit,
        lambda h, w: st.tuples(plane(h, w, TAME)),
        lambda r, a: is_single(r, *a.shape) and (r > 0).all(),
    ),
    "finite_keys": Contract(
        half_keys.finite_keys,
        lambda h, w: st.tuples(halfs(h, w)),
        lambda r, a: (
            np.array_equal(half_keys.from_keys(r.keys).view("i2"), a.view("i2"))
            and np.array_equal(unknown(a), np.zeros(a.shape[:2], bool) if r.bad is None else r.bad)
        ),
    ),
    "extremes of halfs": Contract(
        extremes,
        lambda h, w: st.tuples(st.lists(halfs(h, w), min_size=1, max_size=4), plane(h, w, UNIT)),
        plates_are_extremes,
    ),
    "extremes of floats": Contract(
        extremes,
        lambda h, w: st.tuples(
            st.lists(st.one_of(halfs(h, w), picture(h, w)), min_size=1, max_size=4),
            plane(h, w, UNIT),
        ),
        plates_are_extremes,
    ),
    "shade": Contract(
        compositing.shade,
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME), plane(h, w, UNIT)),
        lambda r, lit, shadow, b: (
            is_single(r, *lit.shape)
            and (r <= np.maximum(lit, shadow) + 1e-5).all()
            and (r >= np.minimum(lit, shadow) - 1e-5).all()
        ),
    ),
    "shade of unknown β": Contract(
        compositing.shade,
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME), picture(h, w)),
        lambda r, lit, shadow, b: (np.isnan(r) >= np.isnan(b)).all(),
    ),
    "over": Contract(
        compositing.over,
        lambda h, w: st.tuples(picture(h, w, TAME), plane(h, w, UNIT), picture(h, w, TAME)),
        lambda r, f, a, b: is_single(r, *b.shape) and (r >= f).all() and (r <= f + b).all(),
    ),
    "shadow_ratio": Contract(
        compositing.shadow_ratio,
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, s, lit: is_single(r, *s.shape) and (r >= 0).all() and (r[lit <= 0] == 1).all(),
    ),
    "shadow_matte": Contract(
        matte_of,
        three,
        lambda r, c, lit, s: (
            is_single(r, *lit.shape[:2])
            and not np.isfinite(r[unknown(c) | ((lit - s) ** 2).sum(axis=-1).__eq__(0)]).any()
        ),
    ),
    "β of L and S": Contract(
        lambda lit, s: (matte_of(lit, lit, s), matte_of(s, lit, s)),
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, lit, s: (
            within(np.abs(r[0] - 1), 0, 1e-5)
            and within(r[1], 0, 0)
            and np.array_equal(np.isnan(r[0]), np.isnan(r[1]))
        ),
    ),
    "shadow_matte in each channel": Contract(
        lambda c, lit, s: matte_of(c, lit, s, "rgb"),
        three,
        lambda r, c, lit, s: (
            is_single(r, *lit.shape) and not np.isfinite(r[(lit == s) | ~np.isfinite(c)]).any()
        ),
    ),
    "shadow_matte of halfs": Contract(
        lambda c, lit, s: matte_of(c, lit, s),
        lambda h, w: st.tuples(halfs(h, w), picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, c, lit, s: (
            np.array_equal(r, matte_of(c.astype(np.float32), lit, s), equal_nan=True)
        ),
    ),
    "shadow_contrast": Contract(
        contrast_of,
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, lit, s: is_single(r, *lit.shape[:2]) and (r >= 0).all(),
    ),
    "shadow_contrast of unknown plates": Contract(
        lambda lit, s: contrast_of(np.where(unknown(lit)[..., None], np.nan, lit), s),
        lambda h, w: st.tuples(picture(h, w), picture(h, w, TAME)),
        lambda r, lit, s: np.isnan(r[unknown(lit)]).all(),
    ),
    "channel_contrast": Contract(
        lambda lit, s: beta.channel_contrast(Plates(lit, s), MODEL),
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, lit, s: is_single(r, *lit.shape) and (r >= 0).all(),
    ),
    "never_shaded": Contract(
        beta.never_shaded,
        lambda h, w: st.tuples(
            plane(h, w), array(h, w, elements=st.integers(0, 2000), dtype=np.uint32)
        ),
        lambda r, c, n: r.dtype == bool and r[np.isnan(c)].all() and r[c <= 10].all(),
    ),
    "without_noise": Contract(
        beta.without_noise,
        lambda h, w: st.tuples(plane(h, w, st.one_of(UNIT, st.just(np.nan))), plane(h, w, TAME)),
        lambda r, b, c: (
            is_single(r, *b.shape)
            and np.array_equal(np.isnan(r), np.isnan(b))
            and within(r, min(np.nanmin(b, initial=1), 1) - 1e-4, 1 + 1e-4)
        ),
    ),
    "weight_of": Contract(
        beta.weight_of,
        lambda h, w: st.tuples(plane(h, w, st.one_of(TAME, st.just(np.nan)))),
        lambda r, c: is_single(r, *c.shape) and (r >= 0).all() and (r[np.isnan(c)] == 0).all(),
    ),
    "confidence": Contract(
        beta.confidence,
        lambda h, w: st.tuples(plane(h, w, st.one_of(TAME, st.just(np.nan)))),
        lambda r, c: (
            r.dtype == np.float16 and within(r, 0, 1) and (r[~(c > 1)] == 0).all()
        ),
    ),
    "fill_beta": Contract(
        beta.fill_beta,
        lambda h, w: st.tuples(
            plane(h, w, st.one_of(UNIT, st.just(np.nan))),
            mask(h, w),
            mask(h, w),
            st.sampled_from(["inpaint", "lit"]),
        ),
        lambda r, b, never, hidden, fill: (
            is_single(r, *b.shape) and not np.isnan(r).any() and within(r, -1e-5, 1 + 1e-5)
        ),
    ),
    "fill_beta with nothing": Contract(
        beta.fill_beta,
        lambda h, w: st.tuples(plane(h, w), mask(h, w), mask(h, w), st.just("none")),
        lambda r, b, *others: np.array_equal(r, b, equal_nan=True),
    ),
    "inpaint": Contract(
        beta.inpaint,
        lambda h, w: st.tuples(plane(h, w, st.one_of(UNIT, st.just(np.nan)))),
        lambda r, b: (
            is_single(r, *b.shape)
            and np.array_equal(r[~np.isnan(b)], b[~np.isnan(b)])
            and within(r, np.nanmin(b, initial=1) - 1e-5, 1 + 1e-5)
            and not np.isnan(r).any()
        ),
    ),
    "fill_membrane": Contract(
        filling.fill_membrane,
        lambda h, w: st.tuples(picture(h, w, UNIT), plane(h, w, UNIT)),
        lambda r, v, weight: (
            is_single(r, *v.shape)
            and np.array_equal(r[weight > 0], v[weight > 0])
            and within(r, -1e-5, 1 + 1e-5)
        ),
    ),
    "sigma": Contract(
        MODEL.sigma,
        lambda h, w: st.tuples(picture(h, w)),
        lambda r, a: (
            is_single(r, *a.shape)
            and np.array_equal(np.isnan(r), np.isnan(a))
            and within(r, 1e-4, np.inf)
        ),
    ),
    "sample_positions": Contract(
        lambda n: noise.sample_positions(n),
        lambda h, w: st.tuples(st.integers(0, 5000)),
        lambda r, n: (
            (r == {}) == (n < 2)
            and all(0 <= p < n for p in r.values())
            and all(r[k + 1] == r[k] + 1 for k in r if k % 2 == 0)
        ),
    ),
    "thin": Contract(
        noise.thin,
        lambda h, w: st.tuples(halfs(h, w)),
        lambda r, a: r.dtype == np.float32 and r.ndim == 3 and r.shape[2] == 3,
    ),
    "noise_model": Contract(
        lambda samples: noise.noise_model(noise.noise_levels(dict(enumerate(samples)))),
        lambda h, w: st.tuples(
            st.lists(array(6, 10, 3, dtype=np.float32), min_size=0, max_size=4)
        ),
        lambda r, samples: (r.slope >= 0).all() and (r.floor > 0).all(),
    ),
    "extreme_range": Contract(
        noise.extreme_range,
        lambda h, w: st.tuples(array(h, w, elements=st.integers(0, 10**6), dtype=np.uint32)),
        lambda r, n: (
            is_single(r, *n.shape)
            and (np.diff(r.ravel()[np.argsort(n.ravel(), kind="stable")]) >= 0).all()
        ),
    ),
    "frame_gain": Contract(
        exposure.frame_gain,
        lambda h, w: st.tuples(picture(h, w), picture(h, w)),
        lambda r, a, b: isinstance(r, float) and 0.7 < r < 1.5,
    ),
    "frame_gain of the same": Contract(
        lambda a: exposure.frame_gain(a, a),
        lambda h, w: st.tuples(picture(h, w)),
        lambda r, a: r == 1.0,
    ),
    "row_gains": Contract(
        lambda a, b: exposure.row_gains(a, b, np.arange(len(a), dtype=float), True),
        lambda h, w: st.tuples(picture(h, w), picture(h, w)),
        lambda r, a, b: np.shape(r) in ((), (len(a), 3)) and np.all((r > 0.5) & (r < 2)),
    ),
    "band_gains": Contract(
        lambda a, b: flicker.band_gains(a, b, 1.0, np.arange(2.0 * len(a))),
        lambda h, w: st.tuples(picture(6 * h, 6 * w), picture(6 * h, 6 * w)),
        lambda r, a, b: r is None or (r.shape == (2 * len(a),) and (r > 0).all()),
    ),
    "without_gain": Contract(
        exposure.without_gain,
        lambda h, w: st.tuples(halfs(h, w), st.floats(0.7, 1.4)),
        lambda r, a, gain: r.dtype == a.dtype and np.array_equal(np.isnan(r), np.isnan(a)),
    ),
    "tremble": Contract(
        lambda *frames: trembling.tremble([trembling.strips(f) for f in frames]),
        lambda h, w: st.tuples(*(plane(h, w) for _ in range(3))),
        lambda r, *frames: isinstance(r, float) and r >= 0 and np.isfinite(r),
    ),
    "off_place": Contract(
        lambda a, b: trembling.off_place(trembling.strips(a), [trembling.strips(b)]),
        lambda h, w: st.tuples(plane(h, w), plane(h, w)),
        lambda r, a, b: isinstance(r, float) and r >= 0 and np.isfinite(r),
    ),
    "Vantage.off": Contract(
        lambda a, b: camera_motion.Vantage.of(a).off(b),
        lambda h, w: st.tuples(picture(h, w), picture(h, w)),
        lambda r, a, b: bool(np.isfinite(r).all()),
    ),
    "displaced": Contract(
        camera_motion.displaced,
        lambda h, w: st.tuples(halfs(h, w), st.tuples(st.floats(-2, 2), st.floats(-2, 2))),
        lambda r, image, place: (
            r.dtype == image.dtype
            and r.shape == image.shape
            and np.array_equal(np.isfinite(r), np.isfinite(image))
        ),
    ),
    "resized": Contract(
        resized,
        lambda h, w: st.tuples(picture(h, w), SIZES),
        lambda r, image, size: (
            is_single(r, size[1], size[0], 3)
            and not np.isinf(r).any()
            and (np.isfinite(r).all() or not np.isfinite(image).all())
            and np.array_equal(np.isnan(r).any(axis=-1), np.isnan(r).all(axis=-1))
        ),
    ),
    "prepare": Contract(
        camera_motion.prepare,
        lambda h, w: st.tuples(plane(h, w)),
        lambda r, a: is_single(r, *a.shape) and np.isfinite(r).all(),
    ),
    "shift": Contract(
        lambda a, b: camera_motion.shift(a, b, 640),
        lambda h, w: st.tuples(plane(h, w, UNIT), plane(h, w, UNIT)),
        lambda r, a, b: r is None or r >= 0,
    ),
    "grid_step": Contract(
        grid_step, lambda h, w: st.tuples(st.integers(1, 9000), st.integers(1, 9000)),
        lambda r, w, h: r >= 1,
    ),
    **{
        f"{name} there and back": Contract(
            lambda a, t=curves: t.decode(t.encode(a)),
            lambda h, w: st.tuples(plane(h, w)),
            lambda r, a: is_single(r, *a.shape)
            and np.allclose(r, a, rtol=1e-4, atol=1e-6, equal_nan=True),
        )
        for name, curves in TRANSFERS.items()
    },
    **{
        f"{name} rises": Contract(
            curves.encode,
            lambda h, w: st.tuples(array(h * w, elements=st.floats(-4, 4, width=32))),
            lambda r, a: (np.diff(r[np.argsort(a, kind="stable")]) >= -1e-6).all(),
        )
        for name, curves in TRANSFERS.items()
    },
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", CONTRACTS)
def test_a_contract_is_kept(name):
    is_kept(CONTRACTS[name])


def test_a_broken_contract_is_noticed():
    def spoils(values: np.ndarray) -> np.ndarray:
        values[...] = 1
        return values

    def wanders(values: np.ndarray) -> bool:
        return values.flags.c_contiguous

    for call in (spoils, wanders):
        broken = Contract(call, lambda h, w: st.tuples(plane(3, 3, WILD)), lambda r, a: True)
        with pytest.raises(AssertionError):
            is_kept(broken, shrink=False)
