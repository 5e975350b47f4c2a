"""Alpha and colour of a figure before a background that is known but for its shadow.

C = αF + (1 - α)B(β). F is that of a near part of the figure in more or less light; β is that of
the ground around, give or take. For each of several near parts the most probable α, β and light on
the figure follow in closed form (after Bayesian matting, Chuang et al. 2001, whose background and
figure are here lines), and what they give is averaged by how well each explains the pixel.

Where alpha is known beforehand, give or take, it may still be quite another: there the ground may
be in a shadow that is only seen further away, as under a sole, or the figure may turn into its own
shade, as what is round does at its rim. These are two explanations more.
"""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from shadowtool.core.backdrop import Backdrop
from shadowtool.core.bands import blocks
from shadowtool.core.filling import fill_membrane
from shadowtool.core.regions import square
from shadowtool.core.transfer import LUMA
from shadowtool.core.trimap import FIGURE, UNKNOWN, Prior

Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]
Index = NDArray[np.intp]
Places = tuple[Index, ...]
Bool = NDArray[np.bool_]

# How far the figure's colour is from that of its near part, as a part of it, and at least; and by
# what part of it there may be more or less light.
_COLOUR, _LEAST_COLOUR = 0.04, 0.002
_SHADING = 0.25
# In compressed footage colours are coarser than luma: their alpha is so far from its own.
_FRINGE = 0.15
# Once alpha is known, how far the pixel's own may be.
_OWN_COLOUR = 0.6
# How far β is from that of the ground around where that is even.
_BETA = 0.02
# There may be shadow that is only seen so many times the edges' reach away. How rare that is, as is
# a figure in its own shade: exp(-the second). Alpha is then off by the third from 0, or from what
# else is expected.
_UNSEEN_REACHES, _RARE, _OFF = 5, 2.0, 0.3
# Within so many pixels β is looked at for evenness.
_EVEN_RADIUS = 4
# What near parts of the figure are tried: the nearest, and those nearest to places (down, right)
# this far off; one at the second distance counts less by exp(-1/2).
_AROUND, _FAR = 3, 6.0
_STEPS = ((0, 0), (_AROUND, 0), (-_AROUND, 0), (0, _AROUND), (0, -_AROUND))
_ROUNDS = 2
_BLOCK = 1 << 16


class Measured(NamedTuple):
    """What a frame by itself tells of a figure's matte.

    Attributes:
        alpha: (H, W) float32 in [0, 1].
        error: (H, W) float32, standard deviation of alpha where the trimap is unknown, else 0.
        misfit: (H, W) float32, squared distance of C from its explanation in standard deviations,
            where the trimap is unknown, else 0.
    """

    alpha: Float32
    error: Float32
    misfit: Float32


class Solved(NamedTuple):
    """A figure's matte and colour.

    Attributes:
        alpha: (H, W) float32 in [0, 1].
        foreground: (H, W, 3) float32 ≥ 0, F where alpha is above 0, not premultiplied.
    """

    alpha: Float32
    foreground: Float32


def ground_beta(beta: Float32, ground: Bool) -> Float32:
    """β of the ground that is seen, carried on behind what hides it.

    Args:
        beta: (H, W), may be below 0.
        ground: (H, W), where it is that of the ground.

    Returns:
        (H, W) float32; 1 if no ground is seen.
    """
    if not ground.any():
        return np.ones_like(beta)
    known = np.where(ground, beta, np.float32(0))[..., np.newaxis]
    return fill_membrane(known, ground.astype(np.float32))[..., 0]


def measure(
    image: Float32, trimap: UInt8, behind: Float32, backdrop: Backdrop, excess: float = 1
) -> Measured:
    """Alpha where a trimap is unknown, if all of [0, 1] is as likely.

    Args:
        image: (H, W, 3) float32, linear light, without NaN.
        trimap: (H, W) uint8; 0 and 255 are kept as they are. Without any 255 all is background:
            there is no figure to mix with.
        behind: (H, W), β from `ground_beta`.
        excess: by how much more than its noise the frame is off beside the figure, ≥ 1.
    """
    solid = trimap == FIGURE
    alpha = solid.astype(np.float32)
    error, misfit = np.zeros_like(alpha), np.zeros_like(alpha)
    if not solid.any():
        return Measured(alpha, error, misfit)
    around = _around(solid, behind, None)
    for part in _blocks(trimap == UNKNOWN):
        pixels = _gather(image, part, around, backdrop, excess)
        mean, deviation = np.full_like(pixels.far, 0.5), np.full_like(pixels.far, 3)
        alpha[part], error[part], misfit[part], _ = _most_probable(pixels, mean, deviation)
    return Measured(alpha, error, misfit)


def solve(
    image: Float32,
    trimap: UInt8,
    behind: Float32,
    backdrop: Backdrop,
    reach: int,
    prior: Prior,
    excess: float = 1,
) -> Solved:
    """Alpha and F where a trimap is unknown; arguments as for `measure`.

    Args:
        reach: how far the figure's edges go, pixels; shadow is looked for in this measure.
        prior: of alpha.
    """
    solid = trimap == FIGURE
    alpha = solid.astype(np.float32)
    foreground = image * alpha[..., np.newaxis]
    if not solid.any():
        return Solved(alpha, foreground)
    around = _around(solid, behind, reach)
    for part in _blocks(trimap == UNKNOWN):
        pixels = _gather(image, part, around, backdrop, excess)
        mean, deviation = np.empty_like(pixels.far), np.empty_like(pixels.far)
        mean[:] = prior.mean[part][:, np.newaxis]
        deviation[:] = prior.deviation[part][:, np.newaxis]
        mean[:, -2], deviation[:, -2] = 0, _OFF
        deviation[:, -1] = np.maximum(deviation[:, -1], np.float32(_OFF))
        alpha[part], error, _, share = _most_probable(pixels, mean, deviation)
        foreground[part] = _colour(pixels, alpha[part], error, share).T
    return Solved(alpha, np.maximum(foreground, 0, out=foreground))


def colours(
    image: Float32, alpha: Float32, behind: Float32, backdrop: Backdrop, reach: int
) -> Float32:
    """F for an alpha that is given; arguments as for `solve`.

    Where nothing is quite opaque, what is most so stands for the figure's colour.

    Returns:
        (H, W, 3) float32 ≥ 0, not premultiplied; 0 where alpha is 0.
    """
    solid = alpha >= min(0.99, float(alpha.max()))
    foreground = np.where((solid & (alpha > 0))[..., np.newaxis], image, np.float32(0))
    around = _around(solid, behind, reach)
    for part in _blocks((alpha > 0) & ~solid):
        pixels = _gather(image, part, around, backdrop)
        given = alpha[part]
        sure = np.full_like(pixels.far, 1e-3)
        *_, share = _most_probable(pixels, given[:, np.newaxis], sure)
        foreground[part] = _colour(pixels, given, np.zeros_like(given), share).T
    return np.maximum(foreground, 0, out=foreground)


def _blocks(mask: Bool) -> Iterator[Places]:
    """The mask's pixels, so many at a time that memory stays bounded."""
    rows, columns = np.nonzero(mask)
    for part in blocks(rows.size, _BLOCK):
        yield rows[part], columns[part]


class _Around(NamedTuple):
    """What there is around each pixel.

    Attributes:
        near: (H, W), the place of the figure's nearest part, counted row by row.
        behind, uneven: (H, W), β and its standard deviation.
        darkest: (H, W), the least β that is not far; None if none but ``behind`` is thought of.
    """

    near: NDArray[np.int32]
    behind: Float32
    uneven: Float32
    darkest: Float32 | None


def _around(solid: Bool, behind: Float32, reach: int | None) -> _Around:
    darkest = None
    if reach is not None:
        darkest = np.asarray(cv2.erode(behind, square(_UNSEEN_REACHES * reach)), np.float32)
    return _Around(_nearest(solid), behind, _unevenness(behind), darkest)


class _Pixels(NamedTuple):
    """N pixels that are mixed, and K explanations for each; colours by channel.

    Attributes:
        seen, noise: (3, N, 1), C and the variance of its noise.
        behind, shift, error: (3, N, K), B, by how much it changes with β, and the variance of its
            own error.
        even: (N, K), standard deviation of β.
        figure, shading: (3, N, K), F, and its standard deviation as there is more or less light.
        far: (N, K), how much the likelihood's logarithm is less than that of what is nearest.
        fringe: standard deviation of the colours' alpha from that of luma.
    """

    seen: Float32
    noise: Float32
    behind: Float32
    shift: Float32
    error: Float32
    even: Float32
    figure: Float32
    shading: Float32
    far: Float32
    fringe: float


def _gather(
    image: Float32, unknown: Places, around: _Around, backdrop: Backdrop, excess: float = 1
) -> _Pixels:
    """If there is a darkest β there are two more explanations, each with the nearest part of the
    figure: the ground's β is anything from that to what is expected; or the figure is in its own
    shade."""
    rows, columns = unknown
    height, width = image.shape[:2]
    steps, which = list(_STEPS), [0] * len(_STEPS)
    sample, plates = image[unknown], backdrop.at(unknown)
    betas, uneven = [around.behind[unknown]], [around.uneven[unknown]]
    if around.darkest is not None:
        half = np.asarray((betas[0] - around.darkest[unknown]) / 2, np.float32)
        betas.append(betas[0] - half)
        uneven.append(np.maximum(uneven[0], half))
        steps += [(0, 0), (0, 0)]
        which += [1, 0]
    chosen = np.stack(
        [
            around.near[np.clip(rows + down, 0, height - 1), np.clip(columns + right, 0, width - 1)]
            for down, right in steps
        ],
        axis=1,
    )
    away = (chosen // width - rows[:, np.newaxis]) ** 2
    away = away + (chosen % width - columns[:, np.newaxis]) ** 2
    far = (away / (2 * _FAR**2)).astype(np.float32)
    figure = np.ascontiguousarray(np.moveaxis(image.reshape(-1, 3)[chosen], -1, 0))
    shading = np.float32(_SHADING) * figure
    if around.darkest is not None:
        far[:, -2:] += np.float32(_RARE)
        far[half < uneven[0], -2] = np.inf
        shade = np.clip(plates.shadow / np.maximum(plates.lit, np.float32(1e-3)), 0, 1).T
        shading[..., -1] = (1 - shade) / 2 * figure[..., -1]
        figure[..., -1] *= (1 + shade) / 2
    span = plates.lit - plates.shadow
    shifts = [np.where(beta[:, np.newaxis] >= 0, span, plates.shadow) for beta in betas]
    grounds = [plates.under(beta) for beta in betas]
    return _Pixels(
        seen=_by_channel(sample),
        noise=_by_channel(backdrop.noise.variance(sample)),
        behind=_by_channel(*grounds)[..., which],
        shift=_by_channel(*shifts)[..., which],
        error=_by_channel(*(plates.own_variance(ground) for ground in grounds))[..., which],
        even=np.stack(uneven, axis=-1)[:, which],
        figure=figure,
        shading=shading,
        far=far,
        fringe=_FRINGE * (1 - 1 / excess**2),
    )


def _by_channel(*values: Float32) -> Float32:
    """K times (N, 3) as (3, N, K)."""
    return np.stack([value.T for value in values], axis=-1)


def _nearest(solid: Bool) -> NDArray[np.int32]:
    """For each pixel the place of the mask's nearest, counted row by row."""
    _, labels = cv2.distanceTransformWithLabels(
        (~solid).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.zeros(int(labels.max()) + 1, np.int32)
    places[labels[solid]] = np.flatnonzero(solid)
    return np.asarray(places[labels], np.int32)


def _unevenness(behind: Float32) -> Float32:
    """The standard deviation to expect of β behind the figure, (H, W)."""
    size = 2 * _EVEN_RADIUS + 1
    mean = cv2.blur(behind, (size, size))
    scatter = cv2.blur(behind**2, (size, size)) - mean**2
    return np.asarray(np.float32(_BETA) + np.sqrt(np.maximum(scatter, 0)), np.float32)


def _most_probable(
    pixels: _Pixels, mean: Float32, deviation: Float32
) -> tuple[Float32, Float32, Float32, Float32]:
    """Alpha, its standard deviation and the least misfit (N), and how much each explanation is
    worth (N, K).

    With the variance of C fixed the posterior of alpha, of how far (1 - α)β is from what is
    expected, and of how far the light on αF is, is normal; the variance, which depends on alpha,
    follows in a second round.

    Args:
        mean, deviation: (N, K), what is expected of alpha.
    """
    trust = 1 / deviation**2
    contrast, above = pixels.figure - pixels.behind, pixels.seen - pixels.behind
    shift, shading = pixels.shift, pixels.shading
    colour = _colour_variance(pixels.figure)
    fringe = np.float32(pixels.fringe) * (contrast - np.tensordot(LUMA, contrast, 1))
    fixed = pixels.noise + fringe**2
    alpha = np.broadcast_to(mean, contrast.shape[1:])
    for _ in range(_ROUNDS):
        variance = fixed + alpha**2 * colour + (1 - alpha) ** 2 * pixels.error
        weight = 1 / variance
        even = 1 / (pixels.even * np.maximum(1 - alpha, np.float32(0.05))) ** 2
        level = 1 / np.maximum(alpha, np.float32(0.05)) ** 2
        # β and light are eliminated from the normal equations.
        ground, light = weight * shift, weight * shading
        ground_ground, light_light = (ground * shift).sum(axis=0), (light * shading).sum(axis=0)
        ground_light = (ground * shading).sum(axis=0)
        # But for rounding, what cancels out leaves nothing negative; so below.
        minor = np.maximum(ground_ground * light_light - ground_light**2, 0)
        ground_ground += even
        minor += level * ground_ground + even * light_light
        light_light += level
        sides = np.stack([(ground * contrast).sum(axis=0), (ground * above).sum(axis=0)])
        lit_sides = np.stack([(light * contrast).sum(axis=0), (light * above).sum(axis=0)])
        betas = (light_light * sides - ground_light * lit_sides) / minor
        lights = (ground_ground * lit_sides - ground_light * sides) / minor
        left = weight * (contrast - betas[0] * shift - lights[0] * shading)
        information = np.maximum((left * contrast).sum(axis=0), 0) + trust
        alpha = ((left * above).sum(axis=0) + trust * mean) / information
        alpha = np.clip(alpha, 0, 1)
    beta, lit = (parts[1] - alpha * parts[0] for parts in (betas, lights))
    rest = above - alpha * contrast - beta * shift - lit * shading
    misfit = (weight * rest**2).sum(axis=0) + even * beta**2 + level * lit**2
    likelihood = misfit + np.log(variance).sum(axis=0) + trust * (alpha - mean) ** 2
    # Of the logarithms, as the product may be too large for a single float.
    likelihood += np.log(minor) + np.log(information) - np.log(even * level * trust)
    likelihood = -likelihood / 2 - pixels.far
    share = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    average = (share * alpha).sum(axis=1)
    spread = (share * (alpha**2 + 1 / information)).sum(axis=1) - average**2
    return np.minimum(average, 1), np.sqrt(np.maximum(spread, 0)), misfit.min(axis=1), share


def _colour_variance(figure: Float32) -> Float32:
    return np.asarray((np.float32(_COLOUR) * figure + np.float32(_LEAST_COLOUR)) ** 2, np.float32)


def _colour(pixels: _Pixels, alpha: Float32, uncertain: Float32, share: Float32) -> Float32:
    """F (3, N) for an alpha that is known but for its standard deviation: between that of the near
    parts and what C tells of it."""
    expected = (share * pixels.figure).sum(axis=-1)
    prior = (np.float32(_OWN_COLOUR) * expected + np.float32(_LEAST_COLOUR)) ** 2
    behind, error = ((share * values).sum(axis=-1) for values in (pixels.behind, pixels.error))
    rest = pixels.seen[..., 0] - alpha * expected - (1 - alpha) * behind
    variance = alpha**2 * prior + pixels.noise[..., 0] + (1 - alpha) ** 2 * error
    variance = variance + (uncertain * (expected - behind)) ** 2
    # What β may be off by errs in all channels together: rank one more in the covariance.
    off = (1 - alpha) * (share * pixels.even * pixels.shift).sum(axis=-1)
    together = (off * rest / variance).sum(axis=0) / (1 + (off**2 / variance).sum(axis=0))
    rest = rest - together * off
    return np.asarray(expected + alpha * prior * rest / variance, np.float32)
