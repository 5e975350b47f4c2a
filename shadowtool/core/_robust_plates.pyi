from typing import Any

from numpy.typing import NDArray

def sample(grays: tuple[NDArray[Any], ...], kept: tuple[NDArray[Any], ...]) -> None: ...
def add(
    frames: tuple[NDArray[Any], ...],
    bounds: tuple[NDArray[Any], ...],
    near: NDArray[Any],
    lit: tuple[NDArray[Any], ...],
    groups: tuple[NDArray[Any], ...],
    least_group: float,
) -> None: ...
