"""When a sweep's shadow reached each pixel, from frames on disk."""

from pathlib import Path

import numpy as np

from shadowtool.core.half_floats import to_half
from shadowtool.io.products import read_scan
from shadowtool.steps.scan import scan
from tests.conftest import write_frames
from tests.scene import Scene, Sweep

SCENE = Scene(rows=(0, 0), columns=(0, 0))
SWEEP = Sweep(0.3, speed=8.0, soft=1.0, width=30.0)


def test_what_the_key_light_never_reaches_has_no_time(tmp_path: Path) -> None:
    shade = np.zeros((SCENE.height, SCENE.width), bool)
    shade[60:85, 100:150] = True
    shots = []
    for frame in range(SCENE.frames_of(SWEEP)):
        # Of the sky, which is all that lights what lies in shade, the stick takes a little, later.
        sky = 0.9 + 0.1 * SCENE.sweep_beta(SWEEP, frame - 6)[..., None]
        image = SCENE.image(SCENE.sweep_beta(SWEEP, frame))
        image[shade] = (sky * SCENE.shadow)[shade]
        shots.append(to_half(SCENE.noisy(image, frame, 0.0005)))
    scan(write_frames(tmp_path / "take", shots), tmp_path / "scan", plane="0,0 159,0 159,50 0,50")
    time = read_scan(tmp_path / "scan")[0].times.time
    assert not np.isfinite(time[66:79, 106:144]).any()
    assert np.isfinite(time[~shade]).mean() > 0.95
