import numpy as np
import pytest

from shadowtool.core.trimap import (
    BACKGROUND,
    FIGURE,
    UNKNOWN,
    Prior,
    doubted,
    edge_prior,
    narrowed,
    wide_trimap,
)
from tests.figures import KNOWN, disk, in_motion, strand

REACH = 4
EXACT = np.zeros(KNOWN.shape, np.float32)


def prior_of(alpha: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, Prior]:
    """The wide trimap of a mask, and the prior when alpha is solved without error."""
    trimap = wide_trimap(mask, mask, REACH)
    alpha = alpha.astype(np.float32)
    return trimap, edge_prior(alpha, EXACT, EXACT, trimap, mask, REACH)


def test_the_band_holds_all_that_is_mixed() -> None:
    alpha = disk(80, 50, 25)
    trimap = wide_trimap(alpha > 0.5, alpha > 0.5, REACH)
    assert (trimap[(alpha > 0) & (alpha < 1)] == UNKNOWN).all()
    assert (alpha[trimap == FIGURE] == 1).all() and (alpha[trimap == BACKGROUND] == 0).all()
    assert (trimap == FIGURE).sum() > 0.6 * alpha.sum()


def test_a_limb_keeps_a_core_and_a_hair_has_none() -> None:
    limb, hair = strand((20, 20), (140, 20), 7), strand((20, 70), (140, 70), 1)
    mask = np.maximum(limb, hair) > 0.5
    trimap = wide_trimap(mask, mask, REACH)
    assert (trimap[20, 30:130] == FIGURE).all()
    assert not (trimap[60:80] == FIGURE).any()


def test_a_hair_alone_is_its_own_core() -> None:
    mask = strand((20, 70), (140, 70), 1) > 0.5
    assert (wide_trimap(mask, mask, REACH) == FIGURE).any()


@pytest.mark.parametrize("mask", [np.zeros_like(KNOWN), ~KNOWN])
def test_nothing_and_everything(mask: np.ndarray) -> None:
    assert (wide_trimap(mask, mask, REACH) == (FIGURE if mask.any() else BACKGROUND)).all()


def test_what_may_be_figure_is_in_the_band_and_little_is_expected_of_it() -> None:
    alpha = disk(80, 50, 20)
    maybe = strand((80, 50), (150, 50), 1) > 0
    trimap = wide_trimap(alpha > 0.5, maybe | (alpha > 0.5), REACH)
    assert (trimap[50, 110:145] == UNKNOWN).all()
    prior = edge_prior(alpha.astype(np.float32), EXACT, EXACT, trimap, alpha > 0.5, REACH)
    assert prior.mean[50, 120] < 0.2 < prior.deviation[50, 120]


def test_a_sharp_edge_makes_a_band_of_its_own_width() -> None:
    alpha = disk(80, 50, 25)
    mask = alpha > 0.5
    trimap, prior = prior_of(alpha, mask)
    narrow = narrowed(trimap, prior, mask)
    assert (alpha[narrow == FIGURE] > 0.95).mean() > 0.98
    # Two pixels outwards are left open, and the mixed ones.
    assert (narrow == UNKNOWN).sum() < 4.5 * 2 * np.pi * 25


def test_an_edge_that_is_soft_all_around_is_expected_to_be() -> None:
    alpha = np.clip((25 - np.hypot(*np.mgrid[-50:50, -80:80])) / 4 + 0.5, 0, 1)
    mask = alpha > 0.1
    trimap, prior = prior_of(alpha, mask)
    band = trimap == UNKNOWN
    assert np.abs(prior.mean - alpha)[band].mean() < 0.1
    assert (narrowed(trimap, prior, mask)[(alpha > 0.05) & (alpha < 0.8)] == UNKNOWN).all()


def test_what_is_mixed_with_ground_is_no_sample_of_the_figure() -> None:
    alpha = np.clip((25 - np.hypot(*np.mgrid[-50:50, -80:80])) / 6 + 0.5, 0, 1)
    mask = alpha > 0.3
    trimap, prior = prior_of(alpha, mask)
    assert alpha[narrowed(trimap, prior, mask) == FIGURE].min() > 0.95


def test_where_motion_blurs_the_edge_the_band_stays_wide() -> None:
    alpha = in_motion(lambda time: disk(77 + 5 * time, 50, 25))
    mask = alpha > 0.1
    trimap, prior = prior_of(alpha, mask)
    before = slice(44, 57), slice(50, 60)
    mixed = (alpha > 0.05) & (alpha < 0.7)
    assert (narrowed(trimap, prior, mask)[before][mixed[before]] == UNKNOWN).all()


def test_a_limb_in_motion_on_a_figure_that_stands_is_expected_to_be_blurred() -> None:
    hand = in_motion(lambda time: disk(118 + 5 * time, 50, 12))
    alpha = np.max([disk(50, 50, 32), strand((50, 50), (110, 50), 11), hand], axis=0)
    _, prior = prior_of(alpha, alpha > 0.1)
    blurred = (alpha > 0.05) & (alpha < 0.8) & (disk(140, 50, 18) > 0)
    assert np.abs(prior.mean - alpha)[blurred].mean() < 0.25


def test_another_colour_at_the_rim_is_not_taken_for_blur() -> None:
    alpha = disk(80, 50, 25)
    found = np.where(disk(80, 50, 21) > 0, alpha, 0.5 * alpha)
    found = np.where(np.arange(160) < 101, alpha, found)
    mask = alpha > 0.5
    trimap, prior = prior_of(found, mask)
    assert (narrowed(trimap, prior, mask)[disk(80, 50, 23) == 1] == FIGURE).mean() > 0.97


def test_less_is_expected_at_the_edge_of_what_looks_like_the_ground() -> None:
    prior = Prior(np.float32([0.8, 0.8, 1.0, 0.0]), np.full(4, 0.1, np.float32))
    found = doubted(prior, np.float32([1, 100, 1, 1]))
    assert found.mean[0] < 0.5
    assert np.array_equal(found.mean[1:], prior.mean[1:])
    assert np.array_equal(found.deviation, prior.deviation)
