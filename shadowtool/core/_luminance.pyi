from typing import Any

from numpy.typing import NDArray

def luminance(
    red: NDArray[Any],
    green: NDArray[Any],
    blue: NDArray[Any],
    out: NDArray[Any],
    of_red: float,
    of_green: float,
    of_blue: float,
) -> None: ...
