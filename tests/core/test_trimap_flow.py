import cv2
import numpy as np
import pytest

from shadowtool.core.trimap import BACKGROUND, FIGURE, UNKNOWN
from shadowtool.core.trimap_flow import Carried, Link, carry, flow_picture, links, merge
from tests.figures import SCENE, disk

RNG = np.random.default_rng(3)
CLOTH = cv2.GaussianBlur(RNG.uniform(0, 1, (*SCENE.lit.shape[:2], 1)), (0, 0), 1.5)


def frame(shift: float) -> np.ndarray:
    """A patterned disk before the ground, moved to the right."""
    move = np.float32([[1, 0, shift], [0, 1, 0]])
    pattern = cv2.warpAffine(CLOTH, move, (SCENE.width, SCENE.height), borderMode=cv2.BORDER_WRAP)
    alpha = disk(50 + shift, 50, 22)[..., None]
    figure = np.clip(0.5 + 4 * (pattern[..., None] - 0.5), 0, 1)
    return (alpha * figure + (1 - alpha) * SCENE.lit).astype(np.float32)


def drawn(shift: float) -> np.ndarray:
    trimap = np.full(SCENE.lit.shape[:2], UNKNOWN, np.uint8)
    trimap[disk(50 + shift, 50, 18) == 1] = FIGURE
    trimap[disk(50 + shift, 50, 27) == 0] = BACKGROUND
    return trimap


def ways(steps: int, speed: float) -> tuple[list, list]:
    """The links from the last frame of some to the first, and from the first to the last."""
    pictures = [flow_picture(frame(speed * k)) for k in range(steps + 1)]
    pairs = [links(pictures[k], pictures[k + 1]) for k in range(steps)]
    return [back for _, back in reversed(pairs)], [there for there, _ in pairs]


def test_links_follow_the_figure_and_leave_the_ground_alone() -> None:
    there, back = links(flow_picture(frame(0)), flow_picture(frame(3)))
    inside, far = disk(50, 50, 15) == 1, disk(50, 50, 40) == 0
    assert np.median(there.flow[inside], axis=0) == pytest.approx([3, 0], abs=0.2)
    assert np.abs(there.flow[far]).mean() < 0.2
    assert np.median(back.flow[disk(53, 50, 15) == 1], axis=0) == pytest.approx([-3, 0], abs=0.2)
    assert np.median(there.error[inside]) < 0.2


def test_what_only_one_of_two_frames_shows_is_lost() -> None:
    there, _ = links(flow_picture(frame(0)), flow_picture(SCENE.lit))
    hidden, far = disk(50, 50, 18) == 1, disk(50, 50, 45) == 0
    assert np.median(there.error[hidden]) > 0.5
    assert np.median(there.error[far]) < 0.1


def test_a_keyframe_is_carried_to_where_the_figure_has_gone() -> None:
    back, _ = ways(5, 3)
    carried = carry(drawn(0), back)
    assert (disk(65, 50, 22)[carried.trimap == FIGURE] > 0).mean() > 0.98
    assert (carried.trimap[disk(65, 50, 13) == 1] == FIGURE).mean() > 0.95
    assert (disk(65, 50, 22)[carried.trimap == BACKGROUND] == 0).mean() > 0.98


def test_the_further_it_is_carried_the_less_is_known() -> None:
    back, _ = ways(6, 1)
    near, far = carry(drawn(5), back[:1]), carry(drawn(0), back)
    assert (near.trimap == UNKNOWN).sum() < (far.trimap == UNKNOWN).sum()
    assert near.error.mean() < far.error.mean()


def test_every_step_adds_to_the_error() -> None:
    shape = SCENE.lit.shape[:2]
    still = Link(np.zeros((*shape, 2), np.float16), np.zeros(shape, np.float16))
    one, many = carry(drawn(0), [still]), carry(drawn(0), [still] * 8)
    assert (many.error > one.error).all()
    assert (one.trimap == UNKNOWN).sum() < (many.trimap == UNKNOWN).sum()
    assert np.isinf(carry(drawn(0), [still] * 30).error).all()


def test_without_a_way_it_is_as_drawn() -> None:
    carried = carry(drawn(0), [])
    assert np.array_equal(merge([carried]), drawn(0))


def side(trimap: int, error: float) -> Carried:
    return Carried(np.full((1, 1), trimap, np.uint8), np.full((1, 1), error, np.float32))


@pytest.mark.parametrize(
    ("before", "after", "merged"),
    [
        (side(FIGURE, 1), side(FIGURE, 3), FIGURE),
        (side(FIGURE, 2), side(BACKGROUND, 3), UNKNOWN),
        (side(FIGURE, 1), side(BACKGROUND, 3), FIGURE),
        (side(UNKNOWN, 3), side(BACKGROUND, 1), BACKGROUND),
        (side(FIGURE, np.inf), side(BACKGROUND, 3), BACKGROUND),
        (side(FIGURE, np.inf), side(FIGURE, np.inf), UNKNOWN),
    ],
)
def test_two_sides_are_merged_by_how_surely_each_is_known(
    before: Carried, after: Carried, merged: int
) -> None:
    assert merge([before, after]) == merged
    assert merge([after, before]) == merged


def test_large_pictures_are_looked_at_small() -> None:
    assert flow_picture(np.zeros((1080, 1920, 3), np.float16)).shape == (270, 480)
    assert flow_picture(np.zeros((8, 6, 3), np.float32)).shape == (16, 16)


def test_the_small_picture_of_what_is_brighter_than_1_is_not_all_white() -> None:
    two, many = (flow_picture(frame(0) * np.float32(scale)) for scale in (4, 64))
    assert np.abs(two.astype(int) - many).max() <= 1
    assert 100 < np.median(two) < 250


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
@pytest.mark.parametrize("size", [(8, 6), (270, 480)])
def test_what_is_not_finite_stays_where_it_is(bad: float, size: tuple[int, int]) -> None:
    image = np.random.default_rng(0).uniform(0.1, 0.8, (*size, 3)).astype(np.float32)
    spoiled = image.copy()
    spoiled[: size[0] // 4, : size[1] // 4] = bad
    whole, part = flow_picture(image), flow_picture(spoiled)
    height, width = whole.shape
    assert np.array_equal(whole[height // 2 :], part[height // 2 :])
    assert np.array_equal(whole[:, width // 2 :], part[:, width // 2 :])
