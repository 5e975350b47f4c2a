from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowtool.core import plane_fits
from shadowtool.core.plane_fits import RADII, Windows, fit_planes, understated

REACH = Windows().reach
compiled = pytest.mark.skipif(
    plane_fits._compiled is None, reason="it was installed without a compiler"
)
ROWS, COLUMNS = np.mgrid[:60, :80].astype(np.float64)


def measured(truth: np.ndarray, error: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    value = truth + rng.normal(scale=error, size=truth.shape)
    return value.astype(np.float32), np.full(truth.shape, error, np.float32)


def by_hand(
    value: np.ndarray, error: np.ndarray, row: int, column: int, radius: int
) -> tuple[float, float]:
    """A plane's value at the middle of a window, and its variance, by plain least squares."""
    window = (
        slice(row - radius, row + radius + 1),
        slice(column - radius, column + radius + 1),
    )
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    design = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    weight = 1 / error[window].ravel().astype(np.float64) ** 2
    normal = design.T @ (design * weight[:, None]) + np.diag([1e-9, 0.1, 0.1])
    solved = np.linalg.solve(normal, design.T @ (weight * value[window].ravel()))
    return float(solved[0]), float(np.linalg.inv(normal)[0, 0])


def fit_planes_one_by_one(
    value: np.ndarray, error: np.ndarray, windows: Windows
) -> tuple[np.ndarray, np.ndarray]:
    """Each pixel and each window in turn, by plain least squares."""
    best, spread = value.astype(np.float64), error.astype(np.float64) ** 2
    for row, column in np.ndindex(value.shape):
        around = (
            np.abs(np.subtract.outer(np.arange(value.shape[0]), row)) <= 1,
            (np.abs(np.subtract.outer(np.arange(value.shape[1]), column)) <= 1),
        )
        others, errors = value[np.ix_(*around)], error[np.ix_(*around)]
        allowed = 3 * np.hypot(errors, error[row, column]) + 1
        # A measurement agrees with itself.
        if (np.abs(others - value[row, column]) < allowed).sum() - 1 < 3:
            spread[row, column] = np.inf
    weight = np.where(np.isfinite(spread), 1 / spread, 0)
    own, own_weight = best.copy(), weight.copy()
    y, x = np.mgrid[: value.shape[0], : value.shape[1]]
    for radius in windows.radii:
        smaller, smaller_spread = best.copy(), spread.copy()
        # Large windows are made of cells of two or four pixels squared.
        size = 1 if radius < 8 else 2 if radius < 16 else 4
        cells = round(((2 * radius + 1) / size - 1) / 2)
        for (row, column), (up, left) in product(
            np.ndindex(value.shape), product((-cells, 0, cells), repeat=2)
        ):
            here, there = row + up * size, column + left * size
            if not (0 <= here < value.shape[0] and 0 <= there < value.shape[1]):
                continue
            inside = np.abs(y // size - here // size) <= cells
            inside &= np.abs(x // size - there // size) <= cells
            inside &= weight > 0
            if inside.sum() < 4:
                continue
            a, b = ((n // size + 0.5) * size - 0.5 for n in (here, there))
            design = np.stack([np.ones(inside.sum()), x[inside] - column, y[inside] - row], 1)
            level = np.array([[1, b - column, a - row], [0, 1, 0], [0, 0, 1]])
            normal = design.T @ (design * weight[inside, None])
            # As if windows had seen no slope, about their middle.
            normal += level.T @ np.diag([1e-9, 0.1, 0.1]) @ level
            plane = np.linalg.solve(normal, design.T @ (weight * value)[inside])
            rest = weight[inside] @ value[inside] ** 2 - plane @ (
                design.T @ (weight * value)[inside]
            )
            misfit = max(rest, 0) / max(inside.sum() - 3, 1)
            certain = np.linalg.inv(normal)[0, 0] * max(misfit, 1) * windows.factor**2 + 0.02**2
            off = plane[0] - np.array([own[row, column], smaller[row, column]])
            if (
                misfit < 1.5
                and certain < spread[row, column]
                and off[0] ** 2 * own_weight[row, column] < 9
                and off[1] ** 2 <= 9 * smaller_spread[row, column]
            ):
                best[row, column], spread[row, column] = plane[0], certain
    best[np.isinf(spread)] = np.nan
    return best, np.sqrt(spread)


@pytest.mark.parametrize(
    "windows",
    [
        Windows((1, 2, 3, 5)),
        Windows((2, 5), 1.7),
        Windows((3, 8)),
        Windows((9, 16)),
        Windows((18,)),
    ],
)
def test_each_pixel_is_given_what_its_windows_in_turn_give_it(windows: Windows) -> None:
    rng = np.random.default_rng(3)
    truth = np.where(COLUMNS < 9, 0.4 * ROWS, 7 - 0.3 * COLUMNS)[:14, :18]
    error = rng.choice([0.05, 0.3, 0.8], truth.shape).astype(np.float32)
    # Errors that are a little larger than they are said to be: windows of all sizes compete.
    value = (truth + 1.2 * rng.normal(size=truth.shape) * error).astype(np.float32)
    value[4, 5] = 30
    fitted, spread = fit_planes(value, error, windows)
    expected, expected_spread = fit_planes_one_by_one(value, error, windows)
    assert fitted == pytest.approx(expected, abs=1e-3, nan_ok=True)
    assert spread == pytest.approx(expected_spread, abs=1e-3)


def test_a_single_centred_window_is_plain_least_squares() -> None:
    value, error = measured(0.02 * COLUMNS, 0.3)
    error *= np.random.default_rng(1).uniform(0.8, 1.2, error.shape).astype(np.float32)
    fitted, spread = fit_planes(value, error, Windows((3,)))
    for row, column in ((0, 0), (30, 40), (41, 17)):
        # Of a window's pixels the middle is known best: elsewhere the window is shifted.
        inside = (slice(row, row + 1), slice(column, column + 1))
        assert np.isfinite(fitted[inside]).all()
    plane, variance = by_hand(value, error, 30, 40, 3)
    if spread[30, 40] ** 2 == pytest.approx(variance + 0.02**2, rel=0.02):
        assert fitted[30, 40] == pytest.approx(plane, abs=1e-4)
    assert (spread < 0.7 * error).mean() > 0.9


@pytest.mark.parametrize("slope", [0.0, 0.3, -2.0])
def test_a_plane_is_found_as_well_as_predicted(slope: float) -> None:
    truth = 3 + slope * COLUMNS - 0.5 * slope * ROWS
    value, error = measured(truth, 0.5)
    fitted, spread = fit_planes(value, error)
    assert np.median(np.abs(fitted - truth)) < 0.06
    assert np.percentile(np.abs(fitted - truth) / spread, 90) < 3


def test_a_step_stays_where_it_is() -> None:
    truth = np.where(COLUMNS < 37, 0.1 * ROWS, 12 - 0.2 * COLUMNS)
    value, error = measured(truth, 0.4)
    fitted, _ = fit_planes(value, error)
    off = np.abs(fitted - truth)
    assert np.percentile(off, 99) < 0.6
    assert off[:, 34:40].mean() < 0.25


def test_what_is_known_well_leads() -> None:
    # Times of an edge that moves 9 pixels a frame: a few are caught, of the others nothing but the
    # interval is known, so that their middle is off by up to half a frame.
    truth = 0.1 * COLUMNS + 0.05 * ROWS
    caught = np.random.default_rng(0).uniform(size=truth.shape) < 0.2
    value = np.where(caught, truth, np.floor(truth) + 0.5).astype(np.float32)
    error = np.where(caught, 0.02, 12**-0.5).astype(np.float32)
    fitted, spread = fit_planes(value, error)
    assert np.percentile(np.abs(fitted - truth), 95) < 0.1
    assert np.median(spread) < 0.05


def test_a_lone_wrong_measurement_is_replaced() -> None:
    value, error = measured(np.zeros_like(ROWS), 0.1)
    value[20, 30] = 40.0
    fitted, _ = fit_planes(value, error)
    assert abs(fitted[20, 30]) < 0.2
    assert np.abs(fitted).max() < 0.5


def test_unknown_stays_unknown_and_does_not_count() -> None:
    value, error = measured(0.2 * ROWS, 0.1)
    value[10:20, 10:20] = np.nan
    error[10:20, 10:20] = np.inf
    before = value.copy()
    fitted, spread = fit_planes(value, error)
    assert np.array_equal(np.isnan(fitted), np.isnan(value))
    assert np.isinf(spread[10:20, 10:20]).all()
    assert np.array_equal(value, before, equal_nan=True)


def test_bands_of_the_picture_give_the_same() -> None:
    value, error = measured(np.hypot(ROWS, COLUMNS), 0.5)
    whole, spread = fit_planes(value, error)
    first = 30
    part, part_spread = fit_planes(value[first - REACH :], error[first - REACH :])
    assert np.array_equal(part[REACH:], whole[first:])
    assert np.array_equal(part_spread[REACH:], spread[first:])


def test_rows_alone_are_those_of_the_whole() -> None:
    value, error = measured(np.hypot(ROWS, COLUMNS), 0.5)
    whole, spread = fit_planes(value, error)
    for wanted in (slice(0, 1), slice(7, 31), slice(50, 60)):
        part, part_spread = fit_planes(value, error, wanted=wanted)
        assert np.array_equal(part, whole[wanted])
        assert np.array_equal(part_spread, spread[wanted])


def test_windows_grow_with_the_step() -> None:
    assert Windows.for_step(8) == Windows()
    assert Windows.for_step(24) == Windows(tuple(3 * radius for radius in RADII), 3.0)
    for step in (5, 8, 12, 20):
        assert 2 * max(Windows.for_step(step).radii) + 1 > 1.5 * step
    assert Windows.for_step(1e6).reach < 200


def test_between_frames_far_apart_the_few_that_were_caught_lead() -> None:
    # 40 pixels a frame: small windows hold nothing but pixels of one and the same interval.
    rows, columns = np.mgrid[:160, :200]
    truth = columns / 40 + rows / 160
    caught = np.random.default_rng(0).uniform(size=truth.shape) < 0.03
    value = np.where(caught, truth, np.floor(truth) + 0.5).astype(np.float32)
    error = np.where(caught, 0.01, 12**-0.5).astype(np.float32)
    fitted, _ = fit_planes(value, error, Windows.for_step(40))
    assert np.median(np.abs(fitted - truth)) < 0.02
    assert np.percentile(np.abs(fitted - truth), 90) < 0.05


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 20),
    st.integers(1, 20),
    st.floats(0, 1),
    st.integers(0, 2**32 - 1),
    st.sampled_from([Windows(), Windows((9, 20))]),
)
def test_any_picture_gives_one_of_its_size(
    height: int, width: int, unknown: float, seed: int, windows: Windows
) -> None:
    rng = np.random.default_rng(seed)
    value = rng.uniform(-100, 100, (height, width)).astype(np.float32)
    value[rng.uniform(size=value.shape) < unknown] = np.nan
    error = np.where(np.isnan(value), np.inf, rng.uniform(0.01, 10, value.shape)).astype(np.float32)
    fitted, spread = fit_planes(value, error, windows)
    assert fitted.shape == spread.shape == value.shape
    assert fitted.dtype == spread.dtype == np.float32
    assert np.isnan(fitted[np.isnan(value)]).all()
    assert np.array_equal(np.isfinite(fitted), np.isfinite(spread))
    assert (spread > 0).all()


@compiled
@settings(max_examples=100, deadline=None)
@given(
    st.integers(1, 90),
    st.integers(1, 90),
    st.sampled_from([Windows(), Windows((2,)), Windows((9, 20)), Windows((15, 40), near=30.0)]),
    st.sampled_from([0.0, 0.3, 0.9]),
    st.integers(0, 2**32 - 1),
)
def test_compiled_or_not_the_same_bits_are_fitted(
    height: int, width: int, windows: Windows, unknown: float, seed: int
) -> None:
    """Planes and steps, errors of all sizes, of nothing too."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    value = (0.1 * y - 0.07 * x + 20 * (x > rng.integers(width))).astype(np.float32)
    error = rng.choice([0.0, 0.01, 0.3, 5.0], value.shape).astype(np.float32)
    value += error * rng.normal(size=value.shape).astype(np.float32)
    value[rng.random(value.shape) < unknown] = np.nan
    start = int(rng.integers(height))
    wanted = slice(start, int(rng.integers(start, height)) + 1)
    found = fit_planes(value, error, windows, wanted)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plane_fits, "_compiled", None)
        expected = fit_planes(value, error, windows, wanted)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@compiled
@pytest.mark.parametrize("wrong", [{"sums": 10}, {"planes": 8}, {"kind": "f8"}, {"width": 6}])
def test_sums_that_do_not_fit_together_are_not_solved(wrong: dict) -> None:
    def solve(sums: int = 11, planes: int = 9, kind: str = "f4", width: int = 7) -> None:
        plane_fits._compiled.solve(
            tuple(np.ones((5, 7)) for _ in range(sums)),
            tuple(np.empty((5, width), kind) for _ in range(planes)),
            *(1.0, 2, 1e-9, 0.1, 4e-4, 1.5),
        )

    solve()
    with pytest.raises(ValueError, match=r"fit together|another type"):
        solve(**wrong)


@compiled
@pytest.mark.parametrize(
    "wrong",
    [
        {"planes": 8},
        {"cells": 2},
        {"width": 6},
        {"kind": "f8"},
        {"size": 0},
        {"radius": 0},
        {"height": -1},
        {"height": 2**63 - 1},
        {"radius": 2**62},
        {"first": 2**62},
        {"first": -1},
    ],
)
def test_what_does_not_fit_together_is_not_chosen_from(wrong: dict) -> None:
    given = {"planes": 9, "cells": 3, "width": 7, "kind": "f4"}
    given |= {"size": 2, "radius": 4, "height": 6, "first": 0}

    def choose(planes, cells, width, kind, size, radius, height, first):
        parts = tuple(np.zeros((cells, 7), np.float32) for _ in range(planes))
        chosen = tuple(np.zeros((5, width), kind) for _ in range(4))
        plane_fits._compiled.choose(parts, chosen, height, size, radius, first, 3.0)

    choose(**given)
    with pytest.raises(ValueError, match=r"fit together|another type"):
        choose(**given | wrong)


@compiled
def test_nothing_is_done_of_pictures_without_pixels() -> None:
    """However wide they are."""
    wide = np.empty((0, 1 << 58), np.float32)
    plane_fits._compiled.trust(wide, wide, np.empty(wide.shape, bool), 1.0, 3)
    cells, double = np.empty((11, 0, 1 << 49)), np.empty((0, 1 << 50))
    plane_fits._compiled.add_up(double, double, cells, 2)
    plane_fits._compiled.choose((wide,) * 9, (wide,) * 4, 0, 1, 1, 0, 3.0)


def test_rows_need_not_lie_one_after_the_other_in_memory() -> None:
    value, error = measured(3 + 0.1 * ROWS, 0.1)
    expected = fit_planes(value, error)
    for order in (np.asfortranarray, lambda a: np.repeat(a, 2, axis=1)[:, ::2], np.float64):
        for one, other in zip(fit_planes(order(value), order(error)), expected, strict=True):
            np.testing.assert_array_equal(one, other)


@compiled
@pytest.mark.parametrize(
    ("size", "shape"), [(1, (11, 6, 7)), (3, (11, 2, 3)), (4, (10, 2, 2)), (4, (11, 2, 3))]
)
def test_cells_that_do_not_fit_the_picture_are_not_added_up(size, shape) -> None:
    value = np.ones((6, 7))
    plane_fits._compiled.add_up(value, value, np.empty((11, 2, 2)), 4)
    with pytest.raises(ValueError, match="cells"):
        plane_fits._compiled.add_up(value, value, np.empty(shape), size)
    with pytest.raises(ValueError, match="cells"):
        plane_fits._compiled.add_up(value, value[:, :6].copy(), np.empty((11, 2, 2)), 4)


@compiled
def test_what_is_of_another_size_is_not_trusted() -> None:
    value, out = np.zeros((3, 4), np.float32), np.zeros((3, 4), bool)
    plane_fits._compiled.trust(value, value, out, 1.0, 3)
    for wrong in (value[:2], value[:, :3].copy(), value.astype("f8"), value.ravel()):
        with pytest.raises(ValueError, match=r"pictures of one size|another type"):
            plane_fits._compiled.trust(value, wrong, out, 1.0, 3)


PLANE = np.ones(ROWS.shape, bool)
SLOPED = 3 + 0.1 * ROWS - 0.07 * COLUMNS


@pytest.mark.parametrize("seed", range(3))
def test_errors_that_are_right_are_not_understated(seed: int) -> None:
    assert understated(*measured(SLOPED, 0.05, seed), PLANE) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("larger", [2, 5])
def test_it_is_told_by_how_much_errors_are_understated(larger: float) -> None:
    value, error = measured(SLOPED, 0.05)
    # A quarter of the windows may deviate a little more than all others.
    assert understated(value, error / larger, PLANE) == pytest.approx(larger, rel=0.1)


def test_errors_that_are_too_large_are_left() -> None:
    value, error = measured(SLOPED, 0.05)
    assert understated(value, 3 * error, PLANE) == 1


def test_what_lies_off_the_plane_and_what_is_alone_says_nothing_of_errors() -> None:
    value, error = measured(SLOPED, 0.05)
    plane = COLUMNS < 50
    expected = understated(value, error, plane)
    value[:, 50:] = np.random.default_rng(0).uniform(0, 99, (60, 30))
    value[5::9, 3::7], value[7::9, 5::7] = -20, np.nan
    error[7::9, 5::7] = np.inf
    before = value.copy()
    assert understated(value, error, plane) == pytest.approx(expected, abs=0.1)
    assert np.array_equal(value, before, equal_nan=True)


def test_without_a_plane_or_anything_known_errors_are_believed() -> None:
    value, error = measured(SLOPED, 0.05)
    assert understated(value, error / 9, np.zeros_like(PLANE)) == 1
    assert understated(value, error / 9, COLUMNS < 6) == 1
    assert understated(np.full_like(value, np.nan), np.full_like(error, np.inf), PLANE) == 1


def test_errors_that_are_understated_keep_no_plane_from_being_fitted() -> None:
    value, error = measured(SLOPED, 0.05)
    said = error / 4
    raised = said * np.float32(understated(value, said, PLANE))
    off, off_raised = (np.abs(fit_planes(value, e)[0] - SLOPED).mean() for e in (said, raised))
    assert off_raised < 0.5 * off


def of_few_errors(seed: int, unknown: float) -> tuple[np.ndarray, np.ndarray]:
    """Two planes, half of whose measurements have errors of nothing; and their errors."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:60, :78]
    value = rng.normal() * x + rng.normal() * y + rng.normal() * 50
    beyond = x * rng.normal() + y * rng.normal() > rng.normal() * 30
    value = np.where(beyond, value, value + rng.normal() * 20)
    error = rng.uniform(0.01, 2, x.shape)
    error[rng.random(x.shape) < 0.5] = 0
    value = (value + error * rng.normal(size=x.shape)).astype(np.float32)
    value[rng.random(x.shape) < unknown] = np.nan
    return value, error.astype(np.float32)


@pytest.mark.parametrize(("radius", "unknown", "seed"), [(28, 0.9, 19), (24, 0.3, 868)])
def test_where_few_errors_of_nothing_lead_predictions_are_numbers(
    radius: int, unknown: float, seed: int
) -> None:
    """Variances whose large terms cancel out; rounding leaves less than nothing of some."""
    value, error = of_few_errors(seed, unknown)
    fitted, spread = fit_planes(value, error, Windows((radius,), near=3.0))
    known = np.isfinite(value)
    assert np.isfinite(fitted[known]).all() and (spread[known] >= 0).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("twin", [pytest.param(True, marks=compiled), False])
@pytest.mark.parametrize("rounded", [(1e-13, 0), (0, 1e-13), (1e-13, 1e-13), (-1e-13, 1e-13)])
def test_slopes_of_a_single_place_are_as_well_known_as_what_holds_them_back(
    twin: bool, rounded: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of whose weights rounding leaves less than nothing about their mean."""
    weight, x, y, value = 6e9, 31.0, -37.0, 1050.0
    less_x, less_y = rounded
    sums = [weight, weight * x, weight * y]
    sums += [weight * x * x * (1 - less_x), weight * x * y, weight * y * y * (1 - less_y)]
    sums += [weight * value * power for power in (1, x, y, value)] + [4.0]
    if not twin:
        monkeypatch.setattr(plane_fits, "_compiled", None)
    planes = plane_fits._Planes(*(np.empty((1, 1), np.float32) for _ in range(9)))
    arrays = [np.full((1, 1), part) for part in sums]
    plane_fits._solve(arrays, 1.0, 10, slice(None), planes)
    # A slope of one a pixel, ten pixels to a radius.
    most = 10 / np.sqrt(0.1) * (1 + 1e-3)
    assert 0 < planes.px[0, 0] <= most and 0 < planes.qy[0, 0] <= most
    assert all(np.isfinite(part).all() for part in planes)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("columns", "factor"), [(2, 4.8), (3, 2.7), (4, 7.2), (9, 1.6), (31, 5.5), (78, 6.7)]
)
@pytest.mark.parametrize("seed", range(4))
def test_no_plane_is_known_better_than_any_can_be(columns: int, factor: float, seed: int) -> None:
    """Wide windows on narrow strips, whose slopes are hardly known."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:60, :78]
    error = rng.choice([0.03, 0.1, 2.0, 20.0], x.shape, p=rng.dirichlet([0.2] * 4))
    value = (rng.normal() * x + rng.normal() * y + error * rng.normal(size=x.shape)).astype("f4")
    value[:, columns:] = np.nan
    fitted, spread = fit_planes(value, error.astype(np.float32), Windows.for_step(8 * factor))
    assert np.isfinite(fitted[:, :columns]).all()
    assert (spread >= np.float32(0.02)).all()


def exact_plane(parts: list[tuple[float, float, int, int]]) -> tuple[Fraction, Fraction]:
    """A plane's value at (0, 0), and its misfit, from values, weights and places."""
    used = [tuple(map(Fraction, part)) for part in parts]
    sums = {
        (power, a, b): sum(weight * value**power * x**a * y**b for value, weight, x, y in used)
        for power, a, b in product(range(3), repeat=3)
    }
    w, wx, wy = sums[0, 0, 0] + Fraction(1e-9), sums[0, 1, 0], sums[0, 0, 1]
    wxx, wxy, wyy = sums[0, 2, 0], sums[0, 1, 1], sums[0, 0, 2]
    wv, wvx, wvy = sums[1, 0, 0], sums[1, 1, 0], sums[1, 0, 1]
    wxx, wyy = (total + Fraction(0.1) for total in (wxx, wyy))
    # Cramer's rule.
    ca, cb, cc = wxx * wyy - wxy**2, wxy * wy - wx * wyy, wx * wxy - wxx * wy
    determinant = w * ca + wx * cb + wy * cc
    a = (ca * wv + cb * wvx + cc * wvy) / determinant
    b = (cb * wv + (w * wyy - wy**2) * wvx + (wx * wy - w * wxy) * wvy) / determinant
    c = (cc * wv + (wx * wy - w * wxy) * wvx + (w * wxx - wx**2) * wvy) / determinant
    return a, (sums[2, 0, 0] - a * wv - b * wvx - c * wvy) / max(len(used) - 3, 1)


@pytest.mark.parametrize(("radius", "unknown", "seed"), [(28, 0.9, 19), (24, 0.9, 3)])
def test_planes_of_errors_of_all_sizes_are_those_of_exact_arithmetic(
    radius: int, unknown: float, seed: int
) -> None:
    """As are those windows that hold more than one surface."""
    value, error = of_few_errors(seed, unknown)
    known, variance = plane_fits._known(value, error)
    trusted = plane_fits._trusted(value, known, variance, 3.0)
    weight = np.where(trusted, 1 / np.maximum(variance.astype(np.float64), 1e-6), 0)
    size, cells = plane_fits._cells(radius)
    planes = plane_fits._planes(np.nan_to_num(value, nan=0.0).astype("f8"), weight, size, cells, 1)
    y, x = np.nonzero(trusted)
    compared = 0
    for row, cell in np.ndindex(15, 19):
        inside = (abs(y // size - row) <= cells) & (abs(x // size - cell) <= cells)
        if inside.sum() < 4:
            continue
        parts = [
            (float(value[at]), float(weight[at]), at[1] - cell * size, at[0] - row * size - 1.5)
            for at in zip(y[inside].tolist(), x[inside].tolist(), strict=True)
        ]
        a, misfit = exact_plane(parts)
        one_surface = np.isfinite(planes.planes.r[row, cell * size])
        if abs(misfit / Fraction(1.5) - 1) > 0.01:
            assert one_surface == (misfit < 1.5)
        if one_surface:
            assert planes.planes.a[row, cell * size] == pytest.approx(float(a), abs=1e-3)
            compared += 1
    assert compared > 20
