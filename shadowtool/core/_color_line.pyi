from typing import Any

from numpy.typing import NDArray

def nearest(
    colours: NDArray[Any],
    weight: NDArray[Any],
    lit: NDArray[Any],
    shadow: NDArray[Any],
    distance: NDArray[Any],
    part: NDArray[Any],
) -> None: ...
