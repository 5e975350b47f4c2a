from collections.abc import Callable
from functools import cache, cached_property

import cv2
import numpy as np
import pytest

from shadowtool.core.holdout import (
    Background,
    figure_mask,
    find_background,
)
from shadowtool.core.noise import NoiseModel
from shadowtool.core.robust_plates import SAMPLES
from tests.scene import Scene, smoothstep

WIDTH, HEIGHT = 240, 135
FRAMES = 40
SCENE = Scene(HEIGHT, WIDTH, rows=(0, 0), columns=(0, 0))
NOISE = NoiseModel(np.full(3, 5e-5), np.full(3, 2e-7))
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH].astype(float)
# Head, shirt, trousers, shoes, from the top, as parts of the height.
MANY = ((0.2, (0.55, 0.33, 0.24)), (0.6, (0.10, 0.35, 0.75)), (0.95, (0.75, 0.7, 0.1)))
DARK = ((0.2, (0.30, 0.16, 0.10)), (0.6, (0.018, 0.018, 0.022)), (0.95, (0.03, 0.026, 0.024)))
VELVET = ((1.0, (0.004, 0.004, 0.004)),)
RATIO = np.array([0.18, 0.23, 0.3])
Walk = Callable[[int], float]
Clothes = tuple[tuple[float, tuple[float, float, float]], ...]


def steadily(frame: int) -> float:
    return 25 + 190 * frame / (FRAMES - 1)


def pausing(frame: int) -> float:
    """Stands still for a third of the take."""
    return 25 + 190 * float(np.interp(frame, [0, 13, 27, 39], [0, 0.5, 0.5, 1]))


def stopping(frame: int) -> float:
    """Walks in and stands for 60% of the take."""
    return 25 + 190 * float(np.interp(frame, [0, 0.4 * FRAMES], [0, 0.5]))


def leaving(frame: int) -> float:
    """Stands for 60% of the take and walks out."""
    return 215 - 190 * float(np.interp(frame, [0.6 * FRAMES, FRAMES], [0.5, 1]))


def waiting(frame: int) -> float:
    """Stands in the middle for all but a sixth of the take at either end."""
    return 25 + 190 * float(np.interp(frame, [0, 7, 33, 39], [0, 0.5, 0.5, 1]))


def about_the_middle(frame: int) -> float:
    """Stays about the middle of the picture."""
    return 80 + 110 * frame / (FRAMES - 1)


def figure_alpha(x: float) -> np.ndarray:
    """A figure as tall as half the picture with a soft edge, (H, W)."""
    distance = np.hypot((COLUMNS - x) / 13, (ROWS - 65) / 36) - 1
    return 1 - smoothstep(distance * 13 / 1.5 + 0.5)


def figure_colour(x: float, clothes: Clothes) -> np.ndarray:
    """Clothes with folds, (H, W, 3)."""
    height = (ROWS - 29) / 72
    colour = np.full((HEIGHT, WIDTH, 3), clothes[-1][1])
    for part, own in reversed(clothes):
        colour[height < part] = own
    folds = 1 + 0.25 * np.sin((COLUMNS - x) / 2) * np.cos(ROWS / 5)
    return colour * folds[..., None]


def shadow_beta(x: float, reach: float = 34, soft: float = 2) -> np.ndarray:
    """A slanting shadow that starts at the feet and gets softer with distance."""
    away = np.clip((ROWS - 88) / 40, 0, 1)
    distance = np.abs(COLUMNS - (x + reach * away)) - 11
    beta = smoothstep(distance / (soft + 6 * away) + 0.5)
    return np.where(ROWS > 88, beta, 1.0)


class Shoot:
    """Frames, α and β of a take."""

    def __init__(
        self, walk: Walk | None, clothes: Clothes = MANY, shade: np.ndarray | None = None
    ) -> None:
        self.frames, self.alphas, self.betas = [], [], []
        for number in range(FRAMES):
            x = 25 + 4.8 * number if walk is None else walk(number)
            beta = shadow_beta(x)
            if shade is not None:
                # Another shadow, that moves away for the last quarter of the take.
                beta = np.minimum(beta, shade if number < 0.7 * FRAMES else 1)
            image = SCENE.image(beta.astype(np.float32))
            alpha = np.zeros((HEIGHT, WIDTH)) if walk is None else figure_alpha(x)
            colour = figure_colour(x, clothes)
            image = alpha[..., None] * colour + (1 - alpha[..., None]) * image
            self.frames.append(SCENE.noisy(image, number))
            self.alphas.append(alpha)
            self.betas.append(beta)
        self.samples = [
            self.frames[i] for i in np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
        ]

    @cached_property
    def background(self) -> Background:
        return find_background(self.samples, NOISE)

    @cached_property
    def masks(self) -> list[np.ndarray]:
        return [figure_mask(frame, self.background) for frame in self.frames]


@cache
def shoot(name: str) -> Shoot:
    takes = {
        "walking": lambda: Shoot(steadily),
        "pausing": lambda: Shoot(pausing),
        "stopping": lambda: Shoot(stopping),
        "stopping in dark clothes": lambda: Shoot(stopping, DARK),
        "leaving": lambda: Shoot(leaving),
        "waiting": lambda: Shoot(waiting),
        "dark clothes": lambda: Shoot(about_the_middle, DARK, shade=middle_shade()),
        "dark clothes right across": lambda: Shoot(steadily, DARK),
        "all but black clothes": lambda: Shoot(steadily, VELVET),
        "shade in most frames": lambda: Shoot(steadily, shade=lasting_shade()),
        "empty": lambda: Shoot(None),
    }
    return takes[name]()


def lasting_shade() -> np.ndarray:
    return smoothstep((np.hypot(COLUMNS - 190, ROWS - 105) - 22) / 5 + 0.5)


def middle_shade() -> np.ndarray:
    """Shade that the figure walks through."""
    return smoothstep((np.abs(COLUMNS - 130) - 25) / 4 + 0.5)


TAKES = [
    "walking",
    "pausing",
    "stopping",
    "stopping in dark clothes",
    "leaving",
    "waiting",
    "dark clothes",
    "dark clothes right across",
    "all but black clothes",
    "shade in most frames",
]


@pytest.mark.parametrize("name", TAKES)
def test_nearly_all_of_the_figure_is_held_out_of_every_frame(name: str) -> None:
    take = shoot(name)
    for mask, alpha in zip(take.masks, take.alphas, strict=True):
        assert mask[alpha > 0.5].mean() >= 0.98


@pytest.mark.parametrize("name", TAKES)
def test_little_else_is_held_out(name: str) -> None:
    take = shoot(name)
    around = np.ones((15, 15), np.uint8)
    held_light, held_shade = [], []
    for mask, alpha, beta in zip(take.masks, take.alphas, take.betas, strict=True):
        away = cv2.dilate((alpha > 0).astype(np.uint8), around) == 0
        held_light.append(mask[away & (beta == 1)].mean())
        held_shade.append(mask[away & (beta < 0.9)].mean())
    assert np.mean(held_light) < 0.01
    assert np.mean(held_shade) < 0.05


@pytest.mark.parametrize("name", [*TAKES, "empty"])
def test_the_lines_are_those_of_the_ground(name: str) -> None:
    background = shoot(name).background
    lit = np.abs(np.log(background.lit / SCENE.lit)).max(axis=-1)
    assert np.mean(lit < 0.05) > 0.97
    shadow = np.abs(np.log(background.shadow / SCENE.shadow)).max(axis=-1)
    assert np.mean(shadow < 0.15) > 0.95


@pytest.mark.parametrize("sky", [0.12, 0.07, 0.04])
def test_a_large_figure_in_one_colour_is_no_deep_shadow(sky: float) -> None:
    """On ground of few colours a plain figure's ratio to it is as frequent as shadow's."""
    rng = np.random.default_rng(0)
    lit = np.where((COLUMNS // 20 + ROWS // 20) % 2 == 0, 0.35, 0.3)[..., None]
    lit = (lit * np.array([1.05, 1.0, 0.9])).astype(np.float32)
    ratio = sky * np.array([0.8, 1.0, 1.4])
    frames = []
    for number in range(0, FRAMES, 2):
        x = steadily(number)
        beta = shadow_beta(x)[..., None]
        image = lit * (ratio + beta * (1 - ratio))
        alpha = figure_alpha(x)[..., None] > 0.5
        shading = np.exp(0.12 * np.sin((COLUMNS - x) / 4))[..., None]
        image = np.where(alpha, np.array([0.07, 0.12, 0.27]) * shading, image)
        noise = np.sqrt(5e-5 * image + 5e-6) * rng.normal(size=image.shape)
        frames.append((image + noise).astype(np.float32))
    background = find_background(frames, NoiseModel(np.full(3, 5e-5), np.full(3, 5e-6)))
    below = (ROWS > 100) & (COLUMNS > 60) & (COLUMNS < 180)
    found = np.median((background.shadow / background.lit)[below], axis=0)
    assert found == pytest.approx(ratio, rel=0.15)


@pytest.mark.parametrize("grain", [0.03, 0.08, 0.2])
@pytest.mark.parametrize("clothes", [0.01, 0.02, 0.04])
def test_plain_dark_clothes_that_fill_much_of_a_picture_are_no_shadow(
    clothes: float, grain: float
) -> None:
    """All of one colour before even ground; what tells is that ground is never quite even."""
    rng = np.random.default_rng(0)
    texture = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 1)
    lit = 0.4 * np.exp(grain / texture.std() * texture)[..., None] * np.array([1.05, 1.0, 0.9])
    frames = []
    for number in range(0, FRAMES, 2):
        x = -30 + 300 * number / (FRAMES - 1)
        image = lit * (RATIO + shadow_beta(x)[..., None] * (1 - RATIO))
        figure = np.hypot((COLUMNS - x) / 40, (ROWS - 50) / 58) < 1
        image[figure] = clothes * np.array([1.0, 0.9, 0.95])
        frames.append(SCENE.noisy(image.astype(np.float32), number))
    background = find_background(frames, NOISE)
    found = np.median((background.shadow / background.lit)[110:], axis=(0, 1))
    assert found == pytest.approx(RATIO, rel=0.05)


def test_bright_clothes_in_the_grounds_colour_make_no_shade_of_the_ground() -> None:
    """Were they lit ground, all that is seen without them would be ground in a penumbra."""
    frames, alphas = [], []
    for number in range(FRAMES):
        x = steadily(number)
        image = SCENE.lit * (0.25 + 0.75 * shadow_beta(x)[..., None])
        alphas.append(figure_alpha(x) > 0.5)
        image = np.where(alphas[-1][..., None], 2.2 * SCENE.lit, image)
        frames.append(SCENE.noisy(image.astype(np.float32), number))
    chosen = np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
    background = find_background([frames[i] for i in chosen], NOISE)
    off = np.abs(np.log(background.lit / SCENE.lit)).max(axis=-1)
    assert np.mean(off < 0.1) > 0.98
    held = [
        figure_mask(frame, background)[alpha].mean()
        for frame, alpha in zip(frames, alphas, strict=True)
    ]
    assert np.mean(held) > 0.95


@pytest.mark.parametrize(("least", "most"), [(0.16, 0.35), (0.1, 0.4), (0.06, 0.4)])
def test_near_a_lamp_shadow_is_deeper_and_still_no_figure(least: float, most: float) -> None:
    """A ratio that changes from left to right: no one ratio is the scene's, or a window's."""
    rng = np.random.default_rng(2)
    texture = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 1)
    lit = 0.4 * np.exp(0.08 / texture.std() * texture)[..., None] * np.array([1.05, 1.0, 0.9])
    ratio = (least * (most / least) ** (COLUMNS / WIDTH))[..., None]
    frames, betas, alphas = [], [], []
    for number in range(FRAMES):
        x = steadily(number)
        betas.append(shadow_beta(x))
        alphas.append(figure_alpha(x))
        image = lit * (ratio + betas[-1][..., None] * (1 - ratio))
        image += alphas[-1][..., None] * (figure_colour(x, MANY) - image)
        frames.append(SCENE.noisy(image.astype(np.float32), number))
    chosen = np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
    background = find_background([frames[i] for i in chosen], NOISE)
    shade, figure = [], []
    for frame, beta, alpha in zip(frames, betas, alphas, strict=True):
        mask = figure_mask(frame, background)
        shade.append(mask[(beta < 0.05) & (ROWS > 110)].mean())
        figure.append(mask[alpha > 0.5].mean())
    assert np.mean(shade) < 0.03
    assert np.mean(figure) > 0.95


@pytest.mark.parametrize("sky", [0.6, 0.7])
def test_shadow_hardly_darker_than_light_has_its_ratio_too(sky: float) -> None:
    """Noise spreads what is lit nearly as far as shadow lies below it."""
    ratio = np.array([sky - 0.02, sky, sky + 0.05])
    noise = NoiseModel(np.full(3, 1.5e-3), np.full(3, 1e-6))
    rng = np.random.default_rng(5)
    frames = []
    for number in range(SAMPLES):
        x = steadily(number * FRAMES / SAMPLES)
        image = SCENE.lit * (ratio + shadow_beta(x)[..., None] * (1 - ratio))
        image += figure_alpha(x)[..., None] * (figure_colour(x, DARK) - image)
        spread = noise.sigma(image.astype(np.float32))
        frames.append((image + spread * rng.normal(size=image.shape)).astype(np.float32))
    background = find_background(frames, noise)
    found = np.median(background.shadow / background.lit, axis=(0, 1))
    assert found == pytest.approx(ratio, abs=0.05)


def test_of_a_shadow_and_its_wide_penumbra_the_shadow_counts() -> None:
    """More of the ground is in half light, as beside two lamps, than in shadow."""
    frames, betas, alphas = [], [], []
    for number in range(FRAMES):
        x = steadily(number)
        half = np.where((ROWS > 88) & (np.abs(COLUMNS - x - 30) < 18), 0.5, 1.0)
        betas.append(np.minimum(half, shadow_beta(x)))
        alphas.append(figure_alpha(x))
        image = SCENE.image(betas[-1].astype(np.float32))
        image += alphas[-1][..., None] * (figure_colour(x, MANY) - image)
        frames.append(SCENE.noisy(image.astype(np.float32), number))
    chosen = np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
    background = find_background([frames[i] for i in chosen], NOISE)
    shade = [
        figure_mask(frame, background)[(beta < 0.05) & (ROWS > 100)].mean()
        for frame, beta in zip(frames, betas, strict=True)
    ]
    assert np.mean(shade) < 0.1


def test_a_surface_that_shade_makes_darker_than_others_is_background_too() -> None:
    wall = (COLUMNS > 100) & (COLUMNS < 160) & (ROWS > 95)
    grain = 0.7 * np.exp(0.4 * np.random.default_rng(0).normal(size=wall.shape))[..., None]
    lit, shadow = grain * SCENE.lit, grain * SCENE.shadow
    shadow[wall] *= 0.7
    frames, betas = [], []
    for number in range(FRAMES):
        away = np.abs(COLUMNS - (-35 + 310 * number / (FRAMES - 1))) - 35
        betas.append(np.where(ROWS > 88, np.clip(away / 2 + 0.5, 0, 1), 1.0))
        image = shadow + betas[-1][..., None] * (lit - shadow)
        frames.append(SCENE.noisy(image.astype(np.float32), number))
    some = np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
    background = find_background([frames[i] for i in some], NOISE)
    held = [
        figure_mask(frame, background)[wall & (beta == 0)]
        for frame, beta in zip(frames, betas, strict=True)
    ]
    assert np.concatenate(held).mean() < 0.1


@pytest.mark.parametrize(
    ("soft", "sky"), [(2, 1.0), (16, 1.0), (20, 0.5), (2, 0.05), (2, 0.02), (2, 0.0), (12, 0.0)]
)
def test_shadow_is_background_however_soft_or_dark(soft: float, sky: float) -> None:
    dark = SCENE.shadow * np.float32(sky)
    frames, alphas, betas = [], [], []
    for number in range(FRAMES):
        x = steadily(number)
        betas.append(shadow_beta(x, soft=soft))
        alphas.append(figure_alpha(x))
        image = dark + betas[-1][..., None] * (SCENE.lit - dark)
        image += alphas[-1][..., None] * (figure_colour(x, MANY) - image)
        frames.append(SCENE.noisy(image.astype(np.float32), number))
    chosen = np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
    background = find_background([frames[i] for i in chosen], NOISE)
    assert np.median(np.abs(background.shadow - dark) / SCENE.lit) < 0.02
    held = [figure_mask(frame, background) for frame in frames]
    around = np.ones((15, 15), np.uint8)
    away = [cv2.dilate((alpha > 0).astype(np.uint8), around) == 0 for alpha in alphas]
    shade = [m[a & (b < 0.9)].mean() for m, a, b in zip(held, away, betas, strict=True)]
    assert np.mean(shade) < 0.05
    figure = [m[alpha > 0.5].mean() for m, alpha in zip(held, alphas, strict=True)]
    assert np.mean(figure) > 0.97


@pytest.mark.parametrize("places", [1, 3, 30, 300])
def test_what_a_few_pixels_lose_makes_no_common_ratio(places: int) -> None:
    rng = np.random.default_rng(places)
    frames = [SCENE.noisy(SCENE.lit, seed)[:60, :80] for seed in range(SAMPLES)]
    for frame in frames[::2]:
        dimmed = rng.integers(0, 60, places), rng.integers(0, 80, places)
        frame[dimmed] *= rng.uniform(0.68, 0.77, (places, 1)).astype(np.float32)
    background = find_background(frames, NOISE)
    ratio = background.shadow / background.lit
    assert ((ratio > 0.2) & (ratio < 0.8)).all()


def test_a_channel_may_be_black() -> None:
    lit = np.random.default_rng(3).uniform(0.3, 0.7, (60, 80, 3)).astype(np.float32)
    lit[::2, :, 2] = 0
    frames = []
    for number in range(12):
        frame = lit.copy()
        frame[20:40, 5 * number : 5 * number + 20] *= 0.25
        frames.append(frame)
    background = find_background(frames, NOISE)
    assert np.isfinite(background.lit).all()
    assert np.isfinite(background.shadow).all()


def test_a_take_without_a_figure_holds_nothing_out() -> None:
    assert not any(mask.any() for mask in shoot("empty").masks)


def test_a_still_take_holds_nothing_out() -> None:
    frames = [SCENE.noisy(SCENE.lit, seed)[:60, :80] for seed in range(SAMPLES)]
    background = find_background(frames, NOISE)
    assert not any(figure_mask(frame, background).any() for frame in frames)


def test_under_a_card_there_is_no_background_to_tell() -> None:
    ratio = np.kron(np.random.default_rng(2).uniform(0.1, 0.4, (9, 16)), np.ones((15, 15)))
    shadow = SCENE.lit * ratio[..., None].astype(np.float32)
    frames = []
    for number in range(SAMPLES):
        x = -70 + 16 * number
        beta = smoothstep((np.abs(COLUMNS - x) - 45) / 10)[..., None].astype(np.float32)
        frames.append(SCENE.noisy(shadow + beta * (SCENE.lit - shadow), number)[40:80])
    assert find_background(frames, NOISE).under_card


@pytest.mark.parametrize("somebody", [False, True])
def test_what_covers_half_of_a_picture_is_a_card_if_nobody_is_seen(somebody: bool) -> None:
    frames = []
    for number in range(SAMPLES):
        x = -20 + 13 * number
        beta = np.where(ROWS > 70, smoothstep((np.abs(COLUMNS - x) - 25) / 4), 1)
        image = SCENE.image(beta.astype(np.float32))
        alpha = figure_alpha(x)[..., None] * somebody
        frames.append(SCENE.noisy(alpha * figure_colour(x, MANY) + (1 - alpha) * image, number))
    assert find_background(frames, NOISE).under_card != somebody


@pytest.mark.parametrize("somebody", [False, True])
def test_a_card_may_come_to_each_place_but_once(somebody: bool) -> None:
    frames = []
    for number in range(SAMPLES):
        x, y = 30 + 60 * (number % 4), 12 + 19 * (number // 4)
        beta = np.where((np.abs(COLUMNS - x) < 28) & (np.abs(ROWS - y) < 10), 0.0, 1.0)
        image = SCENE.image(beta.astype(np.float32))
        alpha = figure_alpha(steadily(number))[..., None] * somebody
        colour = figure_colour(steadily(number), MANY)
        frames.append(SCENE.noisy(alpha * colour + (1 - alpha) * image, number))
    assert find_background(frames, NOISE).under_card != somebody


# The part of a picture that the figure crosses half-way through the take.
MIDDLE = slice(20, 120), slice(90, 150)


def test_unknown_pixels_do_not_spread() -> None:
    take = shoot("walking")
    samples = [sample[MIDDLE].copy() for sample in take.samples]
    whole = find_background(samples, NOISE)
    frame = take.frames[20][MIDDLE].copy()
    expected = figure_mask(frame, whole)
    for broken in (*samples, frame):
        broken[2:5, 2:5] = np.nan
        broken[9, 9] = np.inf
    background = find_background(samples, NOISE)
    assert expected.any()
    assert (figure_mask(frame, background) == expected)[16:].mean() > 0.995


def test_the_same_samples_give_the_same_bits_and_are_left_alone() -> None:
    take = shoot("walking")
    samples = [sample[MIDDLE].copy() for sample in take.samples]
    one, other = (find_background(samples, NOISE) for _ in range(2))
    assert one.lit.tobytes() == other.lit.tobytes()
    assert one.shadow.tobytes() == other.shadow.tobytes()
    frame = take.frames[7][MIDDLE].copy()
    assert np.array_equal(figure_mask(frame, one), figure_mask(frame, other))
    assert np.array_equal(frame, take.frames[7][MIDDLE])
    pairs = zip(samples, take.samples, strict=True)
    assert all(np.array_equal(sample, full[MIDDLE]) for sample, full in pairs)


@pytest.mark.parametrize("part", [0, 1.1])
def test_to_pass_over_decided_pixels_changes_no_bit(
    part: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    samples = [sample[MIDDLE] for sample in shoot("pausing").samples]
    usual = find_background(samples, NOISE)
    monkeypatch.setattr("shadowtool.core.holdout._WORTHWHILE", part)
    other = find_background(samples, NOISE)
    assert np.array_equal(usual.lit, other.lit) and np.array_equal(usual.shadow, other.shadow)


def test_a_lone_pixel_is_no_figure() -> None:
    background = shoot("empty").background
    frame = SCENE.noisy(SCENE.lit, 99)
    frame[60, 100] = 3
    assert not figure_mask(frame, background).any()


def test_shade_of_rough_ground_is_background() -> None:
    """Of gravel each grain has a ratio of its own."""
    rng = np.random.default_rng(8)
    rough = np.exp(0.15 * rng.standard_normal((HEIGHT, WIDTH, 1)))
    frames, betas = [], []
    for number in range(FRAMES):
        beta = shadow_beta(25 + 4.8 * number)
        shade = SCENE.lit * RATIO * rough
        image = beta[..., None] * SCENE.lit + (1 - beta[..., None]) * shade
        frames.append(SCENE.noisy(image.astype(np.float32), number))
        betas.append(beta)
    places = np.linspace(0, FRAMES - 1, SAMPLES).round().astype(int)
    background = find_background([frames[i] for i in places], NOISE)
    held = [figure_mask(f, background)[b < 0.1] for f, b in zip(frames, betas, strict=True)]
    assert np.concatenate(held).mean() < 0.05
