"""The contracts of the functions that tell figures from ground, and of the robust plates."""

import numpy as np
import pytest
from hypothesis import strategies as st

from shadowtool.core import grid, matting, partial_coverage
from shadowtool.core.backdrop import Backdrop
from shadowtool.core.noise import NoiseModel
from shadowtool.core.robust_plates import hide, keyed
from tests.core.contracts import (
    TAME,
    UNIT,
    Contract,
    array,
    halfs,
    is_kept,
    mask,
    picture,
    plane,
)

MODEL = NoiseModel(np.full(3, 1e-3), np.full(3, 1e-6))
COUNTS = st.integers(0, 40)


def counts(h, w):
    return array(h, w, elements=COUNTS, dtype=np.uint32)


def completed(lit, shadow, frames):
    # Where nothing was shaded there is no shadow.
    shadow = np.where((frames > 0)[..., None], np.minimum(lit, shadow), np.float32(np.nan))
    noise = NoiseModel(np.zeros(3), np.full(3, 1e-4))
    return partial_coverage.complete_shadow(lit, shadow, frames, noise)


def hidden(gray):
    marked = gray.copy()
    hide(marked, np.ones(gray.shape, bool))
    return marked


def before(lit, shadow):
    lit, shadow = np.nan_to_num(lit), np.nan_to_num(np.minimum(lit, shadow))
    noise = NoiseModel(np.full(3, 1e-4), np.full(3, 1e-6))
    return Backdrop(lit, shadow, noise, np.zeros(lit.shape[:2], np.float32))


def unknown(lit, shadow):
    return np.asarray(np.isnan(lit).any(axis=-1))


def is_figure(found, image):
    shape = image.shape[:2]
    return (
        found.foreground.dtype == found.alpha.dtype == np.float32
        and found.foreground.shape == image.shape
        and found.alpha.shape == found.trimap.shape == shape
        and np.isfinite(found.alpha).all()
        and (found.alpha >= 0).all()
        and (found.alpha <= 1).all()
        and np.isfinite(found.foreground).all()
        and (found.foreground >= 0).all()
        and (found.foreground[found.alpha == 0] == 0).all()
        and set(np.unique(found.trimap).tolist()) <= {0, 128, 255}
    )


CONTRACTS = {
    "pull_figure": Contract(
        lambda c, lit, shadow: matting.pull_figure(c, before(lit, shadow), unknown(lit, shadow)),
        lambda h, w: st.tuples(picture(h, w), picture(h, w, TAME), picture(h, w, TAME)),
        lambda r, c, lit, shadow: is_figure(r, c),
    ),
    "colour_figure": Contract(
        lambda c, lit, shadow, a: matting.colour_figure(
            c, before(lit, shadow), unknown(lit, shadow), a
        ),
        lambda h, w: st.tuples(
            picture(h, w), picture(h, w, TAME), picture(h, w, TAME), plane(h, w, UNIT)
        ),
        lambda r, c, lit, shadow, a: is_figure(r, c),
    ),
    "on_grid": Contract(
        lambda a: grid.on_grid(a, 2),
        lambda h, w: st.tuples(halfs(h, w)),
        lambda r, a: r.dtype == np.float32 and np.array_equal(
            r, a[::2, ::2].astype(np.float32), equal_nan=True
        ),
    ),
    "full_size": Contract(
        lambda m: grid.full_size(m, 2 * m.shape[1], 2 * m.shape[0], 2),
        lambda h, w: st.tuples(mask(h, w)),
        lambda r, m: (
            r.shape == (2 * m.shape[0], 2 * m.shape[1])
            and set(np.unique(r).tolist()) <= {0, 255}
            and (r[::2, ::2][m] == 255).all()
        ),
    ),
    "keyed": Contract(
        lambda a, m: keyed(a, m),
        lambda h, w: st.tuples(halfs(h, w), plane(h, w, UNIT)),
        lambda r, a, m: (
            r.keys.shape == a.shape
            and r.gray.shape == m.shape
            and np.array_equal(r.gray != hidden(r.gray), np.isfinite(a).all(axis=-1) & (m <= 0))
        ),
    ),
    "complete_shadow": Contract(
        completed,
        lambda h, w: st.tuples(picture(h, w, TAME), picture(h, w, TAME), counts(h, w)),
        lambda r, lit, shadow, frames: (
            r.shadow.shape == lit.shape and (r.own >= 0).all() and (r.own <= 1).all()
        ),
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", CONTRACTS)
def test_a_contract_is_kept(name):
    is_kept(CONTRACTS[name])
