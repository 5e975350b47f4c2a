"""OpenEXR and nothing else, on threads: the floor that `speed` measures commands by.

    python codec.py '{"jobs": 2, "frames": [["a.1.exr", "b.1.exr"], ...], "models": [], "into": ""}'

Decodes each frame's files, and encodes the models, read once, for each frame into a folder.
"""

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import OpenEXR


def main() -> None:
    work = json.loads(sys.argv[1])
    models = []
    for path in work["models"]:
        file = OpenEXR.File(path)
        models.append({name: channel.pixels for name, channel in file.channels().items()})
    if models:
        Path(work["into"]).mkdir(parents=True)

    def frame(item: tuple[int, list[str]]) -> None:
        number, paths = item
        for path in paths:
            OpenEXR.File(path)
        for index, channels in enumerate(models):
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            target = Path(work["into"]) / f"{index}.{number}.exr"
            OpenEXR.File(header, dict(channels)).write(str(target))

    with ThreadPoolExecutor(work["jobs"]) as pool:
        list(pool.map(frame, enumerate(work["frames"])))


if __name__ == "__main__":
    main()
