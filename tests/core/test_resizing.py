import numpy as np

from shadowtool.core.resizing import resized


def test_a_pixel_made_mostly_of_what_is_unknown_is_unknown() -> None:
    image = np.full((8, 8, 3), 0.5, np.float32)
    image[2, 3] = image[3, 2:4] = np.nan
    small = resized(image, (4, 4))
    lost = np.isnan(small).all(axis=-1)
    assert np.argwhere(lost).tolist() == [[1, 1]]
    assert (small[~lost] == 0.5).all()
